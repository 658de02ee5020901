"""Many worlds behind one hook: each bit for bit what it is alone, whatever the threads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_node import SimulatedNode
from test_mujoco_arrays import HOPPER

from neuros.errors import ModelError
from neuros.simulators.mujoco import MuJoCoWorlds

COPIES, ROUNDS, STEPS = 6, 200, 5
FIELDS = ("qpos", "qvel", "act", "ctrl", "time")


def worlds(copies: int = COPIES, **more: Any) -> MuJoCoWorlds:
    return MuJoCoWorlds(SimulatedNode(copies=copies), HOPPER, **more)


def actions(copies: int = COPIES, rounds: int = ROUNDS) -> Any:
    return np.random.default_rng(1).uniform(-1, 1, (rounds, copies, 2))


class Bare:
    """One world of MuJoCo without NeuROS."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(HOPPER)
        self.data = mujoco.MjData(self.model)

    def step(self, action: Any, count: int = STEPS) -> Any:
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, count)
        return self.state()

    def state(self) -> Any:
        d = self.data
        return np.concatenate([d.qpos, d.qvel, d.act, d.ctrl, [d.time]])


def scatter(data: Any, generator: np.random.Generator) -> None:
    data.qpos[1] += generator.uniform(0, 1)


# ---------------------------------------------------------------------- the physics


@pytest.mark.parametrize("threads", [None, 1, 3])
def test_each_copy_is_bit_for_bit_that_of_mj_step(threads: int | None) -> None:
    many, alone = worlds(threads=threads), [Bare() for _ in range(COPIES)]
    for round_ in actions():
        many.step(round_, STEPS)
        expected = [bare.step(action) for bare, action in zip(alone, round_, strict=True)]
        assert np.array_equal(many.read(*FIELDS), expected)
    assert len({*many.read("qpos[0:1]").ravel()}) == COPIES  # they differ from each other
    contacts = [data.ncon for data in many.data]
    assert any(contacts)  # so that the solver has had something to solve
    warm = [bare.data.qacc_warmstart for bare in alone]
    assert np.array_equal([data.qacc_warmstart for data in many.data], warm)
    many.close()


def test_readings_of_the_present_state_do_not_change_the_physics() -> None:
    many, alone = worlds(), [Bare() for _ in range(COPIES)]
    for round_ in actions(rounds=50):
        many.step(round_, STEPS)
        seen = many.read("sensordata", "xpos", "cfrc_ext", "qpos")
        for bare, action, row in zip(alone, round_, seen, strict=True):
            state = bare.step(action)
            there = Bare()
            there.data = bare.data.__copy__()
            mujoco.mj_forward(there.model, there.data)
            mujoco.mj_rnePostConstraint(there.model, there.data)
            d = there.data
            parts = [d.sensordata, d.xpos.ravel(), d.cfrc_ext.ravel(), state[:3]]
            assert np.array_equal(row, np.concatenate(parts))


@given(
    copies=st.integers(1, 20),
    threads=st.integers(1, 4),
    masks=st.lists(st.integers(0, 2**20 - 1), min_size=1, max_size=8),
    count=st.integers(1, 3),
)
@settings(max_examples=20)
def test_copies_begin_anew_by_a_mask_and_the_others_go_on(
    copies: int, threads: int, masks: list[int], count: int
) -> None:
    many, alone = worlds(copies, threads=threads), [Bare() for _ in range(copies)]
    for mask, round_ in zip(masks, actions(copies, len(masks)), strict=True):
        anew = np.array([bool(mask >> index & 1) for index in range(copies)])
        many.step(round_, count, reset=anew)
        for index, bare in enumerate(alone):
            if anew[index]:
                mujoco.mj_resetData(bare.model, bare.data)
            else:
                bare.step(round_[index], count)
        assert np.array_equal(many.read("qpos"), [bare.data.qpos for bare in alone])
        assert np.array_equal(many.read("time").ravel(), [bare.data.time for bare in alone])
    assert many.sim_time == pytest.approx(count * len(masks) * 0.004)
    many.close()


# ---------------------------------------------------------------------- beginnings


def test_a_copy_begins_by_its_own_generator_and_a_reset_of_all_repeats_it() -> None:
    many = worlds(begin=scatter)
    generators = [np.random.default_rng(seed) for seed in range(COPIES)]

    def heights() -> list[float]:
        return [generator.uniform(0, 1) for generator in generators]

    first = many.read("qpos[1:2]").ravel()
    assert first.tolist() == heights()
    mask = np.arange(COPIES) % 2 == 0
    many.reset(mask)
    second, drawn = many.read("qpos[1:2]").ravel(), heights()
    assert np.array_equal(second, np.where(mask, drawn, first))
    many.step(None, 3)
    many.reset()
    assert np.array_equal(many.read("qpos[1:2]").ravel(), first)
    assert many.sim_time == 0.0


