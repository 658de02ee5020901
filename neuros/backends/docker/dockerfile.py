"""Parses Dockerfiles: instructions, stages, and the images that they begin from."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import takewhile
from types import MappingProxyType

_VARIABLE = re.compile(r"\$(?:\{(\w+)(?::-([^}]*))?\}|(\w+))")
_HEREDOC = re.compile(r"(?:^|\s)\d*<<(-?)([\"']?)([A-Za-z_][\w.-]*)\2(?=[\s;|&)]|$)")
_WITH_HEREDOCS = ("RUN", "COPY", "ADD")
_NOTHING: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class Instruction:
    """One instruction.

    Attributes:
        name: in capital letters.
        text: the rest of the instruction on one line, without heredocs.
        first: the number of its first line, from 1.
        last: the number of its last line, with heredocs.
    """

    name: str
    text: str
    first: int
    last: int


def instructions(text: str) -> Iterator[Instruction]:
    """The instructions of a Dockerfile, in order."""
    lines = text.splitlines()
    # Parser directives come before all other lines.
    directives = takewhile(lambda line: re.match(r"#\s*\w+\s*=", line), lines)
    found = (re.match(r"#\s*escape\s*=\s*(\S)", line, re.IGNORECASE) for line in directives)
    escape = next((match[1] for match in found if match), "\\")
    at = 0
    while at < len(lines):
        parts: list[str] = []
        first, goes_on = at, True
        while goes_on and at < len(lines):
            line = lines[at].strip()
            at += 1
            if not line or line.startswith("#"):
                goes_on = bool(parts)  # within an instruction they do not count
                continue
            goes_on = line.endswith(escape)
            parts.append(line[:-1].strip() if goes_on else line)
        name, _, rest = " ".join(parts).partition(" ")
        name, rest = name.upper(), rest.strip()
        for strips, _quote, end in _HEREDOC.findall(rest) if name in _WITH_HEREDOCS else ():
            while at < len(lines):
                line = lines[at].lstrip("\t") if strips else lines[at]
                at += 1
                if line == end:
                    break
        if name:
            yield Instruction(name, rest, first + 1, at)


def images_in(text: str, arguments: Mapping[str, str] = _NOTHING) -> list[str]:
    """The images in its ``FROM`` lines, in order, without names of its own stages.

    Args:
        arguments: build arguments; they count if the Dockerfile declares them before its first
            ``FROM``.
    """
    values: dict[str, str] = {}
    images: list[str] = []
    stages: set[str] = set()
    for each in instructions(text):
        if each.name == "ARG" and not images:
            for name, default in _declared(each):
                values[name] = arguments.get(name, _filled(default, values))
        if each.name != "FROM":
            continue
        words = [word for word in each.text.split() if not word.startswith("--")]
        image = _filled(words[0], values) if words else ""
        if image not in stages:
            images.append(image)
        if len(words) == 3 and words[1].upper() == "AS":
            stages.add(words[2])
    return images


def arguments_of(text: str) -> set[str]:
    """The names of all declared build arguments."""
    return {
        name for each in instructions(text) if each.name == "ARG" for name, _ in _declared(each)
    }


def after_each_from(text: str, lines: str) -> str:
    """The Dockerfile with ``lines`` after each ``FROM``, for all stages."""
    ends = {each.last for each in instructions(text) if each.name == "FROM"}
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        found += [line, lines] if number in ends else [line]
    return "\n".join(found) + "\n"


def on_images(text: str, tags: Mapping[str, str]) -> str:
    """The Dockerfile with other images in its ``FROM`` lines: ``{name: tag}``."""

    def renamed(match: re.Match[str]) -> str:
        name = match[2].removesuffix(":latest")
        return f"{match[1]}{tags[name]}" if name in tags else match[0]

    head = r"(?i)^([ \t]*(?:FROM[ \t]+(?:--\S+[ \t]+)*|ARG[ \t]+\w+=[\"']?))([^\s\"']+)"
    begins = {each.first for each in instructions(text) if each.name in ("FROM", "ARG")}
    return "".join(
        re.sub(head, renamed, line) if number in begins else line
        for number, line in enumerate(text.splitlines(keepends=True), 1)
    )


def _filled(text: str, values: Mapping[str, str]) -> str:
    return _VARIABLE.sub(lambda m: values.get(m[1] or m[3], "") or m[2] or "", text)


def _declared(instruction: Instruction) -> Iterator[tuple[str, str]]:
    """The names, and the defaults, of the arguments that an ``ARG`` declares."""
    try:
        words = shlex.split(instruction.text)
    except ValueError:  # a quotation mark too many: the engine says so
        words = instruction.text.split()
    for word in words:
        name, _, default = word.partition("=")
        yield name, default
