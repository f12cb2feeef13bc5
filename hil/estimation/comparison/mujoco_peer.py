"""mujoco.sysid on a settled period, for comparison; installed with the `peers` extra.

The arm is a MuJoCo model with one or two hinges. The unknowns are the first moment and inertia of each link, the
armature of joint 2, and each joint's damping, friction loss and constant torque, all scaled by expected values. The
method is given every advantage: an initial guess within 50 % of the expected values (from farther away, it does not
converge), the length of link 1, the initial state from the period's Fourier series, the delay found by hil's stage 1,
and mujoco.sysid's own optimiser with rollouts on all cores.
"""

import importlib
import io
import time
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.errors import MissingExtra
from hil.estimator.baselines.compare import Peer
from hil.estimator.data.joined_periods import joined
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.stage1 import LinearEstimate, fit_lines

STEPS = 2  # integration steps per sample
WITHIN = 0.5  # maximum relative error of the initial guess
BOUNDS = (0.02, 20.0)  # bounds relative to `centre`; offsets may have either sign


def import_mujoco() -> tuple[Any, Any]:
    """Return the modules mujoco and mujoco.sysid. Raises MissingExtra."""
    try:
        mujoco: Any = importlib.import_module("mujoco")
        sysid: Any = importlib.import_module("mujoco.sysid")
    except ImportError as error:
        raise MissingExtra("mujoco.sysid is not installed: pip install 'hil[peers]'.") from error
    if not hasattr(sysid, "optimize"):
        raise MissingExtra("mujoco is installed without its sysid extra: pip install 'hil[peers]'.")
    return mujoco, sysid


def fit_with_mujoco(period: SettledPeriod, centre: dict[str, float], length: float, gravity: float) -> Peer:
    """Fit with mujoco.sysid, starting from values drawn within 50 % of `centre` (base parameters by name [SI]).

    `length`: length of link 1 [m]. `gravity`: acceleration of gravity [m/s^2]. Raises MissingExtra if mujoco[sysid] is
    not installed.
    """
    mujoco, sysid = import_mujoco()
    linear = fit_lines(period)
    arm = _Arm.of(centre, period.joints, length, gravity)
    spec = mujoco.MjSpec.from_string(_xml(arm, 1.0 / (STEPS * period.rate)))
    random = np.random.default_rng(1)
    parameters = sysid.ParameterDict()
    for name, value in arm.values.items():
        low, high = (-BOUNDS[1], BOUNDS[1]) if name.startswith("offset") else BOUNDS
        parameter = sysid.Parameter(name, 1.0, low, high, modifier=_modifier(name, value))
        parameter.value[:] = 1.0 + WITHIN * random.uniform(-1.0, 1.0)
        parameters.add(parameter)
    residual = sysid.build_residual_fn(models_sequences=[_sequences(mujoco, sysid, spec, period, linear)])
    began = time.perf_counter()
    with redirect_stdout(io.StringIO()):  # it prints its iterations despite `verbose`
        found, result = sysid.optimize(parameters, residual_fn=residual, optimizer="mujoco", verbose=False)
    seconds = time.perf_counter() - began
    left = residual(result.x, found)[0]
    covariance = sysid.calculate_intervals(left, np.asarray(result.jac).reshape(-1, result.x.size))[0]
    values = np.array(list(arm.values.values()))
    base = arm.base(values * result.x)
    # The base parameters are almost linear in MuJoCo's: finite differences transform the covariance.
    names = list(base)
    slope = np.stack(
        [
            [arm.base(values * (result.x + 1e-6 * row))[name] / 1e-6 - base[name] / 1e-6 for name in names]
            for row in np.eye(values.size)
        ],
        axis=1,
    )
    std = np.sqrt(np.diag(slope @ covariance @ slope.T))
    settings = f"initial guess within {100 * WITHIN:.0f} %, {values.size} parameters, {STEPS} steps per sample"
    return Peer(
        "mujoco_sysid",
        base | {"delay": linear.delay},
        dict(zip(names, std.tolist(), strict=True)),
        seconds,
        settings,
        1,
    )


