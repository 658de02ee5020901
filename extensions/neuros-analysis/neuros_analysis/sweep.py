"""Sweeps: runs of a project with every combination of values and seeds, and their table."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import itertools
import json
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from tabulate import tabulate

from neuros.api.live import LiveRun
from neuros.api.plan import time_problems
from neuros.api.project import Project, override_texts, value_text
from neuros.api.request import Request
from neuros.api.run import Run
from neuros.api.run_record import consumed_percent
from neuros.caching import locked
from neuros.errors import EnvironmentFault, NeurosError, Problem, ProjectError, UsageError
from neuros.options import takes
from neuros.ports import Job, JobResources, Jobs, SweepExecutor, SweepPlan
from neuros.recording.run_file import RUN_FILE, read_object
from neuros.registry import AUTO, BACK_ENDS, EXECUTORS
from neuros_analysis.options import SweepOptions

_PLAN_NAME = "sweep.json"
_LOCK_NAME = ".sweep.lock"  # there while a sweep goes on
_STOP_NAME = ".sweep.stop"  # there from when a sweep was ended until it goes on
CSV_NAME = "sweep.csv"
_HEED_S = 1.0
_PAUSE_PER_WRITING = 100.0  # so that a table of any length takes 1 % of a core
_OF_EACH_RUN = ("backend", "duration", "record")
_REASON_CHARACTERS = 50
_COUNTS = (": sent", ": consumed")
_MOST_CHARACTERS = 80
# Columns of the table that are none of a value.
_TAKEN = {
    *("seed", "repeat", "exit_code", "reason"),
    *("wall_s", "sim_s", "real_time_factor", "folder"),
}
_OPENING, _CLOSING = "[{", "]}"


class Sweep:
    """A sweep that is over, or as far as it has come.

    Attributes:
        folder: with a folder for each run, and the table, ``sweep.csv``.
        rows: one for each run: its values, ``seed``, ``exit_code``, ``reason``, times, of each
            connection how many packets were sent and consumed, also as a share, what nodes
            found out (``node.set_result``), and its ``folder``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: list[dict[str, Any]] = []

    def frame(self) -> Any:
        """A ``pandas.DataFrame``, one row per run."""
        from neuros_analysis.frames import table

        return table(self.rows)

    def runs(self) -> list[Run]:
        """The runs that have begun, in the order of the rows."""
        folders = [Path(row["folder"]) for row in self.rows]
        return [Run(folder) for folder in folders if (folder / RUN_FILE).exists()]

    def __str__(self) -> str:
        return _table_of(self.rows)

    def __repr__(self) -> str:
        return f"<Sweep of {len(self.rows)} runs in {self.folder}>"


@takes(SweepOptions)
def sweep(project: Project | str | os.PathLike[str], options: SweepOptions) -> Sweep:
    """Run a project with every combination of values, seeds and repetitions.

    What has finished in ``output`` already is not run again, so that a sweep can be gone on with.
    A run that fails is a row like the others. ``KeyboardInterrupt`` ends the runs that go on;
    what has finished is in the table on the disk. This process reads no run folder but those of an
    earlier call: a job sends the row of its run.

    ``set`` has, by path as in ``--set``, a list of values or a single one. Runs have the other
    options of :meth:`~neuros.api.project.Project.run`.

    Raises:
        ProjectError: if the project is not valid with all values; nothing has been run then.
        UsageError: for arguments that make no sense, or if ``output`` holds another sweep, or one
            that goes on.
        EnvironmentFault: if the table cannot be written, or the back end cannot be loaded.
    """
    if not isinstance(project, Project):
        project = Project.from_file(project)
    values = _values(options.set)
    points = points_of(values, [int(seed) for seed in options.seeds], options.repeat)
    if options.jobs is not None and options.jobs < 1:
        raise UsageError(f"jobs {options.jobs}: give 1 or more")
    request = Request(backend=options.backend, duration=options.duration, record=options.record)
    if (back_end := request.backend or AUTO) != AUTO:
        BACK_ENDS.load(back_end)  # else each run would be refused, in a folder that names it
    resources = _check_all(project, points, request)
    folder = _sweep_folder(project, options)
    with _locked_folder(folder):
        return _Sweeping(project, points, folder, options, request).run(resources)


