"""Where a node stands in its plugin: told by itself, and read from outside while it cannot."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from deadlines import wait_until

from neuros.stacks import ProcessThreads, Thread, stack_in, threads_of

PLUGIN = """\
import ctypes, threading
def hook(wait):
    print("running", flush=True)
    deep(wait)
def deep(wait):
    wait()
def hold():
    ctypes.PyDLL(None).sleep(60)
def hold_elsewhere():
    thread = threading.Thread(target=hold, name="worker")
    thread.start()
    thread.join()
"""
CALLS = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("plugin", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
module.hook(getattr(module, sys.argv[2]))
"""


@pytest.fixture
def plugin(tmp_path: Path) -> Path:
    (tmp_path / "plugin_\u00fc.py").write_text(PLUGIN)
    return tmp_path / "plugin_\u00fc.py"


@contextmanager
def in_hook(plugin: Path, function: str) -> Iterator[int]:
    """The id of a process whose hook calls one of the functions."""
    command = [sys.executable, "-c", CALLS, plugin, function]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == b"running\n"
        yield process.pid
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def lines_of(text: str) -> list[str]:
    """Line and function of each call."""
    frames = [line for line in text.splitlines() if line.startswith("  File")]
    return [frame.partition(", ")[2] for frame in frames]


def test_it_is_read_while_the_plugin_holds_the_global_lock(plugin: Path) -> None:
    with in_hook(plugin, "hold") as pid:
        wait_until(lambda: "in hold" in str(threads_of(pid)), 20.0)
        read = threads_of(pid)
    assert not read.stopped
    assert read.lock_holder is not None
    assert read.lock_holder.is_main
    assert read.hook_stack("other", str(plugin.parent / "other.py")) is None
    stack = read.hook_stack("a", str(plugin))
    assert stack is not None
    assert (stack.node, stack.hook) == ("a", "hook")
    assert lines_of(stack.text) == ["line 4, in hook", "line 6, in deep", "line 8, in hold"]


def test_so_is_that_of_a_thread_of_the_plugin_that_holds_it(plugin: Path) -> None:
    with in_hook(plugin, "hold_elsewhere") as pid:
        wait_until(lambda: "in hold" in str(threads_of(pid).lock_holder), 20.0)
        read = threads_of(pid)
    holder, stack = read.lock_holder, read.hook_stack("a", str(plugin))
    assert holder is not None
    assert holder.name.startswith("worker")
    assert lines_of(str(holder))[-1] == "line 8, in hold"
    assert stack is not None
    assert lines_of(stack.text)[:2] == ["line 4, in hook", "line 6, in deep"]
    first, *_ = str(read).splitlines()
    assert first == "MainThread:"
    assert "worker holds Python's global lock:\n" in str(read)


def test_a_process_that_was_stopped_is_read_too(plugin: Path) -> None:
    with in_hook(plugin, "hold") as pid:
        wait_until(lambda: "in hold" in str(threads_of(pid)), 20.0)
        os.kill(pid, signal.SIGSTOP)
        wait_until(lambda: threads_of(pid).stopped, 20.0)
        assert "in deep" in str(threads_of(pid))


def test_why_nothing_could_be_read_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with subprocess.Popen(["sleep", "60"]) as process:
        assert threads_of(process.pid) == ProcessThreads(
            problem="py-spy: Failed to find python version from target process"
        )
        process.kill()
    assert threads_of(process.pid).problem.startswith("py-spy: Failed to get process executable")
    monkeypatch.setattr("importlib.metadata.files", lambda _: None)
    monkeypatch.setenv("PATH", "/nowhere")
    assert threads_of(os.getpid()).problem.startswith("py-spy is not installed")


def test_of_a_deep_recursion_the_first_call_and_the_last_hundred_are_shown() -> None:
    frames = tuple(("/a.py", line, "deep") for line in range(250))
    text = str(Thread("MainThread", is_main=True, has_lock=False, frames=frames))
    _, first, left_out, *others = text.splitlines()
    assert first == '  File "/a.py", line 0, in deep'
    assert left_out == "  [150 calls are left out]"
    assert len(others) == 99
    assert others[-1] == '  File "/a.py", line 249, in deep'


def test_no_file_is_opened_that_a_process_names(tmp_path: Path) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("first\nsecret\n")
    compiles = f"""
print("running", flush=True)
exec(compile("\\n__import__('time').sleep(60)", {str(secret)!r}, "exec"))
"""
    with subprocess.Popen([sys.executable, "-c", compiles], stdout=subprocess.PIPE) as process:
        try:
            wait_until(lambda: f'"{secret}", line 2' in str(threads_of(process.pid)), 20.0)
            assert "secret\n" not in str(threads_of(process.pid))
        finally:
            process.kill()


def test_a_node_that_reports_tells_it_of_its_main_thread(plugin: Path) -> None:
    spec = importlib.util.spec_from_file_location("plugin", plugin)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: list[Any] = []

    def ask() -> None:
        thread = threading.Thread(target=lambda: found.append(stack_in("a", plugin)))
        thread.start()
        thread.join()

    module.hook(ask)
    (stack,) = found
    node, hook, text = stack.node, stack.hook, stack.text
    assert (node, hook) == ("a", "hook")
    assert text.startswith(f'  File "{plugin}", line 4, in hook\n    deep(wait)\n  File ')
    ask()
    assert found[1] is None, "it is in no plugin now"


def test_a_busy_process_is_read_many_times_and_goes_on_unharmed() -> None:
    """As after a standstill of the machine: it goes on while its threads are read."""
    busy = """
import threading
def go_on():
    while True:
        exec("def deep(n):\\n return n and [deep(n - 1)]\\ndeep(20)", {})
print("running", flush=True)
threading.Thread(target=go_on).start()
go_on()
"""
    with subprocess.Popen([sys.executable, "-c", busy], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == b"running\n"
            texts = [str(threads_of(process.pid)) for _ in range(100)]
            assert process.poll() is None
        finally:
            process.kill()
    assert sum("in go_on" in text for text in texts) > 50
