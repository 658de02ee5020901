"""Extensions: distributions of their own, which the core finds by entry points and never names."""

from __future__ import annotations

import ast
import configparser
import json
import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
from test_architecture import imports_of

from neuros.api.loading import load_with_messages
from neuros.cli.main import main
from neuros.distribution import __version__, libraries
from neuros.errors import ProjectError, UsageError
from neuros.ports import DeploymentKind, ModelFormat, PluginCheck
from neuros.registry import EXTENSIONS, Registry

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = sorted((ROOT / "extensions").glob("neuros-*"))
CORE = sorted((ROOT / "neuros").rglob("*.py"))
PLUGIN = """
from neuros.hooks import neuros_tick

@neuros_tick(seconds=1)
def tick(node):
    pass
"""
each_extension = pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)


def package(folder: Path) -> str:
    return folder.name.replace("-", "_")


def sections(file: Path) -> dict[str, dict[str, str]]:
    parser = configparser.ConfigParser(delimiters="=")
    parser.read(file, "utf-8")
    return {name: dict(parser[name]) for name in parser.sections()}


def test_the_core_knows_what_each_extension_brings() -> None:
    brought: dict[str, dict[str, str]] = {}
    for folder in FOLDERS:
        parts = sections(folder / package(folder) / "entry_points.txt")
        for group, names in parts.items():
            if group.startswith("neuros."):
                rows = brought.setdefault(group, {})
                rows |= dict.fromkeys(names, folder.name.removeprefix("neuros-"))
    assert sections(EXTENSIONS) == brought


@each_extension
def test_an_extension_has_the_version_of_the_core_and_asks_for_it(folder: Path) -> None:
    text = (folder / "pyproject.toml").read_text("utf-8")
    assert f'name = "{folder.name}"\nversion = "{__version__}"' in text
    assert f'"neuros=={__version__}"' in text
    core = (ROOT / "pyproject.toml").read_text("utf-8")
    name = folder.name.removeprefix("neuros-")
    assert re.search(
        rf'^{name} = \["{folder.name}(\[[a-z,]+\])?=={__version__}"', core, re.MULTILINE
    )


@each_extension
def test_its_facts_are_those_of_the_core_and_its_page_tells_how_it_is_installed(
    folder: Path,
) -> None:
    core, text = ((each / "pyproject.toml").read_text("utf-8") for each in (ROOT, folder))
    for line in re.findall(r"^(?:license|authors|requires-python) = .*$", core, re.MULTILINE):
        assert f"\n{line}\n" in text
    name = folder.name.removeprefix("neuros-")
    page = (folder / "README.md").read_text("utf-8").partition("\n## ")[0]
    wanted = f"`./install.py` installs it, `pip install 'neuros[{name}]'` does so elsewhere."
    assert f"extension `{folder.name}`: {wanted}" in " ".join(page.split())


def test_the_version_is_shown_with_those_of_the_extensions(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown == [f"{name} {__version__}" for name in ("neuros", *(f.name for f in FOLDERS))]


def test_an_extension_of_another_version_is_told_apart(tmp_path: Path) -> None:
    metadata = tmp_path / "neuros_lab-1.0.dist-info"
    metadata.mkdir()
    text = "Metadata-Version: 2.1\nName: neuros-lab\nVersion: 1.0\n"
    (metadata / "METADATA").write_text(text, "utf-8")
    (metadata / "entry_points.txt").write_text("[neuros.names]\nlab = lab\n", "utf-8")
    shown = output_of("from neuros.distribution import versions; print(versions())", tmp_path)
    assert "\nneuros-lab 1.0  (that of neuros is needed: ./install.py)\n" in shown


@each_extension
def test_what_an_extension_brings_can_be_loaded(folder: Path) -> None:
    for group, names in sections(folder / package(folder) / "entry_points.txt").items():
        for name, value in names.items():
            assert EntryPoint(name, value, group).load() is not None


@each_extension
def test_an_extension_imports_no_other_extension_and_nothing_private(folder: Path) -> None:
    others = {package(other) for other in FOLDERS if other != folder}
    for file in (folder / package(folder)).rglob("*.py"):
        for _, module in imports_of(ast.parse(file.read_text("utf-8")), package(folder)):
            first, *rest = module.split(".")
            assert first not in others, file
            if first == "neuros":
                assert not [name for name in rest if re.match("_[a-z]", name)], (file, module)


@pytest.mark.parametrize("file", CORE, ids=lambda file: str(file.relative_to(ROOT)))
def test_the_core_names_no_extension(file: Path) -> None:
    text = file.read_text("utf-8")
    assert [each.name for each in FOLDERS if each.name in text or package(each) in text] == []


def test_an_extension_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [])
    registry: Registry[ModelFormat] = Registry("neuros.models", "model format", ModelFormat)
    with pytest.raises(UsageError, match=r"'urdf' is in the extension neuros-robots, .* install"):
        registry.load("urdf")


def test_so_is_that_of_a_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [])
    monkeypatch.setattr(
        "neuros.cli.main.SUBCOMMANDS", Registry("neuros.commands", "command", object)
    )
    with pytest.raises(SystemExit) as ended:
        main(["convert", "robot.urdf"])
    assert ended.value.code == 2
    assert "command 'convert' is in the extension neuros-robots" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command", [["launch", str(ROOT / "examples/1_tick/clock")], ["doctor", "--no-delivery"]]
)
def test_so_is_that_of_a_deployment(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [])
    registry: Registry[DeploymentKind] = Registry(
        "neuros.deployments", "--deployment on", DeploymentKind
    )
    for name in ("neuros.api.plan.DEPLOYMENTS", "neuros.registry.DEPLOYMENTS"):
        monkeypatch.setattr(name, registry)
    assert main([*command, "--deployment", "lab.json"]) == 2
    assert "'machines' is in the extension neuros-cluster, which is" in capsys.readouterr().err


