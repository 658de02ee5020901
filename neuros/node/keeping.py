"""Values that plugins keep beyond a run (``node.keep``), such as weights.

The file of a value is an ``.npz`` file of NumPy. Arrays are entries of it, so ``numpy.load`` shows
them; the entry ``structure.json`` tells where they belong. Nothing in it is ever executed
(``allow_pickle=False``), and equal values give equal files.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuros.errors import NodeError
from neuros.node.failures import as_node_error
from neuros.ordinary_files import write_whole
from neuros.project.suggest import did_you_mean, listed

if TYPE_CHECKING:
    from numpy.typing import NDArray

KEPT, RESTORED = "kept", "restored"
"""Folders in the folder of a node: what it has kept, and what was restored to it."""
SUFFIX = ".npz"
_STRUCTURE = "structure.json"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_NO_WORD = re.compile(r"[^\w.-]+")
_PLAIN = (str, int, float, bool, type(None))
_ALLOWED = (
    "give a NumPy array, bytes, str, int, float, bool or None, or a list of these, or a dict of"
    " these with keys of type str"
)
_BROKEN = (
    *(zipfile.BadZipFile, zlib.error, EOFError, RuntimeError),
    *(AttributeError, LookupError, TypeError, ValueError),
)
"""What reading a file of other content raises."""
_Get = Callable[[], Any]
_Put = Callable[[Any], object]


class Keeping:
    """The values that the plugin of a node keeps, in one life of the node after the other.

    Args:
        node: its name; ``folder``: its folder in the run folder.
        restored: names of values in its folder ``restored``, for the first life, and for each that
            takes over nothing else.

    Attributes:
        names: of what the plugin keeps.
    """

    def __init__(self, node: str, folder: Path, restored: Iterable[str]) -> None:
        self._node = node
        self._folder = folder
        self._restored = {name: folder / RESTORED / f"{name}{SUFFIX}" for name in restored}
        self._functions: dict[str, tuple[_Get, _Put]] = {}
        self._earlier: set[str] = set()  # registered in an earlier life
        self._waiting = {**self._restored}

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._functions)

    def register(self, name: str, get: _Get, put: _Put) -> None:
        """Keep a value from now on; one that waits for it is put.

        Raises:
            NodeError: for a name that is none, or is in use.
        """
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise NodeError(f"keep: {name!r} is no name: it may have letters, digits and '_'")
        if not (callable(get) and callable(put)):
            raise NodeError(
                f"keep: '{name}': give a function that returns the value, and one that takes it"
            )
        if name in self._functions and name not in self._earlier:
            raise NodeError(f"keep: '{name}' is kept already: give each value a name of its own")
        self._earlier.discard(name)
        self._functions[name] = get, put
        if name in self._waiting:
            put(self._read(name))

    def values(self) -> dict[str, Any]:
        """A copy of each value, by name. Raises as :meth:`save`."""
        return {name: decoded(self._encoded(name)) for name in self._functions}

    def save(self, name: str) -> None:
        """Write the value of now into the folder ``kept``.

        Raises:
            NodeError: if it cannot be had, is of a type that cannot be kept, or cannot be written.
        """
        data = self._encoded(name)
        try:
            (self._folder / KEPT).mkdir(exist_ok=True)
            write_whole(self._folder / KEPT / f"{name}{SUFFIX}", data)
        except OSError as error:
            raise NodeError(f"keep: '{name}' cannot be written ({error.strerror})") from error

    def begin_anew(self, names: Collection[str], *, forgets: bool) -> None:
        """Save these values for the node after its reset; older files are removed.

        Args:
            forgets: whether the plugin is loaded anew, and registers them again.

        Raises:
            NodeError: as :meth:`save`, and if nothing keeps one of the names.
        """
        for name in names:
            if name not in self._functions:
                raise no_such(self._node, name, self._functions)
            self.save(name)
        files = {name: self._folder / KEPT / f"{name}{SUFFIX}" for name in names}
        for file in {*(self._folder / KEPT).glob(f"*{SUFFIX}")}.difference(files.values()):
            file.unlink()
        self._waiting = {**self._restored, **files}
        if forgets:
            self._functions.clear()
        self._earlier = {*self._functions}

    def restore_waiting(self) -> None:
        """All initialise hooks have run: put what waits, by functions of an earlier life.

        Raises:
            NodeError: if nothing keeps what waits.
        """
        for name in tuple(self._waiting):
            if name not in self._functions:
                raise no_such(self._node, name, self._functions)
            value = self._read(name)
            self._call(name, partial(self._functions[name][1], value))

    def _read(self, name: str) -> Any:
        file = self._waiting.pop(name)
        try:
            return decoded(file.read_bytes())
        except (OSError, ValueError) as error:
            raise NodeError(f"keep: '{name}' cannot be restored: {file}: {error}") from error

    def _encoded(self, name: str) -> bytes:
        return _data_of(name, self._call(name, self._functions[name][0]))

    def _call(self, name: str, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except NodeError:
            raise
        except BaseException as error:
            raise as_node_error(error, f"keep: '{name}': ") from error


def restore_values(values: Mapping[str, Any], folder: Path) -> dict[str, str]:
    """Put values into the folder of a node, for its start; returns ``restored`` of its file.

    Raises:
        NodeError: for a value that cannot be kept.
    """
    sources = {}
    for name, value in values.items():
        (folder / RESTORED).mkdir(parents=True, exist_ok=True)
        file = folder / RESTORED / f"{name}{SUFFIX}"
        file.write_bytes(_data_of(name, value))
        sources[name] = str(file)
    return sources


def _data_of(name: str, value: Any) -> bytes:
    try:
        return encoded(value)
    except (TypeError, RecursionError) as error:
        raise NodeError(f"keep: '{name}'{error}") from None


def no_such(node: str, name: str, known: Iterable[str]) -> NodeError:
    """The error for a value that is to be restored and that no node keeps."""
    names = [*known]
    has = did_you_mean(name, names) or (f"it keeps {listed(names)}" if names else "")
    has = has or "call node.keep in an initialise hook"
    return NodeError(f"nothing in node '{node}' keeps '{name}' ({has})")


def encoded(value: Any) -> bytes:
    """The content of a file for a value.

    Raises:
        TypeError: for what cannot be kept; its text goes on after the name of the value.
    """
    import numpy as np

    arrays: dict[str, NDArray[Any]] = {}
    structure = _taken_apart(value, (), arrays)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        # Entries that are opened by name have no time.
        with archive.open(_STRUCTURE, "w") as entry:
            entry.write(json.dumps(structure).encode())
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, (3, 0), allow_pickle=False)
    return file.getvalue()


def decoded(data: bytes) -> Any:
    """The value in the content of a file; of one by ``numpy.savez`` a dict of its arrays.

    Raises:
        ValueError: if it is none.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = archive.namelist()
            if _STRUCTURE not in names:
                return {name.removesuffix(".npy"): _array(archive, name) for name in names}
            return _put_together(json.loads(archive.read(_STRUCTURE)), archive)
    except _BROKEN as error:
        raise ValueError(f"it is no value that was kept ({error})") from None


