"""What the engine says while it builds an image: kept in a file, shown in part, explained."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

_TAIL_LINES = 12
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")

# The first that fits what was said last tells why.
_CAUSES = (
    (r"no space left on device|\[Errno 28\]", "the disk is full: make room (docker system df)"),
    (
        r"CERTIFICATE_VERIFY_FAILED|x509: certificate",
        "a certificate is not trusted: give your authority's with --ca-bundle FILE",
    ),
    (
        r"ERROR: No matching distribution found for (?P<what>\S+)",
        "there is no package {what} for the Python of this image (or it is not in the wheelhouse):"
        " correct the requirements.txt, or take another Python with --base-image",
    ),
    (
        r"ERROR: ResolutionImpossible|have conflicting dependencies",
        "its requirements.txt cannot be satisfied, as packages in it exclude each other: loosen"
        " their versions",
    ),
    (
        r"E: Unable to locate package (?P<what>\S+)|E: Package '?(?P<also>[\w.+-]+)'? has no",
        "the package sources of its base have no {what}: correct the name, or take another base"
        " with --base-image",
    ),
    (
        r"pull access denied for (?P<what>[^\s,]+)|manifest for (?P<also>\S+) not found",
        "there is no image {what} to begin from: correct the FROM line, or name one that the engine"
        " has with --base-image",
    ),
    (
        r"(?P<what>\S+): pull access denied, repository does not exist",
        "there is no image {what} to begin from: correct the FROM line, or name one that the engine"
        " has with --base-image",
    ),
    (
        r"dockerfile parse error.*unknown flag: (?P<what>[\w-]+)",
        "its Dockerfile uses the option --{what}, which this engine is too old for: install a newer"
        " one, or write the step without",
    ),
    (
        r"Get \"?https?://(?P<what>[^/\"]+)|lookup (?P<also>\S+).* no such host",
        "the registry {what} cannot be reached: check the network and the engine's proxy, or name"
        " an image that the engine has with --base-image",
    ),
    (
        r"Temporary failure in name resolution|Temporary failure resolving|NewConnectionError"
        r"|Network is unreachable|Could not resolve|ConnectTimeout|ReadTimeout|ProxyError",
        "the package index cannot be reached: check the network (behind a proxy: export"
        " HTTPS_PROXY=http://HOST:PORT), or build from a folder of wheels with --wheelhouse DIR",
    ),
    (
        r"ensurepip is not available|No module named '?(venv|ensurepip)",
        "the Python of its base has no venv: add the package python3-venv to the base",
    ),
    (r"python3: (command )?not found", "its base has no Python: take one with Python 3.10 to 3.14"),
    (
        r"Permission denied|are you root\?",
        "a step may not write: images of NeuROS run as an ordinary user, so put USER 0 above it",
    ),
    (
        r"COPY failed|ADD failed|(compute cache key|calculate checksum).*: not found",
        "a file that its Dockerfile copies is not beside it",
    ),
)


class BuildLog:
    """The output of a build, as it comes.

    Args:
        file: keeps all of it.
        show: is called with each step.
    """

    def __init__(self, file: Path, show: Callable[[str], object]) -> None:
        self._file, self._show = file, show
        self._lines: list[str] = []
        self._begun = ""  # a line of which the rest is still to come

    def follow(self, stream: Iterable[Mapping[str, Any]]) -> str | None:
        """Read a build to its end; returns the id of the image, ``None`` if it failed."""
        image = None
        with self._file.open("a", encoding="utf-8") as file:
            for message in stream:
                text = str(message.get("stream") or message.get("error") or "")
                file.write(text)
                image = message.get("aux", {}).get("ID", image)
                if "error" in message:
                    self._take("\n" * bool(self._begun) + text + "\n")
                    return None
                self._take(text)
        self._take("\n")
        return image

    @property
    def tail(self) -> list[str]:
        """The last lines."""
        return self._lines[-_TAIL_LINES:]

    @property
    def cause(self) -> str:
        """Why it failed, in a sentence."""
        text = "\n".join(self._lines[-40:])
        for pattern, sentence in _CAUSES:
            if match := re.search(pattern, text, re.IGNORECASE):
                names = match.groupdict()
                return sentence.format(what=names.get("what") or names.get("also"))
        return self._lines[-1] if self._lines else "the engine does not say why"

    def _take(self, text: str) -> None:
        *lines, self._begun = (self._begun + text).split("\n")
        for line in _COLOURS.sub("", "\n".join(lines)).splitlines():
            if line.strip():
                self._lines.append(line.rstrip())
                if line.startswith("Step ") or re.match(r"\s*(Collecting|Downloading)", line):
                    self._show(line.strip())
