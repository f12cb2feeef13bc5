"""The brake opposes each velocity within the limits, and ends when it cannot or should not continue."""

from collections.abc import Callable
from math import nan

import pytest

from hil.config.schema import Config
from hil.drivers.errors import PortLost
from hil.drivers.servo_prior import servo_prior
from hil.drivers.state import State
from hil.errors import Cause, ExperimentError, NotSettled, SafetyStop, StopRequested
from hil.plan.brake import NOTICED_AFTER, Brake, braking_gains, may_brake
from tests.support.motion import brake_of, seen_moving

Arm = Callable[..., Config]
MOVING = State(0.0, 0.001, (0.0, 0.0), (0.0, 0.0), (3.0, -4.0), (-1.57, 0.0), (0, 0), (False, False))


def test_full_current_at_half_of_the_velocity_limit(arm: Arm) -> None:
    """The limits of the joints are 1.2 A and 15 rad/s, 0.8 A and 20 rad/s."""
    assert braking_gains(arm()) == pytest.approx([1.2 / 7.5, 0.8 / 10.0])
    assert brake_of(arm(), MOVING).goals(MOVING) == pytest.approx([-1.2 * 3.0 / 7.5, 0.8 * 4.0 / 10.0])


@pytest.mark.parametrize(("rate", "interval"), [(100.0, 0.01), (60.0, 1 / 120), (20.0, 0.01), (40.0, 0.025)])
def test_a_light_joint_is_not_thrown_back(arm: Arm, rate: float, interval: float) -> None:
    """With a velocity limit of 0.2 rad/s, the full current at half of it would reverse a light joint at once.

    On a slow bus, 40 Hz means one exchange per sample, which only the stream knows.
    """
    config = arm()
    joints = [joint.model_copy(update={"velocity_limit": 0.2}) for joint in config.joints]
    slow = config.experiment.model_copy(update={"rate": rate})
    config = config.model_copy(update={"joints": joints, "experiment": slow})
    known = interval if rate == 40.0 else None
    moving = MOVING._replace(velocity=(0.3, -0.3))
    goals = Brake(config, known, seen_moving(config, moving)).goals(moving)
    assert goals is not None
    for goal, joint, velocity in zip(goals, config.joints, (0.3, -0.3), strict=True):
        rotor = 0.5 * servo_prior(joint.joint.servo).armature.median
        change = goal * joint.torque_per_goal * (interval + 0.002) / rotor
        assert change == pytest.approx(-velocity), "stopped by one brake, not reversed"


def test_never_more_than_the_current_limit(arm: Arm) -> None:
    for sign in (1.0, -1.0):
        moving = MOVING._replace(velocity=(sign * -14.0, sign * 19.0))
        assert brake_of(arm(), moving).goals(moving) == pytest.approx([sign * 1.2, sign * -0.8])


@pytest.mark.parametrize(
    "change",
    [
        {"velocity": (0.09, -0.09)},
        {"velocity": (nan, -4.0), "missing": (True, False)},
        {"missing": (False, True)},
        {"error": (0, 0x80)},
        {"error": (1, 0)},
    ],
)
def test_over_at_rest_unseen_or_alarmed(arm: Arm, change: dict[str, object]) -> None:
    assert brake_of(arm(), MOVING).goals(MOVING._replace(**change)) is None  # type: ignore[arg-type]


def test_one_joint_that_still_moves_is_braked_alone(arm: Arm) -> None:
    moving = MOVING._replace(velocity=(0.0, 0.11))
    goals = brake_of(arm(), moving).goals(moving)
    assert goals is not None and goals[0] == 0.0 and goals[1] == pytest.approx(-0.8 * 0.11 / 10.0)


