"""From the elements of a world or model to scopes with everything in its place."""

from __future__ import annotations

from neuros.convert.elements import Element
from neuros.convert.numbers import is_true, word
from neuros.convert.poses import Pose, read_pose
from neuros.convert.report import Report
from neuros.convert.scopes import Frame, Link, Scope, relative_to

_KINDS = ("link", "joint", "frame", "model")


def read_scope(
    element: Element, report: Report, *, parent: Scope | None, prefix: str = ""
) -> Scope:
    """A world or model with all that is in it, poses in the world still unknown."""
    scope = Scope(element, report, parent, prefix)
    placement = element.child("placement_frame")
    if placement is not None:
        element.attributes["placement_frame"] = placement.text
    if not scope.is_world:
        is_static = is_true(element, "static", report, default=False)
        scope.is_static = is_static or (parent is not None and parent.is_static)
        scope.self_collides = is_true(element, "self_collide", report, default=False)
    for kind in _KINDS:
        for child in element.each(kind):
            _add_frame(scope, child)
    for child in element.each("model"):
        if child.name and child.name not in scope.models:
            inner = f"{prefix}{child.name}/" if _needs_prefix(scope) else ""
            scope.models[child.name] = read_scope(child, report, parent=scope, prefix=inner)
    return scope


def place_all(scope: Scope) -> None:
    """Place every model and link in the world."""
    for name, model in scope.models.items():
        model.pose = scope.pose @ scope.place(name, model.element)
        place_all(model)
    for name in scope.frames:
        scope.place(name, scope.frames[name].element)  # also those that nothing is relative to
    for name, link in scope.links.items():
        link.pose = scope.pose @ scope.place(name, link.element)


def _needs_prefix(scope: Scope) -> bool:
    """A model that stands alone in its file needs none."""
    return not scope.is_world or scope.element.tag == "world"


def _add_frame(scope: Scope, element: Element) -> None:
    if not element.name:
        scope.report.problem(element, f"the <{element.tag}> has no name")
        return
    if element.name in scope.frames:
        first = scope.frames[element.name].element
        scope.report.problem(
            element, f"the name '{element.name}' occurs twice", f"see {first.place}"
        )
        return
    default = ""
    if element.tag == "joint":
        default = word(element, "child")
    elif element.tag == "frame":
        default = element.attributes.get("attached_to", "")
    base = relative_to(element) or default
    scope.frames[element.name] = Frame(element, base, read_pose(element, scope.report))
    if element.tag == "link":
        name = scope.prefix + element.name
        scope.links[element.name] = Link(name, element, scope, Pose(), scope.is_static)
