"""mujoco.sysid on the recordings of benchmarks/chain.py; the extra `peers` installs it.

The arm is a MuJoCo model with the described geometry and masses. The unknowns are the pseudo-inertia of every link (10
parameters of a Cholesky factor relative to the description's), and armature, damping, friction loss and a constant
torque of every joint. There are about as many of them as parameters in hil's stage 2. The arm would fall in an
open-loop simulation, so the software spring and damper are part of the model, as an affine bias. The method gets every
advantage: the true lag, an initial state from the Fourier series of the period, an initial guess as close as hil's, its
own optimiser with rollouts on all cores, and two integration steps per sample.
"""

import io
import time
from contextlib import redirect_stdout
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hil.estimation.comparison.mujoco_peer import import_mujoco
from hil.estimator.chain.fit.stage1 import fit_lines
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.simulation.drive import motor_torque

Array = NDArray[np.float64]

STEPS = 2  # integration steps per sample
LAG = 1e-3  # s
MOST_ITERATIONS = 40
WIDEST = 2.0  # change of a link's coordinates; its masses may be off by a factor exp(4)
FRICTION = {"damping": (0.05, 1.0), "frictionloss": (0.05, 1.0), "armature": (0.01, 1.0), "offset": (0.02, 0.0)}
"""Unit of each joint's parameters [SI] and initial guess in that unit."""


def fit_chain_with_mujoco(
    period: SettledPeriod, base: BaseParameters, prior: Prior, described: Array
) -> tuple[Array, float, int]:
    """Return the base parameters [SI], the processor time [s] and the number of parameters.

    described: all parameters of the description (11 joints,) [SI]. Raises MissingExtra without mujoco[sysid].
    """
    mujoco, sysid = import_mujoco()
    joints = base.chain.joints
    links = described.reshape(joints, -1)[:, :10]
    spec = mujoco.MjSpec.from_string(_xml(period, base, links))
    model = spec.compile()
    parameters = sysid.ParameterDict()
    for joint in range(joints):
        zero = np.zeros(10)
        parameters.add(
            sysid.Parameter(f"link_{joint}", zero, zero - WIDEST, zero + WIDEST, modifier=_link_modifier(joint, links))
        )
        for term, (_, start) in FRICTION.items():
            low = -10.0 if term == "offset" else 1e-3
            parameters.add(
                sysid.Parameter(f"{term}_{joint}", start, low, 20.0, modifier=_modifier(term, joint)),
            )
    residual = sysid.build_residual_fn(models_sequences=[_sequences(sysid, spec, model, period, base, prior)])
    began = time.process_time()
    with redirect_stdout(io.StringIO()):  # it prints its iterations despite `verbose`
        found, _ = sysid.optimize(
            parameters, residual_fn=residual, optimizer="mujoco", verbose=False, max_iters=MOST_ITERATIONS
        )
    seconds = time.process_time() - began
    fitted = sysid.apply_param_modifiers(found, spec)
    return base.of_all(_links_of(fitted, joints)), seconds, int(found.size)


def _links_of(model: Any, joints: int) -> Array:
    """Return the parameters of MuJoCo's links and rotors (11 joints,) [SI]."""
    rows = np.empty((joints, 11))
    for joint in range(joints):
        body = model.body(f"link_{joint}")
        w, x, y, z = body.iquat
        turn = Rotation.from_quat([x, y, z, w]).as_matrix()
        mass, centre = float(body.mass[0]), np.array(body.ipos)
        inertia = turn @ np.diag(body.inertia) @ turn.T
        inertia += mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        upper = [inertia[r, c] for r in range(3) for c in range(r, 3)]
        rows[joint] = [mass, *(mass * centre), *upper, float(model.joint(f"joint_{joint}").armature[0])]
    return rows.reshape(-1)


def _sequences(sysid: Any, spec: Any, model: Any, period: SettledPeriod, base: BaseParameters, prior: Prior) -> Any:
    """Return commands and positions of the period as MuJoCo time series."""
    stabilised = period.stabiliser
    assert stabilised is not None  # the recordings of benchmarks/chain.py have one
    feedback = stabilised.feedback
    command = stabilised.excitation + (feedback.stiffness * feedback.pose)[:, None]
    steps = motor_torque(command, period.rate, period.command_to_sample, STEPS, delay=0.0, lag=LAG)
    torque = steps.reshape(base.chain.joints, -1)
    at = np.arange(torque.shape[1]) * model.opt.timestep
    control = sysid.TimeSeries(at, np.concatenate((torque, np.ones_like(torque))).T)
    motion = fit_lines([period], ChainModel(base), prior).motions[0]
    state = sysid.create_initial_state(model, motion.position[:, 0], motion.velocity[:, 0])
    position = sysid.TimeSeries.from_names(at[::STEPS], period.filled().T, model)
    return sysid.ModelSequences("arm", spec, "settled period", state, control, position)


