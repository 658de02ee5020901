"""What of a Dockerfile decides about the order of builds: its stages, and what they begin from."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from types import MappingProxyType

_CONTINUED = re.compile(r"\\[ \t]*\n")
_INSTRUCTION = re.compile(r"^[ \t]*(ARG|FROM)[ \t]+(.+?)[ \t]*$", re.IGNORECASE)
_VARIABLE = re.compile(r"\$(?:\{(\w+)(?::-([^}]*))?\}|(\w+))")
_NOTHING: Mapping[str, str] = MappingProxyType({})


def images_in(text: str, arguments: Mapping[str, str] = _NOTHING) -> list[str]:
    """The images that its stages begin from, in order; stages that begin from another are left out.

    ``arguments`` are build arguments; they count where the Dockerfile declares them in front of the
    first ``FROM``, else its own default does.
    """
    values: dict[str, str] = {}
    images: list[str] = []
    stages: set[str] = set()
    for line in _CONTINUED.sub(" ", text).splitlines():
        match = _INSTRUCTION.match(line)
        if match is None:
            continue
        if match[1].upper() == "ARG":
            if not images:
                name, _, default = match[2].partition("=")
                values[name] = arguments.get(name, _filled(_unquoted(default), values))
            continue
        words = [word for word in match[2].split() if not word.startswith("--")]
        image = _filled(words[0], values) if words else ""
        if image not in stages:
            images.append(image)
        if len(words) == 3 and words[1].upper() == "AS":
            stages.add(words[2])
    return images


def arguments_of(text: str) -> set[str]:
    """The names of all build arguments that it declares."""
    return set(re.findall(r"^[ \t]*ARG[ \t]+(\w+)", text, re.IGNORECASE | re.MULTILINE))


def after_each_from(text: str, lines: str) -> str:
    """The Dockerfile with ``lines`` behind each ``FROM``: they count in all of its stages."""
    found = []
    is_from = False
    for line in text.splitlines():
        found.append(line)
        is_from = is_from or bool(re.match(r"[ \t]*FROM[ \t]", line, re.IGNORECASE))
        if is_from and not line.rstrip().endswith("\\"):
            found.append(lines)
            is_from = False
    return "\n".join(found) + "\n"


def on_images(text: str, tags: Mapping[str, str]) -> str:
    """The Dockerfile with other names for the images that it begins from: ``{name: tag}``."""

    def renamed(match: re.Match[str]) -> str:
        name = match[2].removesuffix(":latest")
        return f"{match[1]}{tags[name]}" if name in tags else match[0]

    head = r"(?im)^([ \t]*(?:FROM[ \t]+(?:--\S+[ \t]+)*|ARG[ \t]+\w+=[\"']?))([^\s\"']+)"
    return re.sub(head, renamed, text)


def label_line(labels: Mapping[str, str]) -> str:
    """The instruction that writes labels, all in one step."""
    pairs = (f"{key}={json.dumps(value)}" for key, value in sorted(labels.items()))
    return f"LABEL {' '.join(pairs)}".replace("$", "\\$")


def _filled(text: str, values: Mapping[str, str]) -> str:
    return _VARIABLE.sub(lambda m: values.get(m[1] or m[3], "") or m[2] or "", text)


def _unquoted(text: str) -> str:
    return text.strip().strip("\"'")