def _values(given: Mapping[str, Any] | Sequence[str] | None) -> dict[str, list[Any]]:
    """The values of each path, from Python or as texts of ``--set``."""
    if isinstance(given, Mapping):
        return {path: _as_list(each) for path, each in given.items()}
    values: dict[str, list[Any]] = {}
    for text in given or ():
        path, listed = parse_values(text)
        if path in values:
            raise UsageError(
                f"--set {path}: is given twice; give it once, with all values separated by commas"
            )
        values[path] = listed
    return values


class _Sweeping:
    """A sweep that goes on."""

    def __init__(
        self,
        project: Project,
        points: Sequence[Point],
        folder: Path,
        options: SweepOptions,
        request: Request,
    ) -> None:
        names = short_names(list(points[0].settings))
        self._name = project.name
        self._options = options
        self._sweep = Sweep(folder)
        self._points = {point.folder_name(names): point for point in points}
        self._rows: dict[str, dict[str, Any]] = {}
        self._next_save_s = 0.0
        self._jobs = {
            name: SweepJob(
                project,
                point.values(names),
                {
                    "set": override_texts(point.settings),
                    "seed": point.seed,
                    **{key: getattr(request, key) for key in _OF_EACH_RUN},
                },
                folder / name,
                folder / _STOP_NAME,
            )
            for name, point in self._points.items()
        }

    def run(self, resources: JobResources) -> Sweep:
        folder, options = self._sweep.folder, self._options
        (folder / _STOP_NAME).unlink(missing_ok=True)
        waiting = [name for name in self._jobs if not self._take_finished(name)]
        try:
            if waiting:
                plan = SweepPlan(self._name, folder, options.jobs, resources, "neuros-analysis")
                with open_executor(options.executor, plan) as jobs:
                    self._execute(jobs, waiting)
        finally:
            self._save()
        return self._sweep

    def _execute(self, jobs: Jobs, waiting: Sequence[str]) -> None:
        """Have the runs made, and note each as soon as it has ended."""
        ended: SimpleQueue[Future[Any]] = SimpleQueue()
        futures: dict[Future[Any], str] = {}
        noted = 0
        try:
            submitted = jobs.submit([self._jobs[name] for name in waiting])
            futures |= zip(submitted, waiting, strict=True)
            for future in futures:
                future.add_done_callback(ended.put)
            while noted < len(futures):
                # Python does not see a Ctrl+C that comes just before it waits, until it has waited.
                with contextlib.suppress(Empty):
                    future = ended.get(timeout=_HEED_S)
                    noted += 1
                    self._note(futures[future], future)
        except BaseException:
            # Wherever they are: jobs look for it.
            (self._sweep.folder / _STOP_NAME).touch()
            jobs.cancel()
            wait(futures)
            for future, name in futures.items():
                self._take(name, future)
            raise

    def _take_finished(self, name: str) -> bool:
        """Whether this was run before; what is to be made again is set aside."""
        job = self._jobs[name]
        # Without a record it may go on: its job sees to it.
        if not (job.folder / RUN_FILE).exists():
            return False
        run = finished_run(job.folder)
        if run and (run.is_ok or not self._options.retry):
            self._rows[name] = row_of(job.values, run)
            return True
        set_aside(job.folder, "failed" if run else "unfinished")
        return False

    def _take(self, name: str, future: Future[Any]) -> bool:
        """Whether a job has brought a row."""
        job = self._jobs[name]
        if future.cancelled():
            return False
        error = future.exception()
        row = future.result() if error is None else failed_row(job.values, error, job.folder)
        if row is not None:
            self._rows[name] = row
        return row is not None

    def _note(self, name: str, future: Future[Any]) -> None:
        if not self._take(name, future):
            return
        if time.monotonic() >= self._next_save_s:
            self._save()
        if self._options.on_row is not None:
            self._options.on_row(len(self._rows), len(self._points), self._rows[name])

    def _save(self) -> None:
        """Write the table; how long that takes says how soon it may be written again."""
        started_s = time.monotonic()
        self._sweep.rows = [self._rows[name] for name in self._points if name in self._rows]
        try:
            _write_csv(self._sweep.rows, self._sweep.folder)
        except OSError as error:
            file = self._sweep.folder / CSV_NAME
            raise EnvironmentFault(f"{file} cannot be written ({error.strerror})") from error
        now_s = time.monotonic()
        self._next_save_s = now_s + _PAUSE_PER_WRITING * (now_s - started_s)


