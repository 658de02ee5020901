"""What the pages say exists: links, functions, options, keys, messages.

Quick: reads files, parses, and loads projects; starts nothing.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from site_parts.command_line import add_option_tables

from neuros.api.loading import load_with_messages
from neuros.api.request import LaunchOptions
from neuros.cli.main import parser
from neuros.errors import NeurosError
from neuros.installation.machine import NEWEST, NEWEST_FOR_NEST, OLDEST, dotted
from neuros.options import Option
from neuros.options import options_of as declared_options
from neuros.registry import BACK_ENDS, LAUNCH

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "extensions").glob("*/README.md"),
        *(ROOT / "examples").rglob("README.md"),
        *(ROOT / "extensions").glob("*/README.md"),
        ROOT / "workspace" / "README.md",
    ]
)

_LINK = re.compile(r"\[([^\]]*)\]\(([^)\s]+)\)")
_BLOCK = re.compile(r"^[ ]*```(\w*)\n(.*?)^[ ]*```", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)|``([^\n]+?)``")
_COMMAND = re.compile(r"(?:^|[\s;&|/])(neuros|launch\.py)((?:[ \t]+[^\s;&|]+)*)")
_CELL = re.compile(r"(?<!\\)\|")


def without_code(text: str) -> str:
    return _BLOCK.sub("", text)


def blocks(page: Path, language: str) -> list[str]:
    return [body for kind, body in _BLOCK.findall(page.read_text("utf-8")) if kind == language]


def links(page: Path) -> list[tuple[str, str]]:
    """``(text, target)`` of all links that stay in the project."""
    found = _LINK.findall(without_code(page.read_text("utf-8")))
    return [(text, target) for text, target in found if "://" not in target]


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", without_code(page.read_text("utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def named(page: Path) -> str:
    """A page, as a message calls it."""
    return str(page.relative_to(ROOT))


def test_every_link_leads_somewhere() -> None:
    missing = []
    for page in PAGES:
        for _, target in links(page):
            path, _, anchor = target.partition("#")
            file = (page.parent / path).resolve() if path else page
            if not file.exists() or (anchor and anchor not in anchors(file)):
                missing.append(f"{named(page)}: {target}")
    assert not missing


def test_every_function_is_in_the_file_that_its_link_leads_to() -> None:
    missing = []
    for page in PAGES:
        for text, target in links(page):
            match = re.fullmatch(r"`([\w.]+)`", text)
            if match and target.endswith(".py") and not match[1].endswith(".py"):
                code = (page.parent / target).read_text("utf-8")
                for name in match[1].split("."):
                    if not re.search(rf"^ *(?:def|class) {name}\b", code, re.MULTILINE):
                        missing.append(f"{named(page)}: {match[1]} in {target}")
    assert not missing


def test_every_page_can_be_found_from_the_first() -> None:
    index = ROOT / "docs" / "index.md"
    found, new = set(), {index.resolve()}
    while new:
        page = new.pop()
        found.add(page)
        targets = {(page.parent / t.partition("#")[0]).resolve() for _, t in links(page)}
        new |= {t for t in targets if t.suffix == ".md" and t.is_file()} - found
    missing = sorted(page.name for page in set((ROOT / "docs").glob("*.md")) - found)
    assert not missing, f"link these from docs/index.md: {missing}"
    assert index.resolve() in {
        (ROOT / t).resolve() for _, t in links(ROOT / "README.md") if t.endswith("index.md")
    }


def commands(page: Path) -> Iterator[tuple[str, list[str]]]:
    """``(program, words behind it)`` for everything on a page that looks like a command."""
    text = page.read_text("utf-8")
    places = [body for kind, body in _BLOCK.findall(text) if kind in ("sh", "console", "bash")]
    places += [one or two for one, two in _INLINE.findall(without_code(text))]
    for place in places:
        for line in place.splitlines():
            for program, words in _COMMAND.findall(line.partition(" #")[0]):
                try:
                    yield program, shlex.split(words)
                except ValueError:
                    continue


@cache
def options_of(command: str) -> set[str]:
    """The options of ``neuros <command>``, with those of its actions."""
    if not command:
        return {option for action in parser()._actions for option in action.option_strings}
    return {
        option
        for each in subparsers(parser())
        if each.prog.split()[1:2] == [command]
        for action in each._actions
        for option in action.option_strings
    }


def subparsers(of: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """All commands below a parser, and their actions."""
    for action in of._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                yield each
                yield from subparsers(each)


def test_every_option_exists() -> None:
    unknown = []
    for page in PAGES:
        for program, words in commands(page):
            command = "launch" if program == "launch.py" else ""
            if program == "neuros" and words and not words[0].startswith("-"):
                command = words.pop(0)
            given = [word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)]
            unknown += [
                f"{named(page)}: {program} {command} {option}"
                for option in given
                if option not in options_of(command)
            ]
    assert not unknown


def test_every_option_is_described() -> None:
    source = [(ROOT / "docs" / "command_line.md").read_text("utf-8")]
    add_option_tables(None, "docs/command_line", source)
    (text,) = source
    wanted = {
        option
        for command in ("launch", "validate", "graph")
        for option in options_of(command)
        if option.startswith("--") and option != "--help"
    }
    back_ends = map(BACK_ENDS.load, BACK_ENDS)  # each has a page with its options
    wanted -= {flag for each in back_ends for option in each.options for flag in option.flags}
    assert not {option for option in wanted if f"{option}" not in text}


@pytest.mark.parametrize(
    "option",
    [*declared_options(LaunchOptions), *LAUNCH.load("--dashboard").options],
    ids=lambda option: option.name,
)
def test_the_page_that_says_more_on_an_option_exists(option: Option) -> None:
    file, _, anchor = option.page.partition("#")
    assert (ROOT / "docs" / file).exists()
    assert not anchor or anchor in anchors(ROOT / "docs" / file)


def files_named_in(
    value: Any, keys: tuple[str, ...] = ("plugin", "script", "network", "policy")
) -> Iterator[str]:
    """The plugins, or what is in their place, and scripts that a project, or node, names."""
    if isinstance(value, dict):
        yield from (value[key] for key in keys if isinstance(value.get(key), str))
        for each in value.values():
            yield from files_named_in(each)
    elif isinstance(value, list):
        for each in value:
            yield from files_named_in(each)


def json_projects(page: Path) -> Iterator[dict[str, Any]]:
    """The JSON blocks of a page that are projects, or nodes, which are made one."""
    nodes, projects = [], []
    for body in blocks(page, "json"):
        content = json.loads(body)
        if isinstance(content.get("nodes"), list):
            projects.append(content)
        elif "container" in content:
            nodes.append(content)
    yield from ({"nodes": [node]} for node in nodes)
    by_file = {f"{node['name']}.json": node for node in nodes}
    for project in projects:
        entries = [by_file.get(n, n) if isinstance(n, str) else n for n in project["nodes"]]
        yield {**project, "nodes": entries}


def test_every_project_shown_is_valid(tmp_path: Path) -> None:
    wrong = []
    shown = [(page, project) for page in PAGES for project in json_projects(page)]
    for number, (page, project) in enumerate(shown):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name in files_named_in(project):
            (folder / name).write_text("")
        (folder / "project.json").write_text(json.dumps(project))
        try:
            load_with_messages(folder, reads_plugins=False)
        except NeurosError as error:
            wrong.append(f"{named(page)}: {error}")
    assert not wrong


def test_every_code_block_says_its_language() -> None:
    """What does not is coloured as Python by the site."""
    fences = {
        named(page): re.findall(r"^ *```(.*)$", page.read_text("utf-8"), re.MULTILINE)[::2]
        for page in PAGES
    }
    assert not [page for page, languages in fences.items() if "" in languages]


def test_every_plugin_shown_is_python() -> None:
    for page in PAGES:
        for body in blocks(page, "python"):
            indent = len(body) - len(body.lstrip(" "))
            lines = [line[indent:] or "\n" for line in body.splitlines(True)]
            compile("".join(lines), named(page), "exec")


def catalogue() -> list[str]:
    """The messages in the table of problems in project files."""
    text = (ROOT / "docs" / "troubleshooting.md").read_text("utf-8")
    table = text.partition("## Problems in project files")[2]
    rows = [_CELL.split(line) for line in table.splitlines() if line.startswith("| `")]
    return [row[1].strip().strip("`") for row in rows]


def test_every_message_of_the_catalogue_is_one_that_the_validator_gives() -> None:
    given = "".join(
        file.read_text("utf-8") for file in (ROOT / "tests/project/broken").glob("*.expected")
    )
    assert len(catalogue()) > 30
    assert not [message for message in catalogue() if message not in given]


def words_of(message: str) -> set[str]:
    """The words of a message without names, numbers and the hint."""
    return set(re.findall(r"[a-z]+", re.sub(r"'[^']*'|\(.*", "", message)))


def test_every_kind_of_message_is_in_the_catalogue() -> None:
    """Each broken project has a message that the catalogue knows, names apart."""
    known = [words_of(message) for message in catalogue()]
    unknown = []
    for file in sorted((ROOT / "tests/project/broken").glob("*.expected")):
        lines = file.read_text("utf-8").splitlines()
        texts = [words_of(line.split(": ", 2)[2]) for line in lines]
        if not any(words and words <= text for text in texts for words in known):
            unknown.append(file.name)
    assert not unknown


def test_the_keys_of_the_schema_are_described() -> None:
    text = (ROOT / "docs" / "project_files.md").read_text("utf-8")
    text += (ROOT / "docs" / "simulators.md").read_text("utf-8")
    node = json.loads((ROOT / "schema/node.schema.json").read_text("utf-8"))
    project = json.loads((ROOT / "schema/project.schema.json").read_text("utf-8"))
    keys = {*node["properties"], *project["properties"]}
    for part in ("input", "output", "connection", "mujoco_actuator", "mujoco_sensor"):
        keys |= set(node["$defs"][part]["properties"])
    assert not {key for key in keys if f"`{key}`" not in text}


def test_the_supported_pythons_are_the_same_everywhere() -> None:
    oldest, newest = dotted(OLDEST), dotted(NEWEST)
    files = (*PAGES, ROOT / "install.py", *(ROOT / "neuros").rglob("*.py"))
    said = {
        (str(file.relative_to(ROOT)), versions)
        for file in files
        for versions in re.findall(r"Python (3\.\d+) to (3\.\d+)", file.read_text("utf-8"))
    }
    assert {name for name, _ in said} >= {"README.md", "install.py", "docs/tutorial.md"}
    assert {versions for _, versions in said} == {(oldest, newest)}
    pyproject = (ROOT / "pyproject.toml").read_text("utf-8")
    assert f'requires-python = ">={oldest}"' in pyproject
    newest_for_nest = dotted((NEWEST_FOR_NEST[0], NEWEST_FOR_NEST[1] + 1))
    assert f"nest-simulator>=3.9,<4; python_version < '{newest_for_nest}'" in pyproject
