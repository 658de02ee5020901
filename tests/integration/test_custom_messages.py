"""Messages of a project's own: built, found by every node, recorded, and understood outside."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from launching import BACKENDS, EXAMPLES, REPOSITORY, launch, start
from message_packages import CustomMessages, write_package
from needs import COMPILER, cannot_run, require
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import neuros.bag
from containers import connected, require_containers
from neuros.backends.docker.images import images_for
from neuros.backends.domain import choose_domain
from neuros.backends.pythons import HERE
from neuros.errors import EnvironmentFault
from neuros.messages.package import Ros

PROJECT = Path(__file__).parent / "custom_messages"
PACKAGES = ("demo_msgs", "demo_more_msgs")
CONFLICT = EXAMPLES / "5_containers/conflict"
NEWER = "statemachine_2"
HEARD = [f"{[0.5 * number, 1.5]} 3.0 ['neck', 'jaw']" for number in range(3)]

ROUND_TRIP = """
import rclpy
from demo_msgs.msg import Joints, Limits
from demo_msgs.srv import Move
from demo_more_msgs.msg import Told
from rclpy.serialization import deserialize_message, serialize_message

joints = Joints(angles=[1.0, -2.5], names=["a", "b"], flags=[True, False], raw=b"xyz", one=b"\\x07")
joints.header.stamp.sec = 5
joints.header.frame_id = "w\\u00e4nd"
joints.limits[0].lower = -1.0
joints.fixed[2] = 2.5
assert (Joints.MANY, joints.label, joints.limits[1].upper) == (5, "none", 1.0)
assert (joints.unit, Joints.PLACE) == ("\\u00b0", "Gr\\u00f6\\u00dfe \\u2014 \\u89d2\\u5ea6")
told = Told(joints=joints, hash="x")
for message in (joints, told, Move.Request(to=joints), Move.Response(done=True)):
    again = deserialize_message(serialize_message(message), type(message))
    assert again == message, (again, message)
    assert again is not message

rclpy.init()
node = rclpy.create_node("node")
node.create_service(Move, "move", print)
publishers = [node.create_publisher(kind, kind.__name__, 1) for kind in (Joints, Limits, Told)]
for publisher in publishers:
    (info,) = node.get_publishers_info_by_topic(publisher.topic)
    print(info.topic_type, info.topic_type_hash)
"""

HARNESS = """
import sys
from neuros.testing import PluginHarness

harness = PluginHarness.from_project(sys.argv[1], "brain")
joints = harness.make_packet("joints")
joints.names = ["neck"]
harness.send("joints", joints)
harness.run()
print(harness.log[0].text)
"""

# A plain ROS program, which knows nothing of NeuROS.
LISTENER = """
import time
import rclpy
from demo_more_msgs.msg import Told

rclpy.init()
node, heard = rclpy.create_node("listener"), []
node.create_subscription(Told, "/told", heard.append, 10)
deadline_s = time.monotonic() + 40
while time.monotonic() < deadline_s and not (heard and heard[-1].hash):
    rclpy.spin_once(node, timeout_sec=0.1)
