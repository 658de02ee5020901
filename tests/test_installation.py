"""``install.py`` and ``launch.py`` on machines that lack something.

A whole installation takes a minute and a network; what is tested here are its decisions, with real
virtual environments where one without packages is enough.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
import venv
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest

from neuros.cli.main import parser
from neuros.errors import EnvironmentFault
from neuros.installation import command
from neuros.installation.command import (
    Environment,
    build_arguments,
    extras_of,
    remove_leftovers,
)
from neuros.installation.machine import Machine, clean_environment, explain_missing_library
from neuros.installation.packages import explain_failure, pip_settings
from neuros.installation.progress import Progress

ROOT = Path(__file__).resolve().parents[1]
SUPPORTED = Machine((3, 12), "CPython", "Linux", "x86_64", (2, 36))
PYPROJECT = '[project]\nname = "neuros"\n[project.optional-dependencies]\nnest = ["nest"]\n'


def fault_of(machine: Machine) -> str:
    with pytest.raises(EnvironmentFault) as caught:
        machine.require_support()
    return str(caught.value)


class TestMachine:
    @pytest.mark.parametrize("minor", [10, 11, 12, 13, 14])
    def test_every_python_with_packages_is_supported(self, minor: int) -> None:
        replace(SUPPORTED, python=(3, minor)).require_support()

    @pytest.mark.parametrize("python", [(3, 9), (3, 15)])
    def test_another_python_is_told_which_one_to_use(self, python: tuple[int, int]) -> None:
        fault = fault_of(replace(SUPPORTED, python=python))
        assert f"3.10 to 3.14, and this is CPython 3.{python[1]}" in fault
        assert "run python3." in fault

    def test_another_implementation_is_told_which_one_to_use(self) -> None:
        assert "this is PyPy 3.12" in fault_of(replace(SUPPORTED, implementation="PyPy"))

    def test_for_arm_the_package_index_is_asked(self) -> None:
        replace(SUPPORTED, processor="aarch64").require_support()

    def test_another_processor_is_told_to_use_docker(self) -> None:
        fault = fault_of(replace(SUPPORTED, processor="riscv64"))
        assert "this is Linux on riscv64: use Docker, docker run " in fault

    def test_another_system_is_told_to_use_docker(self) -> None:
        fault = fault_of(replace(SUPPORTED, system="Darwin", processor="arm64", glibc=()))
        assert "this is Darwin on arm64: use Docker, docker run " in fault

    @pytest.mark.parametrize("glibc", [(2, 27), ()])
    def test_a_c_library_without_packages_is_told_to_use_docker(self, glibc: tuple[int]) -> None:
        assert "glibc 2.28 or newer" in fault_of(replace(SUPPORTED, glibc=glibc))

    def test_the_machine_that_runs_the_tests_is_supported(self) -> None:
        Machine.here().require_support()


class TestExplanations:
    @pytest.mark.parametrize(
        ("output", "sentence"),
        [
            ("ERROR: Could not install: [Errno 28] No space left on device", "make room"),
            ("Temporary failure in name resolution\nNo matching distribution found", "network"),
            ("NewConnectionError: [Errno 101] Network is unreachable", "export HTTPS_PROXY="),
            ("SSLError(SSLCertVerificationError: CERTIFICATE_VERIFY_FAILED", "export PIP_CERT="),
            ("error: command 'x86_64-linux-gnu-gcc' failed: No such file", "no C compiler"),
            ("error: command 'gcc' failed with exit code 1", "no C compiler"),
            ("fatal error: Python.h: No such file or directory", "no C compiler"),
            ("ERROR: No matching distribution found for uv", "does not exist for this Python"),
            ("No solution found\n  cause: Because a was not found", "(a was not found): run"),
            ("client error (Connect)\n  cause: dns error", "export HTTPS_PROXY="),
            ("invalid peer certificate: UnknownIssuer", "export PIP_CERT="),
            ("PermissionError: [Errno 13] Permission denied: 'x'", "sudo chown"),
        ],
    )
    def test_what_pip_says_becomes_one_sentence(self, output: str, sentence: str) -> None:
        explanation = explain_failure(output)
        assert explanation is not None
        assert sentence in explanation
        assert "\n" not in explanation

    def test_a_package_that_the_index_has_not_for_this_processor_is_named(self) -> None:
        explanation = explain_failure(
            "No solution found\n  cause: Because ros-rclpy==7.1.6"
            " has no wheels with a matching platform tag (e.g.,"
            " `manylinux_2_28_aarch64`) and you require ros-rclpy==7.1.6, we can conclude that your"
            " requirements are unsatisfiable."
        )
        assert explanation is not None
        assert "processor (ros-rclpy==7.1.6 has no wheels" in explanation
        assert "`manylinux_2_28_aarch64`" in explanation
        assert "): use Docker, docker run" in explanation

    def test_what_is_not_known_is_not_guessed(self) -> None:
        assert explain_failure("something new") is None

    def test_a_missing_system_library_is_named_with_its_remedy(self) -> None:
        error = "MuJoCo does not import (libGL.so.1: cannot open shared object file)"
        assert "libGL.so.1 belongs to the operating system: " in explain_missing_library(error)

    def test_another_import_error_stays_as_it_is(self) -> None:
        assert explain_missing_library("No module named 'nest'") == "No module named 'nest'"


def test_a_sourced_ros_distribution_does_not_reach_the_virtual_environment() -> None:
    sourced = {
        "PATH": "/usr/bin",
        "PYTHONPATH": "/opt/ros/jazzy/lib/python3.12/site-packages",
        "LD_LIBRARY_PATH": "/opt/ros/jazzy/lib",
        "AMENT_PREFIX_PATH": "/opt/ros/jazzy",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }
    assert clean_environment(sourced) == {"PATH": "/usr/bin"}


def test_the_extras_are_those_of_the_project() -> None:
    tomllib = pytest.importorskip("tomllib")
    text = (ROOT / "pyproject.toml").read_text("utf-8")
    declared = tomllib.loads(text)["project"]["optional-dependencies"]
    assert extras_of(text) == tuple(declared)


def test_progress_in_a_log_is_a_line_per_step_and_no_detail() -> None:
    stream = StringIO()
    progress = Progress(stream)
    progress.step("one")
    progress.detail("two")
    progress.fail("three")
    assert [row.partition("] ")[2] or row for row in stream.getvalue().splitlines()] == [
        "one",
        "three",
    ]


def test_progress_on_a_terminal_shows_details_in_place() -> None:
    class Terminal(StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    Progress(stream).detail("downloading")
    assert stream.getvalue().startswith("\r\x1b[K[")
    assert stream.getvalue().endswith("downloading")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A source tree with nothing to install in it."""
    (tmp_path / "pyproject.toml").write_text(PYPROJECT, "utf-8")
    return tmp_path