@pytest.mark.parametrize(("more", "goes_on"), [(3.9, True), (4.1, False)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_that_gets_faster_ends_it(arm: Arm, more: float, goes_on: bool, sign: float) -> None:
    """The tolerance is a fifth of the velocity limit, 20 rad/s, above the speed at the start of braking."""
    brake = brake_of(arm(), MOVING)
    assert brake.goals(MOVING) is not None
    faster = MOVING._replace(velocity=(0.0, sign * (4.0 + more)))
    assert (brake.goals(faster) is not None) is goes_on
    slow = brake_of(arm(), MOVING)
    assert slow.goals(MOVING._replace(velocity=(0.0, 0.2))) is not None
    assert (slow.goals(MOVING._replace(velocity=(0.0, sign * (0.2 + more)))) is not None) is goes_on


@pytest.mark.parametrize("interval", [0.001, 0.0025, 0.01, 0.05])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_current_in_the_direction_in_which_the_position_moves(arm: Arm, interval: float, sign: float) -> None:
    """Whatever the velocity says. The other joint is braked as ever."""
    for claimed in (0.5, 5.0, 20.0, 3000.0):
        moving = MOVING._replace(velocity=(3.0, -sign * claimed))
        truly = MOVING._replace(velocity=(3.0, sign * 2.0))
        brake = Brake(arm(), interval, seen_moving(arm(), truly, interval))
        assert brake.goals(moving) == pytest.approx([braking_gains(arm(), interval)[0] * -3.0, 0.0])


@pytest.mark.parametrize(("more", "goes_on"), [(1.1, True), (1.3, False)])
def test_a_joint_that_is_still_faster_after_a_while_ends_it(arm: Arm, more: float, goes_on: bool) -> None:
    """As with a reversed motor whose limit is 20 rad/s: after 20 ms, an increase of 6 % of this is too much."""
    brake = brake_of(arm(), MOVING)
    faster = MOVING._replace(velocity=(0.0, -4.0 - more))
    goals = [brake.goals(each) for each in (MOVING, *8 * [faster])]
    assert None not in goals[:8] and (goals[8] is not None) is goes_on


@pytest.mark.parametrize(("interval", "samples"), [(0.0025, 8), (0.01, 2), (0.002, 10)])
def test_a_while_is_the_same_time_however_long_an_exchange_takes(arm: Arm, interval: float, samples: int) -> None:
    brake = Brake(arm(), interval, seen_moving(arm(), MOVING, interval))
    faster = MOVING._replace(velocity=(0.0, -4.0 - 1.3))
    goals = [brake.goals(each) for each in (MOVING, *samples * [faster])]
    assert None not in goals[:samples] and goals[samples] is None


def test_a_brake_that_drives_acts_as_long_as_the_dry_run_assumes(arm: Arm) -> None:
    """What one state calls for is sent in the next exchange, whose own state shows none of its effect yet."""
    brake, velocity, acted = brake_of(arm(), MOVING), -4.0, 0
    goals = brake.goals(MOVING)
    while goals is not None:
        acted += 1  # from this exchange until the next one
        goals = brake.goals(MOVING._replace(velocity=(0.0, velocity)))
        velocity -= 4.1  # more than a fifth of the limit
    assert acted == NOTICED_AFTER


@pytest.mark.parametrize("interval", [0.0025, 0.01])
def test_hardly_any_current_while_the_position_stands_still(arm: Arm, interval: float) -> None:
    still = MOVING._replace(velocity=(0.0, 0.0))
    goals = Brake(arm(), interval, seen_moving(arm(), still, interval)).goals(MOVING._replace(velocity=(-15.0, 20.0)))
    assert goals is not None and abs(goals[0]) < 0.03 * 1.2 and abs(goals[1]) < 0.03 * 0.8


def test_a_joint_seen_only_once_is_not_braked_yet(arm: Arm) -> None:
    brake = Brake(arm())
    assert brake.goals(MOVING) == pytest.approx([0.0, 0.0])
    later = MOVING._replace(time_before_write=0.01, time_after_read=0.011, position=(-1.54, -0.04))
    assert brake.goals(later) == pytest.approx([-1.2 * 3.0 / 7.5, 0.8 * 4.0 / 10.0])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_position_that_gets_faster_ends_it_whatever_the_velocity_says(arm: Arm, sign: float) -> None:
    brake = brake_of(arm(), MOVING)
    assert brake.goals(MOVING) is not None
    for number in range(1, 20):
        time, moved = 0.0025 * number, sign * 9.0 * 0.0025 * number
        state = MOVING._replace(time_before_write=time, time_after_read=time + 0.001, position=(-1.57, moved))
        if brake.goals(state) is None:
            break
    assert 2 <= number <= 12, "9 rad/s instead of 4, on average over 20 ms"


ALLOWED = {
    *(Cause.POSITION, Cause.VELOCITY, Cause.OUT_OF_VOLTAGE, Cause.GOALS_CHANGED),
    *(Cause.TEMPERATURE, Cause.VOLTAGE),
}


@pytest.mark.parametrize("cause", Cause)
def test_brakes_only_where_motion_and_command_can_be_trusted(arm: Arm, cause: Cause) -> None:
    assert may_brake(arm(), SafetyStop("", cause)) is (cause in ALLOWED)


@pytest.mark.parametrize(
    ("error", "brakes"),
    [
        (StopRequested(), True),
        (NotSettled(), True),
        (ExperimentError(), True),
        (PortLost(), False),
        (KeyboardInterrupt(), False),
        (ZeroDivisionError(), False),
    ],
)
def test_brakes_for_the_errors_of_an_experiment_alone(arm: Arm, error: BaseException, brakes: bool) -> None:
    assert may_brake(arm(), error) is brakes


def test_never_where_the_configuration_says_cut(arm: Arm) -> None:
    config = arm(("[experiment]\n", '[safety]\nstop = "cut"\n\n[experiment]\n'))
    assert not may_brake(config, StopRequested())
