"""What the site's own parts make; the whole is built, and its links are followed, by tests/run."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

from docutils import nodes
from site_parts import code, command_line, contents, schema, uml, wrapping
from site_parts.finished import dead_links

from neuros.cli.main import parser

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


class TestFinishedSite:
    def dead(self, folder: Path, **pages: str) -> list[str]:
        for name, text in pages.items():
            (folder / f"{name}.html").write_text(text)
        return list(dead_links(folder))

    def test_links_between_pages_and_to_their_anchors_are_followed(self, tmp_path: Path) -> None:
        assert not self.dead(
            tmp_path, a='<a href="b.html#here">', b='<p id="here"><a href="#here">'
        )

    def test_a_page_or_an_anchor_that_is_not_there_is_named(self, tmp_path: Path) -> None:
        dead = self.dead(tmp_path, a='<a href="c.html"><a href="b.html#there">', b="")
        assert dead == ["a.html: b.html#there", "a.html: c.html"]

    def test_links_into_the_world_are_left_alone_but_nothing_is_loaded(
        self, tmp_path: Path
    ) -> None:
        page = '<a href="https://ros.org"><script src="https://cdn.example/x.js"></script>'
        assert self.dead(tmp_path, a=page) == ["a.html: https://cdn.example/x.js"]


class TestDiagrams:
    def test_classes_have_their_public_parts_bases_and_uses(self, tmp_path: Path) -> None:
        file = tmp_path / "pets.py"
        file.write_text(
            "class Animal:\n    name: str\n    def eat(self): ...\n    def _grow(self): ...\n"
            "class Cat(Animal):\n    def __init__(self, owner: 'int', toy: Toy) -> None: ...\n"
            "class Toy: ...\nclass _Hidden: ...\n"
        )
        assert uml.class_diagram([file]).splitlines() == [
            "classDiagram",
            *("  class Animal {", "    name", "    eat()", "  }"),
            *("  class Cat", "  class Toy"),
            *("  Animal <|-- Cat", "  Cat --> Toy"),
        ]

    def test_an_import_that_follows_from_others_is_left_out(self) -> None:
        drawn = uml.import_diagram({"c": {"a", "b"}, "b": {"a"}})
        assert re.findall(r"(\w+) --> (\w+)", drawn) == [("n1", "n0"), ("n2", "n1")]

    def test_the_engine_imports_no_transport(self) -> None:
        imports = uml.imports_between(ROOT, 2)
        assert imports["transport"] >= {"errors", "ports"}
        assert not imports["engine"] & {"transport", "node", "backends", "launcher", "cli"}


@cache
def pages_of_code() -> dict[str, str]:
    """The pages of all packages, which take long."""
    return dict(code.pages(ROOT))


class TestReference:
    def test_every_module_is_on_the_page_of_its_package(self) -> None:
        text = "".join(pages_of_code().values())
        modules = {
            ".".join(file.relative_to(base).with_suffix("").parts).removesuffix(".__init__")
            for base in (ROOT, *ROOT.glob("extensions/*"))
            for file in base.glob("neuros*/**/*.py")
            if (file.parent / "__init__.py").exists()
        }
        assert len(modules) > 100
        assert modules >= code.PLUGINS
        modules -= code.PLUGINS
        assert not [name for name in modules if f".. automodule:: {name}\n" not in text]

    def test_every_command_and_its_options_are_shown(self) -> None:
        page = command_line.page()
        assert "\n## neuros launch\n" in page
        assert "\n## neuros bag repair\n" in page
        assert "`-d ID, --domain-id ID`" in page
        assert "\n## neuros node\n" not in page, "what launchers start is no command for users"

    def test_every_key_of_the_schemas_has_a_row(self) -> None:
        assert "\n| `discard_limit` | integer (≥ 0, ≤ 1000000000) |  |" in schema.page(ROOT, "node")
        assert "\n| `nodes` | array" in schema.page(ROOT, "project")

    def test_a_key_that_is_defined_elsewhere_has_its_type_and_meaning(self) -> None:
        page = schema.page(ROOT, "node")
        assert "\n| `environment` | object |  | Environment variables of the node." in page
        assert "\n| `qos` | qos |  | Quality of service" in page

    def test_every_package_says_in_the_list_what_it_is(self) -> None:
        listed = pages_of_code()["code"]
        assert "| [neuros.engine](code/neuros.engine.md) | The engine of a node" in listed
        assert ") |  |" not in listed

    def test_the_navigation_has_the_pages_of_each_table_of_the_index(self) -> None:
        source = [(DOCS / "index.md").read_text("utf-8")]
        table = source[0]
        contents.add_toctrees(None, "docs/index", source)
        for page in DOCS.glob("*.md"):
            if page.stem != "index":
                title = re.search(rf"^\| \[(.+)\]\({page.name}\)", table, re.MULTILINE)
                assert title, page.name
                assert f"\n{title[1]} </docs/{page.stem}>\n" in source[0]
        assert ":caption: Tutorial\n\nFrom zero" in source[0]

    def test_the_front_page_does_not_say_how_the_site_is_built(self) -> None:
        page = (DOCS / "index.md").read_text("utf-8")
        assert "--docs" not in page
        assert "--docs" in (ROOT / "CONTRIBUTING.md").read_text("utf-8")


def test_options_are_kept_whole_and_long_paths_may_be_broken() -> None:
    option, path = nodes.literal(text="--node NAME"), nodes.literal(text="/neuros/" + 30 * "x")
    page = nodes.paragraph("", "", option, path)
    wrapping.keep_words_whole(None, page)
    assert (option["classes"], path["classes"]) == (["whole"], [])


def test_every_variable_of_neuros_is_on_its_page() -> None:
    page = (DOCS / "environment_variables.md").read_text("utf-8")
    text = "".join(file.read_text("utf-8") for file in (ROOT / "neuros").rglob("*.py"))
    named = set(re.findall(r"\bNEUROS_[A-Z_]*[A-Z]\b", text))
    assert "NEUROS_RUN_ID" in named
    assert named <= set(re.findall(r"`(NEUROS_[A-Z_]+)`", page))


def test_the_exit_codes_are_those_of_the_command() -> None:
    page = (DOCS / "command_line.md").read_text("utf-8").partition("\n## Exit codes\n")[2]
    told = re.findall(r"^  (\d+) ", str(parser().epilog), re.MULTILINE)
    assert told == re.findall(r"^\| (\d+) \|", page.partition("\n## ")[0], re.M)


def test_every_example_in_a_docstring_is_run_by_a_test() -> None:
    tests = "".join(file.read_text("utf-8") for file in (ROOT / "tests").rglob("test_*.py"))
    for file in (ROOT / "neuros").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                is_example = ">>> " in (ast.get_docstring(node) or "")
                assert not is_example or f'"{node.name}"' in tests, f"{node.name} of {file.name}"
