"""ROS nodes are given up without a word more from others, so that Fast DDS does not hang.

The hang itself takes two processes that end at one moment: one end in 250 of three together. Who
wants to see it: ``pytest -m acceptance tests/integration/test_teardown.py``, with the line that
ends discovery taken out.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
import rclpy
from deadlines import wait_until
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from neuros.backends.domain import choose_domain
from neuros.transport import rclpy_patches
from neuros.transport.lean_node import give_up
from neuros.transport.messages import message_class
from neuros.transport.rclpy_patches import end_discovery

String = message_class("std_msgs/msg/String")
TOPICS = [f"topic_{place}" for place in range(5)]


def begin(name: str, domain_id: int) -> tuple[Context, Node]:
    context = Context()
    options = SignalHandlerOptions.NO
    rclpy.init(context=context, domain_id=domain_id, signal_handler_options=options)
    return context, rclpy.create_node(name, context=context)


@pytest.fixture
def begun() -> Iterator[Callable[[str], Node]]:
    """Makes nodes, each in a context of its own, in one domain; all of them are given up."""
    with choose_domain(None, {}, False) as domain, ExitStack() as stack:

        def make(name: str) -> Node:
            context, node = begin(name, domain.id)
            stack.callback(give_up, context, [node])
            return node

        yield make


@pytest.mark.parametrize(("is_ended", "heard"), [(False, 1), (True, 0)])
def test_a_participant_without_discovery_hears_of_nobody_any_more(
    begun: Callable[[str], Node], is_ended: bool, heard: int
) -> None:
    node, other = begun("node"), begun("other")
    before, after = (node.create_publisher(String, topic, 1) for topic in ("before", "after"))
    other.create_subscription(String, "before", print, 1)
    wait_until(lambda: node.count_subscribers("before") == before.get_subscription_count() == 1)
    if is_ended:
        end_discovery(node)
    other.create_subscription(String, "after", print, 1)
    # DDS matches the two after it has told the listener: no later word can come.
    wait_until(lambda: after.get_subscription_count() == 1)
    assert node.count_subscribers("after") == heard


def test_another_rmw_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rclpy_patches, "_RMW", "librmw_other.so")
    with choose_domain(None, {}, False) as domain:
        context, node = begin("node", domain.id)
        give_up(context, [node])
        assert not context.ok()


@pytest.mark.acceptance
def test_processes_that_end_together_do_not_hang() -> None:
    """Without the cure 1 in 250 does, so that it is seen in 1000 but for once in 50 times."""
    count, rounds = 3, 334
    with choose_domain(None, {}, False) as domain:
        arguments = [sys.executable, __file__, str(domain.id), str(rounds)]
        processes = [
            subprocess.Popen(
                [*arguments, str(place)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            for place in range(count)
        ]
        try:
            for _ in range(rounds):
                for process in processes:
                    # Fast DDS may have printed there that another has removed a file of its.
                    assert process.stdout is not None
                    assert "ready\n" in process.stdout, "one has hung, and ended itself"
                for process in processes:
                    assert process.stdin is not None
                    process.stdin.write("end\n")
                    process.stdin.flush()
            assert [process.wait(20.0) for process in processes] == [0] * count
        finally:
            for process in processes:
                process.kill()
                process.communicate()


def end_again_and_again(domain_id: int, rounds: int, place: int) -> None:
    """One of the processes: it is there, is seen by the others, and ends when it is told to."""
    import faulthandler

    for _ in range(rounds):
        context, node = begin(f"node_{place}", domain_id)
        publishers = [node.create_publisher(String, topic, 1) for topic in TOPICS]
        for topic in TOPICS:
            node.create_subscription(String, topic, print, 1)
        wait_until(lambda: all(each.get_subscription_count() == 3 for each in publishers))  # noqa: B023
        print("ready", flush=True)
        sys.stdin.readline()
        faulthandler.dump_traceback_later(10.0, exit=True)  # from C: Python's lock is held
        give_up(context, [node])
        faulthandler.cancel_dump_traceback_later()


if __name__ == "__main__":
    end_again_and_again(*map(int, sys.argv[1:]))
