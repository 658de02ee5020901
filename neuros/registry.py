"""Registries: parts that NeuROS finds by a name, ours and those of other distributions.

A distribution registers a part as an entry point in its ``pyproject.toml``::

    [project.entry-points."neuros.backends"]
    slurm = "neuros_slurm:BACK_END"

Ours stand in ``entry_points.txt`` beside this module, from where the build takes them, too. They
are read there and not from the metadata of the installation, which containers do not have, which
is out of date in a checkout that was updated, and which takes some 10 ms to search.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from neuros.errors import EnvironmentFault, UsageError
from neuros.ports import BackEnd, SimulatorKind, TransportKind
from neuros.project.suggest import did_you_mean

Part = TypeVar("Part")
OWN = Path(__file__).with_name("entry_points.txt")
US = "neuros"


@dataclass(frozen=True)
class Entry:
    """An entry point: where a part is, as ``module:attribute``, and whose it is."""

    value: str
    distribution: str

    def load(self) -> object:
        module, _, attribute = self.value.partition(":")
        return getattr(importlib.import_module(module), attribute)


class Registry(Generic[Part]):
    """The parts of one kind, loaded one by one when they are asked for.

    Args:
        group: of the entry points, as ``neuros.backends``.
        noun: what such a part is, for messages.
        kind: the class of which all are instances.
        further: words that users may give besides the names of parts, as ``auto``.
    """

    def __init__(self, group: str, noun: str, kind: type[Any], further: Sequence[str] = ()) -> None:
        self._group = group
        self.noun = noun
        self._kind = kind
        self._further = tuple(further)
        self._loaded: dict[str, Part] = {}

    def __iter__(self) -> Iterator[str]:
        """All names, ours first. Raises ``EnvironmentFault`` if one is taken twice."""
        yield from (*self._own, *self._others)

    def load(self, name: str) -> Part:
        """The part of this name.

        Raises:
            UsageError: if there is none; it lists those that there are.
            EnvironmentFault: if it cannot be loaded, or two distributions have one of this name.
        """
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def _load(self, name: str) -> Part:
        entry = self._own.get(name) or self._others.get(name)
        if entry is None:
            known = [*self._further, *self]
            hint = did_you_mean(name, known)
            raise UsageError(
                f"{self.noun} '{name}': choose one of {', '.join(known)}"
                f"{f' ({hint})' if hint else ''}"
            )
        try:
            part = entry.load()
        except Exception as error:  # whatever a module of another distribution may raise
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
        # Every node process reads it: configparser takes 2 ms to import.
        _, _, section = OWN.read_text("utf-8").partition(f"[{self._group}]\n")
        rows = (row.split(" = ") for row in section.partition("\n[")[0].split("\n") if row)
        return {name: Entry(value, US) for name, value in rows}

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


AUTO = "auto"
"""In place of the name of a back end: the best one that can be used."""

BACK_ENDS: Registry[BackEnd] = Registry("neuros.backends", "back end", BackEnd, further=[AUTO])
TRANSPORTS: Registry[TransportKind] = Registry("neuros.transports", "transport", TransportKind)
SIMULATORS: Registry[SimulatorKind] = Registry("neuros.simulators", "simulator", SimulatorKind)
