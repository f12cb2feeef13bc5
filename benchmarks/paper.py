"""The seed paper's method as printed, compared with maximum likelihood on the same data; the paper's figures 2 to 5.

    python benchmarks/paper.py [--json] [--seeds N] [--figures DIR]

The data are 100 s at 100 Hz of the arm of Table 1 with the paper's noise; the amplitudes are those of Table 2, at
different frequencies for the two joints. `rmse_m1` and `rmse_m2` [kg] are the errors of maximum likelihood over N seeds
on the plant as printed (first order); `literal_rmse_m1` and `literal_rmse_m2` are those of the method as printed. For
comparison, the output also gives the Cramer-Rao bound, and results for the corrected plant (second order with friction)
and for 10 samples per second. The figures need matplotlib.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from numpy.typing import NDArray

from benchmarks.machine import machine
from benchmarks.seed_paper.equations import (
    AMPLITUDES,
    FUNDAMENTAL,
    NOISE,
    Excitation,
    Order,
    PaperArm,
    coefficients,
    fit_as_printed,
    fit_likelihood,
    own_lines,
    record,
    response,
)

Array = NDArray[np.float64]

PUBLISHED = (1.0568, 1.5420)
ARM = PaperArm()
DAMPED = PaperArm(viscous=4.0)
GUESS = PaperArm(mass_1=3.5, mass_2=1.0, viscous=2.0)


def rmse(rate: float, seeds: int, order: Order) -> tuple[Array | None, Array | None]:
    """RMS errors of the masses (2,) [kg]: of the method as printed (first order only), and of maximum likelihood."""
    excitation = own_lines()
    literal: list[tuple[float, float]] = []
    likely: list[tuple[float, float]] = []
    for seed in range(seeds):
        position = record(ARM if order == 1 else DAMPED, excitation, order, rate, seed)
        lines = coefficients(position, excitation)
        if order == 1:
            literal.append(fit_as_printed(lines, excitation, ARM))
        found = fit_likelihood(lines, excitation, GUESS, order)
        likely.append((found.mass_1, found.mass_2))
    return _rms(literal), _rms(likely)


def _rms(masses: list[tuple[float, float]]) -> Array | None:
    true = np.array((ARM.mass_1, ARM.mass_2))
    return np.sqrt(np.mean((np.array(masses) - true) ** 2, axis=0)) if masses else None


def bound(rate: float) -> Array:
    """Cramer-Rao bound of m1 and m2 [kg] for the plant as printed in the paper and noise of its variance."""
    excitation = own_lines()
    columns = []
    for moved in (replace(ARM, mass_1=ARM.mass_1 + 1e-5), replace(ARM, mass_2=ARM.mass_2 + 1e-5)):
        slope = (response(moved, excitation, 1) - response(ARM, excitation, 1)) / 1e-5
        columns.append(np.concatenate((slope.real.ravel(), slope.imag.ravel())))
    J = np.stack(columns, axis=1)
    variance = NOISE**2 / 12.0 * 2.0 * FUNDAMENTAL / rate
    return np.asarray(np.sqrt(variance * np.diag(np.linalg.inv(J.T @ J))))


def figures(folder: Path) -> None:
    """Draw figures 2 to 5: torques, angles while settling, steady state, and mass estimates by seed."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    excitation, rate = own_lines(), 100.0
    time = np.arange(round(rate / FUNDAMENTAL)) / rate
    torque = excitation.torque @ np.cos(np.outer(excitation.frequency, time))
    draw(plt, folder / "figure_2.png", time, torque, "torque [N m]", "Figure 2: torques, on separate lines")
    settling, angles = transient(excitation)
    draw(plt, folder / "figure_3.png", settling, angles, "angle [rad]", "Figure 3: angles of the corrected arm")
    noisy = record(ARM, excitation, 1, rate, 0)
    draw(plt, folder / "figure_4.png", time, noisy, "angle [rad]", "Figure 4: steady state with the paper's noise")
    masses = []
    for seed in range(20):
        lines = coefficients(record(ARM, excitation, 1, rate, seed), excitation)
        found = fit_likelihood(lines, excitation, GUESS, 1)
        masses.append((*fit_as_printed(lines, excitation, ARM), found.mass_1, found.mass_2))
    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 5))
    for axis, true, which in zip(axes, (ARM.mass_1, ARM.mass_2), (0, 1), strict=True):
        axis.plot([row[which] for row in masses], "x", label="as printed")
        axis.plot([row[which + 2] for row in masses], ".", label="likelihood")
        axis.axhline(true, color="black", linewidth=0.8)
        axis.set_ylabel(f"m{which + 1} [kg]")
    axes[0].legend()
    axes[0].set_title("Figure 5: estimates over 20 noise seeds")
    axes[1].set_xlabel("seed")
    figure.savefig(folder / "figure_5.png", dpi=120)
    plt.close(figure)


def transient(excitation: Excitation) -> tuple[Array, Array]:
    """Angles of the corrected arm starting from rest (2, samples) [rad], computed with the matrix exponential."""
    from scipy.linalg import expm

    rate, D, K = 20.0, DAMPED.mass_matrix(), DAMPED.stiffness()
    inverse = np.linalg.inv(D)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ K, -inverse * DAMPED.viscous]])
    time = np.arange(round(2.0 * rate / FUNDAMENTAL)) / rate
    turn = np.exp(1j * np.outer(excitation.frequency, time))
    steady = response(DAMPED, excitation, 2)
    settled = (steady @ turn).real
    speed = (steady * (1j * excitation.frequency) @ turn).real
    # Add the decaying transient.
    away = -np.concatenate((settled[:, 0], speed[:, 0]))
    fade = expm(A / rate)
    position = settled.copy()
    for k in range(time.size):
        position[:, k] += away[:2]
        away = fade @ away
    return time, position


def draw(plt: Any, path: Path, time: Array, curves: Array, label: str, title: str) -> None:
    """Draw one curve per joint over time."""
    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 5))
    for joint, (axis, curve) in enumerate(zip(axes, curves, strict=True), start=1):
        axis.plot(time, curve, linewidth=0.8)
        axis.set_ylabel(f"joint {joint}, {label}")
    axes[0].set_title(title)
    axes[1].set_xlabel("time [s]")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--figures", type=Path)
    options = parser.parse_args()
    literal, ours = rmse(100.0, options.seeds, 1)
    assert literal is not None
    assert ours is not None
    if options.figures:
        figures(options.figures)
    if options.json:
        keys = ("rmse_m1", "rmse_m2", "literal_rmse_m1", "literal_rmse_m2")
        print(json.dumps(dict(zip(keys, (*ours.tolist(), *literal.tolist()), strict=True))))
        return
    slow_literal, slow = rmse(10.0, options.seeds, 1)
    _, damped = rmse(100.0, options.seeds, 2)
    assert slow_literal is not None
    assert slow is not None
    assert damped is not None
    print(f"{machine()}; {options.seeds} seeds, amplitudes {AMPLITUDES} N m; RMSE in kg")
    rows = (
        ("published", PUBLISHED),
        ("as printed, 100 Hz", literal),
        ("as printed, 10 Hz", slow_literal),
        ("likelihood, 100 Hz", ours),
        ("Cramer-Rao bound, 100 Hz", bound(100.0)),
        ("likelihood, 10 Hz", slow),
        ("likelihood, corrected arm (second order, friction), 100 Hz", damped),
    )
    for name, (first, second) in rows:
        print(f"{name:60s} m1 {first:8.4f}   m2 {second:8.4f}")


if __name__ == "__main__":
    main()
