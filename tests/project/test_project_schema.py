"""The schema files: complete, true to themselves, and shipped."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from referencing import Registry, Resource

from neuros.project.validate import SCHEMA_FOLDER, Validator, schema

SCHEMAS = {name: schema(name) for name in ("project", "node", "deployment")}
REGISTRY: Registry[Any] = Registry().with_resources(
    (content["$id"], Resource.from_contents(content)) for content in SCHEMAS.values()
)


def keys_of(part: Any, path: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every key that users write, and what the schema says of it (references followed)."""
    if isinstance(part, list):
        for index, item in enumerate(part):
            yield from keys_of(item, f"{path}/{index}")
    if not isinstance(part, dict):
        return
    for key, value in part.items():
        narrows = "/then/" in f"{path}/" or "/if/" in f"{path}/" or "node_file" in path
        if key == "properties" and isinstance(value, dict) and not narrows:
            for name, content in value.items():
                yield f"{path}/{name}", content
        yield from keys_of(value, f"{path}/{key}")


KEYS = [(f"{name}:{path}", part) for name in SCHEMAS for path, part in keys_of(SCHEMAS[name], "")]


def resolved(part: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in part:
        name = "deployment" if part["$ref"].endswith("/host") else "node"
        resolver = REGISTRY.resolver(SCHEMAS[name]["$id"])
        part = {**resolver.lookup(part["$ref"]).contents, **part}
        part.pop("$ref")
    return part


@pytest.mark.parametrize("name", [*SCHEMAS, "run"])
def test_it_is_a_schema_of_draft_2020_12_with_an_https_id(name: str) -> None:
    Draft202012Validator.check_schema(schema(name))
    assert schema(name)["$id"].startswith("https://")


def test_every_key_is_explained() -> None:
    explanations = {"title", "description", "default", "examples"}
    assert not [path for path, part in KEYS if not explanations <= set(resolved(part))]


def test_the_examples_of_every_key_are_valid() -> None:
    wrong = []
    for path, part in ((path, resolved(part)) for path, part in KEYS):
        base = SCHEMAS[path.partition(":")[0]]
        validator = Draft202012Validator({**part, "$id": base["$id"]}, registry=REGISTRY)
        if "#/$defs" not in str(part):
            wrong += [
                f"{path}: {example}"
                for example in part["examples"]
                if not validator.is_valid(example)
            ]
    assert not wrong


@pytest.mark.parametrize("name", SCHEMAS)
def test_the_examples_of_the_whole_are_valid(name: str) -> None:
    for example in SCHEMAS[name]["examples"]:
        Draft202012Validator(SCHEMAS[name], registry=REGISTRY).validate(example)


def test_the_package_has_the_schemas_of_the_project() -> None:
    top = Path(__file__).resolve().parents[2] / "schema"
    assert SCHEMA_FOLDER.resolve() == top
    assert sorted(file.name for file in SCHEMA_FOLDER.glob("*.json")) == [
        "deployment.schema.json",
        "node.schema.json",
        "project.schema.json",
        "run.schema.json",
    ]


ANYTHING: tuple[Any, ...] = (
    *(None, True, 0, 1, -1, 2.5, 10**30, "", "x y", "/left", [], {}, {"x y": None}, {"": 1}),
    *([1, 1], [1, True], ["a", "a"], {"sensor": "camera"}, {"name": "a", "type": "b"}),
)
RUN = json.loads((Path(__file__).parents[1] / "upgrades/kept/2.0.0/run/run.json").read_text())


def changed(value: Any) -> Iterator[Any]:
    """A value with each part of it in turn left out, doubled, or replaced by anything."""
    yield from ANYTHING
    if isinstance(value, dict):
        yield {**value, "x": 1}
        for key, item in value.items():
            yield {name: each for name, each in value.items() if name != key}
            yield from ({**value, key: each} for each in changed(item))
    elif isinstance(value, list):
        for place, item in enumerate(value[:2]):
            yield [*value, item]
            yield from ([*value[:place], each, *value[place + 1 :]] for each in changed(item))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, value) for name in SCHEMAS for value in SCHEMAS[name]["examples"]),
        ("run", {key: value for key, value in RUN.items() if key != "expanded_project"}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_violates_a_schema_is_what_jsonschema_says(name: str, value: Any) -> None:
    theirs = Draft202012Validator(schema(name), registry=REGISTRY)
    ours = Validator(f"{name}.schema.json", is_strict=name == "run")
    for each in [value, *islice(changed(value), 0, None, 23)]:  # jsonschema takes 2 ms each
        found = {(v.keyword, v.path, v.is_name) for v in ours.violations(each)}
        assert found == {
            (str(e.validator), tuple(e.absolute_path), "propertyNames" in e.schema_path)
            for e in theirs.iter_errors(each)
        }, each


def test_whole_numbers_of_users_may_have_a_point_those_of_neuros_have_none() -> None:
    for value, is_strict, found in ((2.0, False, 0), (2.0, True, 1), (2.5, False, 1), (2, True, 0)):
        validator = Validator("run.schema.json", "/properties/format", is_strict=is_strict)
        assert len([*validator.violations(value)]) == found
