"""How far the nodes of a run look for others: ``--network`` and ``--peers``."""

from __future__ import annotations

from pathlib import Path

import pytest

from neuros.api.loading import workspaces_of
from neuros.api.plan import chosen_network, make_plan
from neuros.api.request import Request
from neuros.errors import EnvironmentFault, UsageError
from neuros.messages.needed import Messages
from neuros.project.model import Node, Project
from neuros.transport.dds_profile import LOCAL_PROFILES, PROFILES_VARIABLE

RANGE, PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"


def test_nodes_stay_on_this_machine_unless_the_environment_says_otherwise() -> None:
    network = chosen_network(False, None)
    assert network.environment({}) == network.environment({RANGE: ""}) == {RANGE: "LOCALHOST"}
    assert network.environment({RANGE: "SUBNET"}) == {RANGE: "SUBNET"}


def test_what_a_run_in_a_run_inherits_is_no_wish() -> None:
    inherited = {RANGE: "SYSTEM_DEFAULT", PROFILES_VARIABLE: str(LOCAL_PROFILES)}
    assert chosen_network(False, None).environment(inherited) == {RANGE: "LOCALHOST"}


def test_network_goes_before_the_environment() -> None:
    assert chosen_network(True, None).environment({RANGE: "LOCALHOST"}) == {RANGE: "SUBNET"}


def test_peers_imply_it_and_are_given_as_ros_wants_them() -> None:
    network = chosen_network(False, " 10.0.0.7, 10.0.0.8,10.0.0.7")
    assert network.is_wide
    assert network.environment({}) == {RANGE: "SUBNET", PEERS: "10.0.0.7;10.0.0.8"}


def test_a_host_name_becomes_an_address_here_since_a_container_may_not_know_it() -> None:
    assert chosen_network(False, "localhost").peers == ("127.0.0.1",)


@pytest.mark.parametrize(
    "nonsense", ["", "10.0.0", "10.0.0.256", "1", "0.0.0.0", "239.255.0.1", "a b", "-x", "fe80::1"]
)
def test_what_can_be_no_host_is_wrong_usage(nonsense: str) -> None:
    with pytest.raises(UsageError, match="is neither an IPv4 address nor the name of a host"):
        chosen_network(False, f"10.0.0.7,{nonsense}")


def test_a_name_that_nobody_knows_is_a_fault_of_the_machine() -> None:
    with pytest.raises(EnvironmentFault, match=r"the host 'robot\.invalid' cannot be found"):
        chosen_network(False, "robot.invalid")


@pytest.mark.parametrize(
    ("option", "given"),
    [
        ("-n", Request(deployment="x", nodes=["a"])),
        ("--network", Request(deployment="x", network=True)),
        ("--peers", Request(deployment="x", peers="10.0.0.7")),
        ("--isolate", Request(deployment="x", isolate=True)),
        ("--backend", Request(deployment="x", backend="in-process")),
    ],
)
def test_with_a_deployment_nothing_else_says_where_nodes_run(option: str, given: Request) -> None:
    project = Project("toy", (Node("a", "neuros_python", Path("a.py")),), (), Path("project.json"))
    with pytest.raises(UsageError, match=f"--deployment with {option}"):
        make_plan(project, Messages(workspaces_of(Path("project.json")), ()), given)
