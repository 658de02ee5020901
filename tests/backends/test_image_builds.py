"""What is decided about builds without an engine: causes of failures, Pythons, what goes to it."""

from __future__ import annotations

import tarfile
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from neuros.backends.docker.builders import CERTIFICATES, BuildLog, context_of, served, surroundings
from neuros.backends.docker.images import PythonInImage, chosen
from neuros.errors import EnvironmentFault


class TestBuildLog:
    def log(self, folder: Path, *lines: str, error: str = "") -> tuple[BuildLog, str | None]:
        log = BuildLog(folder / "x.log", lambda _: None)
        messages: list[dict[str, Any]] = [{"stream": f"{line}\n"} for line in lines]
        return log, log.follow([*messages, {"error": error} if error else {"aux": {"ID": "id"}}])

    def test_a_build_that_succeeds_has_an_image_and_all_that_was_said(self, tmp_path: Path) -> None:
        _, image = self.log(tmp_path, "Step 1/1 : FROM a", "---> 12")
        assert image == "id"
        assert (tmp_path / "x.log").read_text() == "Step 1/1 : FROM a\n---> 12\n"

    def test_steps_are_shown_and_the_rest_is_not(self, tmp_path: Path) -> None:
        shown: list[str] = []
        BuildLog(tmp_path / "x.log", shown.append).follow(
            [{"stream": "Step 1/1 : FROM a\n"}, {"stream": "---> 12\n"}, {"status": "Pulling"}]
        )
        assert shown == ["Step 1/1 : FROM a"]

    def test_one_that_fails_has_none_and_its_last_lines(self, tmp_path: Path) -> None:
        log, image = self.log(tmp_path, *map(str, range(50)), error="it broke")
        assert image is None
        assert log.tail == [*map(str, range(39, 50)), "it broke"]
        assert log.cause == "it broke"

    def test_a_line_that_comes_in_pieces_is_one(self, tmp_path: Path) -> None:
        log = BuildLog(tmp_path / "x.log", lambda _: None)
        pieces = ({"stream": "Step 1\nE"}, {"stream": ": Unable to locate package a\nbye"})
        assert log.follow([*pieces, {"error": "over"}]) is None
        assert log.tail == ["Step 1", "E: Unable to locate package a", "bye", "over"]
        assert "have no a: correct the name" in log.cause

    @pytest.mark.parametrize(
        ("said", "cause"),
        [
            ("OSError: [Errno 28] No space left on device", "the disk is full: make room"),
            (
                "ERROR: No matching distribution found for numpy==99",
                "there is no package numpy==99 for the Python of this image",
            ),
            ("ERROR: ResolutionImpossible: for help", "requirements.txt cannot be satisfied"),
            (
                "pull access denied for neuros_pyhton, repository does not exist",
                "there is no image neuros_pyhton to begin from: correct the FROM line",
            ),
            ("manifest for python:9 not found: manifest unknown", "there is no image python:9"),
            (
                'Get "https://registry-1.docker.io/v2/": dial tcp: i/o timeout',
                "the registry registry-1.docker.io cannot be reached",
            ),
            ("Temporary failure in name resolution", "the package index cannot be reached"),
            ("SSLError(CERTIFICATE_VERIFY_FAILED)", "give your authority's with --ca-bundle"),
            ("E: Unable to locate package ros-jazzy-rviz2", "have no ros-jazzy-rviz2: correct"),
            ("E: Package 'rviz' has no installation candidate", "have no rviz: correct"),
            ("COPY failed: file not found in build context", "is not beside it"),
            ('failed to compute cache key: "/x" not found: not found', "is not beside it"),
            (
                "docker.io/library/nest:9: pull access denied, repository does not exist or may",
                "there is no image docker.io/library/nest:9 to begin from",
            ),
            ("dockerfile parse error line 2: Unknown flag: link", "too old for the option --link"),
            ("E: Could not open lock file - open (13: Permission denied)", "put USER 0 above it"),
            ("/bin/sh: 1: python3: not found", "its base has no Python"),
            ("ensurepip is not available", "add the package python3-venv"),
        ],
    )
    def test_the_cause_is_one_sentence_with_the_next_step(
        self, said: str, cause: str, tmp_path: Path
    ) -> None:
        log, _ = self.log(tmp_path, said, error="a command returned a non-zero code: 1")
        assert cause in log.cause


def answer(**changes: Any) -> dict[str, Any]:
    """What a Python says of itself."""
    return {
        "python": "/usr/bin/python3",
        "version": [3, 12],
        "glibc": True,
        "machine": "x86_64",
        "has_rclpy": False,
        "setup": "",
    } | changes


