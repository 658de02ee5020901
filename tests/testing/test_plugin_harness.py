"""``PluginHarness``: what users can find out about a plugin without launching anything."""

from __future__ import annotations

import doctest
import gc
import json
import os
import re
import sys
import textwrap
from pathlib import Path

import pytest
from std_msgs.msg import Float64, Int32, String

from neuros.errors import HookError, NodeError, PluginError, ProjectError
from neuros.testing import PluginHarness, wire

INT, TEXT = "std_msgs/msg/Int32", "std_msgs.msg.String"

COUNT = """
    import os
    from neuros.hooks import *

    START = int(os.environ.get("START", "0"))

    @neuros_initialise()
    def begin(node):
        node.set_user_data(START)

    @neuros_function(inputs="x", outputs="total")
    def add(node, x):
        node.set_user_data(node.get_user_data() + x.data)
        total = node.make_packet("total")
        total.data = node.get_user_data()
        return total

    @neuros_finalise()
    def end(node):
        node.get_logger().info(f"the sum is {node.get_user_data()}")
"""


@pytest.fixture
def plugin(tmp_path):
    def write(text: str, name: str = "plugin.py") -> Path:
        path = tmp_path / "project" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(textwrap.dedent(text))
        return path

    return write


def counter(plugin, **arguments):
    return PluginHarness(plugin(COUNT), inputs={"x": INT}, outputs={"total": INT}, **arguments)


def numbers(packets):
    return [packet.data for packet in packets]


def integers(*values):
    return [Int32(data=value) for value in values]


def test_the_example_in_its_docstring_works(tmp_path, monkeypatch):
    text = re.search(r"::\n\n(.*?)\n\n    this tests it", PluginHarness.__doc__, re.DOTALL)[1]
    (tmp_path / "doubler.py").write_text(textwrap.dedent(text))
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(PluginHarness, "PluginHarness")
    result = doctest.DocTestRunner(verbose=False).run(example)
    assert result.attempted > 8
    assert result.failed == 0


KEEPER = COUNT.replace(
    "START)\n", "START)\n        node.keep('sum', node.get_user_data, node.set_user_data)\n", 1
)


def test_a_plugin_gets_back_what_it_keeps_and_the_test_sees_it(plugin):
    arguments = {"inputs": {"x": INT}, "outputs": {"total": INT}}
    with PluginHarness(plugin(KEEPER), **arguments, restore={"sum": 40}) as harness:
        harness.send("x", *integers(1, 1))
        assert harness.kept == {}
        harness.run()
        assert numbers(harness.received("total")) == [41, 42]
        assert harness.kept == {"sum": 42}
    assert (harness.run_dir / "kept" / "sum.npz").exists()


def test_a_test_that_restores_what_nothing_keeps_fails(plugin):
    with pytest.raises(NodeError, match=r"nothing in node 'node' keeps 'sun' .did you mean 'sum'"):
        PluginHarness(
            plugin(KEEPER), inputs={"x": INT}, outputs={"total": INT}, restore={"sun": 1}
        ).run()
    with pytest.raises(NodeError, match="keep: 'sum' is a set, which cannot be kept"):
        counter(plugin, restore={"sum": {1}})


def test_the_example_of_wire_works():
    (example,) = doctest.DocTestFinder().find(wire, "wire", globs={"wire": wire})
    assert doctest.DocTestRunner(verbose=False).run(example).failed == 0


def test_packets_go_in_and_come_out_in_order(plugin):
    bench = counter(plugin, environment={"START": "100"})
    bench.send("x", *integers(1, 2, 3))
    assert bench.run() == 4
    assert numbers(bench.received("total")) == [101, 103, 106]
    assert bench.executions == {"begin": 1, "add": 3}
    assert bench.node.get_user_data() == 106
    assert bench.connections["sender.x -> node.x"]["consumed"] == 3


def test_finalise_hooks_run_once(plugin):
    with counter(plugin) as bench:
        bench.run()
        bench.finalise()
        bench.finalise()
    assert [record.text for record in bench.log] == ["the sum is 0"]


def test_packets_are_sent_as_they_are_at_that_moment(plugin):
    bench = counter(plugin)
    packet = Int32(data=1)
    for value in (1, 2, 3):
        packet.data = value
        bench.send("x", packet)
    bench.run()
    assert numbers(bench.received("total")) == [1, 3, 6]


