"""What plugins keep beyond a run: saved with it, restored by name, and over resets."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from api_projects import dice
from replaying import replay
from test_python_api import thrown
from test_stepped_sessions import ACCEPTANCE, DEADLINE_S, EVERY_BACK_END

import neuros
from containers import require_containers
from neuros.api.session import Session
from neuros.cli.main import main
from neuros.errors import RunError, UsageError
from neuros.hooks import neuros_initialise, neuros_tick
from neuros.node.keeping import encoded

LEARNER = """
import numpy as np
from neuros.hooks import neuros_function, neuros_initialise

@neuros_initialise()
def start(node):
    learnt = np.zeros(2)  # sum and number of the eyes

    def put(kept):
        learnt[:] = kept["layer"]

    node.set_user_data(learnt)
    node.keep("weights", lambda: {"layer": learnt, "note": "eyes"}, put)

@neuros_function(inputs="eyes")
def learn(node, eyes):
    learnt = node.get_user_data()
    learnt += eyes.data, 1
    if "SHUTDOWN":
        node.shutdown("learnt")
"""
ENDLESS = LEARNER.replace('"SHUTDOWN"', "False")
ENDING = LEARNER.replace('"SHUTDOWN"', "learnt[1] % 10 == 0")
WEIGHTS = "counter.weights"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def learner(folder: Path, plugin: str = ENDING) -> neuros.Project:
    return neuros.Project.from_file(dice(folder, plugin))


def learnt(run: neuros.Run) -> list[float]:
    """Sum and number of the eyes that were seen."""
    found: list[float] = run.kept(WEIGHTS)["layer"].tolist()
    return found


def needs(back_end: str) -> str:
    if back_end == "docker":
        require_containers()
    return back_end


@pytest.mark.parametrize("back_end", EVERY_BACK_END[1:])
def test_a_run_goes_on_learning_where_an_earlier_one_has_ended(
    tmp_path: Path, back_end: str
) -> None:
    project = learner(tmp_path)
    first = project.run(backend=needs(back_end), check=True)
    assert learnt(first) == [sum(thrown(1)), 10]
    file = first.folder / "counter" / "kept" / "weights.npz"
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    described = {"sha256": sha256, "bytes": file.stat().st_size}
    assert first.nodes["counter"]["kept"] == {"weights": described}
    second = project.run(backend=back_end, restore={WEIGHTS: first}, seed=2, check=True)
    assert learnt(second) == [sum(thrown(1)) + sum(thrown(2)), 20]
    assert second.nodes["counter"]["restored"] == {"weights": {"from": str(file), **described}}
    assert not {"kept", "restored"} & {*second.nodes["thrower"]}


@pytest.mark.parametrize("back_end", EVERY_BACK_END)
class TestASession:
    def test_keeps_over_a_reset_what_it_is_asked_to(self, tmp_path: Path, back_end: str) -> None:
        with learner(tmp_path, ENDLESS).session(backend=needs(back_end)) as s:
            step(s, 3)
            s.reset(seed=2, keep=WEIGHTS)
            step(s, 2)
            s.reset(seed=3, keep=True)
            step(s, 1)
        assert learnt(s.close()) == [sum([*thrown(1)[:3], *thrown(2)[:2], *thrown(3)[:1]]), 6]

    def test_begins_again_with_what_was_restored(self, tmp_path: Path, back_end: str) -> None:
        file = tmp_path / "own.npz"
        file.write_bytes(encoded({"layer": np.array([100.0, 50.0])}))
        project = learner(tmp_path, ENDLESS)
        with project.session(backend=needs(back_end), restore={WEIGHTS: file}) as s:
            step(s, 3)
            s.reset(seed=2)
            step(s, 2)
        assert learnt(s.close()) == [100 + sum(thrown(2)[:2]), 52]
        assert s.close().nodes["counter"]["restored"]["weights"]["from"] == str(file)


def step(s: Session, rounds: int) -> None:
    assert s.step(rounds, timeout_s=DEADLINE_S)


def test_a_reset_that_is_not_asked_to_keep_anything_begins_anew(tmp_path: Path) -> None:
    with learner(tmp_path, ENDLESS).session(backend="local") as s:
        step(s, 3)
        s.reset(keep=[WEIGHTS])
        assert (s.folder / "counter" / "kept" / "weights.npz").exists()
        s.reset()
        assert not (s.folder / "counter" / "kept" / "weights.npz").exists()
        step(s, 1)
    assert learnt(s.close()) == [thrown(1)[0], 1]


def test_a_reset_of_a_run_that_has_ended_keeps_what_that_has_left(tmp_path: Path) -> None:
    with learner(tmp_path).session(backend="local") as s:
        while s.step(timeout_s=DEADLINE_S):
            pass
        with pytest.raises(UsageError, match=r"keeps 'weight' .did you mean 'counter.weights'"):
            s.reset(keep="counter.weight")
        s.reset(keep=WEIGHTS)
        step(s, 2)
    assert learnt(s.close()) == [sum(thrown(1)) + sum(thrown(1)[:2]), 12]


@pytest.mark.parametrize("back_end", ["local", "in-process"])
def test_a_session_that_keeps_no_such_value_says_so_and_goes_on(
    tmp_path: Path, back_end: str
) -> None:
    wrong: dict[str, Any] = {
        r"keeps 'weigths' \(did you mean 'counter.weights'\?\)": "counter.weigths",
        r"node 'thrower' keeps 'luck' \(plugins keep 'counter.weights'\)": ["thrower.luck"],
        "in node 'counter' keeps ''": "counter",
    }
    with learner(tmp_path, ENDLESS).session(backend=back_end) as s:
        step(s, 1)
        for said, asked in wrong.items():
            with pytest.raises(UsageError, match=said):
                s.reset(keep=asked)
        step(s, 1)
    assert learnt(s.close()) == [sum(thrown(1)[:2]), 2]


STAYING = """
import numpy as np
from neuros.hooks import neuros_function, neuros_initialise, neuros_reset

