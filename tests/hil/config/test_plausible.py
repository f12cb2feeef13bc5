"""Unit errors are refused by name; values of real arms are accepted."""

from pathlib import Path

import pytest

from hil.config.bundled import bundled_configs
from hil.config.schema import load_config, parse_config
from hil.errors import ConfigError
from tests.support.paths import CONFIGS

PLAIN = (CONFIGS / "xm430_two_link.toml").read_text(encoding="utf-8")
PILOT = PLAIN.replace("gravity = 9.81 ", "link_lengths = [0.147, 0.180]\ngravity = 9.81 ")
PRIOR = PILOT + "\n[arm.prior]\n{}\n"
KNOWN = PLAIN + "\n[known]\n{}\n"
SPRING = PLAIN + "\n[stabiliser]\n{}\n"

SLIPS = [
    (
        "position_limit = [-3.14, 0.00]",
        "position_limit = [-240.0, 60.0]",
        r"position_limit of joint 'shoulder'.*-4\.18",
    ),
    ("velocity_limit = 10.0 ", "velocity_limit = 360.0 ", r"velocity_limit.*degrees/s, write 6\.28"),
    ("velocity_limit = 10.0 ", "velocity_limit = 46.0 ", r"velocity_limit.*rpm, write 4\.817"),
    ("velocity_limit = 10.0 ", "velocity_limit = 46.0 ", r"the no-load speed of XM430-W350 is 5\.9 rad/s at 14\.8 V"),
    ("current_limit = 0.69 ", "current_limit = 6.9 ", r"current_limit of joint 'shoulder'.*stall current.* is 2\.7 A"),
    ("torque_constant = 1.81 ", "torque_constant = 0.0051 ", r"torque_constant.*published"),
    ("torque_constant = 1.81 ", "torque_constant = 18.5 ", r"torque_constant.*kgf cm"),
    ("rest_pose = [-1.5708, 0.0000]", "rest_pose = [-90.0, 0.0]", r"rest_pose"),
    ("[arm]\n", "[arm]\nrest_tolerance = 15.0\n", r"arm\.rest_tolerance.*0\.2618"),
    ("[arm]\n", "[arm]\nlink_lengths = [147.0, 180.0]\n", r"link_lengths of joint 'shoulder' = 147 m.*mm, .* 0\.147"),
    ("[arm]\n", "[arm]\nlink_lengths = [14.7, 18.0]\n", r"link_lengths of joint 'shoulder' = 14\.7 m"),
    ("[arm]\n", "[arm]\nlink_lengths = [0.000147, 0.00018]\n", r"link_lengths.*shorter than any servo"),
]
TABLES = [
    (PRIOR, "link_mass = [180.0, 200.0]", r"arm\.prior\.link_mass of joint 'shoulder' = 180 kg"),
    (PRIOR, "servo_mass = [82.0, 82.0]", r"servo_mass"),
    (PRIOR, "link_centre = [81.0, 112.0]", r"link_centre"),
    (PRIOR, "link_inertia = [700.0, 290.0]", r"link_inertia"),
    (PRIOR, "coulomb = [55.0, 50.0]", r"arm\.prior\.coulomb"),
    (PRIOR, "viscous = [45.0, 40.0]", r"arm\.prior\.viscous"),
    (KNOWN, "length_1 = 147.0", r"known\.length_1 = 147 m.*0\.147"),
    (KNOWN, "mass_2 = 200.0", r"known\.mass_2 = 200 kg"),
    (KNOWN, "link_inertia_2 = {value = 290.0, std = 1.0}", r"known\.link_inertia_2"),
    (SPRING, "stiffness = [500.0, 0.5]\ndamping = [0.1, 0.1]", r"stabiliser\.stiffness of joint 'shoulder'"),
]


@pytest.mark.parametrize(("old", "new", "said"), SLIPS)
def test_a_slip_of_unit_is_named(old: str, new: str, said: str, tmp_path: Path) -> None:
    assert old in PLAIN
    with pytest.raises(ConfigError, match=f"(?s){said}"):
        parse_config(PLAIN.replace(old, new, 1), tmp_path / "arm.toml")


@pytest.mark.parametrize(("text", "line", "said"), TABLES)
def test_a_slip_in_another_table_is_named(text: str, line: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"(?s){said}"):
        parse_config(text.format(line), tmp_path / "arm.toml")


@pytest.mark.parametrize("name", sorted(bundled_configs()))
def test_ready_arms_pass(name: str) -> None:
    assert load_config(bundled_configs()[name]).joints


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("torque_constant = 1.81 ", "torque_constant = 9.05 "),  # an external gear with a ratio of 5
        ("position_limit = [-3.14, 0.00]", "position_limit = [-7.0, 4.0]"),
        ("[arm]\n", "[arm]\nlink_lengths = [0.03, 0.9]\n"),
    ],
)
def test_unusual_arms_pass(old: str, new: str, tmp_path: Path) -> None:
    assert parse_config(PLAIN.replace(old, new), tmp_path / "arm.toml").joints
