"""Schema violations of a project, in sentences; and NEST nodes that cannot share a process.

The schema is the only grammar of the configuration. What it cannot express (names that occur
twice, connections that end nowhere) is in :mod:`neuros.project.checks`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from neuros.errors import Problem
from neuros.project.model import Project
from neuros.project.parsed import ParsedProject
from neuros.project.scanner import Element, problem_in
from neuros.project.suggest import did_you_mean, listed

MOST_PROBLEMS = 200
"""Of one kind that are looked for: nobody reads more, and to find all takes minutes."""
SCHEMA_FOLDER = Path(__file__).resolve().parents[1] / "schema"

_KINDS = {
    "object": "an object",
    "array": "a list",
    "string": "a text",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "null": "null",
}


_TYPES: Mapping[str, type] = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "null": type(None),
}


def violations(parsed: ParsedProject) -> list[Problem]:
    """Everything in the files of a project that violates the schema."""
    found = violations_in(parsed.root, "project")
    for node in parsed.nodes:
        if node.source is not parsed.root.source:
            found += violations_in(node, "node")
    return found


def schema(name: str) -> dict[str, Any]:
    """The schema of that name: ``"project"``, ``"node"``, or ``"run"`` for ``run.json``."""
    content: dict[str, Any] = json.loads(
        (SCHEMA_FOLDER / f"{name}.schema.json").read_text(encoding="utf-8")
    )
    return content


def mistake(content: Any, name: str, part: str = "") -> str:
    """What is wrong with the content of a file that NeuROS has written, empty if nothing is.

    ``part`` of the schema of that name is its form, as ``"#/$defs/node_file"``.
    """
    validator = Validator(f"{name}.schema.json", part.removeprefix("#"), is_strict=name == "run")
    error = next(validator.violations(content), None)
    if error is None:
        return ""
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in error.path)
    return f"${''.join(steps)}: {_sentence(error)[0]}"


def nest_conflicts(project: Project, names: Collection[str] | None = None) -> tuple[Problem, ...]:
    """The NEST nodes, among those of ``names`` (``None``: all), that would have to share a process.

    NEST has one kernel per process, so that this matters to back ends that put all nodes into
    one. Nodes that use NEST are known by their container here.
    """
    chosen = [node for node in project.nodes if names is None or node.name in names]
    nest = [node for node in chosen if node.container.partition(":")[0] == "neuros_nest"]
    return tuple(
        problem_in(
            node.file,
            f"{node.pointer}/container",
            f"nodes '{nest[0].name}' and '{node.name}' both use NEST, which allows one node per "
            "process",
            "start them with --backend process",
        )
        for node in nest[1:]
    )


def violations_in(element: Element, name: str) -> list[Problem]:
    """Everything in a document that violates the schema of that name."""
    errors = Validator(f"{name}.schema.json").violations(element.plain)
    found = (problem for error in errors for problem in _sentences(error, element))
    return [*islice(found, MOST_PROBLEMS)]


class Violation(NamedTuple):
    """A keyword of the schema that a value does not keep to, as ``minimum``.

    Attributes:
        wanted: what the schema says of it.
        part: the part of the schema that says so.
        path: names and places from the root to the value.
        is_name: whether the value is the name of a member of the object there.
    """

    keyword: str
    wanted: Any
    found: Any
    part: Mapping[str, Any]
    path: tuple[str | int, ...]
    is_name: bool = False


@dataclass(frozen=True)
class Validator:
    """Compares values with a part of a schema, in those keywords that NeuROS's own schemas use.

    ``jsonschema`` knows all keywords, but its import would be a tenth of each launch. A test holds
    both against each other.

    Args:
        file: of the schema.
        is_strict: whether 2.0 is no whole number: in what NeuROS has written.
    """

    file: str
    pointer: str = ""
    is_strict: bool = False

    def violations(self, value: Any) -> Iterator[Violation]:
        """All of them, in the order of the schema."""
        return self._in(value, {"$ref": f"{self.file}#{self.pointer}"}, self.file, ())

    def _in(
        self, value: Any, part: Mapping[str, Any], file: str, path: tuple[str | int, ...]
    ) -> Iterator[Violation]:
        for keyword, wanted in part.items():
            if keyword == "$ref":
                name, _, pointer = wanted.partition("#")
                yield from self._in(value, _part_of(name or file, pointer), name or file, path)
            elif keyword == "if":
                branch = "then" if self._fits(value, wanted, file) else "else"
                yield from self._in(value, part.get(branch, {}), file, path)
            elif keyword == "allOf":
                for each in wanted:
                    yield from self._in(value, each, file, path)
            elif keyword == "items" and isinstance(value, list):
                for place, item in enumerate(value):
                    yield from self._in(item, wanted, file, (*path, place))
            elif keyword == "properties" and isinstance(value, dict):
                for name in (name for name in wanted if name in value):
                    yield from self._in(value[name], wanted[name], file, (*path, name))
            elif keyword == "propertyNames" and isinstance(value, dict):
                for name in value:
                    for each in self._in(name, wanted, file, path):
                        yield each._replace(is_name=True)
            elif keyword == "additionalProperties" and isinstance(wanted, dict):
                for name in _additional(value, part):
                    yield from self._in(value[name], wanted, file, (*path, name))
            elif not self._keeps_to(keyword, wanted, value, part, file):
                yield Violation(keyword, wanted, value, part, path)

    def _fits(self, value: Any, part: Mapping[str, Any], file: str) -> bool:
        return next(self._in(value, part, file, ()), None) is None

    def _keeps_to(
        self, keyword: str, wanted: Any, value: Any, part: Mapping[str, Any], file: str
    ) -> bool:
        match keyword:
            case "type":
                kinds = [wanted] if isinstance(wanted, str) else wanted
                return any(self._is(value, kind) for kind in kinds)
            case "const":
                return _same(value) == _same(wanted)
            case "enum":
                return _same(value) in map(_same, wanted)
            case "not":
                return not self._fits(value, wanted, file)
            case "oneOf":
                return sum(self._fits(value, each, file) for each in wanted) == 1
        if isinstance(value, dict):
            if keyword == "required":
                return all(name in value for name in wanted)
            return keyword != "additionalProperties" or next(_additional(value, part), None) is None
        if isinstance(value, str):
            # Python's '$' also matches before a final line feed, the one of JSON Schema does not.
            if keyword == "pattern":
                return re.search(re.sub(r"\$$", r"\\Z", wanted), value) is not None
            return _is_within(len(value), keyword, "Length", wanted)
        if isinstance(value, list):
            # To look for equal ones takes long, and there may be millions.
            if keyword == "uniqueItems" and len(value) <= part["maxItems"]:
                return len({*map(_same, value)}) == len(value)
            return _is_within(len(value), keyword, "Items", wanted)
        return not self._is(value, "number") or _is_within(value, keyword, "imum", wanted)

    def _is(self, value: Any, kind: str) -> bool:
        if kind not in ("number", "integer"):
            return isinstance(value, _TYPES[kind])
        if isinstance(value, int):
            return not isinstance(value, bool)
        # JSON has no other numbers, but Python's reader takes NaN, with which nothing compares.
        if not isinstance(value, float) or not math.isfinite(value):
            return False
        return kind == "number" or (value.is_integer() and not self.is_strict)


def _is_within(size: float, keyword: str, of: str, limit: Any) -> bool:
    if keyword == f"min{of}":
        return bool(size >= limit)
    if keyword == f"max{of}":
        return bool(size <= limit)
    return keyword != "exclusiveMinimum" or of != "imum" or bool(size > limit)


def _additional(value: Any, part: Mapping[str, Any]) -> Iterator[str]:
    """The names of an object that its part of the schema does not have."""
    known = part.get("properties", ())
    return (name for name in value if name not in known) if isinstance(value, dict) else iter(())


def _same(value: Any) -> str:
    """A text that only equal values share: 2.0 is 2, and true is not 1."""
    is_whole = isinstance(value, float) and value.is_integer()
    return json.dumps(int(value) if is_whole else value, sort_keys=True)


@cache
def _part_of(file: str, pointer: str) -> dict[str, Any]:
    part = _content(file)
    for step in pointer.split("/")[1:]:
        part = part[step]
    return part


@cache
def _content(file: str) -> dict[str, Any]:
    return schema(file.removesuffix(".schema.json"))


def _sentences(error: Violation, root: Element) -> Iterator[Problem]:
    element = root.at(error.path)
    if error.keyword == "oneOf" and not isinstance(element.value, dict):
        return  # its type is told
    if error.is_name:
        member = element.value[error.found]
        yield member.key_problem(f"'{error.found}' is not allowed as a name here", _hint(error))
    elif error.keyword == "additionalProperties":
        allowed = error.part["properties"]
        for key in [key for key in element.value if key not in allowed]:
            hint = did_you_mean(key, set(allowed) - set(element.value))
            yield element.value[key].key_problem(f"unknown key '{key}'", hint)
    elif error.keyword == "required":
        for key in [key for key in error.wanted if key not in element.value]:
            yield element.problem(f"the key '{key}' is missing")
    elif error.keyword == "not":
        key = error.path[-1]
        yield element.key_problem(f"'{key}' has no meaning for this kind of sensor")
    else:
        text, hint = _sentence(error)
        yield element.problem(text, hint)


def _sentence(error: Violation) -> tuple[str, str]:
    """The problem with a value, and a hint."""
    expected, found = error.wanted, error.found
    if error.keyword == "type":
        kinds = [expected] if isinstance(expected, str) else expected
        allowed = " or ".join(_KINDS[kind] for kind in kinds)
        return f"must be {allowed}, but is {_kind_of(found)}", ""
    if error.keyword == "pattern":
        title = error.part.get("title", "text").lower()
        return f"{_shown(found)} is not allowed as {title}", _hint(error)
    if error.keyword == "enum":
        hint = did_you_mean(found, expected) if isinstance(found, str) else ""
        return f"must be {listed(expected)}, but is {_shown(found)}", hint
    if error.keyword == "oneOf":
        return "needs exactly one of " + listed(option["required"][0] for option in expected), ""
    if error.keyword == "required":
        missing = next(key for key in expected if key not in found)
        return f"the key '{missing}' is missing", ""
    numbers = {
        "minimum": f"must be at least {expected}, but is {found}",
        "exclusiveMinimum": f"must be more than {expected}, but is {found}",
        "minLength": "must not be empty",
        "minItems": "must not be empty" if expected == 1 else f"has less than {expected} items",
        "maximum": f"must be at most {expected}, but is {found}",
        "maxItems": f"has more than {expected} items",
        "maxLength": f"is longer than {expected} characters",
        "uniqueItems": "contains the same item twice",
    }
    return numbers.get(error.keyword, f"must be {_shown(expected)}"), ""


def _hint(error: Violation) -> str:
    return str(error.part.get("$comment", ""))


def _kind_of(value: Any) -> str:
    for kind, types in (
        ("boolean", bool), ("object", dict), ("array", list), ("string", str), ("integer", int)
    ):  # fmt: skip
        if isinstance(value, types):
            return _KINDS[kind]
    if value is None:
        return "null"
    return "a number with a fraction" if math.isfinite(value) else f"{value}"


def _shown(value: Any) -> str:
    return f"'{value}'" if isinstance(value, str) else json.dumps(value)
