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
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from tabulate import tabulate

from neuros.api.kept import find_sources, given_sources
from neuros.api.live import LiveRun
from neuros.api.loading import override_texts, value_text
from neuros.api.plan import time_problems
from neuros.api.project import Project, StartOptions
from neuros.api.request import Request
from neuros.api.run import Run
from neuros.caching import locked
from neuros.errors import EnvironmentFault, NeurosError, Problem, ProjectError, UsageError
from neuros.options import takes
from neuros.ordinary_files import write_whole
from neuros.ports import Job, JobResources, Jobs, SweepExecutor, SweepPlan
from neuros.recording.run_file import RUN_FILE, read_object
from neuros.registry import AUTO, BACK_ENDS, EXECUTORS
from neuros_analysis.comparison import consumed_percent
from neuros_analysis.options import SweepOptions

_PLAN_NAME = "sweep.json"
_LOCK_NAME = ".sweep.lock"  # locked while a sweep goes on
_STOP_NAME = ".sweep.stop"  # exists from the interruption of a sweep until its continuation
CSV_NAME = "sweep.csv"
_WAIT_S = 1.0
_PAUSE_PER_WRITING = 100.0  # writing the table uses at most 1 % of a core, however long it is
_OF_EACH_RUN = ("backend", "duration", "portable", "record")  # as given
_OF_EACH_JOB = (*_OF_EACH_RUN, "restore")
_REASON_CHARACTERS = 50
_COUNTS = (": sent", ": consumed")
_MOST_CHARACTERS = 80
# Columns of the table that do not hold a value of the sweep.
_TAKEN = {
    *("seed", "repeat", "exit_code", "reason"),
    *("wall_s", "sim_s", "real_time_factor", "folder"),
}
_OPENING, _CLOSING = "[{", "]}"


