"""Distributions that Python finds as if pip had installed them."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

DISTRIBUTIONS = Path(__file__).parents[1] / "distributions"


def install(site: Path, name: str, parts: Mapping[str, Mapping[str, str]]) -> None:
    """Write the metadata of a distribution with these entry points, by group and name."""
    info = site / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    rows: list[str] = []
    for group, values in parts.items():
        rows += [f"[{group}]\n", *(f"{key} = {value}\n" for key, value in values.items())]
    (info / "entry_points.txt").write_text("".join(rows))


def path_with(site: Path, name: str) -> str:
    """``PYTHONPATH`` with a distribution of this folder, whose metadata are written to ``site``."""
    folder = DISTRIBUTIONS / name
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    install(site, project["name"], project["entry-points"])
    paths = [str(site), str(folder), os.environ.get("PYTHONPATH", "")]
    return os.pathsep.join(filter(None, paths))
