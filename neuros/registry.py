"""Registries: parts that NeuROS finds by name, its own and those of other distributions.

A distribution registers a part as an entry point in its ``pyproject.toml``::

    [project.entry-points."neuros.backends"]
    slurm = "neuros_slurm:BACK_END"

``entry_points.txt`` beside this module has NeuROS's own parts; the build reads it, too. The
metadata of the installation would be out of date in an updated checkout, and its search takes some
10 ms.

``extensions.txt`` has the parts of NeuROS's extensions, so that errors can name the one to install.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar, cast

from neuros.distribution import install_command
from neuros.errors import EnvironmentFault, NeurosError, UsageError
from neuros.ports import (
    BackEnd,
    Deployment,
    DeploymentKind,
    LaunchExtension,
    MachineCheck,
    ModelFormat,
    Notice,
    PluginCheck,
    Subcommand,
    SweepExecutor,
    TransportKind,
)
from neuros.project.model import Node, Project
from neuros.project.suggest import did_you_mean

Part = TypeVar("Part")
OWN = Path(__file__).with_name("entry_points.txt")
EXTENSIONS = Path(__file__).with_name("extensions.txt")
US = "neuros"


@dataclass(frozen=True)
class Entry:
    """An entry point: ``module:attribute``, or a module; and its distribution."""

    value: str
    distribution: str

    def load(self) -> object:
        name, _, attribute = self.value.partition(":")
        module = importlib.import_module(name)
        return getattr(module, attribute) if attribute else module


class Registry(Generic[Part]):
    """The parts of one kind; each is loaded at its first use.

    Args:
        group: of the entry points, as ``neuros.backends``.
        noun: the word for a part, in messages.
        kind: the class of all parts.
        further: words that users may give in place of a name, as ``auto``.
    """

    def __init__(self, group: str, noun: str, kind: type[Any], further: Sequence[str] = ()) -> None:
        self._group = group
        self.noun = noun
        self._kind = kind
        self._further = tuple(further)
        self._loaded: dict[str, Part] = {}

    def __iter__(self) -> Iterator[str]:
        """All names, NeuROS's first. Raises ``EnvironmentFault`` if two parts have one name."""
        yield from (*self._own, *self._others)

    def load(self, name: str) -> Part:
        """The part of this name.

        Raises:
            UsageError: if there is none; the error lists all names.
            EnvironmentFault: if it cannot be loaded, or two distributions have this name.
        """
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def value(self, name: str) -> str:
        """``module:attribute``, or the module, of a name; empty if there is none."""
        entry = self._own.get(name) or self._others.get(name)
        return entry.value if entry else ""

    def missing(self, name: str) -> str:
        """How to install the extension of NeuROS that has a part; empty for other names."""
        extension = dict(_rows(EXTENSIONS, self._group)).get(name)
        if extension is None or name in self:
            return ""
        return (
            f"{self.noun} '{name}' is in the extension neuros-{extension}, which is not installed:"
            f" {install_command(extension)}"
        )

    def _load(self, name: str) -> Part:
        entry = self._own.get(name) or self._others.get(name)
        if entry is None:
            if missing := self.missing(name):
                raise UsageError(missing)
            known = [*dict.fromkeys((*self._further, *self))]
            hint = did_you_mean(name, known)
            raise UsageError(
                f"{self.noun} '{name}': choose one of {', '.join(known)}"
                f"{f' ({hint})' if hint else ''}"
            )
        try:
            part = entry.load()
        except EnvironmentFault:  # its text names what is missing
            raise
        except Exception as error:  # a module may raise anything
            raise self._fault(name, entry, f"cannot be loaded: {error!r}") from error
        if not isinstance(part, self._kind):
            raise self._fault(name, entry, f"is not a {self._kind.__name__}, but {part!r}")
        if (own_name := getattr(part, "name", name)) != name:
            raise self._fault(name, entry, f"calls itself '{own_name}'")
        return cast("Part", part)

    def _fault(self, name: str, entry: Entry, what: str) -> EnvironmentFault:
        whose = entry.distribution
        return EnvironmentFault(
            f"{self.noun} '{name}' of the distribution {whose} ({entry.value}) {what}: install"
            f" that again, or remove it (pip uninstall {whose})"
        )

    @cached_property
    def _own(self) -> Mapping[str, Entry]:
        return {name: Entry(value, US) for name, value in _rows(OWN, self._group)}

    @cached_property
    def _others(self) -> Mapping[str, Entry]:
        from importlib.metadata import entry_points

        found: dict[str, Entry] = {}
        for each in entry_points(group=self._group):
            distribution = each.dist.name if each.dist else "?"
            if distribution == US:
                continue
            before = self._own.get(each.name) or found.get(each.name)
            if before is not None:
                raise EnvironmentFault(
                    f"both {before.distribution} and {distribution} have a {self.noun}"
                    f" '{each.name}': remove one (pip uninstall {distribution})"
                )
            found[each.name] = Entry(each.value, distribution)
        return found


def _rows(file: Path, group: str) -> Iterator[tuple[str, str]]:
    """The names and values of a section. An import of configparser takes 2 ms per node."""
    _, _, section = file.read_text("utf-8").partition(f"[{group}]\n")
    for row in section.partition("\n[")[0].split("\n"):
        if row:
            name, _, value = row.partition(" = ")
            yield name, value


def own_packages() -> set[str]:
    """The packages of NeuROS and of its extensions."""
    rows = (row.partition(" = ") for row in EXTENSIONS.read_text("utf-8").splitlines())
    return {US, *(f"{US}_{extension}" for _, _, extension in rows if extension)}


AUTO = "auto"
"""The name for the best usable back end."""

