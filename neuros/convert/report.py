"""What is wrong with a description, and what of it was not taken over."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from neuros.convert.elements import Element
from neuros.convert.reasons import reason_for
from neuros.errors import DescriptionError, Problem


@dataclass(frozen=True)
class NotTaken:
    """Something in a description that the result does not have, or has otherwise.

    Attributes:
        place: ``file:line`` of the first one.
        path: its path in the document.
        why: the reason, in words.
        count: how many of the same kind there are, for the same reason.
    """

    place: str
    path: str
    why: str
    count: int = 1

    def __str__(self) -> str:
        more = f" (and {self.count - 1} more)" if self.count > 1 else ""
        return f"{self.place}: {self.path}: {self.why}{more}"


class Report:
    """Gathers problems and notes while a description is read."""

    def __init__(self) -> None:
        self.problems: list[Problem] = []
        self._notes: list[tuple[Element, str]] = []

    def problem(self, element: Element, text: str, hint: str = "") -> None:
        """Something that makes a conversion impossible."""
        self.problems.append(element.problem(text, hint))

    def note(self, element: Element, why: str) -> None:
        """Something that is not taken over, or not as it is; it counts as read."""
        element.take_all()
        self._notes.append((element, why))

    def remark(self, element: Element, why: str) -> None:
        """The same about something whose children are still to be read."""
        element.taken = True
        self._notes.append((element, why))

    def note_unread(self, roots: Iterable[Element]) -> None:
        """Note the topmost elements that nobody has read."""
        for root in roots:
            for child in root.children:
                if not child.taken:
                    self.note(child, reason_for(child.tag))
            self.note_unread(root.children)

    def raise_any(self) -> None:
        """Raise ``DescriptionError`` with all problems, if there are any."""
        if self.problems:
            raise DescriptionError(self.problems)

    def not_taken(self) -> Sequence[NotTaken]:
        """The notes in the order of their places, equal ones of one kind as one."""
        notes = sorted(self._notes, key=lambda note: (str(note[0].file), note[0].line))
        groups: dict[tuple[str, str, str], list[Element]] = {}
        for element, why in notes:
            groups.setdefault((str(element.file), element.kind, why), []).append(element)
        return [
            NotTaken(elements[0].place, elements[0].path, why, len(elements))
            for (_, _, why), elements in groups.items()
        ]
