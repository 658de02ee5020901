"""``neuros launch``: a run with its console, its signals, and its exit code."""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from neuros.api.execution import Execution, run_domain
from neuros.api.plan import Plan, make_plan
from neuros.api.recording import recording_of
from neuros.api.request import Request, parse_duration
from neuros.api.run_folder import folders_of, run_folder_path
from neuros.cli.environments import make_shown_environments
from neuros.cli.launch_options import back_end_options
from neuros.cli.projects import load_with_messages
from neuros.cli.views import Views
from neuros.errors import UsageError
from neuros.recording.selection import Request as RecordingRequest


def launch(options: argparse.Namespace) -> int:
    """Run a project; returns the exit code."""
    with _signals_noted() as (signals, waker):
        request = _request(options)
        project, messages = load_with_messages(options)
        plan = make_plan(project, messages, request, is_tried=not options.dry_run)
        if options.dry_run:
            return _dry_run(plan, request)
        if ended := make_shown_environments(plan.pythons, signals, messages):
            return ended
        views = Views(options, plan)
        run = Execution(plan, request, sys.stdout, signals, waker, views=views)
        return int(run.run()["exit_code"])


def _request(options: argparse.Namespace) -> Request:
    """What the options ask for. Raises ``UsageError``."""
    return Request(
        backend=options.backend,
        backend_options=back_end_options(options),
        nodes=tuple(options.node),
        duration=parse_duration(options.duration),
        domain_id=options.domain_id,
        network=options.network,
        peers=options.peers,
        output=options.output,
        is_placed=not options.no_placement,
        has_digests=options.digests,
        monitors_load=options.monitor_system_load,
        shows_progress=options.progress,
        recording=_recording_request(options),
        is_verbose=options.verbose,
    )


def _recording_request(options: argparse.Namespace) -> RecordingRequest | None:
    """What the command line has recorded, ``None``: nothing. Raises ``UsageError``."""
    if options.record or options.record_topics:
        return RecordingRequest(
            everything=options.record,
            topics=tuple(options.record_topics),
            exclude=tuple(options.exclude),
            storage=options.storage,
        )
    if options.exclude or options.storage != "mcap":
        name = "--exclude" if options.exclude else "--storage"
        raise UsageError(f"{name}: nothing is recorded; add -r, or name topics with -t")
    return None


def _dry_run(plan: Plan, request: Request) -> int:
    recording = recording_of(plan, request, os.environ)
    folder = run_folder_path(request.output, plan.project.name, "<utc time>")
    with run_domain(plan, request, recording) as domain:
        print(f"back end {plan.back_end.name}; {domain.reason}; run folder {folder}")
    messages = plan.messages.describe() if plan.messages else ()
    for line in (*plan.pythons.notices, *plan.pythons.describe(), *messages):
        print(line)
    for _, notice in plan.notices:
        print(notice)
    for line in plan.launcher().describe(plan.node_files(folders_of(plan, folder))):
        print(line)
    if recording is not None:
        names = ", ".join([*(topic.name for topic in recording.topics), *recording.listen])
        print(f"recorder: {names or 'nothing'} ({recording.storage})")
    return 0


@contextmanager
def _signals_noted() -> Iterator[tuple[list[int], socket.socket]]:
    """Collect SIGINT and SIGTERM instead of dying of them, until the run is cleaned up.

    Yields them, and a socket to which a byte goes for each, and whenever a child has ended.
    """
    noted: list[int] = []
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # else nohup wants it to go on
        numbers.append(signal.SIGHUP)
    previous = {
        number: signal.signal(number, lambda number, _: noted.append(number)) for number in numbers
    }
    previous[signal.SIGCHLD] = signal.signal(signal.SIGCHLD, lambda *_: None)
    waker = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)  # launch.py had them wait
    try:
        yield noted, reader
    finally:
        signal.set_wakeup_fd(waker)
        for number, handler in previous.items():
            signal.signal(number, handler)
        reader.close()
        writer.close()
