"""What an agent and its launcher share: trees, the mirror, clocks, and the pump between them."""

from __future__ import annotations

import fcntl
import os
import time
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from deadlines import wait_until
from msgspec.structs import replace
from neuros_cluster.agent import Agent, remove_old_runs
from neuros_cluster.deployment_file import Host
from neuros_cluster.files import RECEIVED, RUNS, Follower, TreeStore, chunks_of, scan, write_chunk
from neuros_cluster.machine import ClockOffset, agent_command
from neuros_cluster.messages import (
    FROM_AGENT,
    TO_AGENT,
    Chunk,
    NodeEnded,
    Pong,
    Tree,
)
from neuros_cluster.pump import Pump

from neuros.backends.control_sockets import UnixListener, connect
from neuros.control import Hello, LiveCounters, Message, NodeStatus, PublishState, Report, Stop
from neuros.control.link import encode, to_bytes
from neuros.ports import ControlStream

_SOON_S = 30.0


def send(project: Path, store: TreeStore, path: str) -> None:
    for chunk in chunks_of(project / path, f"toy/{path}"):
        write_chunk(store.received, chunk)


class TestTrees:
    """Folders that another machine gets."""

    @pytest.fixture
    def project(self, tmp_path: Path) -> Path:
        folder = tmp_path / "toy"
        for name in ("plugin.py", "models/robot.xml", ".git/config", "__pycache__/x.pyc"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(name)
        (folder / "old_run").mkdir()
        (folder / "old_run/run.json").write_text("{}")
        (folder / "script.sh").write_text("true")
        (folder / "script.sh").chmod(0o755)
        return folder

    def give(self, project: Path, cache: Path) -> tuple[list[str], Path]:
        """The names of the files that had to be sent, and the folder that came of it."""
        tree, store = scan("toy", project), TreeStore(cache)
        lacking = store.lacking(tree)
        for path in lacking:
            send(project, store, path)
        folder = store.place(tree)
        store.clean_up()
        return sorted(Path(path).name for path in lacking), folder

    def test_it_has_the_files_without_hidden_folders_caches_and_runs(
        self, project: Path, tmp_path: Path
    ) -> None:
        sent, folder = self.give(project, tmp_path / "cache")
        assert sent == ["plugin.py", "robot.xml", "script.sh"]
        assert (folder / "models/robot.xml").read_text() == "models/robot.xml"
        assert os.access(folder / "script.sh", os.X_OK)
        assert not os.access(folder / "plugin.py", os.X_OK)

    def test_only_what_has_changed_is_sent(self, project: Path, tmp_path: Path) -> None:
        _, before = self.give(project, tmp_path / "cache")
        assert self.give(project, tmp_path / "cache") == ([], before)
        (project / "plugin.py").write_text("changed")
        sent, after = self.give(project, tmp_path / "cache")
        assert sent == ["plugin.py"]
        assert (before / "plugin.py").read_text() == "plugin.py"  # another run may use it
        assert (after / "plugin.py").read_text() == "changed"

    def test_content_that_changed_while_it_was_sent_is_not_used(
        self, project: Path, tmp_path: Path
    ) -> None:
        tree, store = scan("toy", project), TreeStore(tmp_path / "cache")
        (project / "plugin.py").write_text("another version")
        for path in tree.files:
            send(project, store, path)
        with pytest.raises(OSError, match=r"plugin\.py was changed while it was sent"):
            store.place(tree)

    def test_two_agents_with_one_process_id_share_a_cache(
        self, project: Path, tmp_path: Path
    ) -> None:
        """As on two nodes of a cluster, whose home folder is one."""
        tree, stores = scan("toy", project), [TreeStore(tmp_path / "cache") for _ in range(2)]
        for path in tree.files:
            for store in stores:
                send(project, store, path)
        stores[1].clean_up()
        assert (stores[0].place(tree) / "plugin.py").read_text() == "plugin.py"

    def test_what_was_changed_there_is_put_right(self, project: Path, tmp_path: Path) -> None:
        _, folder = self.give(project, tmp_path / "cache")
        (folder / "plugin.py").write_text("changed there")
        assert self.give(project, tmp_path / "cache") == (["plugin.py"], folder)
        assert (folder / "plugin.py").read_text() == "plugin.py"

    def test_what_has_come_to_it_there_is_removed(self, project: Path, tmp_path: Path) -> None:
        _, folder = self.give(project, tmp_path / "cache")
        (folder / "random.py").write_text("a module that hides one of Python's")
        (folder / "old/models").mkdir(parents=True)
        (folder / "old/models/robot.xml").write_text("stale")
        (folder / "__pycache__").mkdir()
        (folder / "__pycache__/plugin.pyc").write_text("of a run that uses it now")
        assert self.give(project, tmp_path / "cache") == ([], folder)
        assert not (folder / "random.py").exists()
        assert not (folder / "old").exists()
        assert (folder / "__pycache__/plugin.pyc").exists()

    def test_old_runs_are_removed_and_projects_of_such_a_name_are_not(
        self, project: Path, tmp_path: Path
    ) -> None:
        cache = tmp_path / "cache"
        trees = [TreeStore(cache).place(Tree(name, {})) for name in ("run-a", "received", "runs")]
        old = [cache / RUNS / "abcdefgh", cache / RECEIVED / "0123456789ab"]
        for folder in (*old, *trees):
            folder.mkdir(parents=True, exist_ok=True)
            os.utime(folder, (0, time.time() - 8 * 24 * 3600))
        remove_old_runs(cache)
        assert [folder.exists() for folder in (*old, *trees)] == [False, False, True, True, True]


class TestAgent:
    """What an agent sends of its nodes; the launcher takes nothing."""

    @pytest.fixture
    def agent(self, tmp_path: Path) -> Agent:
        agent = Agent.__new__(Agent)  # a new one takes standard input and output of this process
        for node in ("eye", "brain"):
            (tmp_path / node).mkdir()
            (tmp_path / node / "node.log").write_bytes(bytes(3 << 20))
        agent._follower = Follower(tmp_path, ["eye", "brain"], "robot", ())
        agent._processes = {"eye": Ended(None), "brain": Ended(None)}  # type: ignore[dict-item]
        agent._pump = Sent()  # type: ignore[assignment]
        agent._in_flight_bytes, agent._is_lost, agent._is_over = 0, False, False
        agent._monitor = None
        return agent

    def test_the_end_of_a_node_is_told_while_another_writes_more_than_is_taken(
        self, agent: Agent
    ) -> None:
        agent._processes["brain"] = Ended("exit code 0")  # type: ignore[assignment]
        assert agent._send_news()
        assert NodeEnded("brain", "exit code 0") in agent._pump.messages  # type: ignore[attr-defined]

    def test_nodes_take_turns(self, agent: Agent) -> None:
        agent._send_news()
        agent._in_flight_bytes = 0
        agent._send_news()
        chunks = [each for each in agent._pump.messages if each.data]  # type: ignore[attr-defined]
        assert list(dict.fromkeys(each.path for each in chunks)) == [
            "eye/node.log",
            "brain/node.log",
        ]

    def test_nothing_more_is_sent_to_a_launcher_that_has_gone(self, agent: Agent) -> None:
        agent._is_lost = True
        agent._finish()
        sent = agent._pump.messages  # type: ignore[attr-defined]
        assert sum(len(each.data) for each in sent) < 2 << 20
        assert not agent._is_over


class Ended:
    """A process that has ended so, or runs."""

    def __init__(self, how: str | None) -> None:
        self.how = how

    def poll(self) -> str | None:
        return self.how


class Sent:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self.send = self.send_last = self.messages.append


class TestMirror:
    """Files that nodes write elsewhere."""

    @pytest.fixture
    def there(self, tmp_path: Path) -> Path:
        (tmp_path / "there/eye/spool").mkdir(parents=True)
        return tmp_path / "there"

    def write(self, chunks: Iterator[Chunk], here: Path) -> list[str]:
        found = list(chunks)
        for chunk in found:
            write_chunk(here, chunk)
        return [chunk.path for chunk in found if chunk.data]

    def test_logs_and_recorded_packets_come_while_they_grow(
        self, there: Path, tmp_path: Path
    ) -> None:
        here, follower = tmp_path / "here", Follower(there, ["eye"], "robot", ())
        (there / "eye/node.log").write_text("one\n")
        (there / "eye/figure.png").write_text("later")
        assert self.write(follower.grown("eye"), here) == ["eye/node.log"]
        with open(there / "eye/node.log", "a") as log:
            log.write("two\n")
        (there / "eye/spool/00000000").write_bytes(bytes(200_000))
        sizes = [os.path.getsize(there / "eye" / n) for n in ("node.log", "spool/00000000")]
        self.write(follower.grown("eye"), here)
        assert (here / "eye/node.log").read_text() == "one\ntwo\n"
        assert os.path.getsize(here / "eye/spool/00000000") == sizes[1]
        assert self.write(follower.grown("eye"), here) == []

    def test_a_file_that_is_cut_off_is_cut_off_here(self, there: Path, tmp_path: Path) -> None:
        here, follower = tmp_path / "here", Follower(there, ["eye"], "robot", ())
        log = there / "eye/node.log"
        for text in ("one\ntwo\n", "one\n", "one\nand two\n"):
            log.write_text(text)
            self.write(follower.grown("eye"), here)
            assert (here / "eye/node.log").read_text() == text

    def test_in_the_end_everything_else_comes_and_what_was_given_does_not(
        self, there: Path, tmp_path: Path
    ) -> None:
        here = tmp_path / "here"
        (there / "eye/node.json").write_text("given")
        (there / "eye/sub").mkdir()
        (there / "eye/sub/figure.png").write_text("a figure")
        (there / "notes.txt").write_text("of no node")
        follower = Follower(there, ["eye"], "robot", ["eye/node.json"])
        self.write(follower.rest(), here)
        files = {path.relative_to(here).as_posix() for path in here.rglob("*") if path.is_file()}
        assert files == {"eye/sub/figure.png", "machines/robot/notes.txt"}

    def test_nothing_is_written_outside_of_the_run_folder(self, tmp_path: Path) -> None:
        with pytest.raises(OSError, match="outside of the folder run"):
            write_chunk(tmp_path / "run", Chunk("../elsewhere", 0, b""))

    @pytest.mark.parametrize("path", ["eye/\0", "\0/eye", "\ud800"])
    def test_what_is_no_path_is_refused(self, tmp_path: Path, path: str) -> None:
        with pytest.raises(OSError, match=r"null byte|can't encode"):
            write_chunk(tmp_path / "run", Chunk(path, 0, b""))

    def test_a_pipe_of_a_plugin_is_not_waited_for(self, there: Path, tmp_path: Path) -> None:
        os.mkfifo(there / "eye/pipe")
        chunks = Follower(there, ["eye"], "robot", ()).rest()
        assert self.write(chunks, tmp_path / "here") == []


class TestClock:
    """Times of a machine whose monotonic clock is 1000 s ahead."""

    @pytest.fixture
    def clock(self) -> ClockOffset:
        clock = ClockOffset()
        clock.add(Pong(5.0, 1005.0, 2e9 + 0.5), 5.0, 2e9)
        return clock

    def test_the_fastest_answer_tells_how_far_it_is_ahead(self) -> None:
        clock = ClockOffset()
        for late_s, ahead_s in ((0.5, 1000.2), (0.01, 1000.0), (0.25, 999.9)):
            sent_s, there_s = 50.0, 50.0 + late_s / 2 + ahead_s
            clock.add(Pong(sent_s, there_s, 2e9 - late_s / 2 - 3.0), sent_s + late_s, 2e9)
        assert clock.round_trip_s == pytest.approx(0.01)
        assert clock.monotonic_s == pytest.approx(1000.0)
        assert clock.unix_s == pytest.approx(-3.0)

    def test_a_clock_that_drifts_is_followed_and_so_are_times_in_packet_logs(
        self, tmp_path: Path
    ) -> None:
        """The clock there gains 50 us a second for an hour; the first answer is the fastest."""
        clock, drift = ClockOffset(), 5e-5

        def there_s(here_s: float) -> float:
            return 1000.0 + here_s * (1 + drift)

        for second in range(3600):
            half_s = 0.0001 if second == 0 else 0.001
            sent_s, now_s = second - half_s, second + half_s
            clock.add(Pong(sent_s, there_s(second), 2e9), now_s, 2e9)
        assert clock.monotonic_s == pytest.approx(1000.0 + 3600 * drift, abs=0.005)
        here = [0, 1000, 2000, 3000, 3599]
        log = array("q", [round(1e9 * there_s(each)) for each in here])
        (tmp_path / "0.sent_ns").write_bytes(log.tobytes())
        clock.log_here(tmp_path)
        moved = array("q", (tmp_path / "0.sent_ns").read_bytes())
        assert [1e-9 * each for each in moved] == pytest.approx(here, abs=0.005)

    def test_nothing_elsewhere_is_moved_through_a_link(
        self, clock: ClockOffset, tmp_path: Path
    ) -> None:
        (tmp_path / "elsewhere").write_bytes(array("q", [5]).tobytes())
        (tmp_path / "packets").mkdir()
        (tmp_path / "packets/0.sent_ns").symlink_to(tmp_path / "elsewhere")
        clock.log_here(tmp_path / "packets")
        assert array("q", (tmp_path / "elsewhere").read_bytes()) == array("q", [5])

    def test_processes_of_one_machine_have_one_clock(self) -> None:
        clock = ClockOffset()
        clock.add(Pong(50.0, 50.06, 2e9), 50.1, 2e9)
        assert clock.monotonic_s == 0.0

    def test_what_nodes_report_is_on_the_clock_of_this_machine(self, clock: ClockOffset) -> None:
        report = Report(node="eye", running_since_s=1005.0, timeline=((1.0, 1006.0),))
        here = replace(report, running_since_s=5.0, timeline=((1.0, 6.0),))
        metrics: Any = {"state": {"state": "idle", "cause": ""}, "executing": None}
        metrics |= {"outgoing": {}, "incoming": {}, "hooks": {}, "accounting": {}}
        counters = LiveCounters(1007.0, metrics, {"c": (1, (10**12,))}, {"c": (1, 10**12 + 1)})  # type: ignore[arg-type]
        status = NodeStatus("eye", 1, None, counters, {"x": {"values": [[1008.0, 3.5]]}})
        moved = LiveCounters(7.0, metrics, {"c": (1, (0,))}, {"c": (1, 1)})  # type: ignore[arg-type]
        status_here = NodeStatus("eye", 1, None, moved, {"x": {"values": [[8.0, 3.5]]}})
        hello = Hello(("eye",))
        for there, expected in ((report, here), (status, status_here), (hello, hello)):
            assert clock.data_here(to_bytes(there)) == to_bytes(expected)
        assert clock.data_here(b"what is no message") == b"what is no message"

    def test_so_are_the_times_in_packet_logs(self, clock: ClockOffset, tmp_path: Path) -> None:
        second_ns = 10**9
        files = {
            "0.sent_ns": ([1001 * second_ns, 1002 * second_ns], [second_ns, 2 * second_ns]),
            "0.taken": ([1, 2], [1, 2]),
            "executions": (
                [0, 1003 * second_ns, 1004 * second_ns],
                [0, 3 * second_ns, 4 * second_ns],
            ),
            "credits": ([0, 5, 1005 * second_ns], [0, 5, 5 * second_ns]),
            "pauses": ([1006 * second_ns, 1007 * second_ns], [6 * second_ns, 7 * second_ns]),
        }
        for name, (there, _) in files.items():
            (tmp_path / name).write_bytes(array("q", there).tobytes())
        clock.log_here(tmp_path)
        for name, (_, here) in files.items():
            assert array("q", (tmp_path / name).read_bytes()) == array("q", here), name


class TestPump:
    """Two ends in one process."""

    @pytest.fixture
    def ends(self, tmp_path: Path) -> Iterator[Ends]:
        ends = Ends(tmp_path)
        yield ends
        ends.close()

    def test_control_connections_pass_through_in_order(self, ends: Ends) -> None:
        node = connect(ends.listener.address)
        hello, stop = encode(Hello(("eye",))), encode(Stop())
        node.sendall(hello)
        supervisor = ends.accepted()
        assert supervisor.recv(100) == hello
        supervisor.sendall(stop)
        assert node.recv(100) == stop
        words = encode(PublishState("last words")) * 4_000  # more than is read at once
        node.sendall(words)
        node.close()
        end = NodeEnded("eye", "exit code 0")
        ends.agent.send_last(end)
        wait_until(lambda: end in ends.to_launcher)
        supervisor.setblocking(False)  # what it has said before is there when its end is known
        assert b"".join(iter(lambda: supervisor.recv(1 << 16), b"")) == words
        supervisor.close()

    def test_all_that_was_said_by_then_comes_before_it_is_told_to_be_there(
        self, tmp_path: Path
    ) -> None:
        """Of a node, too, that the agent has not let in before it was asked."""
        ends = Ends(tmp_path, is_listening=False)
        node = connect(ends.listener.address)
        hello = encode(Hello(("eye",)))
        node.sendall(hello)
        end = NodeEnded("eye", "exit code 0")
        ends.agent._listener = ends.listener
        ends.agent.send_last(end)
        wait_until(lambda: end in ends.to_launcher)
        supervisor = ends.supervisor.accept()
        assert supervisor is not None
        supervisor.setblocking(False)
        assert supervisor.recv(100) == hello
        node.close()
        supervisor.close()
        ends.close()

    def test_who_hangs_up_is_missed_at_once(self, ends: Ends) -> None:
        ends.agent.end()
        wait_until(lambda: ends.lost)
        assert ends.lost == ["the connection was closed"]

    def test_all_that_was_said_is_heard_though_its_end_is_noticed_by_writing(self) -> None:
        (from_there, to_here), (taken, to_there) = os.pipe(), os.pipe()
        fcntl.fcntl(to_here, fcntl.F_SETPIPE_SZ, 1 << 20)
        said = [NodeEnded(f"eye{number}", "x" * 1000) for number in range(200)]
        os.write(to_here, b"".join(map(encode, said)))  # more than is read at once
        os.close(to_here)
        os.close(taken)
        heard: list[Message] = []
        lost: list[str] = []
        pump = Pump(from_there, to_there, FROM_AGENT, "robot", heard.append, lost.append)
        pump.start()
        pump.join(_SOON_S)
        assert heard == said
        assert lost == ["the connection was closed"]

    def test_who_is_silent_is_missed_after_its_time(self) -> None:
        (from_there, held), (taken, to_there) = os.pipe(), os.pipe()  # and nobody writes
        lost: list[str] = []
        pump = Pump(from_there, to_there, FROM_AGENT, "robot", id, lost.append)
        pump.timeout_s = 0.2
        pump.start()
        pump.join(_SOON_S)
        os.close(held)
        os.close(taken)
        assert lost == ["nothing was heard of robot for 0.2 s"]


class Ends:
    """A launcher's pump and an agent's, joined by pipes."""

    def __init__(self, folder: Path, *, is_listening: bool = True) -> None:
        (from_agent, to_launcher), (from_launcher, to_agent) = os.pipe(), os.pipe()
        self.to_launcher: list[Message] = []
        self.lost: list[str] = []
        self.supervisor, self.listener = (UnixListener(folder / name) for name in ("run", "there"))
        for name, listener in (("run", self.supervisor), ("there", self.listener)):
            (folder / name).mkdir()
            listener.open()
        self.launcher = Pump(
            *(from_agent, to_agent, FROM_AGENT, "robot"),
            self.to_launcher.append,
            self.lost.append,
            connect=lambda: connect(self.supervisor.address),
        )
        self.agent = Pump(from_launcher, to_launcher, TO_AGENT, "the launcher", id, id)
        if is_listening:
            self.agent.listen(self.listener)
        self.launcher.start()
        self.agent.start()

    def accepted(self) -> ControlStream:
        """The control connection that has come through."""
        found: list[ControlStream] = []
        wait_until(lambda: found.extend(filter(None, [self.supervisor.accept()])) or found)
        found[0].setblocking(True)
        return found[0]

    def close(self) -> None:
        for pump in (self.launcher, self.agent):
            pump.end()
            pump.join(_SOON_S)
        self.supervisor.close()
        self.listener.close()


class TestCommand:
    """How an agent is started."""

    def test_by_ssh_which_must_not_ask(self) -> None:
        host = Host("robot", "pi@robot", ssh_options=("-p", "2222"), neuros="~/my robot/neuros")
        command = agent_command(host)
        assert command[0] == "ssh"
        assert "BatchMode=yes" in command
        assert command[-5:] == ["-p", "2222", "--", "pi@robot", "exec ~/'my robot/neuros' agent"]

    def test_through_another_command(self) -> None:
        host = Host("node7", through=("srun", "--nodelist=node7"), neuros="/opt/neuros")
        assert agent_command(host) == ["srun", "--nodelist=node7", "/opt/neuros", "agent"]
