"""Tables, figures and the page of an experiment, made of the runs that it holds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.reproduce.experiment import Experiment
from benchmarks.reproduce.kinds import Kind, Reading, Readings
from benchmarks.reproduce.page import Page, Section, markdown_table
from benchmarks.reproduce.tables import write_runs
from benchmarks.results import write_whole
from neuros.errors import UsageError


def write_results(experiment: Experiment, kind: Kind) -> Path:
    """Write all of it into the folder of the experiment; returns ``index.md``.

    Raises:
        UsageError: if a run is no longer there, or the folder cannot be written to.
    """
    folder = experiment.folder
    readings = read_all(experiment, kind)
    try:
        tables, figures = folder / "tables", folder / "figures"
        for each in (tables, figures):
            each.mkdir(exist_ok=True)
        sections = kind.show(readings, figures) if readings else ()
        for section in sections:
            if section.table is not None:
                section.table.write_csv(tables)
                text = markdown_table(section.table) + "\n"
                (tables / f"{section.table.name}.md").write_text(text, "utf-8")
        write_runs(readings, tables / "runs.csv")
        page = Page(kind.title, [*_beginning(experiment, kind), *sections])
        write_whole(folder / "index.md", page.markdown(folder))
    except OSError as error:
        raise UsageError(f"{folder} cannot be written to ({error.strerror})") from error
    return folder / "index.md"


def read_all(experiment: Experiment, kind: Kind) -> Readings:
    """The runs that went well, by part. Raises ``UsageError`` for one that cannot be read."""
    found: dict[str, list[Reading]] = {}
    for entry in experiment.runs:
        if entry.failure:
            continue
        try:
            reading = kind.read(experiment.run_folder(entry), entry)
        except OSError as error:
            raise UsageError(
                f"{error.filename} cannot be read ({error.strerror}): it belongs to run"
                f" {entry.title} of {experiment.folder}"
            ) from error
        found.setdefault(entry.name, []).append(reading)
    return found


def _beginning(experiment: Experiment, kind: Kind) -> Sequence[Section]:
    """What was done, on what, and what did not work."""
    good = [entry for entry in experiment.runs if not entry.failure]
    machine = experiment.machine
    versions = ", ".join(f"{name} {version}" for name, version in experiment.versions.items())
    loads = [entry.load_before for entry in experiment.runs]
    about = (
        f"Begun {experiment.started}; {experiment.duration_s:g} s each; {len(good)}"
        f" run{'' if len(good) == 1 else 's'}, one after the other. Of several runs of the same"
        " kind tables show the median and the range."
    )
    on = f"{machine['cores']} cores of {machine['processor']}, {machine['system']}; {versions}."
    if loads:
        on += (
            f" In the second before a run others kept {min(loads):.0%} to {max(loads):.0%} of the"
            " cores busy."
        )
    sections = [
        Section("", [kind.introduction, kind.elsewhere, about]),
        Section("Measured on", [on]),
    ]
    failed = [entry for entry in experiment.runs if entry.failure]
    if failed:
        lines = [f"{entry.title}: {entry.failure.splitlines()[-1]}" for entry in failed]
        sections.append(Section("Runs that failed", lines))
    return sections
