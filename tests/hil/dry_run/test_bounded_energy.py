"""Arms judged to have too little energy to leave their limits do not leave them in a simulation, and most are found."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.dry_run.bounded_energy import Boundary, boundary
from hil.dry_run.ensemble import prior_ensemble
from hil.dry_run.stopping_distance import Stopping, stopping_distance
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.closed_loop import Feedback, respond, resting
from hil.plan.plan import make_plan
from tests.support.edits import replaced
from tests.support.short_experiment import CONFIG, short_config

RATE = 200.0
SECONDS = 4.0
ARM = {
    "inertia_1": 0.018, "coupling": 0.0033, "inertia_2": 0.0028, "armature_2": 0.010, "gravity_1": 0.55,
    "gravity_2": 0.22, "viscous_1": 0.002, "viscous_2": 0.002,
}  # fmt: skip
LOW, HIGH = np.array([-2.6, -1.2]), np.array([-0.4, 1.0])


def farthest(physics: Physics, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    state = resting(position)
    state[1] = state[4] = velocity
    nothing = np.zeros((position.size, round(SECONDS * RATE)))
    moved = respond(physics, state, nothing, RATE, Feedback.none(position.size)).position
    return moved.min(axis=1), moved.max(axis=1)


@given(
    share=st.tuples(st.floats(0.01, 0.99), st.floats(0.01, 0.99)),
    velocity=st.tuples(st.floats(-4.0, 4.0), st.floats(-6.0, 6.0)),
    offset=st.floats(-0.05, 0.05),
    zero=st.floats(-0.1, 0.1),
    cable=st.floats(0.0, 0.1),
    gravity=st.floats(-0.3, 0.9),
    friction=st.floats(0.0, 0.03),
)
@settings(max_examples=150, deadline=None)
def test_an_arm_that_is_held_by_its_energy_stays_within_its_limits(
    share: tuple[float, float],
    velocity: tuple[float, float],
    offset: float,
    zero: float,
    cable: float,
    gravity: float,
    friction: float,
) -> None:
    richer = {"offset_1": offset, "zero_2": zero, "cable_stiffness_2": cable, "coulomb_1": friction}
    physics = Physics.of(ARM | richer | {"gravity_1": gravity, "coulomb_width_1": 0.01})
    limits = boundary(physics, LOW, HIGH)
    position = LOW + np.array(share) * (HIGH - LOW)
    if limits.holds(position, np.array(velocity)):
        low, high = farthest(physics, position, np.array(velocity))
        assert (low > LOW).all() and (high < HIGH).all()


def test_slow_arms_near_rest_are_found_and_fast_or_outer_ones_are_not() -> None:
    limits = boundary(Physics.of(ARM), LOW, HIGH)
    hanging = np.array([-np.pi / 2, 0.0])
    assert limits.holds(hanging, np.array([1.0, 1.0]))
    assert not limits.holds(hanging, np.array([9.0, 0.0]))
    low, high = farthest(Physics.of(ARM), hanging, np.array([9.0, 0.0]))
    assert (low < LOW).any() or (high > HIGH).any(), "and rightly"
    assert not limits.holds(np.array([-2.7, 0.0]), np.zeros(2)), "outside already"


def test_one_joint_is_judged_too() -> None:
    pendulum = Physics.of({"inertia_1": 0.02, "gravity_1": 0.5, "viscous_1": 0.002})
    limits = boundary(pendulum, LOW[:1], HIGH[:1])
    hanging = np.array([-np.pi / 2])
    assert limits.holds(hanging, np.array([1.0])) and not limits.holds(hanging, np.array([9.0]))


@pytest.mark.parametrize(
    "term", [{"presliding_stiffness_1": 5.0}, {"saturation_2": 0.1}, {"viscous_asymmetry_1": 0.01}, {"coulomb_1": -0.1}]
)
def test_terms_that_may_return_energy_are_simulated(term: dict[str, float]) -> None:
    assert not boundary(Physics.of(ARM | term), LOW, HIGH).holds(np.array([-np.pi / 2, 0.0]), np.zeros(2))


def test_a_horizontal_arm_has_no_such_bound() -> None:
    flat = Physics.of(ARM | {"gravity_1": 0.0, "gravity_2": 0.0})
    assert not boundary(flat, LOW, HIGH).holds(np.array([-1.5, 0.0]), np.array([0.01, 0.0]))


def test_overshoots_are_the_same_with_and_without(monkeypatch: pytest.MonkeyPatch) -> None:
    text = CONFIG.read_text(encoding="utf-8")
    config = short_config(replaced(text, ("[-4.2, 1.06]", "[-2.3, -0.9]"), ("[-3.1, 3.1]", "[-0.5, 0.5]")))
    plan, ensemble = make_plan(config), prior_ensemble(config, 3)

    def found() -> Stopping:
        return stopping_distance(config, plan, ensemble, np.array([3.0, 2.0]))

    judged = found()
    monkeypatch.setattr(Boundary, "holds", lambda *_: False)
    simulated = found()
    for ways in ("planned", "passed"):
        here, there = getattr(judged, ways), getattr(simulated, ways)
        for way in here:
            np.testing.assert_allclose(here[way], there[way], atol=1e-12)
    assert any((beyond > 0.0).any() for beyond in judged.planned.values()), "there is something to compare"
