"""Effect of timing jitter on the estimate, with and without correction for the actual times, on the ideal fake arm.

    python benchmarks/effects/jitter.py [--json] [--rms-us 0 200 500] [--config configs/fake_two_link_ideal.toml]

Each write happens at a random time after its deadline, drawn from a half-normal distribution with the given RMS. The
same recording is estimated twice: as it is, and with its times replaced by the deadlines.
"""

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.machine import machine
from hil.config.schema import load_config
from tests.support.stream.late_loop import measure

CONFIG = Path(__file__).parents[2] / "configs" / "fake_two_link_ideal.toml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--rms-us", type=float, nargs="+", default=[0.0, 200.0, 500.0])
    parser.add_argument("--config", type=Path, default=CONFIG)
    options = parser.parse_args()
    config = load_config(options.config)
    found = {f"{rms:g}": measure(config, 1e-6 * rms) for rms in options.rms_us}
    if options.json:
        print(json.dumps(found))
        return
    print(f"{machine()}; {options.config.stem} at {config.experiment.rate:g} Hz")
    for rms, both in found.items():
        for times, entry in both.items():
            print(
                f"late by {rms:>4s} us RMS, {times:7s} times: worst parameter {100 * entry['worst_error']:.3f} %, "
                f"residual {entry['residual_ticks']:.3f} steps, held out {100 * entry['held_out_rms']:.3f} %"
            )


if __name__ == "__main__":
    main()