def test_a_busy_receiver_holds_up_the_node_and_it_holds_up_its_sender(plugin):
    bench = counter(plugin)
    bench.block("total")
    bench.send("x", *integers(1, 2, 3, 4))
    bench.run()
    assert numbers(bench.received("total")) == [1]
    assert bench.unsent("x") == 2
    bench.acknowledge("total")
    bench.run()
    assert numbers(bench.received("total")) == [1, 3]
    bench.unblock("total")
    bench.run()
    assert numbers(bench.received("total")) == [1, 3, 6, 10]
    assert bench.unsent("x") == 0


def test_a_discard_limit_is_kept(plugin):
    bench = counter(plugin, connections=[wire("s.o -> node.x", discard_limit=2)])
    bench.block("total")
    bench.send("x", *integers(1, 10, 100, 1000, 10000, 100000))
    bench.run()  # one is executed, and of the next three two are discarded
    assert bench.unsent("x") == 2
    assert bench.connections["s.o -> node.x"]["discarded"] == 2
    bench.unblock("total")
    bench.run()
    assert bench.connections["s.o -> node.x"]["longest_discard"] == 2


def test_inputs_may_have_several_sources_and_outputs_several_receivers(plugin):
    path = plugin("""
        from neuros.hooks import *

        @neuros_function(inputs=All("votes"), outputs="result")
        def count(node, votes):
            result = node.make_packet("result")
            result.data = sum(vote.data for vote in votes)
            return result
    """)
    bench = PluginHarness(
        path,
        inputs={"votes": INT},
        outputs={"result": INT},
        connections=[
            wire("ann.vote -> node.votes", discard_limit=0),
            wire("bob.vote -> node.votes", discard_limit=0),
            wire("node.result -> press.result", discard_limit=0),
            wire("node.result -> archive.result"),
        ],
    )
    with pytest.raises(ValueError, match=r"say which source: ann\.vote, bob\.vote"):
        bench.send("votes", Int32())
    bench.send("votes", Int32(data=1), source="ann")
    assert bench.run() == 0
    assert bench.explain() == ["waits for `votes` from bob"]
    bench.send("votes", Int32(data=2), source="bob.vote")
    assert bench.run() == 1
    assert numbers(bench.received("result", "press")) == [3]
    assert numbers(bench.received("result", "archive.result")) == [3]
    with pytest.raises(ValueError, match="no such receiver: radio"):
        bench.received("result", "radio")


def test_a_connection_to_itself_works_and_is_seen(plugin):
    path = plugin("""
        from neuros.hooks import *

        @neuros_initialise(outputs="out")
        def begin(node):
            return node.make_packet("out")

        @neuros_function(inputs="back", outputs=Optional("out"))
        def again(node, packet):
            packet.data += 1
            return packet if packet.data < 5 else None
    """)
    (path.parent / "project.json").write_text(
        json.dumps(
            {
                "nodes": [
                    {
                        "name": "loop",
                        "container": "neuros_python",
                        "plugin": "plugin.py",
                        "inputs": [{"name": "back", "type": INT}],
                        "outputs": [{"name": "out", "type": INT}],
                    }
                ],
                "connections": [
                    {
                        "source_node": "loop",
                        "source_output": "out",
                        "destination_node": "loop",
                        "destination_input": "back",
                        "discard_limit": 0,
                    }
                ],
            }
        )
    )
    bench = PluginHarness.from_project(path.parent, "loop")
    assert bench.run() == 6
    assert numbers(bench.received("out")) == [0, 1, 2, 3, 4]


TICK = """
    from neuros.hooks import *

    @neuros_tick(seconds=0.1, outputs="out")
    def beat(node):
        return node.make_packet("out")
"""


def test_time_passes_only_when_it_is_told_to(plugin):
    bench = PluginHarness(plugin(TICK), outputs={"out": INT})
    assert bench.run() == 0
    assert bench.advance(1.0) == 10
    assert bench.advance(0.05) == 0
    assert bench.advance(0.05) == 1
    assert bench.time_s == pytest.approx(1.1)


def test_ticks_coalesce_while_the_receiver_is_busy(plugin):
    bench = PluginHarness(plugin(TICK), outputs={"out": INT})
    bench.block("out")
    assert bench.advance(1.0) == 1
    bench.unblock("out")
    assert bench.run() == 1
    assert bench.advance(0.1) == 1


def test_a_main_loop_runs_as_often_as_it_is_told_to(plugin):
    path = plugin("""
        from neuros.hooks import *

        @neuros_function(outputs="out")
        def step(node):
            return node.make_packet("out")
    """)
    bench = PluginHarness(path, outputs={"out": INT})
    assert bench.run(executions=3) == 3
    with pytest.raises(NodeError, match=r"no end.*'step'.*run\(executions=\.\.\.\)"):
        bench.run()
    bench.block("out")
    assert bench.run() <= 1


