"""Some hundreds of changed inputs; and every one that was ever answered wrongly."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from .mutation import changed, each_change_of_json
from .running import fault_of
from .targets import TARGETS

CORPUS = Path(__file__).parent / "corpus"


@pytest.mark.parametrize("name", TARGETS)
def test_an_ordinary_input_is_let_in(name: str) -> None:
    for data in TARGETS[name].seeds()[:20]:
        assert not fault_of(TARGETS[name], data)


@pytest.mark.parametrize("name", TARGETS)
def test_any_other_is_answered(name: str) -> None:
    target = TARGETS[name]
    seeds = target.seeds()

    @settings(max_examples=settings().max_examples // 10)
    @given(st.randoms(use_true_random=False))
    def check(chance: random.Random) -> None:
        data = changed(seeds, target.mutate, chance)
        assert not fault_of(target, data, measures_memory=True), data

    check()


@pytest.mark.acceptance
@pytest.mark.parametrize("name", [name for name, target in TARGETS.items() if target.is_json])
def test_every_value_of_json_in_turn_may_be_any_other(name: str) -> None:
    for seed in TARGETS[name].seeds():
        for data in each_change_of_json(seed):
            assert not fault_of(TARGETS[name], data), data


def test_each_value_of_json_is_changed_in_turn_and_only_one_at_a_time() -> None:
    changes = [*each_change_of_json(b'{"a": [1], "b": "x"}')]
    assert b'{"a": [null], "b": "x"}' in changes
    assert b'{"b": "x"}' in changes
    assert b'{"b": "x", "#": [1]}' in changes
    assert b'{"b": NaN, "a": [1]}' in changes
    assert b'{"a": null, "b": null}' not in changes


@pytest.mark.parametrize(
    "file", [pytest.param(file, id="/".join(file.parts[-2:])) for file in CORPUS.glob("*/*")]
)
def test_what_was_once_answered_wrongly_is_answered(file: Path) -> None:
    assert not fault_of(TARGETS[file.parent.name], file.read_bytes(), measures_memory=True)
