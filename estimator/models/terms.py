"""Declaration of every parameter that a model may have: a new term requires one entry here and its equations.

Fits, results, reports, exports and the configuration take names, units, descriptions, ranges, initial guesses and
scales from here; docs/architecture.md lists the files to change for a new term. Parameters are named `term_joint`, with
joints counted from 1, while a parameter of the whole arm is named just `term`. This module imports only the standard
library, so that reading a result is fast.
"""

import re
from dataclasses import KW_ONLY, dataclass
from functools import cache
from typing import Literal, get_args

from hil.estimator.errors import ModelError

__all__ = [
    "BEYOND_SPEEDS",
    "DRIVES",
    "FRICTIONS",
    "OPTIONS",
    "RIGID_BODY",
    "TERMS",
    "Drive",
    "Friction",
    "Option",
    "Scale",
    "Term",
    "base_names",
    "constants",
    "extra_names",
    "joint_of",
    "kind_of",
    "term_of",
    "units_of",
]

Friction = Literal["coulomb", "stribeck", "stribeck_load"]
Drive = Literal["delay", "lag", "delay_lag"]
Option = Literal[
    "presliding",
    "asymmetry",
    "ripple",
    "cogging",
    "zeros",
    "torque_scale",
    "saturation",
    "cable",
    "encoder",
    "lags",
]
Scope = Literal["arm", "joint"]
Range = Literal["any", "positive", "floor", "share"]
Scale = Literal["inertia", "torque", "velocity", "damping", "stiffness", "saturation", "cable", "cogging"]

FRICTIONS: tuple[Friction, ...] = get_args(Friction)
"""Laws of dry friction; each one also includes the terms of all previous laws."""
DRIVES: dict[Drive, tuple[str, ...]] = {"delay": ("delay",), "lag": ("lag",), "delay_lag": ("delay", "lag")}
"""Terms of each drive model."""
OPTIONS: dict[Option, str] = {
    "presliding": "presliding friction: elastic displacement before sliding",
    "asymmetry": "direction-dependent viscous friction",
    "ripple": "torque ripple over the joint angle",
    "cogging": "cogging: torque that varies over the joint angle, whether or not the motor is driven",
    "zeros": "joint zero offsets; the first one is observable only under gravity",
    "torque_scale": "ratio of the joints' torque constants; one of them must be trusted",
    "saturation": "torque saturation: torque falls short of large commands",
    "cable": "a cable or spring that pulls the joint towards one angle",
    "encoder": "encoder errors that repeat once and twice per turn",
    "lags": "different lags or delays of the two joints' torques",
}
"""Optional parts of a model and their descriptions; also keys of `[model]`."""
BEYOND_SPEEDS = 3.0
"""Stribeck velocity, as a multiple of a joint's highest speed, for which the Stribeck rise falls by at most a tenth
within the recorded range of speeds.
"""
WIDEST_STEP = 0.3
"""Width of the Coulomb friction step, as a multiple of a joint's highest speed, above which it could not be
distinguished from viscous friction.
"""


@dataclass(frozen=True)
class Term:
    """One kind of parameter."""

    name: str
    """Name without the joint's number."""
    unit: str
    """SI unit; "1" for a ratio."""
    meaning: str
    """Description for users."""
    _: KW_ONLY
    part: str
    """The part of a model that includes this term: "base" (part of the linear regression, always present), one of
    FRICTIONS, one of OPTIONS, "delay" or "lag" (as listed in DRIVES), or "voltage" (joints driven by voltage).
    """
    scope: Scope = "joint"
    first_joint: int = 1
    """First joint with this term: 2 if the term is relative to joint 1, or if another term includes it for joint 1."""
    range: Range = "positive"
    """Range of values.

    "any": either sign. "positive": above 0. "floor": above the fit's lower bound for widths. "share": a fraction, of
    either sign, of the geometric mean of the two terms in `share_of`.
    """
    share_of: tuple[str, str] | None = None
    """Names of the two terms whose geometric mean bounds this term. If each joint has this term, the two terms are
    those of the same joint.
    """
    scale: Scale | float = 1.0
    """Typical change during a fit: a number [unit], or the name of a scale that depends on the arm and its motion."""
    initial: float = 0.0
    """Initial guess if neither the regression nor the caller provides one [unit]."""
    absent: float = 0.0
    """Value that disables the term in the simulation [unit]: 1 for factors and divisors."""
    fastest: float | None = None
    """Upper bound of a term that is a speed, as a multiple of the joint's highest speed; None for no bound.

    Beyond it, a Stribeck rise would be nearly constant, like Coulomb friction, and a Coulomb step nearly linear in
    velocity, like viscous friction.
    """
    largest: float | None = None
    """Upper bound [unit]; None for no bound.

    A ratio to a term that is absent, such as the rise above a Coulomb friction of zero, would otherwise grow without
    limit, and at speeds that the recording lacks, the model would predict absurd torques.
    """
    max_step: float | None = None
    """Maximum change in the term's coordinate (for positive terms, a logarithm) per iteration; None for the fit's
    limit.
    """
    standstill: bool = False
    """Whether the term shapes friction near standstill, so that its fit has local minima and needs several guesses."""
    replaced_by: str | None = None
    """The option that replaces this term."""
    simulated: bool = True
    """Whether the term belongs to the equations of motion rather than to the drive or the encoders."""
    spread: Scale | float | None = None
    """Typical deviation from `absent` on real arms: a number [unit] or the name of a scale; None if unknown."""
    log_spread: float | None = None
    """Standard deviation of a positive term's logarithm about the logarithm of `initial`; None if unknown."""

    @property
    def of_torque(self) -> bool:
        """Whether the parameter is proportional to torque: it doubles if all torques are twice as large as assumed."""
        return self.unit.startswith(("N m", "kg m^2"))


