"""Projects for Python programs: load, check, run."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuros.api.live import LiveRun
from neuros.api.loading import load_with_messages
from neuros.api.plan import make_environments, make_plan
from neuros.api.request import Request, parse_duration
from neuros.api.run import Run
from neuros.api.validation import model_problems
from neuros.backends.registered import AUTO
from neuros.errors import Problem, ProjectError, UsageError
from neuros.messages.needed import Messages
from neuros.project.graph import graph_mermaid, graph_text
from neuros.project.load import Loaded
from neuros.project.model import Project as Described
from neuros.project.split import project_to_json
from neuros.recording.selection import Request as RecordingRequest

_ENVIRONMENT = "environment"


class Project:
    """A project, which can be run again and again::

        import neuros

        project = neuros.Project.from_file("examples/4_neurorobotics/whiskeye/strict.json")
        run = project.run(duration="5sim", set={"nodes.robot.environment.RATE": 0.5}, seed=7)
        print(run.real_time_factor, run.node_results["visualiser"])

    Attributes:
        file: the project file.
        settings: values in the place of those in the files, by path.
    """

    def __init__(self, file: Path, settings: Mapping[str, Any]) -> None:
        self.settings = dict(settings)
        self._path = file
        self._loaded = self._load()
        self._said = {*self._loaded.warnings}
        self.file = self._loaded.project.file

    @classmethod
    def from_file(
        cls, path: str | os.PathLike[str], *, set: Mapping[str, Any] | None = None
    ) -> Project:
        """Load and check a project. What may be a mistake in it is a Python warning.

        Args:
            path: the project file, or a folder that holds ``project.json``.
            set: values in the place of those in the files, as ``--set`` has them:
                ``{"nodes.robot.environment.RATE": 0.5}``; ``None`` removes the key.

        Raises:
            ProjectError: with every problem there is.
        """
        project = cls(Path(path).absolute(), set or {})
        for warning in project._loaded.warnings:
            warnings.warn(str(warning), stacklevel=2)
        return project

    @property
    def name(self) -> str:
        """Its name."""
        return self._loaded.project.name

    @property
    def description(self) -> str:
        """What its file says of it."""
        return self._loaded.project.description

    @property
    def nodes(self) -> tuple[str, ...]:
        """The names of its nodes."""
        return tuple(node.name for node in self._loaded.project.nodes)

    @property
    def connections(self) -> tuple[str, ...]:
        """Its connections: ``a.out -> b.in``."""
        return tuple(map(str, self._loaded.project.connections))

    def with_settings(self, settings: Mapping[str, Any]) -> Project:
        """The same project with further values in the place of those in the files.

        Raises:
            ProjectError: if it is not valid with them.
        """
        return Project(self._path, {**self.settings, **settings})

    def check_with(self, settings: Mapping[str, Any], seed: int | None = None) -> None:
        """Check it as it would be run with these values, and do no more.

        Raises:
            ProjectError: with every problem there is.
            UsageError: if there is a seed, and no node takes one.
        """
        self._load_for_run(settings, seed)

    def text(self) -> str:
        """The whole project as JSON, node files merged in."""
        return json.dumps(project_to_json(self._loaded.project), sort_keys=True)

    def validate(self) -> tuple[Problem, ...]:
        """Read the files again and check them; returns what may be a mistake all the same.

        Raises:
            ProjectError: with every problem there is.
        """
        self._loaded = self._load()
        if problems := model_problems(self._loaded.project):
            raise ProjectError(problems)
        return self._loaded.warnings

    def graph(self, form: str = "text") -> str:
        """Nodes and connections: ``text`` for people, ``mermaid`` for Markdown."""
        drawn = {"text": graph_text, "mermaid": graph_mermaid}
        if form not in drawn:
            raise ValueError(f"{form!r} is neither 'text' nor 'mermaid'")
        return drawn[form](self._loaded.project)

    def run(
        self,
        *,
        backend: str | None = None,
        duration: float | str | None = None,
        set: Mapping[str, Any] | None = None,
        seed: int | None = None,
        record: bool | Sequence[str] = False,
        output: str | os.PathLike[str] | None = None,
        nodes: Sequence[str] = (),
        domain_id: int | None = None,
        monitor_system_load: bool = False,
        digests: bool = False,
        show: bool = False,
        check: bool = False,
    ) -> Run:
        """Run it to its end; works in a notebook, in any thread, and several times at once.

        The files are read again. ``KeyboardInterrupt`` ends the run in order and then goes on.

        Args:
            backend: ``docker``, ``process``, ``in-process`` or ``auto``; ``None``: the environment
                variable ``NEUROS_BACKEND``, else ``auto``.
            duration: seconds from the first hook to a drained end; ``"30sim"``: simulated ones;
                ``None``: until a node ends it.
            set: values in the place of those in the files, besides :attr:`settings`.
            seed: for every variable with SEED in its name in the ``environment`` of a node.
            record: ``True``: every packet; or names of topics, outputs and connections.
            output: the run folder, new or empty (else ``runs/<project>/<utc time>``).
            nodes: start only these.
            domain_id: the ROS domain.
            monitor_system_load: write ``system_load.csv``.
            digests: keep digests of packets with ``in-process``, too, at any cost.
            show: print what ``neuros launch`` prints.
            check: raise ``RunError`` unless it ends normally.

        Raises:
            ProjectError: if it is not valid, or not with ``set``.
            UsageError: for arguments that make no sense.
            EnvironmentFault: if something is missing on this machine.
            RunError: if ``check`` is set and the run did not end normally.
        """
        live = self._prepared(
            set,
            seed,
            show=show,
            backend=backend,
            duration=duration,
            record=record,
            output=output,
            nodes=nodes,
            domain_id=domain_id,
            monitor_system_load=monitor_system_load,
            digests=digests,
        )
        try:
            live.begin()
            run = live.wait()
        except BaseException:  # Ctrl+C may come between the two
            live.end()
            raise
        return run.check() if check else run

    def start(
        self,
        *,
        backend: str | None = None,
        duration: float | str | None = None,
        set: Mapping[str, Any] | None = None,
        seed: int | None = None,
        record: bool | Sequence[str] = False,
        output: str | os.PathLike[str] | None = None,
        nodes: Sequence[str] = (),
        domain_id: int | None = None,
        monitor_system_load: bool = False,
        digests: bool = False,
        show: bool = False,
    ) -> LiveRun:
        """Start it and go on: the arguments and errors of :meth:`run`."""
        live = self._prepared(
            set,
            seed,
            show=show,
            backend=backend,
            duration=duration,
            record=record,
            output=output,
            nodes=nodes,
            domain_id=domain_id,
            monitor_system_load=monitor_system_load,
            digests=digests,
        )
        live.begin()
        return live

    def __repr__(self) -> str:
        counts = f"{len(self.nodes)} nodes, {len(self.connections)} connections"
        return f"<Project {self.name}: {counts}; {self.file}>"

    def _prepared(
        self, set: Mapping[str, Any] | None, seed: int | None, *, show: bool, **options: Any
    ) -> LiveRun:
        """A run that has yet to begin."""
        request = _request(**options)
        project, messages = self._load_for_run(set or {}, seed)
        plan = make_plan(project, messages, request)
        make_environments(plan.pythons, messages, sys.stderr)
        return LiveRun(plan, request, is_shown=show)

    def _load(self) -> Loaded:
        return load_with_messages(self._path, _override_texts(self.settings))[0]

    def _load_for_run(
        self, settings: Mapping[str, Any], seed: int | None
    ) -> tuple[Described, Messages]:
        texts = _override_texts({**self.settings, **settings})
        loaded, messages = load_with_messages(self._path, texts)
        if seed is not None:
            seeds = _seed_texts(loaded.project, seed)
            loaded, messages = load_with_messages(self._path, [*texts, *seeds])
        for warning in loaded.warnings:
            if warning not in self._said:
                self._said.add(warning)
                warnings.warn(str(warning), stacklevel=3)
        return loaded.project, messages


def _request(
    *,
    backend: str | None,
    duration: float | str | None,
    record: bool | Sequence[str],
    output: str | os.PathLike[str] | None,
    nodes: Sequence[str],
    domain_id: int | None,
    monitor_system_load: bool,
    digests: bool,
) -> Request:
    return Request(
        backend=backend or os.environ.get("NEUROS_BACKEND") or AUTO,
        nodes=tuple(nodes),
        duration=parse_duration(None if duration is None else str(duration)),
        domain_id=domain_id,
        output=None if output is None else os.fspath(output),
        has_digests=digests,
        monitors_load=monitor_system_load,
        recording=_recording(record),
    )


def _recording(record: bool | Sequence[str]) -> RecordingRequest | None:
    if isinstance(record, bool):
        return RecordingRequest(everything=True) if record else None
    names = (record,) if isinstance(record, str) else tuple(record)
    return RecordingRequest(everything=False, topics=names) if names else None


def _override_texts(settings: Mapping[str, Any]) -> tuple[str, ...]:
    """As the texts of ``--set``: ``{"nodes.a.environment.RATE": 0.5}``. ``None`` removes a key."""
    return tuple(f"{path}={value_text(path, value)}" for path, value in settings.items())


def value_text(path: str, value: Any) -> str:
    """A value as ``--set`` has it; in ``environment`` all is text.

    Raises:
        UsageError: if it is nothing that JSON knows.
    """
    if value is None:
        return ""
    if isinstance(value, str) and path.split(".")[2:3] == [_ENVIRONMENT]:
        return value
    try:
        return json.dumps(value.tolist() if hasattr(value, "tolist") else value)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{path}: {error}") from error


def _seed_texts(project: Described, seed: int) -> tuple[str, ...]:
    """Overrides that give this seed to every node that has one.

    A seed is a variable in the ``environment`` of a node whose name contains SEED.

    Raises:
        UsageError: if no node has one.
    """
    places = [
        f"nodes.{node.name}.{_ENVIRONMENT}.{name}"
        for node in project.nodes
        for name in node.environment
        if "SEED" in name.upper()
    ]
    if not places:
        raise UsageError(
            f"seed {seed}: no node of {project.name} has a variable with SEED in its name in its"
            " environment: add one there, or set what its plugin takes for a seed"
        )
    return tuple(f"{place}={int(seed)}" for place in places)