def _as_list(given: Any) -> list[Any]:
    is_one = isinstance(given, (str, bytes, Mapping)) or not hasattr(given, "__iter__")
    return [given] if is_one else list(given)


def _check_all(project: Project, points: Sequence[Point], request: Request) -> JobResources:
    """Check the project with every point; returns what is enough for each of its runs.

    Raises ``ProjectError`` with all problems.
    """
    problems: list[Problem] = []
    needs: set[JobResources] = set()
    for point in points:
        try:
            checked = project.check_with(point.settings, point.seed)
            problems += time_problems(checked, checked.nodes, request.end)
            needs.add(JobResources.of(checked))
        except ProjectError as error:
            problems += error.problems
    if problems:
        raise ProjectError(problems)
    return JobResources.most(needs)


def _sweep_folder(project: Project, options: SweepOptions) -> Path:
    """The sweep's folder, new or that of an earlier part of it. Raises ``UsageError``."""
    stamp = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H-%M-%SZ")
    folder = Path(options.output or Path("runs", project.name, f"sweep-{stamp}")).absolute()
    plan = {
        "project": str(project.file),
        "project_sha256": hashlib.sha256(project.text().encode()).hexdigest(),
        **{name: str(getattr(options, name)) for name in _OF_EACH_RUN},
    }
    file = folder / _PLAN_NAME
    try:
        if file.exists():
            _check_same(read_object(file), plan, folder)
            return folder
        if folder.exists() and any(folder.iterdir()):
            raise UsageError(f"{folder}: is neither empty nor a sweep; name another folder with -o")
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(plan, indent=2) + "\n", "utf-8")
    except (OSError, ValueError, EnvironmentFault) as error:
        raise UsageError(f"{folder} cannot be used ({error}): name another one with -o") from error
    return folder


@contextlib.contextmanager
def _locked_folder(folder: Path) -> Iterator[None]:
    """Keep others from the folder: to them, runs that go on are cut off. Raises ``UsageError``."""
    with contextlib.ExitStack() as stack:
        try:
            is_alone = stack.enter_context(locked(folder / _LOCK_NAME, wait=False))
        except OSError as error:
            raise UsageError(
                f"{folder} cannot be used ({error}): name another one with -o"
            ) from error
        if not is_alone:
            raise UsageError(f"{folder}: a sweep goes on there; wait for its end, or name another")
        yield


def _check_same(before: Mapping[str, Any], now: Mapping[str, Any], folder: Path) -> None:
    for name, value in now.items():
        if before.get(name) != value:
            is_text = name == "project_sha256"
            what = "the project's files differ" if is_text else f"its {name} differs"
            raise UsageError(
                f"{folder} holds a sweep that is not this one ({what}): name another folder with -o"
            )


def _columns_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The columns of all rows; that of the folder is the last."""
    found = dict.fromkeys(name for row in rows for name in row)
    found.pop("folder", None)
    return [*found, "folder"]


def _write_csv(rows: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """Write ``sweep.csv``; a reader never finds half of it. Raises ``OSError``."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, _columns_of(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    new = folder / f"{CSV_NAME}.new"
    new.write_text(text.getvalue(), "utf-8")
    os.replace(new, folder / CSV_NAME)


def _table_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """For people: without folders, times and counts."""
    hidden = ("folder", "wall_s", "sim_s")
    names = [n for n in _columns_of(rows) if n not in hidden and not n.endswith(_COUNTS)]
    names = [name for name in names if any(_is_shown(row.get(name)) for row in rows)]
    table: str = tabulate(
        [[_cell(name, row.get(name)) for name in names] for row in rows],
        headers=[name.replace(": ", "\n").replace(" -> ", "\n-> ") for name in names],
        disable_numparse=True,
    )
    return table


def _is_shown(value: Any) -> bool:
    return value is not None and not isinstance(value, (list, dict))


def _cell(name: str, value: Any) -> str:
    if value is None or isinstance(value, (list, dict)):
        return ""
    if name.endswith(SHARE):
        return f"{value:.1f}"
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    if name == "reason" and len(text) > _REASON_CHARACTERS:
        return text[: _REASON_CHARACTERS - 3] + "..."
    return text


# ---------------------------------------------------------------------- executors


class LocalExecutor(SweepExecutor):
    """Runs on this machine, one after the other, or ``--jobs`` at once."""

    name = "local"

    def open(self, place: str | None, plan: SweepPlan) -> Executor:
        # A run is processes of its own: its launcher has enough with a thread.
        return ThreadPoolExecutor(plan.count or 1, thread_name_prefix="neuros-sweep")


