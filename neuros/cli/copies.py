"""``neuros new`` and ``neuros example``: project folders that a user begins from."""

from __future__ import annotations

import argparse
import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from neuros.cli.output import JSON, add_format, print_json
from neuros.distribution import EXAMPLES, PACKAGE
from neuros.errors import UsageError
from neuros.project.suggest import did_you_mean

_TEMPLATE = PACKAGE / "cli" / "template"
# Relative to the folder that a project is copied from.
_SCHEMA = re.compile(r'(?<="\$schema": ")[./]*/schema/')
_IN_GALLERY = re.compile(r"^## \[.*\]\((.*)/README\.md\)\n\n([^.]*\.(?=\s))", re.MULTILINE)


@dataclass(frozen=True)
class _Example:
    """A row of ``neuros example``."""

    name: str
    description: str
    folder: Path


def add_new(new: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    new.description = (
        "Make a folder with a small project that runs: two plugins in a closed loop, and a test."
    )
    new.add_argument("folder", type=Path, metavar="FOLDER", help="a new or empty folder")
    new.set_defaults(command=_new)


def _new(options: argparse.Namespace) -> int:
    _copy(_TEMPLATE, options.folder, {})
    print(f"made {options.folder}; the next command: neuros launch {options.folder}")
    return 0


def add_example(example: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    example.description = (
        "List the examples, or copy one into a folder, where it can be run and changed."
    )
    example.add_argument("name", nargs="?", metavar="NAME", help="the example to copy")
    example.add_argument(
        "folder",
        nargs="?",
        type=Path,
        metavar="FOLDER",
        help="a new or empty folder (default: NAME, in the current folder)",
    )
    add_format(example)
    example.set_defaults(command=_example)


def _example(options: argparse.Namespace) -> int:
    found = _examples()
    if options.name is None and options.format == JSON:
        print_json([*found.values()])
    elif options.name is None:
        for each in found.values():
            print(f"{each.name:18} {each.description}")
        print("\nneuros example NAME copies one into a folder of its own")
    elif options.name in found:
        _copy_example(found[options.name], options.folder or Path(options.name))
    else:
        hint = did_you_mean(options.name, found) or f"there are {', '.join(found)}"
        raise UsageError(f"there is no example '{options.name}' ({hint})")
    return 0


def _examples() -> Mapping[str, _Example]:
    """By name, in the order of the gallery, with the first sentence that it says on them."""
    gallery = (EXAMPLES / "README.md").read_text("utf-8")
    found = {}
    for inside, sentence in _IN_GALLERY.findall(gallery):
        folder = EXAMPLES / inside
        found[folder.name] = _Example(folder.name, " ".join(sentence.split()), folder)
    return found


def _copy_example(example: _Example, folder: Path) -> None:
    """Copy it, with its commands as they are to be given beside the copy."""
    inside = example.folder.relative_to(EXAMPLES.parent)
    renamed = {f"{inside}": f"{folder}", "./launch.py": "neuros launch", ".venv/bin/": ""}
    _copy(example.folder, folder, renamed)
    others = sorted(file.name for file in folder.glob("*.json") if _is_variant(file))
    print(f"copied to {folder}; the next command: neuros launch {folder}")
    if others:
        print(f"variants of it, as neuros launch {folder / others[0]}: {', '.join(others)}")


def _is_variant(file: Path) -> bool:
    return file.name != "project.json" and "nodes" in json.loads(file.read_text("utf-8"))


def _copy(source: Path, folder: Path, renamed: Mapping[str, str]) -> None:
    """Copy a project folder; ``renamed`` holds for its pages and Python files.

    Raises:
        UsageError: if there is something in the folder already, or it cannot be written.
    """
    try:
        if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
            raise UsageError(f"{folder} exists already: name another folder")
        skipped = shutil.ignore_patterns("__pycache__", "runs")
        shutil.copytree(
            source, folder, ignore=skipped, copy_function=shutil.copyfile, dirs_exist_ok=True
        )
        for file in (*folder.rglob("*.json"), *folder.rglob("*.md"), *folder.rglob("*.py")):
            text = _SCHEMA.sub(f"{(PACKAGE / 'schema').as_uri()}/", file.read_text("utf-8"))
            for old, new in renamed.items():
                text = text.replace(old, new)
            file.write_text(text, "utf-8")
    except OSError as error:
        reason = error.strerror or error
        raise UsageError(f"{folder} cannot be made ({reason}): name another folder") from error