BACK_ENDS: Registry[BackEnd] = Registry("neuros.backends", "back end", BackEnd, further=[AUTO])
DEPLOYMENTS: Registry[DeploymentKind] = Registry(
    "neuros.deployments", "--deployment on", DeploymentKind
)
TRANSPORTS: Registry[TransportKind] = Registry("neuros.transports", "transport", TransportKind)
SUBCOMMANDS: Registry[Subcommand] = Registry("neuros.commands", "command", Subcommand)
LAUNCH: Registry[LaunchExtension] = Registry("neuros.launch", "option", LaunchExtension)
NAMES: Registry[Any] = Registry("neuros.names", "name in neuros", object)
MODELS: Registry[ModelFormat] = Registry(
    "neuros.models", "model format", ModelFormat, further=["xml", "mjcf"]
)
EXECUTORS: Registry[SweepExecutor] = Registry("neuros.executors", "executor", SweepExecutor)
BAG_FORMATS: Registry[Callable[..., Any]] = Registry("neuros.bag_formats", "format", object)
"""Conversions of projects, runs and recorded topics into other formats and types."""
CHECKS: Registry[MachineCheck] = Registry("neuros.checks", "check", MachineCheck)
PLUGIN_CHECKS: Registry[PluginCheck] = Registry("neuros.plugin_checks", "plugin", PluginCheck)


class _Alias:
    """Imports a module of an extension under a second name, in ``neuros``.

    It also finds the modules of a package: other finders would load them a second time. It is a
    loader and a finder without their base classes: every node would import ``importlib.abc``, 6 ms.
    """

    def __init__(self, name: str, module: str) -> None:
        self._name, self._module = name, module

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(self._module)
        self._spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec  # the import has put its own there
        if hasattr(module, "__path__"):
            sys.meta_path.insert(0, self)

    def find_spec(self, fullname: str, path: object, target: object = None) -> ModuleSpec | None:
        inner = fullname.removeprefix(f"{self._name}.")
        return spec_of_alias(fullname, f"{self._module}.{inner}") if inner != fullname else None


def spec_of_name(name: str) -> ModuleSpec | None:
    """The spec of ``neuros.<name>`` if that is a module of an extension.

    Raises:
        ModuleNotFoundError: if it is one of an extension that is not installed.
    """
    inner = name.partition(".")[2]
    if missing := NAMES.missing(inner):
        raise ModuleNotFoundError(missing, name=name)
    value = NAMES.value(inner)
    return spec_of_alias(name, value) if value and ":" not in value else None


def spec_of_alias(name: str, module: str) -> ModuleSpec | None:
    """The spec of a module under a second name; the import loads the module once."""
    found = find_spec(module)
    if found is None:
        return None
    loader = _Alias(name, module)
    spec = ModuleSpec(name, loader, origin=found.origin)  # type: ignore[arg-type]
    spec.has_location = found.has_location
    spec.submodule_search_locations = found.submodule_search_locations
    return spec


@dataclass(frozen=True)
class Chosen:
    """A back end, its deployment, and notices about the choice."""

    back_end: BackEnd
    deployment: Deployment
    notices: Sequence[Notice] = ()


def choose(
    wanted: str, project: Project, nodes: Sequence[Node], options: Mapping[str, Any]
) -> Chosen:
    """Prepare the back end of a name, or for ``auto`` the best usable one, for nodes.

    Args:
        options: of the back end, by name; with ``auto``, each back end gets those that it has.

    Raises:
        UsageError: if there is no such back end, or it has no such option.
        EnvironmentFault: if something is missing; for ``auto``, for every back end.
    """
    if wanted != AUTO:
        back_end = BACK_ENDS.load(wanted)
        known = [each.name for each in back_end.options]
        for name in options:
            if name not in known:
                raise UsageError(
                    f"the back end {back_end.name} has no option '{name}':"
                    f" {', '.join(known) if known else 'it has none'}"
                )
        return Chosen(back_end, back_end.prepare(project, nodes, option_values(back_end, options)))
    # The back ends by rank, highest first; broken ones become notices.
    candidates: list[BackEnd] = []
    notices: list[Notice] = []
    for name in BACK_ENDS:
        try:
            candidates.append(BACK_ENDS.load(name))
        except EnvironmentFault as fault:
            notices.append(("WARN", str(fault)))
    candidates.sort(key=lambda each: -(each.rank or 0))
    reasons: list[tuple[BackEnd, str]] = []
    for back_end in candidates:
        if back_end.rank is None:
            continue
        try:
            deployment = back_end.prepare(project, nodes, option_values(back_end, options))
        except EnvironmentFault as fault:
            reasons.append((back_end, back_end.why_not(fault)))
            continue
        notices += [
            ("INFO", f"each node runs in {back_end.place}, not in {other.place}: {reason}")
            for other, reason in reasons
        ]
        return Chosen(back_end, deployment, notices)
    raise EnvironmentFault("\n".join(f"{other.name}: {reason}" for other, reason in reasons))


def option_values(back_end: BackEnd, options: Mapping[str, Any]) -> dict[str, Any]:
    return {each.name: each.value(options.get(each.name)) for each in back_end.options}


def back_end_of(record: Mapping[str, Any]) -> BackEnd | None:
    """The back end of a past run, by its ``run.json``; ``None`` if it is not registered."""
    try:
        return BACK_ENDS.load(record.get("backend", ""))
    except NeurosError:
        return None


def ran_in_one_process(record: Mapping[str, Any]) -> bool:
    """Whether all nodes of a run shared a process; records of earlier versions do not say."""
    if "is_one_process" in record:
        return bool(record["is_one_process"])
    back_end = back_end_of(record)
    return back_end is not None and back_end.is_one_process
