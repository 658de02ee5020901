"""Every error that NeuROS raises on purpose.

::

    NeurosError
    ├── ProjectError        the project files are wrong        exit code 3
    │   └── DescriptionError   ... a robot's description is
    ├── UsageError          the command line is wrong          exit code 2
    ├── EnvironmentFault    something is missing on this machine   exit code 4
    ├── RunError            a run failed
    ├── WrongValue          a message holds what its definition does not allow
    ├── ControlError        a control message is not understood
    └── NodeError           a node failed                      exit code 1
        ├── HookError       ... in a hook of its plugin
        ├── CallbackError   ... in a callback that its plugin has registered with ROS
        ├── PluginError     ... while its plugin was loaded
        ├── ModelError      ... since its simulator cannot be set up as declared
        └── ProtocolError   ... since a neighbour broke the rules of a connection
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import Future

_Result = TypeVar("_Result")

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_NO_COLOUR = re.compile(r"[\x00-\x08\x0b-\x1a\x1c-\x1f\x7f-\x9f]|\x1b(?!\[[0-9;:]*m)")


class NeurosError(Exception):
    """Base of all errors that NeuROS raises on purpose; its text is written for the user."""


def printable(text: str, *, keeps_colours: bool = False) -> str:
    r"""A text that UTF-8 can encode, and that is harmless for a terminal.

    Lone surrogates, as ``'\udc80'``, and control characters are spelt out: names in a project may
    hold them.
    """
    text = text.encode("utf-8", "backslashreplace").decode()
    control = _NO_COLOUR if keeps_colours else _CONTROL
    return control.sub(lambda match: f"\\x{ord(match[0]):02x}", text)


@dataclass(frozen=True, order=True)
class Problem:
    """A problem in a file of a project or message package.

    ``line`` and ``column`` count from 1, and are 0 for a problem without a place in the file;
    ``pointer`` is a JSON pointer (RFC 6901), empty if the file is not JSON.
    """

    file: str
    line: int
    column: int
    pointer: str
    text: str
    hint: str = ""

    def __str__(self) -> str:
        hint = f" ({self.hint})" if self.hint else ""
        pointer = f"{self.pointer}: " if self.pointer else ""
        place = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        if self.file.startswith("--") and self.line == 1:  # an option has one line
            place = f"{self.file}: character {self.column}"
        return f"{place}: {pointer}{self.text}{hint}"


class ProjectError(NeurosError):
    """All problems of a project at once; ``outcome`` is their consequence."""

    outcome = "nothing was started"

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(sorted(set(problems)))
        super().__init__("\n".join(str(problem) for problem in self.problems))


class DescriptionError(ProjectError):
    """All problems of a robot's description (SDF, URDF) at once.

    Their pointers are paths of elements: ``model[arm]/link[hand]``.
    """

    outcome = "nothing was written"


class UsageError(NeurosError):
    """The command line, or a call of the API, is wrong."""


class EnvironmentFault(NeurosError):
    """A package, an engine or an image that the run needs is missing on this machine."""


class RunError(NeurosError):
    """A run failed with ``exit_code``; raised for programs that require a good run."""

    def __init__(self, text: str, exit_code: int) -> None:
        self.exit_code = exit_code
        super().__init__(text)


class WrongValue(NeurosError, ValueError):
    """A message holds a value that its definition does not allow.

    Attributes:
        path: of the field, ``poses[3].position.y``; empty if the packet itself is of another type.
        found: the value and its type, in words.
        allowed: the type of the field and its range, in words.
    """

    def __init__(self, path: str, found: str, allowed: str, packet: str = "the message") -> None:
        self.path, self.found, self.allowed = path, found, allowed
        what = f"field '{path}'" if path else packet
        super().__init__(f"{what} must be {allowed}, but is {found}")


class ControlError(NeurosError):
    """A message on the control channel of a run is not understood."""


class NodeError(NeurosError):
    """A node failed."""


class HookError(NodeError):
    """A hook is declared wrongly, failed, or returned what it must not return.

    ``where`` is ``file:line`` in the plugin: of the hook, or of its line that failed.
    """

    def __init__(self, text: str, *, hook: str = "", where: str = "") -> None:
        self.text, self.hook, self.where = text, hook, where
        super().__init__(
            ": ".join(part for part in (where, hook and f"hook '{hook}'", text) if part)
        )


class CallbackError(NodeError):
    """A ROS callback of a plugin failed; ``where`` is its ``file:line``."""

    def __init__(self, text: str, *, callback: str, where: str) -> None:
        self.callback, self.where = callback, where
        super().__init__(f"{where}: callback '{callback}': {text}")


class PluginError(NodeError):
    """A plugin cannot be imported, or declares no hooks."""


class ModelError(NodeError):
    """A simulator cannot be set up as its node file declares."""


class ProtocolError(NodeError):
    """A neighbour broke the rules of a connection, as if a lossless one lost a packet."""


def results_of(work: Sequence[Future[_Result]]) -> tuple[list[_Result], BaseException | None]:
    """The results of futures, and one error for all those that failed, ``None`` if none did."""
    errors = [error for each in work if (error := each.exception())]
    results = [each.result() for each in work if not each.exception()]
    others = [error for error in errors if not isinstance(error, EnvironmentFault)]
    if others or not errors:
        return results, next(iter(others), None)
    return results, EnvironmentFault("\n".join(dict.fromkeys(map(str, errors))))


NO_WAITING = (
    "NeuROS serves the callbacks of a node itself, between its hooks, so a hook must not wait for"
    " them: let it return, and take an answer with"
    " client.call_async(request).add_done_callback(function)"
)
"""The remedy for a plugin that waits for callbacks of its node."""
