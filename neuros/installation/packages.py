"""Installs packages with uv, and uv with pip where it is absent; explains their errors."""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import ssl
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from neuros.distribution import python_command
from neuros.errors import EnvironmentFault
from neuros.installation.machine import (
    IN_DOCKER,
    answer_of,
    clean_environment,
    other_python,
    system_install,
)
from neuros.installation.progress import Progress, run_logged

LOG = "neuros-install.log"
"""What uv and pip wrote, in ``.venv``."""

LOCKS = "requirements"
"""The folder of the lock files, which ``.ci/lock`` writes."""

UV = "uv>=0.9,<1"

_PIP_INSTALL = (
    *("pip", "install", "--disable-pip-version-check", "--no-input"),
    *("--progress-bar", "off", "--only-binary", ":all:"),
)
# As for pip, all indexes count, and not only the first that has a package.
_UV_INSTALL = ("pip", "install", "--index-strategy", "unsafe-best-match")

# Settings of pip, and the variables by which uv takes them.
_IN_UV = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
    "no-cache-dir": "UV_NO_CACHE",
    "trusted-host": "UV_INSECURE_HOST",
    "timeout": "UV_HTTP_TIMEOUT",
    "default-timeout": "UV_HTTP_TIMEOUT",
    "retries": "UV_HTTP_RETRIES",
    "constraint": "UV_CONSTRAINT",
    "cert": "SSL_CERT_FILE",
    "client-cert": "SSL_CLIENT_CERT",
    "proxy": "ALL_PROXY",
}
_OF_NO_EFFECT = {
    *("disable-pip-version-check", "no-input", "no-color", "progress-bar", "quiet", "verbose"),
    *("cache-dir", "log", "prefer-binary", "no-warn-script-location", "no-python-version-warning"),
    *("root-user-action", "break-system-packages", "require-virtualenv", "config-file"),
}
_EXTRA_BYTES = {"tensorflow": 2.5e9, "dev": 0.2e9, "docs": 0.2e9, "benchmark": 0.4e9}


def pip_settings(options: argparse.Namespace) -> dict[str, str]:
    """The environment variables of pip for ``--wheelhouse`` and ``--ca-bundle``."""
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
    environ: Mapping[str, str],
    *,
    newest: bool = False,
) -> None:
    """Install the source tree at ``root``, editable, with its extras, for ``python`` (in a venv).

    Versions and hashes are those of the lock files; without an index (``PIP_NO_INDEX``), or with
    ``newest``, versions are the newest that ``pyproject.toml`` allows.

    Raises:
        EnvironmentFault: with a sentence for the user; the output of uv and pip is in a log file.
    """
    folder = python.parent.parent
    # Room for the packages and for uv's copies of them while it works.
    need_bytes = 1.0e9 + sum(_EXTRA_BYTES.get(extra, 0.0) for extra in extras)
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < need_bytes:
        raise EnvironmentFault(
            f"{root} has {free_bytes / 1e9:.1f} GB free and the packages need "
            f"{need_bytes / 1e9:.1f} GB: make room (df -h)"
        )
    installer = Installer(python, root, folder / LOG, progress, environ)
    installer.log.write_text("", "utf-8")
    extensions = [root / "extensions" / f"neuros-{extra}" for extra in extras]
    sources = [str(root), *(str(folder) for folder in extensions if folder.is_dir())]
    # uv leaves what a file names alone where it is installed and its cache-keys have not changed;
    # arguments it builds each time.
    listed = folder / "neuros-sources.txt"
    listed.write_text("".join(f"-e {Path(source).as_uri()}\n" for source in sources), "utf-8")
    names = f"[{','.join(extras)}]"
    is_without_index = bool(environ.get("PIP_NO_INDEX"))
    source = environ.get("PIP_FIND_LINKS", "a folder") if is_without_index else "PyPI"
    progress.step(f"installing neuros{names} from {source} (log: {installer.log})")
    is_locked = not newest and not is_without_index
    whole = ["--editable", f"{root}{names}", "--requirement", str(listed)]
    calls = [[*whole, *(["--upgrade"] if newest else [])]]
    if is_locked:
        # No build isolation: it would take a setuptools that no lock file names.
        calls = [
            _locked(root, "build"),
            ["--no-build-isolation", *_locked(root, "core", *extras)],
            ["--no-build-isolation", "--no-deps", "--requirement", str(listed)],
        ]
    try:
        installer.require_uv(_locked(root, "uv") if is_locked else [UV])
        for arguments in calls:
            installer.install(arguments)
    except InstallationFailed as failure:
        rows = [row.strip() for row in failure.output.splitlines()]
        errors = [row for row in rows if row.lower().startswith(("error", "cause", "fatal error"))]
        for row in (errors or rows)[-4:]:
            progress.step(f"  {row[:300]}")
        cause = explain_failure(failure.output) or "uv failed"
        raise EnvironmentFault(f"{cause} (log: {installer.log})") from failure


