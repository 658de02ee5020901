"""``.ci/sbom``: what is installed, with versions and licences, as CycloneDX."""

from __future__ import annotations

import json
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


def sbom(folder: Path, *arguments: str | Path) -> dict[str, Any]:
    """What ``.ci/sbom`` writes, which it has checked against the schema of CycloneDX."""
    output = folder / "bill.json"
    done = subprocess.run(
        [sys.executable, ROOT / ".ci/sbom", "-o", output, *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    written: dict[str, Any] = json.loads(output.read_text("utf-8"))
    assert written["bomFormat"] == "CycloneDX"
    return written


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python with two packages, one of which the lock files name."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder / "venv", with_pip=False)
    (site_packages,) = folder.glob("venv/lib/python*/site-packages")
    licences = {"psutil": "License-Expression: BSD-3-Clause", "mine": "License: GPLv2+ or so"}
    for name, licence in licences.items():
        info = site_packages / f"{name}-1.0.dist-info"
        info.mkdir()
        text = f"Metadata-Version: 2.4\nName: {name}\nVersion: 1.0\n{licence}\n"
        (info / "METADATA").write_text(text, "utf-8")
        (info / "RECORD").touch()
    # Wheels of ROS bring one of these, too: a part of a package, and none by itself.
    (site_packages / "psutil_part-1.0.egg-info").write_text("Name: psutil_part\nVersion: 1.0\n")
    return folder / "venv/bin/python"


def test_every_package_is_listed_with_version_licence_and_origin(
    python: Path, tmp_path: Path
) -> None:
    by_name = {each["name"]: each for each in sbom(tmp_path, "--python", python)["components"]}
    assert set(by_name) == {"psutil", "mine"}
    assert by_name["psutil"]["purl"] == "pkg:pypi/psutil@1.0"
    assert by_name["psutil"]["licenses"] == [{"license": {"id": "BSD-3-Clause"}}]
    assert by_name["psutil"]["scope"] == "required"
    assert by_name["mine"]["licenses"] == [{"license": {"name": "GPLv2+ or so"}}]
    assert by_name["mine"]["scope"] == "optional"


def test_the_table_of_licences_has_what_users_install_and_no_more(
    python: Path, tmp_path: Path
) -> None:
    table = tmp_path / "licences.md"
    sbom(tmp_path, "--python", python, "--licences", table)
    assert "| `psutil` | 1.0 | core | BSD-3-Clause |" in table.read_text("utf-8")
    assert "mine" not in table.read_text("utf-8")
