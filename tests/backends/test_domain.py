"""Each run gets a ROS domain of its own, unless it is told otherwise."""

from __future__ import annotations

import fcntl
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from neuros.backends import domain as domain_module
from neuros.backends.domain import AUTOMATIC, DomainLock, choose_domain
from neuros.errors import EnvironmentFault, UsageError

_UDP_TABLES = domain_module._UDP_TABLES


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """No other ROS node of the machine, which might come or go within a test, takes a domain."""
    monkeypatch.setattr(domain_module, "_UDP_TABLES", ())


def _first_free(folder: Path) -> DomainLock:
    return choose_domain(None, {}, False, folder=folder)


def test_the_command_line_comes_first(tmp_path: Path) -> None:
    with choose_domain(7, {"ROS_DOMAIN_ID": "8"}, True, folder=tmp_path) as lock:
        assert lock.id == 7
        assert lock.reason == "ROS domain 7 (-d)"


def test_then_the_environment(tmp_path: Path) -> None:
    with choose_domain(None, {"ROS_DOMAIN_ID": " 8 "}, True, folder=tmp_path) as lock:
        assert lock.id == 8
        assert lock.reason == "ROS domain 8 (ROS_DOMAIN_ID)"


def test_a_project_that_others_must_find_is_in_domain_0(tmp_path: Path) -> None:
    with choose_domain(None, {"ROS_DOMAIN_ID": ""}, True, folder=tmp_path) as lock:
        assert lock.id == 0


def test_else_the_first_free_one(tmp_path: Path) -> None:
    with _first_free(tmp_path) as one, _first_free(tmp_path) as two:
        assert one.id in AUTOMATIC
        assert two.id > one.id
        assert one.reason == f"ROS domain {one.id} (first free)"


def test_a_released_domain_is_free_again_and_leaves_no_file(tmp_path: Path) -> None:
    with _first_free(tmp_path) as one:
        pass
    one.release()
    assert list(tmp_path.iterdir()) == []
    with _first_free(tmp_path) as two:
        assert two.id == one.id


def test_nobody_picks_a_domain_that_somebody_chose(tmp_path: Path) -> None:
    with _first_free(tmp_path) as probe:
        free = probe.id
    with choose_domain(free, {}, False, folder=tmp_path), _first_free(tmp_path) as picked:
        assert picked.id != free


def test_runs_may_share_a_domain_on_purpose(tmp_path: Path) -> None:
    with choose_domain(7, {}, False, folder=tmp_path):
        with choose_domain(7, {}, False, folder=tmp_path) as two:
            assert two.reason == "ROS domain 7 (-d)"
        assert list(tmp_path.iterdir()), "the first one still holds it"
    assert list(tmp_path.iterdir()) == []


def test_joining_a_run_that_picked_its_domain_is_said(tmp_path: Path) -> None:
    with _first_free(tmp_path) as one, choose_domain(one.id, {}, False, folder=tmp_path) as two:
        assert two.reason == f"ROS domain {one.id} (-d; another run uses it, too)"


def test_a_domain_in_which_a_ros_node_runs_without_our_lock_is_not_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(domain_module, "_UDP_TABLES", _UDP_TABLES)
    with _first_free(tmp_path) as probe:
        free = probe.id
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("", 7400 + 250 * free))
        with _first_free(tmp_path) as lock:
            assert lock.id != free


def test_the_lock_dies_with_a_killed_process(tmp_path: Path) -> None:
    program = (
        "import sys, time; from pathlib import Path\n"
        "from neuros.backends.domain import choose_domain\n"
        "lock = choose_domain(1, {}, False, folder=Path(sys.argv[1]))\n"
        "print(lock.id, flush=True); time.sleep(60)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    with process.stdout as output:
        assert output.readline() == "1\n"
    with _first_free(tmp_path) as lock:
        assert lock.id == 2
    process.kill()
    process.wait(5)
    with _first_free(tmp_path) as lock:
        assert lock.id == 1


def test_all_users_of_the_machine_can_lock(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        with _first_free(tmp_path) as lock:
            assert lock.path is not None
            assert lock.path.stat().st_mode & 0o777 == 0o666
    finally:
        os.umask(before)


def test_a_link_in_place_of_a_lock_file_is_not_followed(tmp_path: Path) -> None:
    with _first_free(tmp_path) as probe:
        path, free = probe.path, probe.id
    assert path is not None
    path.symlink_to(tmp_path / "elsewhere")
    with _first_free(tmp_path) as lock:
        assert lock.id != free
    assert not (tmp_path / "elsewhere").exists()


def test_a_pipe_in_place_of_a_lock_file_holds_up_nobody(tmp_path: Path) -> None:
    with _first_free(tmp_path) as probe:
        path = probe.path
    assert path is not None
    os.mkfifo(path)
    with _first_free(tmp_path) as lock:
        assert lock.path == path


def test_without_any_free_domain_the_user_is_told_what_to_do(tmp_path: Path) -> None:
    held = []
    try:
        for domain in AUTOMATIC:
            held.append(open(tmp_path / f"neuros-domain-{domain}.lock", "w"))  # noqa: SIM115
            fcntl.flock(held[-1], fcntl.LOCK_EX)
        with pytest.raises(EnvironmentFault, match=r"all ROS domains from 1 to 101.*-d"):
            _first_free(tmp_path)
    finally:
        for file in held:
            file.close()


@pytest.mark.parametrize("text", ["x", "-1", "233", "1.0", "1_0", "٣", "0x1"])
def test_an_environment_value_that_is_no_domain_is_a_usage_error(text: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="ROS_DOMAIN_ID"):
        choose_domain(None, {"ROS_DOMAIN_ID": text}, False, folder=tmp_path)


@pytest.mark.parametrize("domain", [-1, 233])
def test_so_is_one_on_the_command_line(domain: int, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--domain-id"):
        choose_domain(domain, {}, False, folder=tmp_path)
