"""``requirements.txt``: read as pip reads it, and compared with what is installed here.

The format: https://pip.pypa.io/en/stable/reference/requirements-file-format/
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from neuros.errors import EnvironmentFault

if TYPE_CHECKING:
    from packaging.requirements import Requirement

_COMMENT = re.compile(r"(^|\s+)#.*$")
_INCLUDE = re.compile(r"(-r|-c|--requirement|--constraint)(?:\s+|=|(?<=-[rc]))(?P<file>\S.*)")
_OPTION = re.compile(r"\s--?\w.*$")


@dataclass(frozen=True)
class Line:
    """One requirement, or an option of pip.

    Attributes:
        is_constraint: whether it applies only if something else asks for the package.
    """

    text: str
    is_constraint: bool = False


@dataclass(frozen=True)
class Requirements:
    """A ``requirements.txt`` with all files that it includes.

    Attributes:
        digest: changes with the content of any of them.
    """

    file: Path
    lines: tuple[Line, ...]
    digest: str

    @property
    def has_hashes(self) -> bool:
        """Whether pip refuses packages without a hash."""
        return any("--hash" in line.text for line in self.lines)


def read_requirements(file: Path) -> Requirements:
    """Read a file and what it includes.

    Raises:
        EnvironmentFault: if one of them cannot be read.
    """
    digest = hashlib.sha256()
    lines: list[Line] = []
    seen: set[tuple[Path, bool]] = set()

    def read(path: Path, is_constraint: bool) -> None:
        if (path.resolve(), is_constraint) in seen:
            return
        seen.add((path.resolve(), is_constraint))
        text = _text(path)
        digest.update(f"{is_constraint} {len(text)} {text}".encode())
        for row in _rows(text):
            include = _INCLUDE.fullmatch(row)
            if include and "://" not in include["file"]:
                read(path.parent / include["file"], is_constraint or "c" in include[1])
            else:
                lines.append(Line(row, is_constraint))

    read(file, False)
    return Requirements(file, tuple(lines), digest.hexdigest())


def _text(file: Path) -> str:
    try:
        return file.read_text("utf-8-sig")
    except OSError as error:
        raise EnvironmentFault(f"{file} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise EnvironmentFault(f"{file} is not valid UTF-8: save it as UTF-8") from error


def _rows(text: str) -> Iterator[str]:
    """Lines without comments; a backslash at the end joins a line to the next."""
    for row in re.sub(r"\\\r?\n", "", text).splitlines():
        stripped = _COMMENT.sub("", row).strip()
        if stripped:
            yield stripped


def unmet(requirements: Requirements, *, any_version: bool = False) -> list[str]:
    """Requirements that this environment lacks, in words; empty if it lacks none.

    Args:
        any_version: whether it is enough that a package is there.
    """
    found = [
        lack
        for line in requirements.lines
        if not line.text.startswith("-") or line.text.startswith(("-e", "--editable"))
        for lack in _lacks(line, any_version)
    ]
    return list(dict.fromkeys(found))


def _lacks(line: Line, any_version: bool) -> Iterator[str]:
    from packaging.requirements import InvalidRequirement, Requirement

    text = _OPTION.sub("", line.text)
    try:
        requirement = Requirement(text)
    except InvalidRequirement:  # a path, an address, or a mistake: pip knows
        yield line.text
        return
    pending, seen = [(requirement, "")], {""}
    while pending:
        wanted, extra = pending.pop()
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": extra}):
            continue
        installed = _installed(wanted.name)
        if installed is None:
            if not line.is_constraint:
                yield f"{_without_marker(wanted)} (not installed)"
            continue
        if not (any_version or _fits(wanted, installed)):
            yield f"{_without_marker(wanted)} ({installed.version} is installed)"
            continue
        # What an extra adds is a requirement, too; other dependencies came with the package.
        for name in wanted.extras - seen:
            seen.add(name)
            needs = [Requirement(need) for need in installed.requires or () if "extra" in need]
            pending += [(need, name) for need in needs]


def _installed(name: str) -> importlib.metadata.Distribution | None:
    """A package of this environment; ``None`` also for what an interrupted pip has left of one."""
    try:
        found = importlib.metadata.distribution(name)
        return found if found.version else None
    except (importlib.metadata.PackageNotFoundError, FileNotFoundError, KeyError):
        return None


def _fits(wanted: Requirement, installed: importlib.metadata.Distribution) -> bool:
    if wanted.url:
        origin = installed.read_text("direct_url.json")
        return origin is not None and json.loads(origin).get("url") == wanted.url
    return wanted.specifier.contains(installed.version, prereleases=True)


def _without_marker(wanted: Requirement) -> str:
    return str(wanted).partition(";")[0].strip()
