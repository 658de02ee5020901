"""Files that a description names by URI: ``model://``, ``package://``, ``file://``, or a path."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

PATH_VARIABLES = (
    "SDF_PATH",
    "GZ_SIM_RESOURCE_PATH",
    "IGN_GAZEBO_RESOURCE_PATH",
    "GAZEBO_MODEL_PATH",
    "ROS_PACKAGE_PATH",
)
_REMOTE = ("http://", "https://", "fuel://")


class NotFound(Exception):
    """A URI that leads nowhere; the text says where was looked, the hint what to do."""

    def __init__(self, text: str, hint: str = "") -> None:
        self.hint = hint
        super().__init__(text)


@dataclass(frozen=True)
class Finder:
    """Looks up URIs.

    ``model://name/...`` and ``package://name/...`` are looked up in ``folders``, then in the
    folders above the file that names them: there a model lies beside its neighbours. A package may
    also lie in ``share`` of a ROS installation.
    """

    folders: Sequence[Path] = ()
    packages: Sequence[Path] = field(default=())

    def find(self, uri: str, here: Path) -> Path:
        """The file or folder behind ``uri``, which a file in the folder ``here`` names.

        Raises :class:`NotFound`.
        """
        if uri.startswith(_REMOTE):
            raise NotFound(
                f"'{uri}' is on the network", "download it, for instance with `gz fuel download`"
            )
        scheme, colon, rest = uri.partition("://")
        if not colon:
            candidates = iter([here / uri, *(folder / uri for folder in self.folders)])
        elif scheme == "file":
            candidates = iter([Path(unquote(rest)), here / unquote(rest)])
        elif scheme in ("model", "package"):
            candidates = self._by_name(unquote(rest), here, scheme)
        else:
            raise NotFound(f"'{uri}': there is no way to look up '{scheme}://'")
        for candidate in candidates:
            if candidate.exists():
                return candidate.resolve()
        hint = f"name its folder with -I, or in {' or '.join(PATH_VARIABLES[:2])}"
        raise NotFound(f"'{uri}' cannot be found", "" if scheme == "file" else hint)

    def find_file(self, uri: str, here: Path) -> Path:
        """The file behind ``uri``; a folder is not found."""
        found = self.find(uri, here)
        if not found.is_file():
            raise NotFound(f"'{uri}' is no file")
        return found

    def _by_name(self, rest: str, here: Path, scheme: str) -> Iterator[Path]:
        name, _, inside = rest.partition("/")
        for folder in (*self.folders, *([] if scheme == "model" else self.packages)):
            yield folder / name / inside
            if folder.name == name:  # the folder of the model itself was named
                yield folder / inside
        for folder in (here, *here.parents):
            yield folder / name / inside


def finder(folders: Sequence[Path], environ: Mapping[str, str]) -> Finder:
    """The usual one: ``folders`` of the user's own first, then those in the environment."""
    found = [folder.resolve() for folder in folders]
    for variable in PATH_VARIABLES:
        found += [Path(text) for text in environ.get(variable, "").split(os.pathsep) if text]
    prefixes = environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return Finder(tuple(found), tuple(Path(text) / "share" for text in prefixes if text))