class Sweep:
    """A finished or interrupted sweep.

    Attributes:
        folder: with a folder for each run, and the table, ``sweep.csv``.
        rows: one per run: its values, ``seed``, ``exit_code``, ``reason``, times, sent and consumed
            packets of each connection, results of nodes (``node.set_result``), and ``folder``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: list[dict[str, Any]] = []

    def frame(self) -> Any:
        """A ``pandas.DataFrame``, one row per run."""
        import pandas as pd

        return pd.DataFrame(self.rows)

    def runs(self) -> list[Run]:
        """The runs that have begun, in the order of the rows."""
        folders = [Path(row["folder"]) for row in self.rows]
        return [Run(folder) for folder in folders if (folder / RUN_FILE).exists()]

    def __str__(self) -> str:
        hidden = ("folder", "wall_s", "sim_s")
        names = [
            name
            for name in _columns_of(self.rows)
            if name not in hidden
            and not name.endswith(_COUNTS)
            and not all(isinstance(row.get(name), (list, dict, type(None))) for row in self.rows)
        ]
        text: str = tabulate(
            [[_cell(name, row.get(name)) for name in names] for row in self.rows],
            headers=[name.replace(": ", "\n").replace(" -> ", "\n-> ") for name in names],
            disable_numparse=True,
        )
        return text

    def __repr__(self) -> str:
        return f"<Sweep of {len(self.rows)} runs in {self.folder}>"


@takes(SweepOptions)
def sweep(project: Project | str | os.PathLike[str], options: SweepOptions) -> Sweep:
    """Run a project with every combination of values, seeds and repetitions.

    Runs that have finished in ``output`` are not repeated, so a sweep can be continued. A failed
    run is a row like the others. ``KeyboardInterrupt`` ends all runs; the table on the disk has
    the finished ones. Each job sends the row of its run: this process only reads run folders of
    earlier calls.

    ``set`` has a value or a list of values for each path of ``--set``. Runs have the other
    options of :meth:`~neuros.api.project.Project.run`. With ``points`` the rows are in their order.

    Raises:
        ProjectError: if the project is not valid with all values; nothing has been run then.
        UsageError: for arguments that make no sense, or if ``output`` holds another sweep, or one
            that goes on.
        EnvironmentFault: if the table cannot be written, or the back end cannot be loaded.
    """
    if not isinstance(project, Project):
        project = Project.from_file(project)
    values = _values(options.set)
    seeds = [int(seed) for seed in options.seeds]
    points = points_of(values, seeds, options.repeat)
    if options.points:
        points = [*_asked(options.points, values, seeds, options.repeat)]
    if options.jobs is not None and options.jobs < 1:
        raise UsageError(f"jobs {options.jobs}: give 1 or more")
    request = Request(**{name: getattr(options, name) for name in _OF_EACH_RUN})
    if (back_end := request.backend or AUTO) != AUTO:
        BACK_ENDS.load(back_end)  # raises here once, not in each run
    resources = _check_all(project, points, request)
    given = given_sources(options.restore)
    sources = find_sources(given, [node.name for node in project.described().nodes])
    restore = {
        f"{node}.{name}": str(file) for node in sources for name, file in sources[node].items()
    }
    request = replace(request, restore=restore)
    folder = _sweep_folder(project, options, restore)
    with _locked_folder(folder):
        return _Sweeping(project, points, folder, options, request).run(resources)


def _values(given: Mapping[str, Any] | Sequence[str] | None) -> dict[str, list[Any]]:
    """The values of each path, from Python or as texts of ``--set``."""
    if isinstance(given, Mapping):
        return {
            path: [each]
            if isinstance(each, (str, bytes, Mapping)) or not hasattr(each, "__iter__")
            else list(each)
            for path, each in given.items()
        }
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
                    **{key: getattr(request, key) for key in _OF_EACH_JOB},
                },
                folder / name,
                folder / _STOP_NAME,
            )
            for name, point in self._points.items()
        }

    def run(self, resources: JobResources) -> Sweep:
        folder, options = self._sweep.folder, self._options
        (folder / _STOP_NAME).unlink(missing_ok=True)
        waiting = [name for name in self._jobs if not self._has_finished(name)]
        try:
            if waiting:
                plan = SweepPlan(self._name, folder, options.jobs, resources, "neuros-analysis")
                with open_executor(options.executor, plan) as jobs:
                    self._execute(jobs, waiting)
        finally:
            self._save()
        return self._sweep

    def _execute(self, jobs: Jobs, waiting: Sequence[str]) -> None:
        """Submit the runs, and add a row as soon as a run has ended."""
        ended: SimpleQueue[Future[Any]] = SimpleQueue()
        futures: dict[Future[Any], str] = {}
        count = 0
        try:
            submitted = jobs.submit([self._jobs[name] for name in waiting])
            futures |= zip(submitted, waiting, strict=True)
            for future in futures:
                future.add_done_callback(ended.put)
            while count < len(futures):
                # Python handles a Ctrl+C that comes just before a wait only after it.
                with contextlib.suppress(Empty):
                    future = ended.get(timeout=_WAIT_S)
                    count += 1
                    name = futures[future]
                    if self._receive_row(name, future):
                        if time.monotonic() >= self._next_save_s:
                            self._save()
                        if self._options.on_row is not None:
                            total = len(self._points)
                            self._options.on_row(len(self._rows), total, self._rows[name])
        except BaseException:
            # Jobs on other machines watch for this file.
            (self._sweep.folder / _STOP_NAME).touch()
            jobs.cancel()
            wait(futures)
            for future, name in futures.items():
                self._receive_row(name, future)
            raise

    def _has_finished(self, name: str) -> bool:
        """Add the row of a run of an earlier call; set a run aside that must be repeated."""
        job = self._jobs[name]
        # Without a record the run may go on: its job handles that.
        if not (job.folder / RUN_FILE).exists():
            return False
        run = finished_run(job.folder)
        if run and (run.is_ok or not self._options.retry):
            self._rows[name] = row_of(job.values, run)
            return True
        set_aside(job.folder, "failed" if run else "unfinished")
        return False

    def _receive_row(self, name: str, future: Future[Any]) -> bool:
        """Add the row of a job; False if the job has none."""
        job = self._jobs[name]
        if future.cancelled():
            return False
        error = future.exception()
        row = future.result() if error is None else failed_row(job.values, error, job.folder)
        if row is not None:
            self._rows[name] = row
        return row is not None

    def _save(self) -> None:
        """Write the table atomically; the pause until the next writing grows with the duration."""
        started_s = time.monotonic()
        self._sweep.rows = [self._rows[name] for name in self._points if name in self._rows]
        try:
            text = io.StringIO(newline="")
            columns = _columns_of(self._sweep.rows)
            writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(self._sweep.rows)
            write_whole(self._sweep.folder / CSV_NAME, text.getvalue().encode())
        except OSError as error:
            file = self._sweep.folder / CSV_NAME
            raise EnvironmentFault(f"{file} cannot be written ({error.strerror})") from error
        now_s = time.monotonic()
        self._next_save_s = now_s + _PAUSE_PER_WRITING * (now_s - started_s)


def _check_all(project: Project, points: Sequence[Point], request: Request) -> JobResources:
    """Check the project with every point; returns resources that suffice for each run.

    Raises ``ProjectError`` with all problems.
    """
    problems: list[Problem] = []
    needs: set[JobResources] = set()
    for point in points:
        try:
            checked = project.described(StartOptions(set=point.settings, seed=point.seed))
            problems += time_problems(checked, checked.nodes, request.end)
            needs.add(JobResources.of(checked))
        except ProjectError as error:
            problems += error.problems
    if problems:
        raise ProjectError(problems)
    return JobResources.most(needs)


def _sweep_folder(project: Project, options: SweepOptions, restore: Mapping[str, str]) -> Path:
    """The folder of a new sweep, or of the one to continue. Raises ``UsageError``."""
    stamp = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H-%M-%SZ")
    folder = Path(options.output or Path("runs", project.name, f"sweep-{stamp}")).absolute()
    plan = {
        "project": str(project.file),
        "project_sha256": hashlib.sha256(project.text().encode()).hexdigest(),
        **{name: str(getattr(options, name)) for name in _OF_EACH_RUN},
        **({"restore": restore} if restore else {}),
    }
    file = folder / _PLAN_NAME
    try:
        if file.exists():
            before = read_object(file)
            for name in [*plan, "restore"]:
                if before.get(name) != plan.get(name):
                    is_text = name == "project_sha256"
                    what = "the project's files differ" if is_text else f"its {name} differs"
                    raise UsageError(
                        f"{folder} holds a sweep that is not this one ({what}): name another"
                        " folder with -o"
                    )
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
    """Lock the folder against other sweeps, which would take its runs for cut off.

    Raises ``UsageError``.
    """
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


def _columns_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    found = dict.fromkeys(name for row in rows for name in row)
    found.pop("folder", None)
    return [*found, "folder"]


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
        # A run has its own processes: a thread is enough for its launcher.
        return ThreadPoolExecutor(plan.count or 1, thread_name_prefix="neuros-sweep")


LOCAL = LocalExecutor()


class _PoolJobs:
    """The jobs of a pool of :mod:`concurrent.futures`."""

    def __init__(self, pool: Executor) -> None:
        self._pool = pool

    def submit(self, jobs: Sequence[Job]) -> list[Future[Any]]:
        return [self._pool.submit(job) for job in jobs]

    def cancel(self) -> None:
        """Jobs that begin now find the stop file, and return at once."""


@contextlib.contextmanager
def open_executor(wanted: str | Executor, plan: SweepPlan) -> Iterator[Jobs]:
    """The executor for ``NAME``, ``NAME=PLACE``, or a pool of the caller's own.

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
        seed: for all nodes with a seed; ``None``: as in the files.
        repeat: number of the repetition, from 1; ``None`` without repetitions.
    """

    settings: Mapping[str, Any]
    seed: int | None = None
    repeat: int | None = None

    def values(self, names: Mapping[str, str]) -> dict[str, Any]:
        """The values that identify the point; ``names``: columns by path."""
        found = {names[path]: value for path, value in self.settings.items()}
        found |= {} if self.seed is None else {"seed": self.seed}
        return found | ({} if self.repeat is None else {"repeat": self.repeat})

    def folder_name(self, names: Mapping[str, str]) -> str:
        """A readable folder name, different for each point."""
        settings = sorted((path, value_text(path, v)) for path, v in self.settings.items())
        identity = (settings, self.seed, self.repeat)
        digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:8]
        text = "_".join(f"{name}={value}" for name, value in self.values(names).items()) or "run"
        return f"{re.sub(r'[^A-Za-z0-9._=+-]', '-', text)[:_MOST_CHARACTERS]}-{digest}"


def points_of(
    values: Mapping[str, Sequence[Any]], seeds: Sequence[int], repeat: int
) -> list[Point]:
    """All points of the grid; the last path changes first.

    Raises:
        UsageError: a path has no value, or a value twice.
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


