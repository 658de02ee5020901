"""Policies as functions of arrays: ONNX by onnxruntime, and those of LeRobot by that library."""

from __future__ import annotations

import hashlib
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from neuros.distribution import install_command
from neuros.errors import NodeError

Dimensions: TypeAlias = "tuple[int | None, ...]"
Values: TypeAlias = "Mapping[str, Any]"

LEROBOT = "lerobot:"
_POINTER = b"version https://git-lfs"
_TYPES: Mapping[str, str] = {
    "float": "float32",
    "double": "float64",
    "float16": "float16",
    "bool": "bool",
    **{f"{kind}{size}": f"{kind}{size}" for kind in ("int", "uint") for size in (8, 16, 32, 64)},
}
"""The element types of ONNX that NumPy has, without texts and complex numbers."""


class PolicyError(NodeError):
    """What is wrong with a policy, for the user; ``hint`` says what to do."""

    def __init__(self, text: str, hint: str = "") -> None:
        self.text, self.hint = text, hint
        super().__init__(f"{text}: {hint}" if hint else text)


@dataclass(frozen=True)
class Tensor:
    """An input or output of a policy.

    Attributes:
        shape: sizes of its axes; ``None`` for one of any size.
        dtype: of NumPy, by name; in another form if NumPy has none.
    """

    name: str
    shape: Dimensions
    dtype: str

    @property
    def is_numeric(self) -> bool:
        return self.dtype in _TYPES.values()

    def __str__(self) -> str:
        sizes = ",".join("?" if size is None else str(size) for size in self.shape)
        return f"'{self.name}' {self.dtype}[{sizes}]"


class Model(ABC):
    """A policy.

    Attributes:
        inputs, outputs: by name, in the order of the policy.
        sha256: of its file; of all its files, if it has several.
    """

    inputs: Mapping[str, Tensor]
    outputs: Mapping[str, Tensor]
    sha256: str

    @abstractmethod
    def reset(self) -> None:
        """Forget what came before, as at the beginning of an episode."""

    @abstractmethod
    def run(self, values: Values) -> Values:
        """The outputs for these inputs; raises :class:`PolicyError`."""


def open_model(name: str, task: str = "") -> Model:
    """The policy in a file, or ``lerobot:`` with a folder or the name of a repository.

    Args:
        task: in a sentence, for a policy of LeRobot that asks for one.

    Raises:
        PolicyError: there is none, or its library is not installed.
    """
    if not name.startswith(LEROBOT):
        return OnnxModel(Path(name))
    from neuros_learn.policies.lerobot import LeRobotModel

    return LeRobotModel(name.removeprefix(LEROBOT), task)


class OnnxModel(Model):
    """A policy in ONNX, computed by one thread: equal inputs give equal bits."""

    def __init__(self, file: Path) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise PolicyError(
                "policies in ONNX need onnxruntime, which is not installed", install_command("onnx")
            ) from None
        try:
            data = file.read_bytes()
        except OSError as error:
            raise PolicyError(f"{file.name} cannot be read ({error.strerror})") from None
        if data.startswith(_POINTER):
            text = f"{file.name} is a pointer of Git LFS, not the policy itself"
            raise PolicyError(text, "get it with `git lfs pull`")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = 4  # what is wrong is raised
        try:
            # By its path: large weights may be in files beside it.
            self._session = onnxruntime.InferenceSession(
                str(file), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # the exceptions of onnxruntime have no class in common
            raise _unreadable(file.name, str(error)) from None
        self.inputs = {each.name: _tensor(each) for each in self._session.get_inputs()}
        self.outputs = {each.name: _tensor(each) for each in self._session.get_outputs()}
        self.sha256 = hashlib.sha256(data).hexdigest()

    def reset(self) -> None:
        """Whoever calls it holds its states."""

    def run(self, values: Values) -> Values:
        try:
            found = self._session.run(None, values)
        except Exception as error:  # the exceptions of onnxruntime have no class in common
            raise PolicyError(f"the policy cannot be computed: {_reason(str(error))}") from None
        return dict(zip(self.outputs, found, strict=True))


def _tensor(argument: Any) -> Tensor:
    kind = re.sub(r"tensor\((\w+)\)", r"\1", argument.type)
    sizes = (size if isinstance(size, int) else None for size in argument.shape)
    return Tensor(argument.name, tuple(sizes), _TYPES.get(kind, kind))


def _unreadable(name: str, text: str) -> PolicyError:
    """The error for a file that onnxruntime refuses."""
    if opset := re.search(r"[Oo]pset (\d+) is under development.*is till opset (\d+)", text):
        return PolicyError(
            f"{name} needs opset {opset[1]} of ONNX, and onnxruntime here knows those up to"
            f" {opset[2]}",
            f"export it with opset_version={opset[2]}, or install a newer onnxruntime",
        )
    if version := re.search(r"[Uu]nsupported model IR version: (\d+).*version: (\d+)", text):
        return PolicyError(
            f"{name} has version {version[1]} of ONNX's format, and onnxruntime here knows those"
            f" up to {version[2]}",
            "export it with an older onnx, or install a newer onnxruntime",
        )
    if "INVALID_PROTOBUF" in text or "No graph was found" in text:
        return PolicyError(f"{name} is not in ONNX, or is damaged", "export or copy it again")
    return PolicyError(f"{name} is refused by onnxruntime: {_reason(text)}")


def _reason(text: str) -> str:
    """An error of onnxruntime without its number and its place in the source."""
    words = text.partition(" : ")[2].partition(" : ")[2].partition(" : ")[2] or text
    words = re.sub(r"^/\S+:\d+ .*?\) (?=\S)", "", " ".join(words.split()))
    return words[:300]


def zeros(tensor: Tensor, size: int = 1) -> Any:
    """Zeros of the shape of a tensor, with ``size`` for each axis of any size."""
    return np.zeros([size if each is None else each for each in tensor.shape], tensor.dtype)
