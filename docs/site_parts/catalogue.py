"""The catalogue of mistakes in project files: what the tests do wrong, and what NeuROS says."""

from __future__ import annotations

from pathlib import Path

_INTRODUCTION = """\
# Mistakes in project files

Made from the wrong projects of the tests (`tests/project/broken`): each file below is validated
there, and what `neuros validate` says is what stands here, word for word.
[Troubleshooting](../troubleshooting.md) says what to do about each message, and has those of runs.
"""


def page(root: Path) -> str:
    """Every broken project with its messages, in Markdown."""
    folder = root / "tests" / "project" / "broken"
    return _INTRODUCTION + "".join(_entry(file) for file in sorted(folder.glob("*.expected")))


def _entry(expected: Path) -> str:
    title = expected.stem.partition("_")[2].replace("_", " ").capitalize()
    wrong = expected.with_suffix(".json").read_text("utf-8", "replace").rstrip()
    said = expected.read_text("utf-8").rstrip()
    return f"\n## {title}\n\n```text\n{said}\n```\n\n```text\n{wrong}\n```\n"
