"""A container that was started, and the node in it."""

from __future__ import annotations

import contextlib
import signal
import threading
from pathlib import Path

import requests
from docker import DockerClient
from docker.errors import DockerException

from neuros.launch.docker.watch import ContainerWatch
from neuros.launch.host import signal_in_words
from neuros.launch.host_command import last_line, script_failure
from neuros.project.resources import memory_text

_OUT_OF_MEMORY = 128 + signal.SIGKILL
_NOT_EXECUTED = (125, 126, 127)
_STOPPED = "the Docker engine stopped it, as it does for `docker stop` and when it ends itself"


class RunningContainer:
    """A container with one node (:class:`neuros.ports.RunningNode`).

    Nothing here waits for the engine: it is asked for something in a thread of its own, and the
    watch says what came of it.
    """

    def __init__(
        self,
        name: str,
        container_id: str,
        engine: DockerClient,
        watch: ContainerWatch,
        *,
        log: Path,
        mem_bytes: int | None,
    ) -> None:
        self._name = name
        self._id = container_id
        self._engine = engine
        self._watch = watch
        self._log = log
        self._mem_bytes = mem_bytes
        self._is_told = False
        watch.add(container_id)

    @property
    def names(self) -> tuple[str, ...]:
        return (self._name,)

    @property
    def id(self) -> str:
        """The id that the engine has given it."""
        return self._id

    def poll(self) -> str | None:
        """``None`` while it runs, then how it ended, in words."""
        end = self._watch.end_of(self._id)
        if end is not None:
            words = how_it_ended(*end, self._log, self._mem_bytes)
            is_stopped = self._watch.is_signalled(self._id) and not self._is_told
            return f"{words}: {_STOPPED}" if is_stopped else words
        if self._watch.lost and not self._watch.has_processes(self._name):
            return f"the Docker engine went away ({self._watch.lost}): start it again"
        return None

    @property
    def is_abandoned(self) -> bool:
        return bool(self._watch.lost) and self._watch.end_of(self._id) is None

    def terminate(self) -> None:
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        self._is_told = True
        if self._watch.lost:
            self._watch.signal_all(number, self._name)
        else:
            threading.Thread(target=self._tell_engine, args=(number,), daemon=True).start()

    def _tell_engine(self, number: signal.Signals) -> None:
        # It may have ended meanwhile; the events say what became of it.
        with contextlib.suppress(DockerException, requests.RequestException):
            self._engine.api.kill(self._id, int(number))


def how_it_ended(exit_code: int, is_out_of_memory: bool, log: Path, mem_bytes: int | None) -> str:
    """How a container ended, in words.

    Args:
        log: of the node; its last line says what could not be executed.
        mem_bytes: its limit of memory, ``None`` if it has none of its own.
    """
    limit = f" (limit {memory_text(mem_bytes)})" if mem_bytes is not None else ""
    if is_out_of_memory and exit_code == _OUT_OF_MEMORY:
        return f"out of memory{limit}"
    if exit_code == 1 and (failure := script_failure(log)):
        return failure
    words = f"exit code {exit_code}"
    if exit_code > 128:
        words = signal_in_words(exit_code - 128)
    elif exit_code in _NOT_EXECUTED and (said := last_line(log)):
        words += f": {said}"
    return words + (f", after a process of it ran out of memory{limit}" if is_out_of_memory else "")
