"""The faults that ``rclpy_patches`` corrects are still there; once one is gone, so is its patch."""

from __future__ import annotations

import inspect
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from neuros.transport.dds_profile import LOCAL_PROFILES, PROFILES_VARIABLE, RANGE_VARIABLE
from neuros.transport.lean_node import give_up
from neuros.transport.rclpy_patches import GuardedTask

FAILING_TASK = """
import rclpy
from rclpy.experimental.events_executor import EventsExecutor

def fail():
    raise ValueError("on purpose")

rclpy.init()
executor = EventsExecutor()
executor.add_node(rclpy.create_node("node"))
executor.spin_until_future_complete(executor.create_task(fail), 20.0)
"""


def test_a_task_that_fails_still_ends_the_process() -> None:
    # A process that dies so would leave the shared memory of DDS behind: it gets UDP alone.
    environment = {**os.environ, PROFILES_VARIABLE: str(LOCAL_PROFILES)}
    environment[RANGE_VARIABLE] = "SYSTEM_DEFAULT"
    command = [sys.executable, "-c", FAILING_TASK]
    done = subprocess.run(command, env=environment, capture_output=True, timeout=60)
    assert done.returncode == -signal.SIGSEGV, "own_tasks may go: rclpy issue 1641 is corrected"


@pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # ROS's parser has it
def test_fast_dds_is_still_of_the_releases_that_may_hang_at_the_end() -> None:
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("node", context=context)
    loaded = set(re.findall(r"/lib(fast[a-z]+)\.so\.(\d+)", Path("/proc/self/maps").read_text()))
    give_up(context, [node])
    known = {("fastrtps", "2"), ("fastcdr", "2")}
    assert loaded <= known, "is Fast DDS issue 6513 closed? Then end_discovery may go"


def test_a_coroutine_that_the_end_comes_before_is_closed() -> None:
    """Else Python warns that it was never awaited."""

    async def later() -> None: ...

    task = GuardedTask(later)
    coroutine = task._handler
    del task
    assert inspect.getcoroutinestate(coroutine) == inspect.CORO_CLOSED
