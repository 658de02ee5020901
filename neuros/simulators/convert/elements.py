"""XML elements with their file and line, and a mark once they have been read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from neuros.errors import Problem
from neuros.project.scanner import display_name


@dataclass(eq=False)
class Element:
    """An XML element and its place.

    Attributes:
        text: what stands in it, without the white space around.
        taken: whether it has been read; elements never read are listed as not taken over.
    """

    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    column: int
    parent: Element | None = None
    text: str = ""
    children: list[Element] = field(default_factory=list)
    taken: bool = False

    @property
    def path(self) -> str:
        """Its place in the document, as ``model[arm]/link[base]/inertial``."""
        names = [element.step for element in reversed(list(self.and_ancestors()))]
        return "/".join(names[1:] or names)

    @property
    def kind(self) -> str:
        """Its path without names: what all elements of its kind have in common."""
        tags = [element.tag for element in reversed(list(self.and_ancestors()))]
        return "/".join(tags[1:] or tags)

    @property
    def step(self) -> str:
        name = self.attributes.get("name")
        return f"{self.tag}[{name}]" if name else self.tag

    @property
    def place(self) -> str:
        """``file:line``."""
        return f"{display_name(self.file)}:{self.line}"

    @property
    def name(self) -> str:
        return self.attributes.get("name", "")

    def and_ancestors(self) -> Iterator[Element]:
        element: Element | None = self
        while element is not None:
            yield element
            element = element.parent

    def child(self, *tags: str) -> Element | None:
        """The first child with that tag (or at the end of a path of tags), now read."""
        element: Element | None = self
        for tag in tags:
            element = next((c for c in element.children if c.tag == tag), None) if element else None
            if element is not None:
                element.taken = True
        return element

    def each(self, tag: str) -> list[Element]:
        """All children with that tag, now read."""
        found = [child for child in self.children if child.tag == tag]
        for child in found:
            child.taken = True
        return found

    def take_all(self) -> None:
        """Count everything in it as read."""
        self.taken = True
        for child in self.children:
            child.take_all()

    def problem(self, text: str, hint: str = "") -> Problem:
        """Something wrong with it."""
        return Problem(display_name(self.file), self.line, self.column, self.path, text, hint)


class _Builder:
    """Makes elements of what expat reports."""

    def __init__(self, file: Path) -> None:
        self.root: Element | None = None
        self._file, self._open = file, list[Element]()
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._characters

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        parent = self._open[-1] if self._open else None
        line, column = self.parser.CurrentLineNumber, self.parser.CurrentColumnNumber + 1
        element = Element(tag, attributes, self._file, line, column, parent)
        if parent is None:
            self.root = element
        else:
            parent.children.append(element)
        self._open.append(element)

    def _end(self, tag: str) -> None:
        element = self._open.pop()
        element.text = element.text.strip()

    def _characters(self, text: str) -> None:
        if self._open:
            self._open[-1].text += text


def parse(file: Path) -> Element | Problem:
    """The root of an XML file, or why it cannot be read."""
    name = display_name(file)
    builder = _Builder(file)
    try:
        builder.parser.Parse(file.read_bytes(), True)
    except OSError as error:
        return Problem(name, 1, 1, "/", f"cannot be read: {error.strerror}")
    except (expat.ExpatError, ValueError) as error:
        line = getattr(error, "lineno", 1)
        column = getattr(error, "offset", 0) + 1
        text = expat.ErrorString(error.code) if isinstance(error, expat.ExpatError) else str(error)
        return Problem(name, line, column, "/", f"this is no XML: {text}")
    if builder.root is None:  # expat reports an empty document itself
        return Problem(name, 1, 1, "/", "this is no XML: no element found")
    return builder.root
