"""Checks that a schema cannot express: the parts of a project, and its plugins, fit together.

They also work on files that violate the schema elsewhere. They pass over what has the wrong form,
which the schema reports, and guess nothing that depends on it. Plugins are read, not run.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Literal, TypeAlias

from neuros.distribution import EXAMPLES, PACKAGE
from neuros.errors import Problem
from neuros.project.dashboard import dashboard_mistakes
from neuros.project.message_types import normalised
from neuros.project.model import Connection, Node
from neuros.project.names import INTERNAL, MOST_CHARACTERS
from neuros.project.parsed import ENDS, ParsedProject, names_of, rules_of
from neuros.project.plugin_files import DeclaredHook, PluginFile, Remark, read_plugin
from neuros.project.scanner import Element, display_name
from neuros.project.suggest import did_you_mean
from neuros.project.validate import MOST_PROBLEMS

Side = Literal["inputs", "outputs"]
_SIDES: tuple[Side, ...] = ("inputs", "outputs")
_LONGEST_PART = len("/data")
_IMAGE = "sensor_msgs/msg/Image"
_INT64 = 1 << 63
# ROS declares these itself, and passes over what is neither true nor false.
_TRUTH_VALUES = ("use_sim_time", "start_type_description_service")
_STAND_INS: Mapping[str, str] = {"neuros_gazebo": "neuros_mujoco"}
_GAZEBO_PREFIXES = ("GZ_", "IGN_", "GAZEBO_")
_GAZEBO_FOLDERS = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH")
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


def mistakes(parsed: ParsedProject) -> list[Problem]:
    """Everything that does not fit together."""
    checks = (
        _duplicate_nodes,
        _duplicate_ports,
        _duplicate_connections,
        _connection_ends,
        _budget_mistakes,
        dashboard_mistakes,
        _qos_of_connections,
        _rules_without_sense,
        _long_names,
        _parameter_mistakes,
    )
    return [problem for check in checks for problem in islice(check(parsed), MOST_PROBLEMS)]


def remarks(parsed: ParsedProject) -> list[Problem]:
    """What is allowed, but may be a mistake. For a project without mistakes."""
    return sorted([*_gazebo_remarks(parsed), *_unconnected(parsed), *_qos_without_effect(parsed)])


def _all_ports(parsed: ParsedProject) -> Iterator[tuple[Element, Side, str]]:
    """Every port with its side and the name of its node."""
    for node in parsed.nodes:
        for side in _SIDES:
            for port in node.items(side):
                yield port, side, node.string("name") or ""


def _duplicate_nodes(parsed: ParsedProject) -> Iterator[Problem]:
    first: dict[str, tuple[Element, Element]] = {}
    for node, entry in zip(parsed.nodes, parsed.entries, strict=True):
        name = node.string("name")
        if name is None:
            continue
        if name.lower() not in first:
            first[name.lower()] = node, entry
            continue
        other, other_entry = first[name.lower()]
        if other.source.file == node.source.file and other.pointer == node.pointer:
            # One node file, used twice: both names have one place.
            yield entry.problem(f"the node name '{name}' occurs twice", _where(other_entry))
            continue
        text = f"the node name '{name}' occurs twice"
        if other.string("name") != name:
            text = f"the node names '{other.string('name')}' and '{name}' differ only in case"
        yield node.value["name"].problem(text, _where(other, "name"))


def _duplicate_ports(parsed: ParsedProject) -> Iterator[Problem]:
    for node in parsed.nodes:
        for side in _SIDES:
            first: dict[str, Element] = {}
            for port in node.items(side):
                name = port.string("name")
                if name is not None and first.setdefault(name, port) is not port:
                    yield port.value["name"].problem(
                        f"two {side} of the node are named '{name}'", _where(first[name], "name")
                    )


def _duplicate_connections(parsed: ParsedProject) -> Iterator[Problem]:
    first: dict[str, Element] = {}
    for connection in parsed.connections:
        name = _connection_name(connection)
        if name is not None and first.setdefault(name, connection) is not connection:
            yield connection.problem(f"the connection {name} occurs twice", _where(first[name]))


def _connection_ends(parsed: ParsedProject) -> Iterator[Problem]:
    nodes = {node.string("name") or "" for node in parsed.nodes}
    ports = _ports_of(parsed)
    all_known = parsed.is_complete and "" not in nodes
    for connection in parsed.connections:
        found: list[Element] = []
        for node_key, port_key, side in (
            ("source_node", "source_output", "outputs"),
            ("destination_node", "destination_input", "inputs"),
        ):
            name, port = connection.string(node_key), connection.string(port_key)
            if name is None:
                continue
            if name not in nodes:
                if all_known and name:
                    hint = did_you_mean(name, nodes)
                    yield connection.value[node_key].problem(f"there is no node '{name}'", hint)
                continue
            end = _port(ports, name, port, side) if port else None
            if isinstance(end, Element):
                found.append(end)
                if end.member("external_topic") is not None:
                    yield connection.value[port_key].problem(
                        f"{side[:-1]} '{port}' of node '{name}' has an external topic, so it "
                        "cannot be connected",
                        _where(end, "external_topic"),
                    )
            elif end is not None:
                yield connection.value[port_key].problem(*end)
        yield from _different_types(connection, found)
        yield from _compression(connection, found)


_Ports: TypeAlias = "dict[tuple[str, str], dict[str | None, Element]]"


def _ports_of(parsed: ParsedProject) -> _Ports:
    """By node and side, the ports by name; with the name ``None``, not all of them are known."""
    found: _Ports = {}
    for node in parsed.nodes:
        for side in _SIDES:
            ports = found.setdefault((node.string("name") or "", side), {})
            for port in node.items(side):
                ports.setdefault(port.string("name"), port)
            member = node.member(side)
            if member is not None and not isinstance(member.value, list):
                ports.setdefault(None, member)
    return found


def _port(ports: _Ports, node: str, port: str, side: str) -> Element | tuple[str, str] | None:
    """The port of the nodes of one name, or what is wrong with it; ``None`` if that is unknown."""
    names = ports[node, side]
    if port in names:
        return names[port]
    if None in names:
        return None
    other = "outputs" if side == "inputs" else "inputs"
    hint = did_you_mean(port, filter(None, names))
    if port in ports[node, other]:
        hint = f"it has an {other[:-1]} of that name"
    return f"node '{node}' has no {side[:-1]} '{port}'", hint


def _different_types(connection: Element, ends: list[Element]) -> Iterator[Problem]:
    types = [normalised(port.string("type") or "") for port in ends]
    if len(types) == 2 and None not in types and types[0] != types[1]:
        source, destination = ends
        yield connection.problem(
            f"the output sends {types[0]}, the input takes {types[1]}",
            f"{_where(source, 'type')} and {_where(destination, 'type').removeprefix('see ')}",
        )


def _compression(connection: Element, ends: list[Element]) -> Iterator[Problem]:
    transport = connection.members("transport")
    compression, quality = transport.get("compression"), transport.get("quality")
    if compression is None or compression.value != "jpeg":
        if quality is not None:
            yield quality.key_problem("'quality' is that of JPEG", 'add "compression": "jpeg"')
        return
    for port in ends:
        found = normalised(port.string("type") or "")
        if found not in (None, _IMAGE):
            yield compression.problem(f"JPEG is for {_IMAGE}, not {found}", "zstd takes any type")
            return
    if connection.string(ENDS[0]) == connection.string(ENDS[2]):
        yield compression.problem(
            "packets of a node to itself are not sent, so they cannot be encoded", "leave it out"
        )


def _unconnected(parsed: ParsedProject) -> Iterator[Problem]:
    used = {
        (side, connection.string(node), connection.string(port))
        for connection in parsed.connections
        for side, node, port in (("outputs", *ENDS[:2]), ("inputs", *ENDS[2:]))
    }
    for port, side, node in _all_ports(parsed):
        name = port.string("name")
        # A sensor may be read by the plugin alone, for a message of the user's own.
        is_sensor = side == "outputs" and port.member("mujoco") is not None
        if not ((side, node, name) in used or is_sensor or port.member("external_topic")):
            yield port.problem(f"{side[:-1]} '{name}' of node '{node}' is not connected")


def _budget_mistakes(parsed: ParsedProject) -> Iterator[Problem]:
    """Budgets for connections that the project has not."""
    budgets = parsed.root.member("budgets")
    limits = {} if budgets is None else budgets.members("lost_packets")
    names = [_connection_name(connection) for connection in parsed.connections]
    known = [name for name in names if name is not None]
    known_names = {*known}
    for name, member in limits.items():
        if name not in known_names and len(known) == len(names):
            hint = did_you_mean(name, known) or "write 'a.out -> b.in', as `neuros launch` does"
            yield member.key_problem(f"there is no connection '{name}'", hint)


def _connection_name(connection: Element) -> str | None:
    """``a.out -> b.in``, ``None`` if an end is missing."""
    source, output, destination, input_ = (connection.string(end) for end in ENDS)
    if None in (source, output, destination, input_):
        return None
    return f"{source}.{output} -> {destination}.{input_}"


def _where(element: Element, key: str = "") -> str:
    """Where the other one is, for a hint."""
    place = element.value[key] if key else element
    line, column = place.source.place(place.start)
    return f"see {place.source.name}:{line}:{column}"


# ---------------------------------------------------------------------- ROS graph


def _qos_of_connections(parsed: ParsedProject) -> Iterator[Problem]:
    """QoS where there is none to choose."""
    for port, side, _ in _all_ports(parsed):
        qos = port.member("qos")
        if qos is not None and port.member("external_topic") is None:
            yield qos.key_problem(
                f"'qos' is for external topics, but this {side[:-1]} has no external topic",
                "the QoS of a connection follows from its discard_limit and queue_size",
            )


def _qos_without_effect(parsed: ParsedProject) -> Iterator[Problem]:
    for port, _, _ in _all_ports(parsed):
        qos = port.member("qos")
        policies = qos and (qos.string("reliability"), qos.string("durability"))
        if qos is not None and policies == ("best_effort", "transient_local"):
            yield qos.problem(
                "transient_local has no effect with best_effort: a subscriber that comes later"
                " gets nothing",
                "make it reliable",
            )


def _rules_without_sense(parsed: ParsedProject) -> Iterator[Problem]:
    names, remap = names_of(parsed), parsed.root.members("remap")
    nodes = [node.string("name") or "" for node in parsed.nodes]
    for rule in rules_of(parsed):
        only, _, old = rule.rpartition(":")
        if only and only not in nodes and parsed.is_complete:
            yield remap[rule].key_problem(f"there is no node '{only}'", did_you_mean(only, nodes))
        if names.full(old, only).startswith(f"{names.namespace}{INTERNAL}"):
            yield remap[rule].key_problem(
                f"'{old}' is an internal topic of NeuROS and cannot be renamed",
                "a namespace moves all internal topics",
            )


def _long_names(parsed: ParsedProject) -> Iterator[Problem]:
    names = names_of(parsed)
    for port, _, node in _all_ports(parsed):
        topic = port.string("external_topic")
        if topic is not None:
            full = names.resolve(topic, node)
            if len(full) > MOST_CHARACTERS:
                yield port.value["external_topic"].problem(_too_long(full))
    for connection in parsed.connections:
        ends = [connection.string(end) or "" for end in ENDS]
        full = f"{names.namespace}{INTERNAL}{'/'.join(ends)}"
        if len(full) + _LONGEST_PART > MOST_CHARACTERS:
            yield connection.problem(
                _too_long(full), "choose shorter names, or a shorter namespace"
            )


def _too_long(topic: str) -> str:
    return f"the topic {topic} is longer than the {MOST_CHARACTERS} characters that ROS allows"


# ---------------------------------------------------------------------- parameters of ROS


def _parameter_mistakes(parsed: ParsedProject) -> Iterator[Problem]:
    """What ROS has no type for, and names that occur twice."""
    for node in parsed.nodes:
        yield from _group_mistakes(node.members("parameters"), "", {})


def _group_mistakes(
    group: Mapping[str, Element], prefix: str, seen: dict[str, Element]
) -> Iterator[Problem]:
    for name, member in group.items():
        full = prefix + name
        if isinstance(member.value, dict):
            yield from _group_mistakes(member.value, f"{full}.", seen)
            continue
        if seen.setdefault(full, member) is not member:
            yield member.key_problem(f"the parameter '{full}' occurs twice")
        if full in _TRUTH_VALUES and not isinstance(member.value, bool):
            yield member.problem("must be true or false, as ROS declares it")
        values = member.value if isinstance(member.value, list) else [member]
        kinds = {_ros_kind(each.value) for each in values}
        if len(kinds) > 1:
            yield member.problem(
                f"the list has {' and '.join(sorted(kinds))}", "ROS has lists of one kind only"
            )
        for each in values:
            if type(each.value) is int and not -_INT64 <= each.value < _INT64:
                yield each.problem("is too large for an integer of ROS, which has 64 bits")


def _ros_kind(value: object) -> str:
    """What ROS tells apart."""
    if isinstance(value, bool):
        return "truth values"
    if isinstance(value, int | float):
        return "numbers"
    return "texts" if isinstance(value, str) else "other values"


# ---------------------------------------------------------------------- Gazebo, of NeuROS 1.0


def container_in_place_of(name: str) -> str:
    """The container that a node runs in; another one only where Gazebo's was asked for."""
    return _STAND_INS.get(name, name)


