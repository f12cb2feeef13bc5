"""Random spatial arms with three to six joints, identified on the fake bus from a description whose masses are 30 %
off.

    python benchmarks/spatial/chain_population.py --arms 60 [--first 0] [--plain] [--json]

Axes, lengths, masses, servos, rest pose and limits are drawn at random; the real arm's masses differ from the URDF's by
30 %, its centres of mass by 5 mm, its torque constants by 3 %. Unless `--plain` is given, the files also vary in style
as those of different authors do: axes in any direction, turned joint frames, meshes and boxes as collision geometry,
fixed tool frames, a gripper with two prismatic fingers, one mimicking the other, a tilted base, and `friction =
"auto"`.

The script counts runs that finish with a result, collisions of the recorded motion with the arm itself or the floor,
exceeded position limits, and results that say "yes" although they are wrong: the rigid-body torque on random motions is
off by more than 2 % and three standard errors for some joint, or more than a tenth of the parameters are off by more
than four standard errors. Like the results, true values are in units of the first joint's torque constant. A run that
the dry run refuses as unsafe does not count as finished.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np

import hil
from benchmarks.spatial.judgement import WRONG_SHARE, WRONG_STDS, WRONG_TORQUE, judged, measured
from hil.clearance.space import Space
from hil.config.schema import load_config
from hil.drivers.errors import DriverError
from hil.drivers.servo_model import servo_model
from hil.drivers.servo_prior import servo_prior
from hil.errors import HilError
from hil.estimator.chain.simulation.rollout import ChainArms, weights
from hil.estimator.errors import EstimationError
from hil.plan.chain_model import KnownChain, known_chain

SPREAD = 0.3
STOP_ROOM = 0.06  # rad between the rest pose and the limit next to it
TRIES = 200
HEADROOM = 2.5  # times a joint's own largest weight
SERVOS = (("XM430-W350", 1.8, 1.4), ("XM540-W270", 2.41, 3.5))
"""Model, torque constant [N m/A], largest current [A]."""


@dataclass(frozen=True)
class Style:
    """How a file is written. turned: axes in any direction and turned frames. shape: type of collision geometry."""

    turned: bool = False
    shape: str = "cylinder"
    gripper: bool = False
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    friction: str = "stribeck"

    @classmethod
    def draw(cls, random: np.random.Generator) -> "Style":
        """Draw a style."""
        tilt = tuple(random.uniform(-0.5, 0.5, 2).round(3).tolist()) if random.random() < 0.3 else (0.0, 0.0)
        return cls(
            bool(random.random() < 0.5),
            str(random.choice(["cylinder", "box", "mesh"])),
            bool(random.random() < 0.5),
            (*tilt, 0.0),
            str(random.choice(["auto", "stribeck"])),
        )


def box_mesh(width: float, length: float) -> bytes:
    """Return a binary STL file of a box about the z axis [m]."""
    corners = [np.array([x * width, y * width, z * length]) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)]
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    rows = [
        np.concatenate((np.zeros(3), *(corners[k] for k in face))).astype("<f4").tobytes() + b"\0\0" for face in faces
    ]
    return b"\0" * 80 + len(faces).to_bytes(4, "little") + b"".join(rows)


def collision_of(style: Style, folder: Path, name: str, radius: float, length: float) -> str:
    """Return a link's collision element; a mesh is written to its file."""
    if style.shape == "mesh":
        (folder / f"{name}.stl").write_bytes(box_mesh(2e3 * radius, 1e3 * length))
        return f'<collision><geometry><mesh filename="{name}.stl" scale="0.001 0.001 0.001"/></geometry></collision>'
    sizes = {
        "cylinder": f'cylinder radius="{radius:.4f}" length="{length:.4f}"',
        "box": f'box size="{2 * radius:.4f} {2 * radius:.4f} {length:.4f}"',
    }
    return f'<collision><origin xyz="0 0 {0.5 * length:.4f}"/><geometry><{sizes[style.shape]}/></geometry></collision>'


def axis_of(random: np.random.Generator, style: Style, joint: int) -> str:
    """Return a joint's axis: the first is vertical, the others mostly perpendicular to their link."""
    axis = np.array([0, 0, 1] if joint == 1 else ([0, 1, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1])[random.integers(4)])
    if style.turned:
        axis = axis * random.choice([-1.0, 1.0]) + (0.2 * random.standard_normal(3) if random.random() < 0.3 else 0.0)
        axis = axis / np.linalg.norm(axis)
    return " ".join(f"{each:.9g}" for each in axis)


GRIPPER = (
    '<joint name="tool" type="fixed"><parent link="l{last}"/><child link="palm"/>'
    '<origin xyz="0 0 {reach:.4f}"/></joint>'
    '<link name="palm"><inertial><origin xyz="0 0 0.01"/><mass value="0.03"/>'
    '<inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="left" type="prismatic"><parent link="palm"/><child link="left_finger"/><axis xyz="0 1 0"/>'
    '<limit lower="0" upper="0.02" velocity="1" effort="1"/></joint><link name="left_finger"><inertial>'
    '<mass value="0.01"/><inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="right" type="prismatic"><parent link="palm"/><child link="right_finger"/><axis xyz="0 -1 0"/>'
    '<limit lower="0" upper="0.02" velocity="1" effort="1"/><mimic joint="left"/></joint><link name="right_finger">'
    '<inertial><mass value="0.01"/>'
    '<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="camera_joint" type="fixed"><parent link="palm"/><child link="camera"/></joint><link name="camera"/>'
)


