"""What the gallery and the pages of the examples show is what the examples print."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
import shown_output
from launching import REPOSITORY, Finished, start
from plain_programs import plain_program
from shown_output import Entry

from neuros.backends.domain import choose_domain

QUICK = ("clock", "tennis", "voting", "elevator", "light")
BESIDE = {"rover": ("driver.py", "battery.py")}
LIMIT_S = 400.0  # the first start of some installs their libraries


def parameters() -> list[object]:
    return [
        pytest.param(each, id=each.name, marks=[] if each.name in QUICK else pytest.mark.acceptance)
        for each in shown_output.entries()
    ]


@pytest.mark.parametrize("entry", parameters())
def test_an_example_prints_what_is_shown(entry: Entry, tmp_path: Path) -> None:
    assert entry.lines
    assert entry.lines_of_page
    run = run_as_shown(entry, tmp_path)
    assert run.exit_code == 0, run.output
    assert not shown_output.missing(entry.lines, run), run.output
    assert not shown_output.missing(entry.lines_of_page, run), run.output
    assert not shown_output.miscounted(entry, run), run.output


def run_as_shown(entry: Entry, folder: Path) -> Finished:
    """The command of the gallery, with the programs beside it that the page tells to start."""
    project, *options = entry.command
    with choose_domain(None, {}, False) as domain, contextlib.ExitStack() as stack:
        command = (REPOSITORY / project, "-d", str(domain.id), *options)
        running = stack.enter_context(start(*command, cwd=folder, NEUROS_GUI="0"))
        for program in BESIDE.get(entry.name, ()):
            stack.enter_context(plain_program(entry.page.parent / program, domain.id))
        return running.finish(LIMIT_S)


def test_every_example_is_in_the_gallery() -> None:
    pages = {each.page for each in shown_output.entries()}
    assert pages == {
        file.parent / "README.md" for file in shown_output.EXAMPLES.glob("*/*/project.json")
    }


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("stroke 1", "stroke 2"),
        ("level 2 after 6.55 s", "level 2 after 9.55 s"),
        ("level 2 after 6.55 s", "level 3 after 6.55 s"),
        ("I run it 2.5.0", "I run it 2.6.0"),
        ("RMS 1.90 deg, ...", "maximum 1.90 deg, and more"),
        ("tea", "teas"),
    ],
)
def test_another_line_is_not_the_one_shown(shown: str, printed: str) -> None:
    assert not shown_output.is_same(shown, printed)


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("It is 23:13:36", "It is 09:00:01"),
        ("level 2 after 6.55 s", "level 2 after 6.60 s"),
        ("learnt 360 in 7.7 s: 0.447", "learnt 360 in 31.2 s: 0.447"),
        ("RMS 1.90 deg, ...", "RMS 1.94 deg, maximum 5.78 deg"),
    ],
)
def test_what_is_of_the_moment_may_differ(shown: str, printed: str) -> None:
    assert shown_output.is_same(shown, printed)
