"""``neuros report`` and ``neuros compare`` on the command line."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import pytest
from run_folders import accounting, run_folder

from neuros.cli.main import main

WIRES = {"a.out -> b.in": 0, "b.out -> a.in": None}
FIGURES = {"graph", "time_shares", "swim_lanes", "packets", "latency"}
LOAD = """\
time_s,unix_time_s,core0_percent,memory_used_bytes,a.cpu_percent,a.memory_bytes,a.threads
1.0,1700000001,50.0,1000000,40.0,500000,3
2.0,1700000002,60.0,1000000,,,
3.0,1700000003,
"""
PNG = b"\x89PNG\r\n"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Two nodes in a loop; the name of the project could be read as HTML."""
    nodes = {
        "a": accounting(executing={"send": 2.0}, blocked={"a.out -> b.in": 8.0}),
        "b": accounting(executing={"use": 9.0}, waiting={"in": 1.0}),
    }
    return run_folder(tmp_path / "run", WIRES, nodes, project="<b>&made")


def test_a_page_and_its_figures_are_written(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(run)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("b.use limits the speed: it executes 90% of the time")
    assert "missing: processor and memory: the run was made without -m" in out
    files = {path.stem: path.read_bytes() for path in (run / "report").glob("*.png")}
    assert {*files} == FIGURES
    assert all(data.startswith(PNG) for data in files.values())


def test_the_page_needs_no_other_file_and_shows_names_as_they_are(run: Path) -> None:
    main(["report", str(run)])
    page = (run / "report/report.html").read_text("utf-8")
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(sources) == len(FIGURES)
    pictures = [base64.b64decode(s.removeprefix("data:image/png;base64,")) for s in sources]
    assert all(picture.startswith(PNG) for picture in pictures)
    assert "&lt;b&gt;&amp;made" in page
    assert "<b>" not in page
    assert page.index("b.use limits the speed") < page.index("<img")


def test_load_timeline_and_ticks_are_drawn_where_they_were_kept(tmp_path: Path) -> None:
    ticks = {
        "period_ms": 10.0,
        "std_ms": 0.1,
        "within": {"1 ms": 1.0},
        "histogram": [[9.9, 3], [10.0, 5]],
    }
    hooks = {"f": {"executions": 8, "ticks": ticks}}
    run = run_folder(
        tmp_path / "run", {}, {"a": accounting(executing={"f": 1.0}, idle=9.0)},
        timeline={"a": [[0.0, 0.0], [1.0, 0.5], [2.0, 0.9]]},
        nodes={"a": {"accounting": accounting(idle=9.0), "hooks": hooks}},
    )  # fmt: skip
    (run / "system_load.csv").write_text(LOAD)
    assert main(["report", str(run), "-o", str(tmp_path / "out")]) == 0
    names = {path.stem for path in (tmp_path / "out").glob("*.png")}
    assert {"real_time", "ticks", "system_load"} <= names


def test_a_load_with_a_time_without_bounds_is_drawn_without_it(run: Path) -> None:
    (run / "system_load.csv").write_text(f"{LOAD}\n1e308,1,2,3,4,5,6\n")
    assert main(["report", str(run)]) == 0
    assert (run / "report/system_load.png").exists()


@pytest.mark.parametrize(
    ("load", "has_figure"),
    [
        (f"{LOAD}{'9' * 200_000}\n", True),
        ("time_s,time_s\n1,2\n", False),
        ("time_s,a.cpu_percent\n1,2\n", False),
    ],
    ids=["long field", "column twice", "half of a node"],
)
def test_of_a_damaged_load_what_can_be_read_is_shown(
    run: Path, capsys: pytest.CaptureFixture[str], load: str, has_figure: bool
) -> None:
    (run / "system_load.csv").write_text(load)
    assert main(["report", str(run)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"missing: the \w+ (of|in) .*system_load\.csv: the file is damaged", said)
    assert (run / "report/system_load.png").exists() == has_figure


def test_a_run_without_anything_is_no_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "project.json").write_text('{"nodes": [{"name": "a"}], "connections": []}')
    assert main(["report", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("The bottleneck is not known")
    assert "missing: run.json" in out


def test_what_is_no_run_is_a_wrong_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    assert main(["compare", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("not the folder of a run") == 2


def test_a_page_that_cannot_be_written_is_a_fault_of_the_machine(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / "report").touch()
    assert main(["report", str(run)]) == 4
    assert "name another place with -o" in capsys.readouterr().err


def test_a_run_folder_cannot_have_the_report_written_elsewhere(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "report.html").write_text("mine")
    (run / "report").symlink_to(elsewhere)
    assert main(["report", str(run)]) == 4
    assert "report is a link to another place: name a place with -o" in capsys.readouterr().err
    (run / "report").unlink()
    (run / "report").mkdir()
    (run / "report/report.html").symlink_to(elsewhere / "report.html")
    assert main(["report", str(run)]) == 0
    assert [file.read_text() for file in elsewhere.iterdir()] == ["mine"]
    assert not (run / "report/report.html").is_symlink()


def test_a_link_that_the_user_names_is_followed(run: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    assert main(["report", str(run), "-o", str(tmp_path / "link")]) == 0
    assert (tmp_path / "elsewhere/report.html").is_file()


def test_two_runs_are_shown_side_by_side_with_their_ratio(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nodes = {"a": accounting(executing={"send": 4.0}), "c": accounting(idle=10.0)}
    faster = run_folder(tmp_path / "faster", {"a.out -> b.in": 0}, nodes, wall_s=6.0)
    assert main(["compare", str(run), str(faster), "-o", str(tmp_path / "out.html")]) == 0
    rows = {
        cells[0]: cells[1:]
        for line in capsys.readouterr().out.splitlines()
        if len(cells := re.split(r"  +", line.strip())) > 2
    }
    assert rows["wall time / s"] == ["12.00", "6.00", "0.50"]
    assert rows["a: executing / %"] == ["20.0", "100.0", "5.00"]
    assert rows["b.out -> a.in: sent"] == ["50", "-", "-"]
    page = (tmp_path / "out.html").read_text("utf-8")
    assert "The bottleneck of faster" in page
    assert page.count("<img") == 1


def test_more_than_two_runs_have_no_ratio(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", str(run), str(run), str(run)]) == 0
    out = capsys.readouterr().out
    assert "ratio" not in out
    assert "1: " in out


def test_runs_without_figures_are_compared_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"format": 2}')
    page = tmp_path / "out.html"
    assert main(["compare", str(tmp_path), str(tmp_path), "-o", str(page)]) == 0
    assert "<img" not in page.read_text("utf-8")


def test_what_a_killed_sweep_has_left_is_named_and_the_rest_is_compared(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begun, torn, cut_off = (tmp_path / name for name in ("begun", "torn", "cut_off"))
    for folder in (begun, torn, cut_off):
        folder.mkdir()
    (torn / "run.json").write_text('{"format": 2, "conn')
    (cut_off / "project.json").write_text('{"nodes": [{"name": "a"}], "connections": []}')
    assert main(["compare", *map(str, (begun, run, torn, cut_off))]) == 2
    shown = capsys.readouterr()
    assert re.search(r"^ +run +cut_off +ratio$", shown.out, re.MULTILINE)
    assert "wall time / s" in shown.out
    assert "missing in cut_off: run.json: the run goes on, or its launcher was killed" in shown.out
    first, second = shown.err.splitlines()
    assert first.startswith(f"neuros: left out: {begun} has no run.json")
    assert second.startswith(f"neuros: left out: {torn / 'run.json'} is broken")
