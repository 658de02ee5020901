"""The dashboard of real runs: in a browser, click by click, and over plain HTTP."""

from __future__ import annotations

import json
import re
import signal
import socket
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import psutil
from browser import browser_page
from launching import Running, start
from neuros_dashboard.server import STATIC
from visitor import IMU, WATCHED, Visitor, address, is_full


def start_watched(tmp_path: Path, *arguments: str) -> Running:
    return start(WATCHED, "--dashboard", *arguments, cwd=tmp_path)


def server_of(running: Running) -> psutil.Process:
    children = psutil.Process(running.process.pid).children()
    (server,) = (child for child in children if "dashboard" in child.cmdline())
    return server


def sent(page: Any, name: str = IMU) -> int:
    return int(page.inner_text(f'#connections tr[data-name="{name}"] td:nth-child(3)'))


def wait_until(page: Any, condition: str, argument: Any = None) -> None:
    page.wait_for_function(condition, arg=argument)


COVERED_EDGES = """() => window.neuros.graph.cy.edges().filter((edge) => {
    const {x1, x2, y1, y2} = edge.boundingBox(
        {includeNodes: false, includeEdges: false, includeLabels: true});
    const {x, y} = edge.midpoint();
    return x1 <= x && x <= x2 && y1 <= y && y <= y2;
}).map((edge) => edge.id())"""
STATES = """() => Object.fromEntries(window.neuros.graph.cy.nodes().map(
    (node) => [node.data('name'), node.data('state')]))"""
MORE_THAN = """([name, count]) => Number(document.querySelector(
    `#connections tr[data-name="${name}"] td:nth-child(3)`).textContent) > count"""


def test_a_visitor_sees_and_steers_a_run_in_a_browser(tmp_path: Path) -> None:
    with start_watched(tmp_path) as running, browser_page() as page:
        page.goto(address(running))
        assert "token" not in page.url

        # The graph: states of nodes, counters of connections.
        wait_until(
            page,
            "() => ['world', 'brain'].every((name) => ['executing', 'waiting', 'blocked'].includes("
            "window.neuros?.graph.cy.getElementById(`node ${name}`).data('state')))",
        )
        label = page.evaluate(
            "(name) => window.neuros.graph.cy.getElementById(`connection ${name}`).data('label')",
            IMU,
        )
        assert label.startswith("imu: lossless\n")
        assert page.evaluate(COVERED_EDGES) == []
        wait_until(page, MORE_THAN, [IMU, 5])

        # The fields of a packet.
        page.click(f'#connections tr[data-name="{IMU}"]')
        page.wait_for_selector('#details tr[data-name="angular_velocity.z"]')
        page.set_viewport_size({"width": 1200, "height": 1100})
        hidden = "(panel) => panel.scrollWidth - panel.clientWidth"
        assert page.locator("#details").evaluate(hidden) == 0, "values are beyond the edge"
        drawn = page.inner_text('#details tr[data-name="header.frame_id"] td:nth-child(2)')
        assert drawn == "head"

        # An image: 640 x 480, shown as 320 x 240.
        wait_until(page, "() => document.querySelector('#images img').naturalWidth == 320")
        assert page.evaluate("() => document.querySelector('#images img').naturalHeight") == 240

        # The log and its filter; the load of each node.
        page.fill("#log-filter", "turning fast")
        wait_until(page, "() => document.querySelector('#log').childElementCount > 0")
        lines = page.inner_text("#log").splitlines()
        assert lines
        assert all("turning fast" in line for line in lines)
        page.wait_for_selector('#load tr[data-name="brain"]')

        # Pause, step, resume.
        page.click("#pause")
        page.wait_for_selector("#phase.paused")
        wait_until(
            page,
            "() => window.neuros.graph.cy.getElementById('node world').data('state') == 'paused'",
        )
        before = sent(page)
        page.fill("#count", "3")
        page.click("#step")
        wait_until(page, MORE_THAN, [IMU, before + 2])
        page.click("#step")
        wait_until(page, MORE_THAN, [IMU, before + 5])
        assert sent(page) == before + 6
        page.click("#resume")
        wait_until(page, MORE_THAN, [IMU, before + 20])

        # Stop: the run ends well, and the page says so.
        page.on("dialog", lambda dialog: dialog.accept())
        page.click("#stop")
        page.wait_for_selector("#phase.ended")
        assert "ended from the dashboard (exit code 0)" in page.inner_text("#phase")
        assert page.evaluate(STATES) == {"world": "ended", "brain": "ended"}
        rows = [row.split("\t") for row in page.inner_text("#connections tbody").splitlines()]
        cells = {row[0]: [row[2], *row[-2:]] for row in rows}  # sent, discarded, lost
        shares = page.inner_text('#nodes tr[data-name="world"] td:nth-child(3)')
        finished = running.finish()
    assert finished.exit_code == 0
    for name, shown in cells.items():
        connection = finished.connection(name)
        assert shown == [str(connection[key]) for key in ("sent", "discarded", "lost")]
    assert re.search(rf"^world +{shares.replace(' ', '')} ", finished.output, re.M)
    assert finished.connection(IMU)["lost"] == 0
    assert finished.record["nodes"]["world"]["accounting"]["paused"] > 0