def _asked(
    asked: Sequence[Mapping[str, Any]],
    values: Mapping[str, Sequence[Any]],
    seeds: Sequence[int],
    repeat: int,
) -> Iterator[Point]:
    """The points that an optimiser asks for; one that it asks for again is a repetition."""
    paths = set(asked[0])
    known: list[Mapping[str, Any]] = []
    for number, settings in enumerate(asked, 1):
        if set(settings) != paths:
            raise UsageError(f"points: number {number} has other paths than the first one")
        before = known.count(settings) * repeat
        known.append(settings)
        for point in points_of({**values, **{k: [v] for k, v in settings.items()}}, seeds, repeat):
            again = (point.repeat or 1) + before
            yield replace(point, repeat=again) if before else point


def short_names(paths: Sequence[str]) -> dict[str, str]:
    """Column names of paths: the fewest last steps that tell them apart."""
    names = {}
    for path in paths:
        steps = path.split(".")
        count = 2 if steps[-1] in _TAKEN else 1
        while any(other != path and other.split(".")[-count:] == steps[-count:] for other in paths):
            count += 1
        names[path] = ".".join(steps[-count:])
    return names


def parse_values(text: str) -> tuple[str, list[Any]]:
    """Parse ``PATH=1,2,3``; commas within brackets and quotes do not separate.

    Raises:
        UsageError: the text does not have this form.
    """
    path, equals, listed = text.partition("=")
    if not (path and equals):
        raise UsageError(f"--set {text}: is not of the form PATH=VALUE,VALUE,...")
    is_text = path.split(".")[2:3] == ["environment"]
    values: list[Any] = []
    for part in _split(listed):
        try:
            values.append(part if is_text else json.loads(part))
        except ValueError:
            values.append(part)
    return path, values


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


