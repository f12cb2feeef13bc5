"""Recordings of a real arm made by others, the DFKI double pendulum C.1: length of link 1 and prediction of swing-ups.

    python benchmarks/dfki.py DIR [--json] [--torque con|meas] [--floor]

DIR holds c1_sinusoids_*.csv and c1_swing_up_*.csv. Multiple shooting and filtered inverse-dynamics least squares
(IDIM-LS) are fitted to the sinusoids; `length` = 9.81 coupling / gravity_2 should be 0.2 m. The swing-ups are held out:
both methods predict them for half a second at a time, from the same measured states. IDIM-LS uses the torque delay with
the smallest residual. No rule gives its cut-off frequency in advance, so three are compared: `customary` is five times
the highest tone (8 Hz); `chosen` predicts the sinusoids best; `best` predicts the swing-ups best, although nobody could
know this in advance.

The encoders are zeroed at every start, although dry friction may hold the arm away from its rest pose, by up to 0.07
rad in these recordings. Within half a second near the upright pose, such an error grows tenfold. Therefore, two
comparisons are made. `swing_up` assumes that the zeros are 0, as a reader of the file would. For `swing_up_zeroed`, the
two encoder zeros for each half of a swing-up are fitted to its other half, with fixed parameters; for IDIM-LS, the
better of `swing_up` and `swing_up_zeroed` counts.

--floor estimates how much of the error is unavoidable, using the predicted data themselves: encoder zeros
fitted to each swing-up, and parameters fitted to the swing-ups or to all recordings together.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from scipy.optimize import minimize
from scipy.signal import savgol_filter

from benchmarks.machine import machine
from hil.config.recording import load_recording_config
from hil.estimation.model_from_config import wanted_model
from hil.estimator.baselines.idim import fit_inverse_dynamics, uniform
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ShootingEstimate, estimate_by_shooting
from hil.estimator.selection.prediction import prediction_errors, prediction_rms
from hil.recordings.convert import convert
from hil.recordings.csv_file import read_csv_table

CONFIG = Path(__file__).parents[1] / "configs" / "recordings" / "dfki_double_pendulum.toml"
SEPARATE = 30.0  # Hz, cut-off for positions if it differs from that for regressors and torques
CUTOFFS = {f"{each:g} Hz": (each, each) for each in (3.0, 4.0, 5.0, 8.0, 15.0, 30.0)} | {
    f"{each:g} Hz, positions {SEPARATE:g} Hz": (each, SEPARATE) for each in (2.0, 3.0, 4.0, 8.0)
}
CUSTOMARY = "8 Hz"
START_CUTOFF = 8.0  # Hz
DELAYS = (0.0, 0.003, 0.006, 0.009)  # s
WIDTH = 0.05  # rad/s
HORIZON = 0.5  # s
SMOOTHING = 51  # samples of 2 ms
GRAVITY = 9.81


def load(folder: Path, pattern: str, torque: str) -> list[Recording]:
    columns = load_recording_config(CONFIG).columns
    between = "linear" if torque == "meas" else "held"
    columns = columns.model_copy(update={"torque": [f"tau_{torque}1", f"tau_{torque}2"], "between": between})
    return [convert(read_csv_table(path), columns).recordings[0] for path in sorted(folder.glob(pattern))]


def idle_inertia(folder: Path) -> list[float]:
    """For each joint, the slope of its measured torque over its acceleration while it is not driven [kg m^2]."""
    pairs = list(zip(*(load(folder, "c1_sinusoids_*.csv", torque) for torque in ("con", "meas")), strict=True))
    found = []
    for joint in range(2):
        idle = [measured for commanded, measured in pairs if not commanded.torque[joint].any()]
        uniformly = [uniform(each) for each in idle]
        torque = np.concatenate([torque[joint] - torque[joint].mean() for _, torque, _ in uniformly])
        acceleration = np.concatenate(
            [savgol_filter(position[joint], SMOOTHING, 3, deriv=2, delta=dt) for position, _, dt in uniformly]
        )
        found.append(float(acceleration @ torque / (acceleration @ acceleration)))
    return found


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
    found = minimize(
        error,
        simplex[0],
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-4, "maxiter": 60},
    )
    return np.asarray(found.x)[None]


def predictions(parameters: dict[str, float], sines: list[Recording], swings: list[Recording]) -> dict[str, float]:
    pairs = [pair for swing in swings for pair in (halves(swing), halves(swing)[::-1])]
    zeroed = [prediction_rms([test], parameters, HORIZON, 2, zeros_of(other, parameters)) for other, test in pairs]
    return {
        "sinusoids": both(prediction_rms(sines, parameters, HORIZON, 2)),
        "swing_up": both(prediction_rms(swings, parameters, HORIZON, 2)),
        "swing_up_zeroed": both(np.array(zeroed)),
    }


def filtered_fit(sines: list[Recording], swings: list[Recording], cutoffs: tuple[float, float]) -> dict[str, float]:
    rows, positions = cutoffs
    fits = [(delay, fit_inverse_dynamics(sines, rows, WIDTH, delay, positions)) for delay in DELAYS]
    delay, found = min(fits, key=lambda fit: float(np.sum(fit[1].relative_residual ** 2)))
    named = dict(zip(found.names, found.value.tolist(), strict=True))
    named |= {"coulomb_width_1": WIDTH, "coulomb_width_2": WIDTH, "delay": delay}
    return {"length": GRAVITY * named["coupling"] / named["gravity_2"], **predictions(named, sines, swings)}


def shooting_fit(recordings: list[Recording]) -> ShootingEstimate:
    config = load_recording_config(CONFIG)
    model = wanted_model(config.model, 2).without("zeros")
    start = fit_inverse_dynamics(recordings, START_CUTOFF, WIDTH).value
    return estimate_by_shooting(recordings, model, start, length=config.columns.segment, zeros=True)


def floor(sines: list[Recording], swings: list[Recording], parameters: dict[str, float]) -> dict[str, Any]:
    """RMS prediction errors of the swing-ups [rad] if zeros or parameters are fitted to the swing-ups themselves."""
    errors, _ = prediction_errors(swings, parameters, HORIZON, 2)
    squares = np.sort(np.sum(errors**2, axis=1))[::-1]
    hindsight = np.concatenate([zeros_of(swing, parameters) for swing in swings])
    alone, together = shooting_fit(swings), shooting_fit([*sines, *swings])
    count = len(swings)
    return {
        "worst_four_segments_share": float(squares[:4].sum() / squares.sum()),
        "own_zeros": both(prediction_rms(swings, parameters, HORIZON, 2, hindsight)),
        "fitted_alone": both(prediction_rms(swings, alone.parameters, HORIZON, 2)),
        "fitted_alone_own_zeros": both(prediction_rms(swings, alone.parameters, HORIZON, 2, alone.zeros)),
        "fitted_together": both(prediction_rms(swings, together.parameters, HORIZON, 2)),
        "fitted_together_own_zeros": both(
            prediction_rms(swings, together.parameters, HORIZON, 2, together.zeros[-count:])
        ),
        "fitted_together_sinusoids": both(
            prediction_rms(sines, together.parameters, HORIZON, 2, together.zeros[:-count])
        ),
        "zeros": alone.zeros.tolist(),
        "parameters_alone": alone.parameters,
        "parameters_together": together.parameters,
    }


def measure(folder: Path, torque: str, with_floor: bool) -> dict[str, Any]:
    sines, swings = load(folder, "c1_sinusoids_*.csv", torque), load(folder, "c1_swing_up_*.csv", torque)
    filtered = {name: filtered_fit(sines, swings, cutoffs) for name, cutoffs in CUTOFFS.items()}
    began = time.perf_counter()
    estimate = shooting_fit(sines)
    seconds = time.perf_counter() - began
    length, std = length_of(estimate)
    ours = predictions(estimate.parameters, sines, swings)
    ours["sinusoids"] = both(prediction_rms(sines, estimate.parameters, HORIZON, 2, estimate.zeros))
    chosen = min(filtered, key=lambda name: filtered[name]["sinusoids"])
    best = min(filtered, key=lambda name: filtered[name]["swing_up"])
    cutoffs = {"customary": CUSTOMARY, "chosen": chosen, "best": best}
    return {
        "idle_inertia": idle_inertia(folder),
        "length": length,
        "length_std": std,
        "seconds": seconds,
        "model": estimate.model.description,
        "parameters": estimate.parameters,
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
        **({"floor": floor(sines, swings, estimate.parameters)} if with_floor else {}),
    }


def show(found: dict[str, Any]) -> None:
    print(f"length {found['length']:.4f} +- {found['length_std']:.4f} m, {found['model']}, {found['seconds']:.1f} s")
    print("measured torque of an undriven joint per acceleration:", found["idle_inertia"], "kg m^2")
    print(f"{'':28s} {'length':>7s} {'sinusoids':>10s} {'swing-ups':>10s} {'zeros from the other half':>26s}")
    rows = {"shooting": found} | {f"IDIM-LS {name}": entry for name, entry in found["filtered"].items()}
    for name, entry in rows.items():
        print(
            f"{name:28s} {entry['length']:7.4f} {entry['sinusoids']:10.4f} {entry['swing_up']:10.4f} "
            f"{entry['swing_up_zeroed']:26.4f}"
        )
    for name, cutoff in found["cutoffs"].items():
        print(
            f"swing-ups, IDIM-LS at {cutoff} ({name}): {found['ratio'][name]:.1f} times better, "
            f"{found['ratio_zeroed'][name]:.1f} with zeros"
        )
    for name, value in found.get("floor", {}).items():
        print(f"{name:28s} {value if not isinstance(value, float) else round(value, 4)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--torque", choices=("con", "meas"), default="con")
    parser.add_argument("--floor", action="store_true")
    options = parser.parse_args()
    found = measure(options.folder, options.torque, options.floor)
    if options.json:
        print(json.dumps(found))
        return
    print(f"{machine()}; torque {options.torque}, prediction over {HORIZON:g} s, RMS of both joints [rad]")
    show(found)


if __name__ == "__main__":
    main()
