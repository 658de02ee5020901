"""The package, without the checkout: what is in its wheel, and what that does when installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Iterator, Mapping
from email.parser import HeaderParser
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from browser import browser_page
from launching import start
from PIL import Image, ImageChops
from visitor import address

from neuros.backends.pythons import find_python
from neuros.installation.command import DEVELOPER_EXTRAS
from neuros.installation.machine import NEWEST_FOR_NEST, clean_environment
from neuros.installation.packages import LOCKS, Installer
from neuros.installation.progress import Progress

ROOT = Path(__file__).resolve().parents[1]
DATA = ("containers", "examples", "schema", "workspace")
SOURCES = ("neuros", "resource", *DATA, "tests/integration/back_ends")
SCREENSHOTS = ROOT / "build" / "screenshots"
IS_DRAWN = "() => Number(document.querySelector('#world').dataset.drawn ?? 0) > 2"
FILES = ("pyproject.toml", "setup.py", "package.xml", "MANIFEST.in", "README.md", "LICENSE")
LEFT_BEHIND = shutil.ignore_patterns("__pycache__", "runs", "build", "*.egg-info")
EXTENSIONS = sorted(ROOT.glob("extensions/*"))
PYTHONS = [(3, minor) for minor in range(10, NEWEST_FOR_NEST[1] + 1)]
_DIGESTS = """
from neuros.backends.containers import OWN_FOLDER, find_recipe, names_in
print({name: find_recipe(name).digest for name in names_in(OWN_FOLDER)})
"""


class Extension(NamedTuple):
    """Its folder in the checkout, and its wheel."""

    folder: Path
    wheel: Path

    @property
    def package(self) -> str:
        return self.folder.name.replace("-", "_")


def files_in(folder: Path) -> Iterator[str]:
    """All but what runs and Python leave, relative to the folder."""
    for file in folder.rglob("*"):
        if file.is_file() and not {"__pycache__", "runs"} & {*file.relative_to(folder).parts}:
            yield str(file.relative_to(folder))


def run(*command: object, cwd: Path, environ: Mapping[str, str]) -> str:
    """What a command says, which must end well."""
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env={**environ, "NEUROS_GUI": "0"},
        capture_output=True,
        text=True,
        timeout=550,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


EXTRACTION: Any = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
"""Python 3.11.2, of Debian 12, has no filters yet."""


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an sdist, made of a copy of the checkout, and a wheel, made of the sdist."""
    folder = tmp_path_factory.mktemp("package")
    for name in SOURCES:
        shutil.copytree(ROOT / name, folder / "copy" / name, symlinks=True, ignore=LEFT_BEHIND)
    for name in FILES:
        shutil.copy(ROOT / name, folder / "copy")
    build(folder)
    return folder


def build(folder: Path) -> Path:
    """Make an sdist of the distribution in ``copy``, unpack it as ``sdist``, and make its wheel."""
    for kind, place in (("sdist", "copy"), ("wheel", "sdist")):
        code = f"import setuptools.build_meta as b; b.build_{kind}({str(folder)!r})"
        run(sys.executable, "-c", code, cwd=folder / place, environ=os.environ)
        for archive in folder.glob("*.tar.gz"):
            with tarfile.open(archive) as opened:
                opened.extractall(folder, **EXTRACTION)
            archive.with_name(archive.name.removesuffix(".tar.gz")).rename(folder / "sdist")
            archive.unlink()
    return wheel_in(folder)


def wheel_in(folder: Path) -> Path:
    (file,) = folder.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    return wheel_in(built)


