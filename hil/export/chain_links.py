"""Links for the export of an identified spatial arm: of all physically possible links with the identified dynamics,
the ones closest to the URDF are used.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isclose
from pathlib import Path

import numpy as np

from hil.chain_model import ChainArmModel
from hil.description.arm import ArmDescription, ArmFileError, ArmJoint, Body
from hil.description.files import read_arm
from hil.drivers.errors import DriverError
from hil.drivers.servo_model import servo_model
from hil.drivers.servo_prior import servo_prior
from hil.errors import ExportError
from hil.estimator.arrays import Array
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.physical_links import PhysicalLinks, nearest_links
from hil.estimator.chain.model.prior import ARMATURE
from hil.estimator.chain.model.tilt import TILT
from hil.export.source import Source

HALVINGS = 12
LEAST_LEFT = 0.1  # of a link's mass, after separating what held joints move
FAR = 3.0  # standard errors between physical links and identified parameters above which a note is added
DIFFERENT, USELESS = 0.01, 0.2
"""Limits on the relative RMS difference between a joint's torques in the file and the identified ones. Above the first,
a warning is given; above the second, the export is refused.
"""
LITTLE_PULL = 1e-3
"""Weight of the description if the usual weight pulls the torques away from identified values that are uncertain."""
MOTIONS, SPEED, ACCELERATION = 200, 1.0, 10.0  # random poses; RMS velocity [rad/s] and acceleration [rad/s^2]
NOT_EXACT = "the identified arm exactly: "
"""Beginning of the first sentence about what a file cannot represent, if its arm is not equivalent to the identified
one.
"""


@dataclass(frozen=True)
class ChainLinks:
    """An arm to be exported: its description and, per joint, the link's body and the rotor's inertia [kg m^2]."""

    path: Path
    arm: ArmDescription
    bodies: tuple[Body, ...]
    armature: tuple[float, ...]
    left_out: tuple[str, ...]
    """What the links cannot represent, one sentence each."""

    @property
    def is_exact(self) -> bool:
        """Whether the links have the identified dynamics."""
        return not any(sentence.startswith(NOT_EXACT) for sentence in self.left_out)


def chain_links(source: Source, model: ChainArmModel) -> ChainLinks:
    """Compute the links from a run folder, which holds the URDF. Raises ExportError."""
    assert source.result.chain is not None
    path = source.run / source.result.chain.urdf
    try:
        arm = read_arm(path, [joint.name for joint in model.joints])
    except ArmFileError as error:
        raise ExportError(f"The URDF used for the run is needed: {error}.") from error
    geometry = model.geometry
    chain = Chain(geometry.rotation, geometry.translation, geometry.axis, geometry.gravity)
    base = BaseParameters.of(chain, tilts=TILT[0] in model.values)
    if not _same_groups(base, model.groups):
        raise ExportError(
            f"{source.run}: this run was estimated by a version of hil that groups the links' parameters differently. "
            "Run hil estimate again."
        )
    value = np.array([model.values[name] for name in base.names])
    std = np.array([model.stds[name] for name in base.names])
    rotors = np.array([_rotor(model, number) for number in range(1, len(model.joints) + 1)])
    found = nearest_links(base, value, std, arm.parameters, rotors)
    different = _torque_difference(model, base, value, found)
    if different.max() > 0.1 * DIFFERENT:
        nearer = nearest_links(base, value, std, arm.parameters, rotors, LITTLE_PULL)
        nearer_by = _torque_difference(model, base, value, nearer)
        if nearer_by.max() < different.max():
            found, different = nearer, nearer_by
    if different.max() > USELESS:
        raise ExportError(_refusal(model, different))
    said = []
    if found.misfit > FAR or different.max() > DIFFERENT:
        said.append(
            f"{NOT_EXACT}no physically consistent links have the identified values. Those in the file are up to "
            f"{found.misfit:.1f} standard errors away, and the joints' torques differ by {_by_joint(model, different)}"
        )
    bodies = tuple(_body(row) for row in found.links)
    return ChainLinks(path, arm, bodies, tuple(found.armature.tolist()), tuple(said))


def _torque_difference(model: ChainArmModel, base: BaseParameters, value: Array, found: PhysicalLinks) -> Array:
    """RMS difference between each joint's torque with the exported links and the identified torque, relative to the RMS
    of the whole torque (joints,). All torques are computed in random poses within the position limits.
    """
    rng = np.random.default_rng(1)
    limits = np.array([joint.position_limit if joint.has_limits else (-np.pi, np.pi) for joint in model.joints])
    shape = len(model.joints), MOTIONS
    q = rng.uniform(limits[:, :1], limits[:, 1:], shape)
    v, a = SPEED * rng.standard_normal(shape), ACCELERATION * rng.standard_normal(shape)
    exported = base.of_all(np.column_stack((found.links, found.armature)).reshape(-1))
    away = base.regressor(q, v, a) @ (exported - value)
    whole = model.inverse_dynamics(q.T, v.T, a.T).T
    return np.asarray(np.sqrt(np.mean(away**2, axis=1) / np.mean(whole**2, axis=1)))


def _by_joint(model: ChainArmModel, different: Array) -> str:
    parts = ", ".join(
        f"{100.0 * each:.2g} % ({joint.name})" for joint, each in zip(model.joints, different, strict=True)
    )
    return f"{parts} of their RMS, in {MOTIONS} random poses with {SPEED:g} rad/s and {ACCELERATION:g} rad/s^2 RMS"


def _refusal(model: ChainArmModel, different: Array) -> str:
    return (
        "No physically consistent links have the identified values: with the closest ones, the joints' torques differ "
        f"by {_by_joint(model, different)}; arms that differ by more than {100.0 * USELESS:.0f} % are not exported. "
        "Correct what the verdict names (base, direction, zero_ticks, the description of the arm) and identify again. "
        "The identified values themselves can be exported with --format toml or json."
    )


def without_movable(joint: ArmJoint, body: Body) -> tuple[Body, float]:
    """Separate a link from the parts that held joints move, such as gripper fingers; these parts keep their own
    inertia.

    If the described masses of these parts leave no physically possible body for the link itself, the masses are
    multiplied by a common fraction, which is halved until a body is possible. Returns the link's body and that
    fraction.
    """
    share = 1.0
    for _ in range(HALVINGS):
        left = body
        for each in joint.movable.values():
            left = left.joined(Body(-share * each.mass, each.centre, -share * each.inertia))
        if left.mass > LEAST_LEFT * body.mass and left.is_physical:
            return left, share
        share *= 0.5
    return body, 0.0


def _same_groups(base: BaseParameters, groups: Mapping[str, str]) -> bool:
    """Return whether these groups and those of the base parameters are equal, up to rounding of the factors."""
    if set(groups) != set(base.names):
        return False
    return all(_same_sum(group, groups[name]) for name, group in zip(base.names, base.groups, strict=True))


def _same_sum(one: str, other: str) -> bool:
    words, others = one.split(), other.split()
    return len(words) == len(others) and all(map(_same_word, words, others))


def _same_word(one: str, other: str) -> bool:
    if one[0].isdigit() and other[0].isdigit():
        return isclose(float(one), float(other), rel_tol=1e-4)
    return one == other


def _rotor(model: ChainArmModel, number: int) -> float:
    """A joint's rotor inertia [kg m^2]: as identified or, if only a sum containing it was identified, the typical
    value for its servos.

    If the typical value is far too small, the exported link becomes far too heavy.
    """
    if (known := model.values.get(f"armature_{number}", 0.0)) > 0.0:
        return known
    try:
        joint = model.joints[number - 1]
        return joint.servos * servo_prior(servo_model(joint.servo)).armature.median
    except DriverError:  # recordings of an unknown servo
        return 0.5 * ARMATURE


def _body(link: np.ndarray) -> Body:
    mass, centre = float(link[0]), link[1:4] / link[0]
    about = np.zeros((3, 3))
    about[np.triu_indices(3)] = link[4:]
    about = about + np.triu(about, 1).T
    return Body(mass, centre, about - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre)))