def is_for_gazebo(variable: str) -> bool:
    """Whether an environment variable is one of Gazebo's, so that its path need not exist."""
    return variable.startswith(_GAZEBO_PREFIXES)


def _gazebo_remarks(parsed: ParsedProject) -> Iterator[Problem]:
    """What has no meaning here, by node: its container, its environment, its ports."""
    for node in parsed.nodes:
        container = node.string("container") or ""
        if container in _STAND_INS:
            yield node.value["container"].problem(
                f"Gazebo is not supported: the node runs in '{_STAND_INS[container]}' instead of"
                f" '{container}'"
            )
        yield from _gazebo_variables(parsed, node)
        yield from _gazebo_ports(node)


def _gazebo_variables(parsed: ParsedProject, node: Element) -> Iterator[Problem]:
    for name, member in node.members("environment").items():
        if not is_for_gazebo(name):
            continue
        if name not in _GAZEBO_FOLDERS:
            yield member.key_problem(f"'{name}' is for Gazebo and has no effect")
        elif not parsed.roots.finds(member.value, member.source.folder):
            yield member.problem(f"'{name}' is left out: there is no folder '{member.value}'")


def _gazebo_ports(node: Element) -> Iterator[Problem]:
    every = [*node.items("inputs"), *node.items("outputs")]
    ports = [port for port in every if port.member("gazebo_type") is not None]
    if not ports:
        return
    names = ", ".join(f"'{port.string('name')}'" for port in ports)
    has = "port has" if len(ports) == 1 else "ports have"
    bound = any(port.member("external_topic") is not None for port in ports)
    topics = "; their external topics are plain ROS topics, without a bridge" if bound else ""
    yield (
        ports[0]
        .value["gazebo_type"]
        .key_problem(
            f"Gazebo itself is not supported: {len(ports)} {has} a 'gazebo_type', which has no"
            f" effect: {names}{topics}",
            "MuJoCo stands in for it, see the key 'mujoco'",
        )
    )


