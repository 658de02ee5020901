"""Replays of several nodes of a run, each in a process of its own, some at a time."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from neuros.api.run_record import PastRun
from neuros.backends.node_command import signal_in_words
from neuros.errors import EnvironmentFault, NeurosError, UsageError
from neuros_analysis.replay.node_replay import FAILED, NodeReplay, NodeVerdict, replay_of

_TAIL_LINES = 20
_END_S = 5.0
VERDICT = "verdict.json"
LOG = "replay.log"


def replays_of(run: PastRun, names: Sequence[str]) -> list[NodeReplay]:
    """Prepare the replays of nodes.

    Raises:
        UsageError, EnvironmentFault: with all nodes that cannot be replayed, by name.
    """
    replays, faults = [], dict[str, NeurosError]()
    for name in names:
        try:
            replays.append(replay_of(run, name, is_strict=True))
        except (UsageError, EnvironmentFault) as fault:
            faults[name] = fault
    if not faults:
        return replays
    lines = [f"  {name}: {str(fault).removeprefix('replay: ')}" for name, fault in faults.items()]
    of = f"{len(faults)} of {len(names)} nodes of {run.folder} cannot be replayed"
    others = " ".join(f"--node {each.name}" for each in replays)
    rest = [f"to replay the others: neuros replay {run.folder} {others}"] if others else []
    text = "\n".join([f"replay: {of}, and none was started:", *lines, *rest])
    is_machine = all(isinstance(fault, EnvironmentFault) for fault in faults.values())
    raise EnvironmentFault(text) if is_machine else UsageError(text)


class Replays:
    """Runs the replays of nodes, ``jobs`` at a time.

    Args:
        folder: takes the place of the run folder; each node has its folder in it.
    """

    def __init__(self, folder: Path, jobs: int) -> None:
        self._folder = folder
        self._jobs = jobs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._is_over = False

    def run(
        self,
        replays: Iterable[tuple[NodeReplay, Path]],
        on_end: Callable[[NodeVerdict], object],
    ) -> list[NodeVerdict]:
        """Replay nodes, each with its Python; the verdicts are in the order of the nodes.

        Args:
            on_end: called with each verdict when it is known.
        """
        with ThreadPoolExecutor(self._jobs) as pool:
            futures = [pool.submit(self._replay, *each) for each in replays]
            try:
                for future in as_completed(futures):
                    on_end(future.result())
            except BaseException:
                self._end()
                raise
        return [future.result() for future in futures]

    def _replay(self, replay: NodeReplay, python: Path) -> NodeVerdict:
        own = self._folder / replay.name
        file = own / VERDICT
        started = replay.start(python, self._folder, ["--verdict", str(file)])
        with (own / LOG).open("wb") as log:
            if self._is_over:
                return NodeVerdict(replay.name, FAILED)
            process = self._processes[replay.name] = subprocess.Popen(
                started.arguments,
                env=started.environment,
                cwd=started.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        code = process.wait()
        try:
            return NodeVerdict.read(file)
        except FileNotFoundError:
            lines = (own / LOG).read_text("utf-8", "replace").splitlines()[-_TAIL_LINES:]
            why = signal_in_words(-code) if code < 0 else f"exit code {code}"
            return NodeVerdict(
                replay.name, FAILED, difference="\n".join([f"its process ended: {why}", *lines])
            )

    def _end(self) -> None:
        """End the processes, which have no child that they would have to end before."""
        self._is_over = True
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
