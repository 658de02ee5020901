"""Reasons why a second run of a project may differ, as far as its files and plugins tell.

``docs/deterministic_runs.md`` has the conditions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator

from neuros.project.model import Node, Project
from neuros.project.plugin_files import PluginHook, plugins_of


def why_not_repeatable(project: Project, *, is_stepped: bool = False) -> list[str]:
    """A sentence, with its cure, for each part of a project that may do something else again.

    Args:
        is_stepped: whether all nodes are in the thread of a program that steps them: then only
            threads of plugins are left.
    """
    if project.is_virtual:  # what cannot be repeated there is refused at the start
        return []
    threads = [
        f"{node.name}: its plugin sends from a thread (run_asynchronous, submit), when that comes"
        " to it: let a hook step the simulator"
        for node in project.nodes
        if any(plugin.sends_by_itself for plugin in plugins_of(node))
    ]
    return threads if is_stepped else [*threads, *_outside(project)]


def _outside(project: Project) -> Iterator[str]:
    feeds = Counter((c.destination_node, c.destination_input) for c in project.connections)
    for node in project.nodes:
        for port in node.inputs:
            if port.external_topic is not None:
                yield f"{node.name}.{port.name}: other programs send on {port.external_topic}"
        if not node.outputs:
            continue  # as a plot: nothing follows from what it does
        into = [c for c in project.connections if c.destination_node == node.name]
        for connection in into:
            if connection.discard_limit != 0:
                yield f'{connection}: may lose packets: give it "discard_limit": 0'
        to_itself = {c.destination_input for c in into if c.source_node == node.name}
        for plugin in plugins_of(node):
            for hook in plugin.hooks:
                yield from _hook(node, hook, feeds, to_itself)


def _hook(
    node: Node, hook: PluginHook, feeds: Counter[tuple[str, str]], to_itself: Container[str | None]
) -> Iterator[str]:
    where = f"{node.name}, hook '{hook.name}'"
    if hook.kind == "neuros_tick" and hook.sim_tick is None:
        yield f"{where}: ticks by the wall clock: let it tick by simulated time (sim_seconds)"
    for port in hook.inputs or ():
        name = f"{where}: input '{port.name}'"
        count = feeds[node.name, port.name or ""]
        if port.is_optional and count and port.name not in to_itself:
            yield f"{name} is Optional, so it is empty or not as it comes: require it"
        elif count > 1 and not port.is_all:
            yield f"{name} has {count} sources, whose packets come in any order: take it with All"
