"""The plugin of nodes with ``"policy"``: one packet of each input is one call of the policy."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from neuros.errors import ModelError, NodeError
from neuros.hooks import Optional, neuros_function, neuros_initialise, neuros_reset
from neuros.project.model import Node
from neuros_learn.policies.mapping import PortMapping, newest_of, observed_ports
from neuros_learn.policies.model import LEROBOT, open_model


@neuros_initialise()
def begin(node: Any) -> None:
    own: Node = node.description
    name = os.environ["POLICY"]
    if name.startswith(LEROBOT):
        with suppress(ModelError):  # it is the name of a repository
            name = f"{LEROBOT}{node.resolve_path(name.removeprefix(LEROBOT))}"
    model = open_model(name, str(own.parameters.get("task", "")))
    policy = PortMapping(own, model)
    if policy.mistakes:
        raise NodeError("; ".join(map(str, policy.mistakes)))
    node.set_user_data((policy, {}, model.sha256))
    begin_again(node)


@neuros_reset()
def begin_again(node: Any) -> None:
    policy, newest, sha256 = node.get_user_data()
    policy.reset()
    newest.clear()
    node.set_result("policy_sha256", sha256)


def neuros_hooks(node: Node) -> list[Callable[..., Any]]:
    """The hook that acts; its ports are those of the node."""
    names, late = [port.name for port in observed_ports(node)], newest_of(node)
    outputs = [port.name for port in node.outputs]

    @neuros_function(
        inputs=[Optional(name) if name in late else name for name in names],
        outputs=[Optional(name) if late else name for name in outputs],
        batch=node.copies is not None,
    )
    def act(handle: Any, *packets: Any) -> list[Any] | None:
        policy, newest, _ = handle.get_user_data()
        newest.update((n, p) for n, p in zip(names, packets, strict=True) if p is not None)
        if len(newest) < len(names):
            return None
        found: list[Any] = policy.act(newest, handle.make_packet)
        return found

    return [act]
