"""A package imports only from layers below its own.

The table is that of the architecture.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted((ROOT / "neuros").rglob("*.py"))


@dataclass(frozen=True)
class Package:
    """A part of ``neuros``: the modules it consists of, and its layer."""

    layer: int
    modules: tuple[str, ...]

    def holds(self, module: str) -> bool:
        return any(is_within(module, name) for name in self.modules)

    def __str__(self) -> str:
        return self.modules[0]


def is_within(module: str, package: str) -> bool:
    """Whether a dotted name is that package or lies in it."""
    return module == package or module.startswith(package + ".")


# The first one that holds a module counts.
PACKAGES = (
    Package(0, ("errors", "distribution", "hooks")),
    Package(1, ("time",)),
    Package(1, ("project",)),
    Package(1, ("installation",)),
    Package(0, ("ordinary_files",)),
    Package(1, ("caching",)),
    Package(1, ("arithmetic",)),
    Package(2, ("engine",)),
    Package(3, ("ports", "control", "stacks", "options", "registry")),
    Package(4, ("transport",)),
    Package(4, ("backends",)),
    Package(4, ("simulators",)),
    Package(4, ("snn",)),
    Package(4, ("messages",)),
    Package(4, ("recording", "bag")),
    Package(4, ("visualise",)),
    Package(5, ("node",)),
    Package(5, ("launcher",)),
    Package(6, ("runtime",)),
    Package(7, ("api",)),
    Package(7, ("testing",)),
    Package(8, ("pytest_plugin",)),
    Package(8, ("ros_launch",)),
    Package(8, ("cli", "doctor")),
)
# neuros itself holds public names; every package may ask it for the version. Those of others
# it imports when they are asked for.
PUBLIC_NAMES = Package(2, ("",))
OWNERS = {
    "Connection": "project",
    "Node": "project",
    "NodeHandle": "node",
    "Project": "api",
    "Run": "api",
}
PORTS = 3

MESSAGES = {"builtin_interfaces", "geometry_msgs", "nav_msgs", "rosgraph_msgs", "sensor_msgs"}
MESSAGES |= {"service_msgs", "std_msgs", "rcl_interfaces", "rosidl_runtime_py"}
GENERATORS = {f"rosidl_generator_{name}" for name in ("c", "py", "type_description")}
GENERATORS |= {f"rosidl_typesupport_{name}" for name in ("c", "fastrtps_c", "introspection_c")}
GENERATORS |= {"rosidl_adapter", "rosidl_cli"}
# What is not named here has none; a part of a package may have less than the package.
THIRD_PARTY: dict[str, set[str]] = {
    "project.validate": {"jsonschema", "referencing"},
    "control": {"msgspec"},
    "node.keeping": {"numpy"},
    "time": {"builtin_interfaces"},
    "transport": {
        "numpy",
        "rclpy",
        "rosidl_generator_py",
        "rosidl_parser",
        "rpyutils",
        "xxhash",
        "backports",
        "compression",
        "PIL",
    }
    | MESSAGES,
    "transport.memory": set(),
    "runtime": {"rclpy", "std_msgs"},
    "runtime.virtual_ros": {"rclpy", "std_msgs", "msgspec"},
    "simulators.mujoco": {"mujoco", "numpy", "OpenGL", "glfw"} | MESSAGES,
    "snn": {"numpy"},
    "snn.nest": {"numpy", "nest"},
    "backends.docker": {"docker", "requests"},
    "backends.console": {"tqdm"},
    "backends.pythons": {"packaging"},
    "pytest_plugin": {"pytest"},
    "ros_launch": {"launch"},
    "api.packets": {"numpy", "xxhash"},
    "api.run_record": {"tabulate"},
    "api.session": {"numpy"},
    "api.verify": {"numpy", "xxhash"},
    "messages.package": {"catkin_pkg"},
    "messages.checking": {"rosidl_adapter"},
    "messages.workspace": {"rosidl_adapter"},
    "messages.generation": GENERATORS,
    "messages.needed": {"numpy"},
    "cli.main": {"argcomplete"},
    "cli.template": {"std_msgs"},
    "cli.live": {"tabulate"},
    "cli.runs": {"tabulate"},
    "node.handle": {"numpy"},
    "recording": {"mcap", "rosbags", "psutil", "tabulate", "numpy", "xxhash"},
    "recording.stored": {"mcap", "rosbags", "ruamel", "backports", "compression"},
    "visualise": {"numpy"},
    "visualise.program": {"matplotlib", "numpy"},
    "recording.columns": {"rosbags", "numpy"},
    "bag": {"rosbags", "numpy"},
}
# The engine is pure: no threads, no wall clock, no files.
IMPURE = {
    "threading",
    "multiprocessing",
    "asyncio",
    "time",
    "socket",
    "os",
    "subprocess",
}


def package_of(module: str) -> Package | None:
    """The package of ``neuros.<module>``; the package itself is ``""``."""
    if not module:
        return PUBLIC_NAMES
    module = OWNERS.get(module, module)
    return next((package for package in PACKAGES if package.holds(module)), None)


def third_party_of(module: str) -> set[str]:
    """The packages that ``neuros.<module>`` may import, from the longest entry that fits."""
    entries = [entry for entry in THIRD_PARTY if is_within(module, entry)]
    return THIRD_PARTY[max(entries, key=len)] if entries else set()


def imports_of(tree: ast.AST, package: str) -> Iterator[tuple[int, str]]:
    """Every ``(line, module)`` that is imported anywhere in a file of ``package``, late ones too.

    ``from a import b`` yields ``a.b``: ``b`` may be a module.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*parents, *([node.module] if node.module else [])])
            source = base if node.level else str(node.module)
            yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            names = [name.value for name in node.args[:1] if isinstance(name, ast.Constant)]
            yield from ((node.lineno, str(name)) for name in names)


