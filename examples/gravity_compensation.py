"""Hold a pose with a weak spring, with and without the identified model compensating gravity.

    python examples/gravity_compensation.py [RUN]

RUN is a run folder of `hil identify`; without it, the realistic fake arm is identified first. The printed errors are
the distances between the final pose and the desired one.
"""

import numpy as np
from control_loop import Array, Controller, identified_arm, play

STIFFNESS = np.array([1.5, 0.7])  # N m/rad
DAMPING = np.array([0.10, 0.05])  # N m s/rad
LIFT = np.array([0.8, 0.5])  # rad from the rest pose
MOVE, HOLD = 1.5, 1.5  # s


def main() -> None:
    config, model = identified_arm()
    rate = config.experiment.rate
    rest = np.array(model.rest_pose)
    count = len(rest)
    share = np.clip(np.arange(round((MOVE + HOLD) * rate)) / (MOVE * rate), 0.0, 1.0)
    wanted = rest + (share**2 * (3 - 2 * share))[:, None] * LIFT[:count]

    def spring(index: int, position: Array, speed: Array) -> Array:
        return np.asarray(STIFFNESS[:count] * (wanted[index] - position) - DAMPING[:count] * speed)

    def spring_and_model(index: int, position: Array, speed: Array) -> Array:
        return spring(index, position, speed) + model.gravity_torque(position)

    def sag(controller: Controller) -> Array:
        end = play(config, model, controller, len(wanted))[-1]
        return np.abs(end - wanted[-1])

    without, with_model = sag(spring), sag(spring_and_model)
    for joint, before, after in zip(model.joints, without, with_model, strict=True):
        print(
            f"{joint.name}: {1e3 * before:.1f} mrad off without the model, {1e3 * after:.1f} mrad with it: "
            f"{before / after:.1f} times smaller"
        )


if __name__ == "__main__":
    main()
