"""A MuJoCo model (MJCF) as a plant (`pip install hil[mujoco]`).

    [fake]
    plant = "hil.fakes.plants.mujoco_plant:make_plant"
    plant_options = { model = "arm.xml", joints = ["shoulder", "elbow"], torque_constant = [1.8, 1.8] }

Friction, armature and limits are those of the model's joints; its actuators are not used. The motor torque, current
times torque constant, is applied directly to the joint.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.fakes.plants.errors import PlantError

try:
    import mujoco
except ImportError as error:
    raise PlantError("MuJoCo is not installed: pip install hil[mujoco], or pip install mujoco") from error


class MujocoPlant:
    """A plant simulated by MuJoCo in steps of at most the model's `timestep`; see `hil.fakes.plants.plant.Plant`."""

    def __init__(self, model: Any, joints: Sequence[str], torque_constant: Sequence[float], current_lag: float) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        indices = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in joints]
        self._position_at = [int(model.jnt_qposadr[index]) for index in indices]
        self._velocity_at = [int(model.jnt_dofadr[index]) for index in indices]
        self._torque_constant = np.array(torque_constant)
        self._lag = current_lag
        self._step = float(model.opt.timestep)
        self._current = np.zeros(len(joints))
        self._jammed = [False] * len(joints)
        self._held_at: list[float | None] = [None] * len(joints)
        mujoco.mj_forward(model, self._data)

    @property
    def joints(self) -> int:
        return len(self._position_at)

    @property
    def position(self) -> Sequence[float]:
        return [float(self._data.qpos[at]) for at in self._position_at]

    @property
    def velocity(self) -> Sequence[float]:
        return [float(self._data.qvel[at]) for at in self._velocity_at]

    @property
    def current(self) -> Sequence[float]:
        return [float(current) for current in self._current]

    def jam(self, joint: int, jammed: bool) -> None:
        self._jammed[joint] = jammed

    def hold(self, joint: int, velocity: float | None) -> None:
        self._held_at[joint] = velocity

    def advance(self, until: float, current: Sequence[float]) -> None:
        remaining = until - self._data.time
        if remaining <= 0.0:
            return
        steps = max(1, int(np.ceil(remaining / self._step - 1e-9)))
        self._model.opt.timestep = remaining / steps
        for _ in range(steps):
            self._one_step(remaining / steps, np.asarray(current, dtype=float))
        self._data.time = until  # avoids accumulated rounding errors

    def _one_step(self, step: float, command: Any) -> None:
        left = np.exp(-step / self._lag) if self._lag else 0.0
        self._current = command + (self._current - command) * left
        self._data.qfrc_applied[self._velocity_at] = self._torque_constant * self._current
        held = {at: self._data.qpos[at] for at, jammed in zip(self._position_at, self._jammed, strict=True) if jammed}
        before = [float(self._data.qpos[at]) for at in self._position_at]
        mujoco.mj_step(self._model, self._data)
        for joint, (position_at, velocity_at) in enumerate(zip(self._position_at, self._velocity_at, strict=True)):
            if self._jammed[joint]:
                self._data.qpos[position_at] = held[position_at]
                self._data.qvel[velocity_at] = 0.0
            elif (velocity := self._held_at[joint]) is not None:
                self._data.qpos[position_at] = before[joint] + velocity * step
                self._data.qvel[velocity_at] = velocity


def make_plant(
    model: str, joints: Sequence[str], torque_constant: Sequence[float], current_lag: float = 0.0
) -> MujocoPlant:
    """Create the plant from a MuJoCo model.

    model: path of the MJCF file, or its text.
    joints: names of hinge joints in the order of the servos.
    torque_constant: torque per current of each joint [N m/A].
    current_lag: time constant of the first-order current loop [s].
    Raises PlantError.
    """
    is_text = model.lstrip().startswith("<")
    try:
        compiled = mujoco.MjModel.from_xml_string(model) if is_text else mujoco.MjModel.from_xml_path(model)
    except ValueError as error:
        raise PlantError(f"model = {'text' if is_text else model}: {error}") from error
    known = [
        mujoco.mj_id2name(compiled, mujoco.mjtObj.mjOBJ_JOINT, index)
        for index in range(compiled.njnt)
        if compiled.jnt_type[index] == mujoco.mjtJoint.mjJNT_HINGE
    ]
    for name in joints:
        if name not in known:
            raise PlantError(f'joints: the model has no hinge "{name}"; it has {", ".join(map(str, known)) or "none"}')
    if len(torque_constant) != len(joints):
        raise PlantError(f"torque_constant has {len(torque_constant)} entries for {len(joints)} joints")
    return MujocoPlant(compiled, joints, torque_constant, current_lag)
