"""A real arm recorded by others, DFKI double pendulum C.1: link 1's length, and predictions of swing-ups.

    python benchmarks/dfki.py DIR [--json] [--torque meas|con]

DIR holds c1_sinusoids_*.csv and c1_swing_up_*.csv. Multiple shooting and filtered inverse-dynamics least squares
(IDIM-LS) get the sinusoids; `length` = 9.81 coupling / gravity_2 must be 0.2 m. The swing-ups are not fitted: both
predict them for half a second at a time from the measured state. The cut-off of IDIM-LS is what no rule tells in
advance: `customary` is five times the highest tone (8 Hz), `chosen` predicts the sinusoids best, `best` predicts the
swing-ups best, which nobody could have known.

The encoders are zeroed anew at every start, while dry friction holds the arm off its rest: by up to 0.07 rad here, and
half a second beside the upright multiplies that by ten. So two comparisons: `swing_up` takes the zeros as 0, as a
reader of the file would; for `swing_up_zeroed` each half of a swing-up gets its two zeros from the other half, the
parameters kept, and IDIM-LS counts with the better of the two.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine
from scipy.optimize import minimize

from estimator.idim import fit_inverse_dynamics
from estimator.model import Model
from estimator.prediction import prediction_rms
from estimator.recording import Recording
from estimator.shooting import ShootingEstimate, estimate_by_shooting
from hil.csv_config import load_csv_config
from hil.csv_recording import read_csv

CONFIG = Path(__file__).parents[1] / "configs" / "recordings" / "dfki_double_pendulum.toml"
CUTOFFS = (3.0, 4.0, 5.0, 8.0, 15.0, 30.0)  # Hz
CUSTOMARY = 8.0
WIDTH = 0.05  # rad/s
HORIZON = 0.5  # s
GRAVITY = 9.81


def load(folder: Path, pattern: str, torque: str) -> list[Recording]:
    columns = load_csv_config(CONFIG).columns
    between = "linear" if torque == "meas" else "held"
    columns = columns.model_copy(update={"torque": [f"tau_{torque}1", f"tau_{torque}2"], "between": between})
    return [read_csv(path, columns) for path in sorted(folder.glob(pattern))]


def length_of(estimate: ShootingEstimate) -> tuple[float, float]:
    found, names = estimate.parameters, list(estimate.names)
    length = GRAVITY * found["coupling"] / found["gravity_2"]
    slope = np.zeros(len(names))
    slope[names.index("coupling")] = length / found["coupling"]
    slope[names.index("gravity_2")] = -length / found["gravity_2"]
    return length, float(np.sqrt(slope @ estimate.covariance @ slope))


def both(rms: np.ndarray) -> float:
    return float(np.sqrt(np.mean(rms**2)))


def halves(recording: Recording) -> tuple[Recording, Recording]:
    middle = recording.time.size // 2
    first, second = slice(0, middle), slice(middle, None)
    return part(recording, first), part(recording, second)


def part(recording: Recording, chosen: slice) -> Recording:
    time, torque = recording.time[chosen], recording.torque[:, chosen]
    return replace(recording, time=time, torque=torque, position=recording.position[:, chosen])


def zeros_of(recording: Recording, parameters: dict[str, float]) -> np.ndarray:
    """The two encoder zeros (1, 2) [rad] with which `parameters` predict this recording best."""

    def error(zeros: np.ndarray) -> float:
        return both(prediction_rms([recording], parameters, HORIZON, 2, zeros[None]))

    simplex = np.array([[0.0, 0.0], [0.03, 0.0], [0.0, 0.03]])
    options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-4, "maxiter": 60}
    return np.asarray(minimize(error, simplex[0], method="Nelder-Mead", options=options).x)[None]


def predictions(parameters: dict[str, float], sines: list[Recording], swings: list[Recording]) -> dict[str, float]:
    pairs = [pair for swing in swings for pair in (halves(swing), halves(swing)[::-1])]
    zeroed = [prediction_rms([test], parameters, HORIZON, 2, zeros_of(other, parameters)) for other, test in pairs]
    return {
        "sinusoids": both(prediction_rms(sines, parameters, HORIZON, 2)),
        "swing_up": both(prediction_rms(swings, parameters, HORIZON, 2)),
        "swing_up_zeroed": both(np.array(zeroed)),
    }


def filtered_fit(sines: list[Recording], swings: list[Recording], cutoff: float) -> dict[str, float]:
    found = fit_inverse_dynamics(sines, cutoff, WIDTH)
    named = dict(zip(found.names, found.value.tolist(), strict=True))
    named |= {"coulomb_width_1": WIDTH, "coulomb_width_2": WIDTH}
    return {"length": GRAVITY * named["coupling"] / named["gravity_2"], **predictions(named, sines, swings)}


def measure(folder: Path, torque: str) -> dict[str, Any]:
    sines, swings = load(folder, "c1_sinusoids_*.csv", torque), load(folder, "c1_swing_up_*.csv", torque)
    filtered = {cutoff: filtered_fit(sines, swings, cutoff) for cutoff in CUTOFFS}
    config = load_csv_config(CONFIG)
    start = fit_inverse_dynamics(sines, CUSTOMARY, WIDTH).value
    began = time.perf_counter()
    model = Model(2, config.model.friction, config.model.drive)
    estimate = estimate_by_shooting(sines, model, start, length=config.columns.segment, zeros=True)
    seconds = time.perf_counter() - began
    length, std = length_of(estimate)
    ours = predictions(estimate.parameters, sines, swings)
    ours["sinusoids"] = both(prediction_rms(sines, estimate.parameters, HORIZON, 2, estimate.zeros))
    chosen = min(filtered, key=lambda cutoff: filtered[cutoff]["sinusoids"])
    best = min(filtered, key=lambda cutoff: filtered[cutoff]["swing_up"])
    cutoffs = {"customary": CUSTOMARY, "chosen": chosen, "best": best}
    return {
        "length": length,
        "length_std": std,
        "seconds": seconds,
        "residual_rms": estimate.residual_rms.tolist(),
        "zeros": estimate.zeros.tolist(),
        **ours,
        "filtered": filtered,
        "cutoffs": cutoffs,
        "ratio": {name: filtered[cutoff]["swing_up"] / ours["swing_up"] for name, cutoff in cutoffs.items()},
        "ratio_zeroed": {
            name: min(filtered[cutoff]["swing_up"], filtered[cutoff]["swing_up_zeroed"]) / ours["swing_up_zeroed"]
            for name, cutoff in cutoffs.items()
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--torque", choices=("meas", "con"), default="meas")
    options = parser.parse_args()
    found = measure(options.folder, options.torque)
    if options.json:
        print(json.dumps(found))
        return
    print(f"{machine()}; torque {options.torque}, prediction over {HORIZON:g} s, RMS of both joints [rad]")
    print(f"length {found['length']:.4f} +- {found['length_std']:.4f} m, {found['seconds']:.1f} s")
    print(f"{'':14s} {'length':>7s} {'sinusoids':>10s} {'swing-ups':>10s} {'zeros from the other half':>26s}")
    rows = {"shooting": found} | {f"IDIM-LS {cutoff:g} Hz": entry for cutoff, entry in found["filtered"].items()}
    for name, entry in rows.items():
        print(
            f"{name:14s} {entry['length']:7.4f} {entry['sinusoids']:10.3f} {entry['swing_up']:10.3f} "
            f"{entry['swing_up_zeroed']:26.3f}"
        )
    for name, cutoff in found["cutoffs"].items():
        print(
            f"swing-ups, IDIM-LS at {cutoff:g} Hz ({name}): {found['ratio'][name]:.1f} times better, "
            f"{found['ratio_zeroed'][name]:.1f} with zeros"
        )


if __name__ == "__main__":
    main()
