"""Loops of a project: which hooks start each, as far as the sources of plugins tell.

A hook can run if a hook that can run sends to each of its required inputs. The search begins with
the hooks that need no packet: ticks, initialise hooks, main loops. A plugin that computes its
hooks, or sends from a thread, may send anything.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

from neuros.errors import Problem
from neuros.project.model import Connection, Node, Project
from neuros.project.plugin_files import PluginFile, PluginHook, PluginPort, plugins_of, read_plugin
from neuros.project.scanner import display_name

_Key = TypeVar("_Key", bound=Hashable)
_KINDS = {"neuros_initialise": "initialise hook", "neuros_tick": "tick", "neuros_function": "hook"}


@dataclass(frozen=True)
class Loop:
    """Nodes that send to each other.

    Attributes:
        started_by: in words, the hooks that send into the loop without a packet from it;
            ``None`` if unknown.
        may_stop_at: its connections that may lose the packet for which the whole loop waits.
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
    declared: PluginHook

    @property
    def needed(self) -> list[PluginPort]:
        return [port for port in self.declared.inputs or () if not port.is_optional]

    @property
    def outputs(self) -> set[str]:
        return {port.name or "" for port in self.declared.outputs or ()}


class Loops:
    """The hooks of a project that can run, and its loops."""

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
        self._rings = _rings([*self._nodes], lambda name: to.get(name, ()))
        # Without a loop no plugin need be read.
        hooks = {node.name: _hooks_of(node) if self._rings else () for node in project.nodes}
        self._unknown = {name for name, found in hooks.items() if found is None}
        self._hooks = {
            name: [_Hook(name, each) for each in found or () if each.kind in _KINDS]
            for name, found in hooks.items()
        }
        self._live: set[tuple[str, str]] = set()
        self._running: set[_Hook] = set()
        waiting = [hook for each in self._hooks.values() for hook in each]
        while waiting:
            hook = waiting.pop()
            if hook in self._running or any(self._lacks(hook.node, p) for p in self._needs(hook)):
                continue
            self._running.add(hook)
            self._live |= {(hook.node, output) for output in hook.outputs}
            waiting += [each for node in to.get(hook.node, ()) for each in self._hooks[node]]

    @cached_property
    def found(self) -> tuple[Loop, ...]:
        return tuple(self._loop(ring) for ring in self._rings)

    def problems(self) -> Iterator[Problem]:
        """The loops in which every hook waits for another hook of the loop."""
        dead = [hook for each in self._hooks.values() for hook in each if hook not in self._running]
        before = {
            hook: [
                (other, port)
                for port in self._needs(hook)
                for connection in self._lacks(hook.node, port)
                for other in self._hooks[connection.source_node]
                if other not in self._running and connection.source_output in other.outputs
            ]
            for hook in dead
        }
        for ring in _rings(dead, lambda hook: [other for other, _ in before[hook]]):
            first = ring[0]
            waits = [f"'{hook.declared.name}' of {hook.node}" for hook in ring]
            _, port = next(pair for pair in before[first] if pair[0] in ring)
            sends = sorted(
                c.source_output
                for c in self._connections
                if c.source_node == first.node
                and c.source_output in first.outputs
                and any(hook.node == c.destination_node for hook in ring)
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

    def _needs(self, hook: _Hook) -> list[PluginPort]:
        clock = self._nodes[hook.node].clock
        if hook.declared.sim_tick is None or clock is None:
            return hook.needed
        return [*hook.needed, PluginPort(clock.name, *hook.declared.sim_tick)]

    def _lacks(self, node: str, port: PluginPort) -> list[Connection]:
        """The connections of an input that bring nothing, if the input gets no packet therefore."""
        ends = self._to.get((node, port.name or ""), [])
        silent = [
            each
            for each in ends
            if each.source_node not in self._unknown
            and (each.source_node, each.source_output) not in self._live
        ]
        return silent if port.is_all or len(silent) == len(ends) else []

    def _loop(self, nodes: Sequence[str]) -> Loop:
        ring = {*nodes}
        inside = [c for c in self._connections if {c.source_node, c.destination_node} <= ring]
        sent = {(c.source_node, c.source_output) for c in inside}
        received = {(c.destination_node, c.destination_input) for c in inside}
        starting = [
            hook
            for node in sorted(ring)
            for hook in self._hooks[node]
            if hook in self._running
            and any((node, output) in sent for output in hook.outputs)
            and not any((node, port.name) in received for port in self._needs(hook))
        ]
        started_by = tuple(
            f"{_KINDS[hook.declared.kind]} '{hook.declared.name}' of {hook.node}"
            for hook in starting
        )
        is_known = not ring & self._unknown
        # Initialise hooks start a loop once: a lost packet ends it.
        starts_once = {hook.declared.kind for hook in starting} == {"neuros_initialise"}
        may_stop_at = tuple(
            str(c)
            for c in inside
            if is_known and starts_once
            if not c.is_reliable and c.source_node != c.destination_node
        )
        return Loop(tuple(nodes), started_by or (() if is_known else None), may_stop_at)


def _hooks_of(node: Node) -> Sequence[PluginHook] | None:
    """The hooks of a node; ``None`` if it may have others, or sends packets without hooks."""
    found: list[PluginHook] = []
    for plugin in plugins_of(node):
        if not plugin.is_whole or plugin.mistakes:
            return None
        beside = [*modules_beside(plugin)]
        if any(part.sends_by_itself for part in (plugin, *beside)):
            return None
        without_hooks = {part.path.stem for part in beside if part.is_whole and not part.hooks}
        if plugin.functions_of - without_hooks:
            return None
        found += plugin.hooks
    is_known = all(None not in (hook.inputs, hook.outputs) for hook in found)
    has_names = all(
        port.name is not None
        for hook in found
        for port in (*(hook.inputs or ()), *(hook.outputs or ()))
    )
    return found if found and is_known and has_names else None


def modules_beside(plugin: PluginFile) -> Iterator[PluginFile]:
    """The modules in a plugin's folder that it imports."""
    names = sorted({name.lstrip(".").partition(".")[0] for name in plugin.imports} - {""})
    found = (read_plugin(plugin.path.parent / f"{name}.py") for name in names)
    yield from (module for module in found if module is not None)


def _rings(keys: Iterable[_Key], after: Callable[[_Key], Iterable[_Key]]) -> list[list[_Key]]:
    """The strongly connected components that have a circle, in the order of ``keys`` (Kosaraju)."""
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
