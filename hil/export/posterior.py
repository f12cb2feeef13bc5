"""Arms drawn from the posterior of an identification, for domain randomisation: one file per arm, one table for all.

The parameters are drawn from a normal distribution with the estimated covariance. A factor common to all torques is
also drawn, because the torque constants are known far less accurately than anything else. The motion reveals the ratios
of the joints' constants, so only a common factor remains unknown; its uncertainty is that of the best-known joint's
constant. The torque per goal (in A or V) is scaled with it, so that all drawn arms respond to the same goals in the
same way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hil.arm_model import ArmModel
from hil.chain_model import ChainArmModel
from hil.errors import ExportError, RunFolderError
from hil.estimator.arrays import Array
from hil.estimator.models.terms import kind_of
from hil.export.chain_links import NOT_EXACT
from hil.export.mjcf import export_mjcf
from hil.export.source import MissingPackages, Source
from hil.export.urdf import export_urdf

FORMATS = {"mjcf": (export_mjcf, "xml"), "urdf": (export_urdf, "urdf")}
TABLE = "arms.parquet"
MOST_SAMPLES = 100_000
_TRIES = 20
"""Maximum number of rounds in which draws without physically possible masses are replaced."""

_FRICTION = ("viscous", "coulomb")
_LEAST_WIDTH = 1e-4
"""Smallest width of a drawn arm's Coulomb step [rad/s]: practically the same as true stiction."""
_POSES = 20
"""Number of poses in which the mass matrix of a drawn spatial arm must be positive definite."""

_WITH_TORQUE = ("N", "kg")
"""First letters of the units of parameters that scale with the torque constant: torques, masses and their moments."""


@dataclass(frozen=True)
class Drawn:
    """Arms drawn from one result.

    values: parameters (samples, names) [SI]. torque_factor: common torque factor (samples,), with a mean of 1. redrawn:
    number of draws without physically possible masses, which were replaced. inexact: number of arms whose files are not
    dynamically equivalent to what was drawn.
    """

    models: tuple[ArmModel, ...]
    names: tuple[str, ...]
    values: Array
    torque_factor: Array
    redrawn: int
    inexact: int = 0


def draw_arms(source: Source, samples: int, seed: int = 1, *, torque_constants: bool = True) -> Drawn:
    """Draw arms whose parameters have the result's mean and covariance. Raises ExportError.

    torque_constants: if false, the torque constants are not varied.
    """
    if not 2 <= samples <= MOST_SAMPLES:
        raise ExportError(f"--samples {samples}: must be from 2 to {MOST_SAMPLES}.")
    names, mean, covariance = _posterior(source)
    rng = np.random.default_rng(seed)
    values = mean + _matched(rng, samples, len(names)) @ _root(covariance).T
    values, redrawn = _physical(source, names, mean, covariance, values, rng)
    width = np.array([kind_of(name) == "coulomb_width" for name in names])
    values = np.where(width, np.maximum(values, _LEAST_WIDTH), values)
    spread = _torque_spread(source.model) if torque_constants else 0.0
    factor = np.exp(spread * _matched(rng, samples, 1)[:, 0])
    factor /= factor.mean()
    scaled = np.array([source.result.quantities[name].unit.startswith(_WITH_TORQUE) for name in names])
    values = np.where(scaled, values * factor[:, None], values)
    models = tuple(_model(source.model, names, row, each) for row, each in zip(values, factor, strict=True))
    return Drawn(models, names, values, factor, redrawn)


def export_samples(
    run: Path, formats: Sequence[str], out: Path, samples: int, seed: int = 1, link_length: float | None = None
) -> Drawn:
    """Draw arms from the posterior and write them to the folder `out`: arm_0000.xml or .urdf and so on, and
    arms.parquet.

    Raises ExportError, ResultError, RunFolderError.
    """
    unknown = [name for name in formats if name not in (*FORMATS, "parquet")]
    if unknown:
        raise ExportError(f"--samples writes mjcf, urdf and parquet, not {unknown[0]!r}.")
    source = Source.open(run, link_length)
    drawn = draw_arms(source, samples, seed)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"{out} cannot be created: {error.strerror}.") from error
    _nothing_older(formats, out, samples)
    inexact = set()
    for name in sorted(formats, key=lambda name: name == "parquet"):  # last, as its package may be missing
        if name == "parquet":
            _write_table(source, drawn, out / TABLE)
            continue
        write, ending = FORMATS[name]
        for number, model in enumerate(drawn.models):
            left = write(replace(source, model=model), out / f"arm_{number:04d}.{ending}")
            if any(each.startswith(NOT_EXACT) for each in left):
                inexact.add(number)
    return replace(drawn, inexact=len(inexact))


def _nothing_older(formats: Sequence[str], out: Path, samples: int) -> None:
    """Raise ExportError if arms from an earlier draw would remain in the folder next to the new ones."""
    for name in formats:
        if name in FORMATS:
            ending = FORMATS[name][1]
            older = [path for path in out.glob(f"arm_*.{ending}") if path.stem[4:].isdigit()]
            remaining = sum(int(path.stem[4:]) >= samples for path in older)
            if remaining:
                raise ExportError(
                    f"{out} holds {len(older)} arms from an earlier draw, and {remaining} of them would remain: give "
                    "another --out, or remove them."
                )