def _taken_apart(value: Any, path: tuple[str, ...], arrays: dict[str, NDArray[Any]]) -> Any:
    """A value as JSON; its arrays are added to ``arrays``."""
    import numpy as np

    if isinstance(value, np.generic) and not value.dtype.hasobject:
        value = value.item()
    if type(value) in _PLAIN:
        return {"plain": value}
    if type(value) is dict and all(type(key) is str for key in value):
        parts = {key: _taken_apart(each, (*path, key), arrays) for key, each in value.items()}
        return {"dict": parts}
    if type(value) is list:
        items = enumerate(value)
        return {"list": [_taken_apart(each, (*path, str(n)), arrays) for n, each in items]}
    is_bytes = type(value) is bytes
    if is_bytes:
        value = np.frombuffer(value, np.uint8)
    if type(value) is not np.ndarray or value.dtype.hasobject:
        place = "".join(f"[{key!r}]" for key in path)
        kind = f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")
        of = " of objects" if isinstance(value, np.ndarray) and value.dtype.hasobject else ""
        raise TypeError(f"{place} is a {kind}{of}, which cannot be kept: {_ALLOWED}")
    name = "/".join(_NO_WORD.sub("_", part).lstrip(".") or "_" for part in path) or "value"
    while name in arrays:
        name += "_"
    arrays[name] = value
    return {"bytes" if is_bytes else "array": name}


def _put_together(structure: Any, archive: zipfile.ZipFile) -> Any:
    ((kind, content),) = structure.items()
    if kind == "dict":
        return {key: _put_together(each, archive) for key, each in content.items()}
    if kind == "list":
        return [_put_together(each, archive) for each in content]
    if kind == "plain":
        return content
    array = _array(archive, f"{content}.npy")
    return array.tobytes() if kind == "bytes" else array


def _array(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    import numpy as np

    with archive.open(name) as entry:
        return np.lib.format.read_array(entry, allow_pickle=False)
