"""What is decided about builds without an engine: causes of failures, Pythons, what goes to it."""

from __future__ import annotations

import tarfile
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from neuros.backends.docker.building import (
    CERTIFICATES,
    Surroundings,
    cause_of,
    context_of,
    served,
)
from neuros.backends.docker.images import PythonInImage, chosen
from neuros.errors import EnvironmentFault


class TestCauses:
    """Of a build that failed."""

    @pytest.mark.parametrize(
        ("said", "cause"),
        [
            ("OSError: [Errno 28] No space left on device", "the disk is full: make room"),
            (
                "pull access denied for neuros_pyhton, repository does not exist",
                "there is no image neuros_pyhton to begin from: correct the FROM line",
            ),
            ("manifest for python:9 not found: manifest unknown", "there is no image python:9"),
            (
                "docker.io/library/nest:9: pull access denied, repository does not exist or may",
                "there is no image docker.io/library/nest:9 to begin from",
            ),
            (
                "ERROR: failed to solve: mine: failed to resolve source metadata for mine/x:1:"
                " mine/x:1: not found",
                "there is no image mine/x:1 to begin from",
            ),
            (
                'Get "https://registry-1.docker.io/v2/": dial tcp: i/o timeout',
                "the registry registry-1.docker.io cannot be reached",
            ),
            (
                "ERROR: failed to solve: a: failed to resolve source metadata for docker.io/a:1:"
                ' failed to do request: Head "https://registry-1.docker.io/v2/a": i/o timeout',
                "the registry registry-1.docker.io cannot be reached",
            ),
            ("Temporary failure in name resolution", "the package index cannot be reached"),
            ("SSLError(CERTIFICATE_VERIFY_FAILED)", "give your authority's with --ca-bundle"),
            ("E: Could not open lock file - open (13: Permission denied)", "put USER 0 above it"),
        ],
    )
    def test_what_a_user_can_mend_is_one_sentence_with_the_next_step(
        self, said: str, cause: str
    ) -> None:
        assert cause in cause_of([said, "a command returned a non-zero code: 1"])

    @pytest.mark.parametrize(
        ("said", "cause"),
        [
            (
                ["Step 2/3 : RUN pip", "ERROR: No matching distribution found for a", "code: 1"],
                "ERROR: No matching distribution found for a",
            ),
            (
                [
                    "#5 [2/3] RUN apt",
                    "#5 1.23 E: Unable to locate package a",
                    "ERROR: exit code: 1",
                ],
                "E: Unable to locate package a",
            ),
            (
                ["Step 1/2 : RUN a", "ERROR: is none", "Step 2/2 : RUN b", "returned a code: 1"],
                "returned a code: 1",
            ),
            (
                ['ERROR: failed to solve: compute cache key: "/x" not found: not found'],
                'ERROR: failed to solve: compute cache key: "/x" not found: not found',
            ),
            ([], "docker build does not say why"),
        ],
    )
    def test_everything_else_is_the_error_of_the_last_step_as_it_was_printed(
        self, said: list[str], cause: str
    ) -> None:
        assert cause_of(said) == cause


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
        around = Surroundings(engine_with("bridge"), environ, None, "")
        assert around.arguments == {"https_proxy": "http://p:1", "NO_PROXY": "x"}
        assert around.network is None
        assert around.lines == ""

    def test_without_a_bridge_builds_use_the_network_of_this_machine(self) -> None:
        assert Surroundings(engine_with("host", "none"), {}, None, "").network == "host"

    def test_nor_would_a_proxy_on_this_machine_be_found_from_the_bridge(self) -> None:
        environ = {"HTTPS_PROXY": "http://localhost:3128"}
        assert Surroundings(engine_with("bridge"), environ, None, "").network == "host"

    def test_with_a_wheelhouse_nothing_else_is_asked(self) -> None:
        around = Surroundings(engine_with("bridge"), {"HTTP_PROXY": "x"}, None, "http://w/")
        assert around.arguments == {"SYSTEM_PACKAGES": "", "WINDOWS": "no"}
        assert around.network == "host"
        assert around.lines == "ARG PIP_NO_INDEX=1 PIP_FIND_LINKS=http://w/"

    def test_certificates_lie_beside_every_dockerfile(self, tmp_path: Path) -> None:
        (tmp_path / "ca.pem").write_text("PEM")
        around = Surroundings(engine_with("bridge"), {}, tmp_path / "ca.pem", "")
        ((name, content),) = around.files.items()
        assert content == b"PEM"
        assert f"COPY {name} {CERTIFICATES}\n" in around.lines
        assert f"PIP_CERT={CERTIFICATES}" in around.lines


def test_the_context_holds_the_folder_and_the_dockerfile_that_is_meant(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "x").write_text("1")
    (tmp_path / "data" / "x").chmod(0o600)
    (tmp_path / "Dockerfile").write_text("FROM a")
    with (
        context_of(tmp_path, "FROM b", {"more": b"2"}) as file,
        tarfile.open(fileobj=file, mode="r:gz") as archive,
    ):
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
    with (
        context_of(tmp_path / "mine", "FROM b") as file,
        tarfile.open(fileobj=file, mode="r:gz") as archive,
    ):
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
