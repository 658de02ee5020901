"""Checks that the schema cannot express: the parts of a project, and its plugins, fit together.

The checks also work on files that violate the schema elsewhere: they pass over values of the wrong
form, which the schema reports. Plugins are read, not run.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, Literal

from neuros.distribution import EXAMPLES, PACKAGE
from neuros.errors import Problem
from neuros.project.dashboard import dashboard_mistakes, panels_without_effect
from neuros.project.message_types import array_type, normalised, with_copies
from neuros.project.model import CLOCK_TYPE, Connection, Node
from neuros.project.names import INTERNAL, MOST_CHARACTERS
from neuros.project.parsed import ENDS, ParsedProject, connection_name, names_of, rules_of
from neuros.project.plugin_files import PluginFile, PluginHook, Remark, plugins_of, read_plugin
from neuros.project.scanner import Element
from neuros.project.suggest import did_you_mean
from neuros.project.timing import LEAST_DELAY_NS, VIRTUAL, Distribution
from neuros.project.validate import MOST_PROBLEMS

Side = Literal["inputs", "outputs"]
_SIDES: tuple[Side, ...] = ("inputs", "outputs")
_LONGEST_PART = len("/data")
_IMAGE = "sensor_msgs/msg/Image"
_INT64 = 1 << 63
# ROS declares these parameters itself, and ignores values that are neither true nor false.
_TRUTH_VALUES = ("use_sim_time", "start_type_description_service")
_KINDS = {bool: "truth values", int: "numbers", float: "numbers", str: "texts"}
_STAND_INS: Mapping[str, str] = {"neuros_gazebo": "neuros_mujoco"}
_GAZEBO_PREFIXES = ("GZ_", "IGN_", "GAZEBO_")
_GAZEBO_FOLDERS = ("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH")
_MOST_FILES = 400
_MOST_FOLDERS = 2000
_VARIABLE = re.compile(r"[A-Za-z_]\w*")
# Reads of a variable whose name is no literal: any variable may be read there.
_COMPUTED = re.compile(
    r"\benviron\b(?!\s*\[\s*[\"']|\.(?:get|setdefault|pop)\(\s*[\"']|\s*$)|\bgetenv\((?!\s*[\"'])",
    re.MULTILINE,
)
# Variables of Python, libraries, drivers and ROS.
_KNOWN_PREFIXES = (
    *("PYTHON", "LD_", "LC_", "LANG", "TZ", "HOME", "PATH", "TMP", "XDG_", "DISPLAY", "QT_"),
    *("OMP_", "OPENBLAS_", "MKL_", "KMP_", "GOMP_", "BLIS_", "NUMEXPR_", "VECLIB_", "MALLOC_"),
    *("NUMBA_", "TF_", "XLA_", "JAX_", "CUDA", "NVIDIA_", "TORCH_", "PYTORCH_", "HF_", "KERAS_"),
    *("MUJOCO_", "PYOPENGL_", "EGL_", "LIBGL_", "MESA_", "GALLIUM_", "VK_", "__GL", "DRI_"),
    *("ROS_", "RMW_", "RCUTILS_", "RCL_", "FASTRTPS_", "FASTDDS_", "CYCLONEDDS_", "AMENT_"),
    *("NEST_", "MPL", "MATPLOTLIB", "GZ_", "IGN_", "GAZEBO_", "SDF_", "HTTP", "NO_PROXY", "SSL_"),
)


def mistakes(parsed: ParsedProject) -> list[Problem]:
    """All parts that do not fit together, at most ``MOST_PROBLEMS`` from each check."""
    parts = (_nodes, _ports, _connections, dashboard_mistakes)
    checks = (*parts, _names, _parameters, _timing)
    return [problem for check in checks for problem in islice(check(parsed), MOST_PROBLEMS)]


def _ports_of(node: Element) -> Iterator[tuple[Element, Side]]:
    for side in _SIDES:
        for port in node.items(side):
            yield port, side


def _nodes(parsed: ParsedProject) -> Iterator[Problem]:
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
            # One node file, used twice: both names are at one place.
            yield entry.problem(f"the node name '{name}' occurs twice", _where(other_entry))
            continue
        text = f"the node name '{name}' occurs twice"
        if other.string("name") != name:
            text = f"the node names '{other.string('name')}' and '{name}' differ only in case"
        yield node.value["name"].problem(text, _where(other, "name"))


def copies_of(node: Element) -> int | None:
    """The number of copies of a node; ``None`` if it has none, or a wrong one."""
    value: Any = getattr(node.member("copies"), "value", None)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return int(value) if value >= 1 and value % 1 == 0 else None


def _ports(parsed: ParsedProject) -> Iterator[Problem]:
    """Names that occur twice, QoS without an external topic, no room for an axis of copies."""
    first: dict[tuple[int, Side, str], Element] = {}
    for index, node in enumerate(parsed.nodes):
        for port, side in _ports_of(node):
            name, qos = port.string("name"), port.member("qos")
            if name is not None and first.setdefault((index, side, name), port) is not port:
                place = _where(first[index, side, name], "name")
                text = f"two {side} of the node are named '{name}'"
                yield port.value["name"].problem(text, place)
            if qos is not None and port.member("external_topic") is None:
                yield qos.key_problem(
                    f"'qos' is for external topics, but this {side[:-1]} has no external topic",
                    "the QoS of a connection follows from its discard_limit and queue_size",
                )
            if copies_of(node) is None:
                continue
            written, hint = port.string("type") or "", _where(node, "copies")
            if normalised(written) not in (None, CLOCK_TYPE) and array_type(written) is None:
                text = f"each {side[:-1]} of a node with copies is an array, not {written}"
                yield port.value["type"].problem(text, f"write it like 'float64[18]'; {hint}")
            if port.member("mujoco") is not None:
                text = "sensors and actuators are of one world, and the node has copies"
                hint = f"its plugin reads them from MuJoCoWorlds; {hint}"
                yield port.value["mujoco"].key_problem(text, hint)


def _connections(parsed: ParsedProject) -> Iterator[Problem]:
    """Connections that occur twice or do not fit their ends, and budgets of unknown ones."""
    yield from _connection_ends(parsed)
    first: dict[str, Element] = {}
    are_all_known = True
    for connection in parsed.connections:
        name = connection_name(connection)
        if not name:
            are_all_known = False
            continue
        if first.setdefault(name, connection) is not connection:
            yield connection.problem(f"the connection {name} occurs twice", _where(first[name]))
    budgets = parsed.root.member("budgets")
    for name, member in ({} if budgets is None else budgets.members("lost_packets")).items():
        if name not in first and are_all_known:
            hint = did_you_mean(name, first) or "write 'a.out -> b.in', as `neuros launch` does"
            yield member.key_problem(f"there is no connection '{name}'", hint)


def _connection_ends(parsed: ParsedProject) -> Iterator[Problem]:
    # By node and side, the ports by name; the name None says that others may be there.
    ports: dict[tuple[str, Side], dict[str | None, Element]] = {}
    copies: dict[str | None, int | None] = {}
    for node in parsed.nodes:
        copies.setdefault(node.string("name"), copies_of(node))
        for side in _SIDES:
            known = ports.setdefault((node.string("name") or "", side), {})
            member = node.member(side)
            if member is not None and not isinstance(member.value, list):
                known.setdefault(None, member)
        for port, side in _ports_of(node):
            ports[node.string("name") or "", side].setdefault(port.string("name"), port)
    nodes = {name for name, _ in ports}
    for connection in parsed.connections:
        found: list[Element] = []
        for node_key, port_key, side, other in (
            (*ENDS[:2], _SIDES[1], _SIDES[0]),
            (*ENDS[2:], _SIDES[0], _SIDES[1]),
        ):
            name, wanted = connection.string(node_key), connection.string(port_key)
            if name is None:
                continue
            if name not in nodes:
                if parsed.is_complete and "" not in nodes and name:
                    hint = did_you_mean(name, nodes)
                    yield connection.value[node_key].problem(f"there is no node '{name}'", hint)
                continue
            known, end = ports[name, side], ports[name, side].get(wanted)
            if not wanted:
                continue
            if end is None:
                if None not in known:
                    hint = did_you_mean(wanted, filter(None, known))
                    if wanted in ports[name, other]:
                        hint = f"it has an {other[:-1]} of that name"
                    text = f"node '{name}' has no {side[:-1]} '{wanted}'"
                    yield connection.value[port_key].problem(text, hint)
                continue
            found.append(end)
            if end.member("external_topic") is not None:
                yield connection.value[port_key].problem(
                    f"{side[:-1]} '{wanted}' of node '{name}' has an external topic, so it "
                    "cannot be connected",
                    _where(end, "external_topic"),
                )
        names = (connection.string(key) for key in (ENDS[0], ENDS[2]))
        types = [
            normalised(with_copies(port.string("type") or "", copies.get(name)))
            for port, name in zip(found, names, strict=False)
        ]
        if len(types) == 2 and None not in types and types[0] != types[1]:
            source, destination = found
            yield connection.problem(
                f"the output sends {types[0]}, the input takes {types[1]}",
                f"{_where(source, 'type')} and {_where(destination, 'type').removeprefix('see ')}",
            )
        yield from _compression(connection, [each for each in types if each is not None])


def _compression(connection: Element, types: list[str]) -> Iterator[Problem]:
    transport = connection.members("transport")
    compression, quality = transport.get("compression"), transport.get("quality")
    others = [each for each in types if each != _IMAGE]
    if compression is None or compression.value != "jpeg":
        if quality is not None:
            yield quality.key_problem("'quality' is that of JPEG", 'add "compression": "jpeg"')
    elif others:
        text = f"JPEG is for {_IMAGE}, not {others[0]}"
        yield compression.problem(text, "zstd takes any type")
    elif connection.string(ENDS[0]) == connection.string(ENDS[2]):
        yield compression.problem(
            "packets of a node to itself are not sent, so they cannot be encoded", "leave it out"
        )


def unconnected_ports(parsed: ParsedProject) -> Iterator[Problem]:
    used = {
        (side, connection.string(node), connection.string(port))
        for connection in parsed.connections
        for side, node, port in (("outputs", *ENDS[:2]), ("inputs", *ENDS[2:]))
    }
    for node in parsed.nodes:
        for port, side in _ports_of(node):
            name = port.string("name")
            # The plugin may read a sensor itself, for a message of the user's own.
            is_sensor = side == "outputs" and port.member("mujoco") is not None
            is_used = (side, node.string("name"), name) in used
            if not (is_used or is_sensor or port.member("external_topic")):
                text = f"{side[:-1]} '{name}' of node '{node.string('name')}' is not connected"
                yield port.problem(text)


def _where(element: Element, key: str = "") -> str:
    """The place of an element, or of its key, as a hint."""
    return f"see {(element.value[key] if key else element).where}"


# ---------------------------------------------------------------------- ROS graph


def _names(parsed: ParsedProject) -> Iterator[Problem]:
    """Remapping rules without effect, and topics that are longer than ROS allows."""
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
    for node in parsed.nodes:
        for port, _ in _ports_of(node):
            topic = port.string("external_topic")
            full = names.resolve(topic, node.string("name") or "") if topic is not None else ""
            if len(full) > MOST_CHARACTERS:
                yield port.value["external_topic"].problem(_too_long(full))
    for connection in parsed.connections:
        ends = [connection.string(end) or "" for end in ENDS]
        full = f"{names.namespace}{INTERNAL}{'/'.join(ends)}"
        if len(full) + _LONGEST_PART > MOST_CHARACTERS:
            hint = "choose shorter names, or a shorter namespace"
            yield connection.problem(_too_long(full), hint)


def _too_long(topic: str) -> str:
    return f"the topic {topic} is longer than the {MOST_CHARACTERS} characters that ROS allows"


# ---------------------------------------------------------------------- parameters of ROS


def _parameters(parsed: ParsedProject) -> Iterator[Problem]:
    """Values that ROS has no type for, and parameters that occur twice."""
    for node in parsed.nodes:
        seen: dict[str, Element] = {}
        waiting = [*node.members("parameters").items()]
        while waiting:
            full, member = waiting.pop(0)
            if isinstance(member.value, dict):
                inner = member.value.items()
                waiting[:0] = [(f"{full}.{name}", each) for name, each in inner]
                continue
            if seen.setdefault(full, member) is not member:
                yield member.key_problem(f"the parameter '{full}' occurs twice")
            if full in _TRUTH_VALUES and not isinstance(member.value, bool):
                yield member.problem("must be true or false, as ROS declares it")
            values = member.value if isinstance(member.value, list) else [member]
            kinds = {_KINDS.get(type(each.value), "other values") for each in values}
            if len(kinds) > 1:
                yield member.problem(
                    f"the list has {' and '.join(sorted(kinds))}", "ROS has lists of one kind only"
                )
            for each in values:
                if type(each.value) is int and not -_INT64 <= each.value < _INT64:
                    text = "is too large for an integer of ROS, which has 64 bits"
                    yield each.problem(text)


# ---------------------------------------------------------------------- virtual time


def _timing(parsed: ParsedProject) -> Iterator[Problem]:
    """Impossible durations, delays and losses; in virtual time, inputs from outside."""
    for node in parsed.nodes:
        for duration in node.members("durations").values():
            yield from _impossible(duration)
    for connection in parsed.connections:
        delay, loss = connection.member("delay"), connection.member("loss")
        if delay is not None:
            yield from _impossible(delay, LEAST_DELAY_NS)
        is_to_itself = connection.string(ENDS[0]) == connection.string(ENDS[2])
        for key, member in (("delay", delay), ("loss", loss)):
            if member is not None and is_to_itself:
                text = "packets of a node to itself are not sent, so they have no"
                yield member.key_problem(f"{text} {key}", "leave it out")
        if loss is not None and loss.value and connection.member("discard_limit") is not None:
            text = "a connection with a discard limit loses no packet on its way"
            hint = "leave out the discard_limit: then packets may be lost"
            yield loss.key_problem(text, hint)
    for node in parsed.nodes if parsed.root.string("time") == VIRTUAL else ():
        for port in node.items("inputs"):
            topic = port.member("external_topic")
            if topic is not None:
                text = "packets of an external topic arrive in real time, not in virtual time"
                hint = "connect the input to a node, or run in real time"
                yield topic.key_problem(text, hint)


def _impossible(duration: Element, least_ns: int = 0) -> Iterator[Problem]:
    """A range without values, and values below the least one; those of a normal curve are cut."""
    try:
        distribution = Distribution.of(duration.plain)
    except (ValueError, TypeError, AttributeError):
        return  # the schema reports it
    low, high = distribution.values[0], distribution.values[-1]
    if distribution.kind == "uniform" and low > high:
        text, hint = "the least value is above the largest", f"write [{high:g}, {low:g}]"
        yield duration.value["uniform"].problem(text, hint)
    if distribution.kind not in ("normal", "lognormal") and distribution.least_ns < least_ns:
        text = f"is at least {least_ns / 1000:g} microsecond"
        yield duration.problem(f"a delay {text}, but may be {distribution.least_ns / 1e9:g} s")


# ---------------------------------------------------------------------- remarks; Gazebo, of 1.0


def container_in_place_of(name: str) -> str:
    """The container of a node: the named one, or the stand-in for Gazebo's."""
    return _STAND_INS.get(name, name)


