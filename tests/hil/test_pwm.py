"""Voltage-driven arms: their configuration and experiment."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.config.schema import Config, load_config
from hil.drivers.servo_model import Mode
from hil.dry_run.amplitude import Amplitude
from hil.dry_run.ensemble import prior_ensemble
from hil.dry_run.prediction import predict, quantities_of
from hil.errors import ConfigError
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.fakes.servo.registers import load_model
from hil.plan.plan import make_plan
from hil.runs.run_folder import RunFolder
from tests.support.dry_runs import is_within, run_on
from tests.support.edits import WITHOUT_HELD_OUT, replaced

ArmFile = Callable[..., Path]

BY_CURRENT = (
    ("torque_constant = 1.80         # N m/A at the output shaft", ""),
    ("torque_constant_std = 0.15     # its uncertainty; every parameter of the joint scales with it", ""),
    ("current_limit = 1.2            # A", ""),
    ("torque_constant = 1.80\n", ""),
    ("torque_constant_std = 0.15\n", ""),
    ("current_limit = 0.8\n", ""),
)


def by_voltage(arm_file: ArmFile) -> Path:
    """The fake arm's file with both joints driven by voltage."""
    path = arm_file()
    head, fake = path.read_text(encoding="utf-8").split("\n[fake]\n")
    for old, new in BY_CURRENT:
        assert old in head
        head = head.replace(old, new, 1)
    joint = 'model = "XL430-W250"\ntorque_per_volt = 0.125\ntorque_per_volt_std = 0.01\nvoltage_limit = 8.0\n'
    head = head.replace('model = "XM430-W350"\n', joint)
    path.write_text(f"{head}\n[fake]\n{fake}".replace('model = "XM430-W350"', 'model = "XL430-W250"'), encoding="utf-8")
    return path


@pytest.fixture
def voltage_driven(arm_file: ArmFile) -> Config:
    return load_config(by_voltage(arm_file))


def test_the_model_decides_the_mode(voltage_driven: Config) -> None:
    assert {joint.drive_mode for joint in voltage_driven.joints} == {Mode.PWM}
    assert voltage_driven.bus.joints[0].mode is Mode.PWM


def test_goals_are_volts(voltage_driven: Config) -> None:
    (first, *_) = make_plan(voltage_driven).segments
    assert np.abs(first.period_current).max(axis=0) == pytest.approx([0.80 / 0.125, 0.42 / 0.125], rel=1e-6)


def test_a_dry_run_knows_what_turning_motors_generate(arm_file: ArmFile, tmp_path: Path) -> None:
    path = by_voltage(arm_file)
    text = path.read_text(encoding="utf-8").replace("[arm]\n", "[arm]\nlink_lengths = [0.147, 0.180]\n", 1)
    path.write_text(replaced(text, *WITHOUT_HELD_OUT), encoding="utf-8")
    config = load_config(path)
    plan = make_plan(config)
    foreseen = predict(config, plan, prior_ensemble(config, 48))
    seen = run_on(config, Amplitude(plan, plan.segments[0].peak_torque, foreseen), tmp_path)
    assert seen is not None and is_within(config, seen, foreseen.quantile)
    # Without back-EMF, the predicted speed of the elbow would be several times higher.
    assert (foreseen.median[2] < 2.0 * seen[2]).all()
    assert quantities_of(config.joints[0])[3] == ("voltage", "V") and foreseen.limits[3].tolist() == [8.0, 8.0]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("voltage_limit = 8.0", "current_limit = 0.8", r"joints\[1\]: voltage_limit is missing; pwm mode needs it"),
        ("voltage_limit = 8.0", "voltage_limit = 8.0\ncurrent_limit = 0.8", r"current_limit = 0\.8 has no meaning"),
        ("voltage_limit = 8.0", 'voltage_limit = 8.0\nmode = "current"', r"XL430-W250 has no current mode"),
        ("voltage_limit = 8.0", "voltage_limit = 2.0", r"more than voltage_limit \* torque_per_volt = 0\.25 N m"),
    ],
)
def test_a_fault_is_said(arm_file: ArmFile, old: str, new: str, said: str) -> None:
    path = by_voltage(arm_file)
    path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=said):
        load_config(path)


def test_joints_may_be_driven_in_different_modes(arm_file: ArmFile) -> None:
    path = by_voltage(arm_file)
    text = path.read_text(encoding="utf-8")
    at = text.rindex('model = "XL430-W250"\ntorque_per_volt')
    mixed = text[:at] + text[at:].replace(
        'model = "XL430-W250"\ntorque_per_volt = 0.125\ntorque_per_volt_std = 0.01\nvoltage_limit = 8.0',
        'model = "XM430-W350"\ntorque_constant = 1.8\ncurrent_limit = 0.8',
        1,
    )
    path.write_text(mixed, encoding="utf-8")
    config = load_config(path)
    assert len({joint.drive_mode for joint in config.joints}) == 2


def test_an_arm_driven_by_voltage_is_identified(arm_file: ArmFile, tmp_path: Path) -> None:
    motor = load_model("XL430-W250")
    path = by_voltage(arm_file)
    text = path.read_text(encoding="utf-8")
    text = replaced(
        text,
        ("torque_per_volt = 0.125", f"torque_per_volt = {1.80 / motor.resistance_ohm}"),
        ("torque_per_volt = 0.125", f"torque_per_volt = {1.80 / motor.resistance_ohm}"),
        ("rate = 400.0 ", "rate = 100.0 "),
        ("period = 2.0 ", "period = 6.0 "),
        ("band = [0.5, 6.0]", "band = [0.17, 6.0]"),
        # Back-EMF damps so strongly that the arm approaches its periodic motion slowly.
        ("[experiment]\n", "[experiment]\nheld_out = false\nmax_settling_periods = 8\n"),
    )
    path.write_text(text, encoding="utf-8")
    config = load_config(path)
    run = RunFolder.create(tmp_path / "run", config)
    run_experiment(config, run, path, lambda _: None)
    result = estimate_run(run)
    assert max(result.fit.residual_rms_ticks) <= 0.30
    found, truth = result.parameters, result.truth
    by_back_emf = 1.80 * motor.back_emf_v_s / motor.resistance_ohm
    assert truth["viscous_1"] == pytest.approx(0.045 + by_back_emf)
    for name, within in (("gravity", 0.002), ("viscous", 0.005), ("coulomb", 0.02)):
        for joint in (1, 2):
            assert found[f"{name}_{joint}"].value == pytest.approx(truth[f"{name}_{joint}"], rel=within)
    for name, entry in found.items():
        assert abs(entry.value - truth[name]) <= 3.5 * entry.std, name
