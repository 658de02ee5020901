"""Why an environment cannot be made, in one sentence with the cause and what to do."""

from __future__ import annotations

import errno
import re
from collections.abc import Sequence
from pathlib import Path

from neuros.installation.machine import system_install
from neuros.installation.packages import explain_machine

_NONE = re.compile(r"satisfies the requirement (.+?) \(from versions: (.*)\)")
_CONFLICT = re.compile(r"The conflict is caused by:\n((?: {4}.+\n)+)")
_FEW = 5


def why_pip_failed(output: str, python: str, own_needs: Sequence[str]) -> str:
    """What in the output of pip is the cause, for a version of Python as ``3.12``.

    ``own_needs`` are the requirements of NeuROS itself that pip was given, too.
    """
    if sentence := explain_machine(output, again="launch"):
        return sentence
    if none := _NONE.search(output):
        return f"no {none[1]} exists for Python {python} ({_there_is(none[2].split(', '))})"
    if conflict := _CONFLICT.search(output):
        rows = "; ".join(row.strip() for row in conflict[1].splitlines())
        own = [need for need in own_needs if re.search(rf"\b{_name_of(need)}\b", rows)]
        return f"these exclude each other: {rows}" + "".join(f"; NeuROS needs {n}" for n in own)
    errors = re.findall(r"^ERROR: (.+)", output, re.MULTILINE)
    return errors[0] if errors else "pip failed"


def why_no_venv(output: str, python: str) -> str:
    """What in the output of ``venv`` is the cause."""
    if re.search(r"ensurepip|No module named '?venv", output):
        remedy = system_install(apt=f"python{python}-venv", dnf="python3-pip")
        return f"Python {python} has no venv: {remedy}"
    rows = output.splitlines() or ["venv failed"]
    return explain_machine(output) or rows[-1]


def why_no_files(error: OSError, cache: Path) -> str:
    """What is wrong with the folder of the cache."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"the disk of {cache} is full: make room (df -h), or set XDG_CACHE_HOME"
    return f"{error.filename or cache}: {error.strerror}: set XDG_CACHE_HOME to another folder"


def _there_is(versions: Sequence[str]) -> str:
    if list(versions) == ["none"]:
        return "pip finds none of that name"
    more = "..., " if len(versions) > _FEW else ""
    return f"there is {more}{', '.join(versions[-_FEW:])}"


def _name_of(requirement: str) -> str:
    match = re.match(r"[\w.-]+", requirement)
    return re.escape(match[0]) if match else ""