def test_a_copy_may_have_a_model_of_its_own_each_time_that_it_begins() -> None:
    def heavier(model: Any, generator: np.random.Generator) -> None:
        model.body_mass[model.body("torso").id] *= generator.uniform(1, 2)

    many = worlds(randomise=heavier)
    generators = [np.random.default_rng(seed) for seed in range(COPIES)]
    nominal = Bare().model.body_mass[2]

    def masses() -> list[float]:
        return [model.body_mass[2] for model in many.models]

    first = [nominal * generator.uniform(1, 2) for generator in generators]
    assert masses() == first
    many.reset(np.arange(COPIES) == 3)
    first[3] = nominal * generators[3].uniform(1, 2)  # of the file's mass, not of the last one
    assert masses() == first
    totals = [model.body_subtreemass[0] for model in many.models]
    assert totals == pytest.approx([sum(model.body_mass) for model in many.models])
    alone = [Bare() for _ in range(COPIES)]
    for bare, model in zip(alone, many.models, strict=True):
        bare.model, bare.data = model, mujoco.MjData(model)
    for round_ in actions(rounds=30):
        many.step(round_, STEPS)
        expected = [bare.step(action) for bare, action in zip(alone, round_, strict=True)]
        assert np.array_equal(many.read(*FIELDS), expected)


def test_a_reset_applies_fields_of_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    many = worlds()
    monkeypatch.setenv("NEUROS_MODEL_FIELDS", '{"opt.gravity": [0, 0, -1]}')
    many.reset()
    assert [model.opt.gravity[2] for model in many.models] == [-1] * COPIES
    monkeypatch.delenv("NEUROS_MODEL_FIELDS")
    many.reset()
    assert [model.opt.gravity[2] for model in many.models] == [-9.81] * COPIES


# ---------------------------------------------------------------------- for others


def test_observers_see_the_first_copy() -> None:
    node = SimulatedNode(copies=3)
    many = MuJoCoWorlds(node, HOPPER)
    many.step(np.zeros((3, 2)), 10)
    assert node.read_time_s() == pytest.approx(0.04)
    assert node.look_at_world is not None
    assert "torso" in node.look_at_world({"geometry": True}, 1)["geometry"]


def test_its_threads_end_with_the_node() -> None:
    node = SimulatedNode(copies=3)
    many = MuJoCoWorlds(node, HOPPER, threads=2)
    many.step(None, 2)
    node.close()
    assert many._pool is None


# ---------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (
            lambda many: many.step(np.zeros(2)),
            r"controls of 6 copies with 2 actuators have the shape \(6, 2\), not \(2,\)",
        ),
        (lambda many: many.step(np.zeros((6, 3))), r"shape \(6, 2\), not \(6, 3\)"),
        (lambda many: many.step(None, 0), "step: count is a whole number from 1, not 0"),
        (lambda many: many.step(None, 1.5), "whole number from 1, not 1.5"),
        (
            lambda many: many.reset([True]),
            r"a mask has 6 truth values, one for each copy, not bool\[1\]",
        ),
        (lambda many: many.reset([1, 3, 5, 0, 0, 0]), r"not int64\[6\]"),
        (lambda many: many.step(None, reset=[2]), r"not int64\[1\]"),
        (lambda many: many.read("qpso"), "'qpso' is neither an array of mjData .*'qpos'"),
        (lambda many: many.read("efc_force"), "'efc_force' is neither an array of mjData"),
        (lambda many: many.read(), r"name an array of mjData: read\('qpos', 'qvel'\)"),
    ],
)
def test_wrong_values_are_refused(call: Any, text: str) -> None:
    many = worlds()
    with pytest.raises(ModelError, match=text):
        call(many)
    assert many.sim_time == 0.0
    assert not many.read("qvel").any()


def test_a_copy_that_becomes_unstable_is_named() -> None:
    many = worlds()
    many.data[4].qvel[:] = 1e12
    with pytest.raises(
        ModelError, match=r"copy 4: unstable between 0 s and 0.02 s of simulated time"
    ):
        many.step(None, STEPS)


def test_a_model_that_does_not_compile_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="does not compile"):
        MuJoCoWorlds(SimulatedNode(copies=2), "<mujoco><nothing/></mujoco>")