def test_a_failing_hook_is_reported_with_its_address(plugin):
    path = plugin("""
        from neuros.hooks import *

        @neuros_function(inputs="x")
        def divide(node, x):
            1 / x.data
    """)
    bench = PluginHarness(path, inputs={"x": INT})
    bench.send("x", Int32(data=0))
    for _ in range(2):
        with pytest.raises(HookError, match=r"plugin\.py:6.*hook 'divide'.*ZeroDivisionError"):
            bench.run()
    assert isinstance(bench._failure.__cause__, ZeroDivisionError)


def test_a_plugin_that_cannot_be_imported_is_reported(plugin):
    with pytest.raises(PluginError, match="no_such_module"):
        PluginHarness(plugin("import no_such_module"))


def test_mistakes_in_the_test_are_pointed_out(plugin):
    bench = counter(plugin)
    with pytest.raises(ValueError, match=r"no input 'y' \(it has x\)"):
        bench.send("y", Int32())
    with pytest.raises(TypeError, match=r"takes std_msgs/msg/Int32, not std_msgs.msg.String"):
        bench.send("x", String())
    with pytest.raises(ValueError, match=r"no output 'sum' \(it has total\)"):
        bench.received("sum")
    with pytest.raises(ValueError, match="no input 'z'"):
        counter(plugin, connections=[wire("a.b -> node.z")])
    with pytest.raises(ValueError, match="neither begins nor ends at node 'node'"):
        counter(plugin, connections=[wire("a.b -> c.d")])
    with pytest.raises(ValueError, match="is not a connection"):
        wire("a -> b")
    with pytest.raises(ValueError, match="is not a message type"):
        PluginHarness(plugin(COUNT), inputs={"x": "int"})


def test_shutdown_is_seen_and_stops_the_node(plugin):
    path = plugin("""
        from neuros.hooks import *

        @neuros_function(inputs="x", outputs="y")
        def once(node, x):
            node.shutdown("enough")
            return x
    """)
    bench = PluginHarness(path, inputs={"x": INT}, outputs={"y": INT})
    assert bench.shutdown_reason is None
    bench.send("x", *integers(1, 2))
    assert bench.run() == 1
    assert bench.shutdown_reason == "enough"
    assert numbers(bench.received("y")) == [1]


def test_the_ros_node_has_the_parameters_of_the_project(tmp_path):
    (tmp_path / "node.py").write_text(
        "from neuros.hooks import neuros_function\n"
        "@neuros_function(inputs='x')\n"
        "def hook(node, x):\n"
        "    ros = node.get_ros_node()\n"
        "    assert ros.get_parameter('gain.p').value == 1.5\n"
        "    assert ros.declare_parameter('gain.p', 0.0).value == 1.5\n"
        "    assert not ros.has_parameter('own')\n"
        "    assert ros.declare_parameter('own', 3).value == 3\n"
        "    node.get_logger().info(str(ros.get_parameter('unknown')))\n"
    )
    node = {"name": "a", "container": "neuros_python", "plugin": "node.py"}
    node |= {"inputs": [{"name": "x", "type": INT}], "parameters": {"gain": {"p": 1.5}}}
    (tmp_path / "node.json").write_text(json.dumps(node))
    bench = PluginHarness.from_node_file(tmp_path / "node.json")
    bench.send("x", Int32())
    with pytest.raises(HookError, match=r"ParameterNotDeclared.*unknown"):
        bench.run()


def test_the_ros_node_has_a_logger_and_no_ros(plugin, caplog):
    path = plugin("""
        from neuros.hooks import *

        @neuros_function(inputs="x")
        def hook(node, x):
            ros = node.get_ros_node()
            ros.get_logger().warning("mind the gap", once=True)
            ros.get_logger().get_child("inner").debug(ros.get_name())
            ros.create_timer(1.0, print)
    """)
    bench = PluginHarness(path, inputs={"x": INT}, name="robot")
    bench.send("x", Int32())
    with pytest.raises(NodeError, match=r"get_ros_node\(\)\.create_timer: there is no ROS"):
        bench.run()
    assert bench.log == [("WARN", "mind the gap"), ("DEBUG", "robot")]
    assert "mind the gap" in caplog.messages


