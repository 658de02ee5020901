"""An external topic on which a node hears nobody is named, with the reason if there is one."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from launching import BACKENDS, start
from ros_program import RosProgram

from neuros.backends.domain import choose_domain
from neuros.transport.messages import message_class

PROJECT = Path(__file__).parent / "external_topics"


@pytest.mark.parametrize("back_end", BACKENDS)
def test_topics_that_nobody_serves_are_named(back_end: str, tmp_path: Path) -> None:
    with (
        choose_domain(None, {}, False) as domain,
        RosProgram(domain_id=domain.id) as program,
        start(PROJECT, "--backend", back_end, "-d", str(domain.id), cwd=tmp_path) as running,
    ):
        string, integer = map(message_class, ("std_msgs/msg/String", "std_msgs/msg/Int32"))
        program.node.create_publisher(string, "/heard", 10)
        program.node.create_publisher(integer, "/mistaken", 10)
        # The inputs are looked at in this order.
        running.wait_for("input 'unheard': nobody publishes on /unheard", 60.0)
    assert (
        "input 'mistaken': /mistaken is published as std_msgs/msg/Int32, not as std_msgs/msg/String"
    ) in running.output
    assert "input 'heard'" not in running.output


def test_bytes_that_are_no_message_are_left_out_and_the_run_goes_on(tmp_path: Path) -> None:
    """Anybody in the domain may publish them."""
    with (
        choose_domain(None, {}, False) as domain,
        RosProgram(domain_id=domain.id) as program,
        start(PROJECT, "--backend", "process", "-d", str(domain.id), cwd=tmp_path) as running,
    ):
        kind = message_class("std_msgs/msg/String")
        heard = program.node.create_publisher(kind, "/heard", 10)
        program.spin_until(heard.get_subscription_count, 60.0)
        told = "/heard: a packet is left out, and others like it: 12 bytes are no"
        deadline_s = time.monotonic() + 60.0
        while told not in running.output and time.monotonic() < deadline_s:
            # The subscription may not know of the publisher yet, which knows of it.
            heard.publish(b"\0\1\0\0\xff\xff\xff\x7fabc\0")
            running.read(0.2)
        running.wait_for(told)
        running.wait_for("input 'unheard': nobody publishes on /unheard", 60.0)
    assert "node 'listener' failed" not in running.output
