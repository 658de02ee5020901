"""What a plugin has found out in a run, on the disk."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from neuros.node.handle import Results


def results_in(folder: Path) -> object:
    return json.loads((folder / "results.json").read_text())


def test_each_result_is_on_the_disk_at_once_and_a_later_one_takes_its_place(tmp_path: Path) -> None:
    results = Results(tmp_path)
    results.set("rms_deg", 1.5)
    assert results_in(tmp_path) == {"rms_deg": 1.5}
    results.set("counts", np.arange(3))
    results.set("rms_deg", np.float32(0.5))
    assert results_in(tmp_path) == {"rms_deg": 0.5, "counts": [0, 1, 2]}
    assert [file.name for file in tmp_path.iterdir()] == ["results.json"]


@pytest.mark.parametrize("value", [math.nan, math.inf, np.float32("nan")])
def test_what_is_no_finite_number_is_nothing(tmp_path: Path, value: float) -> None:
    Results(tmp_path).set("gain", value)
    assert results_in(tmp_path) == {"gain": None}


@pytest.mark.parametrize("value", [object(), {1, 2}, [math.nan]])
def test_what_json_does_not_know_is_refused_and_changes_nothing(
    tmp_path: Path, value: object
) -> None:
    results = Results(tmp_path)
    results.set("kept", 1)
    with pytest.raises((TypeError, ValueError)):
        results.set("bad", value)
    results.set("more", 2)
    assert results_in(tmp_path) == {"kept": 1, "more": 2}
