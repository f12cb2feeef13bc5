"""Under a model error: cogging is found, priors keep their influence, and narrow steps are found behind a Stribeck
rise.
"""

from collections.abc import Callable

import numpy as np
import pytest

from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.excitation.multisine import Multisine
from hil.estimator.fit.covariance import inflation
from hil.estimator.fit.levenberg_marquardt import Quadratic
from hil.estimator.fit.stage2 import Near
from hil.estimator.identify import Estimate, identify
from hil.estimator.models.model import Model
from hil.estimator.models.terms import term_of
from hil.estimator.options import LikelihoodOptions
from hil.estimator.selection.restarts import undisguised
from hil.estimator.selection.settled import choose
from hil.fakes.plants.arm import Arm, base_parameters
from tests.support.recorded_arm import servo_arm

Recorder = Callable[[Arm, Multisine], SettledPeriod]
Wave = Callable[..., Multisine]
PEAK = (0.2,)
WIDE_PEAK = (0.3,)


def cogging(pendulum: Arm, recorded: Recorder, wave: Wave, seconds: float) -> SettledPeriod:
    """The motion of a pendulum whose cogging is 1.4 % of its gravity torque.

    It is found in each of seven multisines with this peak. With 0.2 N m, the motion covers too few of its
    cycles: in every other multisine, other terms take its place.
    """
    drive = pendulum.drives[0].model_copy(update={"cogging": 0.002, "cogging_cycles": 4.0})
    return recorded(pendulum.model_copy(update={"drives": (drive,)}), wave(1, WIDE_PEAK, seconds))


def test_cogging_is_found_and_named(pendulum: Arm, recorded: Recorder, wave: Wave) -> None:
    choice = choose([cogging(pendulum, recorded, wave, 7.5)], None, "delay")
    found = choice.estimate.parameters
    assert choice.estimate.model.options == {"cogging"}
    assert np.hypot(found["cogging_sin_1"], found["cogging_cos_1"]) == pytest.approx(0.002, rel=0.02)
    assert found["cogging_cycles_1"] == pytest.approx(4.0, abs=0.05)
    for name, true in base_parameters(pendulum).items():
        if not name.startswith("offset"):
            assert found[name] == pytest.approx(true, rel=0.005), name


def test_a_model_error_does_not_overrule_what_is_known_of_encoders(
    pendulum: Arm, recorded: Recorder, wave: Wave
) -> None:
    period = cogging(pendulum, recorded, wave, 5.0)
    model = Model(1, "coulomb", "delay", {"encoder", "cable"})
    started = LikelihoodOptions(initial_widths=(0.05,), initial_bends=(5e-3,))  # the width is that of the arm
    found = identify(period, model, options=started)
    # As if the residual's errors were independent.
    near = Near(found.parameters, found.start)
    overruled = identify(period, model, near=near, options=LikelihoodOptions(least_inflation=np.inf))
    assert size(found) < 0.8 * size(overruled)


def test_data_count_for_less_by_the_model_error_in_them() -> None:
    normal = np.array([[4.0, 1.0], [1.0, 9.0]])
    at, nothing = Quadratic(100.0, normal, np.zeros(2)), np.zeros((2, 2))
    assert inflation(at, normal, 102, 0.0, nothing) == pytest.approx([1.02, 1.02], rel=1e-3)
    assert inflation(at, 5.0 * normal, 102, 0.0, nothing) == pytest.approx([5.1, 5.1], rel=1e-3)
    assert inflation(at, normal, 102, 50.0, nothing) == pytest.approx([26.02, 26.02], rel=1e-3)


def size(estimate: Estimate) -> float:
    """Return the encoder errors found, in standard deviations of their prior (RMS)."""
    errors = [value for name, value in estimate.parameters.items() if name.startswith("encoder")]
    spread = term_of("encoder_sin_once_1").spread
    assert isinstance(spread, float)
    return float(np.sqrt(np.mean(np.square(errors)))) / spread


def test_a_narrow_step_is_found_behind_a_stribeck_rise(recorded: Recorder, wave: Wave) -> None:
    arm = servo_arm({}, joints=1)
    period = recorded(arm, wave(1, PEAK, 5.0))
    model = Model(1, "stribeck", "delay")
    disguise = {"coulomb_width": 0.12, "stribeck_rise": 3.0, "stribeck_velocity": 0.09}
    start = base_parameters(arm) | {f"{name}_{joint}": v for name, v in disguise.items() for joint in (1,)}
    velocity = np.gradient(period.position, axis=1)[:, 0] * period.rate
    there = Near(start | {"delay": 0.0}, np.stack((period.position[:, 0], velocity)))
    wrong = identify(period, model, near=there)
    values = undisguised(wrong)
    assert values["coulomb_width_1"] < 0.01 and values["stribeck_rise_1"] < 0.1
    right = identify(period, model, near=Near({**wrong.parameters, **values}, wrong.start))
    assert np.sum(right.residual**2) < np.sum(wrong.residual**2)
    assert not undisguised(right)