SURROUNDINGS = """
    import os
    import helper
    from pathlib import Path
    from neuros.hooks import *

    os.environ["SET_BY_PLUGIN"] = "yes"

    @neuros_initialise(outputs="seen")
    def begin(node):
        helper.calls += 1
        (node.run_dir / "note").write_text("x")
        seen = node.make_packet("seen")
        seen.data = " ".join([
            os.environ["WHO"], os.environ["NEUROS_RUN_DIR"], os.getcwd(), str(helper.calls)
        ])
        return seen
"""


def test_the_surroundings_are_the_nodes_during_hooks_and_the_tests_otherwise(
    plugin, tmp_path, monkeypatch
):
    plugin("calls = 0", "helper.py")
    path = plugin(SURROUNDINGS)
    monkeypatch.setenv("WHO", "test")
    before = dict(os.environ), os.getcwd(), list(sys.path), set(sys.modules)
    benches = [
        PluginHarness(
            path, outputs={"seen": TEXT}, environment={"WHO": who}, run_folder=tmp_path / who
        )
        for who in ("ann", "bob")
    ]
    for who, bench in zip(("ann", "bob"), benches, strict=True):
        bench.run()
        run = tmp_path / who
        assert bench.run_dir == run / "node"
        assert (bench.run_dir / "note").exists()
        assert numbers(bench.received("seen")) == [f"{who} {run / 'node'} {run} 1"]
    assert (dict(os.environ), os.getcwd(), list(sys.path)) == before[:3]
    assert not {name for name in set(sys.modules) - before[3] if "helper" in name}
    assert os.environ["WHO"] == "test"


def test_the_temporary_run_folder_goes_with_the_harness(plugin):
    bench = counter(plugin)
    folder = bench.run_dir
    assert folder.is_dir()
    del bench
    gc.collect()
    assert not folder.exists()


PROJECT = {
    "nodes": [
        "node.json",
        {
            "name": "source",
            "container": "neuros_python",
            "plugin": "plugin.py",
            "outputs": [{"name": "x", "type": INT}],
        },
    ],
    "connections": [
        {
            "source_node": "source",
            "source_output": "x",
            "destination_node": "sum",
            "destination_input": "x",
            "discard_limit": 0,
            "queue_size": 2,
        }
    ],
}
NODE = {
    "name": "sum",
    "container": "neuros_python",
    "plugin": "plugin.py",
    "inputs": [{"name": "x", "type": INT}, {"name": "y", "type": INT, "external_topic": "/y"}],
    "outputs": [
        {"name": "total", "type": INT},
        {"name": "said", "type": TEXT, "external_topic": "/said"},
    ],
    "environment": {"START": 5},
}


@pytest.fixture
def project(plugin):
    folder = plugin(
        COUNT
        + """
    @neuros_function(inputs="y", outputs="said")
    def speak(node, y):
        said = node.make_packet("said")
        said.data = str(y.data)
        return said
"""
    ).parent
    (folder / "project.json").write_text(json.dumps(PROJECT))
    (folder / "node.json").write_text(json.dumps(NODE))
    return folder


def test_a_node_of_a_project_has_the_connections_of_the_project(project):
    bench = PluginHarness.from_project(project, "sum")
    bench.send("x", *integers(1, 2, 3))
    bench.run()
    assert numbers(bench.received("total")) == [6, 8, 11]
    assert set(bench.connections) == {
        "source.x -> sum.x",
        "/y -> sum.y",
        "sum.total -> observer.total",
    }


def test_external_topics_of_a_project_can_be_fed_and_heard(project):
    bench = PluginHarness.from_project(project / "project.json", "sum")
    bench.send("y", *integers(7, 8))
    bench.run()
    assert numbers(bench.received("said")) == ["7", "8"]


def test_environment_and_overrides_change_the_project(project):
    bench = PluginHarness.from_project(project, "sum", environment={"START": "1"})
    bench.send("x", Int32(data=1))
    bench.run()
    assert numbers(bench.received("total")) == [2]
    bench = PluginHarness.from_project(project, "sum", overrides=["nodes.sum.environment.START=2"])
    bench.send("x", Int32(data=1))
    bench.run()
    assert numbers(bench.received("total")) == [3]


def test_a_node_file_alone_is_enough(project):
    bench = PluginHarness.from_node_file(project / "node.json")
    bench.send("x", Int32(data=1))
    bench.run()
    assert numbers(bench.received("total")) == [6]


def test_an_unknown_node_or_a_broken_project_is_an_error(project):
    with pytest.raises(KeyError):
        PluginHarness.from_project(project, "nobody")
    (project / "project.json").write_text("{")
    with pytest.raises(ProjectError):
        PluginHarness.from_project(project, "sum")


