"""Where there is no engine that can be used: one sentence on why, and on what to do."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import ThreadingMixIn, UnixStreamServer
from threading import Thread
from types import SimpleNamespace
from typing import Any

import pytest
import requests
from docker.context import ContextAPI
from docker.errors import APIError
from urllib3.exceptions import ProtocolError

from neuros.backends.docker import engine as engine_module
from neuros.backends.docker.engine import Abilities, connect, engine_faults, engine_name, explain
from neuros.backends.docker.launcher import without_limits
from neuros.errors import EnvironmentFault
from neuros.project.model import Node, Resources


def fault_of(environ: dict[str, str]) -> str:
    with pytest.raises(EnvironmentFault) as caught:
        connect(environ).close()
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert sentence.endswith("or run without containers: --backend process")
    return sentence


@contextmanager
def old_engine(path: Path) -> Iterator[str]:
    """What answers as Docker 19 does, which is all that is asked before it is refused."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = json.dumps({"ApiVersion": "1.40", "Version": "19.03.1"}).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def address_string(self) -> str:
            return "unix"

        def log_message(self, *_: object) -> None:
            pass

    class Server(ThreadingMixIn, UnixStreamServer):
        daemon_threads = True

    with Server(str(path), Handler) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"unix://{path}"
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def as_nobody(file: Path) -> Iterator[None]:
    """Without rights on a file, which root always has."""
    file.chmod(0)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)


class TestConnecting:
    def test_a_socket_that_is_not_there_is_named(self, tmp_path: Path) -> None:
        address = f"unix://{tmp_path}/none.sock"
        assert f"no Docker engine answers at {address} (No such file" in fault_of(
            {"DOCKER_HOST": address}
        )

    def test_a_socket_behind_which_nobody_is_is_named(self, tmp_path: Path) -> None:
        with socket.socket(socket.AF_UNIX) as dead:
            dead.bind(str(tmp_path / "dead.sock"))
        fault = fault_of({"DOCKER_HOST": f"unix://{tmp_path}/dead.sock"})
        assert "(Connection refused): install and start it" in fault

    def test_an_address_that_is_none_is_named(self) -> None:
        assert "see DOCKER_HOST" in fault_of({"DOCKER_HOST": "over://there"})

    def test_without_rights_it_is_the_group_that_helps(self, tmp_path: Path) -> None:
        with old_engine(tmp_path / "x.sock") as address, as_nobody(tmp_path / "x.sock"):
            fault = fault_of({"DOCKER_HOST": address})
        assert f"this user may not use the Docker engine at {address}" in fault
        assert "sudo usermod -aG docker" in fault

    def test_the_engine_of_a_context_is_used(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("DOCKER_CONFIG", str(tmp_path))
        (tmp_path / "config.json").write_text('{"currentContext": "lab"}')
        ContextAPI.create_context("lab", host=f"unix://{tmp_path}/lab.sock")
        assert f"no Docker engine answers at unix://{tmp_path}/lab.sock" in fault_of({})

    def test_an_old_engine_is_refused(self, tmp_path: Path) -> None:
        with old_engine(tmp_path / "old.sock") as address:
            fault = fault_of({"DOCKER_HOST": address})
        assert "is too old (API 1.40): install Docker 20.10 or newer" in fault

    def test_the_socket_of_rootless_docker_is_found_where_the_usual_one_is_not(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(engine_module, "_USUAL_SOCKET", tmp_path / "none.sock")
        with old_engine(tmp_path / "docker.sock") as address:
            assert f"at {address} is too old" in fault_of({"XDG_RUNTIME_DIR": str(tmp_path)})


def fault(text: str) -> Any:
    return pytest.raises(EnvironmentFault, match=text)


class TestFaultsWhileWorking:
    def test_what_the_engine_refuses_is_said_in_its_words(self) -> None:
        said = APIError("x", SimpleNamespace(status_code=500), "port is\n already allocated")
        with fault("node 'a': port is already allocated"), engine_faults("node 'a'"):
            raise said

    def test_a_full_disk_comes_with_a_remedy(self) -> None:
        said = APIError("x", SimpleNamespace(status_code=500), "write /x: no space left on device")
        with fault("the disk is full: make room"), engine_faults("image 'a'"):
            raise said

    def test_a_gpu_that_it_cannot_give_comes_with_a_remedy(self) -> None:
        text = 'could not select device driver "" with capabilities: [[gpu]]'
        said = APIError("x", SimpleNamespace(status_code=500), text)
        with fault("node 'a': .*NVIDIA Container Toolkit"), engine_faults("node 'a'"):
            raise said

    def test_an_init_that_podman_lacks_comes_with_a_remedy(self) -> None:
        said = "container create: container-init binary not found on the host: stat /usr/libexec"
        assert explain(said).endswith(": sudo apt-get install catatonit")

    def test_an_engine_that_goes_away_is_noticed(self) -> None:
        reset = ProtocolError("Connection aborted.", ConnectionResetError(104, "reset"))
        with fault("node 'a': the Docker engine has gone away"), engine_faults("node 'a'"):
            raise requests.ConnectionError(reset)

    def test_mistakes_of_our_own_are_not_hidden(self) -> None:
        with pytest.raises(KeyError), engine_faults("node 'a'"):
            raise KeyError("x")


class TestAbilities:
    FACTS: Mapping[str, Any] = {
        "SecurityOptions": ["name=seccomp,profile=default"],
        "MemoryLimit": True,
        "CpuCfsQuota": True,
        "PidsLimit": True,
    }

    def test_an_engine_of_roots_keeps_to_all_limits(self) -> None:
        assert Abilities.of(self.FACTS) == Abilities()

    def test_a_rootless_one_may_have_no_control_groups(self) -> None:
        facts = {
            **self.FACTS,
            "SecurityOptions": ["name=seccomp,profile=default", "name=rootless"],
            "MemoryLimit": False,
            "CpuCfsQuota": False,
        }
        assert Abilities.of(facts) == Abilities(True, frozenset({"mem_bytes", "cpus"}))

    def test_a_rootless_podman_says_in_its_own_way_that_it_is_one(self) -> None:
        facts = {**self.FACTS, "Rootless": True, "CgroupVersion": "2"}
        assert Abilities.of(facts) == Abilities(is_rootless=True)

    def test_with_control_groups_of_version_1_a_rootless_podman_keeps_to_no_limit(self) -> None:
        facts = {**self.FACTS, "Rootless": True, "CgroupVersion": "1"}
        assert Abilities.of(facts).unkept == {"mem_bytes", "cpus", "pids"}

    def test_an_engine_says_whether_it_is_podman(self) -> None:
        podman = {"Version": "4.3.1", "Components": [{"Name": "Podman Engine"}]}
        docker = {"Version": "20.10.24", "Components": [{"Name": "Engine"}]}
        assert [*map(engine_name, (podman, docker))] == ["podman 4.3.1", "20.10.24"]

    def test_limits_that_do_not_hold_are_said(self) -> None:
        def node(name: str, **limits: float) -> Node:
            return Node(name, "c", Path("/p.py"), resources=Resources(**limits))

        nodes = [node("a", mem_bytes=1 << 30), node("b", pids=9), node("c")]
        ((severity, text),) = without_limits(nodes, {"mem_bytes", "cpus"})
        assert severity == "WARN"
        assert text.startswith(
            "resources of a have no effect: this Docker engine has no control groups"
        )
        assert without_limits(nodes, ()) == ()
