"""Settings at the reset of a session: for one episode, without a new start where that will do."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from api_projects import ENDLESS, dice
from hypothesis import given, settings
from hypothesis import strategies as st

import neuros
from neuros.api.session import Session
from neuros.errors import ProjectError, RunError, UsageError

DEADLINE_S = 60.0
MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="ball" pos="0 0 10">
      <freejoint/>
      <geom name="ball" size="0.1" mass="2"/>
    </body>
  </worldbody>
</mujoco>
"""
FALLS = """
from neuros.hooks import neuros_function, neuros_initialise, neuros_reset
from neuros.simulators.mujoco import MuJoCo

@neuros_initialise()
def begin(node):
    node.set_user_data(MuJoCo(node, "ball.xml"))

@neuros_function(outputs="height")
def fall(node):
    simulator = node.get_user_data()
    simulator.step_synchronous()
    height = node.make_packet("height")
    height.data = simulator.data.qpos[2]
    return height
"""
KEEPS = (
    FALLS
    + """
@neuros_reset()
def again(node):
    node.get_user_data().reset()
"""
)


def falling(folder: Path, plugin: str = FALLS) -> Path:
    """A node with a ball that falls from 10 m."""
    (folder / "ball.xml").write_text(MODEL)
    (folder / "plugin.py").write_text(plugin)
    node = {"name": "world", "plugin": "plugin.py", "container": "neuros_mujoco"}
    height = {"name": "height", "type": "std_msgs/msg/Float64"}
    (folder / "project.json").write_text(json.dumps({"nodes": [{**node, "outputs": [height]}]}))
    return folder


def fallen(s: Session, steps: int = 10) -> float:
    """How far it falls in so many timesteps."""
    s.step(steps, timeout_s=DEADLINE_S)
    return 10.0 - float(s["world.height"].packet.data)


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NEUROS_BACKEND", raising=False)


@pytest.mark.parametrize("back_end", ["local", "in-process", "process"])
def test_a_variable_holds_for_one_episode(tmp_path: Path, back_end: str) -> None:
    with neuros.Project.from_file(dice(tmp_path, ENDLESS)).session(backend=back_end) as s:
        s.reset(set={"nodes.thrower.environment.FACES": 1})
        s.step(5, timeout_s=DEADLINE_S)
        assert {packet.data for packet in s["thrower.eyes"].packets} == {1}
        s.reset(seed=3)
        s.step(20, timeout_s=DEADLINE_S)
        assert {packet.data for packet in s["thrower.eyes"].packets} == {*range(1, 7)}
        assert len(s.runs) == (2 if back_end == "process" else 0)


@pytest.mark.parametrize(
    ("back_end", "plugin"),
    [
        *(("local", plugin) for plugin in (FALLS, KEEPS)),
        *(("in-process", plugin) for plugin in (FALLS, KEEPS)),
        ("process", FALLS),
    ],
)
def test_a_field_of_the_model_holds_for_one_episode(
    tmp_path: Path, back_end: str, plugin: str
) -> None:
    with neuros.Project.from_file(falling(tmp_path, plugin)).session(backend=back_end) as s:
        usual = fallen(s)
        s.reset(set={"world.model.opt.gravity": [0, 0, -1.0]})
        assert fallen(s) == pytest.approx(usual / 9.81)
        s.reset(set={"world.model.opt.gravity": 0})
        assert fallen(s) == 0.0
        s.reset()
        assert fallen(s) == usual


def test_a_session_may_begin_with_fields_of_a_model(tmp_path: Path) -> None:
    project = neuros.Project.from_file(falling(tmp_path))
    with project.session(set={"world.model.body_gravcomp": 1.0}) as s:
        assert fallen(s) == 0.0


def test_fields_of_the_session_hold_in_every_episode(tmp_path: Path) -> None:
    project = neuros.Project.from_file(falling(tmp_path))
    with project.session(set={"world.model.opt.gravity": 0}) as s:
        s.reset(set={"world.model.geom_friction": 0.4})
        assert fallen(s) == 0.0
        s.reset(set={"world.model.opt.gravity": [0, 0, -1.0]})
        assert fallen(s) > 0.0
        s.reset()
        assert fallen(s) == 0.0


def test_an_entity_may_be_spawned_in_an_episode_with_settings(tmp_path: Path) -> None:
    spawns = KEEPS.replace(
        "    simulator.step_synchronous()",
        "    if simulator.sim_time == 0.0 and not node.has_spawned:\n"
        "        node.has_spawned = True\n"
        "        simulator.spawn_entity('ball.xml', [0, 0, 20.0], 'second')\n"
        "    simulator.step_synchronous()",
    ).replace("def begin(node):", "def begin(node):\n    node.has_spawned = False")
    with neuros.Project.from_file(falling(tmp_path, spawns)).session() as s:
        s.reset(set={"world.model.geom_friction": 0.4})
        s.step()
        s.reset()
        assert fallen(s) > 0.0


