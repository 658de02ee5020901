"""How much memory a node needs beyond what rclpy alone needs for the same endpoints.

Two nodes that send each other an Imu message ten times a second, each in a process of its own;
without NeuROS the same with a timer, a publisher and a subscription. *Unique* is what no other
process shares (USS: what ending the process would free), *resident* counts shared pages, too (RSS).
"""

from __future__ import annotations

import time

import psutil

from benchmarks.bare_nodes import begun
from benchmarks.graphs import lossless
from benchmarks.launching import project_of_plugins
from benchmarks.live import live
from benchmarks.measure import Case, Difference, Figure, Group, Subject

IMU = "sensor_msgs/msg/Imu"
SETTLE_S = 2.0


def subject(is_quick: bool) -> Subject:
    """The same either way: it takes two seconds."""
    cases = []
    for kind, label in (("unique", "unique"), ("resident", "resident")):
        node, bare = Figure("NeuROS", kind), Figure("rclpy", kind)
        bound = "memory" if kind == "unique" else None
        name = f"memory of a node, {label}"
        cases.append(Case(name, "MB", node, bare, "bare rclpy node"))
        cases.append(
            Case(f"{name}, beyond a bare rclpy node", "MB", Difference(node, bare), bound=bound)
        )
    candidates = {"NeuROS": node_memory, "rclpy": bare_memory}
    return Subject("memory per node", (Group(candidates, tuple(cases)),))


def node_memory() -> dict[str, float]:
    """Of one of the two nodes' processes, in MB."""
    names = ("left", "right")
    nodes = [
        {
            "name": name,
            "container": "neuros_python",
            "plugin": "imu_exchange.py",
            "inputs": [{"name": "heard", "type": IMU}],
            "outputs": [{"name": "said", "type": IMU}],
        }
        for name in names
    ]
    connections = [lossless("left.said", "right.heard"), lossless("right.said", "left.heard")]
    with (
        project_of_plugins({"nodes": nodes, "connections": connections}) as folder,
        live(folder, "process") as run,
    ):
        run.wait_for(names, "heard")
        time.sleep(SETTLE_S)
        return _memory(run.host_of("left"))


def bare_memory() -> dict[str, float]:
    """The same without NeuROS."""
    ends = (("a", "b"), ("b", "a"))
    programs = [[{"role": "exchange", "to": to, "from": source}] for to, source in ends]
    with begun(programs) as processes:
        time.sleep(SETTLE_S)
        return _memory(psutil.Process(processes[0].pid))


def _memory(process: psutil.Process) -> dict[str, float]:
    memory = process.memory_full_info()
    return {"unique": memory.uss / 1e6, "resident": memory.rss / 1e6}
