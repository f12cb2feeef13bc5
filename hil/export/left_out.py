"""What a robot description has no place for, in words: said on the terminal and in the file, never dropped silently."""

from hil.arm_model import ArmModel

MEANING = {
    "armature": "inertia of the rotor through the gears, seen by its own joint only",
    "offset": "constant torque",
    "coulomb_width": "width of the Coulomb step",
    "stribeck_rise": "friction at low speed above Coulomb, as a fraction of it",
    "stribeck_velocity": "velocity where that rise has fallen off",
    "load": "friction per motor torque",
    "presliding_stiffness": "of the spring as which dry friction yields before it slides",
    "presliding_damping": "of that spring",
    "viscous_asymmetry": "viscous friction that is more one way than the other",
    "ripple_sin": "torque ripple over the angle, sine part",
    "ripple_cos": "torque ripple over the angle, cosine part",
    "ripple_cycles": "its cycles per turn",
    "zero": "error of the joint's zero angle",
    "lag": "time constant of the current loop",
    "delay": "delay of the torque",
}
UNITS = {
    "armature": "kg m^2",
    "offset": "N m",
    "coulomb_width": "rad/s",
    "stribeck_rise": "",
    "stribeck_velocity": "rad/s",
    "load": "",
    "presliding_stiffness": "N m/rad",
    "presliding_damping": "N m s/rad",
    "viscous_asymmetry": "N m s/rad",
    "ripple_sin": "",
    "ripple_cos": "",
    "ripple_cycles": "",
    "zero": "rad",
    "lag": "s",
    "delay": "s",
}


def left_out(model: ArmModel, carried: tuple[str, ...] = ()) -> list[str]:
    """One sentence per parameter of the model that has a meaning here, unless the format has `carried` its kind."""
    said = []
    for name, value in model.values.items():
        kind = name.rstrip("0123456789").rstrip("_")
        if kind in MEANING and kind not in carried:
            amount = f"{value:.6g} {UNITS[kind]}".rstrip()
            said.append(f"{name} = {amount} ({MEANING[kind]})")
    return said


def torque_constants(model: ArmModel) -> list[str]:
    """One sentence per joint about its torque constant."""
    return [
        f"torque per goal of {joint.name} = {model.torque_per_goal(number):.6g} N m/{joint.goal_unit}"
        for number, joint in enumerate(model.joints, start=1)
    ]
