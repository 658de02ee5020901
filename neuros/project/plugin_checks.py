"""Checks that plugins fit their nodes, without running them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from neuros.errors import Problem
from neuros.project.model import Connection, Node
from neuros.project.parsed import ParsedProject
from neuros.project.plugin_files import DeclaredHook, DeclaredPort, PluginFile, Remark, read_plugin
from neuros.project.scanner import display_name
from neuros.project.suggest import did_you_mean

_MOST_FILES = 400
_MOST_FOLDERS = 2000
_VARIABLE = re.compile(r"[A-Za-z_]\w*")
# A variable that is not named by a literal may be any.
_COMPUTED = re.compile(
    r"\benviron\b(?!\s*\[\s*[\"']|\.(?:get|setdefault|pop)\(\s*[\"']|\s*$)|\bgetenv\((?!\s*[\"'])",
    re.MULTILINE,
)
# Read by Python, libraries, drivers, and ROS.
_KNOWN_PREFIXES = (
    *("PYTHON", "LD_", "LC_", "LANG", "TZ", "HOME", "PATH", "TMP", "XDG_", "DISPLAY", "QT_"),
    *("OMP_", "OPENBLAS_", "MKL_", "KMP_", "GOMP_", "BLIS_", "NUMEXPR_", "VECLIB_", "MALLOC_"),
    *("NUMBA_", "TF_", "XLA_", "JAX_", "CUDA", "NVIDIA_", "TORCH_", "PYTORCH_", "HF_", "KERAS_"),
    *("MUJOCO_", "PYOPENGL_", "EGL_", "LIBGL_", "MESA_", "GALLIUM_", "VK_", "__GL", "DRI_"),
    *("ROS_", "RMW_", "RCUTILS_", "RCL_", "FASTRTPS_", "FASTDDS_", "CYCLONEDDS_", "AMENT_"),
    *("NEST_", "MPL", "MATPLOTLIB", "GZ_", "IGN_", "GAZEBO_", "SDF_", "HTTP", "NO_PROXY", "SSL_"),
)


def plugin_problems(
    parsed: ParsedProject, nodes: Sequence[Node], connections: Sequence[Connection] | None
) -> tuple[list[Problem], list[Problem]]:
    """What keeps plugins from running, and what may be a mistake in them.

    Args:
        nodes: made of the elements of the parsed project, in the same order.
        connections: ``None`` where they are not all known.
    """
    problems, doubts = list[Problem](), list[Problem]()
    for node, element in zip(nodes, parsed.nodes, strict=True):
        plugin = read_plugin(node.plugin) if node.plugin != Path() else None
        if plugin is None:
            continue
        problems += _located(plugin, plugin.mistakes)
        doubts += _located(plugin, plugin.doubts)
        lists = (getattr(element.member(side), "value", []) for side in ("inputs", "outputs"))
        if all(isinstance(each, list) for each in lists):
            for hook in plugin.hooks:
                problems += _located(plugin, _misfits(hook, node, connections))
    return problems, doubts


def _misfits(
    hook: DeclaredHook, node: Node, connections: Sequence[Connection] | None
) -> Iterator[Remark]:
    """The ports of a hook that its node does not have, and those that nothing is connected to."""
    for side, declared, known, others in (
        ("input", hook.inputs, node.inputs, node.outputs),
        ("output", hook.outputs, node.outputs, node.inputs),
    ):
        names, other_names = {port.name for port in known}, {port.name for port in others}
        for port in declared or ():
            if port.name is None or "" in names:
                continue
            if port.name not in names:
                hint = did_you_mean(port.name, names)
                if port.name in other_names:
                    hint = f"it has an {'output' if side == 'input' else 'input'} of that name"
                hint = hint or f"it has {', '.join(sorted(names)) or 'none'}"
                text = f"hook '{hook.name}': node '{node.name}' declares no {side} '{port.name}'"
                yield Remark(port.line, port.column, text, hint)
            elif side == "input" and connections is not None and not port.is_optional:
                yield from _unconnected(hook, port, node, connections)


def _unconnected(
    hook: DeclaredHook, port: DeclaredPort, node: Node, connections: Sequence[Connection]
) -> Iterator[Remark]:
    assert port.name is not None
    is_fed = node.input(port.name).external_topic is not None or any(
        (c.destination_node, c.destination_input) == (node.name, port.name) for c in connections
    )
    if not is_fed:
        yield Remark(
            port.line,
            port.column,
            f"hook '{hook.name}': needs input '{port.name}', but nothing is connected to"
            f" {node.name}.{port.name}",
            "connect it, or declare it Optional",
        )


def _located(plugin: PluginFile, remarks: Iterable[Remark]) -> list[Problem]:
    name = display_name(plugin.path)
    return [Problem(name, r.line, r.column, "", r.text, r.hint) for r in remarks]


# ---------------------------------------------------------------------- environment variables


def unread_variables(
    parsed: ParsedProject, nodes: Sequence[Node], overrides: Sequence[str]
) -> Iterator[Problem]:
    """Variables that ``--set`` gives to nodes, and that nothing of the project reads."""
    for text in overrides:
        target, _, value = text.partition("=")
        kind, *steps = target.split(".")
        if kind != "nodes" or len(steps) < 3 or steps[1] != "environment" or not value:
            continue
        key = ".".join(steps[2:])
        node = next((node for node in nodes if node.name == steps[0]), None)
        if node is None or key.startswith(_KNOWN_PREFIXES) or _is_read_by_neuros(key):
            continue
        plugin, sources = read_plugin(node.plugin), _sources(node, parsed.roots.project)
        if plugin is None or sources is None:
            continue
        word = re.compile(rf"(?<!\w){re.escape(key)}(?!\w)", re.IGNORECASE)
        if any(word.search(source) or _COMPUTED.search(source) for source in sources):
            continue
        candidates = {text for text in plugin.texts if _VARIABLE.fullmatch(text)}
        hint = did_you_mean(key, (candidates | {*node.environment}) - {key})
        yield Problem(
            f"--set {text}",
            1,
            1,
            "",
            f"nothing in the plugin of node '{node.name}' reads {key}",
            hint,
        )


def _is_read_by_neuros(key: str) -> bool:
    package = Path(__file__).resolve().parents[1]
    quoted = f'"{key}"'
    return any(quoted in file.read_text("utf-8") for file in package.rglob("*.py"))


def _sources(node: Node, project: Path) -> list[str] | None:
    """The programs of a project; ``None`` where there are too many files to look at."""
    seen = 0
    files = {node.plugin, *([node.script] if node.script else [])}
    for folder in {project, node.plugin.parent}:
        for here, folders, names in os.walk(folder):
            if "pyvenv.cfg" in names or "run.json" in names:
                folders.clear()
                continue
            folders[:] = [name for name in folders if not name.startswith((".", "__"))]
            files |= {Path(here, name) for name in names if name.endswith((".py", ".sh"))}
            seen += 1
            if len(files) > _MOST_FILES or seen > _MOST_FOLDERS:
                return None
    return [file.read_text("utf-8", "replace") for file in files if file.is_file()]
