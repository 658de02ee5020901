"""Each command, with its paths in a folder that may not be entered: a sentence, no traceback.

Run folders are open to their user alone, so that those of another user are such folders.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from neuros.cli.main import COMMANDS, parser
from tests.support.ordinary_user import AS_ORDINARY_USER

EXAMPLE = Path(__file__).parents[2] / "examples/1_tick/clock"
KEPT = Path(__file__).parents[1] / "upgrades/kept/2.0.0/run"
# PROJECT and RUN may be read, CLOSED/ is the folder, and all that is named in it is there.
DENIED = """
2 launch CLOSED
2 launch CLOSED/clock
2 launch CLOSED/clock/project.json
2 launch --project CLOSED/clock
2 launch PROJECT --output CLOSED/new
3 launch PROJECT --deployment CLOSED/deployment.json
2 launch --dry-run CLOSED/clock
2 validate CLOSED
2 validate CLOSED/clock
2 validate --import CLOSED/clock
2 graph CLOSED
2 graph CLOSED/clock
2 graph PROJECT --output CLOSED/graph.svg
2 types CLOSED/clock
2 types PROJECT --output CLOSED/types
2 build --project CLOSED
2 build --project CLOSED/clock
2 new CLOSED/new
2 example clock CLOSED/new
2 logs CLOSED
2 logs CLOSED/run
2 sweep CLOSED/clock
2 sweep PROJECT --repeat 1 --duration 0.1 --output CLOSED/new
2 verify CLOSED/run RUN
2 verify RUN CLOSED/run
2 report CLOSED
2 report CLOSED/run
4 report RUN --output CLOSED/new
2 compare CLOSED/run RUN
4 compare RUN RUN --output CLOSED/new.csv
2 bag info CLOSED
2 bag info CLOSED/run
2 bag info CLOSED/run/bag
4 bag repair CLOSED/run
2 bag convert CLOSED/run --output NEW
4 fork CLOSED/run --at 1sim
4 replay CLOSED/run --node counter
2 replay CLOSED/run --topic *
2 export compose CLOSED/clock
2 export compose PROJECT --output CLOSED/new
2 export kubernetes PROJECT --output CLOSED/new
2 export slurm PROJECT --output CLOSED/new
2 convert CLOSED
2 convert CLOSED/robot.urdf
4 convert ROBOT --output CLOSED/robot.xml
3 doctor --no-delivery --deployment CLOSED/deployment.json
2 containers build CLOSED
2 containers build CLOSED/clock
2 containers build --wheelhouse CLOSED/wheels
2 containers build --ca-bundle CLOSED/new
2 benchmark --from CLOSED/new
2 reproduce headdirection --from CLOSED/run
2 reproduce headdirection --weights CLOSED/new --output CLOSED/new
2 node CLOSED/run/counter/node.json
2 part CLOSED/nodes.json counter
2 import-plugin counter CLOSED/clock --answer 1
2 replayed CLOSED/run/counter/node.json --run CLOSED/run
"""
# These look for a run, or an image, by its name.
UNKNOWN = """
2 stop CLOSED/run
2 topic list CLOSED/run
2 topic echo CLOSED/run x
2 topic hz CLOSED/run x
"""
# They are told no path, or ask an engine first, or are started with more than arguments.
PATHLESS = {
    *("ps", "agent", "containers list", "containers ls", "containers remove", "recorder"),
}
# Runs all commands one after another: each by itself would take half a second to begin.
PROGRAM = """
import json, os, sys, tempfile
from neuros.cli.main import main
said = []
for line in json.load(sys.stdin):
    with tempfile.TemporaryFile() as file:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(file.fileno(), stream.fileno())
        try:
            code = main(line)
        except SystemExit as error:
            code = error.code
        except BaseException as error:
            code, text = 1, f"Traceback: {error!r}"
            os.write(file.fileno(), text.encode())
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        file.seek(0)
        said.append((code, file.read().decode()))
open("said.json", "w").write(json.dumps(said))
"""


class Row(NamedTuple):
    code: int
    words: tuple[str, ...]


def rows(table: str) -> list[Row]:
    lines = [line.split() for line in table.strip().splitlines()]
    return [Row(int(code), tuple(words)) for code, *words in lines]


class Said(NamedTuple):
    code: int
    output: str


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("closed") / "closed"
    (folder / "wheels").mkdir(parents=True)
    for place in (folder, folder.parent):
        subprocess.run(["cp", "-r", EXAMPLE, KEPT, place], check=True)
        (place / "robot.urdf").write_text('<robot name="r"><link name="base"/></robot>')
        for name in ("deployment.json", "nodes.json"):
            (place / name).write_text("{}")
    folder.chmod(0)
    yield folder
    folder.chmod(0o700)


@pytest.fixture(scope="module")
def said(closed: Path) -> dict[tuple[str, ...], Said]:
    """What each command says to an ordinary user."""
    table = [row.words for row in rows(DENIED + UNKNOWN.lstrip("\n"))]
    names = {"PROJECT": "clock", "RUN": "run", "ROBOT": "robot.urdf"}
    lines = [
        [names.get(word, word).replace("CLOSED", str(closed)) for word in words] for words in table
    ]
    done = subprocess.run(
        [*AS_ORDINARY_USER, sys.executable, "-c", PROGRAM],
        cwd=closed.parent,
        input=json.dumps(lines),
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    assert done.returncode == 0
    answers = json.loads((closed.parent / "said.json").read_text())
    return {words: Said(*answer) for words, answer in zip(table, answers, strict=True)}


def test_the_folder_is_closed_to_an_ordinary_user(closed: Path) -> None:
    done = subprocess.run([*AS_ORDINARY_USER, "ls", closed / "run"], capture_output=True)
    assert b"Permission denied" in done.stderr


@pytest.mark.parametrize("row", rows(DENIED), ids=lambda row: " ".join(row.words))
def test_a_command_says_what_may_not_be_entered(
    said: dict[tuple[str, ...], Said], closed: Path, row: Row
) -> None:
    code, output = said[row.words]
    assert "Traceback" not in output
    assert code == row.code, output
    assert f"{closed.name}/" in output or str(closed) in output
    assert "Permission denied" in output


@pytest.mark.parametrize("row", rows(UNKNOWN), ids=lambda row: " ".join(row.words))
def test_a_command_that_looks_for_a_run_says_that_there_is_none(
    said: dict[tuple[str, ...], Said], row: Row
) -> None:
    code, output = said[row.words]
    assert (code, "you have no run called" in output) == (row.code, True), output


def test_the_reader_learns_whose_folder_it_is(
    said: dict[tuple[str, ...], Said], closed: Path
) -> None:
    assert said["report", "CLOSED/run"].output == (
        f"neuros: {closed}/run cannot be opened (Permission denied): you may not enter"
        f" {closed}, which belongs to {closed.owner()}\n"
    )


def commands_below(found: argparse.ArgumentParser, words: tuple[str, ...]) -> Iterator[str]:
    groups = [each for each in found._actions if isinstance(each, argparse._SubParsersAction)]
    if not groups:
        yield " ".join(words)
    for group in groups:
        for name, below in group.choices.items():
            yield from commands_below(below, (*words, name))


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_is_left_out(command: str) -> None:
    (group,) = [
        each for each in parser(command)._actions if isinstance(each, argparse._SubParsersAction)
    ]
    tried = {row.words for row in rows(DENIED) + rows(UNKNOWN)}
    for name in commands_below(group.choices[command], (command,)):
        words = tuple(name.split())
        is_tried = any(each[: len(words)] == words for each in tried)
        assert is_tried != (name in PATHLESS), name