(info,) = node.get_publishers_info_by_topic("/told")
print(list(heard[-1].joints.angles), heard[-1].hash, info.topic_type_hash)
"""


@pytest.fixture
def domain() -> Iterator[str]:
    """A ROS domain where nobody else is."""
    with choose_domain(None, {}, False) as chosen:
        yield str(chosen.id)


@pytest.fixture(scope="module")
def custom_messages(tmp_path_factory: pytest.TempPathFactory) -> CustomMessages:
    """The project in ``custom_messages``, its packages built anew, by two programs at once."""
    require(*COMPILER)
    environment = {"XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache"))}
    programs = [
        subprocess.Popen(
            [sys.executable, "-m", "neuros.cli", "build", "-p", str(PROJECT), *PACKAGES],
            env={**os.environ, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for _ in range(2)
    ]
    first, second = (program.communicate(timeout=300)[0] for program in programs)
    assert [program.returncode for program in programs] == [0, 0], first + second
    folders = sorted(Path(environment["XDG_CACHE_HOME"], "neuros", "messages").iterdir())
    pythons = {folder.name.rpartition("-")[0]: folder / "python" for folder in folders}
    return CustomMessages(PROJECT, environment, (first, second), pythons)


def python(messages: CustomMessages, code: str, **environment: str) -> subprocess.Popen[str]:
    """Code in a Python that finds the packages, and does not know NeuROS."""
    path = os.pathsep.join(map(str, messages.pythons.values()))
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def described_hash(messages: CustomMessages, type_name: str) -> str:
    """The hash in the type description that was built."""
    share = messages.pythons[type_name.partition("/")[0]].parent / "share"
    content = json.loads((share / f"{type_name}.json").read_text())
    return str(content["type_hashes"][0]["hash_string"])


def build(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "neuros.cli", "build", *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


class TestBuilding:
    def test_two_programs_build_each_package_once(self, custom_messages: CustomMessages) -> None:
        rows = "".join(custom_messages.outputs).splitlines()

        for package in ("demo_msgs: 2 messages, 1 service", "demo_more_msgs: 1 message"):
            assert len([row for row in rows if f"building {package} " in row]) == 1

    def test_nothing_but_whole_packages_is_left(self, custom_messages: CustomMessages) -> None:
        assert sorted(custom_messages.pythons) == ["demo_more_msgs", "demo_msgs"]
        for package, folder in custom_messages.pythons.items():
            parts = sorted(path.name for path in folder.parent.iterdir())
            assert parts == ["include", "lib", "python", "share"]
            assert {path.suffix for path in (folder / package).rglob("*.*")} == {".py", ".so"}

    def test_the_second_time_there_is_nothing_to_do(self, custom_messages: CustomMessages) -> None:
        done = build("-p", str(custom_messages.project), "demo_msgs", **custom_messages.environment)

        folder = custom_messages.pythons["demo_msgs"].parent
        assert (done.returncode, done.stdout) == (0, f"messages of demo_msgs are built: {folder}\n")

    def test_values_survive_and_all_of_ros_takes_the_types(
        self, custom_messages: CustomMessages
    ) -> None:
        with python(custom_messages, ROUND_TRIP) as program:
            output = program.communicate(timeout=60)[0]
        assert program.returncode == 0, output
        hashes = dict(row.split() for row in output.splitlines())
        assert hashes == {name: described_hash(custom_messages, name) for name in hashes}
        assert len(hashes) == 3

    def test_hashes_are_those_that_another_implementation_computes(
        self, custom_messages: CustomMessages
    ) -> None:
        store = get_typestore(Stores.ROS2_JAZZY)
        for name in ("demo_msgs/msg/Limits", "demo_msgs/msg/Joints", "demo_more_msgs/msg/Told"):
            package, _, message = name.split("/")
            file = custom_messages.project / "workspace" / package / "msg" / f"{message}.msg"
            store.register(get_types_from_msg(file.read_text(), name))

            assert store.hash_rihs01(name) == described_hash(custom_messages, name)

    def test_libraries_need_no_newer_system_than_those_of_ros(
        self, custom_messages: CustomMessages
    ) -> None:
        found = set()
        for file in custom_messages.pythons["demo_msgs"].parent.rglob("*.so"):
            listed = subprocess.run(
                ["objdump", "-T", str(file)], capture_output=True, text=True, check=True
            )
            found |= {word.strip("()") for word in listed.stdout.split() if "GLIBC" in word}
        versions = {tuple(map(int, v.partition("_")[2].split("."))) for v in found if "XX" not in v}
        plus = {tuple(map(int, v.partition("_")[2].split("."))) for v in found if "XX" in v}

        # manylinux_2_28, for which the wheels of ROS are made: glibc 2.28, and GCC 8.
        assert max(versions) <= (2, 28)
        assert max(plus) <= (3, 4, 24)


ACTION = """
import rclpy
from nod_msgs.action import Nod
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import SingleThreadedExecutor

def nod(goal):
    goal.publish_feedback(Nod.Feedback(so_far=1))
    goal.succeed()
    return Nod.Result(done=goal.request.times == 3)