@dataclass(frozen=True)
class _Arm:
    """The arm in MuJoCo's quantities; the masses are arbitrary, since only the moments are identifiable."""

    masses: tuple[float, ...]
    values: dict[str, float]
    """First moments [kg m], inertias about the centres of mass [kg m^2], armature and friction, in optimiser order."""
    length: float
    gravity: float

    @classmethod
    def of(cls, base: dict[str, float], joints: int, length: float, gravity: float) -> "_Arm":
        moment_1, inertia_1 = base["gravity_1"] / gravity, base["inertia_1"]
        values: dict[str, float] = {}
        masses: tuple[float, ...] = ()
        if joints == 2:
            moment_2 = base["gravity_2"] / gravity
            mass_2 = 1.4 * moment_2**2 / base["inertia_2"]
            values |= {"moment_2": moment_2, "inertia_2": base["inertia_2"] - moment_2**2 / mass_2}
            values["armature_2"] = base["armature_2"]
            moment_1 -= mass_2 * length
            inertia_1 -= mass_2 * length**2
            masses = (mass_2,)
        mass_1 = 4.0 * moment_1**2 / inertia_1
        values |= {"moment_1": moment_1, "inertia_1": inertia_1 - moment_1**2 / mass_1}
        for joint in range(1, joints + 1):
            values |= {f"{term}_{joint}": base[f"{term}_{joint}"] for term in ("viscous", "coulomb", "offset")}
        return cls((mass_1, *masses), values, length, gravity)

    def base(self, values: NDArray[np.float64]) -> dict[str, float]:
        """Base parameters [SI] for these values of MuJoCo's quantities."""
        own = dict(zip(self.values, values.tolist(), strict=True))
        base = {name: value for name, value in own.items() if not name.startswith(("moment", "inertia"))}
        moment, inertia = own["moment_1"], own["inertia_1"] + own["moment_1"] ** 2 / self.masses[0]
        if len(self.masses) == 2:
            base["coupling"] = self.length * own["moment_2"]
            base["inertia_2"] = own["inertia_2"] + own["moment_2"] ** 2 / self.masses[1]
            base["gravity_2"] = own["moment_2"] * self.gravity
            moment += self.masses[1] * self.length
            inertia += self.masses[1] * self.length**2
        return base | {"inertia_1": inertia, "gravity_1": moment * self.gravity}


def _sequences(mujoco: Any, sysid: Any, spec: Any, period: SettledPeriod, linear: LinearEstimate) -> Any:
    model = spec.compile()
    steps = STEPS * period.samples
    at = np.arange(steps) * model.opt.timestep
    torque = joined(period, 1).mean_torque(np.append(at, at[-1] + model.opt.timestep), linear.delay)
    control = sysid.TimeSeries(at, np.concatenate((torque, np.ones_like(torque))).T)
    state = sysid.create_initial_state(model, linear.motion.position[:, 0], linear.motion.velocity[:, 0])
    position = sysid.TimeSeries.from_names(at[::STEPS], period.filled().T, model)
    return sysid.ModelSequences("arm", spec, "settled period", state, control, position)


def _xml(arm: _Arm, step: float) -> str:
    bodies = ""
    for joint in range(len(arm.masses), 0, -1):
        bodies = f'''<body name="link_{joint}" pos="{arm.length if joint == 2 else 0} 0 0">
          <joint name="joint_{joint}" type="hinge" axis="0 -1 0"/>
          <inertial pos="0.1 0 0" mass="{arm.masses[joint - 1]!r}" diaginertia="0.01 0.01 0.01"/>{bodies}</body>'''
    names = range(1, len(arm.masses) + 1)
    motors = "".join(f'<motor name="motor_{j}" joint="joint_{j}"/>' for j in names)
    offsets = "".join(f'<motor name="offset_{j}" joint="joint_{j}"/>' for j in names)
    sensors = "".join(f'<jointpos name="position_{j}" joint="joint_{j}"/>' for j in names)
    return f'''<mujoco><option timestep="{step!r}" gravity="0 0 {-arm.gravity}" integrator="implicitfast">
      <flag contact="disable"/></option><compiler angle="radian"/><worldbody>{bodies}</worldbody>
      <actuator>{motors}{offsets}</actuator><sensor>{sensors}</sensor></mujoco>'''


def _modifier(name: str, unit: float) -> Any:
    term, joint = name.rsplit("_", 1)

    def modify(spec: Any, parameter: Any) -> None:
        value = unit * float(parameter.value[0])
        if term == "moment":
            body = spec.body(f"link_{joint}")
            body.ipos = [value / float(body.mass), 0.0, 0.0]
        elif term == "inertia":
            spec.body(f"link_{joint}").inertia = [value] * 3
        elif term == "offset":
            spec.actuator(name).gear = [-value, 0, 0, 0, 0, 0]
        else:
            hinge, field = spec.joint(f"joint_{joint}"), _JOINT_FIELDS[term]
            # Since MuJoCo 4, damping also has terms of higher order in velocity.
            orders = np.size(getattr(hinge, field))
            setattr(hinge, field, value if orders == 1 else [value] + [0.0] * (orders - 1))

    return modify


_JOINT_FIELDS = {"viscous": "damping", "coulomb": "frictionloss", "armature": "armature"}
