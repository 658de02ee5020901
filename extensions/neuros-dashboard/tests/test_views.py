"""``--node-graph`` and ``--visualisations`` of real runs."""

from __future__ import annotations

import json
import os
from importlib.util import find_spec
from pathlib import Path

import pytest
import requests
from launching import launch, start
from neuros_dashboard.web import await_server

from neuros.distribution import install_command

WATCHED = Path(__file__).with_name("watched")
# A stand-in for a tool with a window: it tells how it was started, and stays.
TOOL = """\
#!/bin/sh
echo "$ROS_DOMAIN_ID $*" >"$NEUROS_TOLD/$(basename "$0").txt"
exec sleep 60
"""


@pytest.fixture
def tools(tmp_path: Path) -> Path:
    folder = tmp_path / "tools"
    folder.mkdir()
    for name in ("rqt_graph", "rviz2"):
        (folder / name).write_text(TOOL)
        (folder / name).chmod(0o755)
    return folder


def test_tools_of_ros_get_windows_on_the_run_and_end_with_it(tmp_path: Path, tools: Path) -> None:
    finished = launch(
        *(WATCHED, "-g", "-z", "--backend", "process", "--duration", "1"),
        cwd=tmp_path,
        DISPLAY=":99",
        PATH=f"{tools}:{os.environ['PATH']}",
        NEUROS_TOLD=str(tools),
    )
    assert finished.exit_code == 0
    assert finished.run_folder is not None
    domain = str(finished.record["domain_id"])
    configuration = finished.run_folder / "project.rviz"
    assert (tools / "rqt_graph.txt").read_text().split() == [domain]
    assert (tools / "rviz2.txt").read_text().split() == [domain, "-d", str(configuration)]
    displays = json.loads(configuration.read_text())["Visualization Manager"]["Displays"]
    assert "world.image" in [each["Name"] for each in displays]


def test_without_a_display_the_graph_is_in_the_dashboard(tmp_path: Path) -> None:
    finished = launch(WATCHED, "-g", "--duration", "0.5", cwd=tmp_path, DISPLAY="")
    assert finished.exit_code == 0
    assert "--node-graph: in the dashboard, since rqt_graph needs a display" in finished.output
    assert "dashboard: http://127.0.0.1:" in finished.output


@pytest.mark.skipif(find_spec("rerun") is not None, reason="Rerun is installed here")
def test_where_nothing_can_show_visualisations_nothing_starts(tmp_path: Path) -> None:
    finished = launch(WATCHED, "-z", cwd=tmp_path, DISPLAY="")
    assert finished.exit_code == 4
    assert "rviz2 needs a display, and Rerun is not installed" in finished.output
    assert install_command("rerun") in finished.output
    assert finished.run_folder is None


@pytest.mark.acceptance
@pytest.mark.skipif(find_spec("rerun") is None, reason="Rerun is not installed: --extras rerun")
def test_rerun_is_served_and_fed(tmp_path: Path) -> None:
    with start(WATCHED, "-z", cwd=tmp_path, DISPLAY="") as running:
        running.wait_for("visualisations: http")
        running.wait_for("brain", 30.0)
        (url,) = (
            line.rpartition(" ")[2]
            for line in running.output.splitlines()
            if "visualisations: http" in line
        )
        await_server(url)
        assert "Rerun" in requests.get(url, timeout=20).text
        running.signal(2)
        finished = running.finish()
    assert finished.run_folder is not None
    assert "ERROR" not in (finished.run_folder / "rerun.log").read_text()
