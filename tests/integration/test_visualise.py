"""`neuros.visualise`: figures of real drawing processes, with and without a display."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from deadlines import wait_until
from processes import is_alive
from virtual_display import virtual_display

pytest.importorskip("matplotlib")
from matplotlib.image import imread

import neuros.visualise as figure_files
from neuros.visualise import (
    VisualiseImages,
    VisualiseLines,
    VisualiseRing,
    VisualiseRotations,
    VisualiseSpikes,
)
from neuros.visualise.program import Series

DEADLINE_S = 30.0


@pytest.fixture(autouse=True)
def _in_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NEUROS_RUN_DIR", str(tmp_path))
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "NEUROS_GUI"):
        monkeypatch.delenv(name, raising=False)


def coloured(file: Path, colour: tuple[float, float, float]) -> Any:
    """Where a picture has a colour: ``(rows, columns)``, both from 0 to 1."""
    pixels = imread(file)[..., :3]
    rows, columns = np.nonzero(np.all(np.abs(pixels - colour) < 0.15, axis=2))
    return rows / pixels.shape[0], columns / pixels.shape[1]


def test_the_published_names_draw_angles_that_are_broken_where_they_wrap(tmp_path: Path) -> None:
    figure = VisualiseRotations("Head Direction", duration=60)
    figure.add_quaternion("truth", "lime")
    figure.add_degrees("network", "red")
    for step in range(400):
        angle = step * 0.05
        half = angle / 2
        q = SimpleNamespace(x=0.0, y=0.0, z=np.sin(half), w=np.cos(half))
        figure.plot("truth", q, step * 0.1)
        figure.plot("network", 90.0, step * 0.1)
    figure.close()
    assert figure.file == tmp_path / "head_direction.png"
    assert figure.dropped == 0
    rows, columns = coloured(figure.file, (1, 0, 0))
    inside = rows > 0.15  # not the legend
    assert np.ptp(rows[inside]) < 0.03, "a constant angle is one level line"
    assert np.ptp(columns[inside]) > 0.7
    rows, columns = coloured(figure.file, (0, 1, 0))
    for left in np.arange(0.2, 0.9, 0.02):  # a line down through the figure would fill a column
        slice_ = rows[(columns > left) & (columns < left + 0.004)]
        assert slice_.size == 0 or np.unique(slice_).size < 40


def test_every_kind_of_figure_is_saved_and_parts_may_share_one(tmp_path: Path) -> None:
    lines = VisualiseLines("all of them", 10, y_label="m")
    lines.add_line("height")
    images = VisualiseImages("images", below=lines)
    images.add_image("camera")
    spikes = VisualiseSpikes("spikes", 10, below=images)
    spikes.add_population("ring", 50, "magenta")
    ring = VisualiseRing("ring", 10, below=lines)
    ring.add_ring("left")
    red = np.zeros((480, 640, 3), np.uint8)
    red[...] = (255, 0, 0)
    for step in range(30):
        lines.plot("height", np.sin(step), step)
        images.plot("camera", red, step)
        spikes.plot("ring", [step, 49], step)
        ring.plot("left", np.exp(-((np.arange(50) - step) ** 2) / 20), step)
    lines.close()
    assert [file.name for file in tmp_path.iterdir()] == ["all_of_them.png"]
    red_rows, _ = coloured(lines.file, (1, 0, 0))
    pink_rows, _ = coloured(lines.file, (1, 0, 1))
    assert red_rows.size > 10_000, "the image"
    assert pink_rows.size > 20, "the spikes"
    assert red_rows.mean() < pink_rows.mean(), "below the image"


def test_where_time_goes_back_what_lay_after_is_dropped() -> None:
    series = Series(None)
    for time_s, value in ((0.0, "a"), (1.0, "b"), (2.0, "c"), (0.5, "d"), (1.5, "e")):
        series.add(time_s, value)
    assert (series.times, series.values) == ([0.0, 0.5, 1.5], ["a", "d", "e"])


def test_ros_images_are_shown_in_their_colours() -> None:
    data = np.zeros((4, 4, 3), np.uint8)
    data[...] = (255, 0, 0)  # blue, as OpenCV has it
    message = SimpleNamespace(encoding="bgr8", height=4, width=4, step=0, data=data.tobytes())
    figure = VisualiseImages("camera")
    figure.add_image("eye")
    figure.plot("eye", message)
    with pytest.raises(ValueError, match="encoding 32FC1 cannot be drawn"):
        figure.plot("eye", SimpleNamespace(encoding="32FC1"))
    message.height = 0
    with pytest.raises(ValueError, match="48 bytes are not an image of 4 x 0, 12 per row"):
        figure.plot("eye", message)
    with pytest.raises(ValueError, match="'ear' was not added to the figure; there are eye"):
        figure.plot("ear", message)
    figure.close()
    assert coloured(figure.file, (0, 0, 1))[0].size > 1000


def test_what_cannot_be_drawn_is_said_once_and_the_rest_of_the_figure_is_saved(capfd: Any) -> None:
    wrong = VisualiseLines("wrong", save_every=0.0)
    wrong.add_line("height", "infrared")
    right = VisualiseLines("right", below=wrong)
    right.add_line("height", "red")
    for step in range(10):
        wrong.plot("height", step, step)
        right.plot("height", step, step)
    right.plot("height", 0.0, float("nan"))  # at no time
    wrong.close()
    said = capfd.readouterr().err
    assert said.count("wrong: 'wrong' cannot be drawn: 'infrared' is not a valid") == 1
    assert "Traceback" not in said
    assert coloured(wrong.file, (1, 0, 0))[0].size > 100


def test_a_folder_that_is_gone_costs_the_file_and_not_the_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    monkeypatch.setenv("NEUROS_RUN_DIR", str(tmp_path / "gone"))
    figure = VisualiseLines("lost")
    figure.close()
    said = capfd.readouterr().err
    assert said.startswith(f"lost: {figure.file} cannot be saved: [Errno 2]")
    assert "Traceback" not in said


def test_figures_of_any_titles_have_files_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files: list[Path] = []
    drawn: list[SimpleNamespace] = []
    monkeypatch.setattr(figure_files, "_OPEN", drawn)
    for title in ("Größe", "大きさ", "left eye", "Left-Eye", "???", "!", "x" * 300):
        files.append(figure_files._file_for(title))
        drawn.append(SimpleNamespace(file=files[-1]))
    assert [file.parent for file in files] == [tmp_path] * len(files)
    assert [file.stem for file in files] == [
        "größe", "大きさ", "left_eye", "left_eye_2", "figure", "figure_2", "x" * 60
    ]  # fmt: skip


def test_a_line_that_was_not_added_is_said_whatever_it_is_fed_with() -> None:
    figure = VisualiseRotations("angles")
    figure.add_quaternion("truth")
    with pytest.raises(ValueError, match="'turth' was not added to the figure; there are truth"):
        figure.plot("turth", SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0), 0.0)
    figure.close()


def test_a_hook_never_waits_and_what_is_left_out_is_counted(capfd: Any) -> None:
    figure = VisualiseImages("camera")
    figure.add_image("eye")
    lines = VisualiseLines("speed", below=figure)
    lines.add_line("v")
    drawing = figure._feed._process.pid
    os.kill(drawing, signal.SIGSTOP)  # a drawing process that takes nothing at all
    image = np.random.default_rng(1).integers(0, 255, (320, 320, 3), np.uint8)
    for step in range(100):
        figure.plot("eye", image, step)
    while not lines.dropped > 200:
        lines.plot("v", 1.0, 0.0)
    dropped = figure.dropped
    os.kill(drawing, signal.SIGCONT)
    figure.close()
    assert f"{dropped} of " in capfd.readouterr().err
    assert figure.file.exists()


def test_a_node_shows_progress_until_its_figure_is_saved(tmp_path: Path) -> None:
    closers: list[Callable[[], None]] = []
    pid = 0

    def progress(text: str) -> None:
        assert text == ""  # the user is told by the launcher
        if not told:  # meanwhile nothing is drawn: the machine is busy
            os.kill(pid, signal.SIGCONT)
        told.append(time.monotonic())

    told: list[float] = []
    node = SimpleNamespace(on_close=closers.append, progress=progress)
    figure = VisualiseLines("speed", node=node)
    below = VisualiseLines("height", below=figure, node=node)
    below.add_line("z")
    below.plot("z", 1.0, 0.0)
    pid = figure._feed._process.pid
    os.kill(pid, signal.SIGSTOP)
    (close,) = closers  # one for the figure, whatever shares it
    assert not figure.file.exists()
    close()
    assert told
    assert figure.file == tmp_path / "speed.png"
    assert figure.file.exists()


def test_the_figure_is_saved_again_and_again_and_ends_with_its_node_killed_or_not(
    tmp_path: Path,
) -> None:
    program = """
