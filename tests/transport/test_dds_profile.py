"""Settings of Fast DDS that a process of nodes gets."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from neuros.transport.dds_profile import (
    LOCAL_PROFILES,
    MOST_LOCAL_PARTICIPANTS,
    PROFILES,
    PROFILES_VARIABLE,
    RANGE_VARIABLE,
    as_asked,
    dds_environment,
)

NAMESPACE = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"
LOCAL = {RANGE_VARIABLE: "LOCALHOST"}


def test_nodes_that_stay_on_this_machine_get_transports_that_do() -> None:
    assert dds_environment(LOCAL) == {
        PROFILES_VARIABLE: str(LOCAL_PROFILES),
        RANGE_VARIABLE: "SYSTEM_DEFAULT",
    }


@pytest.mark.parametrize(
    "environ",
    [
        {},
        {RANGE_VARIABLE: "SUBNET"},
        {RANGE_VARIABLE: "OFF"},
        {RANGE_VARIABLE: "SYSTEM_DEFAULT"},
        {**LOCAL, "ROS_STATIC_PEERS": "192.0.2.7"},
    ],
)
def test_another_range_is_left_to_ros(environ: dict[str, str]) -> None:
    assert dds_environment(environ) == {PROFILES_VARIABLE: str(PROFILES)}


def test_on_this_machine_packets_go_by_udp_alone() -> None:
    tree = ElementTree.parse(LOCAL_PROFILES)
    assert [each.text for each in tree.iter(f"{NAMESPACE}type")] == ["UDPv4"]
    (others,) = tree.iter(f"{NAMESPACE}useBuiltinTransports")
    assert others.text == "false"


def test_a_file_of_the_users_own_wins() -> None:
    assert dds_environment({**LOCAL, PROFILES_VARIABLE: "/home/me/dds.xml"}) == {}


def test_a_file_of_neuros_that_was_inherited_is_no_file_of_the_users_own() -> None:
    assert dds_environment({**LOCAL, PROFILES_VARIABLE: str(PROFILES)}) == dds_environment(LOCAL)


@pytest.mark.parametrize(
    "environ",
    [{}, LOCAL, {RANGE_VARIABLE: "SUBNET"}, {**LOCAL, PROFILES_VARIABLE: "/home/me/dds.xml"}],
)
def test_what_a_node_starts_knows_what_was_asked_of_the_node(environ: dict[str, str]) -> None:
    inherited = {**environ, **dds_environment(environ)}
    assert as_asked(inherited) == as_asked(environ) == environ
    assert dds_environment(inherited) == dds_environment(environ)


def test_a_wider_range_asked_of_what_a_node_starts_holds() -> None:
    inherited = {**LOCAL, **dds_environment(LOCAL), RANGE_VARIABLE: "SUBNET"}
    assert dds_environment(inherited) == {PROFILES_VARIABLE: str(PROFILES)}


def test_only_what_stays_on_this_machine_is_repaired_late() -> None:
    """In a network, a writer asks after 20 ms whether all has come, and hears the answer soon."""
    assert duration_ms(PROFILES, "heartbeatPeriod") == 20
    assert duration_ms(PROFILES, "heartbeatResponseDelay") == 1
    assert duration_ms(PROFILES, "nackResponseDelay") == 1
    assert duration_ms(LOCAL_PROFILES, "heartbeatPeriod") is None
    assert duration_ms(LOCAL_PROFILES, "nackSupressionDuration") == 20
    assert duration_ms(LOCAL_PROFILES, "heartbeatResponseDelay") == 20


def test_no_request_to_send_again_comes_while_requests_are_ignored() -> None:
    ignored_ms = duration_ms(PROFILES, "nackSupressionDuration")
    asked_ms = duration_ms(PROFILES, "heartbeatPeriod")
    assert ignored_ms is not None
    assert asked_ms is not None
    assert 0 < ignored_ms < asked_ms


def test_on_a_network_there_is_no_shared_memory_that_might_lose_packets_in_silence() -> None:
    kinds = [kind.text for kind in ElementTree.parse(PROFILES).iter(f"{NAMESPACE}type")]
    assert kinds == ["UDPv4"]


def duration_ms(file: Path, name: str) -> float | None:
    found = ElementTree.parse(file).find(f".//{NAMESPACE}{name}")
    if found is None:
        return None
    seconds, nanoseconds = (int(found.findtext(f"{NAMESPACE}{u}", "0")) for u in ("sec", "nanosec"))
    return seconds * 1e3 + nanoseconds / 1e6


def test_nothing_but_this_machine_is_reached_and_all_of_a_domain() -> None:
    tree = ElementTree.parse(LOCAL_PROFILES)
    assert {each.text for each in tree.iter(f"{NAMESPACE}address")} == {"127.0.0.1"}
    (reach,) = tree.iter(f"{NAMESPACE}maxInitialPeersRange")
    assert reach.text == str(MOST_LOCAL_PARTICIPANTS)


def test_the_send_buffer_holds_the_announcements_of_a_crowd() -> None:
    """With Linux's default, writers of a crowd ask for acknowledgements with each announcement."""
    (size,) = ElementTree.parse(LOCAL_PROFILES).iter(f"{NAMESPACE}sendBufferSize")
    assert int(size.text or 0) >= 4 << 20


def test_both_files_are_packaged() -> None:
    for file in (PROFILES, LOCAL_PROFILES):
        assert file.suffix == ".xml"
        assert file.parent == Path(__file__).resolve().parents[2] / "neuros" / "transport"
