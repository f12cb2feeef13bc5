"""Explains what the joint checks find: the cause of each fault, what was measured, and what the user should do."""

from collections.abc import Sequence
from itertools import pairwise
from math import copysign
from typing import Any

from hil.config.schema import Config
from hil.drivers.servo_model import HARDLY_ANY, Mode
from hil.drivers.state import State
from hil.errors import Cause
from hil.experiment.checks import joint_checks
from hil.experiment.checks.swapped import SwappedReplies, swapped_advice
from hil.experiment.status_check import StatusCheck
from hil.plan.recent_motion import RecentMotion

__all__ = ["JointFaults"]

BELOW_VOLTAGE = 0.9
"""If the supply cannot drive the commanded current at some speed, this fraction of that speed is proposed as a
limit.
"""

_LACKS_S, _EXPLAINED = 0.1, 0.5
"""The supply explains missing torque if it accounts for at least the fraction `_EXPLAINED` of it in the last `_LACKS_S`
[s].
"""

_FEWEST = 4
"""Minimum number of readings needed to explain how a current differs from its goal."""

Fault = tuple[Cause, str]
"""The cause of a fault, and its description as a predicate, to be preceded by the joint's name."""


class JointFaults:
    """Explains a fault from the joints' records (`joint_checks.JOINT`) and their recent motion, status and supply.

    lower_torque: advice to lower the torque, with a leading space; "" if the torque is not the user's choice.
    """

    def __init__(
        self, config: Config, records: Any, recent: RecentMotion, status: StatusCheck, lower_torque: str
    ) -> None:
        self._records, self._recent, self._status = records, recent, status
        self._lower_torque = lower_torque
        self._swapped = SwappedReplies([joint.joint for joint in config.joints])
        self._constants = [joint.torque_per_goal for joint in config.joints]
        self._units = [joint.drive_mode.goal_unit for joint in config.joints]
        self._models = [joint.joint.servo if joint.drive_mode is Mode.CURRENT else None for joint in config.joints]
        self.supply = [float("nan")] * len(config.joints)
        """Lowest measured supply voltage of each joint [V]; NaN before the first reading."""

    def of(self, fault: int, state: State) -> tuple[int, Cause, str]:
        """Return the joint's index, the cause and the explanation of a fault that `JointChecks` returned."""
        index, check = divmod(fault, joint_checks.CHECKS)
        explained = (
            self._jumped,
            self._outside,
            self._too_fast,
            self._not_followed,
            self._disagree,
            self._turns_the_wrong_way,
            self._frozen,
        )
        return index, *explained[check](index, state)

    def lack_of_voltage(self, index: int, lacking: float, recent: Sequence[State]) -> Fault | None:
        """Return the fault if the supply explains a joint's missing torque [N m] in these exchanges, otherwise None."""
        model = self._models[index]
        if model is None or not self._records[index]["is_followed"] or self._status.other_goal(index) is not None:
            return None
        for before, state in pairwise(recent):
            # What is sent with one sample acts until the next.
            goal, carried, velocity = before.goal_current[index], state.current[index], state.velocity[index]
            explained = self._constants[index] * (goal - carried) * copysign(1.0, lacking)
            if (
                state.time_before_write >= recent[-1].time_before_write - _LACKS_S
                and explained >= _EXPLAINED * abs(lacking)
                and model.is_out_of_voltage(goal, carried, velocity, self.supply[index])
            ):
                return self._out_of_voltage(index, goal, carried, velocity)
        return None

    def swapped(self, index: int, state: State) -> str:
        """Return a sentence if a joint's angle changed because replies of two servos were swapped; otherwise ""."""
        before = [self._recent.previous(joint) for joint in range(len(self._records))]
        pair = self._swapped.look(index, state, before)
        return "" if pair is None else swapped_advice(*pair)

    def _jumped(self, index: int, state: State) -> Fault:
        joint = self._records[index]
        check = "Check the encoder, its magnet and the supply, and whether its horn slips."
        return (
            Cause.JUMP,
            f"reports an angle that changed by {joint['moved']:+.3f} rad within {1e3 * joint['seconds']:.0f} ms; its "
            f"velocity limit allows at most {joint['most']:.3f} rad. {self.swapped(index, state) or check}",
        )

    def _outside(self, index: int, state: State) -> Fault:
        joint = self._records[index]
        return (
            Cause.POSITION,
            f"is at {state.position[index]:.3f} rad, outside its position limit [{joint['low']:g}, {joint['high']:g}]."
            f"{self._lower_torque}",
        )

    def _too_fast(self, index: int, state: State) -> Fault:
        velocity = state.velocity[index]
        if self._recent.contradicts(index, velocity):
            return Cause.FROZEN, self._not_its_velocity(index, velocity)
        if self._recent.is_unreachable(index, velocity):
            return Cause.VELOCITY, self._faster_than_its_motor(index, velocity)
        return (
            Cause.VELOCITY,
            f"is moving at {state.velocity[index]:.2f} rad/s, more than its velocity limit of "
            f"{self._records[index]['fastest']:g} rad/s.{self._lower_torque}",
        )

    def _not_its_velocity(self, index: int, velocity: float) -> str:
        said, reach = f"reports a velocity of {velocity:+.2f} rad/s", "that no servo of this model can reach"
        slips = ""
        if travels := self._recent.travels(index):
            moved, seconds, *_ = travels[0]
            way = f"which changed by {moved:+.4f} rad in the last {1e3 * seconds:.0f} ms"
            said += f" that contradicts its position, {way}"
            if self._recent.is_unreachable(index, velocity):
                said += f", and {reach}"
            else:
                slips = ", or its horn has just begun to slip"
        else:
            said += f" {reach}"
        return (
            f"{said}: this reading is wrong{slips}. Check the servo and whether a device between adapter and servo "
            "changes its replies; replace the servo if it happens again."
        )

    def _faster_than_its_motor(self, index: int, velocity: float) -> str:
        moved, seconds, *_ = self._recent.travels(index)[0]
        return (
            f"is moving at {velocity:.2f} rad/s, and its position has changed by {moved:+.3f} rad within "
            f"{1e3 * seconds:.0f} ms: its motor alone cannot turn it that fast. Its horn slips, something has struck "
            "the arm, or its encoder is wrong. Check the horn and its screws, the encoder and its magnet."
        )

    def _not_followed(self, index: int, state: State) -> Fault:
        carried, commanded, velocity = state.current[index], state.goal_current[index], state.velocity[index]
        model, unit = self._models[index], self._units[index]
        said = f"carries {carried:.3f} {unit} instead of the commanded {commanded:.3f} {unit}"
        # If the servo holds another goal, that explains its current.
        has_own_goal = self._status.other_goal(index) is None
        if has_own_goal and model and model.is_out_of_voltage(commanded, carried, velocity):
            if model.is_out_of_voltage(commanded, carried, velocity, self.supply[index]):
                return self._out_of_voltage(index, commanded, carried, velocity)
            # Published figures are too uncertain to rule out the supply, so the arm is still braked.
            return (
                Cause.GOALS_CHANGED,
                f"{said} at {velocity:.2f} rad/s: {self.supply[index]:.1f} V can drive the commanded current at "
                "that speed, according to the published figures. Its goals are being altered in transit or by another "
                "program, its supply sags, a motor wire or contact is loose, or its current sensor is wrong: "
                "check these. If all are in order, its motor is weaker than published: lower velocity_limit to "
                f"{BELOW_VOLTAGE * abs(velocity):.2g} rad/s.",
            )
        seconds = self._records[index]["found"]
        return (
            Cause.NOT_FOLLOWING,
            f"{said}, according to the readings of the last {1e3 * seconds:.0f} ms. "
            f"{self._why_not_followed(index, state)}",
        )

    def _frozen(self, index: int, state: State) -> Fault:
        goals, unit = self._records[index]["goals"], self._units[index]
        return (
            Cause.NOT_FOLLOWING,
            f"has reported exactly the same position, velocity and current ({state.current[index]:.3f} {unit}) for "
            f"{1e3 * goals['same_for']:.0f} ms, although its goal has changed by more than {goals['most']:.3f} {unit}: "
            "its readings are frozen, its torque is off, or its goals do not arrive. Check the servo, and whether a "
            "device between adapter and servo repeats its replies.",
        )

    def _out_of_voltage(self, index: int, goal: float, carried: float, velocity: float) -> Fault:
        unit = self._units[index]
        return (
            Cause.OUT_OF_VOLTAGE,
            f"carries {carried:.3f} {unit} instead of the commanded {goal:.3f} {unit} at {velocity:.2f} rad/s: at that "
            "speed its supply cannot drive more current against the back-EMF, a motor wire or contact is loose, "
            "or its current sensor is wrong. Check the motor's wiring first. If it is sound, lower velocity_limit to "
            f"{BELOW_VOLTAGE * abs(velocity):.2g} rad/s, or raise the supply voltage; if this happens at lower speeds "
            f"too, suspect the wiring or the sensor.{self._lower_torque}",
        )

    def _why_not_followed(self, index: int, state: State) -> str:
        carried, commanded, unit = state.current[index], state.goal_current[index], self._units[index]
        held = self._status.other_goal(index)
        if held is not None and abs(carried - held) < abs(carried - commanded):
            return (
                f"Its goal register reads {held:.3f} {unit}, which matches the measured value: another program is "
                "commanding it, or goals are being altered or lost in transit."
            )
        along = carried if commanded >= 0.0 else -carried
        allowed = self._records[index]["following"]["allowed"]
        readings, least = self._recent.currents(index), self._records[index]["goals"]["most"]
        if _is_stuck(readings, least):
            return (
                "Its current reading stays the same while its goal changes: its current sensor is wrong, or another "
                "program is commanding it."
            )
        if along > abs(commanded) + allowed or along < -allowed or _is_shifted(readings, least):
            return "Its torque is not as commanded: another program is commanding it, or its current sensor is wrong."
        weak = "it cannot deliver this much at its speed and supply voltage (safety.follow_share)."
        if along > HARDLY_ANY * abs(commanded):
            return (
                f"Its goals are being altered in transit or by another program, its current sensor is wrong, or {weak}"
            )
        # The applied voltage, which is measured in PWM mode, does not depend on the motor's wires.
        wire = "" if self._models[index] is None else "a motor wire is broken, "
        return f"Its torque is off, it was rebooted, its watchdog tripped, {wire}its current sensor is wrong, or {weak}"

    def _disagree(self, index: int, state: State) -> Fault:
        return (
            Cause.FROZEN,
            f"reports a velocity of {state.velocity[index]:+.2f} rad/s that does not fit its position, "
            f"{state.position[index]:.3f} rad: one of the two readings is frozen or wrong, or the horn slips. Check "
            "the horn, the encoder and its magnet; replace the servo if necessary.",
        )

    def _turns_the_wrong_way(self, index: int, _: State) -> Fault:
        return (
            Cause.WRONG_SIGN,
            f"is moving against its command: its motor has taken {self._records[index]['found']:.2f} J out of the arm, "
            "more than friction can account for. Its direction is reversed, its horn slips, or something else is "
            "driving the arm.",
        )


def _is_stuck(readings: Sequence[tuple[float, float]], least: float) -> bool:
    """Whether a current stayed at exactly the same nonzero value while its goal changed by more than `least`."""
    if len(readings) < _FEWEST:
        return False
    goals, currents = zip(*readings, strict=True)
    return len(set(currents)) == 1 and abs(currents[0]) > least and max(goals) - min(goals) > least


def _is_shifted(readings: Sequence[tuple[float, float]], least: float) -> bool:
    """Whether a current follows its goal with an offset; offset and goal change must both exceed `least`."""
    if len(readings) < _FEWEST:
        return False
    goals = [goal for goal, _ in readings]
    away = [current - goal for goal, current in readings]
    changed = max(goals) - min(goals)
    return changed > least and max(away) - min(away) < 0.4 * changed and min(map(abs, away)) > least
