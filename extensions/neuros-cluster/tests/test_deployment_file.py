"""Deployment files: what they say, and every problem of one with its place."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from neuros_cluster.deployment_file import DeploymentFile, Host, load_deployment

from neuros.errors import ProjectError
from neuros.project.model import Node, Project

PROJECT = Project(
    "toy",
    tuple(Node(name, "neuros_python", Path("plugin.py")) for name in ("eye", "brain")),
    (),
    Path("project.json"),
)
ROBOT = {"ssh": "pi@robot"}


def load(folder: Path, content: Any) -> DeploymentFile:
    file = folder / "deployment.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return load_deployment(file, PROJECT)


def problems_of(folder: Path, content: Any) -> list[str]:
    """Each as pointer and text, without the place, sorted."""
    with pytest.raises(ProjectError) as raised:
        load(folder, content)
    return sorted(f"{each.pointer}: {each.text}" for each in raised.value.problems)


def test_it_says_where_nodes_run_and_how_machines_are_reached(tmp_path: Path) -> None:
    robot = {**ROBOT, "ssh_options": ["-p", "2222"], "neuros": "/opt/neuros", "address": "10.0.0.7"}
    hosts = {"robot": robot, "unused": {"through": ["srun"]}, "here": {"address": "10.0.0.1"}}
    file = load(tmp_path, {"hosts": hosts, "nodes": {"eye": "robot", "brain": "here"}})
    reached = Host("robot", "pi@robot", "", ("-p", "2222"), (), "/opt/neuros", "10.0.0.7")
    assert file.used == [reached]
    assert file.places == {"eye": "robot"}
    assert file.here.address == "10.0.0.1"
    assert file.timeout_s == 5.0


def test_nodes_that_it_does_not_name_run_here(tmp_path: Path) -> None:
    assert load(tmp_path, {"nodes": {}}).places == {}
    assert load(tmp_path, {"hosts": {"robot": ROBOT}, "nodes": {"eye": "robot"}}).places == {
        "eye": "robot"
    }


def test_all_problems_of_its_form_are_told_at_once(tmp_path: Path) -> None:
    hosts = {"robot": {"shs": "pi@robot"}, "2nd": {"ssh": 5}}
    assert problems_of(tmp_path, {"hosts": hosts, "node": {}, "timeout_s": 0}) == [
        "/: the key 'nodes' is missing",
        "/hosts/2nd/ssh: must be a text, but is a whole number",
        "/hosts/2nd: '2nd' is not allowed as a name here",
        "/hosts/robot/shs: unknown key 'shs'",
        "/node: unknown key 'node'",
        "/timeout_s: must be at least 2, but is 0",
    ]


def test_all_mistakes_in_it_are_told_at_once(tmp_path: Path) -> None:
    hosts = {
        "both": {"ssh": "a", "through": ["srun"]},
        "neither": {},
        "option": {"ssh": "-oProxyCommand=x"},
        "here": {"ssh": "me@here"},
    }
    nodes = {"eye": "robbot", "brian": "both"}
    ways = "needs exactly one of 'ssh', 'docker' and 'through', which say how to reach it"
    assert problems_of(tmp_path, {"hosts": hosts, "nodes": nodes}) == [
        f"/hosts/both: {ways}",
        "/hosts/here/ssh: 'here' is the launching machine, which needs no 'ssh'",
        f"/hosts/neither: {ways}",
        "/hosts/option/ssh: is an option, not a destination: user@host",
        "/nodes/brian: the project has no node 'brian'",
        "/nodes/eye: there is no host 'robbot'",
    ]


def test_a_host_may_be_a_docker_engine(tmp_path: Path) -> None:
    hosts = {"box": {"docker": "ssh://me@box", "ssh_options": ["-p", "2222"]}}
    (host,) = load(tmp_path, {"hosts": hosts, "nodes": {"eye": "box"}}).used
    assert (host.docker, host.way, str(host)) == ("ssh://me@box",) * 2 + ("box (ssh://me@box)",)


def test_mistakes_about_docker_engines_are_told(tmp_path: Path) -> None:
    hosts = {
        "plain": {"docker": "box"},
        "option": {"docker": "ssh://-oProxyCommand=x"},
        "both": {"docker": "ssh://box", "ssh": "box"},
        "installed": {"docker": "ssh://box", "neuros": "/opt/neuros"},
    }
    assert problems_of(tmp_path, {"hosts": hosts, "nodes": {}}) == [
        "/hosts/both: needs exactly one of 'ssh', 'docker' and 'through', which say how to reach"
        " it",
        "/hosts/installed/neuros: has no effect with 'docker': NeuROS comes into the containers by"
        " itself",
        "/hosts/option/docker: 'ssh://-oProxyCommand=x' is not allowed as docker engine",
        "/hosts/plain/docker: 'box' is not allowed as docker engine",
    ]


def test_an_address_that_no_docker_engine_can_have_is_told(tmp_path: Path) -> None:
    reasons = {
        "tcp://[::": "Invalid IPv6 URL",
        "tcp://box": "the port is missing",
        "tcp://box:99999": "Port out of range 0-65535",
        "ssh://box:x": "Port could not be cast to integer value as 'x'",
    }
    usable = ["tcp://[::1]:2375", "tcp://box:2375", "ssh://me@box:22/run/docker.sock", "unix:///s"]
    for address in usable:
        assert load(tmp_path, {"hosts": {"box": {"docker": address}}, "nodes": {}})
    hosts = {f"box{number}": {"docker": address} for number, address in enumerate(reasons)}
    assert problems_of(tmp_path, {"hosts": hosts, "nodes": {}}) == [
        f"/hosts/box{number}/docker: is no address of a Docker engine: {why}"
        for number, why in enumerate(reasons.values())
    ]


def test_control_characters_are_told_wherever_they_are(tmp_path: Path) -> None:
    hosts = {
        "robot": {"ssh": "pi@robot\0", "ssh_options": ["-p", "2\n"], "neuros": "\x7f"},
        "cluster": {"through": ["srun", "\0"], "address": "a\tb"},
        "box": {"docker": "ssh://box\n"},
        "here": {"address": "10.0.0.1\x9b"},
    }
    assert problems_of(tmp_path, {"hosts": hosts, "nodes": {}}) == [
        "/hosts/box/docker: has the control character \\u000a",
        "/hosts/cluster/address: has the control character \\u0009",
        "/hosts/cluster/through/1: has the control character \\u0000",
        "/hosts/here/address: has the control character \\u009b",
        "/hosts/robot/neuros: has the control character \\u007f",
        "/hosts/robot/ssh: has the control character \\u0000",
        "/hosts/robot/ssh_options/1: has the control character \\u000a",
    ]


def test_mistakes_are_told_with_problems_of_form(tmp_path: Path) -> None:
    hosts = {"neither": {}, "robot": {"ssh": 5}, "none": 3}
    nodes = {"eye": "robbot", "brian": "robot", "brain": 7}
    assert problems_of(tmp_path, {"hosts": hosts, "nodes": nodes, "node": {}}) == [
        "/hosts/neither: needs exactly one of 'ssh', 'docker' and 'through', which say how to"
        " reach it",
        "/hosts/none: must be an object, but is a whole number",
        "/hosts/robot/ssh: must be a text, but is a whole number",
        "/node: unknown key 'node'",
        "/nodes/brain: must be a text, but is a whole number",
        "/nodes/brian: the project has no node 'brian'",
        "/nodes/eye: there is no host 'robbot'",
    ]


def test_what_is_no_json_is_told_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match=r"deployment\.json:2:1"):
        load(tmp_path, '{"nodes":\n}')


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(ProjectError, match=r"absent\.json"):
        load_deployment(tmp_path / "absent.json", PROJECT)


def test_every_deployment_on_the_page_is_valid(tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "README.md").read_text("utf-8")
    shown = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    assert len(shown) == 2
    for text in shown:
        (tmp_path / "deployment.json").write_text(text)
        load_deployment(tmp_path / "deployment.json")


def test_every_deployment_of_the_page_is_valid(tmp_path: Path) -> None:
    page = Path(__file__).resolve().parents[1] / "README.md"
    blocks = re.findall(r"```json\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
    shown = [json.loads(block) for block in blocks]
    deployments = [each for each in shown if isinstance(each.get("nodes"), dict)]
    assert deployments
    for content in deployments:
        (tmp_path / "deployment.json").write_text(json.dumps(content))
        load_deployment(tmp_path / "deployment.json")