class TestPythonOfAnImage:
    def test_the_first_with_rclpy_is_taken(self) -> None:
        found = chosen([answer(), answer(python="/opt/x/bin/python", has_rclpy=True)], "mine")
        assert found == PythonInImage("/opt/x/bin/python", (3, 12), True)
        assert found.start == ("/opt/x/bin/python",)

    def test_without_rclpy_it_is_the_first(self) -> None:
        assert chosen([answer(), answer(python="other")], "mine").path == "/usr/bin/python3"

    def test_a_ros_distribution_is_sourced_first(self) -> None:
        setup = "/opt/ros/jazzy/setup.sh"
        start = chosen([answer(has_rclpy=True, setup=setup)], "mine").start
        assert start == ("/bin/sh", "-c", f'. {setup} && exec "$0" "$@"', "/usr/bin/python3")

    @pytest.mark.parametrize("minor", [10, 14])
    def test_every_python_with_wheels_will_do(self, minor: int) -> None:
        assert chosen([answer(version=[3, minor])], "mine").version == (3, minor)

    @pytest.mark.parametrize(
        ("changes", "why"),
        [
            ({"version": [3, 9]}, "has Python 3.9, for which there is no package of rclpy"),
            ({"version": [2, 7]}, "take an image with Python 3.10 to 3.14"),
            ({"glibc": False}, "has another C library than glibc"),
            ({"machine": "aarch64"}, "has a processor of the kind aarch64"),
        ],
    )
    def test_one_without_wheels_is_refused_in_one_sentence(
        self, changes: dict[str, Any], why: str
    ) -> None:
        with pytest.raises(EnvironmentFault) as caught:
            chosen([answer(**changes)], "mine")
        assert why in str(caught.value)

    def test_but_not_where_it_has_rclpy_already(self) -> None:
        assert chosen([answer(has_rclpy=True, machine="aarch64")], "mine").has_rclpy

    def test_an_image_without_python_is_refused(self) -> None:
        with pytest.raises(EnvironmentFault, match="image 'mine' has no Python: take one with"):
            chosen([], "mine")


def engine_with(*networks: str) -> Any:
    named = [SimpleNamespace(name=name) for name in networks]
    return SimpleNamespace(networks=SimpleNamespace(list=lambda: named))


class TestSurroundings:
    def test_proxies_are_passed_on_in_both_spellings(self) -> None:
        environ = {"https_proxy": "http://p:1", "NO_PROXY": "x", "HOME": "/root"}
        around = surroundings(engine_with("bridge"), environ, None, "")
        assert around.arguments == {"https_proxy": "http://p:1", "NO_PROXY": "x"}
        assert around.network is None
        assert around.lines == ""

    def test_without_a_bridge_builds_use_the_network_of_this_machine(self) -> None:
        assert surroundings(engine_with("host", "none"), {}, None, "").network == "host"

    def test_nor_would_a_proxy_on_this_machine_be_found_from_the_bridge(self) -> None:
        environ = {"HTTPS_PROXY": "http://localhost:3128"}
        assert surroundings(engine_with("bridge"), environ, None, "").network == "host"

    def test_with_a_wheelhouse_nothing_else_is_asked(self) -> None:
        around = surroundings(engine_with("bridge"), {"HTTP_PROXY": "x"}, None, "http://w/")
        assert around.arguments == {"SYSTEM_PACKAGES": "", "WINDOWS": "no"}
        assert around.network == "host"
        assert around.lines == "ARG PIP_NO_INDEX=1 PIP_FIND_LINKS=http://w/"

    def test_certificates_lie_beside_every_dockerfile(self, tmp_path: Path) -> None:
        (tmp_path / "ca.pem").write_text("PEM")
        around = surroundings(engine_with("bridge"), {}, tmp_path / "ca.pem", "")
        ((name, content),) = around.files.items()
        assert content == b"PEM"
        assert f"COPY {name} {CERTIFICATES}\n" in around.lines
        assert f"PIP_CERT={CERTIFICATES}" in around.lines


def test_the_context_holds_the_folder_and_the_dockerfile_that_is_meant(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "x").write_text("1")
    (tmp_path / "data" / "x").chmod(0o600)
    (tmp_path / "Dockerfile").write_text("FROM a")
    with tarfile.open(fileobj=context_of(tmp_path, "FROM b", {"more": b"2"})) as archive:
        entries = {entry.name: entry for entry in archive}
        assert set(entries) == {"data/x", "Dockerfile", "more"}
        dockerfile = archive.extractfile("Dockerfile")
        assert dockerfile is not None
        assert dockerfile.read() == b"FROM b"
    assert (entries["data/x"].mode, entries["data/x"].uid) == (0o644, 0)


def test_a_link_in_a_folder_is_sent_as_the_file_that_it_leads_to(tmp_path: Path) -> None:
    (tmp_path / "requirements.txt").write_text("numpy")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "requirements.txt").symlink_to("../requirements.txt")
    with tarfile.open(fileobj=context_of(tmp_path / "mine", "FROM b")) as archive:
        sent = archive.extractfile("requirements.txt")
        assert sent is not None
        assert sent.read() == b"numpy"


class TestWheelhouse:
    def test_wheels_can_be_had_while_it_is_served(self, tmp_path: Path) -> None:
        (tmp_path / "x-1-py3-none-any.whl").write_bytes(b"wheel")
        with served(tmp_path) as address:
            listing = urllib.request.urlopen(address).read().decode()
            wheel = urllib.request.urlopen(f"{address}x-1-py3-none-any.whl").read()
        assert "x-1-py3-none-any.whl" in listing
        assert wheel == b"wheel"
        with pytest.raises(OSError, match="refused"):
            urllib.request.urlopen(address)

    def test_two_builds_at_once_have_one_each(self, tmp_path: Path) -> None:
        (tmp_path / "x-1-py3-none-any.whl").touch()
        with served(tmp_path) as one, served(tmp_path) as other:
            assert one != other

    def test_a_folder_without_wheels_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(EnvironmentFault, match="there are no wheels"), served(tmp_path):
            pass
