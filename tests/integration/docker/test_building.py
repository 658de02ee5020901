"""Images, built by a real engine through the command line, as ``install.py`` calls it."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import uuid
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from deadlines import wait_until
from docker.context import ContextAPI
from docker.errors import APIError
from needs import cannot_run

from containers import connected, require_containers
from neuros.backends.docker.building import context_of, pulled
from neuros.backends.docker.images import image_for
from neuros.cli.main import main
from neuros.errors import EnvironmentFault


@pytest.fixture(scope="module")
def engine() -> Iterator[Any]:
    """An engine that has NeuROS's base image."""
    require_containers("neuros_python")
    with connected() as engine:
        yield engine


class Bench:
    """A project with one container of its own, whose name nobody else has."""

    def __init__(self, folder: Path, engine: Any, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self.engine, self._capsys = folder, engine, capsys
        self.name = f"test_{uuid.uuid4().hex[:10]}"
        self.recipe = folder / "containers" / self.name
        self.recipe.mkdir(parents=True)
        self.wheels = folder / "wheels"
        self.wheels.mkdir()

    def write(self, dockerfile: str) -> None:
        (self.recipe / "Dockerfile").write_text(dockerfile)

    def require(self, *rows: str) -> None:
        (self.recipe / "requirements.txt").write_text("\n".join(rows))

    def wheel(self, name: str, version: str) -> None:
        """Put a package with one module into the wheelhouse."""
        about = f"{name}-{version}.dist-info"
        files = {
            f"{name}.py": f"version = '{version}'\n",
            f"{about}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
            f"{about}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        }
        with zipfile.ZipFile(self.wheels / f"{name}-{version}-py3-none-any.whl", "w") as archive:
            for file, content in files.items():
                archive.writestr(file, content)
            record = "".join(f"{file},,\n" for file in [*files, f"{about}/RECORD"])
            archive.writestr(f"{about}/RECORD", record)

    def build(self, *options: str) -> tuple[int, str, str]:
        """The exit code, standard output, and the last line of standard error."""
        code = main(["containers", "build", str(self.recipe), *options])
        written = self._capsys.readouterr()
        return code, written.out, (written.err.splitlines() or [""])[-1]

    def containers(self, *arguments: str) -> str:
        assert main(["containers", *arguments]) == 0
        return self._capsys.readouterr().out

    def run(self, *command: str) -> str:
        """What a command prints in the image."""
        image = image_for(self.name, self.folder, self.engine)
        container = self.engine.containers.create(
            image.id, entrypoint=[*command], network_mode="none"
        )
        try:
            container.start()
            container.wait()
            return container.logs().decode()
        finally:
            container.remove(force=True)

    def remove_images(self) -> None:
        """Those with a name, and the steps of builds that failed, which the engine keeps."""
        for tag in self.tags:
            self.engine.images.remove(tag)
        log = self.folder / "cache" / "neuros" / "builds" / f"{self.name}.log"
        steps = re.findall(r"---> ([0-9a-f]{12})$", log.read_text() if log.exists() else "", re.M)
        for step in steps[-1:]:
            with suppress(APIError):  # it is in use, or is gone with the tag
                if not self.engine.images.get(step).tags:
                    self.engine.images.remove(step)

    @property
    def tags(self) -> list[str]:
        return [tag for image in self.engine.images.list(self.name) for tag in image.tags]


@pytest.fixture
def bench(
    tmp_path: Path,
    engine: Any,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Bench]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    containers_before = {each.id for each in engine.containers.list(all=True, ignore_removed=True)}
    bench = Bench(tmp_path, engine, capsys)
    yield bench
    bench.remove_images()
    left = [
        each
        for each in engine.containers.list(all=True, ignore_removed=True)
        if each.id not in containers_before
        and each.labels.get("neuros.image.container") == bench.name
    ]
    assert not left


PYTHON = "/opt/neuros/bin/python"


class TestRequirements:
    """A ``requirements.txt`` is enough; the wheels come from a folder."""

    @pytest.fixture
    def options(self, bench: Bench) -> tuple[str, ...]:
        bench.wheel("neurosprobe", "1.0")
        bench.wheel("neurosprobe", "2.0")
        return ("--wheelhouse", str(bench.wheels))

    def test_they_are_installed_beside_what_nodes_need(
        self, bench: Bench, options: tuple[str, ...]
    ) -> None:
        bench.require("neurosprobe==1.0")
        code, out, _ = bench.build(*options)
        assert (code, f"{bench.name}: built in " in out) == (0, True)
        program = "import neurosprobe, rclpy, os; print(neurosprobe.version, os.getuid())"
        assert bench.run(PYTHON, "-c", program).split() == ["1.0", "1000"]
        image = image_for(bench.name, bench.folder, bench.engine)
        assert (image.start, image.notice) == ((PYTHON,), "")

    def test_what_is_built_is_not_built_again(self, bench: Bench, options: tuple[str, ...]) -> None:
        bench.require("neurosprobe==1.0")
        bench.build(*options)
        before = bench.engine.images.get(bench.tags[0]).id
        _, out, _ = bench.build(*options)
        assert f"{bench.name}: up to date" in out
        assert bench.engine.images.get(bench.tags[0]).id == before

    def test_after_a_change_the_old_one_serves_with_a_notice_until_the_new_one_replaces_it(
        self, bench: Bench, options: tuple[str, ...]
    ) -> None:
        bench.require("neurosprobe==1.0")
        bench.build(*options)
        (old,) = bench.tags
        bench.require("neurosprobe==2.0")
        notice = image_for(bench.name, bench.folder, bench.engine).notice
        assert "is older than its recipe: run ./install.py --containers " in notice
        bench.build(*options)
        assert bench.tags != [old]
        assert len(bench.tags) == 1
        program = "import neurosprobe; print(neurosprobe.version)"
        assert bench.run(PYTHON, "-c", program).split() == ["2.0"]

    def test_what_cannot_be_had_is_named_and_the_image_that_was_there_stays(
        self, bench: Bench, options: tuple[str, ...]
    ) -> None:
        bench.require("neurosprobe==1.0")
        bench.build(*options)
        before = bench.tags
        bench.require("neurosprobe==3.0")
        code, _, error = bench.build(*options)
        assert code == 4
        assert (
            f"image '{bench.name}' cannot be built: ERROR: Could not find a version that satisfies"
            " the requirement neurosprobe==3.0" in error
        )
        assert bench.tags == before

    def test_what_excludes_each_other_is_said(self, bench: Bench, options: tuple[str, ...]) -> None:
        bench.require("neurosprobe==1.0", "neurosprobe>1")
        code, _, error = bench.build(*options)
        assert (code, bench.tags) == (4, [])
        assert "ERROR: Cannot install neurosprobe==1.0 and neurosprobe>1 because" in error


class TestDockerfiles:
    def test_certificates_serve_the_build_and_are_gone_afterwards(self, bench: Bench) -> None:
        (bench.folder / "ca.pem").write_text("certificates\n")
        bench.write('FROM neuros_python\nRUN cat "$PIP_CERT" > /tmp/seen\n')
        code, _, _ = bench.build("--ca-bundle", str(bench.folder / "ca.pem"))
        assert code == 0
        assert bench.run("sh", "-c", "ls /tmp; cat /tmp/seen").split() == ["seen", "certificates"]
        assert bench.run("id", "-u").strip() == "1000"

    def test_an_argument_reaches_the_dockerfile_and_is_remembered(self, bench: Bench) -> None:
        bench.write("FROM neuros_python\nARG VARIANT=cpu\nENV VARIANT=$VARIANT\n")
        bench.build("--build-arg", "VARIANT=cuda")
        assert bench.run("sh", "-c", "echo $VARIANT").strip() == "cuda"
        _, out, _ = bench.build()
        assert f"{bench.name}: up to date" in out

    @pytest.mark.parametrize(
        ("step", "cause"),
        [
            ("RUN echo first && false", "returned a non-zero code: 1"),
            ("COPY nothing /", "nothing: "),
            ("RUN touch /x", "put USER 0 above it"),
        ],
    )
    def test_a_step_that_fails_is_shown_with_the_log_and_leaves_no_image(
        self, step: str, cause: str, bench: Bench
    ) -> None:
        bench.write(f"FROM neuros_python\n{step}\n")
        code, out, error = bench.build()
        assert (code, bench.tags) == (4, [])
        assert f"neuros: image '{bench.name}' cannot be built: " in error
        assert cause in error
        log = bench.folder / "cache" / "neuros" / "builds" / f"{bench.name}.log"
        assert f"(log: {log})" in error
        assert f" : {step}" in log.read_text()
        assert f" : {step}" in out

    def test_a_base_image_that_would_not_be_used_is_refused_before_anything_is_built(
        self, bench: Bench
    ) -> None:
        bench.write("FROM neuros_python\n")
        code, _, error = bench.build("--base-image", f"{bench.name}=neuros_nest")
        assert (code, bench.tags) == (2, [])
        assert f"{bench.recipe}/Dockerfile does not begin from BASE_IMAGE: let it begin" in error
        code, _, error = bench.build("--base-image", "nothing=neuros_nest")
        assert (code, bench.tags) == (2, [])
        assert "no container 'nothing' is built here (there are: " in error

    def test_one_that_was_used_is_forgotten_when_the_dockerfile_takes_none_any_more(
        self, bench: Bench
    ) -> None:
        bench.write("ARG BASE_IMAGE=scratch\nFROM ${BASE_IMAGE}\n")
        assert bench.build("--base-image", f"{bench.name}=neuros_python")[0] == 0
        bench.write("FROM neuros_python\nENV ANEW=1\n")
        assert bench.build()[0] == 0

    def test_an_image_that_can_never_run_nodes_gets_no_name(self, bench: Bench) -> None:
        bench.write("FROM scratch\nCOPY Dockerfile /\n")
        code, _, error = bench.build()
        assert (code, bench.tags) == (4, [])
        assert f"image '{bench.name}' has no Python: take one with Python 3.10 to 3.14" in error


class TestBuildKit:
    """It builds where the program ``docker`` has it."""

    DOCKERFILE = (
        "FROM neuros_python\nUSER 0\nARG VARIANT=cpu\n"
        "RUN --mount=type=cache,target=/cache \\\n"
        "    --mount=type=bind,source=hello,target=/mnt/hello \\\n"
        '    cat /mnt/hello "$PIP_CERT" > /seen && echo $VARIANT >> /seen\nUSER 1000\n'
    )

    @pytest.fixture
    def buildkit(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Docker before 23 has it built in, and later ones with buildx."""
        for folder in os.get_exec_path():
            docker = Path(folder, "docker")
            if docker.exists() and (
                subprocess.run([docker, "buildx", "version"], capture_output=True).returncode == 0
                or "Docker version 2" in _version(docker) < "Docker version 23"
            ):
                monkeypatch.setenv("PATH", folder, prepend=os.pathsep)
                monkeypatch.setenv("DOCKER_BUILDKIT", "1")
                return
        cannot_run("BuildKit", "apt-get install docker-buildx")

    @pytest.mark.usefixtures("buildkit")
    def test_a_step_may_mount_caches_and_files_and_all_else_is_as_ever(self, bench: Bench) -> None:
        (bench.recipe / "hello").write_text("hello\n")
        (bench.folder / "ca.pem").write_text("certificates\n")
        bench.write(self.DOCKERFILE)
        options = ("--ca-bundle", str(bench.folder / "ca.pem"), "--build-arg", "VARIANT=cuda")
        code, out, error = bench.build(*options)
        assert (code, f"{bench.name}: built in " in out) == (0, True), error
        seen = bench.run("sh", "-c", "cat /seen; ls /tmp /cache; id -u").split()
        assert seen == ["hello", "certificates", "cuda", "/cache:", "/tmp:", "1000"]
        assert bench.engine.images.list("neuros_building") == []
        assert f"{bench.name}: up to date" in bench.build(*options)[1]

    @pytest.mark.usefixtures("buildkit")
    def test_a_step_that_fails_is_shown_with_what_it_said(self, bench: Bench) -> None:
        bench.write("FROM neuros_python\nRUN --mount=type=cache,target=/c echo why && false\n")
        code, out, error = bench.build()
        assert (code, bench.tags) == (4, [])
        assert "exit code: 1" in error
        assert " why\n" in out

    def test_where_docker_lacks_it_the_option_that_needs_it_is_named(
        self, bench: Bench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("DOCKER_BUILDKIT", "0")
        bench.write(self.DOCKERFILE)
        code, _, error = bench.build()
        assert (code, bench.tags) == (4, [])
        assert "the --mount option requires BuildKit" in error
        assert "install docker-buildx" in error


def _version(docker: Path) -> str:
    return subprocess.run([docker, "--version"], capture_output=True, text=True).stdout


class TestTheProgram:
    """``docker`` builds; the engine alone cannot."""

    def test_where_it_is_missing_the_package_is_named(
        self, bench: Bench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        bench.write("FROM neuros_python\n")
        monkeypatch.setenv("PATH", str(bench.folder))
        code, _, error = bench.build()
        assert (code, bench.tags) == (4, [])
        assert "there is no program docker here: sudo apt-get install docker.io" in error
        code, out, _ = bench.build("--if-engine")
        assert (code, bench.tags) == (0, [])
        assert "no containers are built, so projects run as processes: there is no pro" in out

    def test_it_builds_on_the_engine_of_a_context(
        self, bench: Bench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("DOCKER_CONFIG", str(bench.folder))
        (bench.folder / "config.json").write_text('{"currentContext": "lab"}')
        ContextAPI.create_context("lab", host=os.environ["DOCKER_HOST"])
        monkeypatch.delenv("DOCKER_HOST")
        bench.write("FROM neuros_python\n")
        assert bench.build()[0] == 0
        assert len(bench.tags) == 1

    def test_its_steps_are_shown_on_a_terminal(
        self, bench: Bench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("sys.stdout.isatty", lambda: True)
        bench.write("FROM neuros_python\nENV ANEW=1\n")
        _, out, _ = bench.build()
        assert re.search(rf"{bench.name}: (Step 2/2 : |#\d+ \[)", out)


class TestImagesOfUsers:
    """Any image that the engine has can be a container."""

    @pytest.fixture
    def mine(self, engine: Any, bench: Bench) -> Iterator[str]:
        """An image that its user built on NeuROS's, as Docker's documentation says."""
        tag = f"mine_{bench.name}:1.0"
        engine.images.get("neuros_python").tag(tag)
        yield tag
        engine.images.remove(tag)

    def test_one_that_can_run_nodes_is_used_as_it_is(
        self, mine: str, engine: Any, bench: Bench
    ) -> None:
        assert image_for(mine, bench.folder, engine).id == engine.images.get(mine).id

    def test_it_is_none_of_those_that_neuros_lists_and_removes(
        self, mine: str, engine: Any, bench: Bench
    ) -> None:
        bench.write("FROM neuros_python\n")
        bench.build()
        listed = bench.containers("list")
        assert bench.tags[0] in listed
        assert mine not in listed
        assert bench.containers("remove", bench.name).startswith("removed ")
        assert bench.tags == []
        assert engine.images.get(mine)

    def test_one_that_is_not_there_is_told_apart_from_one_that_is_not_built(
        self, bench: Bench, engine: Any
    ) -> None:
        with pytest.raises(EnvironmentFault, match="the engine has no image of that name"):
            image_for("nowhere/image:1", bench.folder, engine)
        bench.write("FROM neuros_python\n")
        said = f"the image of container '{bench.name}' is not built: run ./install.py --containers"
        alone = bench.folder / "containers" / bench.name
        with pytest.raises(EnvironmentFault, match=f"{said} {alone}$"):
            image_for(bench.name, bench.folder, engine)
        (bench.folder / "project.json").touch()  # which names all of them
        with pytest.raises(EnvironmentFault, match=f"{said} {bench.folder}$"):
            image_for(bench.name, bench.folder, engine)

    @pytest.fixture
    def bare(self, engine: Any) -> str:
        """An image with Python and without rclpy."""
        names = {tag for image in engine.images.list("debian-python") for tag in image.tags}
        if not names:
            cannot_run("an image with Python alone", ".ci/docker-engine start makes one")
        return min(names)

    def test_one_without_rclpy_is_refused_with_what_adds_it(
        self, bare: str, engine: Any, bench: Bench
    ) -> None:
        with pytest.raises(EnvironmentFault, match=f"run ./install.py --containers {bare}"):
            image_for(bare, bench.folder, engine)


@pytest.mark.acceptance
class TestRegistries:
    """With Debian's docker-registry, whose service need not run."""

    @pytest.fixture
    def registry(self, tmp_path: Path) -> Iterator[str]:
        """The address of a registry; it ends with the test."""
        if shutil.which("docker-registry") is None:
            cannot_run("docker-registry", "apt-get install docker-registry")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{free.getsockname()[1]}"
        settings = {
            "version": "0.1",
            "storage": {"filesystem": {"rootdirectory": str(tmp_path / "registry")}},
            "http": {"addr": address},
        }
        (tmp_path / "registry.yml").write_text(json.dumps(settings))  # which is YAML, too
        command = ["docker-registry", "serve", str(tmp_path / "registry.yml")]
        nowhere = subprocess.DEVNULL
        with subprocess.Popen(command, stdout=nowhere, stderr=nowhere) as process:
            wait_until(lambda: _answers(address))
            yield address
            process.terminate()

    @pytest.fixture
    def images(self, registry: str, engine: Any) -> Iterator[tuple[str, str, str]]:
        """A name, and the ids of its two versions: one here, a newer one in the registry."""
        name = f"{registry}/probe:1"
        ids = []
        for version in ("first", "second"):
            with context_of(None, f"FROM scratch\nCOPY Dockerfile /{version}\n") as archive:
                image, _ = engine.images.build(
                    fileobj=archive, custom_context=True, rm=True, tag=name
                )
            ids.append(image.id)
            assert "error" not in engine.images.push(name)
        engine.images.get(ids[0]).tag(name)
        yield name, ids[0], ids[1]
        for image in (name, *ids):
            with suppress(APIError):
                engine.images.remove(image)

    def test_only_pull_asks_for_the_newest_version(
        self, images: tuple[str, str, str], engine: Any
    ) -> None:
        name, here, newest = images
        assert pulled(engine, name, newest=False).id == here
        assert pulled(engine, name, newest=True).id == newest
        engine.images.remove(name)
        assert pulled(engine, name, newest=False).id == newest

    def test_one_that_no_registry_has_is_named_with_the_way_out(
        self, registry: str, images: tuple[str, str, str], engine: Any
    ) -> None:
        name = f"{registry}/nothing:1"
        with pytest.raises(EnvironmentFault, match=f"image '{name}' .*: docker load it, or name"):
            pulled(engine, name, newest=False)
        engine.images.get(images[1]).tag(name)
        with pytest.raises(EnvironmentFault, match="leave out --pull"):
            pulled(engine, name, newest=True)
        engine.images.remove(name)


def _answers(address: str) -> bool:
    host, _, port = address.partition(":")
    try:
        socket.create_connection((host, int(port))).close()
    except OSError:
        return False
    return True
