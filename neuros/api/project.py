"""Projects for Python programs: load, check, run."""

from __future__ import annotations

import itertools
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.api.kept import given_sources
from neuros.api.live import LiveRun
from neuros.api.loading import (
    foreseen_failures,
    load_with_messages,
    model_problems,
    override_texts,
    seed_variables,
    with_model_fields,
)
from neuros.api.plan import make_environments, make_plan
from neuros.api.plugin_text import PluginText, write_project
from neuros.api.request import Request
from neuros.api.run import Run
from neuros.errors import Problem, ProjectError, UsageError
from neuros.messages.needed import Messages
from neuros.options import option, takes
from neuros.ports import Changes
from neuros.project.graph import graph_mermaid, graph_text
from neuros.project.in_python import PythonConnection, PythonNode, PythonProject
from neuros.project.load import LoadedProject
from neuros.project.model import Project as Described
from neuros.project.split import project_to_json
from neuros.registry import AUTO, own_packages

if TYPE_CHECKING:
    from neuros.api.session import Prepare, Session

LOCAL, IN_PROCESS = "local", "in-process"


@dataclass(frozen=True, kw_only=True)
class StartOptions(Request):
    """The arguments of :meth:`Project.start`."""

    seed: int | None = option(
        help="for every variable with SEED in its name in the environment of a node"
    )
    show: bool = option(default=False, is_recorded=False, help="print what `neuros launch` prints")


@dataclass(frozen=True, kw_only=True)
class RunOptions(StartOptions):
    """The arguments of :meth:`Project.run`."""

    check: bool = option(
        default=False, is_recorded=False, help="raise RunError unless the run ends normally"
    )


@dataclass(frozen=True, kw_only=True)
class SessionOptions(StartOptions):
    """The arguments of :meth:`Project.session`: those of a start that make sense for it."""

    nodes: Sequence[str] = field(init=False, default=())
    network: bool = field(init=False, default=False)
    peers: str | None = field(init=False, default=None)
    peer_timeout: int | None = field(init=False, default=None)
    duration: float | str | None = field(init=False, default=None)
    placement: bool = field(init=False, default=True)
    progress: bool | None = field(init=False, default=None)
    backend: str | None = option(
        default=LOCAL,
        variable="NEUROS_BACKEND",
        page="python.md#sessions",
        help="run nodes in the thread of this program (local), or on a back end as `project.start`"
        " does; if something is recorded or monitored, and for a deployment or an isolated run,"
        " the default is auto",
    )
    expose: bool = option(
        default=False,
        page="python.md#sessions",
        help="let ROS tools see the topics of nodes that are in the thread of this program",
    )
    forkable: bool = option(
        default=False,
        page="python.md#forks",
        help="keep the packets that the session sends, so that a fork of it can send them again",
    )
    take_over: Sequence[str] = option(
        is_repeatable=True,
        help="inputs that the session feeds in the place of their connections: robot.wheels",
    )

    def __post_init__(self) -> None:
        asked = self.backend
        super().__post_init__()
        needs = ("record", "topics", "monitor_system_load", "deployment", "isolate")
        given = [name for name in needs if getattr(self, name)]
        if self.backend == LOCAL and given:
            if asked == LOCAL:
                raise UsageError(
                    f"backend='local' with {', '.join(given)}: that needs a run in processes of its"
                    " own, such as backend='in-process'"
                )
            object.__setattr__(self, "backend", AUTO)


