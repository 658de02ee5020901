"""What the ROS wheels do to the environment of Python, undone and done once for all hosts."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from neuros.backends.node_command import with_libraries, without_mark

MARK = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
BOOTSTRAPPER = "ros_wheels_bootstrapper"
OURS = [f"{sys.prefix}/lib", f"{sys.prefix}/lib/ros_rcl.libs"]


@pytest.fixture
def wheels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Python that the wheels have restarted while the user had a library path, too."""
    found = os.pathsep.join([OURS[1], "/opt/mine", OURS[0]])
    stand_in = SimpleNamespace(get_ros_paths=lambda: found)
    monkeypatch.setitem(sys.modules, BOOTSTRAPPER, stand_in)
    monkeypatch.setenv(MARK, "1")


@pytest.mark.usefixtures("wheels")
def test_this_python_is_given_what_its_restart_would_give_it() -> None:
    given = without_mark({MARK: "1", "LD_LIBRARY_PATH": f"{OURS[0]}:/opt/mine", "A": "b"})
    assert given == {"LD_LIBRARY_PATH": "/opt/mine", "A": "b"}
    libraries = os.pathsep.join([*OURS, "/opt/mine"])
    assert with_libraries(given) == {"LD_LIBRARY_PATH": libraries, "A": "b", MARK: "1"}


@pytest.mark.usefixtures("wheels")
def test_no_folder_is_named_twice() -> None:
    once = with_libraries({})
    assert with_libraries(once) == once


def test_without_the_wheels_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, BOOTSTRAPPER, raising=False)
    monkeypatch.setenv(MARK, "1")
    assert with_libraries({"A": "b"}) == {"A": "b"}


@pytest.mark.usefixtures("wheels")
def test_wheels_that_do_not_restart_python_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(MARK)
    assert with_libraries({"A": "b"}) == {"A": "b"}


@pytest.mark.skipif(BOOTSTRAPPER not in sys.modules, reason="the wheels are not installed")
def test_ros_is_found_in_it() -> None:
    environment = with_libraries(without_mark(os.environ))
    program = f"import os, rclpy; print(os.environ['{MARK}'])"
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "1\n"
