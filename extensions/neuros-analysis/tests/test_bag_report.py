"""``neuros report`` on a bag of another program."""

from __future__ import annotations

import re
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

import neuros.bag
from neuros.cli.main import main

STORE = get_typestore(Stores.ROS2_HUMBLE)
ARRAY, FLOAT = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/Float64"
SECOND_NS = 1_000_000_000


@pytest.fixture
def bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One topic of numbers at 2 Hz with a gap of 3 s, one of arrays, and one that was silent."""
    monkeypatch.chdir(tmp_path)
    kinds = STORE.types
    with Writer(tmp_path / "bag", version=8) as writer:
        number = writer.add_connection("/<b>height", FLOAT, typestore=STORE)
        row = writer.add_connection("/row", ARRAY, typestore=STORE)
        writer.add_connection("/silent", FLOAT, typestore=STORE)
        for half_seconds in (0, 1, 2, 8):
            data = STORE.serialize_cdr(kinds[FLOAT](1.0), FLOAT)
            writer.write(number, SECOND_NS + half_seconds * SECOND_NS // 2, data)
        layout = kinds["std_msgs/msg/MultiArrayLayout"]([], 0)
        for second in (1, 2, 3):
            data = STORE.serialize_cdr(kinds[ARRAY](layout, np.arange(3.0)), ARRAY)
            writer.write(row, second * SECOND_NS, data)
    return tmp_path / "bag"


def test_a_bag_gets_a_page_with_its_topics_and_when_their_packets_came(
    bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (file,) = bag.glob("*.db3")
    before = sorted(bag.iterdir())
    for path in (bag, file):
        assert main(["report", str(path)]) == 0
        out = capsys.readouterr().out
        rows = {cells[0]: cells[2:] for row in out.splitlines() if (cells := row.split())}
        assert rows["/<b>height"] == ["4", "0.75", "500", "3000", "12"]
        assert rows["/row"] == ["3", "1", "1000", "1000", "44"]
        assert rows["/silent"] == ["0"]
        page = Path(f"{path.name}_report/report.html").read_text("utf-8")
        assert "/&lt;b&gt;height" in page
        assert "<b>" not in page
        assert "4.00 s; 7 packets" in page
        assert len(re.findall(r'<img [^>]*src="data:image/png;base64,', page)) == 1
        panels = Path(f"{path.name}_report/panels.html").read_text("utf-8")
        assert '"output": "/row", "kind": "array"' in panels
    assert sorted(bag.iterdir()) == before, "nothing is written into the bag"


def test_a_topic_that_cannot_be_decoded_is_noted_and_the_others_are_shown(
    bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("UPDATE topics SET type = 'odd_msgs/msg/Odd' WHERE name LIKE '%height'")
    assert main(["report", str(file), "-o", "out"]) == 0
    out = capsys.readouterr().out
    assert "note: " in out
    assert "/<b>height cannot be decoded: the bag does not define" in out
    assert "/&lt;b&gt;height cannot be decoded" in Path("out/report.html").read_text("utf-8")


def test_a_file_that_is_no_bag_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.txt").write_text("notes")
    assert main(["report", str(tmp_path / "notes.txt")]) == 2
    assert "notes.txt is no bag" in capsys.readouterr().err


def test_a_type_by_its_short_name_has_arrays_frames_and_datasets(bag: Path) -> None:
    """As some programs write it: ``std_msgs/Float64``."""
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("UPDATE topics SET type = 'std_msgs/Float64' WHERE name LIKE '%height'")
    with neuros.bag.open(file) as opened:
        topic = opened["/<b>height"]
        assert topic.array()["data"].tolist() == [1.0] * 4
        assert topic.frame()["data"].tolist() == [1.0] * 4
        assert topic.xarray()["data"].values.tolist() == [1.0] * 4