@pytest.fixture(scope="module", params=EXTENSIONS, ids=lambda folder: folder.name)
def extension(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Extension:
    folder = tmp_path_factory.mktemp(request.param.name)
    shutil.copytree(request.param, folder / "copy", ignore=LEFT_BEHIND)
    return Extension(request.param, build(folder))


class TestWheel:
    @pytest.mark.parametrize("name", DATA)
    def test_it_has_the_folders_of_the_checkout(self, name: str, wheel: Path) -> None:
        start = f"neuros/{name}/"
        with zipfile.ZipFile(wheel) as opened:
            there = {n.removeprefix(start) for n in opened.namelist() if n.startswith(start)}
        assert there == {*files_in(ROOT / name)}

    def test_it_has_every_file_of_the_package(self, wheel: Path) -> None:
        with zipfile.ZipFile(wheel) as opened:
            assert {f"neuros/{name}" for name in files_in(ROOT / "neuros")} <= {*opened.namelist()}

    def test_it_has_no_tests(self, built: Path) -> None:
        assert not (built / "sdist" / "tests").exists()

    def test_an_index_can_show_it(self, wheel: Path) -> None:
        with zipfile.ZipFile(wheel) as opened:
            (name,) = (n for n in opened.namelist() if n.endswith("/METADATA"))
            shown = HeaderParser().parsestr(opened.read(name).decode())
        for key in ("Author", "Project-URL", "Keywords", "License-Expression"):
            assert shown[key]
        assert "Operating System :: POSIX :: Linux" in shown.get_all("Classifier", [])
        assert shown["Description-Content-Type"] == "text/markdown"


def test_the_wheel_of_an_extension_has_every_file_of_its_package(extension: Extension) -> None:
    with zipfile.ZipFile(extension.wheel) as opened:
        there = {name for name in opened.namelist() if ".dist-info/" not in name}
    package = extension.package
    assert there == {f"{package}/{name}" for name in files_in(extension.folder / package)}


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """An environment whose ``neuros`` is the wheel's; all it depends on is that of the tests."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as opened:
        opened.extractall(folder)
    (script,) = folder.glob("*.data/scripts/neuros")
    (folder / "bin").mkdir()
    shutil.copy(script, folder / "bin")
    (folder / "bin" / "neuros").chmod(0o755)
    path = os.pathsep.join(
        [str(folder / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]]
    )
    return {**os.environ, "PYTHONPATH": str(folder), "PATH": path}


class TestInstalled:
    def test_it_knows_nothing_of_the_checkout(
        self, installed: Mapping[str, str], tmp_path: Path
    ) -> None:
        code = "from neuros.distribution import *; print(PACKAGE, EXAMPLES, is_checkout())"
        said = run("python3", "-c", code, cwd=tmp_path, environ=installed)
        folder = installed["PYTHONPATH"]
        assert said.split() == [f"{folder}/neuros", f"{folder}/neuros/examples", "False"]

    def test_its_containers_are_those_of_the_checkout(
        self, installed: Mapping[str, str], tmp_path: Path
    ) -> None:
        there = run("python3", "-c", _DIGESTS, cwd=tmp_path, environ=installed)
        assert "neuros_nest" in there
        assert there == run(sys.executable, "-c", _DIGESTS, cwd=ROOT, environ=os.environ)

    @pytest.mark.ros
    def test_a_new_project_runs(self, installed: Mapping[str, str], tmp_path: Path) -> None:
        said = run("neuros", "new", "mine", cwd=tmp_path, environ=installed)
        assert said == "made mine; the next command: neuros launch mine\n"
        command = ("neuros", "launch", "mine", "--backend", "in-process", "-o", "run")
        assert "the heading is 0.0001 rad" in run(*command, cwd=tmp_path, environ=installed)
        record = json.loads((tmp_path / "run" / "run.json").read_text("utf-8"))
        assert record["exit_code"] == 0

    def test_a_copied_example_is_valid(self, installed: Mapping[str, str], tmp_path: Path) -> None:
        """This one needs the workspace, and a container of its own."""
        run("neuros", "example", "whiskeye", cwd=tmp_path, environ=installed)
        for project in ("whiskeye", "whiskeye/homing.json", "whiskeye/nengo.json"):
            said = run("neuros", "validate", project, cwd=tmp_path, environ=installed)
            assert ": valid: " in said


def see_a_robot_that_turns(project: Path, environ: Mapping[str, str], screenshots: Path) -> None:
    """Launch with the dashboard, and look at its page in a browser until the robot has turned.

    The pictures, of before and after, are for whoever releases.
    """
    program = shutil.which("neuros", path=environ["PATH"])
    assert program is not None
    lasting = ("--set", "nodes.robot.environment.DURATION=1000")
    screenshots.mkdir(parents=True, exist_ok=True)
    with (
        start(
            project,
            *("--dashboard", "--backend", "process", *lasting),
            cwd=project.parent,
            program=(program, "launch"),
            PATH=environ["PATH"],
        ) as running,
        browser_page() as page,
    ):
        page.set_default_timeout(120_000)  # without a graphics card
        page.on("dialog", lambda question: question.accept())
        page.goto(address(running))
        page.wait_for_function(IS_DRAWN)
        page.click("#pause")
        page.wait_for_selector("#phase.paused")
        view = page.locator("#world canvas")
        before = view.screenshot()
        page.screenshot(path=screenshots / "before.png")
        page.click("#resume")
        page.wait_for_selector("#phase.running")
        give_up_s = time.monotonic() + 120
        while differing_pixels(before, view.screenshot()) < 100:
            assert time.monotonic() < give_up_s, "the robot does not move"
        page.screenshot(path=screenshots / "after.png")
        page.click("#stop")
        page.wait_for_selector("#phase.ended")
        assert running.finish().exit_code == 0


def differing_pixels(one: bytes, other: bytes) -> int:
    """How many pixels of two pictures (PNG) are of another colour."""
    pictures = [Image.open(BytesIO(each)).convert("RGB") for each in (one, other)]
    difference = ImageChops.difference(*pictures).convert("L")
    return sum(difference.histogram()[40:])


@pytest.mark.acceptance
@pytest.mark.ros
@pytest.mark.parametrize("version", PYTHONS, ids=lambda version: ".".join(map(str, version)))
def test_three_commands_lead_to_a_robot_that_moves(
    version: tuple[int, int], wheel: Path, tmp_path: Path
) -> None:
    """In an empty environment, with what it needs from the index; ``.ci/bare`` does it with pip."""
    python = find_python(version, os.environ)
    if python is None:
        pytest.skip(f"there is no Python {version} on this machine")
    environ = clean_environment(os.environ)
    environ.pop("VIRTUAL_ENV", None)
    run(python, "-m", "venv", tmp_path / "venv", cwd=tmp_path, environ=environ)
    environ["PATH"] = f"{tmp_path / 'venv' / 'bin'}{os.pathsep}{environ['PATH']}"
    made, progress = tmp_path / "venv", Progress(sys.stdout)
    installer = Installer(made / "bin" / "python", made, tmp_path / "log", progress, environ)
    dashboard = ROOT / "extensions" / "neuros-dashboard"
    installer.install([f"{wheel}[mujoco,nest,plot]", str(dashboard)])
    run("neuros", "example", "whiskeye", cwd=tmp_path, environ=environ)
    see_a_robot_that_turns(
        tmp_path / "whiskeye", environ, SCREENSHOTS / ".".join(map(str, version))
    )
    command = ("neuros", "launch", "whiskeye", "--backend", "process", "-o", "run")
    assert "head-direction error: RMS" in run(*command, cwd=tmp_path, environ=environ)
    for example in ("clock", "voting", "elevator"):
        run("neuros", "example", example, cwd=tmp_path, environ=environ)
        run("neuros", "launch", example, "--duration", "2", cwd=tmp_path, environ=environ)
    run("neuros", "doctor", cwd=tmp_path, environ=environ)


@pytest.mark.acceptance
def test_the_tests_of_an_extension_pass_beside_the_wheel_of_the_core_alone(
    extension: Extension, wheel: Path, tmp_path: Path
) -> None:
    """In an environment with all third parties that developers have, and no other extension."""
    environ, made = clean_environment(os.environ), tmp_path / "venv"
    environ.pop("VIRTUAL_ENV", None)
    run(sys.executable, "-m", "venv", made, cwd=tmp_path, environ=environ)
    python, progress = made / "bin" / "python", Progress(sys.stdout)
    installer = Installer(python, made, tmp_path / "log", progress, environ)
    own = extension.folder.name.removeprefix("neuros-")
    for names in (["build"], ["core", "mujoco", "nest", "plot", own, *DEVELOPER_EXTRAS]):
        locks = [word for name in names for word in ("-r", f"{ROOT}/{LOCKS}/{name}.txt")]
        installer.install(["--no-build-isolation", "--require-hashes", "--no-deps", *locks])
    installer.install(["--no-deps", str(wheel), str(extension.wheel)])

    copy = tmp_path / "checkout"  # without neuros/
    for part in ("tests", "benchmarks", "examples", f"extensions/{extension.folder.name}"):
        shutil.copytree(ROOT / part, copy / part, symlinks=True, ignore=LEFT_BEHIND)
    shutil.rmtree(copy / "extensions" / extension.folder.name / extension.package)
    for name in ("conftest.py", "pyproject.toml"):
        shutil.copy(ROOT / name, copy)
    code = f"import neuros, {extension.package} as other; print(neuros.__file__, other.__file__)"
    for place in run(python, "-c", code, cwd=copy, environ=environ).split():
        assert Path(place).is_relative_to(made)
    print(run(python, "-m", "pytest", "-q", "extensions", cwd=copy, environ=environ))