@pytest.mark.filterwarnings("ignore:.*nothing in the plugin of node 'thrower' reads OTHER")
@pytest.mark.parametrize(
    "begun_with",
    [
        {"nodes.thrower.environment.FACES": 1},
        {"nodes.thrower.environment.FACES": 1, "nodes.thrower.parameters": {"other": 1}},
        {"nodes.thrower.environment.FACES": 1, "nodes.thrower.environment.OTHER": 1},
    ],
)
def test_settings_with_which_a_run_began_hold_for_its_first_episode_alone(
    tmp_path: Path, begun_with: dict[str, object]
) -> None:
    with neuros.Project.from_file(dice(tmp_path, ENDLESS)).session() as s:
        s.close()  # the next reset takes a new run
        s.reset(set=begun_with)
        s.step(5)
        assert {packet.data for packet in s["thrower.eyes"].packets} == {1}
        for _ in range(2):
            s.reset()
            s.step(20)
            assert {packet.data for packet in s["thrower.eyes"].packets} == {*range(1, 7)}


@settings(max_examples=20, deadline=None)
@given(gravity=st.lists(st.floats(-20, 0), min_size=1, max_size=4))
def test_what_an_episode_is_depends_on_its_own_settings_alone(
    falls: Session, gravity: list[float]
) -> None:
    for z in gravity:
        falls.reset(set={"world.model.opt.gravity": np.array([0.0, 0.0, z])})
        last = fallen(falls)
    falls.reset(set={"world.model.opt.gravity": [0.0, 0.0, gravity[-1]]})
    assert fallen(falls) == last


@pytest.fixture(scope="module")
def falls(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = falling(tmp_path_factory.mktemp("falls"), KEEPS)
    project = neuros.Project.from_file(folder)
    with project.session(backend="local", output=folder / "run") as s:
        yield s


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("geom_frictoin", 1.0, r"no field 'geom_frictoin'.*did you mean 'geom_friction'\?"),
        ("geom_friction", [1.0], r"'geom_friction' has the shape \(1, 3\), not \(1,\)"),
        ("geom_friction", "rough", "geom_friction='rough': give numbers"),
        ("names", 3, "no field 'names' with numbers"),
        ("opt", 3, r"no field 'opt' with numbers \(see the fields of mujoco.MjModel\)"),
        ("opt.gravit", 3, r"no field 'opt.gravit' with numbers \(did you mean 'gravity'\?\)"),
        ("opt.timestep", 0.001, "'opt.timestep' cannot be changed here"),
        ("nq", 3, "'nq' cannot be changed"),
        ("geom_type", 0.7, "geom_type=0.7: give whole numbers"),
        ("opt.integrator", 1.5, "opt.integrator=1.5: give whole numbers"),
    ],
)
def test_a_field_that_the_model_lacks_is_named(
    tmp_path: Path, field: str, value: object, said: str
) -> None:
    with neuros.Project.from_file(falling(tmp_path)).session() as s:
        with pytest.raises(RunError, match=said):
            s.reset(set={f"world.model.{field}": value})
        s.reset()
        assert fallen(s) > 0.0


def test_a_variable_that_nothing_reads_is_a_warning(tmp_path: Path) -> None:
    with neuros.Project.from_file(dice(tmp_path, ENDLESS)).session() as s:
        with pytest.warns(UserWarning, match="nothing in the plugin of node 'thrower' reads FACSE"):
            s.reset(set={"nodes.thrower.environment.FACSE": 1})
        assert not s.runs


@pytest.mark.parametrize(
    ("path", "value", "kind", "said"),
    [
        ("wrld.model.opt.gravity", 0, UsageError, r"no node 'wrld' \(did you mean 'world'\?\)"),
        ("world.model.opt.gravity", object(), UsageError, "give finite numbers"),
        ("world.model.opt.gravity", float("nan"), UsageError, "give finite numbers"),
        ("nodes.wrld.environment.X", "1", ProjectError, r"did you mean 'world'\?"),
        ("world.height", 1, ProjectError, "world.height"),
    ],
)
def test_a_wrong_setting_ends_no_episode(
    tmp_path: Path, path: str, value: object, kind: type[Exception], said: str
) -> None:
    with neuros.Project.from_file(falling(tmp_path)).session() as s:
        s.step(3)
        with pytest.raises(kind, match=said):
            s.reset(set={path: value})
        assert s.step()
        assert s["world.height"].count == 4
