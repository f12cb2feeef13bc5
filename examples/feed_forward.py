"""Follow a trajectory with a weak PD controller, with and without the identified model as feed-forward.

    python examples/feed_forward.py [RUN]

RUN is a run folder of `hil identify`; without it, the realistic fake arm is identified first. The printed errors are
RMS differences between measured and desired position.
"""

import numpy as np
from control_loop import Array, Controller, identified_arm, play

STIFFNESS = np.array([4.0, 2.0])  # N m/rad
DAMPING = np.array([0.10, 0.05])  # N m s/rad
SECONDS = 6.0
FADE = 1.0  # s until the motion reaches its full amplitude


def trajectory(rest: Array, rate: float) -> tuple[Array, Array, Array]:
    """Desired angles, velocities and accelerations (samples, joints): two sines per joint, faded in from rest."""
    time = np.arange(-1, round(SECONDS * rate) + 1) / rate
    size = np.clip(time / FADE, 0.0, 1.0)
    size = size**3 * (10 - 15 * size + 6 * size**2)
    swing = [0.6 * np.sin(2 * np.pi * 0.5 * time) + 0.2 * np.sin(2 * np.pi * 1.1 * time)]
    swing += [0.7 * np.sin(2 * np.pi * 0.7 * time) - 0.2 * np.sin(2 * np.pi * 1.3 * time)]
    angle = rest + size[:, None] * np.stack(swing[: len(rest)], axis=1)
    velocity = np.gradient(angle, 1 / rate, axis=0)
    return angle[1:-1], velocity[1:-1], np.diff(angle, 2, axis=0) * rate**2


def main() -> None:
    config, model = identified_arm()
    rest = np.array(model.rest_pose)
    angle, velocity, acceleration = trajectory(rest, config.experiment.rate)
    # The torque that the motion needs according to the model, with friction at the desired velocity.
    known = model.inverse_dynamics(angle, velocity, acceleration)
    # A torque is sent with the next exchange, so shift by one sample.
    known = np.roll(known, -1, axis=0)

    def pd(index: int, position: Array, speed: Array) -> Array:
        stiffness, damping = STIFFNESS[: len(rest)], DAMPING[: len(rest)]
        return stiffness * (angle[index] - position) + damping * (velocity[index] - speed)

    def pd_and_model(index: int, position: Array, speed: Array) -> Array:
        return pd(index, position, speed) + known[index]

    def error(controller: Controller) -> Array:
        difference = play(config, model, controller, len(angle)) - angle
        return np.asarray(np.sqrt(np.mean(difference**2, axis=0)))

    without, with_model = error(pd), error(pd_and_model)
    for joint, before, after in zip(model.joints, without, with_model, strict=True):
        print(
            f"{joint.name}: {1e3 * before:.1f} mrad RMS without the model, {1e3 * after:.1f} mrad with it: "
            f"{before / after:.1f} times smaller"
        )


if __name__ == "__main__":
    main()