_DECLARED = (
    Term(
        "inertia",
        "kg m^2",
        "inertia of the joint's link about the joint; for joint 1, including its rotor and the mass at the link's end",
        part="base",
        scale="inertia",
    ),
    Term(
        "coupling",
        "kg m^2",
        "first moment of link 2 times the length of link 1",
        part="base",
        scope="arm",
        range="share",
        share_of=("inertia_1", "inertia_2"),
        scale="inertia",
    ),
    Term(
        "armature",
        "kg m^2",
        "reflected rotor inertia, acting on its own joint only",
        part="base",
        first_joint=2,
        scale="inertia",
        absent=1.0,
    ),
    Term("gravity", "N m", "gravity torque with the arm horizontal", part="base", range="any", scale="torque"),
    Term("viscous", "N m s/rad", "viscous friction coefficient", part="base", scale="damping"),
    Term("coulomb", "N m", "Coulomb friction while sliding", part="base", scale="torque"),
    Term("offset", "N m", "constant torque", part="base", range="any", scale="torque"),
    Term(
        "coulomb_width",
        "rad/s",
        "velocity width of the Coulomb friction step",
        part="coulomb",
        range="floor",
        scale=0.05,
        absent=1.0,
        fastest=WIDEST_STEP,
        standstill=True,
        replaced_by="presliding",
    ),
    Term(
        "stribeck_rise",
        "1",
        "Stribeck rise at low speed, as a fraction of Coulomb friction",
        part="stribeck",
        initial=0.2,
        largest=10.0,
        max_step=1.0,
        standstill=True,
    ),
    Term(
        "stribeck_velocity",
        "rad/s",
        "speed at which the Stribeck rise has fallen to 1/e",
        part="stribeck",
        scale="velocity",
        initial=0.2,
        absent=1.0,
        fastest=BEYOND_SPEEDS,
        max_step=1.0,
        standstill=True,
        log_spread=1.0,
    ),
    Term("load", "1", "Coulomb friction per unit of motor torque", part="stribeck_load", initial=0.02),
    Term(
        "presliding_stiffness",
        "N m/rad",
        "presliding stiffness",
        part="presliding",
        scale="stiffness",
        standstill=True,
    ),
    Term(
        "presliding_damping",
        "N m s/rad",
        "presliding damping",
        part="presliding",
        scale="damping",
        standstill=True,
    ),
    Term(
        "viscous_asymmetry",
        "N m s/rad",
        "direction-dependent viscous friction",
        part="asymmetry",
        range="share",
        share_of=("viscous", "viscous"),
        scale="damping",
    ),
    Term("ripple_sin", "1", "torque ripple over the angle, sine part", part="ripple", range="any", scale=0.02),
    Term("ripple_cos", "1", "torque ripple over the angle, cosine part", part="ripple", range="any", scale=0.02),
    Term("ripple_cycles", "1", "ripple cycles per turn", part="ripple", range="any", scale=0.02),
    Term("cogging_sin", "N m", "cogging torque, sine part", part="cogging", range="any", scale="cogging"),
    Term("cogging_cos", "N m", "cogging torque, cosine part", part="cogging", range="any", scale="cogging"),
    Term("cogging_cycles", "1", "cogging cycles per turn", part="cogging", range="any", scale=0.02),
    Term("zero", "rad", "true minus measured angle", part="zeros", range="any", scale=0.02, spread=0.04),
    Term(
        "torque_scale",
        "1",
        "ratio of true to assumed torque, relative to joint 1",
        part="torque_scale",
        first_joint=2,
        initial=1.0,
        absent=1.0,
        spread=0.15,
    ),
    Term(
        "saturation",
        "1/(N m)^2",
        "fraction of the torque lost, per torque squared",
        part="saturation",
        range="any",
        scale="saturation",
        spread="saturation",
    ),
    Term(
        "cable_stiffness",
        "N m/rad",
        "cable stiffness",
        part="cable",
        range="any",
        scale="torque",
        spread="cable",
    ),
    *(
        Term(
            f"encoder_{wave}_{times}",
            "rad",
            f"measured minus true angle, {wave} part of the error that repeats {times} per turn",
            part="encoder",
            range="any",
            scale=1e-3,
            simulated=False,
            spread=4e-3,
        )
        for times in ("once", "twice")
        for wave in ("sin", "cos")
    ),
    Term(
        "lag_difference",
        "s",
        "additional lag of the joint's torque relative to joint 1's; without a lag, additional delay",
        part="lags",
        first_joint=2,
        range="any",
        scale=1e-3,
        simulated=False,
        spread=1.5e-3,
    ),
    Term(
        "back_emf",
        "1",
        "fraction of viscous friction that is due to back-EMF and subject to the drive's lag",
        part="voltage",
        initial=0.92,
        log_spread=0.08,
    ),
    Term(
        "delay",
        "s",
        "torque delay",
        part="delay",
        scope="arm",
        range="any",
        scale=1e-3,
        simulated=False,
    ),
    Term(
        "lag",
        "s",
        "time constant of the current loop",
        part="lag",
        scope="arm",
        scale=1e-3,
        initial=1e-3,
        simulated=False,
    ),
)
TERMS: dict[str, Term] = {term.name: term for term in _DECLARED}
"""All terms by name, in the order used in all parameter vectors."""

