"""Where a node stands in its plugin, told by itself, and by a thread in C while it cannot."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from containers import wait_until
from neuros.stacks import FILE_NAME, held_stack, remove_stack_files, stack_in

PLUGIN = """\
import ctypes, threading
def hook(wait):
    print("running", flush=True)
    deep(wait)
def deep(wait):
    wait()
def hold():
    ctypes.PyDLL(None).sleep(60)
"""
HOLDS = """
import importlib.util, pathlib, sys
from neuros import stacks
stacks.HELD_S = 0.2
plugin = pathlib.Path(sys.argv[1])
spec = importlib.util.spec_from_file_location("plugin", plugin)
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
stacks.StackFile(plugin.parent, {"other": plugin.parent / "other.py", "a": plugin}).renew()
module.hook(module.hold)
"""


@pytest.fixture
def plugin(tmp_path: Path) -> Path:
    """Its name has a letter that faulthandler spells out."""
    (tmp_path / "plugin_\u00fc.py").write_text(PLUGIN)
    return tmp_path / "plugin_\u00fc.py"


@contextmanager
def held(plugin: Path) -> Iterator[None]:
    """A process whose plugin holds the global lock."""
    process = subprocess.Popen([sys.executable, "-c", HOLDS, plugin], stdout=subprocess.PIPE)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == b"running\n"
        yield
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_it_is_known_while_the_plugin_holds_the_global_lock(plugin: Path) -> None:
    with held(plugin):
        wait_until(lambda: held_stack(plugin.parent), 20.0)
        stack = held_stack(plugin.parent)
    assert stack is not None
    assert (stack.node, stack.hook) == ("a", "hook")
    lines = [line for line in stack.text.splitlines() if line.startswith("  File")]
    assert [line.split(", ")[1:] for line in lines] == [
        ["line 4", "in hook"],
        ["line 6", "in deep"],
        ["line 8", "in hold"],
    ]


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


def test_a_file_of_one_that_reports_says_nothing(tmp_path: Path) -> None:
    found = run(
        """
        file = stacks.StackFile(folder, {"a": folder / "a.py"})
        with open(folder / stacks.FILE_NAME, "a") as more:
            more.write("Stack (most recent call first):\\n")
            more.write(f'  File "{folder}/a.py", line 3 in f\\n')
        print(stacks.held_stack(folder).hook)
        file.renew()
        print(stacks.held_stack(folder))
        """,
        tmp_path,
    )
    assert (found.returncode, found.stdout) == (0, "f\nNone\n")
    remove_stack_files([tmp_path, tmp_path / "nowhere"])
    assert held_stack(tmp_path) is None
    assert not (tmp_path / FILE_NAME).exists()


def test_a_process_that_was_only_late_goes_on_unharmed(tmp_path: Path) -> None:
    """As after a standstill of the machine: the stack is written while other threads go on."""
    found = run(
        """
        stacks.HELD_S = 0.005
        def late():
            until_s = time.monotonic() + 2.0
            while time.monotonic() < until_s:
                exec("def deep(n):\\n return n and [deep(n - 1)]\\ndeep(20)", {})
        stacks.StackFile(folder, {}).renew()
        thread = threading.Thread(target=late)
        thread.start()
        thread.join()
        print((folder / stacks.FILE_NAME).read_text().count("in join"))
        """,
        tmp_path,
    )
    assert found.returncode == 0, "it was killed by a signal"
    assert int(found.stdout) > 20


def run(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A program in a process of its own."""
    head = "import sys, threading, time\nfrom pathlib import Path\nfrom neuros import stacks\n"
    head += "folder = Path(sys.argv[1])\n"
    command = [sys.executable, "-c", head + textwrap.dedent(program), folder]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
