"""pip: its command, its progress, and explanations of its errors."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from neuros.errors import EnvironmentFault
from neuros.installation.machine import clean_environment, other_python, system_install
from neuros.installation.progress import Progress

LOG = "neuros-install.log"
"""What pip wrote, in ``.venv``."""

_NOTHING: Mapping[str, str] = MappingProxyType({})

PIP_INSTALL = (
    *("-m", "pip", "install", "--disable-pip-version-check", "--no-input"),
    *("--progress-bar", "off", "--prefer-binary"),
)


def pip_settings(options: argparse.Namespace) -> dict[str, str]:
    """What the options ``--wheelhouse`` and ``--ca-bundle`` mean to pip, as its environment."""
    settings: dict[str, str] = {}
    if options.wheelhouse:
        folder = str(Path(options.wheelhouse).absolute())
        settings |= {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": folder}
    if options.ca_bundle:
        settings["PIP_CERT"] = str(Path(options.ca_bundle).absolute())
    return settings


def install(
    python: Path,
    root: Path,
    extras: Sequence[str],
    progress: Progress,
    settings: Mapping[str, str] = _NOTHING,
) -> None:
    """Install the source tree at ``root``, editable, with its extras, for ``python`` (in a venv).

    ``settings`` are added to the environment of pip.

    Raises:
        EnvironmentFault: with a sentence for the user; pip's own output is in a log file.
    """
    folder = python.parent.parent
    free_bytes, need_bytes = shutil.disk_usage(folder).free, _needed_bytes(extras)
    if free_bytes < need_bytes:
        raise EnvironmentFault(
            f"{root} has {free_bytes / 1e9:.1f} GB free and the packages need "
            f"{need_bytes / 1e9:.1f} GB: make room (df -h)"
        )
    log, names = folder / LOG, f"[{','.join(extras)}]"
    source = settings.get("PIP_FIND_LINKS", "PyPI")
    progress.step(f"installing neuros{names} from {source} (log: {log})")
    command = [str(python), *PIP_INSTALL, "--editable", f".{names}"]
    environ = {**clean_environment(os.environ), **settings}
    output = run_pip(command, root, log, progress, environ)
    if output is not None:
        rows = [row.strip() for row in output.splitlines()]
        errors = [row for row in rows if row.lower().startswith(("error", "fatal error"))]
        for row in (errors or rows)[-4:]:
            progress.step(f"  {row[:300]}")
        raise EnvironmentFault(f"{explain_failure(output) or 'pip failed'} (log: {log})")


def run_pip(
    command: Sequence[str], folder: Path, log: Path, progress: Progress, environ: Mapping[str, str]
) -> str | None:
    """Run pip in ``folder`` and show what it does; ``None``, or all that it wrote if it failed.

    Raises:
        OSError: if it cannot be started, or the log cannot be written.
    """
    rows: list[str] = []
    with (
        log.open("w", encoding="utf-8") as file,
        subprocess.Popen(
            command,
            cwd=folder,
            env=environ,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        ) as process,
    ):
        try:
            for row in process.stdout or ():
                file.write(row)
                rows.append(row)
                _show(row, progress)
        except BaseException:
            process.terminate()
            raise
    return "".join(rows) if process.returncode else None


def _show(row: str, progress: Progress) -> None:
    if row.startswith("Installing collected packages"):
        progress.step(f"unpacking {row.count(',') + 1} packages")
    elif re.match(r"\s*(Collecting|Downloading|Building|Running)", row):
        progress.detail(row.partition(" (from ")[0].strip())


def explain_failure(text: str) -> str | None:
    """One sentence, cause and remedy, for what pip or the operating system wrote, where known."""
    sentence = explain_machine(text)
    if sentence is None and re.search("No matching distribution|Could not find a version", text):
        return (
            f"a package does not exist for this Python: run {other_python()} install.py"
            " (with --wheelhouse: or it is not in there)"
        )
    return sentence


def explain_machine(text: str, again: str = "install.py") -> str | None:
    """One sentence for a failure of this machine or its network; ``again`` is what to run then."""
    for pattern, sentence in (
        ("No space left on device|Disk quota exceeded", "the disk is full: make room (df -h)"),
        (
            "CERTIFICATE_VERIFY_FAILED",
            "the certificate of the package index is not trusted: "
            "export PIP_CERT=/path/to/your/authority.pem",
        ),
        (
            "Name or service not known|name resolution|NewConnectionError|ConnectTimeout|"
            "ReadTimeout|ProxyError|Network is unreachable|Max retries exceeded|"
            "Connection refused|Connection reset",
            "the package index https://pypi.org cannot be reached: check the network "
            f"(behind a proxy: export HTTPS_PROXY=http://HOST:PORT), then {again} again",
        ),
        (
            r"(command|unable to execute) '?\S*(gcc|g\+\+|cc|clang)\b|Python\.h: No such file",
            "a package has to be compiled and there is no C compiler: "
            + system_install(apt="build-essential python3-dev", dnf="gcc gcc-c++ python3-devel"),
        ),
        ("Permission denied", "a file cannot be written: sudo chown -R $(id -un) ."),
    ):
        if re.search(pattern, text):
            return sentence
    return None


def _needed_bytes(extras: Sequence[str]) -> float:
    """Room for the packages and for pip's copies of them while it works."""
    per_extra = {"tensorflow": 2.5e9, "dev": 0.2e9, "docs": 0.2e9, "benchmark": 0.4e9}
    return 1.0e9 + sum(per_extra.get(extra, 0.0) for extra in extras)
