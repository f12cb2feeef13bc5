"""A real arm recorded by others, DFKI double pendulum C.1: link 1's length, and predictions of swing-ups.

    python benchmarks/dfki.py DIR [--json] [--torque meas|con]

DIR holds c1_sinusoids_*.csv and c1_swing_up_*.csv. Multiple shooting and filtered inverse-dynamics least squares
(IDIM-LS) get the sinusoids; `length` = 9.81 coupling / gravity_2 must be 0.2 m. The swing-ups are not fitted: both
predict them for half a second at a time from the measured state, the best for IDIM-LS being a low cut-off that no
rule tells in advance. `ratio_customary` compares with a cut-off of about five times the highest tone (8 Hz), and
`ratio_best` with the cut-off that predicts the sinusoids best.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from machine import machine

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


def measure(folder: Path, torque: str) -> dict[str, Any]:
    sines, swings = load(folder, "c1_sinusoids_*.csv", torque), load(folder, "c1_swing_up_*.csv", torque)
    filtered = {}
    for cutoff in CUTOFFS:
        found = fit_inverse_dynamics(sines, cutoff, WIDTH)
        named = dict(zip(found.names, found.value.tolist(), strict=True))
        named |= {"coulomb_width_1": WIDTH, "coulomb_width_2": WIDTH}
        filtered[cutoff] = {
            "length": GRAVITY * named["coupling"] / named["gravity_2"],
            "sinusoids": both(prediction_rms(sines, named, HORIZON, 2)),
            "swing_up": both(prediction_rms(swings, named, HORIZON, 2)),
        }
    config = load_csv_config(CONFIG)
    start = fit_inverse_dynamics(sines, CUSTOMARY, WIDTH).value
    began = time.perf_counter()
    model = Model(2, config.model.friction, config.model.drive, zeros=True)
    estimate = estimate_by_shooting(sines, model, start, length=config.columns.segment)
    seconds = time.perf_counter() - began
    length, std = length_of(estimate)
    ours = both(prediction_rms(swings, estimate.parameters, HORIZON, 2))
    best = min(filtered, key=lambda cutoff: filtered[cutoff]["sinusoids"])
    return {
        "length": length,
        "length_std": std,
        "seconds": seconds,
        "sinusoids": both(prediction_rms(sines, estimate.parameters, HORIZON, 2)),
        "swing_up": ours,
        "filtered": filtered,
        "best_cutoff": best,
        "ratio_customary": filtered[CUSTOMARY]["swing_up"] / ours,
        "ratio_best": filtered[best]["swing_up"] / ours,
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
    print(f"{machine()}; torque {options.torque}, prediction over {HORIZON:g} s, RMS of both joints")
    print(
        f"shooting        length {found['length']:.4f} +- {found['length_std']:.4f} m, sinusoids "
        f"{found['sinusoids']:.3f} rad, swing-ups {found['swing_up']:.3f} rad, {found['seconds']:.1f} s"
    )
    for cutoff, entry in found["filtered"].items():
        print(
            f"IDIM-LS {cutoff:4.0f} Hz length {entry['length']:.4f} m, sinusoids {entry['sinusoids']:.3f} rad, "
            f"swing-ups {entry['swing_up']:.3f} rad"
        )
    print(
        f"swing-ups: {found['ratio_customary']:.1f} times better than IDIM-LS at {CUSTOMARY:g} Hz, "
        f"{found['ratio_best']:.1f} times than at {found['best_cutoff']:g} Hz, its best on the sinusoids"
    )


if __name__ == "__main__":
    main()
