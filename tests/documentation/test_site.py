"""The documentation as a site: built without a warning, and what it says is what the code says."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

from neuros.cli.main import parser

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
SITE = DOCS / "build" / "html"


class Links(HTMLParser):
    """What a page links to, and what can be linked to on it."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.feed(page.read_text("utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if value and name == "id":
                self.anchors.add(value)
            elif value and (tag, name) in {
                ("a", "href"),
                ("img", "src"),
                ("script", "src"),
                ("link", "href"),
            }:
                self.targets.append(value)


@pytest.fixture(scope="module")
def site() -> Path:
    """The site, built anew: a page that Sphinx does not read again has no warnings."""
    command = [sys.executable, DOCS / "make.py", "html", "--fresh-env", "--nitpicky"]
    built = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    assert (SITE / "index.html").exists()
    return SITE


def test_every_link_of_the_site_leads_somewhere_and_none_needs_a_network(site: Path) -> None:
    pages = {page: Links(page) for page in site.rglob("*.html")}
    assert len(pages) > 300
    missing = []
    for page, links in pages.items():
        for target in links.targets:
            if target.startswith(("http:", "https:", "data:", "mailto:")):
                continue
            path, _, anchor = target.partition("#")
            file = (page.parent / unquote(path.partition("?")[0])).resolve() if path else page
            wants_anchor = anchor and file in pages
            if not file.exists() or (wants_anchor and unquote(anchor) not in pages[file].anchors):
                missing.append(f"{page.relative_to(site)}: {target}")
    assert not missing
    assert not [
        page for page in pages if re.search(r"<script[^>]*src=\"http", page.read_text("utf-8"))
    ]


def test_every_module_and_every_public_class_has_its_place(site: Path) -> None:
    reference = "".join(p.read_text("utf-8") for p in (site / "docs/reference/code").glob("*.html"))
    modules = [
        ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for file in (ROOT / "neuros").rglob("*.py")
        if (file.parent / "__init__.py").exists()
    ]
    assert not [name for name in modules if f'id="module-{name}"' not in reference]
    for name in (
        "neuros.core.engine.Engine.on_packet",
        "neuros.ports.Transport",
        "neuros.hooks.Optional",
    ):
        assert f'id="{name}"' in reference


def test_every_variable_of_neuros_is_on_its_page() -> None:
    page = (DOCS / "environment_variables.md").read_text("utf-8")
    code = "".join(file.read_text("utf-8") for file in (ROOT / "neuros").rglob("*.py"))
    assert set(re.findall(r"\bNEUROS_[A-Z_]*[A-Z]\b", code)) <= {
        *re.findall(r"`(NEUROS_[A-Z_]+)`", page),
        "NEUROS_STABLE_ABI_H",  # a guard in a C header
    }


def test_the_exit_codes_are_those_of_the_command() -> None:
    page = (DOCS / "exit_codes.md").read_text("utf-8")
    told = re.findall(r"^  (\d+) ", str(parser().epilog), re.MULTILINE)
    assert told == re.findall(r"^\| (\d+) \|", page, re.MULTILINE)
