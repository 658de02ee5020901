"""Packages are installed with uv, as the lock files say, which fit ``pyproject.toml``."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import threading
import venv
import zipfile
from collections.abc import Iterator
from functools import cache, partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from io import StringIO
from pathlib import Path

import pytest
from packages import make_wheel
from packaging.requirements import Requirement
from packaging.version import Version

from neuros.errors import EnvironmentFault
from neuros.installation.command import extras_of
from neuros.installation.machine import NEWEST, OLDEST, clean_environment, dotted
from neuros.installation.packages import (
    LOCKS,
    UV,
    InstallationFailed,
    Installer,
    explain_failure,
    find_uv,
    install,
    make_venv,
    uv_environment,
)
from neuros.installation.progress import Progress

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = [dotted((3, minor)) for minor in range(OLDEST[1], NEWEST[1] + 1)]
PACKAGE = re.compile(r"^(?P<pin>\S+==[^\\\n]+?) \\\n(?P<hashes>(?:    --hash=.+\n)+)", re.MULTILINE)


def platform_of(python: str) -> dict[str, str]:
    """What markers say on a machine that NeuROS is for."""
    return {
        "python_version": python,
        "python_full_version": f"{python}.1",
        "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
        "sys_platform": "linux",
        "platform_system": "Linux",
        "platform_machine": "x86_64",
        "os_name": "posix",
        "extra": "",
    }


@cache
def packages_of(name: str) -> list[Requirement]:
    """The pinned packages of a lock file."""
    text = (ROOT / LOCKS / f"{name}.txt").read_text("utf-8")
    return [Requirement(match["pin"]) for match in PACKAGE.finditer(text)]


def locked(python: str, *names: str) -> Iterator[tuple[str, Version]]:
    """The packages that some lock files hold for a version of Python."""
    for package in (package for name in names for package in packages_of(name)):
        if package.marker is None or package.marker.evaluate(platform_of(python)):
            (pin,) = package.specifier
            yield package.name, Version(pin.version)


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def asked_for() -> Iterator[tuple[str, str]]:
    """Each requirement of NeuROS and its extensions, with the lock file that it belongs to."""
    tomllib = pytest.importorskip("tomllib")
    table = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    project = table["project"]
    groups = {"core": project["dependencies"], **project["optional-dependencies"]}
    groups |= {"build": table["build-system"]["requires"], "uv": [UV]}
    for folder in (ROOT / "extensions").iterdir():
        project = tomllib.loads((folder / "pyproject.toml").read_text("utf-8"))["project"]
        groups[folder.name.removeprefix("neuros-")] = project["dependencies"]
        groups |= project.get("optional-dependencies", {})
    for group, needs in groups.items():
        yield from ((group, need) for need in needs if not need.startswith("neuros"))


class TestLockFiles:
    def test_there_is_one_for_the_core_and_for_each_extra(self) -> None:
        extras = extras_of((ROOT / "pyproject.toml").read_text("utf-8"))
        names = {file.stem for file in (ROOT / LOCKS).glob("*.txt")}
        assert names == {"build", "core", "uv", *extras}

    @pytest.mark.parametrize("python", PYTHONS)
    def test_they_hold_what_the_project_asks_for(self, python: str) -> None:
        missing = []
        for group, text in asked_for():
            need = Requirement(text)
            if need.marker is None or need.marker.evaluate(platform_of(python)):
                there = dict(locked(python, "core", group)).get(canonical(need.name))
                if there is None or not need.specifier.contains(there):
                    missing.append(f"{group}: {text}, and {there} is locked: run .ci/lock")
        assert missing == []

    @pytest.mark.parametrize("python", PYTHONS)
    def test_they_agree_on_one_version_of_each_package(self, python: str) -> None:
        versions: dict[str, set[Version]] = {}
        for file in (ROOT / LOCKS).glob("*.txt"):
            for name, version in locked(python, file.stem):
                versions.setdefault(name, set()).add(version)
        assert {name: each for name, each in versions.items() if len(each) > 1} == {}

    @pytest.mark.parametrize("file", sorted((ROOT / LOCKS).glob("*.txt")), ids=lambda f: f.stem)
    def test_every_line_is_a_comment_a_pinned_package_or_its_hash(self, file: Path) -> None:
        rest = PACKAGE.sub("", file.read_text("utf-8"))
        assert rest == "# .ci/lock wrote this file: do not edit it.\n"


def settings_of(listing: str, environ: dict[str, str]) -> dict[str, str]:
    """The variables that uv gets in place of, or besides, those of ``environ``."""
    found, unknown = uv_environment(listing, environ)
    assert unknown == []
    ours = {k: v for k, v in found.items() if environ.get(k) != v}
    return {k: v for k, v in ours.items() if k not in ("UV_COMPILE_BYTECODE", "UV_SYSTEM_CERTS")}


class TestSettingsOfPip:
    """uv gets what pip is told; it reads none of it by itself."""

    def test_indexes_proxies_and_certificates_are_passed_on(self) -> None:
        listing = (
            "global.index-url='https://mirror/simple'\n"
            "global.extra-index-url='https://one/simple\\nhttps://two/simple'\n"
            ":env:.cert='/my.pem'\n"
            ":env:.proxy='http://proxy:3128'\n"
            "install.trusted-host='mirror'\n"
        )
        assert settings_of(listing, {"SSL_CERT_FILE": "/other.pem"}) == {
            "UV_DEFAULT_INDEX": "https://mirror/simple",
            "UV_INDEX": "https://one/simple\nhttps://two/simple",
            "SSL_CERT_FILE": "/my.pem",
            "HTTPS_PROXY": "http://proxy:3128",
            "HTTP_PROXY": "http://proxy:3128",
            "ALL_PROXY": "http://proxy:3128",
            "UV_INSECURE_HOST": "mirror",
        }

    def test_a_variable_comes_before_a_file(self) -> None:
        listing = ":env:.index-url='https://b'\nglobal.index-url='https://a'\n"
        settings = settings_of(listing, {"SSL_CERT_FILE": "/my.pem"})
        assert settings == {"UV_DEFAULT_INDEX": "https://b"}

    def test_what_the_user_tells_uv_itself_stays(self) -> None:
        environ = {"UV_DEFAULT_INDEX": "https://mine", "SSL_CERT_FILE": "/my.pem"}
        assert settings_of("global.index-url='https://a'\n", environ) == {}

    def test_folders_of_wheels_that_are_not_there_are_left_out(self, tmp_path: Path) -> None:
        settings = settings_of(f"global.find-links='{tmp_path} {tmp_path}/no https://wheels'\n", {})
        assert settings == {"UV_FIND_LINKS": f"{tmp_path},https://wheels"}

    @pytest.mark.parametrize("name", ["REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE"])
    def test_certificates_for_requests_are_for_uv_too(self, name: str) -> None:
        assert settings_of("", {name: "/my.pem"}) == {"SSL_CERT_FILE": "/my.pem"}

    def test_settings_that_uv_has_not_are_named(self) -> None:
        assert uv_environment("global.keyring-provider='import'\n", {})[1] == ["keyring-provider"]

    def test_settings_of_the_output_do_not_matter(self) -> None:
        assert settings_of("global.quiet='1'\n", {}) == {}


def program(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n", "utf-8")
    path.chmod(0o755)
    return path


class TestUv:
    def test_the_one_beside_python_comes_first(self, tmp_path: Path) -> None:
        beside = program(tmp_path / "bin" / "uv", "")
        assert find_uv(tmp_path / "bin" / "python") == beside

    def test_else_the_one_of_this_python_is_used(self, tmp_path: Path) -> None:
        assert find_uv(tmp_path / "bin" / "python") == Path(sys.executable).with_name("uv")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("echo No module named venv >&2; exit 1", "has no venv: "),
        ("echo first; echo last; exit 1", "last"),
        (
            "echo '[Errno 28] No space left on device'; exit 1",
            "the disk is full: make room (df -h)",
        ),
    ],
)
def test_why_there_is_no_virtual_environment_is_said(text: str, why: str, tmp_path: Path) -> None:
    python = program(tmp_path / "python3.12", text)
    said = make_venv([str(python), "-m", "venv", "x"], os.environ)
    assert why in said
    assert ("python3.12-venv" in said) == ("has no venv" in why)
    assert make_venv([str(tmp_path / "none")], os.environ).endswith("/none cannot be started")


@pytest.fixture
def environ(tmp_path: Path) -> dict[str, str]:
    """An environment in which pip knows one folder of wheels, and nothing else."""
    return {
        **{
            k: v
            for k, v in clean_environment(os.environ).items()
            if not k.startswith(("PIP_", "UV_"))
        },
        "PIP_CONFIG_FILE": os.devnull,
        "PIP_NO_INDEX": "1",
        "PIP_FIND_LINKS": str(tmp_path / "wheels"),
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        "PATH": "/usr/bin:/bin",
    }


@pytest.fixture(scope="module")
def with_pip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a virtual environment that has pip."""
    folder = tmp_path_factory.mktemp("with_pip")
    venv.create(folder, with_pip=True)
    return folder / "bin" / "python"