import sys, time
from neuros.visualise import VisualiseLines
figure = VisualiseLines("speed", save_every=0.1)
figure.add_line("v")
print(figure._feed._process.pid, flush=True)
while True:
    figure.plot("v", time.monotonic(), time.monotonic())
    time.sleep(0.01)
"""
    node = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    with node:
        assert node.stdout is not None
        pid = int(node.stdout.readline())
        picture = tmp_path / "speed.png"
        wait_until(picture.exists)
        first = picture.stat().st_mtime_ns
        wait_until(lambda: picture.stat().st_mtime_ns > first)
        node.kill()
    wait_until(lambda: not is_alive(pid))
    assert picture.stat().st_size > 1000


@pytest.mark.needs("tkinter")
def test_with_a_display_there_is_a_window_that_may_be_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with virtual_display() as user:
        monkeypatch.setenv("DISPLAY", user.display)
        figure = VisualiseLines("speed of light")
        figure.add_line("c")
        figure.plot("c", 1.0, 0.0)
        user.close(user.find("speed of light"))
        figure.plot("c", 1.0, 1.0)
        figure.close()
    assert figure.file.exists()


def test_without_a_toolkit_or_a_display_the_figure_says_that_there_is_no_window(
    monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    monkeypatch.setenv("NEUROS_GUI", "1")
    VisualiseLines("speed").close()
    assert "NEUROS_GUI is set, but there is no display" in capfd.readouterr().err


def test_plotting_a_point_needs_no_matplotlib_in_the_node(tmp_path: Path) -> None:
    program = (
        "import sys; from neuros.visualise import VisualiseLines\n"
        "figure = VisualiseLines('v'); figure.add_line('v'); figure.plot('v', 1, 2)\n"
        "figure.close()\n"
        "assert 'matplotlib' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=DEADLINE_S)
    assert (tmp_path / "v.png").exists()
