"""For all tests: where they run, what they need, and that none leaves anything for the next.

A run is on the back end that a test names, else on that of processes. What ``auto`` would choose
depends on the machine: it has tests of its own, which name it.
"""

import gc
import os
import sys
from collections.abc import Iterator
from importlib import import_module

import pytest
from hypothesis import HealthCheck, settings
from marking import Watch, longest_first, mark
from needs import require, summary

with pytest.MonkeyPatch.context() as patch:
    # NumPy reads it when it is loaded: threads of all workers spin while they wait for a core.
    patch.setenv("OPENBLAS_NUM_THREADS", "1")
    import_module("numpy")

os.environ.setdefault("NEUROS_BACKEND", "process")
LOADING = sys.getdlopenflags()
WATCH = Watch()

# How long examples take depends on what else the machine does.
settings.register_profile("anywhere", deadline=None, suppress_health_check=[HealthCheck.too_slow])
# pytest tests/fuzz --hypothesis-profile=long: an hour or two.
settings.register_profile("long", settings.get_profile("anywhere"), max_examples=20_000)
settings.load_profile("anywhere")


@pytest.fixture(autouse=True)
def environment_as_found() -> Iterator[None]:
    """What ROS nodes, simulators and kernels of the test's own process set is not inherited."""
    found = dict(os.environ)
    yield
    if dict(os.environ) != found:
        os.environ.clear()
        os.environ.update(found)


@pytest.fixture(autouse=True)
def libraries_share_no_symbols() -> Iterator[None]:
    """NEST has them do so from its import on; of two ROS messages with one name one breaks then."""
    sys.setdlopenflags(LOADING)
    yield
    sys.setdlopenflags(LOADING)


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report() -> Iterator[None]:
    """Nor after modules that import NEST."""
    yield
    sys.setdlopenflags(LOADING)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Function]) -> None:
    """Give each test its markers, before ``-m`` chooses by them."""
    for item in items:
        mark(item)
    if hasattr(config, "workerinput"):  # no worker has much to do when the others are done
        longest_first(items)


def pytest_collection_finish() -> None:
    """The garbage collector need not go through all tests and modules again and again."""
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """A unit test starts nothing outside its own process."""
    if item.get_closest_marker("unit") is None:
        return (yield)
    with WATCH.nothing_leaves():
        return (yield)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """What a test's marker ``needs`` names has to be there."""
    for needs in item.iter_markers("needs"):
        require(*needs.args)


class FailuresAtOnce:
    """Says which test failed when it does: a run of all takes a quarter of an hour."""

    def __init__(self, terminal: pytest.TerminalReporter) -> None:
        self._terminal = terminal

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._terminal.write_line(f" {report.nodeid}: {report.when} failed")


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    terminal = config.pluginmanager.get_plugin("terminalreporter")
    if terminal is not None:  # a worker of pytest-xdist has none
        config.pluginmanager.register(FailuresAtOnce(terminal))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Count apart the tests that were left out for want of something."""
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = [each.longrepr[2] for each in skipped if isinstance(each.longrepr, tuple)]
    if lines := list(summary(reason.removeprefix("Skipped: ") for reason in reasons)):
        terminalreporter.section("left out, for want of")
        for line in lines:
            terminalreporter.line(line)