LOCAL = LocalExecutor()


class _PoolJobs:
    """The jobs of a pool of :mod:`concurrent.futures`."""

    def __init__(self, pool: Executor) -> None:
        self._pool = pool

    def submit(self, jobs: Sequence[Job]) -> list[Future[Any]]:
        return [self._pool.submit(job) for job in jobs]

    def cancel(self) -> None:
        """Nothing: a job that begins now returns at once."""


@contextlib.contextmanager
def open_executor(wanted: str | Executor, plan: SweepPlan) -> Iterator[Jobs]:
    """The executor that is asked for: ``NAME``, ``NAME=PLACE``, or a pool of the caller's own.

    Raises ``UsageError`` and ``EnvironmentFault``.
    """
    if isinstance(wanted, Executor):
        if plan.count is not None:
            raise UsageError("jobs: the executor that is given decides how many runs go on at once")
        yield _PoolJobs(wanted)
        return
    name, equals, place = wanted.partition("=")
    executor = EXECUTORS.load(name)
    if equals and not (place and executor.place):
        what = f"give {name}={executor.place}" if executor.place else f"give {name} alone"
        raise UsageError(f"--executor {wanted}: {what}")
    with executor.open(place or None, plan) as opened:
        yield _PoolJobs(opened) if isinstance(opened, Executor) else opened


# ---------------------------------------------------------------------- points


@dataclass(frozen=True)
class Point:
    """One run of a sweep.

    Attributes:
        settings: values by path.
        seed: for all nodes that have one, ``None``: as in the files.
        repeat: which repetition it is, from 1; ``None`` where there is one only.
    """

    settings: Mapping[str, Any]
    seed: int | None = None
    repeat: int | None = None

    def values(self, names: Mapping[str, str]) -> dict[str, Any]:
        """What tells it from others; ``names``: of the columns, by path."""
        found = {names[path]: value for path, value in self.settings.items()}
        found |= {} if self.seed is None else {"seed": self.seed}
        return found | ({} if self.repeat is None else {"repeat": self.repeat})

    def folder_name(self, names: Mapping[str, str]) -> str:
        """A name for its folder: readable, and never that of another point."""
        settings = sorted((path, value_text(path, v)) for path, v in self.settings.items())
        identity = (settings, self.seed, self.repeat)
        digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:8]
        text = "_".join(f"{name}={value}" for name, value in self.values(names).items()) or "run"
        return f"{re.sub(r'[^A-Za-z0-9._=+-]', '-', text)[:_MOST_CHARACTERS]}-{digest}"


def points_of(
    values: Mapping[str, Sequence[Any]], seeds: Sequence[int], repeat: int
) -> list[Point]:
    """The grid; what is named last changes first.

    Raises:
        UsageError: if there is no value for something, or one twice.
    """
    if repeat < 1:
        raise UsageError(f"repeat {repeat}: give 1 or more")
    for name, given in {**values, "seeds": seeds}.items():
        texts = [value_text(name, value) for value in given]
        twice = {text for text in texts if texts.count(text) > 1}
        if twice:
            raise UsageError(f"{name}: {', '.join(sorted(twice))} is given twice")
        if not texts and name != "seeds":
            raise UsageError(f"{name}: give a value")
    repeats: Sequence[int | None] = [None] if repeat == 1 else range(1, repeat + 1)
    return [
        Point(dict(zip(values, combination, strict=True)), seed, number)
        for combination in itertools.product(*values.values())
        for seed in (seeds or (None,))
        for number in repeats
    ]


def short_names(paths: Sequence[str]) -> dict[str, str]:
    """What to call paths: their last steps, as few as tell them apart."""
    names = {}
    for path in paths:
        steps = path.split(".")
        count = 2 if steps[-1] in _TAKEN else 1
        while any(other != path and other.split(".")[-count:] == steps[-count:] for other in paths):
            count += 1
        names[path] = ".".join(steps[-count:])
    return names


def parse_values(text: str) -> tuple[str, list[Any]]:
    """``PATH=1,2,3`` as on the command line: commas within brackets and quotes are no separators.

    Raises:
        UsageError: if it is not of this form.
    """
    path, equals, listed = text.partition("=")
    if not (path and equals):
        raise UsageError(f"--set {text}: is not of the form PATH=VALUE,VALUE,...")
    is_text = path.split(".")[2:3] == ["environment"]
    return path, [part if is_text else _json_or_text(part) for part in _split(listed)]


