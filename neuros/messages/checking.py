"""Mistakes in message packages: in their message files, and in how packages fit together.

The grammar is that of rosidl (https://docs.ros.org/en/jazzy/Concepts/Basic/About-Interfaces.html),
and rosidl's parser judges each line. The parser stops at the first mistake and knows no line
numbers: so each line is parsed by itself, and its errors are put into other words. What rosidl
parses, but cannot generate or compile, is a mistake, too.
"""

from __future__ import annotations

import keyword
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from rosidl_adapter.parser import (
    PRIMITIVE_TYPES,
    Constant,
    Field,
    InvalidValue,
    Type,
    is_valid_message_name,
    is_valid_package_name,
)

from neuros.errors import Problem
from neuros.messages.package import MANIFEST, Package, problem_at
from neuros.messages.workspace import Workspaces
from neuros.project.message_types import similar_package
from neuros.project.suggest import did_you_mean

_PARTS = {".msg": 1, ".srv": 2, ".action": 3}
_SEPARATOR = "---"
_ROS_1 = {"time": "builtin_interfaces/Time", "duration": "builtin_interfaces/Duration"}
_A_LINE = "a type and a name, as 'float64 angle'"
_A_TYPE = (
    "bool, byte, char, int8 to int64, uint8 to uint64, float32, float64, string, wstring or"
    " package/Message, optionally followed by [], [3] or [<=3]"
)
_A_PACKAGE = "a letter, then letters, digits and single '_', all lower case, as 'rover_msgs'"
_A_FIELD = "a letter, then letters, digits and single '_', all lower case, as 'joint_positions'"
_A_CONSTANT = "upper case letters, digits and single '_', as 'MAX_SPEED'"
# Names of fields become names in C, so these are reserved.
_C = re.compile(
    "auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if|"
    "inline|int|long|register|restrict|return|short|signed|sizeof|static|struct|switch|typedef|"
    "union|unsigned|void|volatile|while"
)
_CPP = re.compile(
    "alignas|alignof|and_eq|asm|bitand|bitor|bool|catch|char(8|16|32)_t|compl|const_cast|constexpr|"
    "decltype|delete|dynamic_cast|explicit|export|false|friend|mutable|namespace|new|noexcept|"
    "not_eq|nullptr|operator|or_eq|private|protected|public|reinterpret_cast|static_assert|"
    "static_cast|template|this|thread_local|throw|true|typeid|typename|using|virtual|wchar_t|xor|"
    "xor_eq"
)
# Macros of the compiler with GNU's extensions, and of headers that the generated code includes.
_MACROS = re.compile("linux|unix|i386|complex|errno|st_[acm]time|s[ai]_[a-z_]+")


def check(packages: Sequence[Package], workspaces: Workspaces) -> list[Problem]:
    """Everything that is wrong in the files of these packages."""
    problems: list[Problem] = []
    for package in packages:
        if workspaces.ros.has(package.name):
            text = f"found the name '{package.name}' of a package of ROS, expected another"
            problems.append(problem_at(package.folder / MANIFEST, text))
            continue
        if text := package_name_mistake(package.name):
            problems.append(problem_at(package.folder / MANIFEST, text))
        found: list[Problem] = []
        contained: dict[str, set[str]] = {}
        for file in (package.folder / relative for relative in package.files):
            definition = read_definition(package.name, file)
            found += definition.problems
            unknown = (_unknown(package, file, use, workspaces) for use in definition.uses)
            found += [problem for problem in unknown if problem]
            if file.suffix == ".msg":
                names = {use.type.partition("/") for use in definition.uses}
                contained[file.stem] = {name for of, _, name in names if of == package.name}
        if not found:
            try:
                TopologicalSorter(contained).prepare()
            except CycleError as error:
                circle = error.args[1]
                text = f"found a message that contains itself: {' -> '.join(circle)}"
                found.append(problem_at(package.folder / "msg" / f"{circle[0]}.msg", text))
        problems += found
    return problems


def _unknown(package: Package, file: Path, use: Use, workspaces: Workspaces) -> Problem | None:
    of, _, name = use.type.partition("/")
    messages = workspaces.messages(of)
    if messages is None:
        messages = workspaces.ros.messages(of)
    if messages is None:
        known = {*workspaces.packages, *workspaces.ros.message_packages()}
        text = f"found '{use.type}', expected a message of a package that is here"
        similar = similar_package(of, known) or f"there is no package '{of}'."
        hint = f"{similar} If '{of}' exists, put it into the workspace, too"
    elif name not in messages:
        text = f"found '{use.type}', expected a message of '{of}'"
        hint = workspaces.elsewhere(of, name) or did_you_mean(name, messages)
    else:
        return None
    return problem_at(file, text, use.line, use.column, hint)


def undeclared(packages: Sequence[Package]) -> list[Problem]:
    """Packages that message files use and manifests do not name: colcon may not find them."""
    return [
        problem_at(
            package.folder / MANIFEST,
            f"no <depend>{name}</depend>, and message files use '{name}'",
            hint="colcon builds the package only if another dependency brings it",
        )
        for package in packages
        for name in sorted(package.used - package.declared)
    ]


@dataclass(frozen=True)
class Use:
    """The message type of a field, ``package/Name``, and its place in the file."""

    type: str
    line: int
    column: int


@dataclass
class Definition:
    """The content and mistakes of an interface file."""

    uses: list[Use] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)


