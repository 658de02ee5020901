"""XML elements of a description, the files that it names, and the report of unread elements.

Files are named by URIs (``model://``, ``package://``, ``file://``) or paths.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from urllib.parse import unquote
from xml.parsers import expat

from neuros.errors import DescriptionError, Problem
from neuros.project.scanner import display_name, read_bytes

PATH_VARIABLES = (
    "SDF_PATH",
    "GZ_SIM_RESOURCE_PATH",
    "IGN_GAZEBO_RESOURCE_PATH",
    "GAZEBO_MODEL_PATH",
    "ROS_PACKAGE_PATH",
)
_REMOTE = ("http://", "https://", "fuel://")
_SERVERS = ("fuel.gazebosim.org", "fuel.ignitionrobotics.org", "api.ignitionfuel.org")
_FUEL_CACHES = ("GZ_FUEL_CACHE_PATH", "IGN_FUEL_CACHE_PATH")
_OWN_MODELS = Path(__file__).parent / "models"
"""Models that Gazebo ships, and nearly every world of Gazebo Classic includes: the last resort."""
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"
# Comments, and what may hold the characters of a comment without being one.
_COMMENT = re.compile(rb"<!--(?P<comment>.*?)-->|<!\[CDATA\[.*?\]\]>", re.DOTALL)
_BEFORE_DECLARATION = re.compile(
    rb"(?:\xef\xbb\xbf)?(?:\s|<!--.*?-->)*(?=<\?xml\s)|(?:\xef\xbb\xbf)?\s*", re.DOTALL
)
_VISIBLE = re.compile(rb"[^\r\n]")
_DECLARED = re.compile(rb"<\?xml[^>]*\bencoding\s*=", re.DOTALL)
_MOST_BYTES = 64 << 20
_MOST_ELEMENTS = 200_000
_NUMBER = re.compile(
    r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?inf(inity)?", re.ASCII | re.IGNORECASE
)
HUGE = 1e15
"""Above it, limits are none, and other numbers are a mistake."""
_FILE_ELEMENTS = 20  # the cost of opening a file, in elements
DEEPEST = 50
"""Most levels of models within models, and twice that of elements in a file."""
_UNKNOWN = "the converter does not know this element"
_EXTENSION = "an extension of its author's own"
_TAGS_BY_REASON: Mapping[str, str] = {
    "code that runs inside Gazebo; a NeuROS plugin takes its place": "plugin",
    "has to do with how Gazebo draws; MuJoCo draws in its own way": (
        "gui scene cast_shadows visibility_flags meta lighting ambient specular emissive shader"
        " render_order double_sided shininess light_map visualize"
    ),
    "a setting of another physics engine": "ode bullet simbody dart physics joint_physics",
    "the node file says when and where packets go (`rate`, connections)": (
        "update_rate topic always_on enable_metrics optical_frame_id frame_id"
    ),
    "how stiff limits and contacts are is another number in MuJoCo (solref)": (
        "stiffness dissipation"
    ),
    "MuJoCo simulates no such environment": "wind atmosphere enable_wind fluid_added_mass",
    "MuJoCo has no animated actors": "actor",
    "MuJoCo has no populations: include the models one by one": "population",
    "MuJoCo has no roads": "road",
    "MuJoCo has no sound": "audio audio_sink audio_source",
    "MuJoCo has no place on Earth": "spherical_coordinates",
    "a saved state; the model starts in its initial one": "state",
    "how fast it runs is up to the plugin (`run_asynchronous`)": (
        "real_time_factor real_time_update_rate"
    ),
    "MuJoCo limits no number of contacts per geom": "max_contacts",
    "MuJoCo puts bodies to sleep by an option of the whole world": "allow_auto_disable",
    "MuJoCo has damping in joints, not in links": "velocity_decay",
    "every link is a body of its own": "must_be_base_link",
    "MuJoCo moves every body by forces, or by the plugin (mocap)": "kinematic",
    "MuJoCo does not limit the velocity of a joint": "velocity",
    "MuJoCo's contacts bounce by their damping (solref), not by a coefficient": "bounce",
    "MuJoCo has no soft bodies of that kind": "soft_contact",
    "MuJoCo's torsional friction is a length, not a coefficient": "torsional",
    "a friction model of another engine": "friction",
    "MuJoCo's friction has no direction of its own": "fdir1",
    "MuJoCo has no force-dependent slip": "slip1 slip2",
    "MuJoCo's rangefinders measure distances only": "laser_retro",
    "textures and surfaces of Gazebo's renderer": "pbr",
    "MuJoCo has no projectors": "projector",
    "MuJoCo has no batteries": "battery",
    "MuJoCo has no particles": "particle_emitter",
    "a gripper grips by its contacts": "gripper",
    "MuJoCo has one near and one far plane for all cameras (`visual/map`)": "clip",
    "MuJoCo's cameras are pinhole cameras": "distortion lens",
    "record with `launch -r`": "save",
    "MuJoCo adds no noise": "noise",
    "images are rgb8": "format",
    "see `fine_rendering` of neuros.simulators.mujoco.MuJoCo": "anti_aliasing",
    "the orientation is that in the world": "orientation_reference_frame",
    "the orientation is always sent": "enable_orientation",
    "MuJoCo's cameras show colours": "depth_camera",
    "MuJoCo takes a mesh as a whole": "submesh",
    "MuJoCo's actuator has no such setting": "cmd_offset d_gain",
}
_REASONS = {tag: reason for reason, tags in _TAGS_BY_REASON.items() for tag in tags.split()}


@dataclass(frozen=True)
class Difference:
    """A part of a description that the result lacks, or has in another form.

    Attributes:
        place: ``file:line`` of the first one.
        paths: of all elements of this kind with this reason, in the document.
        why: the reason, in words.
    """

    place: str
    paths: Sequence[str]
    why: str

    @property
    def path(self) -> str:
        return self.paths[0]

    @property
    def count(self) -> int:
        return len(self.paths)

    def __str__(self) -> str:
        more = f" (and {self.count - 1} more)" if self.count > 1 else ""
        return f"{self.place}: {self.path}: {self.why}{more}"


class Report:
    """Problems and notes of one conversion, from the elements of all its documents."""

    def __init__(self) -> None:
        self.problems: list[Problem] = []
        self.places: dict[int, Element] = {}  # by the id of the problem
        self.notes: list[tuple[Element, str]] = []
        self._elements = 0

    def count(self, file: Path, elements: int) -> None:
        """Count elements of a file.

        Raises:
            DescriptionError: there are too many in all files. Files can include each other so
                often that reading would never end.
        """
        self._elements += elements
        if self._elements > _MOST_ELEMENTS:
            text = f"with it the description has more than {_MOST_ELEMENTS} elements"
            raise DescriptionError([Problem(display_name(file), 1, 1, "/", text)])

    def omit_unread(self, roots: Iterable[Element]) -> None:
        for root in roots:
            for child in root.children:
                if not child.is_read:
                    is_extension = ":" in child.tag
                    child.omit(_EXTENSION if is_extension else _REASONS.get(child.tag, _UNKNOWN))
            self.omit_unread(root.children)

    def listed(self, before: int) -> bool:
        """Turn all problems after the first ``before`` ones into notes; whether there are any.

        What is only seen changes no physics, so it need not be right.
        """
        found = self.problems[before:]
        del self.problems[before:]
        for problem in found:
            hint = f" ({problem.hint})" if problem.hint else ""
            self.places[id(problem)].omit(f"{problem.text}{hint}")
        return bool(found)

    def raise_any(self) -> None:
        """Raise ``DescriptionError`` with all problems, if there are any."""
        if self.problems:
            raise DescriptionError(self.problems)

    def differences(self) -> Sequence[Difference]:
        """The notes in the order of their places; equal ones are counted together."""
        notes = sorted(self.notes, key=lambda note: (str(note[0].file), note[0].line))
        groups: dict[tuple[str, str, str], list[Element]] = {}
        for element, why in notes:
            groups.setdefault((str(element.file), element.kind, why), []).append(element)
        return [
            Difference(elements[0].place, [each.path for each in elements], why)
            for (_, _, why), elements in groups.items()
        ]


@dataclass(eq=False)
class Element:
    """An XML element.

    Attributes:
        text: its text, without the white space around.
        is_read: whether code has asked for it; unread elements are listed as unsupported.
        source: the element of the file that this one is made from, whose place and path it has.
    """

    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    column: int
    report: Report
    parent: Element | None = None
    text: str = ""
    children: list[Element] = field(default_factory=list)
    is_read: bool = False
    source: Element | None = None

    @property
    def name(self) -> str:
        return self.attributes.get("name", "")

    @property
    def type(self) -> str:
        return self.attributes.get("type", "")

    @property
    def path(self) -> str:
        if self.source is not None:
            return self.source.path
        steps = [e.tag + (f"[{e.name}]" if e.name else "") for e in self.and_ancestors()][::-1]
        return "/".join(steps[1:] or steps)

    @property
    def kind(self) -> str:
        """The path without names."""
        if self.source is not None:
            return self.source.kind
        tags = [element.tag for element in self.and_ancestors()][::-1]
        return "/".join(tags[1:] or tags)

    @property
    def place(self) -> str:
        """``file:line``."""
        return f"{display_name(self.file)}:{self.line}"

    def descendants(self) -> Iterator[Element]:
        """This element and all within, in the order of the document."""
        yield self
        for child in self.children:
            yield from child.descendants()

    def and_ancestors(self) -> Iterator[Element]:
        element: Element | None = self
        while element is not None:
            yield element
            element = element.parent

    def made(self, tag: str, *content: Element | str, **attributes: str) -> Element:
        """A new element at the place of this one, without a parent; ``content``: text, children."""
        place = self.file, self.line, self.column, self.report
        element = Element(tag, attributes, *place, source=self.source or self)
        for part in content:
            if isinstance(part, str):
                element.text = part
            else:
                part.parent = element
                element.children.append(part)
        return element

    # ---- children: asking for them marks them as read

    def child(self, *tags: str) -> Element | None:
        """The first child with that tag, or the element at the end of a path of tags."""
        element: Element | None = self
        for tag in tags:
            element = next((c for c in element.children if c.tag == tag), None) if element else None
            if element is not None:
                element.is_read = True
        return element

    def each(self, tag: str) -> list[Element]:
        found = [child for child in self.children if child.tag == tag]
        for child in found:
            child.is_read = True
        return found

    def mark_all_read(self) -> None:
        for element in self.descendants():
            element.is_read = True

    # ---- values; after a problem the default is returned

    def numbers(self, default: Sequence[float], key: str = "") -> tuple[float, ...]:
        """The numbers in its text or attribute ``key``, as many as ``default`` has.

        They may be infinite.
        """
        what = f"{key}: " if key else ""
        words = (self.attributes[key] if key else self.text).split()
        for word in words:
            if not _NUMBER.fullmatch(word):
                hint = "spaces stand between numbers" if "," in word else ""
                self.problem(f"{what}'{word}' is not a number", hint)
                return tuple(default)
        if len(words) != len(default):
            wanted = "a number" if len(default) == 1 else f"{len(default)} numbers"
            self.problem(f"{what}{wanted} must stand here, not {len(words)}")
            return tuple(default)
        return tuple(map(float, words))

    def finite(self, default: Sequence[float], key: str = "") -> tuple[float, ...]:
        """The same, of numbers that a simulator can compute with."""
        values = self.numbers(default, key)
        wrong = next((value for value in values if not abs(value) < HUGE), None)
        if wrong is None:
            return values
        what = f"{key}: " if key else ""
        self.problem(f"{what}a number must be finite, and below {HUGE:g}, not {wrong:g}")
        return tuple(default)

    def vector(self, tag: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """The finite numbers in the child ``tag``, as many as ``default`` has."""
        element = self.child(tag)
        return default if element is None or not element.text else element.finite(default)

    def number(
        self, tag: str, default: float, *, positive: bool = False, least: float = -math.inf
    ) -> float:
        """The number in the child ``tag``; it may be infinite, unless it must be ``positive``."""
        element = self.child(tag)
        if element is None or not element.text:
            return default
        (value,) = element.numbers((default,))
        if positive and not 0 < value < HUGE:
            element.problem(f"must be a positive number, not {value:g}")
            return default
        if value < least:
            element.problem(f"must be at least {least:g}, not {value:g}")
            return default
        return value

    def is_true(self, tag: str, *, default: bool = False) -> bool:
        """The truth value in the child ``tag``."""
        element = self.child(tag)
        if element is None:
            return default
        word = element.text.lower()
        if word not in ("true", "1", "false", "0"):
            element.problem(f"'{element.text}' is neither true nor false")
            return default
        return word in ("true", "1")

    def has(self, attribute: str) -> bool:
        return self.attributes.get(attribute) in ("true", "1")

    def text_of(self, tag: str) -> str:
        """The text of the child ``tag``; empty without it."""
        element = self.child(tag)
        return "" if element is None else element.text

    # ---- report

    def problem(self, text: str, hint: str = "") -> None:
        """Report a problem that makes the conversion impossible."""
        name = display_name(self.file)
        problem = Problem(name, self.line, self.column, self.path, text, hint)
        self.report.problems.append(problem)
        self.report.places[id(problem)] = self

    def omit(self, why: str) -> None:
        """Report that the element is left out; everything within counts as read."""
        self.mark_all_read()
        self.report.notes.append((self, why))

    def remark(self, why: str) -> None:
        """Report a difference; the children are still to be read."""
        self.is_read = True
        self.report.notes.append((self, why))


class _Unwanted(Exception):
    """Well-formed XML that is refused."""


class _Builder:
    """Makes elements from the events of expat."""

    def __init__(self, file: Path, report: Report, skipped_lines: int, encoding: str | None):
        self.root: Element | None = None
        self._file, self._report, self._open = file, report, list[Element]()
        self._texts: list[list[str]] = []
        self.skipped_lines = skipped_lines
        self.parser = expat.ParserCreate(encoding)
        self.parser.buffer_text = True
        self.parser.EntityDeclHandler = self._refuse_entity
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._characters

    @property
    def line(self) -> int:
        return self.parser.CurrentLineNumber + self.skipped_lines

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._report.count(self._file, 1)
        if len(self._open) >= 2 * DEEPEST:
            raise _Unwanted(f"elements are nested more than {2 * DEEPEST} deep")
        parent = self._open[-1] if self._open else None
        line, column = self.line, self.parser.CurrentColumnNumber + 1
        element = Element(tag, attributes, self._file, line, column, self._report, parent)
        if parent is None:
            self.root = element
        else:
            parent.children.append(element)
        self._open.append(element)
        self._texts.append([])

    def _end(self, tag: str) -> None:
        self._open.pop().text = "".join(self._texts.pop()).strip()

    def _characters(self, text: str) -> None:
        if self._open:
            self._texts[-1].append(text)

    def _refuse_entity(self, name: str, *_: object) -> None:
        # Ten entities that name each other ten times expand to 10^9 characters.
        raise _Unwanted(f"it declares the entity '{name}', which is not supported")


def parse(file: Path, report: Report) -> Element | Problem:
    """The root of an XML file, or the problem with it.

    What the readers of Gazebo and ROS accept, and XML forbids, is read, too: ``--`` in a comment,
    space or a comment before the declaration, zero bytes at the end, and bytes that are not UTF-8
    in a file without a declared encoding, which are read as Latin-1.

    Raises:
        DescriptionError: ``report`` has counted too many elements.
    """
    line, column = 1, 1
    report.count(file, _FILE_ELEMENTS)
    try:
        data = read_bytes(file, _MOST_BYTES)
    except OSError as error:
        text = f"cannot be read: {error.strerror or error}"
        return Problem(display_name(file), line, column, "/", text)
    if data.startswith(_LFS_POINTER):
        return Problem(display_name(file), line, column, "/", *_lfs_pointer("it"))
    document = _COMMENT.sub(_blanked, _BEFORE_DECLARATION.sub(b"", data, count=1))
    if document[1:2] != b"\0":  # not UTF-16
        document = document.rstrip(b"\0")
    builder = _Builder(file, report, data.count(b"\n") - document.count(b"\n"), _encoding(document))
    try:
        builder.parser.Parse(document, True)
    except _Unwanted as error:
        line, text = builder.line, str(error)
    except expat.ExpatError as error:
        line, column = error.lineno + builder.skipped_lines, error.offset + 1
        text = f"this is not XML: {expat.ErrorString(error.code)}"
    except (ValueError, LookupError) as error:  # LookupError: unknown encoding
        text = f"this is not XML: {error}"
    else:
        assert builder.root is not None, "expat reports an empty document itself"
        return builder.root
    return Problem(display_name(file), line, column, "/", text)


def _blanked(match: re.Match[bytes]) -> bytes:
    """A comment without its text; lines stay where they are."""
    if match["comment"] is None:
        return match[0]
    return b"<!--" + _VISIBLE.sub(b" ", match["comment"]) + b"-->"


def _encoding(document: bytes) -> str | None:
    """The encoding that the parser is told; ``None``: the declared one, or UTF-8."""
    if document[:2] in (b"\xff\xfe", b"\xfe\xff") or _DECLARED.match(document):
        return None
    try:
        document.decode()
    except UnicodeDecodeError:
        return "iso-8859-1"
    return None


def _lfs_pointer(what: str) -> tuple[str, str]:
    """What is wrong with a file of which Git LFS has left a pointer only, and what to do."""
    return (
        f"{what} is a Git LFS pointer, not the file itself",
        "run `git lfs pull` in its repository",
    )


class NotFound(Exception):
    """A URI without a file; the text names the places searched, the hint what to do."""

    def __init__(self, text: str, hint: str = "") -> None:
        self.hint = hint
        super().__init__(text)


@dataclass(frozen=True)
class Finder:
    """Finds the files of URIs.

    ``model://name/...`` and ``package://name/...`` are searched in ``folders``, then in the folders
    above the file that names them, where neighbouring models lie. A package may also lie in
    ``share`` of a ROS installation. Addresses of Gazebo Fuel are searched in ``caches``, where
    Gazebo keeps what it has downloaded.
    """

    folders: Sequence[Path] = ()
    packages: Sequence[Path] = field(default=())
    caches: Sequence[Path] = ()

    def find(self, uri: str, here: Path) -> Path:
        """The file or folder behind ``uri``, which a file in the folder ``here`` names.

        Raises :class:`NotFound`.
        """
        scheme, colon, rest = uri.partition("://")
        hint = f"name its folder with -I, or in {' or '.join(PATH_VARIABLES[:2])}"
        if not colon:
            candidates = iter([here / uri, *(folder / uri for folder in self.folders)])
        elif uri.startswith(_REMOTE):
            candidates = self._downloaded(unquote(rest))
        elif scheme == "file":
            candidates, hint = iter([Path(unquote(rest)), here / unquote(rest)]), ""
        elif scheme in ("model", "package"):
            candidates = self._by_name(unquote(rest), here, scheme)
            if scheme == "package":
                hint = f"name the folder of the package with -I, or in {PATH_VARIABLES[-1]}"
        else:
            raise NotFound(f"'{uri}': there is no way to look up '{scheme}://'")
        for candidate in candidates:
            if os.path.exists(candidate):  # unlike Path.exists, accepts names of any length
                return candidate.resolve()
        if uri.startswith(_REMOTE):
            raise NotFound(
                f"'{uri}' is on the network, and not among the models that Gazebo has downloaded",
                f"`gz fuel download -u '{uri}'` puts a model of Gazebo Fuel into ~/.gz/fuel, where"
                " it is found; anything else can be downloaded and named by its path",
            )
        raise NotFound(f"'{uri}' cannot be found", hint)

    def find_file(self, uri: str, here: Path) -> Path:
        """The file behind ``uri``; a folder is not found, nor what Git LFS has not fetched."""
        found = self.find(uri, here)
        if not found.is_file():
            raise NotFound(f"'{uri}' is not a file")
        with found.open("rb") as opened:
            if opened.read(len(_LFS_POINTER)) == _LFS_POINTER:
                raise NotFound(*_lfs_pointer(f"'{uri}'"))
        return found

    def _by_name(self, rest: str, here: Path, scheme: str) -> Iterator[Path]:
        name, _, inside = rest.partition("/")
        for folder in (*self.folders, *([] if scheme == "model" else self.packages)):
            yield folder / name / inside
            if folder.name == name:  # the user has named the model's own folder
                yield folder / inside
        for folder in (here, *here.parents):
            yield folder / name / inside
            if folder.name.isdecimal() and folder.parent.name == name.lower():
                yield folder / inside  # Gazebo keeps models of Fuel as name/version
        yield _OWN_MODELS / name / inside

    def _downloaded(self, address: str) -> Iterator[Path]:
        """Where Gazebo keeps ``server/1.0/owner/models/name[/version[/files/...]]`` of Fuel."""
        parts = [part for part in address.split("/") if part]
        if len(parts) < 5 or parts[3] not in ("models", "worlds"):
            return
        server, _, owner, kind, name, *rest = parts
        version, inside = (rest or [""])[0], "/".join(rest[2:])
        # A server that has moved is in the cache under the name it had.
        for cache, host in product(self.caches, (server, *_SERVERS)):
            folder = cache / host / owner.lower() / kind / name.lower()
            if version.isdecimal():
                yield folder / version / inside
            else:
                kept = (child.name for child in folder.glob("[0-9]*") if child.name.isdecimal())
                yield from (folder / each / inside for each in sorted(kept, key=int)[-1:])


def finder(folders: Sequence[Path], environ: Mapping[str, str]) -> Finder:
    """A finder for ``folders`` of the user first, then those of the environment."""
    found = [folder.resolve() for folder in folders]
    for variable in PATH_VARIABLES:
        found += [Path(text) for text in environ.get(variable, "").split(os.pathsep) if text]
    prefixes = environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    home = Path(environ.get("HOME", "~")).expanduser()
    caches = [Path(environ[name]) for name in _FUEL_CACHES if environ.get(name)]
    return Finder(
        tuple(found),
        tuple(Path(text) / "share" for text in prefixes if text),
        (*caches, home / ".gz/fuel", home / ".ignition/fuel"),
    )
