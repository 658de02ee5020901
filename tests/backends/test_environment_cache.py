"""The cache of environments: what is whole, who makes what, what goes."""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

import pytest

from neuros.backends.pythons import CachedEnvironment, cache_folder
from neuros.caching import sweep

MONTHS_AGO_S = time.time() - 90 * 24 * 3600
KEY = "0123456789ab"


def make(entry: CachedEnvironment) -> None:
    """As a virtual environment, as far as the cache looks at it."""
    entry.future_python.parent.mkdir(parents=True)
    entry.future_python.symlink_to(sys.executable)


@pytest.fixture
def entry(tmp_path: Path) -> CachedEnvironment:
    return CachedEnvironment(tmp_path / "environments" / f"snn.old-{KEY}")


def test_it_is_where_caches_are() -> None:
    assert cache_folder({"XDG_CACHE_HOME": "/c", "HOME": "/h"}) == Path("/c/neuros/environments")
    assert cache_folder({"HOME": "/h"}) == Path("/h/.cache/neuros/environments")
    relative = {"XDG_CACHE_HOME": "c", "HOME": "/h"}  # which the specification has one ignore
    assert cache_folder(relative) == Path("/h/.cache/neuros/environments")


def test_what_has_not_been_recorded_is_not_there(entry: CachedEnvironment) -> None:
    make(entry)
    assert entry.python() is None
    entry.record_use()
    assert entry.python() == entry.folder / "bin/python"
    entry.remove()
    assert entry.python() is None


def test_an_environment_whose_python_has_gone_is_not_there(entry: CachedEnvironment) -> None:
    make(entry)
    entry.record_use()
    entry.future_python.unlink()
    entry.future_python.symlink_to("/nowhere/python3.11")
    assert entry.python() is None


def test_that_this_python_does_is_remembered_without_a_folder(entry: CachedEnvironment) -> None:
    entry.record_use()
    assert entry.python() == Path(sys.executable)
    assert not entry.folder.exists()


def test_only_one_can_have_it_and_the_next_sees_what_was_made(entry: CachedEnvironment) -> None:
    seen: list[Path | None] = []

    def wait_and_look() -> None:
        with entry.locked():
            seen.append(entry.python())

    with entry.locked() as is_mine:
        assert is_mine
        with entry.locked(wait=False) as is_others:
            assert not is_others
        waiting = threading.Thread(target=wait_and_look)
        waiting.start()
        entry.record_use()
    waiting.join(10)
    assert seen == [Path(sys.executable)]
    assert not list(entry.folder.parent.glob("*.lock"))


def test_what_was_interrupted_and_what_nobody_uses_is_swept(tmp_path: Path) -> None:
    used, unused, interrupted, working = (
        CachedEnvironment(tmp_path / f"{name}-{KEY}")
        for name in ("used", "unused", "interrupted", "working")
    )
    for each in (used, unused, interrupted, working):
        make(each)
    for each in (used, unused):
        each.record_use()
        os.utime(each.mark, (MONTHS_AGO_S, MONTHS_AGO_S))
    used.record_use()
    (tmp_path / "of-somebody-else").mkdir()
    with working.locked():
        sweep(tmp_path, CachedEnvironment)
        assert working.folder.is_dir()
    assert {path.name for path in tmp_path.iterdir()} == {
        f"used-{KEY}",
        f"working-{KEY}",
        "of-somebody-else",
    }


def test_the_log_of_what_failed_stays_for_a_month(entry: CachedEnvironment) -> None:
    entry.folder.parent.mkdir()
    entry.log.write_text("ERROR: no")
    sweep(entry.folder.parent, CachedEnvironment)
    assert entry.log.exists()
    os.utime(entry.log, (MONTHS_AGO_S, MONTHS_AGO_S))
    sweep(entry.folder.parent, CachedEnvironment)
    assert not list(entry.folder.parent.iterdir())
