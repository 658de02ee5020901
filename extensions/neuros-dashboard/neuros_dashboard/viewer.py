"""Viewers of a run: their interface, their registry, and the choice among them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

from neuros.errors import EnvironmentFault
from neuros.ports import BackEnd, Guardian, Shown
from neuros.registry import Registry


class PreparedViewer(Protocol):
    """A viewer prepared for one run."""

    def start(self, run: Shown, guardian: Guardian) -> str:
        """Open the viewer, once there is a control socket; returns a message for the user.

        Raises ``EnvironmentFault``.
        """

    def finish(self) -> None:
        """Close the viewer, also where it was not started."""


class Viewer(ABC):
    """Shows runs in a window or a page. An entry point of the group ``neuros.viewers``.

    Attributes:
        name: for ``--viewer``; also the name of the entry point.
        place: for messages, as "the dashboard" in "shown in the dashboard".
        ranks: rank by subject: the ``graph`` of a run (``--node-graph``), its ``packets``
            (``--visualisations``). The usable viewer with the highest rank is chosen.
    """

    name: str
    place: str
    ranks: Mapping[str, int] = {}

    @abstractmethod
    def prepare(self, back_end: BackEnd, subject: str | None, port: int | None) -> PreparedViewer:
        """Prepare to show a run of this back end.

        Args:
            subject: the subject to show; ``None`` if the user chose the viewer by name.
            port: the user's wish, for a viewer that serves a page.

        Raises:
            EnvironmentFault: the viewer cannot be used here; the text is a few words.
            UsageError: the port is taken.
        """


VIEWERS: Registry[Viewer] = Registry("neuros.viewers", "viewer", Viewer)


class Views:
    """The viewers that a user asks for.

    Args:
        back_end: of the run.
        names: viewers chosen by name.
        subjects: subjects to show, by the flag that asks for them: the best usable viewer of each
            is chosen.
        port: for a viewer that serves a page.

    Raises:
        UsageError: there is no viewer of a name, or the port is taken.
        EnvironmentFault: a viewer or subject cannot be shown, with the reason.
    """

    def __init__(
        self,
        back_end: BackEnd,
        names: Iterable[str],
        subjects: Mapping[str, str],
        port: int | None = None,
    ) -> None:
        self._back_end = back_end
        self._port = port
        self._views: dict[str, PreparedViewer] = {}
        self._notices: list[str] = []
        for flag, subject in subjects.items():
            self._show(flag, subject)
        for name in names:
            if name not in self._views:
                try:
                    self._prepare(VIEWERS.load(name), None)
                except EnvironmentFault as fault:
                    raise EnvironmentFault(f"viewer {name}: {fault}") from fault

    def start(self, run: Shown, guardian: Guardian, log: Callable[[str, str], None]) -> None:
        """Open windows and pages, once there is a control socket. Raises ``EnvironmentFault``."""
        for notice in self._notices:
            log("INFO", notice)
        for view in self._views.values():
            log("INFO", view.start(run, guardian))

    def finish(self) -> None:
        for view in self._views.values():
            view.finish()

    def _show(self, flag: str, subject: str) -> None:
        able = [each for each in map(VIEWERS.load, VIEWERS) if subject in each.ranks]
        reasons: list[str] = []
        for viewer in sorted(able, key=lambda each: -each.ranks[subject]):
            try:
                self._prepare(viewer, subject)
            except EnvironmentFault as fault:
                reasons.append(str(fault))
                continue
            if reasons:
                why = ", and ".join(reasons)
                self._notices.append(f"{flag}: in {viewer.place}, since {why}")
            return
        raise EnvironmentFault(f"{flag}: {', and '.join(reasons)}")

    def _prepare(self, viewer: Viewer, subject: str | None) -> None:
        self._views[viewer.name] = viewer.prepare(self._back_end, subject, self._port)