def environment_of(tree: Path, *extras: str) -> Environment:
    return Environment(tree, extras, Progress(StringIO()))


def test_the_modules_are_compiled_whatever_python_may_write_by_itself(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    environment = environment_of(tree)
    environment.python.parent.mkdir(parents=True)
    environment.python.symlink_to(sys.executable)
    (tree / "neuros").mkdir()
    (tree / "neuros" / "hooks.py").write_text("", "utf-8")
    environment.compile()
    cache = f"hooks.{sys.implementation.cache_tag}.pyc"
    assert (tree / "neuros" / "__pycache__" / cache).exists()


def test_what_an_update_has_left_of_packages_that_moved_is_removed(tmp_path: Path) -> None:
    kept = tmp_path / "neuros/snn/__pycache__/nest.pyc"
    left = [tmp_path / f"neuros/{name}/__pycache__/x.pyc" for name in ("gone", "snn/nir/deep")]
    for file in (kept, *left):
        file.parent.mkdir(parents=True)
        file.touch()
    (tmp_path / "neuros/snn/nest.py").touch()
    (tmp_path / "neuros/snn/nir/__pycache__").mkdir()
    remove_leftovers(tmp_path / "neuros")
    assert {path.name for path in tmp_path.rglob("*")} == {
        *("neuros", "snn", "nest.py", "__pycache__", "nest.pyc")
    }


@pytest.fixture(scope="module")
def pattern(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with nothing in it but pip."""
    folder = tmp_path_factory.mktemp("pattern") / ".venv"
    venv.create(folder, with_pip=True)
    return folder


class TestVirtualEnvironment:
    """A real one is kept where it can be used, and made anew where not."""

    def test_without_one_there_is_no_version(self, tree: Path) -> None:
        assert environment_of(tree).python_version() is None

    def test_a_whole_one_is_kept(self, pattern: Path) -> None:
        assert environment_of(pattern.parent).python_version() == sys.version_info[:2]

    def test_one_that_was_copied_from_elsewhere_is_not(self, pattern: Path, tree: Path) -> None:
        shutil.copytree(pattern, tree / ".venv", symlinks=True)
        assert environment_of(tree).python_version() is None

    def test_one_that_was_interrupted_is_not(self, pattern: Path) -> None:
        unfinished = pattern / "neuros-unfinished"
        unfinished.touch()
        assert environment_of(pattern.parent).python_version() is None
        unfinished.unlink()

    def test_one_whose_python_is_gone_is_not(self, tree: Path) -> None:
        venv.create(tree / ".venv", with_pip=False)
        (tree / ".venv" / "bin" / "python").unlink()
        assert environment_of(tree).python_version() is None

    def test_one_that_never_got_its_pip_is_not(self, tree: Path) -> None:
        venv.create(tree / ".venv", with_pip=False)
        assert environment_of(tree).python_version() is None


def run_script(script: Path, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a script with a Python that has no packages, as on a bare machine."""
    return subprocess.run(
        [getattr(sys, "_base_executable", sys.executable), str(script), *arguments],
        cwd=cwd, env=clean_environment(os.environ), capture_output=True, text=True, check=False,
    )  # fmt: skip


class TestLaunchScript:
    @pytest.fixture
    def copy(self, tmp_path: Path) -> Path:
        """``launch.py`` in a folder of its own, in which nothing was installed."""
        return Path(shutil.copy(ROOT / "launch.py", tmp_path))

    def test_without_an_installation_it_says_what_to_run(self, copy: Path) -> None:
        venv.create(copy.parent / "bare")
        bare = copy.parent / "bare" / "bin" / "python"
        done = subprocess.run([bare, copy], capture_output=True, text=True, check=False)
        assert done.returncode == 4
        install = copy.parent.resolve() / "install.py"
        assert done.stderr == f"launch.py: NeuROS is not installed here: run {install} first\n"

    @pytest.mark.parametrize("name", ["launch.py", "a link"])
    def test_it_goes_on_in_the_virtual_environment_beside_it(self, copy: Path, name: str) -> None:
        script = copy if name == copy.name else copy.parent / name
        if script != copy:
            script.symlink_to(copy)
        python = copy.parent / ".venv" / "bin" / "python"
        python.parent.mkdir(parents=True)
        (copy.parent / ".venv" / "pyvenv.cfg").touch()
        python.write_text(
            '#!/bin/sh\necho "$@" [$LD_LIBRARY_PATH] [$PYTHONPATH]\nexit 7\n', "utf-8"
        )
        python.chmod(0o755)
        environment = {
            **clean_environment(os.environ),
            "AMENT_PREFIX_PATH": "/opt/ros/jazzy",
            "PYTHONPATH": "/opt/ros/jazzy/lib/python:/my/modules",
            "LD_LIBRARY_PATH": "/opt/ros/jazzy/lib:/my/lib",
        }
        done = subprocess.run(
            [getattr(sys, "_base_executable", sys.executable), script, "a b", "--dry-run"],
            cwd="/", env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 7
        assert done.stdout == f"{copy} a b --dry-run [/my/lib] [/my/modules]\n"


class TestContainers:
    """The options of ``install.py`` are those of the command that it hands over to."""

    def arguments(self, *given: str) -> list[str]:
        parsed = command.parse_options(given, command.STANDARD_EXTRAS)
        return list(build_arguments(parsed))

    def test_where_none_is_named_a_machine_without_docker_is_all_right(self) -> None:
        assert self.arguments() == ["containers", "build", "--if-engine"]

    def test_those_that_are_named_have_to_be_built(self) -> None:
        assert self.arguments("--containers", "a", "b") == ["containers", "build", "a", "b"]

    def test_every_option_is_one_of_the_command(self, tmp_path: Path) -> None:
        (tmp_path / "ca.pem").touch()
        given = ["--base-image", "debian:12", "--base-image", "a=debian:13", "--pull"]
        given += ["--wheelhouse", str(tmp_path), "--ca-bundle", str(tmp_path / "ca.pem")]
        understood = vars(parser().parse_args(self.arguments(*given)))
        assert understood["base_image"] == ["debian:12", "a=debian:13"]
        assert understood["wheelhouse"] == str(tmp_path)
        assert understood["ca_bundle"] == str(tmp_path / "ca.pem")
        assert understood["pull"]

    def test_a_wheelhouse_and_certificates_are_for_pip_as_well(self, tmp_path: Path) -> None:
        (tmp_path / "ca.pem").touch()
        given = ["--wheelhouse", str(tmp_path), "--ca-bundle", str(tmp_path / "ca.pem")]
        settings = pip_settings(command.parse_options(given, command.STANDARD_EXTRAS))
        assert settings == {
            "PIP_NO_INDEX": "1",
            "PIP_FIND_LINKS": str(tmp_path),
            "PIP_CERT": str(tmp_path / "ca.pem"),
        }

    def test_what_cannot_be_built_is_the_exit_code(self, tmp_path: Path) -> None:
        python = tmp_path / "python"
        python.write_text('#!/bin/sh\ncase "$*" in *containers*) exit 4 ;; esac\n')
        python.chmod(0o755)
        parsed, shown = command.parse_options([], command.STANDARD_EXTRAS), StringIO()
        assert command.build(python, ROOT, parsed, Progress(shown)) == 4
        assert "NeuROS is installed, but not all images were built" in shown.getvalue()


class TestDocumentation:
    def extras_for(self, *given: str) -> list[str]:
        return list(command.parse_options(given, [*command.STANDARD_EXTRAS, "dev", "docs"]).extras)

    def test_only_who_asks_for_it_gets_what_builds_it(self) -> None:
        assert self.extras_for() == sorted(command.STANDARD_EXTRAS)
        assert self.extras_for("--docs") == sorted(["docs", *command.STANDARD_EXTRAS])
        assert self.extras_for("--dev") == sorted(["dev", "docs", *command.STANDARD_EXTRAS])

    def test_it_is_built_by_the_one_command_that_is_documented(self, tmp_path: Path) -> None:
        python, known = tmp_path / "python", [*command.STANDARD_EXTRAS, "docs"]
        python.write_text(f'#!/bin/sh\necho "$@" >{tmp_path}/asked; [ "$1" = -c ]\n')
        python.chmod(0o755)
        options = command.parse_options(["--docs", "--no-containers"], known)
        assert command.build(python, ROOT, options, Progress(StringIO())) == 1
        assert (tmp_path / "asked").read_text() == f"{ROOT / 'docs' / 'make.py'}\n"
        assert "`docs/make.py`" in (ROOT / "CONTRIBUTING.md").read_text("utf-8")


class TestInstallScript:
    def test_help_names_every_exit_code(self, tmp_path: Path) -> None:
        done = run_script(ROOT / "install.py", "--help", cwd=tmp_path)
        assert done.returncode == 0
        assert "0 installed, 1 a test failed, 2 usage, 4 something is missing" in done.stdout

    def test_an_extra_that_does_not_exist_is_wrong_usage(self, tmp_path: Path) -> None:
        done = run_script(ROOT / "install.py", "--extras", "numpy", cwd=tmp_path)
        assert done.returncode == 2
        assert "no such extra: numpy (there are mujoco, " in done.stderr

    @pytest.mark.parametrize(
        ("arguments", "complaint"),
        [
            (["--containers", "a", "--no-containers"], "not allowed with argument --containers"),
            (["--wheelhouse", "nowhere"], "--wheelhouse nowhere: there is no such folder"),
            (["--ca-bundle", "nowhere"], "--ca-bundle nowhere: there is no such file"),
        ],
    )
    def test_what_contradicts_itself_or_is_not_there_is_wrong_usage(
        self, arguments: list[str], complaint: str, tmp_path: Path
    ) -> None:
        done = run_script(ROOT / "install.py", "-y", *arguments, cwd=tmp_path)
        assert done.returncode == 2
        assert complaint in done.stderr

    @pytest.mark.parametrize("script", ["install.py", "launch.py"])
    def test_an_old_python_can_read_it(self, script: str) -> None:
        ast.parse((ROOT / script).read_text("utf-8"), feature_version=(3, 4))