def is_for_gazebo(variable: str) -> bool:
    """Whether an environment variable is Gazebo's: its path need not exist."""
    return variable.startswith(_GAZEBO_PREFIXES)


def remarks(parsed: ParsedProject) -> Iterator[Problem]:
    """Possible mistakes in a project without mistakes, but for :func:`unconnected_ports`.

    They are panels and QoS without effect, and what belongs to Gazebo, which has no meaning here.
    """
    yield from panels_without_effect(parsed)
    for node in parsed.nodes:
        for qos in (port.member("qos") for port, _ in _ports_of(node)):
            policies = qos and (qos.string("reliability"), qos.string("durability"))
            if qos is not None and policies == ("best_effort", "transient_local"):
                yield qos.problem(
                    "transient_local has no effect with best_effort: a subscriber that comes later"
                    " gets nothing",
                    "make it reliable",
                )
        container = node.string("container") or ""
        if container in _STAND_INS:
            yield node.value["container"].problem(
                f"Gazebo is not supported: the node runs in '{_STAND_INS[container]}' instead of"
                f" '{container}'"
            )
        for name, member in node.members("environment").items():
            if not is_for_gazebo(name):
                continue
            if name not in _GAZEBO_FOLDERS:
                yield member.key_problem(f"'{name}' is for Gazebo and has no effect")
            elif not parsed.roots.finds(member.value, member.source.folder):
                yield member.problem(f"'{name}' is left out: there is no folder '{member.value}'")
        ports = [port for port, _ in _ports_of(node) if port.member("gazebo_type") is not None]
        if not ports:
            continue
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
    """The mistakes in plugins, and their possible mistakes.

    Args:
        nodes: built from the elements of the parsed project, in the same order.
        connections: ``None`` where not all of them are known.
    """
    problems, doubts = list[Problem](), list[Problem]()
    is_virtual = parsed.root.string("time") == VIRTUAL
    for node, element in zip(nodes, parsed.nodes, strict=True):
        plugins = plugins_of(node)
        problems += _wrong_durations(node, element, plugins)
        for plugin in plugins:
            found = [*plugin.mistakes]
            lists = (getattr(element.member(side), "value", []) for side in ("inputs", "outputs"))
            if all(isinstance(each, list) for each in lists):
                for hook in plugin.hooks:
                    found += _misfits(hook, node, connections, is_virtual)
            problems += [remark.in_file(plugin.path) for remark in found]
            doubts += [remark.in_file(plugin.path) for remark in plugin.doubts]
    return problems, doubts


