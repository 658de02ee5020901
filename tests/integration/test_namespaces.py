"""Two copies of a project in one ROS domain, of which neither hears anything of the other."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from launching import Finished, launch, start
from ros_program import RosProgram
from std_srvs.srv import Trigger

from containers import require_containers
from neuros import bag
from neuros.backends.domain import choose_domain

PROJECT = Path(__file__).parent / "namespaces"
LIMIT_S = 60.0
# The second copy has names of its own through rules for what its namespace does not move.
COPIES = {"/left": ("--remap", "/shared:=shared"), "/lab/right": ("--remap", "/shared:=/our/own")}


@pytest.mark.parametrize(
    "back_ends",
    [
        ("process", "in-process"),
        pytest.param(("docker", "docker"), marks=pytest.mark.acceptance),
    ],
    ids="-".join,
)
def test_two_copies_share_a_domain(
    back_ends: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "docker" in back_ends:
        require_containers()
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with choose_domain(None, {}, False) as domain, contextlib.ExitStack() as stack:
        running = {}
        for (namespace, rules), back_end in zip(COPIES.items(), back_ends, strict=True):
            folder = tmp_path / namespace[1:].replace("/", "_")
            folder.mkdir()
            arguments = ("--backend", back_end, "-d", str(domain.id), "-r")
            copy = start(PROJECT, *arguments, "--namespace", namespace, *rules, cwd=folder)
            running[namespace] = stack.enter_context(copy)
        program = stack.enter_context(RosProgram(domain_id=domain.id))
        for namespace in COPIES:
            wait_until_it_has_heard(program, namespace)
        listed = neuros("ps")
        for namespace, copy in running.items():
            assert f"{namespace}/talker" in listed
            copy.signal(signal.SIGINT)
        finished = {namespace: copy.finish() for namespace, copy in running.items()}
    check(finished["/left"], "/left", shared="/left/shared")
    check(finished["/lab/right"], "/lab/right", shared="/our/own")


def wait_until_it_has_heard(program: RosProgram, namespace: str) -> None:
    def has_heard() -> bool:
        told = program.call(Trigger, f"{namespace}/tell", Trigger.Request(), LIMIT_S)
        return bool(told.success)

    program.spin_until(has_heard, LIMIT_S)


def neuros(*arguments: str) -> str:
    command = [sys.executable, "-m", "neuros.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def check(finished: Finished, namespace: str, *, shared: str) -> None:
    """What was recorded and counted is of this copy alone, and can be replayed."""
    assert finished.exit_code == 130, finished.output
    assert finished.run_folder is not None
    assert finished.record["namespace"] == namespace
    counters = finished.connection("talker.inside -> listener.inside")
    assert counters["sent"] >= 5
    inside = f"{namespace}/neuros/talker/inside/listener/inside/data"
    with bag.open(finished.run_folder) as recorded:
        assert {*recorded.topics} - {"/clock"} == {inside, f"{namespace}/said", shared}
        assert recorded[inside].count == counters["sent"]
        for topic in (inside, f"{namespace}/said", shared):
            assert {message.data for _, message in recorded[topic].messages()} == {namespace}


@pytest.mark.acceptance
def test_a_run_in_a_namespace_can_be_replayed(tmp_path: Path) -> None:
    names = ("--namespace", "left", "--remap", "/shared:=shared")
    with choose_domain(None, {}, False) as domain:
        arguments = ("--backend", "process", "-d", str(domain.id), "-r", "--duration", "1")
        finished = launch(PROJECT, *arguments, *names, cwd=tmp_path)
    assert finished.exit_code == 0, finished.output
    told = neuros("replay", str(finished.run_folder), "--node", "talker")
    assert told.startswith("identical: ")
    assert " on 3 connections; " in told