def _split(text: str) -> Iterator[str]:
    depth, in_quotes, start = 0, False, 0
    for place, character in enumerate(text):
        if character == '"':
            in_quotes = not in_quotes
        elif not in_quotes:
            depth += (character in _OPENING) - (character in _CLOSING)
            if character == "," and depth == 0:
                yield text[start:place]
                start = place + 1
    yield text[start:]


def _json_or_text(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


# ---------------------------------------------------------------------- jobs
#
# One run of a sweep as a job, which is sent to an executor, and the row that comes back.


# A run that was interrupted, or could not write what it should, is made again.
_FINISHED = (0, 1, 5)
SHARE = ": consumed / %"
_LOOK_S = 0.25


@dataclass(frozen=True)
class SweepJob:
    """A run of a sweep. Calling it makes the run, wherever it was sent.

    Several jobs of the same run do no harm, as after the front end of a sweep was killed, or where
    Dask has taken a worker for lost: one makes it, and the others return its row.

    Attributes:
        values: what the row begins with.
        arguments: of :meth:`Project.start`.
        folder: of the run.
        stop: a file; as soon as it is there, the run is ended, and none begins.
    """

    project: Project
    values: Mapping[str, Any]
    arguments: Mapping[str, Any]
    folder: Path
    stop: Path

    def __call__(self) -> dict[str, Any] | None:
        """Make the run; returns its row, ``None`` if the sweep was ended before."""
        try:
            with locked(self.folder.with_name(f".{self.folder.name}.lock")):
                return None if self.stop.exists() else self._row_of_another() or self._make()
        except (NeurosError, OSError) as error:
            return failed_row(self.values, error, self.folder)

    def _row_of_another(self) -> dict[str, Any] | None:
        """The row of the run if another job has made it; what is left of one is set aside."""
        if not self.folder.exists():
            return None
        run = finished_run(self.folder)
        if run is None:
            set_aside(self.folder)
        return None if run is None else row_of(self.values, run)

    def _make(self) -> dict[str, Any] | None:
        live: LiveRun | None = None
        try:
            live = self.project.start(**self.arguments, output=self.folder)
            run = self._ended(live)
        except KeyboardInterrupt:  # of a cluster that wants its machine back
            if live is None:
                raise
            live.end()
            run = Run(live.folder)
        is_cut_off = run.exit_code not in _FINISHED and self.stop.exists()
        return None if is_cut_off else row_of(self.values, run)

    def _ended(self, live: LiveRun) -> Run:
        while not self.stop.exists():
            try:
                return live.wait(_LOOK_S)
            except TimeoutError:
                continue
        live.interrupt()
        return live.wait()


def finished_run(folder: Path) -> Run | None:
    """The run that a folder holds, unless it was cut off."""
    try:
        run = Run(folder)
    except NeurosError:
        return None
    return run if run.exit_code in _FINISHED else None


def set_aside(folder: Path, why: str = "unfinished") -> None:
    """Rename what a run has left that is made again."""
    number = 1
    while (aside := folder.with_name(f"{folder.name}.{why}-{number}")).exists():
        number += 1
    folder.rename(aside)


def row_of(values: Mapping[str, Any], run: Run) -> dict[str, Any]:
    """What came of a run, behind the values that it was made with."""
    row = {
        **values,
        "exit_code": run.exit_code,
        "reason": run.reason,
        "wall_s": run.wall_s,
        "sim_s": run.sim_s,
        "real_time_factor": run.real_time_factor,
    }
    for name, connection in run.connections.items():
        sent, consumed = connection["sent"], connection["consumed"]
        row[f"{name}: sent"] = sent
        row[f"{name}: consumed"] = consumed
        row[f"{name}{SHARE}"] = consumed_percent(connection)
    for node, results in run.node_results.items():
        row |= {f"{node}.{name}": value for name, value in results.items()}
    return {**row, "folder": str(run.folder)}


def failed_row(values: Mapping[str, Any], error: BaseException, folder: Path) -> dict[str, Any]:
    """The row of a run that could not begin, or whose job was lost."""
    return {**values, "exit_code": None, "reason": f"not made: {error}", "folder": str(folder)}