def _posterior(source: Source) -> tuple[tuple[str, ...], Array, Array]:
    """Names, mean (names,) and covariance (names, names) [SI]. Raises ExportError if the covariance is not finite."""
    result = source.result
    covariance = result.covariance.array()
    unseen = [name for name, row in zip(result.covariance.names, covariance, strict=True) if not np.isfinite(row).all()]
    if unseen:
        raise ExportError(
            f"The recording contains no information about {', '.join(unseen)}, so there is no distribution to draw "
            "from. Identify again with more motion, or export without --samples."
        )
    mean = np.array([result.quantities[name].value for name in result.covariance.names])
    return result.covariance.names, mean, covariance


def _root(covariance: Array) -> Array:
    """A matrix A with A A^T = covariance. The covariance may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    root: Array = safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _matched(rng: np.random.Generator, samples: int, count: int) -> Array:
    """Standard normal draws (samples, count), with exactly zero mean and unit covariance if there are enough draws."""
    z = rng.standard_normal((samples, count))
    if samples <= count + 1:
        return z
    z -= z.mean(axis=0)
    left, _, right = np.linalg.svd(z, full_matrices=False)
    matched: Array = left @ right * np.sqrt(samples - 1)
    return matched


def _physical(
    source: Source, names: tuple[str, ...], mean: Array, covariance: Array, values: Array, rng: np.random.Generator
) -> tuple[Array, int]:
    """Redraw every arm that has a negative inertia or friction, or no physically possible masses. Return the draws and
    the number of arms replaced.
    """
    root, redrawn = _root(covariance), 0
    for _ in range(_TRIES):
        bad = [index for index, row in enumerate(values) if not _is_physical(_model(source.model, names, row, 1.0))]
        if not bad:
            return values, redrawn
        redrawn += len(bad)
        values[bad] = mean + rng.standard_normal((len(bad), len(names))) @ root.T
    raise ExportError(
        "The uncertainty is so large that most draws do not have positive masses and friction: identify again with "
        "more motion."
    )


def _is_physical(model: ArmModel) -> bool:
    p = model.values
    if isinstance(model, ChainArmModel):
        # Its base parameters are sums of either sign: the mass matrix shows whether any links have them.
        poses = np.random.default_rng(_POSES).uniform(-np.pi, np.pi, (_POSES, len(model.joints)))
        friction = [value for name, value in p.items() if kind_of(name) in _FRICTION]
        return min(friction) >= 0.0 and bool(np.linalg.eigvalsh(model.mass_matrix(poses)).min() > 0.0)
    positive = [
        value for name, value in p.items() if name.startswith(("inertia", "armature", "viscous_1", "viscous_2"))
    ]
    positive += [value for name, value in p.items() if name.startswith("coulomb")]
    coupled = p.get("coupling", 0.0) ** 2 < p["inertia_1"] * p.get("inertia_2", np.inf)
    return min(positive) >= 0.0 and coupled


def _torque_spread(model: ArmModel) -> float:
    """Relative standard deviation of the common torque factor: that of the best-known joint; 0 if none is known."""
    known = [joint.torque_per_goal_std / joint.torque_per_goal for joint in model.joints if joint.torque_per_goal_std]
    return min(known, default=0.0)


def _model(model: ArmModel, names: tuple[str, ...], row: Array, factor: float) -> ArmModel:
    joints = tuple(replace(joint, torque_per_goal=joint.torque_per_goal * factor) for joint in model.joints)
    values = {**model.values, **dict(zip(names, map(float, row), strict=True))}
    return replace(model, values=values, joints=joints)


def _write_table(source: Source, drawn: Drawn, path: Path) -> None:
    """Write one row per arm: parameters, torque factor, and actuator properties, named as in Isaac Lab."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise MissingPackages("Parquet needs the package pyarrow") from error
    table: dict[str, Array] = {"torque_factor": drawn.torque_factor}
    units = {"torque_factor": "1"}
    for index, name in enumerate(drawn.names):
        table[name], units[name] = drawn.values[:, index], source.result.quantities[name].unit
    for number, joint in enumerate(source.model.joints, start=1):
        for key, (values, unit) in _actuator(drawn, number).items():
            table[f"{joint.name}.{key}"], units[f"{joint.name}.{key}"] = values, unit
    fields = [pa.field(name, pa.float64(), metadata={"unit": units[name]}) for name in table]
    try:
        parquet.write_table(
            pa.Table.from_arrays([pa.array(each) for each in table.values()], schema=pa.schema(fields)), path
        )
    except OSError as error:
        raise RunFolderError(f"{path} cannot be written: {error}.") from error


def _actuator(drawn: Drawn, joint: int) -> dict[str, tuple[Array, str]]:
    """Actuator properties of each drawn arm (samples,) and their units, named as in Isaac Lab."""
    facts = drawn.models[0].joints[joint - 1]

    def column(name: str) -> Array:
        if name not in drawn.names:
            return np.zeros(len(drawn.models))
        return np.asarray(drawn.values[:, drawn.names.index(name)])

    effort = np.array([model.joints[joint - 1].torque_per_goal * facts.goal_limit for model in drawn.models])
    return {
        "armature": (column(f"armature_{joint}"), "kg m^2"),
        "friction": (column(f"coulomb_{joint}"), "N m"),
        "viscous_friction": (column(f"viscous_{joint}"), "N m s/rad"),
        "effort_limit": (effort, "N m"),
        "velocity_limit": (np.full(len(drawn.models), facts.velocity_limit), "rad/s"),
    }