PAIR = """
from neuros.hooks import neuros_function, neuros_tick

@neuros_tick(seconds=0.05, outputs="pair")
def beat(node):
    packet = node.make_packet("pair")
    packet.data = [1.0, 2.0]
    return packet

@neuros_function(inputs="camera")
def see(node, camera):
    pass
"""


def test_a_narrow_dark_page_is_usable_and_says_what_has_not_come_yet(tmp_path: Path) -> None:
    (tmp_path / "eye.py").write_text(PAIR)
    ends = [
        ("inputs", "camera", "sensor_msgs/msg/Image"),
        ("outputs", "pair", "std_msgs/msg/Float64MultiArray"),
    ]
    ports = {
        way: [{"name": name, "type": kind, "external_topic": name}] for way, name, kind in ends
    }
    node = {"name": "eye", "container": "neuros_python", "plugin": "eye.py", **ports}
    (tmp_path / "project.json").write_text(json.dumps({"nodes": [node]}))
    with start(tmp_path, "--dashboard", cwd=tmp_path) as running, browser_page(390, 844) as page:
        page.emulate_media(color_scheme="dark")
        page.goto(address(running))
        page.wait_for_selector('#nodes tr[data-name="eye"] .waiting')
        assert page.evaluate("() => document.documentElement.scrollWidth") == 390
        for button in ("#pause", "#step", "#stop", "#layout", "#theme"):
            box = page.locator(button).bounding_box()
            assert 0 <= box["x"] <= 390 - box["width"], button
        assert page.inner_text("#images .none") == "no picture yet"
        assert not page.is_visible("#images img")

        # Two numbers are read; they make no heat map, and no bump.
        page.click('#connections tr[data-name="eye.pair -> pair"]')
        page.wait_for_selector('#details tr[data-name="data[1]"]')
        assert not page.is_visible('button:text("heat map")')

        # What the launcher has said since the start, but for the address with its token.
        wait_until(page, "() => document.querySelector('#log').textContent.includes('run folder')")
        assert "token" not in page.inner_text("#log")
        assert re.search(r"wall clock \d+ s", page.inner_text("#times"))

        # Dark as the system has it, until the user wants it otherwise in this browser.
        colours = "() => getComputedStyle(document.body).backgroundColor"
        dark = page.evaluate(colours)
        page.click("#theme")
        light = page.evaluate(colours)
        assert sum(map(int, re.findall(r"\d+", light))) > sum(map(int, re.findall(r"\d+", dark)))
        page.reload()
        page.wait_for_selector("#phase.running")
        assert page.evaluate(colours) == light
        page.click("#theme")
        assert page.evaluate(colours) == dark
        assert Visitor(address(running)).post("/do/stop") == 204
        finished = running.finish()
    assert finished.exit_code == 0
    assert finished.run_folder is not None
    log = (finished.run_folder / "launcher.log").read_text()
    assert "run folder" in log
    assert "token" not in log


