"""Odd and even distortion on unexcited lines, and the part of it that a model does not explain."""

from collections.abc import Callable

import numpy as np
import pytest

from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.excitation.multisine import Multisine, design_multisine, detecting_lines
from hil.estimator.identify import identify
from hil.estimator.models.model import Friction, Model
from hil.estimator.selection.distortion import Distortion, distortion
from hil.estimator.selection.validation import validate
from hil.estimator.selection.verdict import Evidence, judge
from hil.fakes.plants.arm import Arm

Recorder = Callable[[Arm, Multisine], SettledPeriod]


@pytest.fixture(scope="module")
def odd_wave() -> Multisine:
    return design_multisine(400.0, 10.0, detecting_lines(10.0, (0.1, 5.0), 2, 1), (0.8, 0.42), 3)


def changed(arm: Arm, **terms: float) -> Arm:
    drives = tuple(drive.model_copy(update=terms) for drive in arm.drives)
    return arm.model_copy(update={"drives": drives})


def levels(period: SettledPeriod, friction: Friction = "coulomb") -> Distortion:
    return distortion(period, identify(period, Model(2, friction, "delay")))


def test_friction_is_odd_and_an_offset_even(ideal_arm: Arm, recorded: Recorder, odd_wave: Multisine) -> None:
    found = levels(recorded(changed(ideal_arm, offset=0.0), odd_wave))
    assert found.odd is not None and found.even is not None
    assert np.all(found.odd.motion > 100.0 * found.noise)
    assert np.all(found.even.motion < 2.0 * found.noise), (
        "a hanging arm with symmetric friction only has odd distortion"
    )
    assert np.all(found.odd.left < 2.0 * found.noise), "and the model explains it"
    aside = levels(recorded(changed(ideal_arm, offset=0.03), odd_wave))
    assert aside.even is not None
    assert np.all(aside.even.motion > 20.0 * aside.noise)
    assert np.all(aside.even.left < 2.0 * aside.noise)


def test_what_the_model_lacks_stands_on_the_lines_that_it_makes(
    ideal_arm: Arm, recorded: Recorder, odd_wave: Multisine
) -> None:
    rising = changed(ideal_arm, offset=0.0, coulomb_width=0.0, stribeck_rise=0.6, stribeck_velocity=0.3)
    period = recorded(rising, odd_wave)
    estimate = identify(period, Model(2, "coulomb", "delay"), coarse=True)
    found = distortion(period, estimate)
    assert found.odd is not None and found.even is not None
    assert np.all(found.odd.left > 5.0 * found.noise)
    assert np.all(found.odd.left > 4.0 * found.even.left)
    said = " ".join(judge(estimate, validate(period, estimate), Evidence()).sentences)
    assert "odd harmonics indicates friction or ripple" in said


def test_with_every_line_driven_odd_and_even_cannot_be_told(ideal_period: SettledPeriod) -> None:
    found = distortion(ideal_period, identify(ideal_period, Model(2)))
    assert found.odd is None and found.even is None
    assert found.excited.lines == 50 and found.other is not None
    assert np.all(found.excited.motion > 1000.0 * found.other.motion)
