"""Wrong columns in a chain's recording are named from the normal equations; sound recordings raise no suspicion."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.estimator.chain.column_faults import ColumnCheck
from hil.estimator.chain.fit.stage1 import columns_of
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.recordings import torque_error
from hil.estimator.data.fourier import PeriodicMotion
from hil.estimator.data.recording import Recording

RATE, SAMPLES = 100.0, 1500
LINKS = np.array(
    [[m, m * c, 0.0, 0.0, 0.0, 0.0, 0.0, *(m * c * c * k,) * 3][:10] for m, c, k in ((0.4, 0.1, 1.4),) * 3]
)


def model(first: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> ChainModel:
    """Three links, the last two in a vertical plane. first: axis of the first joint."""
    along = np.array([[0.0, 0.0, 0.0], [0.16, 0.0, 0.0], [0.14, 0.0, 0.0]])
    axis = np.array([first, (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)])
    return ChainModel(BaseParameters.of(Chain(np.stack([np.eye(3)] * 3), along, axis, np.array([0.0, 0.0, -9.81]))))


def recorded(arm: ChainModel, seed: int) -> Recording:
    """Motion of random sines, and the torque that it takes, with noise."""
    rng, time = np.random.default_rng(seed), np.arange(SAMPLES) / RATE
    w = rng.uniform(1.0, 9.0, (3, 4, 1))
    phase, size = w * time + rng.uniform(0.0, 6.0, w.shape), rng.uniform(0.5, 1.5, w.shape) / w
    position = (size * np.sin(phase)).sum(1)
    motion = PeriodicMotion(position, (size * w * np.cos(phase)).sum(1), -(size * w * w * np.sin(phase)).sum(1))
    values = np.concatenate((arm.base.of_all(np.column_stack((LINKS, [0.01] * 3)).reshape(-1)), [0.04] * 6, [0.0] * 3))
    torque = columns_of(arm, motion) @ values
    noise = rng.normal(0.0, 0.02 * torque.std(axis=1, keepdims=True), torque.shape)
    return Recording(time, torque + noise, position, np.full(3, 1e-3), "held", 0.0)


def checked(recording: Recording, arm: ChainModel) -> ColumnCheck:
    found = ColumnCheck.of([recording], arm, Prior.of(arm.base, LINKS))
    assert found is not None
    return found


def test_sound_columns_raise_no_suspicion() -> None:
    arm = model()
    check = checked(recorded(arm, 1), arm)
    assert not check.suspicious
    assert check.reversed_columns() is None
    assert check.contradictory_torques() is None
    assert check.wrong_times() is None


@pytest.mark.parametrize(
    ("torque", "position"),
    [((1, -1, 1), (1, 1, 1)), ((1, 1, 1), (1, 1, -1)), ((1, -1, -1), (1, 1, 1)), ((-1, -1, -1), (1, 1, 1))],
)
def test_reversed_columns_are_found(torque: tuple[int, ...], position: tuple[int, ...]) -> None:
    arm = model()
    good = recorded(arm, 3)
    bad = replace(
        good, torque=good.torque * np.array(torque)[:, None], position=good.position * np.array(position)[:, None]
    )
    check = checked(bad, arm)
    found = check.reversed_columns()
    assert check.suspicious
    assert found is not None
    assert (found.signs.torque, found.signs.position) == (torque, position)


def test_a_reversed_angle_of_a_vertical_first_joint_is_found_by_its_negative_friction() -> None:
    arm = model(first=(0.0, 0.0, 1.0))
    good = recorded(arm, 3)
    assert not checked(good, arm).suspicious
    check = checked(replace(good, position=good.position * np.array([[-1.0], [1.0], [1.0]])), arm)
    found = check.reversed_columns()
    assert check.suspicious
    assert found is not None
    assert found.impossible
    assert found.signs.reversed_columns == ("the position of joint 1",)


@pytest.mark.parametrize(
    ("columns", "torque", "position"), [("torques", (1, 0, 2), (0, 1, 2)), ("positions", (0, 1, 2), (0, 2, 1))]
)
def test_swapped_columns_are_found(columns: str, torque: tuple[int, ...], position: tuple[int, ...]) -> None:
    arm = model()
    good = recorded(arm, 3)
    assert checked(good, arm).swapped_columns() is None
    check = checked(replace(good, torque=good.torque[[*torque]], position=good.position[[*position]]), arm)
    found = check.swapped_columns()
    assert check.suspicious
    assert found is not None
    assert (found.columns, found.joints) == (columns, (0, 1) if columns == "torques" else (1, 2))


def test_a_late_torque_is_found() -> None:
    arm = model()
    good = recorded(arm, 3)
    assert checked(good, arm).late_torque() is None
    shifted = np.roll(good.torque, 3, axis=1)  # by 30 ms
    late = np.array([[False], [True], [False]])
    one = checked(replace(good, torque=np.where(late, shifted, good.torque)), arm).late_torque()
    every = checked(replace(good, torque=shifted), arm).late_torque()
    assert one is not None and every is not None
    assert (one.joint, every.joint) == (1, None)
    assert [one.seconds, every.seconds] == pytest.approx([0.03, 0.03], abs=0.006)


def test_a_torque_of_the_wrong_size_is_found() -> None:
    arm = model()
    good = recorded(arm, 4)
    found = checked(replace(good, torque=good.torque * np.array([1.0, 1.5, 1.0])[:, None]), arm).contradictory_torques()
    assert found is not None
    np.testing.assert_allclose(found, [1.0, 1.0 / 1.5, 1.0], rtol=0.05)


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_wrong_times_are_found(factor: float) -> None:
    arm = model()
    good = recorded(arm, 5)
    found = checked(replace(good, time=good.time * factor), arm).wrong_times()
    assert found is not None
    assert found.factor == pytest.approx(factor, rel=0.1)


def test_the_prediction_of_torque_includes_fitted_ratios() -> None:
    arm = model()
    good = recorded(arm, 6)
    bad = replace(good, torque=good.torque * np.array([1.0, 1.5, 1.0])[:, None])
    found: Any = SimpleNamespace(model=arm, cutoff=8.0, parameters=dict.fromkeys(arm.linear_names, 0.01))
    plain = torque_error([good], found)
    found.parameters["torque_scale_2"] = 1.0 / 1.5
    np.testing.assert_allclose(torque_error([bad], found), plain)