def urdf_of(random: np.random.Generator, joints: int, style: Style, folder: Path) -> str:
    """Draw links of 8 to 20 cm."""
    parts = ['<robot name="random"><link name="base"><collision><origin xyz="0 0 0.02"/><geometry>']
    parts.append('<cylinder radius="0.04" length="0.04"/></geometry></collision></link>')
    reach = 0.07
    for joint in range(1, joints + 1):
        length, radius = random.uniform(0.08, 0.2) * (1.0 if joint < joints else 0.7), random.uniform(0.015, 0.025)
        mass = random.uniform(0.8, 1.6) * length
        axis = axis_of(random, style, joint)
        yaw = random.uniform(-np.pi, np.pi) if style.turned else 0.0
        across, along = mass * (3 * radius**2 + length**2) / 12, 0.5 * mass * radius**2
        parts.append(
            f'<joint name="j{joint}" type="revolute"><parent link="{"base" if joint == 1 else f"l{joint - 1}"}"/>'
            f'<child link="l{joint}"/><origin xyz="0 0 {reach:.4f}" rpy="0 0 {yaw:.6f}"/><axis xyz="{axis}"/>'
            '<limit lower="-3" upper="3" velocity="5" effort="5"/></joint>'
            f'<link name="l{joint}"><inertial><origin xyz="0.005 0.003 {0.5 * length:.4f}"/><mass value="{mass:.4f}"/>'
            f'<inertia ixx="{across:.3e}" iyy="{across:.3e}" izz="{along:.3e}" ixy="0" ixz="0" iyz="0"/></inertial>'
            + collision_of(style, folder, f"l{joint}", radius, length - radius)
            + "</link>"
        )
        reach = length
    if style.gripper:
        parts.append(GRIPPER.format(last=joints, reach=reach))
    return "".join(parts) + "</robot>"


def toml_of(
    random: np.random.Generator, joints: int, rest: Any, limits: Any, servos: Any, stops: Any, style: Style
) -> str:
    """Write the arm's file; without hard stops if `stops` is None."""
    text = ['[port]\nurl = "fake://"\nbaud = 3_000_000\n']
    for joint in range(joints):
        model, constant, current = servos[joint]
        low, high = limits[joint]
        text.append(
            f'[[joints]]\nname = "j{joint + 1}"\nid = {joint + 1}\nmodel = "{model}"\nzero_ticks = 2048\n'
            f"torque_constant = {constant}\ntorque_constant_std = {0.05 * constant:.3f}\n"
            f"position_limit = [{low:.4f}, {high:.4f}]\nvelocity_limit = 5.0\ncurrent_limit = {current}\n"
        )
    pose = [round(float(each), 4) for each in rest]
    text.append(f'[arm]\nurdf = "arm.urdf"\nrest_pose = {pose}\nbase = {list(style.tilt)}\n')
    text.append("[experiment]\npilot = true\nrate = 400.0\nperiod = 10.0\nband = [0.1, 1.5]\nramp = 3.0\n")
    text.append(
        f'[model]\nfriction = "{style.friction}"\ndrive = "lag"\n\n[fake]\nseed = 1\nadapter_latency_us = 60.0\n'
    )
    for joint in range(joints):
        text.append(
            f'[[fake.servos]]\nid = {joint + 1}\nmodel = "{servos[joint][0]}"\nbaud = 3_000_000\nzero_ticks = 2048\n'
        )
    scale = np.exp(np.sqrt(np.log1p(SPREAD**2)) * random.standard_normal(joints)).round(3).tolist()
    names = ", ".join(f'"j{joint + 1}"' for joint in range(joints))
    text.append(f'[fake.chain]\nurdf = "arm.urdf"\njoints = [{names}]\nstart = {pose}\nmass_scale = {scale}')
    text.append(f"base = {list(style.tilt)}")
    text.append(f"centre_shift = {(0.005 * random.standard_normal(joints)).round(4).tolist()}\n")
    for joint in range(joints):
        model, constant, _ = servos[joint]
        prior = servo_prior(servo_model(model))
        drawn = {
            key: guess.median * float(np.exp(0.3 * random.standard_normal()))
            for key, guess in (("viscous", prior.viscous), ("coulomb", prior.coulomb), ("armature", prior.armature))
        }
        text.append(
            f"[[fake.chain.drives]]\nmass = 0.0\nrotor_inertia = {drawn['armature'] / 9e4:.4g}\ngear_ratio = 300.0\n"
            f"torque_constant = {constant * (1 + 0.03 * random.standard_normal()):.4f}\ncurrent_lag = 1e-3\n"
            f"viscous = {drawn['viscous']:.4g}\ncoulomb = {drawn['coulomb']:.4g}\nstribeck_rise = 0.3\n"
            + ("" if stops[joint] is None else f"stops = [{stops[joint][0]:.4f}, {stops[joint][1]:.4f}]\n")
        )
    return "\n".join(text) + "\n"


