"""Schema violations of a project, in sentences; and NEST nodes that cannot share a process.

The schema is the only grammar of the configuration. Rules that it cannot express (names that occur
twice, connections that end nowhere) are in :mod:`neuros.project.checks`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

from neuros.errors import Problem
from neuros.project.model import Project
from neuros.project.parsed import ParsedProject, connection_name
from neuros.project.scanner import Element, SourceError, problem_in, read_file
from neuros.project.suggest import did_you_mean, listed
from neuros.project.timing import VIRTUAL

MOST_PROBLEMS = 200
"""Of one check: nobody reads more, and a search for all can take minutes."""
SCHEMA_FOLDER = Path(__file__).resolve().parents[1] / "schema"

_NAMES = {
    bool: "boolean", dict: "object", list: "array", str: "string", int: "integer",
    type(None): "null",
}  # fmt: skip
_KINDS = {
    "object": "an object",
    "array": "a list",
    "string": "a text",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "null": "null",
}


def violations(parsed: ParsedProject) -> list[Problem]:
    """The violations of the schema in the files of a project."""
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
    """The first violation in the content of a file that NeuROS has written, empty if none.

    ``part``: the definition in the schema of that name, as ``"#/$defs/node_file"``.
    """
    error = next(_validator(name, part).iter_errors(content), None)
    return "" if error is None else f"{error.json_path}: {_sentence(error)[0]}"


def nest_conflicts(project: Project, names: Collection[str] | None = None) -> tuple[Problem, ...]:
    """A problem for each NEST node but the first, among ``names`` (``None``: all nodes).

    NEST has one kernel per process, so a back end with one process cannot run several. A node uses
    NEST if its container does.
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


def apply_timing(parsed: ParsedProject, file: Path) -> list[Problem]:
    """Replace durations and delays of a parsed project by those of a file (``--timing``).

    Returns the mistakes in the file.
    """
    try:
        timing, problems = read_file(file)
    except SourceError as error:
        return [error.problem]
    if found := violations_in(timing, "project", "#/$defs/timing"):
        return [*problems, *found]
    if parsed.root.string("time") != VIRTUAL:
        text = "durations and delays have an effect in virtual time only"
        problems.append(timing.problem(text, "add --time virtual"))
    nodes = {node.string("name") or "": node for node in parsed.nodes}
    for name, duration in timing.members("hooks").items():
        node, _, hook = name.partition(".")
        if node in nodes and hook:
            old = nodes[node].members("durations")
            where = nodes[node].value.get("durations", duration)
            nodes[node].value["durations"] = replace(where, value={**old, hook: duration})
        elif parsed.is_complete:
            hint = did_you_mean(node, nodes) if hook else "write 'node.hook'"
            problems.append(duration.key_problem(f"there is no node for '{name}'", hint))
    connections = {connection_name(c): c for c in parsed.connections}
    for name, delay in timing.members("connections").items():
        if name in connections:
            connections[name].value["delay"] = delay
        else:
            hint = did_you_mean(name, connections) or "write 'a.out -> b.in'"
            problems.append(delay.key_problem(f"there is no connection '{name}'", hint))
    return problems


def violations_in(element: Element, name: str, part: str = "") -> list[Problem]:
    """The violations of the schema of that name, or of a part of it, in a document."""
    errors = _validator(name, part).iter_errors(element.plain)
    found = (problem for error in errors for problem in _sentences(error, element))
    return [*islice(found, MOST_PROBLEMS)]