def test_nobody_gets_in_without_the_token_or_from_another_page(tmp_path: Path) -> None:
    with start_watched(tmp_path) as running:
        url = address(running)
        visitor = Visitor(url)
        netloc = urlsplit(url).netloc
        assert visitor.get("/") == 200
        assert visitor.get("/", "wrong") == 403
        assert visitor.get("/?token=wrong", "") == 403
        assert visitor.get("/static/main.js", "") == 403
        assert visitor.get("/events", "") == 403
        assert visitor.post("/do/stop", "") == 403
        assert visitor.post("/do/stop", Origin="http://example.org") == 403
        assert visitor.post("/do/stop", Origin=f"http://{netloc.replace(':', ':1')}") == 403
        assert visitor.get("/", Host="neuros.example.org") == 403
        assert visitor.get("/", Host=netloc.replace("127.0.0.1", "localhost")) == 200
        assert visitor.get_as_it_is("/static/vendor/../main.js") == 200
        for up in ("..", "%2e%2e", "..%2f..%2fneuros_dashboard", "vendor/../.."):
            assert (STATIC / unquote(up) / "server.py").is_file()
            assert visitor.get_as_it_is(f"/static/{up}/server.py") == 404, up
        assert visitor.get_as_it_is("/static//etc/passwd") == 404
        assert visitor.post("/do/something") == 404

        taken = str(urlsplit(url).port)
        with start(WATCHED, "--dashboard-port", taken, cwd=tmp_path) as second:
            refused = second.finish()
        assert refused.exit_code == 2
        assert f"--dashboard-port {taken}: this port cannot be used" in refused.output

        assert visitor.post("/do/stop", Origin=f"http://{netloc}") == 204
        assert running.finish().exit_code == 0


def test_a_page_is_told_of_every_node_of_one_process_and_of_the_end(tmp_path: Path) -> None:
    with start_watched(tmp_path, "--backend", "in-process") as running:
        visitor = Visitor(address(running))
        with visitor.events() as events:
            figures = next(data for name, data in events if name == "figures" and is_full(data))
            assert figures["nodes"].keys() == {"world", "brain"}
            assert visitor.post("/do/stop") == 204
            *_, (name, last) = events
        assert (name, last["phase"], last["exit_code"]) == ("phase", "ended", 0)
        finished = running.finish()
        assert finished.exit_code == 0
    assert finished.run_folder is not None
    assert (finished.run_folder / "dashboard.log").read_text() == ""


def test_a_paused_run_goes_on_when_its_dashboard_is_killed(tmp_path: Path) -> None:
    with start_watched(tmp_path, "--duration", "5") as running:
        visitor = Visitor(address(running))
        assert visitor.post("/do/pause") == 204
        with visitor.events() as events:
            assert next(data for name, data in events if name == "phase" and data["is_paused"])
        server_of(running).kill()
        finished = running.finish()
    assert finished.exit_code == 0
    assert finished.connection(IMU)["sent"] > 0


def test_the_server_loads_what_it_needs_when_somebody_looks(tmp_path: Path) -> None:
    with start_watched(tmp_path) as running:
        running.wait_for("turning fast")
        loaded = Path(f"/proc/{server_of(running).pid}/maps")
        assert "psutil" not in loaded.read_text()
        visitor = Visitor(address(running))
        assert visitor.get("/") == 200
        assert "psutil" in loaded.read_text()
        assert visitor.post("/do/stop") == 204
        assert running.finish().exit_code == 0


def test_a_run_that_nobody_looks_at_ends_with_its_server(tmp_path: Path) -> None:
    with start_watched(tmp_path) as running:
        running.wait_for("turning fast")
        server = server_of(running)
        running.signal(signal.SIGINT)
        finished = running.finish()
    assert finished.exit_code == 130
    assert not server.is_running()
    assert finished.run_folder is not None
    assert (finished.run_folder / "dashboard.log").read_text() == ""


def test_requests_that_are_none_do_not_fill_the_disk(tmp_path: Path) -> None:
    with start_watched(tmp_path) as running:
        place = urlsplit(address(running))
        for _ in range(25):
            with socket.create_connection((place.hostname, place.port), timeout=20) as asked:
                asked.sendall(b"this is no request\r\n\r\n")
                asked.recv(1)
        (log,) = tmp_path.glob("runs/*/*/dashboard.log")
        assert log.read_text() == ""
        assert Visitor(address(running)).get("/") == 200
