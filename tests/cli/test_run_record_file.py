"""``run.json`` as a file."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from neuros.api.run_folder import write_record


@contextmanager
def files_end_after(size: int) -> Iterator[None]:
    """No file can grow beyond so many bytes, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_where_there_is_no_room_no_part_of_it_is_left(tmp_path: Path) -> None:
    with files_end_after(100), pytest.raises(OSError, match="File too large"):
        write_record({"reason": "x" * 1000}, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_it_is_json(tmp_path: Path) -> None:
    write_record({"reason": "done"}, tmp_path)
    (file,) = tmp_path.iterdir()
    assert json.loads(file.read_text()) == {"reason": "done"}
