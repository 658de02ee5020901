"""ROS programs of the user's own and a running project find each other, however far they look."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from launching import EXAMPLES, start

from neuros.backends.domain import choose_domain
from neuros.transport.dds_profile import PROFILES_VARIABLE, RANGE_VARIABLE

# Ends as soon as it has heard a packet, and knows both nodes by name.
PROGRAM = """
import sys, time
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("passer_by")
heard = []
node.create_subscription(String, "/neuros/clock/time/display/time/data", heard.append, 10)
end = time.monotonic() + 15
while not (heard and {"clock", "display"} <= set(node.get_node_names())):
    if time.monotonic() > end:
        sys.exit(f"heard {len(heard)}, sees {node.get_node_names()}")
    rclpy.spin_once(node, timeout_sec=0.1)
"""


@pytest.mark.parametrize("discovery", [None, "LOCALHOST", "SUBNET"])
def test_a_program_hears_and_sees_the_nodes(discovery: str | None, tmp_path: Path) -> None:
    unwanted = (RANGE_VARIABLE, PROFILES_VARIABLE)
    environment = {key: value for key, value in os.environ.items() if key not in unwanted}
    if discovery:
        environment[RANGE_VARIABLE] = discovery
    with choose_domain(None, {}, False) as domain:
        environment["ROS_DOMAIN_ID"] = str(domain.id)
        with start(EXAMPLES / "1_tick/clock", "-d", str(domain.id), cwd=tmp_path) as running:
            running.wait_for("display")
            program = subprocess.run(
                [sys.executable, "-c", PROGRAM],
                env=environment,
                capture_output=True,
                text=True,
                timeout=30,
            )
            running.signal(signal.SIGINT)
            running.finish()
    assert program.returncode == 0, program.stderr