def draw(folder: Path, seed: int, plain: bool = False) -> Path:
    """Draw an arm and a rest pose in which the arm touches neither itself nor the floor; return its file."""
    random = np.random.default_rng((17, seed))
    style = Style() if plain else Style.draw(np.random.default_rng((18, seed)))
    joints = int(random.integers(3, 7))
    path = folder / "arm.toml"
    for _ in range(TRIES):
        (folder / "arm.urdf").write_text(urdf_of(random, joints, style, folder), encoding="utf-8")
        rest = random.uniform(-1.2, 1.2, joints)
        free = [(float(each) - 3.0, float(each) + 3.0) for each in rest]
        path.write_text(
            toml_of(random, joints, rest, free, [SERVOS[1]] * joints, [None] * joints, style), encoding="utf-8"
        )
        config = load_config(path)
        known = known_chain(config)
        pressed, most = _weights(known, rest, random)
        if (HEADROOM * most > [s[1] * s[2] for s in [SERVOS[1]] * joints]).any():
            continue
        if Space.of(config).nearest(rest[:, None]).distance < 0.02:
            continue
        servos = [SERVOS[0] if HEADROOM * each < SERVOS[0][1] * SERVOS[0][2] else SERVOS[1] for each in most]
        spans = random.uniform(1.4, 2.6, (joints, 2))
        limits, stops = [], []
        for angle, weight, (below, above) in zip(rest, pressed, spans, strict=True):
            low, high, stop = angle - below, angle + above, None
            if weight > 0.02:
                low, stop = angle - STOP_ROOM, (angle, angle + 4.0)
            elif weight < -0.02:
                high, stop = angle + STOP_ROOM, (angle - 4.0, angle)
            limits.append((low, high))
            stops.append(stop)
        path.write_text(toml_of(random, joints, rest, limits, servos, stops, style), encoding="utf-8")
        return path
    raise RuntimeError(f"no arm for seed {seed}")


def _weights(known: KnownChain, rest: Any, random: np.random.Generator) -> tuple[Any, Any]:
    """Torques that hold the described arm in its rest pose, and the largest holding torques in random poses (joints,)
    [N m].
    """
    n = len(rest)
    arm = ChainArms(known.base, known.base.of_all(known.described)[None], np.zeros((1, 6, n)))
    poses = random.uniform(-2.5, 2.5, (60, n))
    return weights(arm, rest)[0], np.max([np.abs(weights(arm, pose)[0]) for pose in poses], axis=0)


def identified(seed: int, plain: bool = False) -> dict[str, Any]:
    """Identify one arm; return the outcome."""
    with tempfile.TemporaryDirectory() as folder:
        path = draw(Path(folder), seed, plain)
        config = load_config(path)
        row: dict[str, Any] = {"seed": seed, "joints": len(config.joints)}
        started = time.process_time()
        run = Path(folder) / "run"
        try:
            found = hil.identify(path, out=run)
            row |= {"ended": "", "trust": found.verdict.trust, "steps": len(found.steps or ())}
            row["residual_ticks"] = round(max(found.fit.residual_rms_ticks), 3)
            row["held_out_percent"] = round(100 * max(found.validation.held_out_rms or (np.nan,)), 2)
            row |= judged(config, found)
        except (HilError, DriverError, EstimationError) as error:
            row["ended"] = f"{type(error).__name__}: {str(error)[:200]}"
        row["cpu_seconds"] = round(time.process_time() - started, 1)
        if any(run.rglob("samples.npy")):
            row |= measured(config, run)
        return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--arms", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--plain", action="store_true", help="use only files in our own style")
    parser.add_argument("--json", action="store_true", help="print only the summary, as JSON")
    options = parser.parse_args()
    rows = []
    for seed in range(options.first, options.first + options.arms):
        rows.append(identified(seed, options.plain))
        if not options.json:
            print(json.dumps(rows[-1]), flush=True)
    finished = [row for row in rows if not row["ended"]]
    print(
        json.dumps(
            {
                "arms": len(rows),
                "finished_percent": 100 * len(finished) / len(rows),
                "collisions": sum(row.get("least_m", 1.0) < 0.0 for row in rows),
                "yes_percent": 100 * sum(row["trust"] == "yes" for row in finished) / max(1, len(finished)),
                "yes_but_wrong": sum(
                    row["trust"] == "yes"
                    and (
                        (row["torque_error_percent"] > WRONG_TORQUE and row["torque_error_stds"] > WRONG_STDS)
                        or row["beyond_4"] > WRONG_SHARE
                    )
                    for row in finished
                ),
                "limits_passed": sum(row.get("excess_rad", -1.0) > 0.0 for row in rows),
            }
        )
    )


if __name__ == "__main__":
    main()