class Project:
    """A project, which can be run again and again::

        import neuros

        project = neuros.Project.from_file("examples/4_neurorobotics/whiskeye/strict.json")
        run = project.run(duration="5sim", set={"nodes.robot.environment.RATE": 0.5}, seed=7)
        print(run.real_time_factor, run.node_results["visualiser"])

    or be described in Python::

        project = neuros.Project(nodes=[cart, brain], connections=[cart["x"] >> brain["x"]])

    Attributes:
        file: the project file; it stands only for the folder of a project in Python.
        settings: by path, values that replace those in the files.

    Args:
        nodes: of the project, ``neuros.Node``.
        connections: between them: ``a["x"] >> b["y"]``, or ``neuros.Connection``.
        folder: from which paths in the project begin; ``None``: the current folder.
        keys: the other keys of a project file: ``description``, ``budgets``, ``namespace``, ....

    Raises:
        UsageError: if an argument is of another type, or there is no such folder.
        ProjectError: with all problems of the project.
    """

    def __init__(
        self,
        nodes: Iterable[PythonNode],
        connections: Iterable[PythonConnection] = (),
        *,
        folder: str | os.PathLike[str] | None = None,
        **keys: Any,
    ) -> None:
        self._open(PythonProject.of(nodes, connections, folder, keys), {})
        self._warned.clear()
        self._warn(self._loaded, is_held=True)

    @classmethod
    def from_file(
        cls, path: str | os.PathLike[str], *, set: Mapping[str, Any] | None = None
    ) -> Project:
        """Load and check a project; possible mistakes are Python warnings.

        A port without a connection is told of when a run starts, since a session may use it.

        Args:
            path: the project file, or a folder that holds ``project.json``.
            set: values that replace those in the files, as with ``--set``:
                ``{"nodes.robot.environment.RATE": 0.5}``; ``None`` removes the key.

        Raises:
            ProjectError: with all problems.
        """
        project = _project_of(Path(path).absolute(), set or {})
        project._warned.clear()
        project._warn(project._loaded, is_held=True)
        return project

    def _open(self, source: Path | PythonProject, settings: Mapping[str, Any]) -> None:
        self.settings = dict(settings)
        self._source = source
        self._loaded = self._load()
        self._warned = {*self._loaded.warnings}  # a copy, as in another process, says nothing
        self.file = self._loaded.project.file

    @property
    def name(self) -> str:
        """The name of the project."""
        return self._loaded.project.name

    @property
    def description(self) -> str:
        """The description in the project file."""
        return self._loaded.project.description

    @property
    def nodes(self) -> tuple[str, ...]:
        """The names of the nodes."""
        return tuple(node.name for node in self._loaded.project.nodes)

    @property
    def connections(self) -> tuple[str, ...]:
        """The connections: ``a.out -> b.in``."""
        return tuple(map(str, self._loaded.project.connections))

    def with_settings(self, settings: Mapping[str, Any]) -> Project:
        """The same project with further values that replace those in the files.

        Raises:
            ProjectError: if the project is not valid with these values.
        """
        project = _project_of(self._source, {**self.settings, **settings})
        project._warned -= project._loaded.unconnected
        return project

    def described(self, options: StartOptions | None = None, *, is_held: bool = False) -> Described:
        """The model of the project, checked as a run with these options does it.

        Args:
            is_held: whether it is for a session, which may use ports without a connection.

        Raises:
            ProjectError: with all problems.
            UsageError: if there is a seed, and no node has a variable for it.
        """
        return self._load_for_run(options or StartOptions(), is_held=is_held)[0]

    def text(self) -> str:
        """The whole project as JSON, node files merged in."""
        return json.dumps(project_to_json(self._loaded.project), sort_keys=True)

    def validate(self) -> tuple[Problem, ...]:
        """Read the files again and check them; returns possible mistakes.

        Raises:
            ProjectError: with all problems.
        """
        self._loaded, messages = load_with_messages(self._source, override_texts(self.settings))
        project = self._loaded.project
        if problems := [*model_problems(project), *foreseen_failures(project, messages)]:
            raise ProjectError(problems)
        return self._loaded.warnings

    def graph(self, form: str = "text") -> str:
        """Nodes and connections: ``text`` for people, ``mermaid`` for Markdown."""
        drawn = {"text": graph_text, "mermaid": graph_mermaid}
        if form not in drawn:
            raise ValueError(f"{form!r} is neither 'text' nor 'mermaid'")
        return drawn[form](self._loaded.project)

    def to_json(
        self, folder: str | os.PathLike[str] | None = None, *, overwrite: bool = False
    ) -> Path:
        """Write a project in Python as files that `neuros launch` runs; returns the project file.

        These are ``project.json``, a file for each node, and plugins of the functions; nodes with
        the same functions share one. Settings of the project are in them.

        Args:
            folder: where; ``None``: the folder of the project. It is made if it does not exist.
            overwrite: whether to replace files that are there already.

        Raises:
            UsageError: if a function cannot stand in a file, a file is there already, or paths in
                the project lead to files that the folder lacks.
        """
        if isinstance(self._source, Path):
            raise UsageError(f"to_json: {self.name} has its files already: {self.file}")
        target = self.file.parent if folder is None else Path(folder).absolute()
        texts = override_texts(self.settings)
        return write_project(self._source, self._loaded.project, texts, target, overwrite=overwrite)

    @takes(RunOptions)
    def run(self, options: RunOptions) -> Run:
        """Run the project to its end; works in notebooks, threads, and several times at once.

        The files are read again. ``KeyboardInterrupt`` ends the run in order and is raised then.

        Raises:
            ProjectError: if the project is not valid, or not with ``set``.
            UsageError: for wrong arguments.
            EnvironmentFault: if something is missing on this machine.
            RunError: if ``check`` is set and the run did not end normally.
        """
        live = self._prepared(options)
        try:
            live.begin()
            run = live.wait()
        except BaseException:  # Ctrl+C may come between the two
            live.end()
            raise
        return run.check() if options.check else run

    @takes(StartOptions)
    def start(self, options: StartOptions) -> LiveRun:
        """Start a run in the background; raises as :meth:`run`."""
        live = self._prepared(options)
        live.begin()
        return live

    @takes(SessionOptions)
    def session(self, options: SessionOptions) -> Session:
        """Start a run that this program steps, and whose packets it reads and sends.

        When this returns, initialise hooks have run, and no other hook. By default, the nodes are
        in the thread of this program: a hook that crashes the process, or never returns, is the
        program's (see ``timeout_s`` of :meth:`Session.step`).

        Raises:
            ProjectError, UsageError, EnvironmentFault: as :meth:`run` does.
            RunError: if the run has ended already.
        """
        from neuros.api.session import Session
        from neuros.api.session_link import with_session_inputs

        if options.expose and options.backend != LOCAL:
            raise UsageError(
                f"expose: ROS tools see the topics of the back end {options.backend} anyway"
            )
        prepare = self._preparer(options, partial(with_session_inputs, taken=options.take_over))
        return Session(prepare, options.seed, is_forkable=options.forkable)

    def held(self, options: StartOptions, fork: Mapping[str, Any]) -> Session:
        """Start a run that stands still, with all that a run without a session has.

        Args:
            fork: of which run it is a fork, for its record.

        Raises:
            ProjectError, UsageError, EnvironmentFault: as :meth:`run` does.
        """
        from neuros.api.session import Session

        return Session(self._preparer(options, lambda project: (project, ())), options.seed, fork)

    def forked(
        self, options: StartOptions, fork: Mapping[str, Any], changes: tuple[float, Changes]
    ) -> Run:
        """Run the project in virtual time to its end, with changes at a moment; as :meth:`run`."""
        live = self._live(*self._load_for_run(options), options, fork=fork, changes=changes)
        live.begin()
        return live.wait()

    def _preparer(
        self, options: StartOptions, bind: Callable[[Described], tuple[Described, Sequence[str]]]
    ) -> Prepare:
        """What starts the runs of a session, whose inputs ``bind`` names."""
        from neuros.api.local_run import LocalRun  # brings rclpy
        from neuros.api.session import Prepared
        from neuros.api.session_link import Held, HeldRun, LaunchedRun

        count = itertools.count(1)

        def prepare(seed: int | None, settings: Mapping[str, Any]) -> Prepared:
            wanted = options.set
            if isinstance(wanted, Mapping):
                wanted = with_model_fields(self._loaded.project, wanted)
            given = [*override_texts(wanted), *override_texts(settings)]
            chosen = replace(options, seed=seed, set=given)
            project, messages = self._load_for_run(chosen, is_held=True)
            held, inputs = bind(project)

            def start(restore: Mapping[str, Any], fork: Mapping[str, Any]) -> Held:
                number, output = next(count), None
                if options.output is not None:  # out, out-2, out-3
                    output = os.fspath(options.output) + (f"-{number}" if number > 1 else "")
                restored = {**given_sources(options.restore), **restore}
                own = replace(chosen, output=output, restore=restored)
                run: HeldRun
                if options.backend == LOCAL:
                    plan = make_plan(held, messages, replace(own, backend=IN_PROCESS))
                    make_environments(plan.pythons, messages, sys.stderr)
                    plan = replace(plan, request=own, fork=fork)
                    is_exposed = getattr(options, "expose", False)
                    run = LocalRun(plan, messages.paths, exposes=is_exposed)
                else:
                    live = self._live(held, messages, own, is_held=True, fork=fork)
                    live.begin()
                    run = LaunchedRun(live, project)
                return Held(run, project, frozenset(inputs), messages.paths)

            return Prepared(project, start, is_stepped=options.backend == LOCAL)

        return prepare

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the path: the files are read again."""
        return _project_of, (self._source, self.settings)

    def __repr__(self) -> str:
        counts = f"{len(self.nodes)} nodes, {len(self.connections)} connections"
        return f"<Project {self.name}: {counts}; {self.file}>"

    def _prepared(self, options: StartOptions) -> LiveRun:
        return self._live(*self._load_for_run(options), options)

    def _live(
        self,
        project: Described,
        messages: Messages,
        options: StartOptions,
        *,
        is_held: bool = False,
        fork: Mapping[str, Any] | None = None,
        changes: tuple[float, Changes] | None = None,
    ) -> LiveRun:
        for node in project.nodes:
            if not node.hooks:
                continue
            if options.deployment is not None:
                raise UsageError(
                    f"deployment: other machines do not have the functions of '{node.name}': write"
                    " the project with to_json(folder), and start that"
                )
            PluginText(node.name, node.hooks)  # fails before there is a run folder
        plan = replace(make_plan(project, messages, options), is_held=is_held)
        plan = replace(plan, fork=fork or {}, changes=changes)
        if options.isolate and not plan.back_end.has_own_network:
            raise UsageError(
                "isolate: a Python program cannot give a run a network of its own: use"
                " backend='docker', or `neuros launch --isolate`"
            )
        try:
            make_environments(plan.pythons, messages, sys.stderr)
        except BaseException:
            plan.deployment.finish(lambda: True)
            raise
        return LiveRun(plan, is_shown=options.show)

    def _load(self) -> LoadedProject:
        return load_with_messages(self._source, override_texts(self.settings))[0]

    def _load_for_run(
        self, options: StartOptions, *, is_held: bool = False
    ) -> tuple[Described, Messages]:
        texts = [*override_texts(self.settings), *override_texts(options.set)]
        others = (options.namespace, options.remap, options.time, options.timing)
        loaded, messages = load_with_messages(self._source, texts, *others)
        if options.seed is not None:
            texts += [
                f"nodes.{node}.environment.{name}={value}"
                for node, variables in seed_variables(loaded.project, options.seed).items()
                for name, value in variables.items()
            ]
            loaded, messages = load_with_messages(self._source, texts, *others)
        self._warn(loaded, is_held=is_held)
        return loaded.project, messages

    def _warn(self, loaded: LoadedProject, *, is_held: bool) -> None:
        """Tell of new possible mistakes, where code outside of NeuROS has called it.

        Args:
            is_held: leaves out ports without a connection, which a session may use.
        """
        known = self._warned | (loaded.unconnected if is_held else frozenset())
        frame, level, own = sys._getframe(), 1, own_packages()
        while frame.f_back and str(frame.f_globals.get("__name__")).partition(".")[0] in own:
            frame, level = frame.f_back, level + 1
        for warning in loaded.warnings:
            if warning not in known:
                self._warned.add(warning)
                warnings.warn(str(warning), stacklevel=level)


def _project_of(source: Path | PythonProject, settings: Mapping[str, Any]) -> Project:
    project = Project.__new__(Project)
    project._open(source, settings)
    return project
