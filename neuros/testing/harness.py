"""``PluginHarness``: one plugin on the real engine, with the test in the place of everybody else."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import neuros
from neuros.errors import NeurosError, NodeError
from neuros.project.load import load_project
from neuros.project.model import Connection, Folders, Node, NodeFile, Port
from neuros.runtime.node import NodeRuntime
from neuros.runtime.scope import Stage
from neuros.testing.neighbours import Neighbours
from neuros.testing.stand_ins import Record, Topics, Workbench
from neuros.testing.step_loop import ManualClock, StepLoop
from neuros.testing.wiring import check_ends, ports, with_neighbours, with_observer

_WORKSPACE = Path(neuros.__file__).resolve().parents[1] / "workspace"
_MANY = 10_000


class PluginHarness:
    """Tests a plugin without ROS processes and without a launcher.

    The engine is the one that runs the plugin in a project, and so are the message classes; time
    and all events come from the test, so that a test gives the same result every time. Given a
    plugin ``doubler.py``::

        from neuros.hooks import neuros_function

        @neuros_function(inputs="number", outputs="double")
        def double(node, number):
            result = node.make_packet("double")
            result.data = 2 * number.data
            node.get_logger().info(f"2 x {number.data}")
            return result

    this tests it:

    >>> from std_msgs.msg import Int32
    >>> from neuros.testing import PluginHarness
    >>> harness = PluginHarness(
    ...     "doubler.py",
    ...     inputs={"number": "std_msgs/msg/Int32"},
    ...     outputs={"double": "std_msgs/msg/Int32"},
    ... )
    >>> harness.send("number", Int32(data=21))
    >>> harness.run()
    1
    >>> harness.received("double")
    [std_msgs.msg.Int32(data=42)]
    >>> harness.log
    [Record(severity='INFO', text='2 x 21')]

    A receiver that is busy holds up the node, as it would in a project:

    >>> harness.block("double")
    >>> harness.send("number", Int32(data=1), Int32(data=2), Int32(data=3))
    >>> harness.run()
    1
    >>> harness.explain()
    ['is blocked on `node.double -> receiver.double` (1 outstanding, last acknowledged 0.0 s ago)']
    >>> harness.unsent("number")
    1
    >>> harness.acknowledge("double")
    >>> harness.run()
    1

    Where nothing else is said, each input has one lossless connection, from a node ``sender``, and
    each output one to a node ``receiver``. A failing hook makes :meth:`run` raise ``HookError``.
    During :meth:`run` environment variables, current folder and import path are the node's.

    Args:
        plugin: the plugin file.
        inputs, outputs: message type by name of the port.
        connections: those that differ, ``wire("camera.image -> node.view", discard_limit=3)``.
        environment: environment variables of the node.
        name: the node's name.
        run_dir: its own writable folder; a temporary one if not given.

    Raises:
        PluginError, HookError: if the plugin cannot be imported, or declares its hooks wrongly.
        ValueError: if a connection does not fit the ports.
    """

    def __init__(
        self,
        plugin: str | os.PathLike[str],
        *,
        inputs: Mapping[str, str] | None = None,
        outputs: Mapping[str, str] | None = None,
        connections: Sequence[Connection] = (),
        environment: Mapping[str, str] | None = None,
        name: str = "node",
        run_dir: Path | None = None,
    ) -> None:
        path = Path(plugin).resolve()
        node = Node(
            name=name,
            container="neuros_python",
            plugin=path,
            inputs=ports(inputs or {}),
            outputs=ports(outputs or {}),
            environment=dict(environment or {}),
            file=path,
        )
        check_ends(node, connections)
        self._open(node, with_neighbours(node, connections), path.parent, _WORKSPACE, run_dir)

    @classmethod
    def from_project(
        cls,
        project: str | os.PathLike[str],
        node_name: str,
        *,
        environment: Mapping[str, str] | None = None,
        overrides: Sequence[str] = (),
        workspace: Path = _WORKSPACE,
        run_dir: Path | None = None,
    ) -> PluginHarness:
        """One node of a project, with the connections that it has there.

        Args:
            project: the project file, or a folder with a ``project.json``.
            environment: variables that differ from the project's.
            overrides: as ``--set`` takes them.
            workspace: the folder that ``@path`` starts from.

        Raises:
            ProjectError: with every problem of the project.
            KeyError: if it has no such node.
        """
        loaded = load_project(Path(project), workspace=workspace, overrides=overrides).project
        node = _with_environment(loaded.node(node_name), environment)
        own = [c for c in loaded.connections if node_name in (c.source_node, c.destination_node)]
        harness = cls.__new__(cls)
        harness._open(node, with_observer(node, own), loaded.folder, workspace, run_dir)
        return harness

    @classmethod
    def from_node_file(
        cls,
        node_file: str | os.PathLike[str],
        *,
        connections: Sequence[Connection] = (),
        environment: Mapping[str, str] | None = None,
        workspace: Path = _WORKSPACE,
        run_dir: Path | None = None,
    ) -> PluginHarness:
        """The node that a node file describes; each port has a connection, as in the constructor.

        Raises:
            ProjectError: with every problem of the file.
        """
        file = Path(node_file).resolve()
        with tempfile.TemporaryDirectory() as folder:
            project = Path(folder) / "project.json"
            project.write_text(f'{{"nodes": ["{file.name}"], "connections": []}}')
            loaded = load_project(project, workspace=workspace, folder=file.parent).project
        node = _with_environment(loaded.nodes[0], environment)
        check_ends(node, connections)
        harness = cls.__new__(cls)
        harness._open(
            node, with_neighbours(node, connections), file.parent, workspace, run_dir
        )
        return harness

    def _open(
        self,
        node: Node,
        connections: tuple[Connection, ...],
        project: Path,
        workspace: Path,
        run_dir: Path | None,
    ) -> None:
        if run_dir is None:
            self._run_folder = Path(tempfile.mkdtemp(prefix="neuros-harness-"))
            weakref.finalize(self, shutil.rmtree, self._run_folder, ignore_errors=True)
        else:
            self._run_folder = run_dir.absolute().parent
        self.run_dir = run_dir.absolute() if run_dir else self._run_folder / node.name
        self.run_dir.mkdir(parents=True, exist_ok=True)
        self._node = node
        self._clock = ManualClock()
        self._loop = StepLoop(self._clock)
        self._topics = Topics()
        self.log: list[Record] = []
        self.shutdown_reason: str | None = None
        self._failure: NeurosError | None = None
        bench = Workbench(self._loop, self._topics, self.log)
        file = NodeFile(node, connections, Folders(project, workspace, self._run_folder))
        self._neighbours = Neighbours(file, bench.hub, self._topics)
        self._bench = bench
        self._stage = Stage()
        self._stage.hide_from_nodes(project)
        with self._on_stage():
            self._runtime = NodeRuntime(
                file,
                bench,
                self._stage,
                tell=self._listen,
                fail=self._fail,
                log_file=None,
                duration_sim_s=None,
                clock=self._clock,
            )
            self._runtime.load()
        self._loop.post(self._runtime.start)
