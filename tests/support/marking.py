"""Which markers a test gets, from what it can reach; and that a unit test keeps to its own process.

A test reaches what its body, its fixtures and the helpers of ``tests`` that they use name. For what
:data:`REACHED` knows among that it is marked ``ros``, ``docker``, ``browser`` or ``process``; where
nothing is found, ``unit``. What is reached only through ``neuros`` is in :data:`BY_NAME`: a
unit test that starts a process, opens a ROS context or connects to a Docker engine fails.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any
from zlib import crc32

import pytest

ROOT = Path(__file__).resolve().parents[2]
HERE = tuple(f"{ROOT / name}{os.sep}" for name in ("tests", "extensions"))
KINDS = ("ros", "docker", "browser", "process", "slow")
# By module, or by name in a module.
REACHED = {
    "launching.start": "ros",
    "rclpy": "ros",
    "rclpy.context": "ros",
    "neuros.backends.docker.engine.connect": "docker",
    "playwright.sync_api": "browser",
    "subprocess": "process",
    "multiprocessing": "process",
    "neuros.backends.process_launchers.InProcessLauncher": "process",
    "neuros.backends.process_launchers.ProcessLauncher": "process",
}
# By the beginning of a test's path and name: what is reached through neuros, and what takes long.
BY_NAME = {
    "ros": (
        "api/test_arrays_in_programs.py::test_a_session",
        "api/test_copies.py",
        "api/test_free_runs.py",
        "api/test_kept_values.py",
        "api/test_local_sessions.py",
        "api/test_python_api.py",
        "api/test_reset_settings.py",
        "api/test_session_forks.py",
        "api/test_session_resets.py",
        "api/test_sessions_in_virtual_time.py",
        "api/test_stepped_sessions.py",
        "extensions/neuros-analysis/tests/test_packs.py",
        "extensions/neuros-analysis/tests/test_fork.py",
        "extensions/neuros-analysis/tests/test_replay_node.py",
        "extensions/neuros-analysis/tests/test_replay_of_topics.py",
        "extensions/neuros-analysis/tests/test_replay_run.py",
        "extensions/neuros-analysis/tests/test_report.py",
        "extensions/neuros-analysis/tests/test_spike_trains.py",
        "extensions/neuros-analysis/tests/test_sweep.py",
        "extensions/neuros-analysis/tests/test_timing_of_runs.py",
        "extensions/neuros-cluster/tests/test_apptainer.py",
        "extensions/neuros-cluster/tests/test_deployment.py",
        "extensions/neuros-cluster/tests/test_deployment_by_ssh.py",
        "extensions/neuros-cluster/tests/test_deployment_in_containers.py",
        "extensions/neuros-cluster/tests/test_exported_projects.py",
        "extensions/neuros-cluster/tests/test_slurm_script.py",
        "benchmarks/test_reproduce_runs.py",
        "conformance/test_conformance.py::test_further_random_projects",
        "conformance/test_conformance.py::test_random_projects",
        "conformance/test_conformance.py::test_what_once",
        "conformance/test_virtual_time.py",
        "extensions/neuros-learn/tests/test_datasets.py",
        "extensions/neuros-learn/tests/test_gym_environments.py",
        "extensions/neuros-learn/tests/test_gym_pictures.py",
        "extensions/neuros-learn/tests/test_gym_vectors.py",
        "extensions/neuros-learn/tests/test_policies.py::TestTime::test_a_session",
        "extensions/neuros-learn/tests/test_policies.py::TestRuns",
        "integration/",
        "runtime/test_local_loop.py::test_a_free_run_serves_ros",
        "runtime/test_local_loop.py::test_events_timers_and_threads",
        "runtime/test_virtual_time.py",
        "simulators/test_mujoco_noise.py::test_one_seed",
        "upgrades/test_upgrades.py",
    ),
    "process": (
        "extensions/neuros-analysis/tests/test_damaged_run_folders.py",
        "messages/test_stubs.py",
        "recording/test_provenance.py",
        "backends/test_container_pythons.py",
        "backends/test_placement.py",
        "backends/test_guardian.py",
        "backends/test_shared_memory.py::test_the_guardian",
        "benchmarks/test_against.py",
        "benchmarks/test_command.py",
        "benchmarks/test_reproduce_command.py",
        *(
            f"cli/test_command_line.py::test_{name}"
            for name in (
                *("a_core_that", "a_folder_that_cannot", "a_machine_without_rclpy"),
                *("a_name_that", "a_plugin_in_place", "nor_one"),
                *("simulated_time_needs", "what_could_not_be_started", "wrong_usage"),
            )
        ),
        "cli/test_validate_command.py",
        "doctor/test_checks.py",
        "examples/test_ant.py",
        "examples/test_gaze.py",
        "examples/test_seeker.py",
        "faults/",
        "fuzz/",
        "simulators/test_mujoco_opengl.py::TestDoctor",
        "snn/test_documented_node.py::test_its_spikes",
        "test_extensions.py::test_a_launch_without_options",
        "test_extensions.py::test_so_is_that_of_a_deployment",
        "test_extensions.py::test_what_an_extension_brings",
        "test_installation.py",
        "test_packages_installed.py",
        "testing/test_plugin_harness.py::test_what_is_not_looked_for",
    ),
    "slow": (
        "benchmarks/test_reproduce_headdirection.py",
        "documentation/test_site_parts.py::TestReference",
        "extensions/neuros-analysis/tests/test_report_command.py",
        "extensions/neuros-robots/tests/test_sdf_kinematics.py",
        "examples/test_whiskeye_correction.py",
        "examples/test_whiskeye_homing.py",
        "examples/test_whiskeye_network.py",
        "examples/test_whiskeye_plugins.py",
        "examples/test_whiskeye_room.py",
        "examples/test_whiskeye_training.py",
        "project/test_project_split.py",
        "recording/test_bag.py",
        "snn/test_nest_networks.py",
        "testing/test_harness_values.py",
        "transport/test_packet_values.py::TestEveryMessageClass",
    ),
}
_LONGEST = ("docker", "ros", "process")
_STARTS_A_PROCESS = {"subprocess.Popen", "os.fork", "os.posix_spawn", "os.exec", "os.system"}


def mark(item: pytest.Function) -> None:
    """Give a test the markers of what it uses, beside its own."""
    own = {each.name for each in item.iter_markers()}
    found = own & {*KINDS} | uses(item)
    for kind in found:
        item.add_marker(kind)
    if not found and not own & {"acceptance", "needs"}:
        item.add_marker("unit")


def uses(item: pytest.Function) -> set[str]:
    """The kinds of things that a test can reach outside its own process, or ``slow``."""
    definitions = item._fixtureinfo.name2fixturedefs.values()
    functions = [item.function, *(each.func for group in definitions for each in group)]
    found = set().union(*map(reached_from, functions))
    parameters = map(str, item.callspec.params.values()) if hasattr(item, "callspec") else ()
    if any(value.startswith(("process", "in-process")) for value in parameters):
        found -= {"docker"}
    name = item.nodeid.removeprefix("tests/")
    return found | {kind for kind, names in BY_NAME.items() if name.startswith(names)}


def longest_first(items: list[pytest.Function]) -> None:
    """Put the files first whose tests wait for containers, then those with runs.

    Those that only compute are spread among them, so that a core has work while others wait; a
    sixth of them comes last, when no worker should get anything long any more.
    """
    ranks: dict[Path, int] = {}
    for item in items:
        marked = {each.name for each in item.iter_markers()}
        rank = next((rank for rank, kind in enumerate(_LONGEST) if kind in marked), len(_LONGEST))
        ranks[item.path] = min(rank, ranks.get(item.path, rank))
    waiting = [file for file in ranks if ranks[file] < len(_LONGEST)]
    # Neighbours are alike; four workers that wait for the same thing would leave the cores idle.
    waiting.sort(key=lambda file: (ranks[file], crc32(file.name.encode())))
    computing = [file for file in ranks if ranks[file] == len(_LONGEST)]
    places = {file: place / len(waiting) for place, file in enumerate(waiting)}
    places |= {file: 1.2 * place / len(computing) for place, file in enumerate(computing)}
    items.sort(key=lambda item: (places[item.path], ranks[item.path]))


@cache
def reached_from(function: Callable[..., Any]) -> frozenset[str]:
    """The kinds of things outside its own process that a function of a test leads to."""
    return frozenset(_reached(function, set()))


def _reached(value: Any, seen: set[int]) -> set[str]:
    """What an object of a test module leads to."""
    value = getattr(value, "__wrapped__", value)
    if id(value) in seen:
        return set()
    seen.add(id(value))
    if isinstance(value, ModuleType):
        return {REACHED[value.__name__]} if value.__name__ in REACHED else set()
    if isinstance(value, FunctionType | type):
        name = f"{value.__module__}.{value.__qualname__}."
        if found := {kind for key, kind in REACHED.items() if name.startswith(f"{key}.")}:
            return found
        names = vars(sys.modules.get(value.__module__, sys))
        if (names.get("__file__") or "").startswith(HERE):
            if isinstance(value, type):
                return set().union(*(_reached(each, seen) for each in vars(value).values()))
            return _reached_by(value.__code__, value.__globals__, seen)
    return set()


def _reached_by(code: CodeType, names: Mapping[str, Any], seen: set[int]) -> set[str]:
    found = {REACHED[name] for name in code.co_names if name in REACHED}  # imported within
    found.update(*(_reached(names[name], seen) for name in code.co_names if name in names))
    inner = (each for each in code.co_consts if isinstance(each, CodeType))
    return found.union(*(_reached_by(each, names, seen) for each in inner))


class Watch:
    """Notes what leaves the process where nothing should."""

    def __init__(self) -> None:
        self._is_on = False
        self._noted: list[str] = []
        sys.addaudithook(self._note)

    @contextmanager
    def nothing_leaves(self) -> Iterator[None]:
        """Fail the test that leaves the process within the block."""
        from rclpy.context import Context

        init = Context.init

        def note_and_init(*of: Any, **given: Any) -> None:
            self._noted.append("a ROS context")
            init(*of, **given)

        self._noted.clear()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Context, "init", note_and_init)
            self._is_on = True
            try:
                yield
            finally:
                self._is_on = False
        if self._noted:
            pytest.fail(
                f"a unit test must not leave its process: {', '.join(self._noted)};"
                " let tests/support/marking.py know",
                pytrace=False,
            )

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self._is_on:
            if event in _STARTS_A_PROCESS:
                self._noted.append(f"{event} of {arguments[:1]}")
            elif event == "socket.connect" and "docker" in str(arguments[1]):
                self._noted.append(f"a connection to {arguments[1]}")