@pytest.mark.parametrize("flag", ["--dashboard-port=1", "-gz"])
def test_so_is_that_of_an_option_of_launch(
    flag: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [])
    monkeypatch.setattr("neuros.cli.launch.LAUNCH", Registry("neuros.launch", "option", object))
    with pytest.raises(SystemExit) as ended:
        main(["launch", "project", flag])
    assert ended.value.code == 2
    wanted = f"option '{flag.partition('=')[0].replace('-gz', '-g')}' is in the extension neuros-"
    assert wanted in capsys.readouterr().err


def test_a_launch_without_options_of_extensions_looks_for_none(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """To find them takes some 10 ms."""
    monkeypatch.setattr("neuros.cli.launch.LAUNCH", None)
    assert main(["launch", "nowhere", "--duration", "1", "--backend=process"]) == 3
    assert "nowhere" in capsys.readouterr().err


def test_so_is_that_of_a_plugin_and_of_what_a_plugin_imports(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [])
    names: Registry[Any] = Registry("neuros.names", "name in neuros", object)
    checks: Registry[PluginCheck] = Registry("neuros.plugin_checks", "plugin", PluginCheck)
    monkeypatch.setattr("neuros.registry.NAMES", names)
    monkeypatch.setattr("neuros.api.loading.NAMES", names)
    monkeypatch.setattr("neuros.api.loading.PLUGIN_CHECKS", checks)
    (tmp_path / "net.nir").touch()
    node = {"name": "brain", "container": "neuros_nir", "network": "net.nir"}
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [node]}), "utf-8")
    with pytest.raises(ProjectError) as caught:
        load_with_messages(tmp_path)
    (problem,) = caught.value.problems
    assert problem.pointer == "/nodes/0/network"
    assert "is in the extension neuros-learn, which is not installed: " in problem.text

    node = {"name": "brain", "container": "neuros_python", "plugin": "brain.py"}
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [node]}), "utf-8")
    (tmp_path / "brain.py").write_text(f"import neuros.datasets\n{PLUGIN}", "utf-8")
    monkeypatch.delitem(sys.modules, "neuros.datasets", raising=False)
    (warning,) = load_with_messages(tmp_path)[0].warnings
    assert warning.text == "there is no module 'neuros.datasets'"
    assert "is in the extension neuros-learn, which is not installed: " in warning.hint


def test_a_python_elsewhere_finds_extensions_where_the_core_says(tmp_path: Path) -> None:
    for name, folder in libraries().items():
        (tmp_path / name).symlink_to(folder, target_is_directory=True)
    program = (
        f"import sys; sys.path[:] = [p for p in sys.path if 'site-packages' not in p]\n"
        f"sys.path.insert(0, {str(tmp_path)!r})\n"
        "from neuros.registry import SUBCOMMANDS\n"
        "print(SUBCOMMANDS.load('convert').module)\n"
    )
    done = subprocess.run(
        [sys.executable, "-IS", "-c", program], capture_output=True, text=True, check=False
    )
    assert done.stdout == "neuros_robots.command\n", done.stderr


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A distribution whose module, function and package are to be found in ``neuros``."""
    (tmp_path / "lab.py").write_text("def greet():\n    return 'hello'\n", "utf-8")
    metadata = tmp_path / "lab-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: lab\nVersion: 1.0\n", "utf-8")
    (tmp_path / "kit").mkdir()
    (tmp_path / "kit" / "__init__.py").touch()
    (tmp_path / "kit" / "arm.py").write_text("import kit\n", "utf-8")
    names = "[neuros.names]\nlab = lab\ngreet = lab:greet\nsnn.kit = kit\n"
    (metadata / "entry_points.txt").write_text(names, "utf-8")
    return tmp_path


def output_of(program: str, path: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env={"PYTHONPATH": str(path)},
    )
    return done.stdout + done.stderr


def test_a_module_of_an_extension_is_imported_from_neuros(lab: Path) -> None:
    program = (
        "import lab, neuros.lab; from neuros.lab import greet\n"
        "print(greet(), neuros.lab is lab, lab.__spec__.name)"
    )
    assert output_of(program, lab) == "hello True lab\n"


def test_a_module_of_its_package_is_loaded_once_whatever_it_is_called(lab: Path) -> None:
    program = (
        "import neuros.snn.kit.arm as first, kit.arm as second; from neuros.snn.kit import arm\n"
        "print(first is second is arm, first.__name__)"
    )
    assert output_of(program, lab) == "True kit.arm\n"


def test_where_a_module_is_can_be_told_without_importing_it(lab: Path) -> None:
    program = (
        "import sys; from neuros.project.paths import find_module\n"
        "print(find_module('neuros.snn.kit.arm'), 'kit.arm' in sys.modules)"
    )
    assert output_of(program, lab) == f"{lab}/kit/arm.py False\n"


def test_so_is_a_function(lab: Path) -> None:
    assert output_of("from neuros import greet; print(greet())", lab) == "hello\n"


def test_a_module_that_nobody_has_is_not_found(lab: Path) -> None:
    assert output_of("import neuros.nothing", lab).endswith(
        "ModuleNotFoundError: No module named 'neuros.nothing'\n"
    )
