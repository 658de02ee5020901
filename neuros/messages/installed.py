"""The message packages that come with ROS, as they are installed for this Python."""

from __future__ import annotations

import sys
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Ros:
    """An installation of ROS: where its headers, libraries and descriptions are.

    Attributes:
        prefix: holds ``include``, ``lib`` and ``share``; for the wheels it is that of their Python.
    """

    prefix: Path

    @classmethod
    def here(cls) -> Ros:
        """The one of this Python."""
        return cls(Path(sys.prefix))

    @property
    def include(self) -> Path:
        return self.prefix / "include"

    @property
    def lib(self) -> Path:
        return self.prefix / "lib"

    def share(self, package: str) -> Path:
        """The folder of a package with its descriptions, which need not be there."""
        return self.prefix / "share" / package

    def has(self, package: str) -> bool:
        """Whether a package is installed."""
        return (self.share(package) / "package.xml").is_file()

    def messages(self, package: str) -> Collection[str] | None:
        """The names of the messages of a package, ``None`` if there is no such package."""
        if not self.has(package):
            return None
        return {file.stem for file in self.share(package).glob("msg/*.idl")}

    def message_packages(self) -> set[str]:
        """The packages that have messages."""
        return {folder.parent.name for folder in (self.prefix / "share").glob("*/msg")}

    def manifest(self, package: str) -> bytes:
        """What tells one version of a package from another; empty if it is not installed."""
        file = self.share(package) / "package.xml"
        return file.read_bytes() if file.is_file() else b""