# ---------------------------------------------------------------------- plugins


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
    if hook.sim_tick is not None:
        text, hint = node.no_clock
        if node.clock is not None:
            text = f"ticks by '{node.clock.name}', but nothing is connected to that input"
            hint = "connect the project's clock to it"
        if node.clock is None or not _is_fed(node, node.clock.name, connections):
            yield Remark(*hook.sim_tick, f"hook '{hook.name}': {text}", hint)
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
            elif (
                side == "input"
                and not port.is_optional
                and not _is_fed(node, port.name, connections)
            ):
                text = (
                    f"hook '{hook.name}': needs input '{port.name}', but nothing is connected to"
                    f" {node.name}.{port.name}"
                )
                hint = "connect it, or declare it Optional"
                yield Remark(port.line, port.column, text, hint)


def _is_fed(node: Node, name: str, connections: Sequence[Connection] | None) -> bool:
    """Whether something is connected to an input; so it seems where connections are unknown."""
    if connections is None or node.input(name).external_topic is not None:
        return True
    return any((c.destination_node, c.destination_input) == (node.name, name) for c in connections)


def _located(plugin: PluginFile, remarks: Iterable[Remark]) -> list[Problem]:
    name = display_name(plugin.path)
    return [Problem(name, r.line, r.column, "", r.text, r.hint) for r in remarks]


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
        plugin = read_plugin(node.plugin)
        sources = _sources(node, parsed.roots.project) if plugin else None
        if plugin is None or sources is None:
            continue
        word = re.compile(rf"(?<!\w){re.escape(key)}(?!\w)", re.IGNORECASE)
        if any(word.search(source) or _COMPUTED.search(source) for source in sources):
            continue
        candidates = {text for text in plugin.texts if _VARIABLE.fullmatch(text)}
        hint = did_you_mean(key, (candidates | {*node.environment}) - {key})
        complaint = f"nothing in the plugin of node '{node.name}' reads {key}"
        place = text.index(f".{key}") + 2
        yield Problem(f"--set {text}", 1, place, f"{node.pointer}/environment", complaint, hint)


@cache
def _is_read_by_neuros(key: str) -> bool:
    quoted = f'"{key}"'
    files = (file for file in PACKAGE.rglob("*.py") if not file.is_relative_to(EXAMPLES))
    return any(quoted in file.read_text("utf-8") for file in files)


def _sources(node: Node, project: Path) -> list[str] | None:
    """The programs of a project; ``None`` where there are too many files to look at."""
    seen = 0
    files = {node.plugin, *([node.script] if node.script else [])}
    is_alone = node.module and "." not in node.module  # its folder has all that is installed
    for folder in {project} if is_alone else {project, node.plugin.parent}:
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
