"""Speed limit set by the supply: near no-load speed, the supply voltage cannot drive the commanded current.

If the currents fall short of their goals, no parameters can be identified from the run. In PWM mode the back-EMF is
part of the model, and no such limit is needed.
"""

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.drivers.servo_model import Mode

_SHARE = 0.85
"""Usable fraction of the no-load speed; the remaining voltage drives the current."""


def within_supply(config: Config) -> Config:
    """The configuration with each velocity_limit capped at what the servo's supply allows [rad/s].

    Nominal supply voltages are assumed. A fake servo whose motor is not limited by its supply has no such limit.
    """
    return slower(config, [_allowed(config, joint) for joint in config.joints])


def slower(config: Config, speed: list[float]) -> Config:
    """The configuration with each velocity_limit lowered to `speed` (joints,) [rad/s] if that is less."""
    joints = [
        joint if each >= joint.velocity_limit else joint.model_copy(update={"velocity_limit": float(f"{each:.2g}")})
        for joint, each in zip(config.joints, speed, strict=True)
    ]
    return config.model_copy(update={"joints": joints})


def lowered(before: Config, after: Config) -> tuple[str, ...]:
    """A tuple with one sentence that names the joints whose velocity_limit was lowered; empty if there are none."""
    pairs = zip(before.joints, after.joints, strict=True)
    now = [f"{new.name} {new.velocity_limit:g}" for old, new in pairs if old.velocity_limit != new.velocity_limit]
    if not now:
        return ()
    return (
        "At higher speeds the supply cannot drive the commanded current, so velocity_limit is lowered: "
        f"{', '.join(now)} rad/s.",
    )


def _allowed(config: Config, joint: JointConfig) -> float:
    if joint.drive_mode is not Mode.CURRENT:
        return float("inf")
    if config.is_fake and config.fake is not None:
        limited = {servo.id for servo in config.fake.servos if servo.voltage_limited}
        if not limited.intersection(joint.ids):
            return float("inf")
    return _SHARE * joint.joint.servo.no_load.speed