RIGID_BODY: dict[int, tuple[str, ...]] = {
    1: ("inertia_1", "gravity_1"),
    2: ("inertia_1", "coupling", "inertia_2", "armature_2", "gravity_1", "gravity_2"),
}
"""Base parameters of the links, by number of joints."""
BASE_FRICTION = ("viscous", "coulomb", "offset")
"""Base terms other than those of the links, one per joint."""


def kind_of(name: str) -> str:
    """Return the term of a parameter: its name without the joint's number."""
    return _split(name)[0]


def term_of(name: str) -> Term:
    """Return the declaration of a parameter's term; raises ModelError for an unknown name."""
    try:
        return TERMS[kind_of(name)]
    except KeyError:
        raise ModelError(f"{name} is not a parameter of any model") from None


def joint_of(name: str) -> int | None:
    """Return the joint of a parameter, counted from 1; None for a parameter of the whole arm."""
    return _split(name)[1]


def base_names(joints: int) -> tuple[str, ...]:
    """Return the names of the base parameters, in the order used in all parameter vectors; raises ModelError."""
    if joints not in RIGID_BODY:
        raise ModelError(f"an arm of {joints} joints: the planar arm model supports one or two")
    friction = (f"{term}_{joint + 1}" for term in BASE_FRICTION for joint in range(joints))
    return (*RIGID_BODY[joints], *friction)


def extra_names(
    joints: int, parts: frozenset[str] | None = None, by_voltage: frozenset[int] | None = None
) -> tuple[str, ...]:
    """Return the names of a model's parameters except the base parameters; parts: parts of the model, by default all.

    by_voltage: joints (from 1) that are driven by voltage; by default all.
    """
    return tuple(
        name
        for term in _DECLARED
        if term.part != "base" and (parts is None or (term.part in parts and term.replaced_by not in parts))
        for name in _names_of(term, joints)
        if term.part != "voltage" or by_voltage is None or joint_of(name) in by_voltage
    )


def constants() -> tuple[str, ...]:
    """Return the names of the constants in a two-joint arm's equations of motion, ordered by term, then by joint."""
    joints = (1, 2)
    simulated = [term for term in _DECLARED if term.simulated and term.part != "base"]
    per_joint = [*BASE_FRICTION, *(term.name for term in simulated if term.scope == "joint")]
    return (
        *RIGID_BODY[2],
        *(f"{name}_{joint}" for name in per_joint for joint in joints),
        *(term.name for term in simulated if term.scope == "arm"),
    )


def units_of(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(term_of(name).unit for name in names)


def _names_of(term: Term, joints: int) -> tuple[str, ...]:
    if term.scope == "arm":
        return (term.name,)
    return tuple(f"{term.name}_{joint}" for joint in range(term.first_joint, joints + 1))


@cache
def _split(name: str) -> tuple[str, int | None]:
    found = re.fullmatch(r"(.+?)_([1-9][0-9]*)", name)
    return (found[1], int(found[2])) if found else (name, None)
