"""Projects for Python programs: load, check, run."""

from __future__ import annotations

import itertools
import json
import os
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from neuros.api.request import Request
from neuros.api.run import Run
from neuros.errors import Problem, ProjectError, UsageError
from neuros.messages.needed import Messages
from neuros.options import option, takes
from neuros.project.graph import graph_mermaid, graph_text
from neuros.project.load import LoadedProject
from neuros.project.model import Project as Described
from neuros.project.split import project_to_json
from neuros.registry import AUTO

if TYPE_CHECKING:
    from neuros.api.session import Session

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

    Attributes:
        file: the project file.
        settings: by path, values that replace those in the files.
    """

    def __init__(self, file: Path, settings: Mapping[str, Any]) -> None:
        self.settings = dict(settings)
        self._path = file
        self._loaded = self._load()
        self._warned = {*self._loaded.warnings}
        self.file = self._loaded.project.file

    @classmethod
    def from_file(
        cls, path: str | os.PathLike[str], *, set: Mapping[str, Any] | None = None
    ) -> Project:
        """Load and check a project; possible mistakes are Python warnings.

        Args:
            path: the project file, or a folder that holds ``project.json``.
            set: values that replace those in the files, as with ``--set``:
                ``{"nodes.robot.environment.RATE": 0.5}``; ``None`` removes the key.

        Raises:
            ProjectError: with all problems.
        """
        project = cls(Path(path).absolute(), set or {})
        for warning in project._loaded.warnings:
            warnings.warn(str(warning), stacklevel=2)
        return project

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
        return Project(self._path, {**self.settings, **settings})

    def check_with(self, settings: Mapping[str, Any], seed: int | None = None) -> Described:
        """Check the project as a run with these values does; returns its model.

        Raises:
            ProjectError: with all problems.
            UsageError: if there is a seed, and no node has a variable for it.
        """
        return self._load_for_run(StartOptions(set=settings, seed=seed))[0]

    def text(self) -> str:
        """The whole project as JSON, node files merged in."""
        return json.dumps(project_to_json(self._loaded.project), sort_keys=True)

    def validate(self) -> tuple[Problem, ...]:
        """Read the files again and check them; returns possible mistakes.

        Raises:
            ProjectError: with all problems.
        """
        self._loaded, messages = load_with_messages(self._path, override_texts(self.settings))
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
        from neuros.api.local_run import LocalRun  # brings rclpy
        from neuros.api.session import Session
        from neuros.api.session_link import Held, HeldRun, LaunchedRun, with_session_inputs

        if options.expose and options.backend != LOCAL:
            raise UsageError(
                f"expose: ROS tools see the topics of the back end {options.backend} anyway"
            )
        count = itertools.count(1)

        def prepare(
            seed: int | None, settings: Mapping[str, Any]
        ) -> Callable[[Mapping[str, Any]], Held]:
            wanted = options.set
            if isinstance(wanted, Mapping):
                wanted = with_model_fields(self._loaded.project, wanted)
            given = [*override_texts(wanted), *override_texts(settings)]
            chosen = replace(options, seed=seed, set=given)
            project, messages = self._load_for_run(chosen)
            held, inputs = with_session_inputs(project, options.take_over)

            def start(restore: Mapping[str, Any]) -> Held:
                number, output = next(count), None
                if options.output is not None:  # out, out-2, out-3
                    output = os.fspath(options.output) + (f"-{number}" if number > 1 else "")
                restored = {**given_sources(options.restore), **restore}
                own = replace(chosen, output=output, restore=restored)
                run: HeldRun
                if options.backend == LOCAL:
                    plan = make_plan(held, messages, replace(own, backend=IN_PROCESS))
                    make_environments(plan.pythons, messages, sys.stderr)
                    plan = replace(plan, request=own)
                    run = LocalRun(plan, messages.paths, exposes=options.expose)
                else:
                    live = self._live(held, messages, own, is_held=True)
                    live.begin()
                    run = LaunchedRun(live, len(project.nodes))
                return Held(run, project, frozenset(inputs), messages.paths)

            return start

        return Session(prepare, options.seed)

    def __reduce__(self) -> tuple[type[Project], tuple[Path, dict[str, Any]]]:
        """Pickle the path: the files are read again."""
        return Project, (self._path, self.settings)

    def __repr__(self) -> str:
        counts = f"{len(self.nodes)} nodes, {len(self.connections)} connections"
        return f"<Project {self.name}: {counts}; {self.file}>"

    def _prepared(self, options: StartOptions) -> LiveRun:
        """A run that has not begun."""
        return self._live(*self._load_for_run(options), options)

    def _live(
        self,
        project: Described,
        messages: Messages,
        options: StartOptions,
        *,
        is_held: bool = False,
    ) -> LiveRun:
        plan = replace(make_plan(project, messages, options), is_held=is_held)
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
        return load_with_messages(self._path, override_texts(self.settings))[0]

    def _load_for_run(self, options: StartOptions) -> tuple[Described, Messages]:
        texts = [*override_texts(self.settings), *override_texts(options.set)]
        names = (options.namespace, options.remap)
        loaded, messages = load_with_messages(self._path, texts, *names)
        if options.seed is not None:
            texts += [
                f"nodes.{node}.environment.{name}={value}"
                for node, variables in seed_variables(loaded.project, options.seed).items()
                for name, value in variables.items()
            ]
            loaded, messages = load_with_messages(self._path, texts, *names)
        for warning in loaded.warnings:
            if warning not in self._warned:
                self._warned.add(warning)
                warnings.warn(str(warning), stacklevel=3)
        return loaded.project, messages
