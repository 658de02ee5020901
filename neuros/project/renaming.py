"""``--namespace`` and ``--remap``: names on the ROS graph, from the command line."""

from __future__ import annotations

from collections.abc import Sequence

from neuros.errors import Problem
from neuros.project.draft import Draft
from neuros.project.source import Element, Source, escape

_FORM = "write --remap FROM:=TO, as in --remap /scan:=/left/scan"
_SPECIAL = {
    "__ns": "use --namespace",
    "__node": "a node keeps the name that the project gives it",
    "__name": "a node keeps the name that the project gives it",
}


def apply_namespace(draft: Draft, text: str) -> None:
    """Apply ``--namespace`` to a draft, in the place of the project's own."""
    if isinstance(draft.root.value, dict):
        source = Source(f"--namespace {text}", draft.roots.project, text)
        draft.root.value["namespace"] = Element(text, source, 0, len(text), "/namespace")


def apply_remaps(draft: Draft, texts: Sequence[str]) -> list[Problem]:
    """Apply each ``--remap`` to a draft; they go before the rules of the project."""
    problems: list[Problem] = []
    rules: dict[str, Element] = {}
    for text in texts:
        source = Source(f"--remap {text}", draft.roots.project, text)
        old, sign, new = text.partition(":=")
        if not (sign and old and new):
            problems.append(source.problem(0, "/remap", "is no rule", _FORM))
        elif old.rpartition(":")[2] in _SPECIAL:
            hint = _SPECIAL[old.rpartition(":")[2]]
            problems.append(source.problem(0, "/remap", f"'{old}' is not remapped", hint))
        else:
            start = len(old) + len(sign)
            pointer = f"/remap/{escape(old)}"
            rule = Element(new, source, start, len(text), pointer, key_start=0)
            rules.setdefault(old, rule)  # the first one counts
    if rules and isinstance(draft.root.value, dict):
        remap = draft.root.member("remap")
        if remap is None:
            source = next(iter(rules.values())).source
            draft.root.value["remap"] = Element(rules, source, 0, len(source.text), "/remap")
        elif isinstance(remap.value, dict):
            remap.value = {**rules, **{k: v for k, v in remap.value.items() if k not in rules}}
    return problems
