"""The options of all commands, and tables of those that a page asks for."""

from __future__ import annotations

import argparse
import posixpath
import re
import textwrap
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from site_parts.words import as_text, cell

if TYPE_CHECKING:
    from sphinx.application import Sphinx

    from neuros.options import Option

_TABLE = re.compile(r"<!-- options of (\w+) -->")


def page() -> str:
    """Every command with its options, in Markdown."""
    from neuros.cli.main import parser

    introduction = (
        "# Options of all commands\n\nMade from the parser, which prints the same with `--help`. "
        "[Command line](../command_line.md) says what the commands are for.\n"
    )
    return introduction + "".join(_section(each) for each in _commands(parser()))


def _commands(of: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield of
    for action in of._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name in _shown(action):
                yield from _commands(action.choices[name])


def _shown(action: argparse._SubParsersAction[argparse.ArgumentParser]) -> list[str]:
    """The commands for users: the others, which NeuROS starts itself, have no help."""
    return [each.dest for each in action._choices_actions if each.help != argparse.SUPPRESS]


def _section(of: argparse.ArgumentParser) -> str:
    described = f"{as_text(of.description)}\n" if of.description else ""
    rows = [_row(of, action) for action in of._actions if action.help != argparse.SUPPRESS]
    table = "\n".join(["| | |", "| --- | --- |", *(row for row in rows if row)])
    words = " ".join(of.format_usage().removeprefix("usage: ").split())
    usage = textwrap.fill(words, 85, subsequent_indent="    ", break_on_hyphens=False)
    return f"\n## {of.prog}\n\n{described}\n```text\n{usage}\n```\n\n{table}\n"


def _row(of: argparse.ArgumentParser, action: argparse.Action) -> str:
    if isinstance(action, argparse._SubParsersAction):
        names = ", ".join(f"`{name}`" for name in _shown(action))
        return f"| `{action.metavar or 'COMMAND'}` | {names} |"
    formatter = of._get_formatter()
    name = formatter._format_action_invocation(action)
    text = formatter._expand_help(action) if action.help else ""
    return f"| `{cell(name)}` | {cell(as_text(text))} |"


def add_option_tables(app: Sphinx | None, page: str, source: list[str]) -> None:
    """Put a table into a page where it has ``<!-- options of LaunchOptions -->``."""
    source[0] = _TABLE.sub(lambda found: _table(found[1], page), source[0])


def _table(name: str, page: str) -> str:
    """The options of a command that a dataclass declares, and extensions do."""
    from neuros_analysis.options import SweepOptions

    from neuros.api.request import LaunchOptions, Request
    from neuros.options import options_of
    from neuros.registry import LAUNCH

    in_python = {each.name for cls in (Request, SweepOptions) for each in options_of(cls)}
    declared_in = {cls.__name__: cls for cls in (LaunchOptions, SweepOptions)}
    shown = [each for each in options_of(declared_in[name]) if each.flags]
    if name == LaunchOptions.__name__:
        extensions = dict.fromkeys(LAUNCH.load(flag) for flag in LAUNCH)
        shown += [each for extension in extensions for each in extension.options]
    rows = [_option_row(each, page, in_python) for each in shown]
    head = ["| option | in Python | meaning | default |", "| --- | --- | --- | --- |"]
    return "\n".join([*head, *rows])


def _option_row(option: Option, page: str, in_python: Collection[str]) -> str:
    value = f" {option.value_text}" if option.has_value else ""
    flags = ", ".join(f"`{flag}{value}`" for flag in option.all_flags)
    meaning = as_text(option.help.replace("%%", "%"))
    meaning += "; repeatable" if option.is_repeatable else ""
    if option.page:
        file, _, anchor = option.page.partition("#")
        target = posixpath.relpath(f"docs/{file}", str(Path(page).parent))
        meaning += f" ([more]({target}{'#' * bool(anchor)}{anchor}))"
    argument = f"`{option.name}`" if option.name in in_python else ""
    cells = (flags, argument, cell(meaning), cell(as_text(option.default_text)))
    return f"| {' | '.join(cells)} |"