def _wrong_durations(
    node: Node, element: Element, plugins: Sequence[PluginFile]
) -> Iterator[Problem]:
    """Durations of hooks that the node does not have, or that take no time."""
    kinds = {hook.name: hook.kind for plugin in plugins for hook in plugin.hooks}
    is_whole = plugins and all(plugin.is_whole and not plugin.functions_of for plugin in plugins)
    for name, duration in element.members("durations").items():
        text, hint = node.no_duration(name, kinds if is_whole or name in kinds else None)
        if text:
            yield duration.key_problem(text, hint)


def _misfits(
    hook: PluginHook, node: Node, connections: Sequence[Connection] | None, is_virtual: bool
) -> Iterator[Remark]:
    """Ports of a hook that its node lacks, required inputs without a connection, endless loops."""
    is_main_loop = (
        hook.kind == "neuros_function"
        and hook.inputs is not None
        and all(port.is_optional for port in hook.inputs)
    )
    if is_virtual and is_main_loop and node.is_timeless(hook.name):
        yield Remark(*hook.place, *node.timeless(hook.name))
    if hook.sim_tick is not None:
        text, hint = node.no_clock
        if node.clock is not None:
            text = f"ticks by '{node.clock.name}', but nothing is connected to that input"
            hint = "connect the project's clock to it"
        if node.clock is None or not _is_fed(node, node.clock.name, connections):
            yield Remark(*hook.sim_tick, f"hook '{hook.name}': {text}", hint)
    if hook.is_batch is not None:
        text, hint = node.misfit(hook.is_batch, bool(hook.inputs or hook.outputs))
        if text:
            yield Remark(*hook.place, f"hook '{hook.name}': {text}", hint)
    for side, declared, known, others in (
        ("input", hook.inputs, node.inputs, node.outputs),
        ("output", hook.outputs, node.outputs, node.inputs),
    ):
        names, other_names = {port.name for port in known}, {port.name for port in others}
        for port in declared or ():
            if port.name is None or "" in names:
                continue
            if port.name not in names:
                text, hint = node.undeclared(side, port.name)
                hint = did_you_mean(port.name, names) or hint
                if port.name in other_names:
                    hint = f"it has an {'output' if side == 'input' else 'input'} of that name"
            elif side == "output" or port.is_optional or _is_fed(node, port.name, connections):
                continue
            else:
                text, hint = node.unfed(port.name)
            yield Remark(port.line, port.column, f"hook '{hook.name}': {text}", hint)


def _is_fed(node: Node, name: str, connections: Sequence[Connection] | None) -> bool:
    """Whether something is connected to an input, or may be: connections can be unknown."""
    if connections is None or node.input(name).external_topic is not None:
        return True
    return any((c.destination_node, c.destination_input) == (node.name, name) for c in connections)


def unread_variables(
    parsed: ParsedProject, nodes: Sequence[Node], overrides: Sequence[str]
) -> Iterator[Problem]:
    """Variables that ``--set`` gives to nodes, and no program of the project reads."""
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
    """The programs of a project; ``None`` if there are too many files to read."""
    seen = 0
    files = {node.plugin, *([node.script] if node.script else [])}
    is_alone = node.module and "." not in node.module  # in the folder of all installed packages
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
