"""The two JSON schemas as tables: every key of every object."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from site_parts.words import as_text, cell


def page(root: Path, name: str) -> str:
    """All objects of ``schema/<name>.schema.json``."""
    schema = json.loads((root / "schema" / f"{name}.schema.json").read_text("utf-8"))
    parts = [f"# Keys of a {name} file, from the schema\n\n{as_text(schema['description'])}\n\n"]
    parts.append(
        f"Made from [`schema/{name}.schema.json`](../../schema/{name}.schema.json). "
        "[Project files](../project_files.md) says what the keys are for.\n"
    )
    for title, part in _objects(schema):
        parts.append(f"\n## {title}\n\n{as_text(part.get('description', ''))}\n\n")
        parts.append(_table(part, schema.get("$defs", {})))
        for example in part.get("examples", []):
            parts.append(f"\n```json\n{json.dumps(example, indent=2)}\n```\n")
    return "".join(parts)


def _objects(schema: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    yield schema["title"], schema
    places = {**schema.get("properties", {}), **schema.get("$defs", {})}
    for name, part in places.items():
        if "properties" in part:
            yield f"{part.get('title', name)} (`{name}`)", part


def _table(part: dict[str, Any], definitions: dict[str, Any]) -> str:
    rows = ["| key | type | needed | meaning |", "| --- | --- | --- | --- |"]
    for key, entry in part["properties"].items():
        value = _defined(entry, definitions)
        needed = "yes" if key in part.get("required", []) else ""
        example = value["examples"][0] if value.get("examples") else None
        shown = f" Example: `{cell(json.dumps(example))}`" if example is not None else ""
        meaning = cell(as_text(value.get("description", "")))
        rows.append(f"| `{key}` | {cell(_type(value))} | {needed} | {meaning}{shown} |")
    return "\n".join(rows) + "\n"


def _defined(value: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """A key with what its definition says; one that has a table of its own is named as the type."""
    found = definitions.get(value.get("$ref", "").removeprefix("#/$defs/"), {})
    if "properties" in found:
        return {"description": found["description"], **value}
    return {**found, **{key: each for key, each in value.items() if key != "$ref" or not found}}


def _type(value: dict[str, Any]) -> str:
    """What may stand there, in a few words."""
    if "$ref" in value:
        return as_text(value["$ref"].rpartition("/")[2].removesuffix(".schema.json"))
    if "enum" in value:
        return " or ".join(f"`{json.dumps(each)}`" for each in value["enum"])
    if "const" in value:
        return f"`{json.dumps(value['const'])}`"
    for several in ("anyOf", "oneOf"):
        if several in value:
            return " or ".join(dict.fromkeys(_type(each) for each in value[several]))
    kinds = value.get("type", "any")
    text = " or ".join(kinds) if isinstance(kinds, list) else kinds
    limits = [f"{sign} {value[key]}" for key, sign in _LIMITS.items() if key in value]
    items = f" of {_type(value['items'])}" if isinstance(value.get("items"), dict) else ""
    return as_text(text) + items + (f" ({', '.join(limits)})" if limits else "")


_LIMITS = {
    "minimum": "≥",
    "exclusiveMinimum": ">",
    "maximum": "≤",
    "maxLength": "length ≤",
    "minItems": "items ≥",
}