@cache
def _validator(name: str, part: str = "") -> Any:
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import ValidationError
    from jsonschema.validators import extend
    from referencing import Registry
    from referencing.jsonschema import DRAFT202012

    def pattern(_: Any, expected: str, instance: Any, __: Any) -> Iterator[ValidationError]:
        # Python's '$' also matches before a final line feed, the one of JSON Schema does not.
        end_exactly = re.sub(r"\$$", r"\\Z", expected)
        if isinstance(instance, str) and not re.search(end_exactly, instance):
            yield ValidationError(f"does not match {expected}")

    def unique(validator: Any, wanted: bool, instance: Any, of: Any) -> Iterator[ValidationError]:
        # The check takes the square of the number of items, and there may be millions.
        if not isinstance(instance, list) or len(instance) <= of["maxItems"]:
            yield from Draft202012Validator.VALIDATORS["uniqueItems"](
                validator, wanted, instance, of
            )

    def finite(_: Any, instance: Any) -> bool:
        # Python's reader accepts NaN, for which every comparison is false.
        is_number = isinstance(instance, (int, float)) and not isinstance(instance, bool)
        return is_number and (isinstance(instance, int) or math.isfinite(instance))

    schemas = {key: schema(key) for key in ("project", "node", "run", "deployment")}
    for content in schemas.values():
        del content["$schema"]  # in a referenced schema it would select the stock validator
    registry = Registry().with_resources(
        (content["$id"], DRAFT202012.create_resource(content)) for content in schemas.values()
    )
    own = {"pattern": pattern, "uniqueItems": unique}
    form = {"$ref": schemas[name]["$id"] + part}

    def whole(_: Any, instance: Any) -> bool:
        return type(instance) is int

    types = Draft202012Validator.TYPE_CHECKER.redefine("number", finite)
    if name == "run":  # in a project, 2.0 is a whole number, too
        types = types.redefine("integer", whole)
    return extend(Draft202012Validator, own, type_checker=types)(form, registry=registry)


def _sentences(error: Any, root: Element) -> Iterator[Problem]:
    element = root.at(error.absolute_path)
    if error.validator == "oneOf" and not isinstance(element.value, dict):
        return  # its type is told
    if "propertyNames" in error.schema_path:
        member = element.value[error.instance]
        yield member.key_problem(
            f"'{error.instance}' is not allowed as a name here", _hint(error.schema)
        )
    elif error.validator == "additionalProperties":
        allowed = error.schema["properties"]
        for key in [key for key in element.value if key not in allowed]:
            hint = did_you_mean(key, set(allowed) - set(element.value))
            yield element.value[key].key_problem(f"unknown key '{key}'", hint)
    elif error.validator == "required":
        for key in [key for key in error.validator_value if key not in element.value]:
            yield element.problem(f"the key '{key}' is missing")
    elif error.validator == "not":
        key = error.absolute_path[-1]
        yield element.key_problem(f"'{key}' has no meaning for this kind of sensor")
    else:
        text, hint = _sentence(error)
        yield element.problem(text, hint)


def _sentence(error: Any) -> tuple[str, str]:
    """The problem with a value, and a hint."""
    expected, found = error.validator_value, error.instance
    if error.validator == "type":
        kinds = [expected] if isinstance(expected, str) else expected
        allowed = " or ".join(_KINDS[kind] for kind in kinds)
        is_finite = isinstance(found, float) and math.isfinite(found)
        kind = _KINDS.get(_NAMES.get(type(found), ""), f"{found}")
        return f"must be {allowed}, but is {'a number with a fraction' if is_finite else kind}", ""
    if error.validator == "pattern":
        title = error.schema.get("title", "text").lower()
        return f"{_shown(found)} is not allowed as {title}", _hint(error.schema)
    if error.validator == "enum":
        hint = did_you_mean(found, expected) if isinstance(found, str) else ""
        return f"must be {listed(expected)}, but is {_shown(found)}", hint
    if error.validator == "oneOf":
        return "needs exactly one of " + listed(option["required"][0] for option in expected), ""
    if error.validator == "required":
        missing = next(key for key in expected if key not in found)
        return f"the key '{missing}' is missing", ""
    if error.validator in ("minProperties", "maxProperties") and "properties" in error.schema:
        return "needs exactly one of " + listed(error.schema["properties"]), ""
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
    return numbers.get(error.validator, error.message), ""


def _hint(schema_part: dict[str, Any]) -> str:
    return str(schema_part.get("$comment", ""))


def _shown(value: Any) -> str:
    return f"'{value}'" if isinstance(value, str) else json.dumps(value)
