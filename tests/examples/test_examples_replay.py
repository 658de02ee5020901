"""Each example is replayed as a whole, and forked: every node sends the same again."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import neuros
from launching import BACKENDS, EXAMPLES, launch

WHISKEYE = "4_neurorobotics/whiskeye"
SHORT = ("--duration", "3sim")
FAST = ("--set", "nodes.elevator.environment.REAL_TIME_FACTOR=20")
EVERY_TIME = [
    ("1_tick/clock", "--duration", "2"),
    ("2_synchronisation/tennis",),
    ("3_physics_simulation/elevator/asynchronous.json", *FAST),
]
LONG = [
    ("2_synchronisation/voting",),
    ("3_physics_simulation/elevator",),
    ("3_physics_simulation/elevator/no_discard_limit.json",),
    (f"{WHISKEYE}/asynchronous.json",),
    (f"{WHISKEYE}/custom_messages.json", *SHORT),
    (f"{WHISKEYE}/no_discard_limit.json", *SHORT),
    (f"{WHISKEYE}/project.json",),
    (f"{WHISKEYE}/room.json", *SHORT),
    (f"{WHISKEYE}/strict.json",),
    (f"{WHISKEYE}/tick_20ms.json", *SHORT),
    (f"{WHISKEYE}/tick_60ms.json", *SHORT),
    (f"{WHISKEYE}/tick_100ms.json", *SHORT),
    (f"{WHISKEYE}/homing.json", *SHORT),
    (f"{WHISKEYE}/live.json", *SHORT),
    (f"{WHISKEYE}/own_labels.json", *SHORT),
    (f"{WHISKEYE}/training.json", *SHORT),
    ("4_neurorobotics/light", "--duration", "5"),
    ("6_outside/rover", "--duration", "2"),
    ("7_learning/cartpole", *SHORT),
    ("7_learning/cartpole/exported.json", *SHORT),
    ("8_plasticity/gaze", "--set", "nodes.chair.environment.SECONDS=3"),
    ("8_plasticity/seeker", "--set", "nodes.teacher.environment.EPISODES=2"),
    ("9_legs/ant", "--duration", "3"),
]
VIRTUAL_TIME = ("--time", "virtual")
FORKED = [
    ("1_tick/clock", "1", *VIRTUAL_TIME, "--duration", "2"),
    ("2_synchronisation/tennis", "0.0005", *VIRTUAL_TIME),
    ("2_synchronisation/voting", "0.0005", *VIRTUAL_TIME),
    ("3_physics_simulation/elevator", "1", *VIRTUAL_TIME),
    ("3_physics_simulation/elevator/asynchronous.json", "1", *VIRTUAL_TIME),
    ("3_physics_simulation/elevator/no_discard_limit.json", "1", *VIRTUAL_TIME),
    (f"{WHISKEYE}/asynchronous.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/custom_messages.json", "1sim", *SHORT),
    (f"{WHISKEYE}/no_discard_limit.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/project.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/room.json", "1sim", *SHORT),
    (f"{WHISKEYE}/strict.json", "1sim", *SHORT),
    (f"{WHISKEYE}/tick_20ms.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/tick_60ms.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/tick_100ms.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/homing.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/live.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/nengo.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/own_labels.json", "1", *VIRTUAL_TIME, *SHORT),
    (f"{WHISKEYE}/training.json", "1", *VIRTUAL_TIME, *SHORT),
    ("4_neurorobotics/light", "0.05", *VIRTUAL_TIME),
    ("4_neurorobotics/light/pynn.json", "0.05", *VIRTUAL_TIME),
    ("5_containers/conflict", "0.05", *VIRTUAL_TIME),
    ("7_learning/cartpole", "1", *VIRTUAL_TIME, *SHORT),
    ("7_learning/cartpole/exported.json", "1", *VIRTUAL_TIME, *SHORT),
    ("8_plasticity/gaze", "1", *VIRTUAL_TIME, "--set", "nodes.chair.environment.SECONDS=3"),
    ("8_plasticity/seeker", "1", *VIRTUAL_TIME, "--set", "nodes.teacher.environment.EPISODES=2"),
    ("9_legs/ant", "1", *VIRTUAL_TIME, "--duration", "3"),
]
WITH_WEIGHTS = ["learning", "prediction", "prediction_asynchronous", "prediction_hybrid"]
OWN_PYTHONS = [
    (f"{WHISKEYE}/nengo.json", *SHORT),
    ("4_neurorobotics/light/pynn.json", "--duration", "5"),
    ("5_containers/conflict", "--duration", "5"),
]


def replays(options: tuple[str, ...], backend: str, folder: Path) -> None:
    """Run an example recorded, then replay it."""
    project, *others = options
    command = [str(EXAMPLES / project), "--backend", backend, "-r", *others]
    run = launch(*command, cwd=folder, timeout_s=300.0)
    assert run.exit_code == 0, run.output
    done = printed("replay", run.run_folder)
    assert f"\nidentical: {len(run.record['nodes'])} node" in done
    assert "as far as recorded" not in done


@pytest.mark.parametrize("options", EVERY_TIME, ids=lambda options: options[0])
def test_an_example_replays(options: tuple[str, ...], tmp_path: Path) -> None:
    replays(options, "process", tmp_path)


@pytest.mark.acceptance
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("options", EVERY_TIME + LONG, ids=lambda options: options[0])
def test_each_example_replays(options: tuple[str, ...], backend: str, tmp_path: Path) -> None:
    replays(options, backend, tmp_path)


@pytest.mark.acceptance
@pytest.mark.parametrize("options", FORKED, ids=lambda options: options[0])
def test_each_example_that_can_be_repeated_forks(options: tuple[str, ...], tmp_path: Path) -> None:
    forks(options, tmp_path)


def forks(options: tuple[str, ...], folder: Path) -> Path:
    """Run an example, then fork it without a change; returns the folder of the run."""
    project, at, *others = options
    command = [str(EXAMPLES / project), "--backend", "process", "--digests", *others]
    run = launch(*command, cwd=folder, timeout_s=300.0)
    assert run.exit_code == 0, run.output
    assert run.run_folder is not None
    fork = folder / "fork"
    printed("fork", run.run_folder, "--at", at, "-o", fork)
    assert "\nidentical: " in printed("verify", run.run_folder, fork)
    return run.run_folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a short training has learnt."""
    brief = [f"nodes.trainer.environment.{each}" for each in ("VIEWS=60", "EPOCHS=2")]
    settings = [word for each in brief for word in ("--set", each)]
    command = [str(EXAMPLES / WHISKEYE / "training.json"), "--backend", "process", *settings]
    run = launch(*command, cwd=tmp_path_factory.mktemp("training"), timeout_s=300.0)
    assert run.exit_code == 0, run.output
    assert run.run_folder is not None
    return run.run_folder / "trainer/weights.npz"


@pytest.mark.acceptance
@pytest.mark.parametrize("name", WITH_WEIGHTS)
def test_each_example_with_weights_replays_and_forks(
    name: str, weights: Path, tmp_path: Path
) -> None:
    restored = ("--restore", f"pcn.weights={weights}")
    run = forks((f"{WHISKEYE}/{name}.json", "1", *VIRTUAL_TIME, *SHORT, "-r", *restored), tmp_path)
    assert "\nidentical: " in printed("replay", run)


def printed(*arguments: object) -> str:
    """What a command writes that succeeds."""
    done = neuros(*arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    return f"\n{done.stdout}"


@pytest.mark.acceptance
@pytest.mark.parametrize("options", OWN_PYTHONS, ids=lambda options: options[0])
def test_an_example_whose_nodes_have_pythons_of_their_own_replays(
    options: tuple[str, ...], tmp_path: Path
) -> None:
    replays(options, "process", tmp_path)