rclpy.init()
node = rclpy.create_node("node")
server, client = ActionServer(node, Nod, "nod", nod), ActionClient(node, Nod, "nod")
heard = []
assert client.wait_for_server(20)
sent = client.send_goal_async(Nod.Goal(times=3), lambda message: heard.append(message.feedback))
rclpy.spin_until_future_complete(node, sent, timeout_sec=20)
result = sent.result().get_result_async()
rclpy.spin_until_future_complete(node, result, timeout_sec=20)
print(result.result().result.done, [each.so_far for each in heard])
"""


@pytest.mark.acceptance
@pytest.mark.needs(*COMPILER)
def test_actions_are_built_too(domain: str, tmp_path: Path) -> None:
    action = "int32 times\n---\nbool done\n---\nint32 so_far\n"
    write_package(
        tmp_path / "workspace", "nod_msgs", {"action/Nod.action": action}, ["action_msgs"]
    )
    done = build("-p", str(tmp_path), "nod_msgs", XDG_CACHE_HOME=str(tmp_path))
    assert done.returncode == 0, done.stderr
    path = str(Path(done.stdout.split()[-1]) / "python")

    program = subprocess.run(
        [sys.executable, "-c", ACTION],
        env={**os.environ, "PYTHONPATH": path, "ROS_DOMAIN_ID": domain},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )

    assert program.stdout == "True [1]\n", program.stderr


@pytest.mark.parametrize("package", ["std_msgs", "geometry_msgs", "std_srvs", "action_msgs"])
def test_packages_of_ros_get_the_hashes_that_they_are_shipped_with(
    package: str, tmp_path: Path
) -> None:
    ros = Ros.here()
    share = ros.share(package)
    kinds = ("msg", "srv")
    files = [
        f.relative_to(share).as_posix() for k in kinds for f in sorted(share.glob(f"{k}/*.{k}"))
    ]
    shares = {name: str(ros.share(name)) for name in ros.message_packages()}
    order = [package, str(share), files, str(tmp_path), str(ros.prefix), shares]
    code = (
        "import json, sys; from neuros.messages.generation import Order, describe;"
        f" describe(Order(*json.loads({json.dumps(order)!r})))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, cwd=REPOSITORY)

    made = {
        file.stem: json.loads(file.read_text())["type_hashes"]
        for file in tmp_path.glob(f"rosidl_generator_type_description/{package}/*/*.json")
    }
    shipped = {f.stem: json.loads(f.read_text())["type_hashes"] for f in share.glob("*/*.json")}
    assert {name: made[name] for name in shipped} == shipped
    assert len(shipped) == len(files) > 0


class TestRuns:
    @pytest.mark.parametrize("back_end", BACKENDS)
    def test_nodes_exchange_them_in_the_run_in_its_bag_and_in_its_replay(
        self, custom_messages: CustomMessages, back_end: str, domain: str, tmp_path: Path
    ) -> None:
        arguments = ("--backend", back_end, "-d", domain, "-t", "body.joints")
        run = launch(
            custom_messages.project,
            *arguments,
            cwd=tmp_path,
            timeout_s=60.0,
            **custom_messages.environment,
        )

        assert run.exit_code == 0, run.output
        assert "building" not in run.output
        assert [text.partition(" on ")[0] for text in run.said("brain")] == HEARD
        assert run.run_folder is not None
        with neuros.bag.open(run.run_folder) as bag:
            (topic,) = bag.topics.values()
            assert topic.type == "demo_msgs/msg/Joints"
            angles = [list(message.angles) for _, message in topic.messages()]
        assert angles == [[0.0, 1.5], [0.5, 1.5], [1.0, 1.5]]

        command = [sys.executable, "-m", "neuros.cli", "replay", str(run.run_folder), "-n", "brain"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "3 starts of hooks" in done.stdout

    def test_a_plugin_under_test_finds_them(
        self, custom_messages: CustomMessages, tmp_path: Path
    ) -> None:
        done = subprocess.run(
            [sys.executable, "-c", HARNESS, str(custom_messages.project)],
            env={**os.environ, **custom_messages.environment},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )

        assert done.stdout.startswith("[] 1.0 ['neck'] on Python"), done.stderr

    def test_a_plain_ros_program_understands_them(
        self, custom_messages: CustomMessages, domain: str, tmp_path: Path
    ) -> None:
        with (
            python(custom_messages, LISTENER, ROS_DOMAIN_ID=domain) as listener,
            start(
                custom_messages.project,
                *("-d", domain, "--set", "nodes.body.environment.WAIT_FOR_LISTENER_S=30"),
                cwd=tmp_path,
                **custom_messages.environment,
            ) as running,
        ):
            heard = listener.communicate(timeout=60)[0]
            assert running.finish(60.0).exit_code == 0
        angles, hash_told, hash_seen = heard.splitlines()[-1].rsplit(" ", 2)
        assert angles == "[1.0, 1.5]"
        assert hash_told == described_hash(custom_messages, "demo_msgs/msg/Joints")
        assert hash_seen == f"{described_hash(custom_messages, 'demo_more_msgs/msg/Told')}"


class TestMistakes:
    @pytest.fixture
    def project(self, tmp_path: Path) -> Path:
        write_package(tmp_path / "workspace", "bad_msgs", {"msg/A.msg": "flaot64 x\nint32 X\n"})
        node = {"name": "n", "container": "neuros_python", "plugin": "n.py"}
        port = {"name": "x", "type": "bad_msgs/msg/B"}
        content = {"nodes": [{**node, "outputs": [port]}], "connections": []}
        (tmp_path / "project.json").write_text(json.dumps(content))
        return tmp_path

    def test_all_are_said_with_their_lines_and_nothing_is_started(self, project: Path) -> None:
        run = launch(project, cwd=project)

        assert run.exit_code == 3
        for part in ("A.msg:1:1: found the type 'flaot64'", "A.msg:2:7: found the name 'X'"):
            assert part in run.output
        assert "'bad_msgs' has no message 'B'" in run.output
        assert "there is no file 'n.py'" in run.output
        assert "Traceback" not in run.output

    def test_build_says_them_too(self, project: Path) -> None:
        done = build("-p", str(project), "bad_msgs")

        assert done.returncode == 3
        assert done.stderr.count("A.msg:") == 2

    def test_a_package_that_does_not_exist_is_wrong_usage(self, project: Path) -> None:
        done = build("-p", str(project), "bed_msgs")

        assert done.returncode == 2
        assert (
            "no workspace has a message package 'bed_msgs' (did you mean 'bad_msgs'?)"
            in done.stderr
        )

    def test_without_a_compiler_it_says_what_to_install(
        self, custom_messages: CustomMessages, tmp_path: Path
    ) -> None:
        empty = {"PATH": "/nonexistent", "XDG_CACHE_HOME": str(tmp_path)}
        done = build("-p", str(custom_messages.project), "demo_msgs", **empty)

        assert done.returncode == 4
        (row,) = done.stderr.splitlines()
        assert "message packages need a C and C++ compiler, and there is no gcc" in row

    def test_an_installation_goes_on_without_one(self, tmp_path: Path) -> None:
        empty = {"PATH": "/nonexistent", "XDG_CACHE_HOME": str(tmp_path)}
        done = build("--if-compiler", **empty)

        assert done.returncode == 0
        assert done.stdout.startswith("message packages are not built: message packages need a C")

    @pytest.mark.needs("Python.h")
    def test_a_compiler_that_fails_leaves_a_log_and_nothing_else(self, tmp_path: Path) -> None:
        write_package(tmp_path / "workspace", "small_msgs", {"msg/A.msg": "int32 a\n"})
        for name in ("gcc", "g++"):
            text = "#!/bin/sh\necho 'x.c:1:2: error: no more of this' >&2; exit 1\n"
            (tmp_path / name).write_text(text)
            (tmp_path / name).chmod(0o755)
        cache = tmp_path / "cache"
        broken = {"PATH": f"{tmp_path}:/bin:/usr/bin", "XDG_CACHE_HOME": str(cache)}
        done = build("-p", str(tmp_path), "small_msgs", **broken)

        assert done.returncode == 4
        assert "'small_msgs' cannot be built: x.c:1:2: error: no more of this (log: " in done.stderr
        (left,) = (cache / "neuros" / "messages").iterdir()
        assert left.suffix == ".log"


def copied(messages: CustomMessages, folder: Path, container: str) -> Path:
    """The project, with a container of its own for the brain."""
    project = folder / "project"
    shutil.copytree(messages.project, project)
    shutil.copytree(CONFLICT / "containers" / container, project / "containers" / container)
    content = json.loads((project / "project.json").read_text())
    content["nodes"][1]["container"] = container
    (project / "project.json").write_text(json.dumps(content))
    return project


def test_nodes_in_containers_find_them(
    custom_messages: CustomMessages, domain: str, tmp_path: Path
) -> None:
    require_containers("neuros_python")

    run = launch(
        custom_messages.project,
        *("--backend", "docker", "-d", domain, "-r"),
        cwd=tmp_path,
        timeout_s=60.0,
        **custom_messages.environment,
    )

    assert run.exit_code == 0, run.output
    assert len(run.said("brain")) == 3
    assert run.said("brain")[2].startswith("[1.0, 1.5] 3.0 ['neck', 'jaw'] on Python 3.")
    assert run.record["recording"]["problems"] == []


@pytest.mark.acceptance
@pytest.mark.parametrize("back_end", ["docker", "process"])
def test_a_node_with_another_python_finds_the_same_build(
    custom_messages: CustomMessages, back_end: str, domain: str, tmp_path: Path
) -> None:
    """In a container with Debian 13; as a process in an environment that takes a minute to make."""
    if back_end == "docker":
        try:
            with connected() as engine:
                images_for(["neuros_python"], None, engine)
                images_for([NEWER], CONFLICT, engine)
        except EnvironmentFault as fault:
            cannot_run("containers", str(fault))
    project = copied(custom_messages, tmp_path, NEWER)

    run = launch(
        project,
        *("--backend", back_end, "-d", domain),
        cwd=tmp_path,
        timeout_s=400.0,
        **custom_messages.environment,
    )

    assert run.exit_code == 0, run.output
    assert "building" not in run.output
    said = run.said("brain")
    assert len(said) == 3
    version = tuple(map(int, said[0].rpartition(" ")[2].split(".")))
    assert version != HERE