@neuros_initialise()
def start(node):
    weights = np.zeros(2)
    node.set_user_data(weights)
    node.keep("weights", lambda: {"layer": weights}, lambda kept: np.copyto(weights, kept["layer"]))

@neuros_reset()
def begin(node):
    node.get_user_data()[:] = 0.0
"""


@pytest.mark.parametrize("back_end", ["local", "in-process"])
def test_a_plugin_that_stays_loaded_gets_its_values_after_its_reset_hooks(
    tmp_path: Path, back_end: str
) -> None:
    plugin = STAYING + ENDLESS[ENDLESS.index("@neuros_function") :]
    with learner(tmp_path, plugin).session(backend=back_end) as s:
        step(s, 3)
        s.reset(seed=2, keep=WEIGHTS)
        step(s, 2)
        assert not s.runs
    assert learnt(s.close()) == [sum([*thrown(1)[:3], *thrown(2)[:2]]), 5]


@ACCEPTANCE
def test_each_recorded_episode_keeps_its_own(tmp_path: Path) -> None:
    project = learner(tmp_path, ENDLESS)
    with project.session(backend="in-process", record=True) as s:
        step(s, 3)
        s.reset(seed=2, keep=WEIGHTS)
        step(s, 2)
    (first,) = s.runs
    assert learnt(first) == [sum(thrown(1)[:3]), 3]
    assert learnt(s.close()) == [sum([*thrown(1)[:3], *thrown(2)[:2]]), 5]


@neuros_initialise()
def begin(node: Any) -> None:
    own = {"sum": 0}
    node.set_user_data(own)
    node.keep("sum", lambda: own["sum"], lambda kept: own.update(sum=kept))


@neuros_tick(seconds=1000.0)  # each step lets it start
def add(node: Any) -> None:
    node.get_user_data()["sum"] += 1


@pytest.mark.parametrize("back_end", ["local", "in-process"])
def test_functions_as_plugins_keep_as_files_do(back_end: str) -> None:
    project = neuros.Project(nodes=[neuros.Node("counter", plugin=[begin, add])], connections=[])
    with project.session(backend=back_end) as s:
        step(s, 3)
        s.reset(keep="counter.sum")
        step(s, 2)
    with project.session(backend=back_end, restore={"counter.sum": s.close()}) as again:
        step(again, 1)
        again.reset()
        step(again, 2)
    assert (s.close().kept("counter.sum"), again.close().kept("counter.sum")) == (5, 7)


# ------------------------------------------------------------------ the command line


def test_launch_restores_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project = dice(tmp_path, ENDING)
    launch = ["launch", str(project), "--backend", "in-process"]
    assert main([*launch, "-o", "first"]) == 0
    assert "counter.weights was kept: " in capsys.readouterr().out
    assert main([*launch, "-o", "second", "--restore", f"{WEIGHTS}=first"]) == 0
    assert "counter.weights was restored: " in capsys.readouterr().out
    assert learnt(neuros.Run("second")) == [2 * sum(thrown(1)), 20]
    for wrong in ("first", f"{WEIGHTS}=", "=first"):
        assert main([*launch, "-o", "third", "--restore", wrong]) == 2
        assert "--restore" in capsys.readouterr().err
    assert not Path("third").exists()


# ------------------------------------------------------------------ mistakes


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> neuros.Run:
    folder = tmp_path_factory.mktemp("earlier")
    return learner(folder).run(backend="in-process", output=folder / "run", check=True)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("conter.weights", r"'conter.weights' is nothing .* \(did you mean 'counter'\?\)"),
        ("weights", r"'weights' is nothing that a node keeps \(nodes are thrower, counter\)"),
        ("counter", r"'counter' is nothing that a node keeps \(say node.name\)"),
        ("counter.weigths", r"no 'counter.weigths' \(did you mean 'counter.weights'\?\)"),
        ("thrower.luck", r"no 'thrower.luck' \(it has kept 'counter.weights'\)"),
    ],
)
def test_a_value_that_the_earlier_run_lacks_is_refused_before_the_start(
    tmp_path: Path, earlier: neuros.Run, value: str, said: str
) -> None:
    project = learner(tmp_path)
    with pytest.raises(UsageError, match=said):
        project.run(backend="in-process", restore={value: earlier.folder})
    with pytest.raises(UsageError, match=said):
        project.session(backend="local", restore={value: earlier})
    assert not (tmp_path / "runs").exists()


def test_a_file_that_holds_no_value_is_refused_before_the_start(tmp_path: Path) -> None:
    project = learner(tmp_path)
    np.savez(tmp_path / "objects.npz", layer=np.array([Path()], dtype=object))
    (tmp_path / "text.npz").write_text("weights")
    for name, said in {
        "objects.npz": "objects.npz: it is no value that was kept .Object arrays cannot be loaded",
        "text.npz": "text.npz: it is no value that was kept .File is not a zip file",
        "gone.npz": "gone.npz cannot be read .No such file",
    }.items():
        with pytest.raises(UsageError, match=said):
            project.run(backend="in-process", restore={WEIGHTS: tmp_path / name})
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("value", "plugin", "said"),
    [
        ("weigths", ENDLESS, r"keeps 'weigths' \(did you mean 'weights'\?\)"),
        ("bias", ENDLESS, r"nothing in node 'counter' keeps 'bias' \(it keeps 'weights'\)"),
        (
            "weights",
            ENDLESS.replace("node.keep(", "print("),
            r"nothing in node 'counter' keeps 'weights' \(call node.keep in an initialise hook\)",
        ),
        (
            "weights",
            "from neuros.hooks import *\n" + ENDLESS[ENDLESS.index("@neuros_function") :],
            r"nothing in node 'counter' keeps 'weights' \(call node.keep in an initialise hook\)",
        ),
    ],
)
def test_a_restored_value_that_nothing_keeps_fails_the_run_by_name(
    tmp_path: Path, value: str, plugin: str, said: str
) -> None:
    file = tmp_path / "own.npz"
    file.write_bytes(encoded({"layer": np.zeros(2)}))
    with pytest.raises(RunError, match=said):
        learner(tmp_path, plugin).session(backend="local", restore={f"counter.{value}": file})


def test_it_fails_before_the_first_packet(tmp_path: Path) -> None:
    file = tmp_path / "own.npz"
    file.write_bytes(encoded({"layer": np.zeros(2)}))
    run = learner(tmp_path).run(backend="in-process", restore={"counter.bias": file})
    assert (run.exit_code, run.reason) == (
        1,
        "node 'counter' failed: nothing in node 'counter' keeps 'bias' (it keeps 'weights')",
    )
    assert run.connections["thrower.eyes -> counter.eyes"]["sent"] == 0


def test_a_value_that_does_not_fit_fails_the_run_at_the_line_of_the_plugin(tmp_path: Path) -> None:
    file = tmp_path / "own.npz"
    file.write_bytes(encoded({"layer": np.zeros(3)}))
    with pytest.raises(RunError, match=r"hook 'start'.*could not broadcast"):
        learner(tmp_path).session(backend="local", restore={WEIGHTS: file})


FAULTS = {
    "{'layer': learnt}['layers']": "keep: 'weights': KeyError: 'layers'",
    "{'layer': (learnt, 1)}": r"keep: 'weights'\['layer'\] is a tuple, which cannot be kept: give",
}


@pytest.mark.parametrize("fault", [*FAULTS])
def test_what_cannot_be_kept_fails_the_run_by_name(tmp_path: Path, fault: str) -> None:
    plugin = ENDING.replace('{"layer": learnt, "note": "eyes"}', fault)
    plugin = plugin.replace("    node.keep(", "    node.keep('good', list, print)\n    node.keep(")
    run = learner(tmp_path, plugin).run(backend="in-process")
    assert run.exit_code == 1
    with pytest.raises(RunError, match=FAULTS[fault]):
        run.check()
    assert [*run.nodes["counter"]["kept"]] == ["good"]


def test_a_run_that_fails_keeps_what_was_learnt_until_then(tmp_path: Path) -> None:
    plugin = ENDING.replace("node.shutdown(", "raise RuntimeError(")
    run = learner(tmp_path, plugin).run(backend="in-process")
    assert run.exit_code == 1
    assert learnt(run) == [sum(thrown(1)), 10]
    with pytest.raises(UsageError, match=r"has kept no 'counter.bias'"):
        run.kept("counter.bias")


def test_a_node_file_tells_what_was_restored(tmp_path: Path, earlier: neuros.Run) -> None:
    run = learner(tmp_path).run(backend="in-process", restore=[f"{WEIGHTS}={earlier.folder}"])
    told = json.loads((run.folder / "counter" / "node.json").read_text())
    source = earlier.folder / "counter" / "kept" / "weights.npz"
    assert told["restored"] == {"weights": str(source)}
    copy = run.folder / "counter" / "restored" / "weights.npz"
    assert copy.read_bytes() == source.read_bytes()


def test_a_replay_gives_a_node_what_was_restored_to_it(tmp_path: Path, earlier: neuros.Run) -> None:
    end = "\n@neuros_finalise()\ndef end(node):\n    print('learnt', [*node.get_user_data()])\n"
    plugin = ENDING.replace("import neuros_function", "import neuros_finalise, neuros_function")
    run = learner(tmp_path, plugin + end).run(
        backend="in-process", record=True, restore={WEIGHTS: earlier}, check=True
    )
    said = next(line for line in run.log("counter").splitlines() if line.startswith("learnt"))
    assert str(2 * sum(thrown(1))) in said
    assert said in replay(run.folder, "counter").stdout
