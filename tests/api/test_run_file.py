"""``run.json`` as a file."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from neuros.errors import EnvironmentFault, UsageError
from neuros.recording.run_file import read_run_file, write_run_file


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
        write_run_file({"reason": "x" * 1000}, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_it_is_json(tmp_path: Path) -> None:
    write_run_file({"reason": "done"}, tmp_path)
    (file,) = tmp_path.iterdir()
    assert json.loads(file.read_text()) == {"reason": "done"}


def test_what_is_no_record_is_refused_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no run\.json: it is not the folder of a run"):
        read_run_file(tmp_path)
    (tmp_path / "a").mkdir()
    (tmp_path / "a/node.json").touch()
    with pytest.raises(UsageError, match="its run goes on, or its launcher was killed"):
        read_run_file(tmp_path)
    for text, reason in (("{", "is broken"), ("[]", "holds no object"), ("{}", "has format None")):
        (tmp_path / "run.json").write_text(text)
        with pytest.raises((UsageError, EnvironmentFault), match=reason):
            read_run_file(tmp_path)
