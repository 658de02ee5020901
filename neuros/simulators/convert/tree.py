"""Tree of bodies for MuJoCo, from SDF's graph of links and joints.

MuJoCo hangs every body on one other; SDF joins any two links. The tree begins with what hangs on
the world, then with links that are no joint's child; a joint that it reaches from its child is
turned round. Joints that would close a loop are left over.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from neuros.simulators.convert.elements import Element
from neuros.simulators.convert.scopes import Link, Scope


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two links, ``None`` being the world."""

    element: Element
    scope: Scope
    parent: Link | None
    child: Link | None

    @property
    def name(self) -> str:
        return self.scope.prefix + self.element.name

    @property
    def type(self) -> str:
        return self.element.attributes.get("type", "")


@dataclass(frozen=True, eq=False)
class Branch:
    """A link and what it hangs on: a joint to ``parent`` (``None``: the world), or nothing."""

    link: Link
    parent: Link | None = None
    joint: Joint | None = None
    is_turned: bool = False


@dataclass
class Tree:
    """Branches in an order in which a parent comes before what hangs on it."""

    branches: list[Branch] = field(default_factory=list)
    loops: list[Joint] = field(default_factory=list)


def grow(links: Sequence[Link], joints: Sequence[Joint]) -> Tree:
    """The tree of all links. Those of static models hang on the world, without a joint."""
    tree, used, seen = Tree(), set[int](), set[int]()
    at: dict[int | None, list[Joint]] = {}
    for joint in joints:
        for end in {_key(joint.parent), _key(joint.child)}:
            at.setdefault(end, []).append(joint)

    def spread(start: Link | None) -> None:
        waiting = deque([start])
        while waiting:
            link = waiting.popleft()
            for joint in at.get(_key(link), ()):
                if id(joint) in used:
                    continue
                used.add(id(joint))
                is_turned = _key(joint.parent) != _key(link)
                other = joint.parent if is_turned else joint.child
                if other is None or other.is_static or id(other) in seen:
                    tree.loops.append(joint)
                    continue
                seen.add(id(other))
                tree.branches.append(Branch(other, link, joint, is_turned))
                waiting.append(other)

    for link in links:
        if link.is_static:
            seen.add(id(link))
            tree.branches.append(Branch(link))
    spread(None)
    children = {_key(joint.child) for joint in joints}
    for link in sorted(links, key=lambda link: id(link) in children):
        if id(link) not in seen:
            seen.add(id(link))
            tree.branches.append(Branch(link))
            spread(link)
    return tree


def _key(link: Link | None) -> int | None:
    """The key of a link; one that never moves counts as the world."""
    return None if link is None or link.is_static else id(link)