def package_name_mistake(name: str) -> str:
    """What is wrong with the name of a package; empty if it is right."""
    if not is_valid_package_name(name):
        return f"found the name '{name}', expected {_A_PACKAGE}"
    if keyword.iskeyword(name):
        return f"found the name '{name}', expected one that is not a keyword of Python"
    if name in sys.stdlib_module_names:
        return f"found the name '{name}' of a module of Python, expected another"
    return ""


def read_definition(package: str, file: Path) -> Definition:
    """Read a file of a package; its path has to be absolute."""
    found = Definition()
    if not is_valid_message_name(file.stem) or "_" in file.stem:
        text = (
            f"found the name '{file.name}', expected letters and digits in CamelCase, as 'Joints'"
        )
        found.problems.append(problem_at(file, text))
    try:
        text = file.read_text("utf-8")
    except (OSError, UnicodeError) as error:
        found.problems.append(problem_at(file, f"cannot be read: {error}"))
        return found
    lines = text.splitlines()
    separators = [number for number, line in enumerate(lines, 1) if line == _SEPARATOR]
    needed = _PARTS[file.suffix] - 1
    if len(separators) != needed:
        almost = [n for n, line in enumerate(lines, 1) if re.fullmatch(r"\s*-{2,}\s*", line)]
        last = separators[-1] if separators else len(lines) or 1
        place = next((number for number in almost if number not in separators), last)
        what = {0: "none", 1: f"one line '{_SEPARATOR}'", 2: f"two lines '{_SEPARATOR}'"}[needed]
        text = f"found {len(separators)} lines '{_SEPARATOR}', expected {what}"
        found.problems.append(problem_at(file, text, place))
    for start, end in zip([0, *separators], [*separators, len(lines) + 1], strict=True):
        _read_part(package, file, {n: lines[n - 1] for n in range(start + 1, end)}, found)
    return found


def _read_part(package: str, file: Path, part: dict[int, str], found: Definition) -> None:
    """Read the lines of a part, by their numbers: names must differ within it."""
    names: dict[str, int] = {}
    for number, line in part.items():
        code = line.replace("\t", " ").partition("#")[0].rstrip()
        if not code:
            continue
        try:
            parsed = _parsed(package, code)
        except _Wrong as wrong:
            problem = problem_at(file, wrong.text, number, wrong.column, wrong.hint)
            found.problems.append(problem)
            continue
        column = code.rindex(" " + parsed.name) + 2 if " " + parsed.name in code else 1
        if parsed.name in names:
            text = f"found the name '{parsed.name}' again (see line {names[parsed.name]})"
            found.problems.append(problem_at(file, f"{text}, expected another", number, column))
        names.setdefault(parsed.name, number)
        if isinstance(parsed, Field) and not parsed.type.is_primitive_type():
            type_name = f"{parsed.type.pkg_name}/{parsed.type.type}"
            found.uses.append(Use(type_name, number, 1))


class _Wrong(Exception):
    def __init__(self, found: str, expected: str, column: int = 1, hint: str = "") -> None:
        self.text, self.column, self.hint = f"found {found}, expected {expected}", column, hint
        super().__init__(self.text)


def _parsed(package: str, code: str) -> Field | Constant:
    """The field or constant that a line declares. Raises ``_Wrong``."""
    if code[0] == " ":
        raise _Wrong("a space in front", "the type in the first column")
    type_text, _, rest = code.partition(" ")
    rest = rest.lstrip()
    if not rest:
        raise _Wrong(f"'{code}'", _A_LINE)
    type_ = _type(package, type_text)
    column = code.index(rest, len(type_text)) + 1
    is_constant = "=" in rest
    if is_constant:
        name, _, value = (text.strip() for text in rest.partition("="))
    else:
        name, _, value = rest.partition(" ")
        for language, is_reserved in (
            ("keyword of Python", keyword.iskeyword(name)),
            ("keyword of C", _C.fullmatch(name)),
            ("keyword of C++", _CPP.fullmatch(name)),
            ("macro of C", _MACROS.fullmatch(name)),
        ):
            if is_reserved:
                raise _Wrong(f"the name '{name}'", f"one that is not a {language}", column)
    try:
        if is_constant:
            return Constant(type_text, name, value)
        if type_.is_array and (odd := next((each for each in value if not each.isascii()), "")):
            text = "ASCII, which is all that rosidl can write there"
            raise _Wrong(f"'{odd}' in the default of an array", text, code.index(odd) + 1)
        return Field(type_, name, value.lstrip() or None)
    except _Wrong:
        raise
    except NameError:
        rule = _A_CONSTANT if is_constant else _A_FIELD
        raise _Wrong(f"the name '{name}'", rule, column) from None
    except InvalidValue as error:
        rule = str(error).rpartition(": ")[2].removeprefix("must be ")
        raise _Wrong(f"the value '{value.strip()}' of a {type_text}", rule, column) from None
    except Exception:  # rosidl's parser raises many
        what = "a constant of a primitive type" if is_constant else "no value behind the name"
        raise _Wrong(f"'{code}'", what, column) from None


def _type(package: str, text: str) -> Type:
    if text.partition("[")[0] in _ROS_1:
        raise _Wrong(f"the type '{text}' of ROS 1", f"'{_ROS_1[text.partition('[')[0]]}'")
    try:
        return Type(text, context_package_name=package)
    except Exception:  # of four kinds, and one of them is a mistake in rosidl's parser
        raise _Wrong(
            f"the type '{text}'", _A_TYPE, 1, did_you_mean(text, set(PRIMITIVE_TYPES) - {*_ROS_1})
        ) from None