def test_a_packet_of_every_port_can_be_made(project):
    bench = PluginHarness.from_project(project, "sum")
    assert isinstance(bench.make_packet("x"), Int32)
    assert isinstance(bench.make_packet("said"), String)


def test_simulated_results_come_through_as_ros_rounds_them(plugin):
    path = plugin("""
        from neuros.hooks import *

        @neuros_function(inputs="x", outputs="y")
        def hook(node, x):
            y = node.make_packet("y")
            y.data = x.data
            return y
    """)
    bench = PluginHarness(
        path, inputs={"x": "std_msgs/msg/Float64"}, outputs={"y": "std_msgs/msg/Float32"}
    )
    bench.send("x", Float64(data=0.1))
    bench.run()
    assert bench.received("y")[0].data == pytest.approx(0.1)
    assert bench.received("y")[0].data != 0.1


def test_a_plugin_can_look_around(plugin):
    harness = PluginHarness(
        plugin(COUNT),
        inputs={"x": INT},
        outputs={"total": INT, "done": "std_msgs/msg/Empty"},
        connections=[wire("camera.image -> node.x")],
    )
    topics = ["/neuros/camera/image/node/x/data"]
    topics += [f"/neuros/node/{name}/receiver/{name}/data" for name in ("done", "total")]
    assert harness.node.get_topic_list() == topics
    assert harness.node.get_topic_info(topics[0]) == (
        "Type: std_msgs/msg/Int32\nPublisher count: 1\nSubscription count: 1"
    )
    with pytest.raises(NodeError, match=r"get_topic_info: there is no topic '/x' now$"):
        harness.node.get_topic_info("x")


@pytest.mark.parametrize(
    ("outputs", "kind"),
    [
        ({"a": INT}, "Int32"),
        ({"a": INT, "b": INT}, "Int32"),
        ({"a": INT, "b": "std_msgs/msg/Empty"}, "Empty"),
        ({"a": INT, "b": TEXT}, None),
        ({}, None),
    ],
    ids=["one output", "one type", "Empty, as published", "two types", "no output"],
)
def test_a_packet_without_a_name_is_of_the_type_that_alone_can_be_meant(plugin, outputs, kind):
    path = plugin("from neuros.hooks import *\n@neuros_initialise()\ndef f(node): pass")
    node = PluginHarness(path, outputs=outputs).node
    if kind:
        assert type(node.make_packet()).__name__ == kind
    else:
        known = ", ".join(outputs) or "none"
        with pytest.raises(NodeError, match=f"say for which output of node 'node': {known}$"):
            node.make_packet()


def failing(plugin, body, **arguments):
    """What a hook with this body fails of."""
    head = "import rclpy, subprocess\nfrom neuros.hooks import *\n"
    text = f"{head}@neuros_initialise()\ndef f(node): {body}"
    with pytest.raises(HookError) as failed:
        PluginHarness(plugin(text), **arguments).run()
    return failed.value.text


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of rclpy
def test_a_hook_that_spins_is_told_what_to_do(plugin):
    told = failing(plugin, "rclpy.spin_once(node.get_ros_node())")
    assert re.search("NeuROS serves .* itself, .*call_async", told)
    gc.collect()  # the executor that rclpy could not make warns when it goes


def test_a_file_that_is_not_in_the_current_folder_is_looked_for_where_it_may_be(plugin, tmp_path):
    assert failing(plugin, "open('data/weights.csv')", run_folder=tmp_path) == (
        "FileNotFoundError: [Errno 2] No such file or directory: 'data/weights.csv' (relative to"
        f" the current folder, which is {tmp_path}; a file beside the plugin, or of the project, is"
        " node.resolve_path('data/weights.csv'))"
    )


@pytest.mark.parametrize("body", ["open('/no/such/file')", "subprocess.run(['nosuchprogram'])"])
def test_what_is_not_looked_for_in_the_current_folder_has_no_such_hint(plugin, body):
    assert "current folder" not in failing(plugin, body)


@pytest.mark.parametrize("is_in_hook", [True, False], ids=["in a hook", "at the top"])
def test_a_missing_module_names_where_packages_go(plugin, is_in_hook):
    hint = (
        "No module named 'brian9' (packages such as brian9 go into the requirements.txt of the"
        " node's container, modules of your own beside the plugin:"
        " docs/containers.md#environments-without-docker)"
    )
    if is_in_hook:
        assert failing(plugin, "import brian9.units").endswith(hint)
    else:
        with pytest.raises(PluginError, match=re.escape(hint)):
            PluginHarness(plugin("import brian9"))
