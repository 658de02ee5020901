"""The schema files: complete, true to themselves, and shipped."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from referencing import Registry, Resource

from neuros.project.validate import SCHEMA_FOLDER, schema

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