def _xml(period: SettledPeriod, base: BaseParameters, links: Array) -> str:
    chain, stabilised = base.chain, period.stabiliser
    assert stabilised is not None
    bodies = ""
    for joint in range(chain.joints - 1, -1, -1):
        mass, moment, (xx, xy, xz, yy, yz, zz) = links[joint, 0], links[joint, 1:4], links[joint, 4:10]
        centre = moment / mass
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        about -= mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        full = _numbers(about[0, 0], about[1, 1], about[2, 2], about[0, 1], about[0, 2], about[1, 2])
        x, y, z, w = Rotation.from_matrix(chain.rotation[joint]).as_quat()
        bodies = (
            f'<body name="link_{joint}" pos="{_numbers(*chain.translation[joint])}" quat="{_numbers(w, x, y, z)}">'
            f'<joint name="joint_{joint}" type="hinge" axis="{_numbers(*chain.axis[joint])}" armature="0.01"/>'
            f'<inertial pos="{_numbers(*centre)}" mass="{float(mass)!r}" fullinertia="{full}"/>{bodies}</body>'
        )
    numbers, feedback = range(chain.joints), stabilised.feedback
    drives = "".join(
        f'<general name="motor_{j}" joint="joint_{j}" gainprm="1" biastype="affine" '
        f'biasprm="{_numbers(0.0, -feedback.stiffness[j], -feedback.damping[j])}"/>'
        for j in numbers
    )
    offsets = "".join(f'<motor name="offset_{j}" joint="joint_{j}"/>' for j in numbers)
    sensors = "".join(f'<jointpos name="position_{j}" joint="joint_{j}"/>' for j in numbers)
    return f"""<mujoco><option timestep="{1.0 / (STEPS * period.rate)!r}" gravity="{_numbers(*chain.gravity)}"
      integrator="implicitfast"><flag contact="disable"/></option><compiler angle="radian" balanceinertia="true"/>
      <worldbody>{bodies}</worldbody><actuator>{drives}{offsets}</actuator><sensor>{sensors}</sensor></mujoco>"""


def _numbers(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


def _link_modifier(joint: int, links: Array) -> Any:
    """Set a link's inertia from its coordinates: the pseudo-inertia is L U U' L', with L that of the description."""
    mass, moment, (xx, xy, xz, yy, yz, zz) = links[joint, 0], links[joint, 1:4], links[joint, 4:10]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    pseudo = np.empty((4, 4))
    pseudo[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    pseudo[:3, 3] = pseudo[3, :3] = moment
    pseudo[3, 3] = mass
    factor = np.linalg.cholesky(pseudo)

    def modify(spec: Any, parameter: Any) -> None:
        upper = np.diag(np.exp(parameter.value[:4]))
        upper[np.triu_indices(4, 1)] = parameter.value[4:]
        whole = factor @ upper
        whole = whole @ whole.T
        centre = whole[:3, 3] / whole[3, 3]
        about = whole[:3, :3] - whole[3, 3] * np.outer(centre, centre)
        second, axes = np.linalg.eigh(about)
        if np.linalg.det(axes) < 0.0:
            axes[:, 0] *= -1.0
        x, y, z, w = Rotation.from_matrix(axes).as_quat()
        body = spec.body(f"link_{joint}")
        body.mass, body.ipos, body.iquat = whole[3, 3], centre, [w, x, y, z]
        body.inertia = second.sum() - second
        body.fullinertia = np.full((6, 1), np.nan)

    return modify


def _modifier(term: str, joint: int) -> Any:
    unit = FRICTION[term][0]

    def modify(spec: Any, parameter: Any) -> None:
        value = unit * float(parameter.value[0])
        if term == "offset":
            spec.actuator(f"offset_{joint}").gear = [-value, 0, 0, 0, 0, 0]
            return
        hinge = spec.joint(f"joint_{joint}")
        # Since MuJoCo 4, damping also has terms of higher order in velocity.
        orders = np.size(getattr(hinge, term))
        setattr(hinge, term, value if orders == 1 else [value] + [0.0] * (orders - 1))

    return modify
