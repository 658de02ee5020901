"""Checks the policy of a node before a run, as far as this Python can."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from neuros.distribution import install_command
from neuros.errors import Problem
from neuros.ports import PluginCheck
from neuros.project.model import Node
from neuros.project.scanner import problem_in
from neuros_learn.policies.lerobot import features, read_config
from neuros_learn.policies.mapping import Mistake, PortMapping, mistakes_in_keys
from neuros_learn.policies.model import LEROBOT, Model, PolicyError, Values, open_model, zeros


class _Described(Model):
    """The policy of LeRobot in a folder, without its weights."""

    def __init__(self, folder: Path) -> None:
        config = read_config(folder)
        self.inputs, self.outputs = features(config, "input"), features(config, "output")

    def reset(self) -> None:
        """It has no states."""

    def run(self, values: Values) -> Values:
        return {name: zeros(tensor) for name, tensor in self.outputs.items()}


class _Check(PluginCheck):
    """Opens the policy and computes it once; of LeRobot, only the description is read."""

    def problems(self, node: Node) -> Iterator[Problem]:
        for each in self._mistakes(node):
            yield _at(node, each)

    def doubts(self, node: Node) -> Iterator[Problem]:
        name = node.environment.get("POLICY", "")
        if name.startswith(LEROBOT):
            if not find_spec("lerobot"):
                hint = "pip install lerobot, or give the node a container that has it"
                yield _at(node, Mistake("/policy", "LeRobot is not installed here", hint))
        elif not find_spec("onnxruntime"):
            text = "the policy cannot be checked before the run"
            hint = f"onnxruntime is not installed: {install_command('onnx')}"
            yield _at(node, Mistake("/policy", text, hint))

    def _mistakes(self, node: Node) -> list[Mistake]:
        name = node.environment.get("POLICY", "")
        try:
            if name.startswith(LEROBOT):
                folder = node.file.parent / name.removeprefix(LEROBOT)
                return (
                    PortMapping(node, _Described(folder)).mistakes
                    if folder.is_dir()
                    else mistakes_in_keys(node)
                )
            if not find_spec("onnxruntime"):
                return mistakes_in_keys(node)
            return PortMapping(node, open_model(name)).mistakes
        except PolicyError as error:
            return [Mistake("/policy", error.text, error.hint), *mistakes_in_keys(node)]


CHECK = _Check()


def _at(node: Node, mistake: Mistake) -> Problem:
    pointer = f"{node.pointer}{mistake.pointer}"
    return problem_in(node.file, pointer, mistake.text, mistake.hint)