def _locked(root: Path, *names: str) -> list[str]:
    """The arguments that install the packages of some lock files."""
    files = [arg for name in names for arg in ("--requirement", str(root / LOCKS / f"{name}.txt"))]
    return ["--require-hashes", "--no-deps", *files]


def find_uv(python: Path) -> Path | None:
    """The uv beside ``python`` or beside the Python that runs this, or ``None``."""
    folders = (python.parent, Path(sys.executable).parent)
    found = shutil.which("uv", path=os.pathsep.join(map(str, folders)))
    return Path(found) if found else None


def make_venv(command: Sequence[str], environ: Mapping[str, str]) -> str:
    """Run the command that makes a virtual environment; returns the reason of a failure, or ""."""
    python, made = command[0], answer_of(command, clean_environment(environ))
    if made is None or not made.returncode:
        return "" if made else f"{python} cannot be started"
    output = made.stdout + made.stderr
    if re.search(r"ensurepip|No module named '?venv", output):
        version = re.search(r"\d\.\d+$", python) or ("3",)
        remedy = system_install(apt=f"python{version[0]}-venv", dnf="python3-pip")
        return f"{python} has no venv: {remedy}"
    return explain_machine(output) or (output.strip().splitlines() or ["venv failed"])[-1]


class InstallationFailed(Exception):
    """uv or pip failed; ``output`` is all that it wrote."""

    def __init__(self, output: str) -> None:
        super().__init__(output)
        self.output = output


@dataclass(frozen=True)
class Installer:
    """Installs packages for a Python.

    Attributes:
        python: of a virtual environment.
        folder: where uv and pip run.
        log: what they write.
        environ: their environment.
    """

    python: Path
    folder: Path
    log: Path
    progress: Progress
    environ: Mapping[str, str]

    def require_uv(self, what: Sequence[str] = (UV,)) -> Path:
        """The uv to use; where there is none, pip installs it beside Python.

        Raises:
            InstallationFailed: if pip cannot.
            OSError: if pip cannot be started, or the log cannot be written.
        """
        if found := find_uv(self.python):
            return found
        self.progress.detail("installing uv")
        self._run(python_command(*_PIP_INSTALL, *what, python=self.python), self.environ)
        return self.python.with_name("uv")

    def install(self, arguments: Sequence[str], python: Path | None = None) -> str:
        """Run ``uv pip install``, with pip's settings; returns what it wrote.

        Args:
            python: for which Python, if not for this installer's.

        Raises:
            InstallationFailed: if uv fails, or is not there and cannot be installed.
            OSError: if it cannot be started, or the log cannot be written.
        """
        environ = dict(self._settings)
        if "--require-hashes" in arguments:
            # Lock files name every version, and uv refuses a constraint without a hash.
            environ.pop("UV_CONSTRAINT", None)
        command = [str(self.require_uv()), *_UV_INSTALL, "--python", str(python or self.python)]
        # uv has this variable as an option only.
        if environ.get("UV_NO_INDEX", "0").lower() not in ("0", "no", "off", "false"):
            command.append("--no-index")
        return self._run([*command, *arguments], environ)

    @cached_property
    def _settings(self) -> Mapping[str, str]:
        """The environment of uv, which reads none of pip's files and variables: pip lists them."""
        pip = python_command("pip", "config", "list", python=self.python)
        listing = answer_of(pip, self.environ)
        environ, unknown = uv_environment(listing.stdout if listing else "", self.environ)
        if unknown:
            names = ", ".join(unknown)
            self.progress.step(f"uv has no setting like pip's {names}, and goes without")
        return environ

    def _run(self, command: Sequence[str], environ: Mapping[str, str]) -> str:
        """Run pip or uv, show what it does, and return what it wrote."""
        rows: list[str] = []

        def show(row: str) -> None:
            rows.append(row)
            if prepared := re.match(r"Prepared (\d+) packages", row):
                self.progress.step(f"unpacking {prepared[1]} packages")
            elif re.match(r"\s*(Collecting|Downloading|Building)", row):
                self.progress.detail(row.strip())

        if run_logged(command, self.log, show, environ=environ, folder=self.folder):
            raise InstallationFailed("".join(rows))
        return "".join(rows)


