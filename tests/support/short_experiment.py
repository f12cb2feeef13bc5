"""The realistic fake arm with an experiment of about four seconds, for benchmarks and tests that need many runs."""

from hil.config.schema import Config, parse_config
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

CONFIG = CONFIGS / "fake_two_link.toml"
PRIOR = """[arm.prior]
spread = 0.1
rough_spread = 0.1
link_mass = [0.180, 0.200]
link_centre = [0.081, 0.112]
link_inertia = [7.0e-4, 2.9e-4]
armature = [0.010, 0.010]
viscous = [0.045, 0.040]
coulomb = [0.055, 0.050]
"""


def short_config(text: str) -> Config:
    """The arm of this TOML text with an experiment of about four seconds."""
    text = replaced(
        text,
        ("rate = 400.0 ", "rate = 200.0 "),
        ("period = 10.0 ", "period = 1.0 "),
        ("band = [0.1, 5.0]", "band = [1.0, 6.0]"),
        ("ramp = 1.0 ", "held_out = false\nsettle_within = 0.05\nrest = 0.1\nramp = 0.2 "),
        ("[experiment]\n", f"{PRIOR}\n[experiment]\n"),
        ("[arm]\n", "[arm]\nlink_lengths = [0.147, 0.18]\n"),
    )
    return parse_config(text, CONFIG)
