"""What the engine is told of a container; no engine is needed for that."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from neuros.backends.docker.images import Image
from neuros.backends.docker.launcher import how_it_ended
from neuros.backends.docker.settings import (
    DDS_SETTINGS,
    as_here,
    container_settings,
    inside,
    outside,
)
from neuros.distribution import python_command
from neuros.errors import EnvironmentFault
from neuros.ports import NodeProgram
from neuros.project.model import Access, Folders, Node, NodeFile, Resources

HERE = Folders(Path("/home/me/robot"), Path("/opt/ws"), Path("/home/me/runs/1"))
IMAGE = Image("sha256:1234", "neuros_python", ("/opt/neuros/bin/python",), (3, 11))
RUN = {
    "NEUROS_RUN_ID": "0123456789abcdef",
    "ROS_LOG_DIR": "/home/me/runs/1",
    "NEUROS_CONTROL": "unix:/home/me/runs/1/control.sock",
}


def node_file(**keys: Any) -> NodeFile:
    node = Node("snn", "neuros_python", HERE.project / "nodes/snn.py", **keys)
    return NodeFile(node, (), HERE)


def settings(
    file: NodeFile,
    environ: Mapping[str, str] | None = None,
    cores: tuple[int, ...] = (),
    **options: Any,
) -> dict[str, Any]:
    program = NodeProgram(cores={"snn": cores}, environ=environ or {})
    return container_settings(file, IMAGE, program, RUN, **options)


def mounts(found: dict[str, Any]) -> dict[str, tuple[str, bool]]:
    """Where what is mounted, and whether it is read-only."""
    return {m["Target"]: (m["Source"], m["ReadOnly"]) for m in found["mounts"]}


def test_by_default_it_may_nothing_and_sees_only_its_run() -> None:
    found = settings(node_file())
    assert found["image"] == "sha256:1234"
    assert found["user"] == f"{os.getuid()}:{os.getgid()}"
    assert found["cap_drop"] == ["ALL"]
    assert found["security_opt"] == ["no-new-privileges"]
    assert {found[key] for key in ("read_only", "init", "auto_remove")} == {True}
    assert list(found["tmpfs"]) == ["/tmp"]
    assert found["pids_limit"] == 4096
    assert not {"mem_limit", "nano_cpus", "devices", "device_requests", "cpuset_cpus"} & set(found)
    seen = mounts(found)
    assert seen["/neuros/project"] == ("/home/me/robot", True)
    assert seen["/neuros/run"] == ("/home/me/runs/1", False)
    assert seen["/neuros/run/snn/node.json"] == ("/home/me/runs/1/snn/node.json", True)
    assert seen["/neuros/lib/neuros"] == (str(Path(__file__).resolve().parents[2] / "neuros"), True)
    assert "/neuros/workspace" not in seen, "there is none here"
    assert seen["/dev/shm"] == ("/dev/shm/neuros_0123456789abcdef", False)
    assert {path for path, (_, read_only) in seen.items() if not read_only} == {
        "/neuros/run",
        "/dev/shm",
    }
    assert found["ipc_mode"] == "private"


def test_what_others_have_in_the_run_folder_can_only_be_read() -> None:
    seen = mounts(settings(node_file(), others=[HERE.run / "arm", HERE.run / "project.json"]))
    assert seen["/neuros/run/arm"] == ("/home/me/runs/1/arm", True)
    assert seen["/neuros/run/project.json"] == ("/home/me/runs/1/project.json", True)


def test_with_a_rootless_engine_its_user_is_root_inside_and_has_no_more_rights() -> None:
    found = settings(node_file(access=Access(devices=("/dev/null",))), is_rootless=True)
    assert (found["user"], found["group_add"]) == ("0:0", [])
    assert found["cap_drop"] == ["ALL"]


def test_it_is_labelled_and_named() -> None:
    found = settings(node_file(), launcher_pid=77)
    assert found["name"] == "neuros-snn-01234567"
    assert found["labels"] == {
        "neuros.run": "0123456789abcdef",
        "neuros.node": "snn",
        "neuros.project": "/home/me/robot",
        "neuros.run_folder": "/home/me/runs/1",
        "neuros.launcher": "77",
    }


def test_limits_and_cores_are_passed_on() -> None:
    resources = Resources(mem_bytes=2 << 30, cpus=1.5, pids=50)
    found = settings(node_file(resources=resources), cores=(2, 3))
    assert found["mem_limit"] == found["memswap_limit"] == 2 << 30
    assert found["nano_cpus"] == 1_500_000_000
    assert found["pids_limit"] == 50
    assert found["cpuset_cpus"] == "2,3"


@pytest.mark.parametrize(
    ("gpus", "request_"),
    [(("all",), {"count": -1}), (("0", "GPU-3a"), {"device_ids": ["0", "GPU-3a"]})],
)
def test_gpus_and_devices_are_requested(
    gpus: tuple[str, ...], request_: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    owner = os.stat("/dev/null").st_gid
    monkeypatch.setattr("os.getgroups", lambda: [owner, owner + 1])
    file = node_file(access=Access(devices=("/dev/null",), gpus=gpus))
    found = settings(file)
    assert found["device_requests"] == [{**request_, "capabilities": [["gpu"]]}]
    assert found["devices"] == ["/dev/null:/dev/null:rw"]
    assert found["group_add"] == [str(owner)], "the group that owns the device"


def test_a_device_that_is_not_there_is_named() -> None:
    file = node_file(access=Access(devices=("/dev/none",)))
    with pytest.raises(EnvironmentFault, match="node 'snn' asks for the device /dev/none: No such"):
        settings(file)


def test_the_display_is_open_to_those_alone_that_ask_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuros.backends.docker.settings.X11", tmp_path)
    key = tmp_path / ".Xauthority"
    key.touch()
    user = {"DISPLAY": ":1", "NEUROS_GUI": "1", "HOME": str(tmp_path)}
    closed = settings(node_file(), user)
    assert not {"DISPLAY", "NEUROS_GUI", "XAUTHORITY"} & set(closed["environment"])
    found = settings(node_file(access=Access(display=True)), user)
    assert found["environment"]["DISPLAY"] == ":1"
    assert found["environment"]["NEUROS_GUI"] == "1"
    assert found["environment"]["XAUTHORITY"] == "/neuros/xauthority"
    assert mounts(found)["/neuros/xauthority"] == (str(key), True)
    assert mounts(found)[str(tmp_path)] == (str(tmp_path), True)


def test_a_display_over_the_network_comes_without_a_socket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuros.backends.docker.settings.X11", tmp_path / "none")
    user = {"DISPLAY": "localhost:10.0"}
    found = settings(node_file(access=Access(display=True)), user)
    assert found["environment"]["DISPLAY"] == "localhost:10.0"
    assert str(tmp_path / "none") not in mounts(found)


def test_settings_of_dds_of_the_users_own_are_passed_on(tmp_path: Path) -> None:
    (tmp_path / "dds.xml").touch()
    found = settings(node_file(), {DDS_SETTINGS: str(tmp_path / "dds.xml")})
    assert found["environment"][DDS_SETTINGS] == "/neuros/fast_dds.xml"
    assert mounts(found)["/neuros/fast_dds.xml"] == (str(tmp_path / "dds.xml"), True)
    with pytest.raises(EnvironmentFault, match="there is no such file"):
        settings(node_file(), {DDS_SETTINGS: str(tmp_path / "none.xml")})


def test_the_environment_is_that_of_the_node_and_little_of_the_users() -> None:
    environ = {"TOKEN": "secret", "LANG": "C.UTF-8", "OMP_NUM_THREADS": "2", "TZ": "UTC"}
    file = node_file(environment={"RATE": "50", "TZ": "CET"})
    found = settings(file, environ)["environment"]
    assert found["RATE"] == "50"
    assert found["LANG"] == "C.UTF-8"
    assert found["OMP_NUM_THREADS"] == "2"
    assert found["MKL_NUM_THREADS"] == "1"
    assert found["TZ"] == "CET", "what the node says counts"
    assert found["NEUROS_RUN_ID"] == "0123456789abcdef"
    assert found["NEUROS_RUN_DIR"] == "/neuros/run/snn"
    assert found["ROS_LOG_DIR"] == "/neuros/run"
    assert found["NEUROS_CONTROL"] == "unix:/neuros/run/control.sock"
    assert found["HOME"] == "/tmp"
    assert "TOKEN" not in found


def test_paths_are_those_inside() -> None:
    file = node_file(
        script=HERE.workspace / "before.sh",
        environment={"MODEL": "/home/me/robot/m.xml", "TEXT": "/home/me/robot"},
        environment_paths=("MODEL",),
    )
    seen = inside(file)
    assert seen.node.plugin == Path("/neuros/project/nodes/snn.py")
    assert seen.node.script == Path("/neuros/workspace/before.sh")
    assert seen.node.environment["MODEL"] == "/neuros/project/m.xml"
    assert seen.node.environment["TEXT"] == "/home/me/robot", "that is no path"
    assert seen.folders.run == Path("/neuros/run")


def test_what_a_node_says_has_the_paths_of_this_machine() -> None:
    said = 'File "/neuros/project/a.py"; /neuros/run; /neuros/runner; /x/neuros/run'
    assert as_here(said, HERE) == (
        'File "/home/me/robot/a.py"; /home/me/runs/1; /neuros/runner; /x/neuros/run'
    )


def test_it_executes_the_python_of_its_image_and_writes_its_own_log() -> None:
    found = settings(node_file())
    assert found["entrypoint"][:2] == ["/bin/sh", "-c"]
    assert found["entrypoint"][3:] == [
        *("/neuros/run/snn/node.log", "/home/me/runs/1/snn/node.log"),
        *python_command(
            "neuros.cli", "node", "/neuros/run/snn/node.json", python="/opt/neuros/bin/python"
        ),
    ]
    assert found["working_dir"] == "/neuros/run"


def test_built_message_packages_are_found_and_cannot_be_changed() -> None:
    built = Path("/home/me/.cache/neuros/messages/arm_msgs-0123456789ab")
    description = str(built / "share/arm_msgs/msg/Joints.json")
    file = replace(
        node_file(environment={"HASH": description}, environment_paths=("HASH",)),
        messages=(built / "python",),
    )
    found, there = settings(file), "/neuros/messages/arm_msgs-0123456789ab"
    assert mounts(found)[there] == (str(built), True)
    assert found["environment"]["PYTHONPATH"] == f"{there}/python:/neuros/lib"
    assert found["environment"]["HASH"] == f"{there}/share/arm_msgs/msg/Joints.json"
    assert outside(inside(file), HERE, built.parent) == file


def test_what_a_node_was_told_is_translated_back() -> None:
    file = node_file(
        script=HERE.workspace / "prepare.sh",
        environment={"MODEL": "/home/me/robot/a.xml", "DATA": "/data", "NOTE": "/home/me/robot"},
        environment_paths=("DATA", "MODEL"),
    )
    assert inside(file).node.script == Path("/neuros/workspace/prepare.sh")
    assert outside(inside(file), HERE) == file
    moved = Folders(Path("/srv/robot"), HERE.workspace, Path("/srv/run"))
    there = outside(inside(file), moved)
    assert there.folders == moved
    assert there.node.plugin == Path("/srv/robot/nodes/snn.py")
    assert there.node.environment["MODEL"] == "/srv/robot/a.xml"
    assert there.node.environment["DATA"] == "/data", "it was never mounted"


@pytest.mark.parametrize(
    ("exit_code", "is_out_of_memory", "mem_bytes", "words"),
    [
        (0, False, None, "exit code 0"),
        (3, False, 1 << 30, "exit code 3"),
        (137, True, 2 << 30, "out of memory (limit 2g)"),
        (137, True, None, "out of memory"),
        (137, False, 2 << 30, "killed by SIGKILL"),
        (139, False, None, "killed by SIGSEGV"),
        (1, True, 512 << 20, "exit code 1, after a process of it ran out of memory (limit 512m)"),
        (127, False, None, "exit code 127: sh: /opt/x: not found"),
    ],
)
def test_how_it_ended_is_said_in_words(
    tmp_path: Path, exit_code: int, is_out_of_memory: bool, mem_bytes: int | None, words: str
) -> None:
    log = tmp_path / "node.log"
    log.write_text("first\nsh: /opt/x: not found\n")
    assert how_it_ended(exit_code, is_out_of_memory, log, mem_bytes) == words