def empty(python: Path) -> None:
    """Remove from its virtual environment what a test has installed."""
    folder = python.parent.parent
    python.with_name("uv").unlink(missing_ok=True)
    (folder / "log").unlink(missing_ok=True)
    for name in ("neuros*", "uv*"):
        for path in folder.glob(f"lib/*/site-packages/{name}"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


@pytest.fixture
def python(with_pip: Path) -> Iterator[Path]:
    yield with_pip
    empty(with_pip)


def is_installed(python: Path) -> bool:
    return bool([*python.parents[1].glob("lib/*/site-packages/neuros_colour.py")])


class TestInstaller:
    """From a folder of wheels, without a network."""

    def run(self, python: Path, environ: dict[str, str]) -> str:
        """Install; returns what was shown."""
        stream, folder = StringIO(), python.parent.parent
        make_wheel(Path(environ["PIP_FIND_LINKS"]), "neuros_colour", "1.0", "NAME = 'red'")
        installer = Installer(python, folder, folder / "log", Progress(stream), environ)
        installer.require_uv()
        installer.install(["neuros_colour"])
        return stream.getvalue()

    def test_what_uv_says_is_the_error(self, python: Path, environ: dict[str, str]) -> None:
        program(python.with_name("uv"), "echo No space left on device; exit 2")
        with pytest.raises(InstallationFailed, match="No space left on device"):
            self.run(python, environ)
        assert not is_installed(python)
        assert "No space left" in (python.parent.parent / "log").read_text("utf-8")

    @pytest.mark.parametrize(("no_index", "option"), [("1", " --no-index"), ("false", "")])
    def test_uv_gets_the_settings_of_pip(
        self, python: Path, environ: dict[str, str], no_index: str, option: str
    ) -> None:
        program(python.with_name("uv"), 'echo "$@" "[$UV_FIND_LINKS]"')
        self.run(python, {**environ, "PIP_NO_INDEX": no_index})
        log = (python.parent.parent / "log").read_text("utf-8")
        assert f"--python {python}{option} neuros_colour [{environ['PIP_FIND_LINKS']}]" in log

    @pytest.mark.parametrize(("set_to", "is_told"), [(None, "1"), ("0", "0")])
    def test_modules_are_compiled_unless_the_user_tells_uv_not_to(
        self, python: Path, environ: dict[str, str], set_to: str | None, is_told: str
    ) -> None:
        program(python.with_name("uv"), 'echo "[$UV_COMPILE_BYTECODE]"')
        self.run(python, environ | ({"UV_COMPILE_BYTECODE": set_to} if set_to else {}))
        assert f"[{is_told}]" in (python.parent.parent / "log").read_text("utf-8")

    def test_a_setting_that_uv_has_not_is_named(
        self, python: Path, environ: dict[str, str]
    ) -> None:
        shown = self.run(python, {**environ, "PIP_PRE": "1"})
        assert "uv has no setting like pip's pre, and goes without" in shown
        assert is_installed(python)

    def test_where_there_is_no_uv_pip_installs_it(
        self, python: Path, environ: dict[str, str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sys, "executable", "/nowhere/python")
        wheels = Path(environ["PIP_FIND_LINKS"])
        wheels.mkdir()
        with zipfile.ZipFile(wheels / "uv-0.9.1-py3-none-any.whl", "w") as wheel:
            info = "Metadata-Version: 2.1\nName: uv\nVersion: 0.9.1\n"
            wheel.writestr("uv-0.9.1.dist-info/METADATA", info)
            kind = "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
            wheel.writestr("uv-0.9.1.dist-info/WHEEL", kind)
            script = zipfile.ZipInfo("uv-0.9.1.data/scripts/uv")
            script.external_attr = 0o100755 << 16
            wheel.writestr(script, "#!/bin/sh\necho this uv\n")
            rows = "uv-0.9.1.dist-info/METADATA,,\nuv-0.9.1.dist-info/WHEEL,,\n"
            wheel.writestr("uv-0.9.1.dist-info/RECORD", rows)
        self.run(python, environ)
        assert "this uv" in (python.parent.parent / "log").read_text("utf-8")

    def test_a_folder_of_wheels_without_uv_is_said_to_lack_it(
        self, python: Path, environ: dict[str, str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sys, "executable", "/nowhere/python")
        with pytest.raises(EnvironmentFault, match=r"No matching distribution found for uv.*house"):
            install(python, ROOT, ["plot"], Progress(StringIO()), environ)

    @pytest.mark.parametrize("has_uv", [True, False])
    def test_an_index_that_cannot_be_reached_is_said(
        self,
        python: Path,
        environ: dict[str, str],
        monkeypatch: pytest.MonkeyPatch,
        has_uv: bool,
    ) -> None:
        if not has_uv:
            monkeypatch.setattr(sys, "executable", "/nowhere/python")
        online = {k: v for k, v in environ.items() if k not in ("PIP_NO_INDEX", "PIP_FIND_LINKS")}
        online |= {"PIP_INDEX_URL": "http://127.0.0.1:9/", "PIP_RETRIES": "1", "UV_NO_CACHE": "1"}
        with pytest.raises(EnvironmentFault, match=r"^the package index .* cannot be reached"):
            install(python, ROOT, ["plot"], Progress(StringIO()), online)


class TestHashes:
    """A file is installed only if a lock file names its hash."""

    @pytest.fixture
    def index(self, tmp_path: Path) -> Iterator[dict[str, str]]:
        """An index with one package on this machine, as an environment of pip."""
        wheel = make_wheel(tmp_path / "simple/neuros-colour", "neuros_colour", "1.0")
        page = f'<a href="{wheel.name}">{wheel.name}</a>'
        wheel.with_name("index.html").write_text(page, "utf-8")
        handler = partial(QuietHandler, directory=str(tmp_path))
        with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            yield {
                **{k: v for k, v in clean_environment(os.environ).items() if k[:4] != "PIP_"},
                "PIP_CONFIG_FILE": os.devnull,
                "PIP_INDEX_URL": f"http://127.0.0.1:{server.server_port}/simple",
                "PATH": "/usr/bin:/bin",
                "UV_NO_CACHE": "1",
            }
            server.shutdown()
            thread.join()

    def install(self, python: Path, hashes: str, index: dict[str, str], tmp_path: Path) -> str:
        """Install a tree that asks for the package; returns what was shown."""
        tree, stream = tmp_path / "tree", StringIO()
        (tree / "requirements").mkdir(parents=True)
        for name in ("build", "core", "uv"):
            text = f"neuros-colour==1.0{hashes}\n" if name == "core" else ""
            (tree / "requirements" / f"{name}.txt").write_text(text, "utf-8")
        (tree / "pyproject.toml").write_text(
            '[build-system]\nrequires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n'
        )
        wheel = make_wheel(tree, "neuros", "2.0")
        (tree / "backend.py").write_text(
            "import shutil, pathlib\n"
            "def build_editable(target, config_settings=None, metadata_directory=None):\n"
            f"    return pathlib.Path(shutil.copy({str(wheel)!r}, target)).name\n"
        )
        install(python, tree, [], Progress(stream), index)
        return stream.getvalue()

    def sha256(self, tmp_path: Path) -> str:
        wheel = next(tmp_path.rglob("neuros_colour*.whl"))
        return hashlib.sha256(wheel.read_bytes()).hexdigest()

    def test_a_file_that_the_lock_file_names_is_installed(
        self, python: Path, index: dict[str, str], tmp_path: Path
    ) -> None:
        self.install(python, f" --hash=sha256:{self.sha256(tmp_path)}", index, tmp_path)
        assert is_installed(python)

    def test_constraints_of_pip_need_no_hash(
        self, python: Path, index: dict[str, str], tmp_path: Path
    ) -> None:
        """The lock file names each version, so they have nothing to say; uv takes none there."""
        constraints = tmp_path / "constraints.txt"
        constraints.write_text("neuros-shape<=2\n", "utf-8")
        constrained = {**index, "PIP_CONSTRAINT": str(constraints)}
        hashes = f" --hash=sha256:{self.sha256(tmp_path)}"
        self.install(python, hashes, constrained, tmp_path)
        assert is_installed(python)

    def test_a_file_that_has_changed_since_is_refused(
        self, python: Path, index: dict[str, str], tmp_path: Path
    ) -> None:
        before = self.sha256(tmp_path)
        make_wheel(tmp_path / "simple/neuros-colour", "neuros_colour", "1.0", "CHANGED = True")
        with pytest.raises(EnvironmentFault, match=r"is not the one that the lock file names"):
            self.install(python, f" --hash=sha256:{before}", index, tmp_path)
        assert not is_installed(python)

    def test_a_package_without_a_hash_is_refused(
        self, python: Path, index: dict[str, str], tmp_path: Path
    ) -> None:
        with pytest.raises(EnvironmentFault):
            self.install(python, "", index, tmp_path)
        assert not is_installed(python)


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves a folder and says nothing."""

    def log_message(self, *_: object) -> None:
        pass


@pytest.mark.parametrize(
    "output",
    [
        "ERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS FILE. If you ...",
        "  × Failed to download `jsonschema==4.26.0`\n  ╰─▶ Hash mismatch for `jsonschema==4.26.0`",
    ],
)
def test_a_package_with_another_hash_is_told_in_one_sentence(output: str) -> None:
    explanation = explain_failure(output)
    assert explanation is not None
    assert explanation.startswith("a package on the index is not the one that the lock file names")
    assert "--newest" in explanation
