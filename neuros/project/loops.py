"""Loops of a project: who starts each, as far as plugins tell without being run.

A hook can run if its required inputs get packets; an output gets them from a hook that can run. So
what can run is found from the hooks that need nothing: ticks, initialise hooks, main loops. Of a
plugin that computes its hooks, or that sends from a thread, anything may come.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

from neuros.errors import Problem
from neuros.project.model import Connection, Node, Project
from neuros.project.plugin_files import DeclaredHook, DeclaredPort, PluginFile, read_plugin
from neuros.project.scanner import display_name

_Key = TypeVar("_Key", bound=Hashable)
_KINDS = {"neuros_initialise": "initialise hook", "neuros_tick": "tick", "neuros_function": "hook"}


@dataclass(frozen=True)
class Loop:
    """Nodes that send to each other.

    Attributes:
        started_by: the hooks that send there without having received from there, in words; empty
            if that is nobody, ``None`` if it is not known.
        may_stop_at: its connections that may lose the packet for which all of it waits.
    """

    nodes: tuple[str, ...]
    started_by: tuple[str, ...] | None
    may_stop_at: tuple[str, ...] = ()

    def __str__(self) -> str:
        who = " and ".join(self.started_by or ("nobody",))
        started = "by whom it is started is not known" if self.started_by is None else ""
        text = f"loop of {', '.join(self.nodes)}: {started or f'started by {who}'}"
        if self.may_stop_at:
            text += (
                f"; it stops for good if a packet is lost on {' or '.join(self.may_stop_at)}"
                ' (add "discard_limit": 0)'
            )
        return text


class _Hook(NamedTuple):
    """A hook of a node that an engine runs."""

    node: str
    declared: DeclaredHook

    @property
    def needed(self) -> list[DeclaredPort]:
        """The inputs without which it does not start."""
        return [port for port in self.declared.inputs or () if not port.is_optional]

    @property
    def outputs(self) -> set[str]:
        return {port.name or "" for port in self.declared.outputs or ()}


class Loops:
    """What can run in a project, and in which of its loops nothing can."""

    def __init__(self, project: Project) -> None:
        self._nodes = {node.name: node for node in project.nodes}
        self._to: dict[tuple[str, str], list[Connection]] = {}
        self._connections = project.connections
        for connection in project.connections:
            end = connection.destination_node, connection.destination_input
            self._to.setdefault(end, []).append(connection)
        to: dict[str, set[str]] = {}
        for each in project.connections:
            to.setdefault(each.source_node, set()).add(each.destination_node)
        self._takers = to
        self._rings = _rings([*self._nodes], lambda name: to.get(name, ()))
        # Without a loop nothing is to be told of the hooks, and no plugin need be read.
        hooks = {node.name: _hooks_of(node) if self._rings else () for node in project.nodes}
        self._unknown = {name for name, found in hooks.items() if found is None}
        self._hooks = {
            name: [_Hook(name, each) for each in found or () if each.kind in _KINDS]
            for name, found in hooks.items()
        }
        self._live: set[tuple[str, str]] = set()
        self._running: set[_Hook] = set()
        self._find_running()

    @cached_property
    def found(self) -> tuple[Loop, ...]:
        """All loops of the project."""
        return tuple(
            Loop(tuple(ring), self._starters({*ring}), self._losers({*ring}))
            for ring in self._rings
        )

    def problems(self) -> Iterator[Problem]:
        """The loops in which every hook waits for another one."""
        dead = [hook for each in self._hooks.values() for hook in each if hook not in self._running]
        before = {hook: [*self._awaited(hook, {*dead})] for hook in dead}
        for ring in _rings(dead, lambda hook: [other for other, _ in before[hook]]):
            first = ring[0]
            waits = [f"'{hook.declared.name}' of {hook.node}" for hook in ring]
            _, port = next(pair for pair in before[first] if pair[0] in ring)
            sends = sorted(
                c.source_output
                for c in self._connections
                if c.source_node == first.node and c.source_output in first.outputs
                if any(hook.node == c.destination_node for hook in ring)
            )
            plugin = self._nodes[first.node].plugin
            outputs = ", ".join(f'"{name}"' for name in dict.fromkeys(sends))
            yield Problem(
                display_name(plugin),
                port.line,
                port.column,
                "",
                f"nobody starts the loop of {', '.join(dict.fromkeys(h.node for h in ring))}: each"
                f" of {' and '.join(waits)} waits for a packet of another",
                f"send the first packets from a hook @neuros_initialise(outputs=[{outputs}]) in"
                f" {plugin.name}, or make one of the inputs Optional",
            )

    # ------------------------------------------------------------------ inside

    def _find_running(self) -> None:
        waiting = [hook for hooks in self._hooks.values() for hook in hooks]
        while waiting:
            hook = waiting.pop()
            if hook in self._running or any(self._lacks(hook.node, p) for p in self._needs(hook)):
                continue
            self._running.add(hook)
            self._live |= {(hook.node, output) for output in hook.outputs}
            waiting += [
                each for node in self._takers.get(hook.node, ()) for each in self._hooks[node]
            ]

    def _needs(self, hook: _Hook) -> list[DeclaredPort]:
        clock = self._nodes[hook.node].clock
        if hook.declared.sim_tick is None or clock is None:
            return hook.needed
        return [*hook.needed, DeclaredPort(clock.name, *hook.declared.sim_tick)]

    def _lacks(self, node: str, port: DeclaredPort) -> list[Connection]:
        """The connections that bring nothing, if therefore an input has no packet."""
        ends = self._to.get((node, port.name or ""), [])
        silent = [
            each
            for each in ends
            if each.source_node not in self._unknown
            and (each.source_node, each.source_output) not in self._live
        ]
        return silent if port.is_all or len(silent) == len(ends) else []

    def _awaited(self, hook: _Hook, dead: set[_Hook]) -> Iterator[tuple[_Hook, DeclaredPort]]:
        for port in self._needs(hook):
            for connection in self._lacks(hook.node, port):
                for other in self._hooks[connection.source_node]:
                    if other in dead and connection.source_output in other.outputs:
                        yield other, port

    def _starters(self, ring: set[str]) -> tuple[str, ...] | None:
        found = tuple(
            f"{_KINDS[hook.declared.kind]} '{hook.declared.name}' of {hook.node}"
            for hook in self._starting(ring)
        )
        return found or (None if ring & self._unknown else ())

    def _starting(self, ring: set[str]) -> list[_Hook]:
        """The hooks that send into a ring without having received from it."""
        inside = self._inside(ring)
        sent = {(c.source_node, c.source_output) for c in inside}
        taken = {(c.destination_node, c.destination_input) for c in inside}
        return [
            hook
            for node in sorted(ring)
            for hook in self._hooks[node]
            if hook in self._running
            and any((node, output) in sent for output in hook.outputs)
            and not any((node, port.name) in taken for port in self._needs(hook))
        ]

    def _losers(self, ring: set[str]) -> tuple[str, ...]:
        """Where a loss ends a ring: in one that only initialise hooks start, once."""
        kinds = {hook.declared.kind for hook in self._starting(ring)}
        if ring & self._unknown or kinds != {"neuros_initialise"}:
            return ()
        return tuple(
            str(c)
            for c in self._inside(ring)
            if not c.is_reliable and c.source_node != c.destination_node
        )

    def _inside(self, ring: set[str]) -> list[Connection]:
        return [c for c in self._connections if {c.source_node, c.destination_node} <= ring]


def _hooks_of(node: Node) -> Sequence[DeclaredHook] | None:
    """The hooks of a node; ``None`` where others may be there, or packets come without them."""
    plugin = None if node.plugin.name == "" else read_plugin(node.plugin)
    if plugin is None or not plugin.is_whole or plugin.mistakes:
        return None
    beside = [*modules_beside(plugin)]
    if any(part.sends_by_itself for part in (plugin, *beside)):
        return None
    bring_hooks = plugin.functions_of - {_name_of(p) for p in beside if p.is_whole and not p.hooks}
    is_known = all(None not in (hook.inputs, hook.outputs) for hook in plugin.hooks)
    has_names = all(
        port.name is not None
        for hook in plugin.hooks
        for port in (*(hook.inputs or ()), *(hook.outputs or ()))
    )
    return plugin.hooks if is_known and has_names and not bring_hooks else None


def _name_of(plugin: PluginFile) -> str:
    return plugin.path.stem


def modules_beside(plugin: PluginFile) -> Iterator[PluginFile]:
    """The modules in a plugin's folder that it imports."""
    names = sorted({name.lstrip(".").partition(".")[0] for name in plugin.imports} - {""})
    found = (read_plugin(plugin.path.parent / f"{name}.py") for name in names)
    yield from (module for module in found if module is not None)


def _rings(keys: Iterable[_Key], after: Callable[[_Key], Iterable[_Key]]) -> list[list[_Key]]:
    """The strongly connected components with a circle in them, in the order of ``keys``."""
    order = [*keys]
    forward: Mapping[_Key, list[_Key]] = {key: [*after(key)] for key in order}
    backward: dict[_Key, list[_Key]] = {key: [] for key in order}
    for key, others in forward.items():
        for other in others:
            backward[other].append(key)
    seen: set[_Key] = set()
    done: list[_Key] = []
    for root in order:
        path = [(root, iter(forward[root]))] if root not in seen else []
        seen.add(root)
        while path:
            key, rest = path[-1]
            for other in rest:
                if other not in seen:
                    seen.add(other)
                    path.append((other, iter(forward[other])))
                    break
            else:
                done.append(key)
                path.pop()
    component: dict[_Key, _Key] = {}
    for root in reversed(done):
        waiting = [root]
        while waiting:
            key = waiting.pop()
            if key not in component:
                component[key] = root
                waiting += backward[key]
    members: dict[_Key, list[_Key]] = {}
    for key in order:
        members.setdefault(component[key], []).append(key)
    return [m for m in members.values() if len(m) > 1 or m[0] in forward[m[0]]]
