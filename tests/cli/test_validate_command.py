"""``neuros validate``: what it finds besides the mistakes in project files."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path
from typing import Any

import pytest

import neuros
from neuros.api.project import StartOptions
from neuros.cli.main import main
from neuros.errors import ProjectError

MODEL = '<mujoco><option timestep="0.002"/><worldbody><body name="box"/></worldbody></mujoco>'
IMU = {
    "name": "imu",
    "type": "sensor_msgs/msg/Imu",
    "mujoco": {"sensor": "imu", "element": "box", "rate": 48},
}
TOO_FAST = "48 Hz is a period of 10.4167 timesteps of 0.002 s, which is not a whole number"
HEAD = "import os\nfrom neuros.hooks import *\nfrom neuros.simulators.mujoco import MuJoCo\n"
HOOK = "@neuros_initialise()\ndef begin(node):\n    "


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def write(plugin: str, **keys: Any) -> None:
    Path("robot.py").write_text(plugin)
    node = {"name": "robot", "container": "neuros_mujoco", "plugin": "robot.py", **keys}
    Path("project.json").write_text(json.dumps({"nodes": [node], "connections": []}))


@pytest.mark.parametrize(
    ("plugin", "environment"),
    [
        (f"{HOOK}MuJoCo(node, 'box.xml')", {}),
        (f"{HOOK}MuJoCo(node, model=str(node.resolve_path('box.xml')))", {}),
        (f"{HOOK}MuJoCo(node, os.environ['MODEL'])", {"MODEL": "#box.xml"}),
        (f"PATH = os.environ.get('MODEL', 'x')\n{HOOK}MuJoCo(node, PATH)", {"MODEL": "box.xml"}),
        (f"XML = '{MODEL}'\n{HOOK}MuJoCo(node, XML)", {}),
        (f"from world import make\n{HOOK}make(node)", {}),
    ],
    ids=["file", "resolved", "path in a variable", "name in a variable", "text", "module"],
)
def test_a_rate_that_does_not_fit_the_model_is_named(
    plugin: str, environment: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("box.xml").write_text(MODEL)
    if "world" in plugin:
        Path("world.py").write_text(f"{HEAD}def make(node): return MuJoCo(node, 'box.xml')")
    write(HEAD + plugin, outputs=[IMU], environment=environment)
    assert main(["validate", "."]) == 3
    said = capsys.readouterr().err
    assert said.startswith(f"project.json:1:{said.split(':')[2]}: /nodes/0/outputs/0/mujoco/rate: ")
    assert TOO_FAST in said


@pytest.mark.parametrize(
    "plugin",
    [
        f"{HOOK}MuJoCo(node, make())\ndef make(): ...",
        f"{HOOK}MuJoCo(node, 'box.xml').model.opt.timestep = 0.001",
        f"{HOOK}(MuJoCo(node, 'box.xml'), MuJoCo(node, 'other.xml'))",
        f"{HOOK}MuJoCo(node, 'robot.urdf')",
        f"{HOOK}MuJoCo(node)",
    ],
    ids=["computed", "another timestep", "two models", "no MJCF", "no model"],
)
def test_what_is_not_known_of_the_model_is_no_problem(plugin: str) -> None:
    Path("box.xml").write_text(MODEL)
    write(HEAD + plugin, outputs=[IMU])
    assert main(["validate", "."]) == 0


@pytest.mark.parametrize(
    ("simulator", "keys"), [("MuJoCo", {"outputs": [IMU]}), ("MuJoCoWorlds", {"copies": 3})]
)
def test_a_model_that_is_none_is_named(
    simulator: str, keys: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("box.xml").write_text("<mujoco><bodi/></mujoco>")
    head = HEAD.replace("import MuJoCo\n", f"import {simulator}\n")
    write(f"{head}{HOOK}{simulator}(node, 'box.xml')", **keys)
    assert main(["validate", "."]) == 3
    assert capsys.readouterr().err.startswith("box.xml:1:1: the model does not compile: ")


def declared(name: str, type_name: str, **mujoco: Any) -> dict[str, Any]:
    return {"name": name, "type": type_name, "mujoco": mujoco}


def test_every_name_that_the_model_lacks_is_named_at_once_with_its_place(
    capsys: pytest.CaptureFixture[str],
) -> None:
    model = """<mujoco><worldbody><body name="box"><joint name="hinge"/><geom size="1"/>
    <camera name="eye"/><site name="tip"/></body></worldbody>
    <actuator><motor name="push" joint="hinge"/></actuator></mujoco>"""
    Path("box.xml").write_text(model)
    number = "std_msgs/msg/Float64"
    write(
        f"{HEAD}{HOOK}MuJoCo(node, 'box.xml')",
        outputs=[
            declared("a", "sensor_msgs/msg/Image", sensor="camera", element="eyes", rate=10),
            declared("b", "sensor_msgs/msg/Imu", sensor="imu", element="top", rate=10),
            declared("c", "sensor_msgs/msg/Imu", sensor="imu", element="tip", rate=10),
        ],
        inputs=[
            declared("d", number, actuator="pusch"),
            declared("e", number, joint="hing", drive="motor"),
            declared("f", number, actuator="push"),
        ],
    )
    assert main(["validate", "."]) == 3
    said = [row for row in capsys.readouterr().err.splitlines() if not row.startswith("warning")]
    assert all(re.match(r"project\.json:\d+:\d+: /nodes/0/", row) for row in said[:-1])
    assert sorted(row.partition(": /nodes/0/")[2] for row in said[:-1]) == [
        "inputs/0/mujoco/actuator: the model has no actuator 'pusch' (did you mean 'push'?)",
        "inputs/1/mujoco/joint: the model has no joint 'hing' (did you mean 'hinge'?)",
        "outputs/0/mujoco/element: the model has no camera 'eyes' (did you mean 'eye'?)",
        "outputs/1/mujoco/element: the model has no site or body 'top' (did you mean 'tip'?)",
    ]


def test_what_an_entity_may_still_bring_is_not_missed() -> None:
    Path("box.xml").write_text(MODEL)
    imu = declared("a", "sensor_msgs/msg/Imu", sensor="imu", element="drone/imu", rate=10)
    write(f"{HEAD}{HOOK}MuJoCo(node, 'box.xml')", outputs=[imu])
    assert main(["validate", "."]) == 0


def test_a_model_that_is_not_there_is_named_where_the_plugin_names_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("box.xml").write_text(MODEL)
    write(f"{HEAD}{HOOK}MuJoCo(node, 'bocks.xml')")
    assert main(["validate", "."]) == 3
    said = capsys.readouterr().err
    assert said.startswith("robot.py:6:18: there is no model 'bocks.xml' (did you mean 'box.xml'?)")


def test_importing_finds_what_reading_cannot(capfd: pytest.CaptureFixture[str]) -> None:
    write(
        "import os\nfrom neuros.hooks import *\nprint('imported in', os.environ['PLACE'])\n"
        "NAME = 'wheel' + 's'\n@neuros_tick(1, outputs=NAME)\ndef f(node): pass\n",
        environment={"PLACE": "Sheffield"},
    )
    assert main(["validate", "."]) == 0
    assert "imported" not in "".join(capfd.readouterr())
    assert main(["validate", ".", "--import", "--set", "nodes.robot.environment.PLACE=York"]) == 3
    said = capfd.readouterr().err.splitlines()
    assert said[0] == "imported in York"
    assert said[1].startswith("node 'robot': ")
    assert said[1].endswith("hook 'f': node 'robot' declares no output 'wheels' (it has none)")
    assert said[2] == "1 problem; nothing was started"


def test_a_plugin_that_ends_python_is_named(capfd: pytest.CaptureFixture[str]) -> None:
    write("import os\nfrom neuros.hooks import *\nos.abort()\n@neuros_tick(1)\ndef f(node): ...")
    assert main(["validate", ".", "--import"]) == 3
    how = "importing the plugin ended its process: killed by SIGABRT"
    assert f"node 'robot': {how}" in capfd.readouterr().err


def test_python_programs_get_the_same_as_warnings_and_errors() -> None:
    Path("box.xml").write_text(MODEL)
    write(
        f"{HEAD}{HOOK}MuJoCo(node, 'box.xml'), os.environ['SPEED']",
        outputs=[IMU],
        container="neuros_mujocco",
    )
    meant = (
        r"/nodes/0/container: there is no container 'neuros_mujocco' .did you mean 'neuros_mujoco'"
    )
    with pytest.warns(UserWarning, match=meant):
        project = neuros.Project.from_file(".")
    setting = "nodes.robot.environment.SPEDE"
    with pytest.warns(UserWarning, match="reads SPEDE .did you mean 'SPEED'"):
        project.described(StartOptions(set={setting: 1}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        project.described(StartOptions(set={"nodes.robot.environment.SPEED": 1}))
    with pytest.raises(ProjectError, match=TOO_FAST):
        project.validate()


def test_a_sweep_over_what_nothing_reads_says_so_once(capsys: pytest.CaptureFixture[str]) -> None:
    write(
        "import os\nfrom neuros.hooks import *\nSPEED = os.environ.get('SPEED')\n"
        "@neuros_initialise()\ndef f(node): node.shutdown(SPEED)\n",
        container="neuros_python",
    )
    arguments = ["--set", "nodes.robot.environment.SPEDE=1", "--backend", "in-process"]
    assert main(["sweep", ".", *arguments]) == 0
    assert capsys.readouterr().err == (
        "warning: --set nodes.robot.environment.SPEDE=1: character 25: /nodes/0/environment:"
        " nothing in the plugin of node 'robot' reads SPEDE (did you mean 'SPEED'?)\n"
    )


@pytest.mark.parametrize(
    ("recipe", "is_said"),
    [
        ({"requirements.txt": "numpy\n"}, True),
        ({"Dockerfile": "RUN add ros-jazzy-arm-msgs\n"}, False),
    ],
    ids=["not named", "named"],
)
def test_a_message_type_of_which_a_container_of_ones_own_says_nothing_is_a_warning(
    recipe: dict[str, str], is_said: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path("containers/arm")
    folder.mkdir(parents=True)
    for name, text in recipe.items():
        (folder / name).write_text(text)
    port = {"name": "joints", "type": "arm_msgs/msg/Joints", "external_topic": "joints"}
    write(f"{HEAD}@neuros_function('joints')\ndef f(node, x): ...", container="arm", inputs=[port])
    assert main(["validate", "."]) == 0
    said = "/nodes/0/inputs/0/type: unknown message type 'arm_msgs/msg/Joints': there is no message"
    assert (said in capsys.readouterr().err) is is_said


def test_a_message_package_that_is_not_there_is_described_with_its_manifest(
    capsys: pytest.CaptureFixture[str],
) -> None:
    port = {"name": "joints", "type": "arm_msgs/msg/Joints", "external_topic": "joints"}
    write(f"{HEAD}@neuros_function('joints')\ndef f(node, x): ...", inputs=[port])
    assert main(["validate", "."]) == 3
    hint = "workspace/arm_msgs/msg/Joints.msg beside the project file, with"
    assert f"{hint} workspace/arm_msgs/package.xml" in capsys.readouterr().err


IMPORTED = "@neuros_tick(1)\ndef f(node): ...\n"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("import numpyy", "robot.py:4:1: there is no module 'numpyy' (did you mean 'numpy'?)"),
        ("from qqqq.zzzz import x", "robot.py:4:1: there is no module 'qqqq.zzzz' (packages such"),
        ("import numpy.fftt", "robot.py:4:1: there is no module 'numpy.fftt'"),
        ("import numpy, besides", "module 'besides' (did you mean 'beside'?)"),
        ("class A:\n    import qqqq", "robot.py:5:5: there is no module 'qqqq'"),
        ("from .beside import x", "'.beside' is relative, but a plugin is in no package"),
        ("import beside_lacks", "beside_lacks.py:1:1: there is no module 'qqqq'"),
    ],
)
def test_a_missing_module_is_named_with_its_place(
    line: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("beside.py").write_text("raise SystemExit('it was run')\n")
    Path("beside_lacks.py").write_text("import qqqq\n")
    write(f"{HEAD}{line}\n{IMPORTED}")
    assert main(["validate", "."]) == 3
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "lines",
    [
        "import os.path, xml.dom.minidom, encodings.utf_8, std_msgs.msg, neuros.snn",
        "try:\n    import qqqq\nexcept ImportError:\n    import zzzz",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import qqqq",
        "def g():\n    import qqqq",
        "import contextlib\nwith contextlib.suppress(ImportError):\n    import qqqq",
        "import beside, folder.inner",
        "import sys\nsys.path.append('elsewhere')\nimport qqqq",
        "import makes.anything",
        "import on_path",
    ],
)
def test_what_is_there_or_may_be_missing_is_no_problem(lines: str) -> None:
    Path("beside.py").write_text("raise SystemExit('it was run')\n")
    for file in ("folder/inner.py", "elsewhere/qqqq.py", "path/on_path.py"):
        Path(file).parent.mkdir()
        Path(file).write_text("raise SystemExit('it was run')\n")
    Path("makes").mkdir()
    Path("makes/__init__.py").write_text("import sys\nsys.modules['makes.anything'] = sys\n")
    write(f"{HEAD}{lines}\n{IMPORTED}", environment={"PYTHONPATH": "#path"})
    assert main(["validate", "."]) == 0


def test_what_the_recipe_of_a_container_names_may_be_missing_here() -> None:
    Path("containers/arm").mkdir(parents=True)
    Path("containers/arm/Dockerfile").write_text("RUN pip install qqqq-lib\n")
    write(f"{HEAD}import qqqq_lib\n{IMPORTED}", container="arm")
    assert main(["validate", "."]) == 0


def test_before_a_run_a_missing_module_is_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    write(f"{HEAD}import qqqq\n{IMPORTED}")
    assert main(["launch", ".", "--dry-run", "--backend", "process"]) == 0
    assert "warning: robot.py:4:1: there is no module 'qqqq'" in capsys.readouterr().err


def test_a_loop_that_nobody_starts_is_refused_and_another_one_is_told(
    capsys: pytest.CaptureFixture[str],
) -> None:
    port = [{"name": "ball", "type": "std_msgs/msg/Int32"}]
    hit = f"{HEAD}@neuros_function('ball', 'ball')\ndef hit(node, ball): return ball\n"
    write(hit, inputs=port, outputs=port)
    project = json.loads(Path("project.json").read_text())
    ends = ("source_node", "source_output", "destination_node", "destination_input")
    project["connections"] = [dict(zip(ends, ("robot", "ball") * 2, strict=True))]
    Path("project.json").write_text(json.dumps(project))
    assert main(["validate", "."]) == 3
    assert "robot.py:4:18: nobody starts the loop of robot" in capsys.readouterr().err
    serve = "@neuros_initialise(outputs='ball')\ndef serve(node): return node.make_packet('ball')\n"
    Path("robot.py").write_text(hit + serve)
    assert main(["validate", "."]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[1] == "loop of robot: started by initialise hook 'serve' of robot"
    assert main(["validate", ".", "--format", "json"]) == 0
    (loop,) = json.loads(capsys.readouterr().out)["loops"]
    starters = ["initialise hook 'serve' of robot"]
    assert loop == {"nodes": ["robot"], "started_by": starters, "may_stop_at": []}