# ---------------------------------------------------------------------- jobs
#
# A run of a sweep as a job for an executor, and the row that the job returns.


# Exit codes of runs that are not repeated: an interrupted one is, or one that could not write.
_FINISHED = (0, 1, 5)
SHARE = ": consumed / %"
_POLL_S = 0.25


@dataclass(frozen=True)
class SweepJob:
    """A run of a sweep; the executor calls the job.

    Several jobs of one run do no harm, as after the death of a sweep's front end, or where Dask
    assumes that a worker is lost: one job makes the run, and the others return its row.

    Attributes:
        values: the first columns of the row.
        arguments: of :meth:`Project.start`.
        folder: of the run.
        stop: a file; while it exists the run is ended, or does not begin.
    """

    project: Project
    values: Mapping[str, Any]
    arguments: Mapping[str, Any]
    folder: Path
    stop: Path

    def __call__(self) -> dict[str, Any] | None:
        """Make the run and return its row, ``None`` if the sweep was ended before."""
        try:
            with locked(self.folder.with_name(f".{self.folder.name}.lock")):
                if self.stop.exists():
                    return None
                if self.folder.exists():
                    if (run := finished_run(self.folder)) is not None:  # of another job
                        return row_of(self.values, run)
                    set_aside(self.folder)
                return self._make()
        except (NeurosError, OSError) as error:
            return failed_row(self.values, error, self.folder)

    def _make(self) -> dict[str, Any] | None:
        live: LiveRun | None = None
        try:
            live = self.project.start(**self.arguments, output=self.folder)
            run = None
            while run is None and not self.stop.exists():
                with contextlib.suppress(TimeoutError):
                    run = live.wait(_POLL_S)
            if run is None:
                live.interrupt()
                run = live.wait()
        except KeyboardInterrupt:  # a cluster needs its machine
            if live is None:
                raise
            live.end()
            run = Run(live.folder)
        is_cut_off = run.exit_code not in _FINISHED and self.stop.exists()
        return None if is_cut_off else row_of(self.values, run)


def finished_run(folder: Path) -> Run | None:
    """The run of a folder, ``None`` if the run was cut off."""
    try:
        run = Run(folder)
    except NeurosError:
        return None
    return run if run.exit_code in _FINISHED else None


def set_aside(folder: Path, why: str = "unfinished") -> None:
    """Rename the folder of a run that must be repeated."""
    number = 1
    while (aside := folder.with_name(f"{folder.name}.{why}-{number}")).exists():
        number += 1
    folder.rename(aside)


def row_of(values: Mapping[str, Any], run: Run) -> dict[str, Any]:
    """The row of a run: its values, then its results."""
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