def complaint(importer: str, imported: str) -> str | None:
    """Why ``neuros.<importer>`` must not import the absolute name ``imported``."""
    package, (top, _, inner) = package_of(importer), imported.partition(".")
    assert package is not None, f"neuros.{importer} belongs to no package: add it to PACKAGES"
    if top != "neuros":
        if package.holds("engine") and top in IMPURE:
            return f"core knows no {top}"
        is_allowed = top in sys.stdlib_module_names or top in third_party_of(importer)
        return None if is_allowed else f"the third-party package {top} is not for it"
    other = package_of(inner)
    if other is None or other in (package, PUBLIC_NAMES):
        return None
    if package is PUBLIC_NAMES and {*other.modules} & {*OWNERS.values(), "registry"}:
        return None
    if package.holds("installation"):
        is_known = other.holds("errors") and not is_within(inner, "hooks")
        return None if is_known else "the installation knows nothing but errors"
    if other.layer >= package.layer:
        return f"{other} is on layer {other.layer}, not below {package.layer}"
    if package.layer == 5 and other.layer > PORTS:
        return f"{package} sees ports only, and {other} is an adapter"
    return None


def broken_rules(file: str, module: str, source: str) -> list[str]:
    """One line per import in ``source`` that breaks the table."""
    package = module if file.endswith("__init__.py") else module.rpartition(".")[0]
    found = []
    for line, imported in imports_of(ast.parse(source), package):
        reason = complaint(module.removeprefix("neuros").removeprefix("."), imported)
        if reason:
            found.append(f"{file}:{line}: imports {imported}: {reason}")
    return found


