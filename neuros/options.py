"""Options, each declared once: its flags, its Python argument, its default, and its help.

An option of a command is a field of a frozen dataclass::

    @dataclass(frozen=True, kw_only=True)
    class LaunchOptions:
        duration: float | str | None = option(
            "--duration", metavar="SECONDS", help="end the run after this time"
        )

    add_options(parser, options_of(LaunchOptions))  # neuros launch --duration SECONDS
    LaunchOptions(**values_of(options_of(LaunchOptions), parser.parse_args()))
    LaunchOptions(duration=30)                      # from Python

Plugins that have no such dataclass, for instance back ends, list :class:`Option` objects.
"""

from __future__ import annotations

import argparse
import inspect
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from neuros.project.suggest import did_you_mean

_METADATA = "neuros option"
_Arguments = ParamSpec("_Arguments")
_Options = TypeVar("_Options")
_Subject = TypeVar("_Subject")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Option:
    """An option of the command line, and the argument of the Python API that it fills.

    Attributes:
        flags: on the command line, as in ``("-n", "--node")``; none: for Python alone. A flag of
            an option that is ``True`` by default switches it off: ``--no-placement``.
        help: text without default, environment variable and "repeatable", which are added.
        name: of the Python argument (default: from the last flag, as ``domain_id``).
        default: the value of a missing option; a ``bool`` makes the option a switch.
        parse: converts the text; its ``ValueError`` is a usage error.
        metavar: the word for the value in help texts.
        choices: the allowed values, or a function that returns them.
        suggestions: a function that returns values for completion; others are allowed.
        is_repeatable: whether the option may occur several times; the value is a tuple.
        is_negatable: whether ``--x`` has a ``--no-x``; the default may then be ``None``.
        variable: an environment variable with the default.
        default_help: the default in words, in place of ``default``.
        group: heading in help texts.
        page: documentation page, as ``placement.md``.
        is_recorded: whether ``run.json`` has the value.
    """

    flags: tuple[str, ...]
    help: str
    name: str = ""
    default: Any = None
    parse: Callable[[str], Any] | None = None
    metavar: str | None = None
    choices: Sequence[str] | Callable[[], Iterable[str]] | None = None
    suggestions: Callable[[], Iterable[str]] | None = None
    is_repeatable: bool = False
    is_negatable: bool = False
    variable: str | None = None
    default_help: str = ""
    group: str = ""
    page: str = ""
    is_recorded: bool = True

    def __post_init__(self) -> None:
        if not self.name:
            if not self.flags:
                raise ValueError(f"an option without flags needs a name: {self.help}")
            last = self.flags[-1].removeprefix("--no-") if self.default is True else self.flags[-1]
            object.__setattr__(self, "name", last.lstrip("-").replace("-", "_"))
        if self.is_repeatable and self.default is None:
            object.__setattr__(self, "default", ())

    @property
    def full_help(self) -> str:
        """The help with the default, and whether the option is repeatable."""
        default = f"default: {self.default_text}" if self.default_text else ""
        also = "; ".join(each for each in ("repeatable" * self.is_repeatable, default) if each)
        return f"{self.help} ({also})" if also else self.help

    @property
    def all_flags(self) -> tuple[str, ...]:
        """The flags, with those that switch the option off."""
        negated = [f"--no-{flag[2:]}" for flag in self.flags if flag.startswith("--")]
        return (*self.flags, *(negated if self.is_negatable else ()))

    @property
    def has_value(self) -> bool:
        """Whether a value follows the flag."""
        return not (self.is_negatable or isinstance(self.default, bool))

    @property
    def value_text(self) -> str:
        """The word for the value in help texts."""
        if self.choices is not None and not self.metavar:
            return "{" + ",".join(self.choices() if callable(self.choices) else self.choices) + "}"
        return self.metavar or self.name.upper()

    @property
    def default_text(self) -> str:
        """The default in words; empty for none, and for a switch that is off."""
        has_default = not isinstance(self.default, bool) and self.default not in (None, ())
        text = self.default_help or (str(self.default) if has_default else "")
        return ", else ".join(part for part in (self.variable, text) if part)

    def value(self, given: Any, environ: Mapping[str, str] | None = None) -> Any:
        """The given value, else that of the environment variable, else the default.

        Raises:
            ValueError: if :attr:`parse` rejects the environment variable.
        """
        if given is not None:
            return given
        environ = os.environ if environ is None else environ
        text = environ.get(self.variable, "") if self.variable else ""
        if not text:
            return self.default
        return self.parse(text) if self.parse else text


def option(*flags: str, help: str, default: Any = None, **declared: Any) -> Any:
    """A field of a dataclass that is an :class:`Option`, named after the field.

    The field is ``None`` by default where an environment variable holds the default.
    """
    declaration = Option(flags, help, name="-", default=default, **declared)
    own_default = declaration.default if declaration.variable is None else None
    return field(default=own_default, metadata={_METADATA: declaration})