def uv_environment(listing: str, environ: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """The environment of uv: ``environ`` with the settings of pip as uv's own variables.

    Variables of uv that the user has set stay. Also returns the settings of pip that uv lacks.

    Args:
        listing: what ``pip config list`` prints.
    """
    rows = re.findall(r"^(global|install|:env:)\.([\w-]+)=(.+)$", listing, re.MULTILINE)
    # A variable comes before a file, and a setting of one command before those of all.
    rows.sort(key=lambda row: ("global", "install", ":env:").index(row[0]))
    found = {_IN_UV[key]: str(ast.literal_eval(value)) for _, key, value in rows if key in _IN_UV}
    unknown = sorted({key for _, key, _ in rows} - _IN_UV.keys() - _OF_NO_EFFECT)
    if links := found.pop("UV_FIND_LINKS", ""):
        # pip ignores a folder that does not exist; for uv it is an error.
        there = [link for link in links.split() if "://" in link or os.path.exists(link)]
        found |= {"UV_FIND_LINKS": ",".join(there)} if there else {}
    if "ALL_PROXY" in found:
        found |= dict.fromkeys(("HTTP_PROXY", "HTTPS_PROXY"), found["ALL_PROXY"])
    settings = {k: v for k, v in found.items() if not (k.startswith("UV_") and environ.get(k))}
    defaults = {"UV_COMPILE_BYTECODE": "1"}  # as pip does, so that no start has to
    if ssl.get_default_verify_paths().cafile:  # authorities of this machine, as for pip
        defaults["UV_SYSTEM_CERTS"] = "1"
    if bundle := environ.get("REQUESTS_CA_BUNDLE") or environ.get("CURL_CA_BUNDLE"):
        defaults["SSL_CERT_FILE"] = bundle
    return {**defaults, **environ, **settings}, unknown


def explain_failure(text: str) -> str | None:
    """Cause and remedy, in one sentence, of an error of uv, pip or the operating system.

    ``None`` for an unknown error.
    """
    if re.search("DO NOT MATCH THE HASHES|Hash mismatch for", text):
        return (
            "a package on the index is not the one that the lock file names, and is not installed:"
            " use another index (export PIP_INDEX_URL=https://pypi.org/simple), or, if you trust"
            " this one, install.py --newest, which uses no lock files"
        )
    if sentence := explain_machine(text):
        return sentence
    if cause := why_unsatisfiable(text):
        remedy = (
            f"run {other_python()} install.py (with --wheelhouse: or it is not in there; with an"
            " index of your own: --newest takes the versions that it has)"
        )
        if "matching platform tag" in cause:
            remedy = f"use Docker, {IN_DOCKER}"
        return f"a package does not exist for this Python or processor ({cause}): {remedy}"
    return None


def why_unsatisfiable(text: str) -> str:
    """Why uv, or pip for uv itself, finds no fitting package; empty for other errors."""
    if found := re.search(r"ERROR: (No matching distribution found for .+)", text):
        return found[1]
    solution = r"No solution found.*?Because (.+?)(?:,\s+we\s+can\s+conclude|\n\n|\Z)"
    found = re.search(solution, text, re.DOTALL)
    return " ".join(found[1].split()) if found else ""


def explain_machine(text: str, again: str = "install.py") -> str | None:
    """Cause and remedy of a failure of this machine or its network; ``again`` is what to run then.

    ``None`` for another error.
    """
    for pattern, sentence in (
        ("No space left on device|Disk quota exceeded", "the disk is full: make room (df -h)"),
        (
            "CERTIFICATE_VERIFY_FAILED|invalid peer certificate",
            "the certificate of the package index is not trusted: "
            "export PIP_CERT=/path/to/your/authority.pem",
        ),
        (
            "Name or service not known|name resolution|NewConnectionError|ConnectTimeout|"
            "ReadTimeout|ProxyError|Network is unreachable|Max retries exceeded|"
            r"Connection refused|Connection reset|client error \(Connect\)|operation timed out",
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