def module_of(path: Path) -> str:
    """The dotted name of a source file."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_a_package_imports_only_from_the_layers_below() -> None:
    assert [
        broken_rule
        for path in FILES
        for broken_rule in broken_rules(
            str(path.relative_to(ROOT)), module_of(path), path.read_text("utf-8")
        )
    ] == []


@pytest.mark.parametrize(
    ("module", "source", "complaint_about"),
    [
        ("neuros.engine.engine", "import rclpy", "third-party package rclpy"),
        ("neuros.engine.engine", "import time", "knows no time"),
        ("neuros.engine.engine", "from neuros import transport", "transport is on layer 4"),
        ("neuros.engine.engine", "from ..ports import Clock", "ports is on layer 3"),
        ("neuros.node.node", "from neuros import Project", "api is on layer 7"),
        ("neuros.hooks", "def f():\n    import neuros.project.model", "project is on layer 1"),
        ("neuros.project.load", "import jsonschema", "third-party package jsonschema"),
        ("neuros.transport.ros", "from neuros.backends import console", "backends is on layer 4"),
        ("neuros.transport.memory", "import rclpy", "third-party package rclpy"),
        ("neuros.node.node", "from neuros.transport.ros import x", "sees ports only"),
        ("neuros.launcher.supervisor", "from neuros.backends.console import x", "sees ports only"),
        ("neuros.backends.console", "from neuros.launcher.supervisor import x", "on layer 5"),
        ("neuros.simulators.mujoco.sensors", "import nest", "third-party package nest"),
        ("neuros.snn.coding", "import nest", "third-party package nest"),
        ("neuros.installation.machine", "from neuros.hooks import All", "nothing but errors"),
        ("neuros.ports", "import importlib\nimportlib.import_module('neuros.cli')", "on layer 8"),
    ],
)
def test_an_import_that_breaks_the_table_is_named_with_its_line(
    module: str, source: str, complaint_about: str
) -> None:
    last = len(source.splitlines())
    (found,) = broken_rules("somewhere.py", module, source)
    assert found.startswith(f"somewhere.py:{last}: imports ")
    assert complaint_about in found


def run_python(*arguments: str) -> None:
    """Run a Python of its own in the source tree, and show what it wrote where it fails."""
    done = subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_engine_imports_where_the_outside_world_does_not_exist() -> None:
    engine = [module_of(path) for path in FILES if "engine" in path.relative_to(ROOT).parts]
    run_python(
        "-c",
        "import sys\n"
        "for name in ('rclpy', 'docker', 'mujoco', 'psutil', 'numpy', 'nest', 'jsonschema'):\n"
        "    sys.modules[name] = None\n"
        "sys.path.insert(0, '.')\n"
        f"import {', '.join(['neuros.engine', *engine])}",
    )


def test_coders_and_decoders_work_without_nest() -> None:
    run_python(
        "-c",
        "import sys\n"
        "sys.modules['nest'] = None\n"
        "sys.path.insert(0, '.')\n"
        "import numpy\n"
        "from neuros.snn import PopulationVector, WindowRate, poisson_spikes\n"
        "spikes = poisson_spikes([50.0] * 4, 1.0, numpy.random.default_rng(1))\n"
        "assert WindowRate(4, 1.0).update(spikes, 1.0).sum() == len(spikes) > 0\n"
        "assert PopulationVector([0.0, 1.0, 2.0, 3.0]).of_spikes(spikes).length > 0",
    )


def test_the_installation_imports_on_a_bare_python() -> None:
    isolated_without_packages = "-IS"
    run_python(
        isolated_without_packages,
        "-c",
        "import sys; sys.path.insert(0, '.'); import neuros.installation",
    )


def test_importing_neuros_imports_no_adapter() -> None:
    run_python(
        "-c",
        "import sys; sys.path.insert(0, '.'); import neuros, neuros.hooks\n"
        "heavy = {'rclpy', 'mujoco', 'numpy', 'nest', 'jsonschema', 'matplotlib', 'docker'}\n"
        "assert not heavy & {*sys.modules}, heavy & {*sys.modules}",
    )


def test_the_command_line_starts_without_what_single_commands_need() -> None:
    """Every node starts through it."""
    run_python(
        "-c",
        "import sys; sys.path.insert(0, '.'); import neuros.cli.main\n"
        "heavy = {'asyncio', 'starlette', 'uvicorn', 'webbrowser', 'rclpy', 'docker', 'numpy'}\n"
        "assert not heavy & {*sys.modules}, heavy & {*sys.modules}",
    )


def ends_or_evaluates(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Calls that a library must not make: it would end the process, or run text as code."""
    banned = {"eval", "exec", "exit", "quit", "sys.exit"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in banned:
            yield node.lineno, ast.unparse(node.func)


def test_no_module_runs_text_as_code_and_only_the_console_script_ends_the_process() -> None:
    found = []
    for path in FILES:
        tree = ast.parse(path.read_text("utf-8"))
        tree.body = [node for node in tree.body if not _is_script_part(node)]
        found += [(str(path.relative_to(ROOT)), *call) for call in ends_or_evaluates(tree)]
    assert found == []


def _is_script_part(node: ast.stmt) -> bool:
    """Whether this only runs as a command: ``if __name__ == "__main__"``, ``console_script``."""
    if isinstance(node, ast.If):
        return ast.unparse(node.test) == "__name__ == '__main__'"
    return isinstance(node, ast.FunctionDef) and node.name == "console_script"


def pythons_started_otherwise(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Commands that start Python so that it may import from the current folder.

    Only :func:`neuros.distribution.python_command` starts modules and code; a Python that is
    isolated, or is given a file, takes nothing from there.
    """
    for node in ast.walk(tree):
        if isinstance(node, (ast.List, ast.Tuple)):
            parts = [ast.unparse(part) for part in node.elts]
            is_shell = parts[:1] in (["'/bin/sh'"], ["'sh'"], ["'/bin/bash'"])
            is_file = len(parts) > 1 and (".py" in parts[1] or "__file__" in parts[1])
            is_compiler, is_text = "'-o'" in parts, parts[1:2] == ["sys.version"]
            is_python = not {"'-m'", "'-c'", "sys.executable"}.isdisjoint(parts)
            is_other = is_shell or is_file or is_compiler or is_text
            if is_python and not (is_other or "'-I'" in parts):
                yield node.lineno, ast.unparse(node)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if re.search(r"\bpython[\d.]* -[mc]\b", node.value):
                yield node.lineno, node.value
        elif (
            isinstance(node, ast.Call)
            and re.search(r"\b(exec[lv]\w*|spawn[lv]\w*|set_executable)$", ast.unparse(node.func))
            and any("sys.executable" in ast.unparse(argument) for argument in node.args)
        ):
            yield node.lineno, ast.unparse(node)


def test_one_function_starts_every_python() -> None:
    assert [
        (str(path.relative_to(ROOT)), *found)
        for path in [*FILES, ROOT / "install.py"]
        for found in pythons_started_otherwise(ast.parse(path.read_text("utf-8")))
        if path.name != "distribution.py"
    ] == []


@pytest.mark.parametrize(
    "source",
    [
        "subprocess.run([sys.executable, '-m', 'neuros.cli'])",
        "command = [str(python), '-m', 'pip']",
        "command = [python, '-c', code]",
        "command = ('-m', 'venv')",
        "command = [sys.executable, *arguments]",
        "os.system('python3 -m neuros.cli ps')",
        "f'exec {python}; python -c {code}'",
        "os.execve(sys.executable, command, environment)",
    ],
)
def test_another_way_to_start_python_is_seen(source: str) -> None:
    assert [*pythons_started_otherwise(ast.parse(source))]
