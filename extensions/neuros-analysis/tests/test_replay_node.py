"""``neuros replay RUN --node NAME`` on real runs: record, replay each node, change something."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import pytest
from launching import EXAMPLES, launch
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from replaying import MIXER, Recorded, assert_identical, copied, record, replay


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(tmp_path_factory.mktemp("recorded"), "process")


@pytest.fixture(scope="module")
def recorded_in_process(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record(tmp_path_factory.mktemp("recorded"), "in-process")


@pytest.fixture
def own(recorded: Recorded, tmp_path: Path) -> Recorded:
    """The same run, with a plugin and a bag that a test may change."""
    return copied(recorded, tmp_path)


@pytest.mark.parametrize("name", ["counter", "mixer"])
@pytest.mark.parametrize("back_end", ["recorded", "recorded_in_process"])
def test_every_node_does_and_sends_the_same_again(
    request: pytest.FixtureRequest, back_end: str, name: str
) -> None:
    recorded: Recorded = request.getfixturevalue(back_end)
    done = replay(recorded.run, name)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("identical: ")
    assert_identical(recorded, name, done.stdout)


def test_a_changed_plugin_is_told_by_packet_and_field(own: Recorded) -> None:
    plugin = own.project / "mixer.py"
    plugin.write_text(MIXER.replace("seen[0] % 1000", "seen[0] % 1000 + (seen[0] > 20)"))
    done = replay(own.run, "mixer")
    assert done.returncode == 1, done.stdout + done.stderr
    assert f"note: {plugin} was changed after the run had begun" in done.stdout
    found = re.search(
        r"different: mixer.mixed -> counter.back: packet (\d+) differs in data:"
        r" (\d+) in the run, (\d+) in the replay\n",
        done.stdout,
    )
    assert found is not None
    number, before, after = map(int, found.groups())
    assert after == before + 1
    assert number > 1


def test_a_plugin_that_fails_now_is_different(own: Recorded) -> None:
    (own.project / "mixer.py").write_text(MIXER.replace("seen[0] += ", "seen[1] += "))
    done = replay(own.run, "mixer")
    assert done.returncode == 1
    assert "different: it failed, but did not in the run: " in done.stdout
    assert "IndexError: list index out of range" in done.stdout


def test_under_pdb_it_stops_in_hooks_and_after_a_failure(own: Recorded) -> None:
    plugin = own.project / "mixer.py"
    plugin.write_text(MIXER.replace("seen[0] += ", "seen[1] += "))
    done = replay(
        own.run,
        "mixer",
        "--pdb",
        stdin="p 'fir' + 'st'\nc\np 'sec' + 'ond', number.data\nc\np 'aft' + 'er', seen\nq\n",
    )
    assert done.returncode == 1, done.stdout + done.stderr
    first, second, after = (
        done.stdout.index(text) for text in ("'first'", "('second', ", "('after', [0])")
    )
    assert first < second < after


def test_breakpoint_in_a_plugin_has_the_terminal(own: Recorded) -> None:
    (own.project / "mixer.py").write_text(
        MIXER.replace("    mixed = ", "    if seen[0] > 20:\n        breakpoint()\n    mixed = ", 1)
    )
    mine, theirs = pty.openpty()
    try:
        with subprocess.Popen(
            [sys.executable, "-m", "neuros.cli", "replay", str(own.run), "--node", "mixer"],
            stdin=theirs,
            stdout=theirs,
            stderr=subprocess.DEVNULL,
        ) as process:
            os.write(mine, b"p 40 + 2\nq\n")
            assert process.wait(60) == 130
        text = os.read(mine, 65536).decode()
    finally:
        os.close(mine)
        os.close(theirs)
    assert "\r\n42\r\n" in text
    assert "left after" in text
    assert "identical so far" in text


def test_the_run_folder_stays_as_it_is(recorded: Recorded, tmp_path: Path) -> None:
    before = sorted(recorded.run.rglob("*"))
    done = replay(recorded.run, "mixer", "-o", str(tmp_path / "kept"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert sorted(recorded.run.rglob("*")) == before
    assert (tmp_path / "kept/mixer/node.json").is_file()


def test_a_node_that_the_run_has_not(recorded: Recorded) -> None:
    done = replay(recorded.run, "nobody")
    assert done.returncode == 2
    assert f"{recorded.run} has no node 'nobody' (it has counter, mixer)" in done.stderr


def test_a_plugin_that_is_gone(own: Recorded) -> None:
    (own.project / "mixer.py").unlink()
    done = replay(own.run, "mixer")
    assert done.returncode == 2
    assert f"the plugin of 'mixer' is gone: {own.project / 'mixer.py'}" in done.stderr


def test_an_event_log_that_was_cut_off_is_replayed_as_far_as_it_goes(own: Recorded) -> None:
    event_log = own.run / "mixer/packets/event_log"
    event_log.write_bytes(event_log.read_bytes()[: event_log.stat().st_size // 2])
    done = replay(own.run, "mixer")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "what it sent later is not compared" in done.stdout


def in_small_chunks(bag: bytes) -> bytes:
    """The same bag as of a long run: with many chunks, each of some packets."""
    reader, written = make_reader(BytesIO(bag)), BytesIO()
    writer = Writer(written, chunk_size=1000, compression=CompressionType.NONE)
    writer.start("ros2", "test")
    channels: dict[int, int] = {}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        assert schema is not None
        if channel.id not in channels:
            kind = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, kind, channel.metadata
            )
        times = message.log_time, message.data, message.publish_time, message.sequence
        writer.add_message(channels[channel.id], *times)
    writer.finish()
    return written.getvalue()


def test_a_truncated_bag_is_replayed_as_far_as_it_goes(own: Recorded) -> None:
    (bag,) = (own.run / "bag").glob("*.mcap")
    whole = in_small_chunks(bag.read_bytes())
    bag.write_bytes(whole[: len(whole) // 2])
    done = replay(own.run, "mixer")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the others are not compared" in done.stdout
    assert "the replay ends there" in done.stdout
    assert re.search(r"identical: [1-9]\d* packets?", done.stdout)


def test_a_run_that_was_not_recorded(tmp_path: Path) -> None:
    finished = launch(EXAMPLES / "2_synchronisation/tennis", "--backend", "process", cwd=tmp_path)
    assert finished.run_folder is not None
    done = replay(finished.run_folder, "ann")
    assert done.returncode == 2
    assert "was not recorded" in done.stderr


def test_a_connection_that_was_left_out(tmp_path: Path) -> None:
    finished = launch(
        EXAMPLES / "2_synchronisation/tennis",
        *("--backend", "process", "-r", "--exclude", "bob.*"),
        cwd=tmp_path,
    )
    assert finished.run_folder is not None
    done = replay(finished.run_folder, "ann")
    assert done.returncode == 2
    assert "what 'ann' received on bob.ball_out -> ann.ball_in was not recorded" in done.stderr
    done = replay(finished.run_folder, "bob")
    assert done.returncode == 2
    assert "unknown: its packets were not recorded" in done.stdout