def like(declared_in: type, name: str, **changes: Any) -> Any:
    """A field that is the option ``name`` of another dataclass, with ``changes`` to it."""
    (found,) = (each for each in fields(declared_in) if each.name == name)
    changed = replace(found.metadata[_METADATA], **changes)
    return field(default=found.default, metadata={_METADATA: changed})


def options_of(declared_in: Any) -> tuple[Option, ...]:
    """The options that a dataclass declares, in its order."""
    declared = ((each.name, each.metadata.get(_METADATA)) for each in fields(declared_in))
    return tuple(replace(each, name=name) for name, each in declared if each is not None)


def takes(
    options: Callable[_Arguments, _Options],
) -> Callable[
    [Callable[[_Subject, _Options], _Result]],
    Callable[Concatenate[_Subject, _Arguments], _Result],
]:
    """Let a function of a subject and ``options`` take their fields as keyword arguments::

        @takes(LaunchOptions)
        def launch(project: Project, options: LaunchOptions) -> Run: ...

        launch(project, duration=30)

    Type checkers, editors and ``help()`` see the fields with their types.
    """

    def decorate(
        function: Callable[[_Subject, _Options], _Result],
    ) -> Callable[Concatenate[_Subject, _Arguments], _Result]:
        @wraps(function)
        def call(
            subject: _Subject, /, *arguments: _Arguments.args, **named: _Arguments.kwargs
        ) -> _Result:
            for name in named.keys() - known:
                hint = did_you_mean(name, known)
                text = f"{function.__qualname__}() got an unexpected keyword argument '{name}'"
                raise TypeError(f"{text} ({hint})" if hint else text)
            return function(subject, options(*arguments, **named))

        first, *_ = inspect.signature(function).parameters.values()
        known = inspect.signature(options).parameters
        taken = known.values()
        call.__dict__["__signature__"] = inspect.Signature([first, *taken])
        described = []
        for each in options_of(options):
            flag = f"``{each.flags[-1]}``: " if each.flags else ""
            described.append(f"    {each.name}: {flag}{each.full_help}.")
        text = "\n".join([f"{inspect.getdoc(function)}", "", "Args:", *described])
        call.__doc__ = text.replace("%%", "%")  # argparse wants them doubled
        return call

    return decorate


def add_options(
    parser: argparse.ArgumentParser | argparse._ArgumentGroup, options: Iterable[Option]
) -> None:
    """Add options to a parser, each under the heading of its group."""
    groups: dict[str, argparse._ArgumentGroup] = {}
    for each in options:
        if not each.flags:
            continue
        target = parser
        if each.group:
            if each.group not in groups:
                groups[each.group] = parser.add_argument_group(each.group)
            target = groups[each.group]
        keywords = _keywords(each)
        action = target.add_argument(*each.flags, dest=each.name, help=each.full_help, **keywords)
        if each.suggestions is not None:
            vars(action)["completer"] = _completer(each.suggestions)


def _completer(suggestions: Callable[[], Iterable[str]]) -> Callable[..., list[str]]:
    return lambda **_: [*suggestions()]


def _keywords(option: Option) -> dict[str, Any]:
    """Further keywords of ``add_argument`` for an option."""
    if option.is_negatable:
        return {"action": argparse.BooleanOptionalAction, "default": option.default}
    if not option.has_value:
        return {"action": "store_false" if option.default else "store_true"}
    keywords: dict[str, Any] = {"metavar": option.metavar, "type": option.parse}
    if option.choices is not None:
        keywords["choices"] = option.choices() if callable(option.choices) else option.choices
    if option.is_repeatable:
        # argparse copies the default before it appends to it.
        return {**keywords, "action": "append", "default": [*option.default]}
    # The environment is read when the value is used: a program may set it before.
    return {**keywords, "default": None if option.variable else option.default}


def values_of(options: Iterable[Option], parsed: argparse.Namespace) -> dict[str, Any]:
    """The parsed values of options, by Python argument."""
    found = {each.name: getattr(parsed, each.name) for each in options if each.flags}
    return {name: tuple(v) if isinstance(v, list) else v for name, v in found.items()}


def parsed_as(declared_in: Callable[..., _Options], parsed: argparse.Namespace) -> _Options:
    return declared_in(**values_of(options_of(declared_in), parsed))


def recorded_values(declared_in: Any) -> dict[str, Any]:
    """The values of a dataclass with options for ``run.json``; other types become text."""
    recorded = (each.name for each in options_of(declared_in) if each.is_recorded)
    return {name: _as_json(getattr(declared_in, name)) for name in recorded}


def _as_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _as_json(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(each) for each in value]
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def positive_seconds(text: str) -> float:
    """Parse a duration in seconds. Raises ``ValueError``, which argparse reports."""
    seconds = float(text)
    if not 0 < seconds < math.inf:
        raise ValueError(text)
    return seconds


def positive_number(text: str) -> int:
    """Parse a number from 1 on. Raises ``ValueError``, which argparse reports."""
    number = int(text)
    if number < 1:
        raise ValueError(text)
    return number
