"""Builds a message package of others from its definitions, and compares the types with ROS's.

ROS identifies a type by the hash of its description (REP 2011); a package ships those of ROS's own
generators.
"""

from __future__ import annotations

import io
import json
import os
import shutil
from pathlib import Path

from neuros.installation.progress import Progress
from neuros.messages.needed import Messages
from neuros.messages.workspace import Workspaces

_KINDS = ("msg", "srv", "action")


def check_messages(name: str, folder: Path, bench: Path) -> tuple[int, list[str]]:
    """Build a package of a wheel in an empty folder; the number of its types, and problems."""
    (share,) = folder.glob(f"*.data/data/share/{name}")
    own = bench / "workspace" / name
    for file in (share / "package.xml", *(f for kind in _KINDS for f in share.glob(f"{kind}/*"))):
        if file.suffix[1:] in (*_KINDS, "xml"):
            (own / file.relative_to(share)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, own / file.relative_to(share))
    workspaces = Workspaces(own.parent, None, {"XDG_CACHE_HOME": str(bench / "cache")})
    messages = Messages(workspaces, [name])
    if problems := [str(problem) for problem in messages.problems()]:
        return 0, problems
    messages.make(Progress(io.StringIO()), os.environ)
    (built,) = messages.built
    wanted, found = _hashes(share), _hashes(built.share)
    wrong = [kind for kind in found if found[kind] != wanted[kind]]
    return len(found), [f"{kind}: its hash is not ROS's" for kind in wrong]


def _hashes(folder: Path) -> dict[str, str]:
    """The hash of each type that the descriptions within a folder define."""
    result: dict[str, str] = {}
    for file in folder.rglob("*.json"):
        told = json.loads(file.read_text("utf-8"))
        result |= {row["type_name"]: row["hash_string"] for row in told.get("type_hashes", ())}
    return result
