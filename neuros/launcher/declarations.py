"""Declarations of plugins that the end of a run depends on.

A loop in which every hook waits for the one before it never comes to rest by itself, so a drained
end has to stop it after one more round. Which hooks these are follows from their declarations:
:func:`last_round`. Of a node that had to be killed, they tell which finalise hooks did not run.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from neuros.control import HookDeclaration, Hooks
from neuros.hooks import HookKind, InputSpec
from neuros.project.model import Connection, NodeFile


@dataclass(frozen=True)
class DeclaredHook(HookDeclaration):
    """A hook as its plugin declares it; ``place`` is that among the hooks of its node's engine."""

    node: str = ""
    place: int = 0

    @property
    def required(self) -> list[InputSpec]:
        """The inputs without which it does not start."""
        return [port for port in self.inputs if not port.is_optional]

    @property
    def may_go_on(self) -> bool:
        """Whether it starts while its project drains."""
        return self.kind is HookKind.FUNCTION and bool(self.required or not self.outputs)


class Declarations:
    """The hooks of the nodes that have been loaded.

    Args:
        files: the nodes.
    """

    def __init__(self, files: Sequence[NodeFile]) -> None:
        self._connections = {connection for file in files for connection in file.connections}
        self._external = {
            (file.node.name, port.name)
            for file in files
            for port in file.node.inputs
            if port.external_topic is not None
        }
        self._hooks: dict[str, list[DeclaredHook]] = {}
        self._finalisers: dict[str, list[str]] = {}
        self._finalising: dict[str, str | None] = {}

    def take(self, message: Hooks) -> None:
        """Take the declarations of a node."""
        node = message.node
        self._finalisers[node] = list(message.finalise)
        self._hooks[node] = [
            DeclaredHook(hook.kind, hook.inputs, hook.outputs, node, place)
            for place, hook in enumerate(message.hooks)
        ]

    def note_finalising(self, node: str, hook: str | None) -> None:
        """A node has started this finalise hook; ``""``: to close what it holds; ``None``: done."""
        self._finalising[node] = hook
        if hook and hook in self._finalisers.get(node, ()):
            self._finalisers[node].remove(hook)

    def is_finalising(self, node: str) -> bool:
        """Whether a node has come as far as its finalise hooks."""
        return node in self._finalising

    def unfinished(self, node: str) -> list[str]:
        """Clauses about the finalise hooks of a node that has not made its final report."""
        clauses = []
        hook = self._finalising.get(node)
        if hook:
            clauses.append(f"finalise hook '{hook}' of '{node}' did not finish")
        elif hook is not None:
            clauses.append(f"what '{node}' has registered with node.on_close did not end")
        if names := self._finalisers.get(node):
            hooks = " and ".join(f"'{name}'" for name in names)
            noun = "hook" if len(names) == 1 else "hooks"
            clauses.append(f"finalise {noun} {hooks} of '{node}' did not run")
        return clauses

    def last_round(self, stopped: str) -> dict[str, tuple[int, ...]]:
        """By node, the places of the hooks that may start once more only, for the end to come.

        ``stopped`` is the node that starts no further hook, empty if there is none.
        """
        hooks = [hook for hooks in self._hooks.values() for hook in hooks]
        found: dict[str, list[int]] = {}
        for hook in last_round(hooks, self._connections, self._external, stopped):
            found.setdefault(hook.node, []).append(hook.place)
        return {node: tuple(places) for node, places in found.items()}


def last_round(
    hooks: Collection[DeclaredHook],
    connections: Collection[Connection],
    external: Collection[tuple[str, str]] = (),
    stopped: str = "",
) -> list[DeclaredHook]:
    """The hooks that have to be stopped for a draining project to come to its end.

    Those that could go on for ever are the largest set of which each hook gets its required inputs
    from others of the set (or from an external topic), and sends reliably to takers of the set
    only: any other taker starves, and its sender blocks. A hook of the set has to be stopped if it
    is in a ring of required inputs, or passes on what an external topic brings: the others only
    work off what these send.

    Args:
        hooks: of all nodes that are known; others count as resting.
        connections: with an end at one of these nodes.
        external: the inputs that are bound to an external topic, as ``(node, input)``.
        stopped: the node that starts no further hook.
    """
    known = {hook.node for hook in hooks}
    endless = {hook for hook in hooks if hook.may_go_on and hook.node != stopped}

    takers: dict[tuple[str, str], list[DeclaredHook]] = defaultdict(list)
    origins: dict[tuple[str, str], list[DeclaredHook]] = defaultdict(list)
    into: dict[tuple[str, str], list[Connection]] = defaultdict(list)
    out_of: dict[tuple[str, str], list[Connection]] = defaultdict(list)
    for hook in hooks:
        for port in hook.inputs if hook.kind is not HookKind.INITIALISE else ():
            takers[hook.node, port.name].append(hook)
        for output in hook.outputs:
            origins[hook.node, output].append(hook)
    for connection in connections:
        into[connection.destination_node, connection.destination_input].append(connection)
        out_of[connection.source_node, connection.source_output].append(connection)

    def senders(hook: DeclaredHook, port: InputSpec) -> list[list[DeclaredHook]]:
        """For each connection of an input, the hooks of the set that send on it."""
        return [
            [each for each in origins[c.source_node, c.source_output] if each in endless]
            for c in into[hook.node, port.name]
        ]

    def is_fed(hook: DeclaredHook, port: InputSpec) -> bool:
        if (hook.node, port.name) in external:
            return True
        found = senders(hook, port)
        return bool(found) and (all(found) if port.is_all else any(found))

    def is_free(hook: DeclaredHook) -> bool:
        return all(
            c.destination_node in known
            and endless.issuperset(takers[c.destination_node, c.destination_input])
            for output in hook.outputs
            for c in out_of[hook.node, output]
            if c.is_reliable
        )

    while ending := [
        hook
        for hook in endless
        if not (all(is_fed(hook, port) for port in hook.required) and is_free(hook))
    ]:
        endless.difference_update(ending)
    before = {
        hook: {h for port in hook.required for some in senders(hook, port) for h in some}
        for hook in endless
    }
    return sorted(
        (
            hook
            for hook in endless
            if _is_in_ring(hook, before)
            or (hook.outputs and any((hook.node, port.name) in external for port in hook.required))
        ),
        key=lambda hook: (hook.node, hook.place),
    )


def _is_in_ring(start: DeclaredHook, before: Mapping[DeclaredHook, set[DeclaredHook]]) -> bool:
    """Whether a hook requires, through others, what it sends itself."""
    seen: set[DeclaredHook] = set()
    ahead = [start]
    while ahead:
        for hook in before[ahead.pop()] - seen:
            if hook == start:
                return True
            seen.add(hook)
            ahead.append(hook)
    return False
