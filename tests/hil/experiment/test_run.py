"""The experiment on the fake bus: the servos must always end without torque, and the recording must be readable."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError, NoReply, PortLost, ServoFault, TorqueNotOff, WrongModel, WrongSetting
from hil.errors import ExperimentError, NotSettled, RunFolderError, SafetyStop, StopRequested
from hil.experiment.run import run_experiment
from hil.experiment.stream import Progress, Watch
from hil.fakes.protocol_fake import FakeSerial
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder
from tests.support.edits import FEWER_SAMPLES, QUICK
from tests.support.short_experiment import CONFIG, short_config
from tests.support.stream.at_sample import at_sample

Arm = Callable[..., Config]


SERVO_1 = 'id = 1\nmodel = "XM430-W350"\nzero_ticks = 3072\n'


def ignore(_: Progress) -> None:
    """Ignore progress reports."""


def run(config: Config, folder: Path, watch: Watch = ignore) -> RunFolder:
    made = RunFolder.create(folder, config)
    run_experiment(config, made, config.path, watch)
    return made


def assert_no_torque(port: Any) -> None:
    servos = port.bus.servos
    assert servos, "the bus has servos"
    assert not any(servo.torque_enabled for servo in servos.values())


def test_a_whole_experiment_is_recorded_in_order_and_ends_without_torque(
    arm: Arm, tmp_path: Path, ports: list[Any]
) -> None:
    config = arm(*FEWER_SAMPLES)
    made = run(config, tmp_path / "run")
    assert_no_torque(ports[0])
    samples = load_samples(made.samples_path, 2)
    changes = np.flatnonzero(np.diff(samples["phase"], prepend=0))
    order = [int(phase) for phase in samples["phase"][changes]]
    twice = [Phase.RAMP_IN, Phase.PERIODIC, Phase.RAMP_OUT]
    assert order == [Phase.REST, *twice, *twice, Phase.COMING_TO_REST]
    assert not samples["missing"].any()
    assert np.allclose(np.diff(samples["deadline"]), 1 / 200)
    assert np.abs(samples["goal_current"]).max(axis=0) == pytest.approx([0.80 / 1.8, 0.42 / 1.8], abs=2.7e-3)
    assert np.abs(samples["velocity"][-20:]).max() < 0.1


def test_a_warm_up_is_played_once_before_the_first_multisine_and_used_for_nothing(arm: Arm, tmp_path: Path) -> None:
    period = arm().experiment.period
    config = arm(("[experiment]", f"[experiment]\nwarm_up = {1.5 * period}"), *FEWER_SAMPLES)
    made = run(config, tmp_path / "run")
    samples = load_samples(made.samples_path, 2)
    warming = samples["phase"] == Phase.WARM_UP
    assert warming.sum() == 2 * config.experiment.samples, "whole periods, rounded up"
    assert set(samples["segment"][warming]) == {0}
    changes = np.flatnonzero(np.diff(samples["phase"], prepend=0))
    order = [int(phase) for phase in samples["phase"][changes]]
    then = [Phase.PERIODIC, Phase.RAMP_OUT]
    assert order == [Phase.REST, Phase.RAMP_IN, Phase.WARM_UP, *then, Phase.RAMP_IN, *then, Phase.COMING_TO_REST]
    first, second = samples["goal_current"][warming].reshape(2, config.experiment.samples, 2)
    assert np.array_equal(first[1:], second[1:])
    periodic = (samples["phase"] == Phase.PERIODIC) & (samples["segment"] == 0) & (samples["period"] == 1)
    assert np.array_equal(samples["goal_current"][periodic][1:], second[1:]), "the warm-up is the same motion"


def test_further_periods_follow_the_settled_one_and_progress_is_shown_20_times_a_second(tmp_path: Path) -> None:
    config = short_config(CONFIG.read_text(encoding="utf-8"))
    last = []
    for further in (0, 2):
        experiment = config.experiment.model_copy(update={"periods": 1 + further})
        shown: list[Progress] = []
        made = run(config.model_copy(update={"experiment": experiment}), tmp_path / f"{further}", shown.append)
        samples = load_samples(made.samples_path, 2)
        assert set(samples["period"][samples["phase"] != Phase.PERIODIC]) == {-1}
        last.append(samples["period"].max())
        usual = [progress.taken for progress in shown if progress.state.slow is None]
        assert set(np.diff(usual)) <= {10, 20} and usual[0] == 10, "at 200 Hz; slow states take the place of some"
    assert last[1] == last[0] + 2


def test_two_runs_of_one_seed_are_the_same_to_the_last_bit(arm: Arm, tmp_path: Path) -> None:
    config = arm(*QUICK)
    first = load_samples(run(config, tmp_path / "a").samples_path, 2)
    second = load_samples(run(config, tmp_path / "b").samples_path, 2)
    assert first.tobytes() == second.tobytes()


def test_an_arm_that_still_swings_is_awaited(arm: Arm, tmp_path: Path) -> None:
    """Within 0.05 rad before torque comes on, and within much more before it would be at rest."""
    config = arm(("start = [-1.5707963, 0.0]", "start = [-1.37, 0.0]"), *QUICK)
    rests = load_samples(run(config, tmp_path / "run").samples_path, 2)["position"]
    assert rests[0, 0] < -1.45 and np.ptp(rests[:20], axis=0).max() < 0.01


def test_a_rest_pose_at_the_encoders_wrap_is_found_on_either_side(arm: Arm) -> None:
    zeros = (("zero_ticks = 3072  ", "zero_ticks = 1024  "), (SERVO_1, SERVO_1.replace("3072", "1024")))
    for off in (-0.003, 0.003):
        start = ("start = [-1.5707963, 0.0]", f"start = [{-1.5707963 + off}, 0.0]")
        config = arm(*zeros, start)
        with ServoBus.open(config.bus) as bus:
            for position in (bus.read_positions(), bus.exchange([0.0, 0.0]).position):
                assert position == pytest.approx([-1.5707963 + off, 0.0], abs=2e-3)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_the_arm(arm: Arm, tmp_path: Path, ports: list[Any], number: signal.Signals) -> None:
    handler = signal.getsignal(number)
    with pytest.raises(StopRequested) as caught:
        run(arm(), tmp_path / "run", at_sample(900, lambda: os.kill(os.getpid(), number)))
    assert_no_torque(ports[0])
    assert caught.value.__notes__ == ["Torque is off on both servos, confirmed by reading it back."]
    assert 900 <= len(load_samples(tmp_path / "run" / "samples.npy", 2)) < 1000
    assert signal.getsignal(number) is handler


def test_a_fault_of_the_program_stops_the_arm(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(arm(), tmp_path / "run", at_sample(900, fail))
    assert_no_torque(ports[0])
    assert len(load_samples(tmp_path / "run" / "samples.npy", 2)) >= 900


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("[-3.1, 3.1]", "[-0.5, 0.5]"), r"'elbow' \(ID 2.*outside its position limit \[-0\.5, 0\.5\]"),
        (("velocity_limit = 15.0", "velocity_limit = 2.0"), r"'shoulder' \(ID 1.*velocity limit of 2"),
    ],
)
def test_a_limit_stops_the_arm_at_the_sample_that_passed_it(
    arm: Arm, tmp_path: Path, ports: list[Any], change: tuple[str, str], said: str
) -> None:
    with pytest.raises(SafetyStop, match=said):
        run(arm(change), tmp_path / "run")
    assert_no_torque(ports[0])
    samples = load_samples(tmp_path / "run" / "samples.npy", 2)
    over = (np.abs(samples["position"][:, 1]) > 0.5) | (np.abs(samples["velocity"][:, 0]) > 2.0)
    looked_at = np.flatnonzero(samples["phase"] != Phase.BRAKING)
    assert over[looked_at[-1]]
    assert np.count_nonzero(samples["phase"] == Phase.BRAKING) <= 0.06 * 400


def test_a_servo_that_falls_silent_is_named_and_the_other_is_without_torque(
    arm: Arm, tmp_path: Path, ports: list[Any]
) -> None:
    def pull() -> None:
        ports[0].bus.servos[2].connected = False

    with pytest.raises(TorqueNotOff, match=r"NOT CONFIRMED for JOINT 'ELBOW' \(ID 2") as caught:
        run(arm(), tmp_path / "run", at_sample(900, pull))
    assert isinstance(caught.value.__context__, SafetyStop)
    assert "missed 6 replies" in str(caught.value.__context__)
    port = ports[0]
    port.clock.wait_until(port.clock.now() + 0.2)
    servos = port.bus.servos
    assert not servos[1].torque_enabled
    assert servos[2].watchdog_tripped
    assert servos[2].goal_current_ticks == 0


def test_a_pulled_cable_leaves_the_servos_to_their_watchdogs(
    arm: Arm, tmp_path: Path, ports: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: Any) -> None:
        raise serial.SerialException("device disconnected")

    def pull() -> None:
        for method in ("read", "write", "reset_input_buffer"):
            monkeypatch.setattr(FakeSerial, method, gone)

    with pytest.raises(TorqueNotOff, match=r"NOT CONFIRMED for JOINT 'SHOULDER'.*'ELBOW'.*cut the power") as caught:
        run(arm(), tmp_path / "run", at_sample(900, pull))
    assert isinstance(caught.value.__context__, PortLost)
    port = ports[0]
    port.clock.wait_until(port.clock.now() + 0.1)
    assert all(servo.watchdog_tripped and servo.goal_current_ticks == 0 for servo in port.bus.servos.values())
    assert len(load_samples(tmp_path / "run" / "samples.npy", 2)) >= 900


def test_an_alert_stops_the_arm(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    def overheat() -> None:
        ports[0].bus.servos[1].temperature_c = 95.0

    with pytest.raises(SafetyStop, match=r"'shoulder' \(ID 1.*alert"):
        run(arm(), tmp_path / "run", at_sample(900, overheat))
    assert_no_torque(ports[0])


def test_a_motion_that_never_settles_is_said(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    never = ("seed = 1\n", "seed = 1\nsettle_within = 1e-9\nmax_settling_periods = 2\n")
    with pytest.raises(NotSettled, match=r"After 2 periods of 2 s"):
        run(arm(never, *FEWER_SAMPLES), tmp_path / "run")
    assert_no_torque(ports[0])


def test_where_grease_warms_up_a_warm_up_is_proposed(arm: Arm, tmp_path: Path) -> None:
    warming = "cold_coulomb = 0.5\ncold_viscous = 0.5\nwarm_up_time = 6.0\n"
    drives = [(f"viscous = {each}", f"{warming}viscous = {each}") for each in ("0.045", "0.040")]
    never = ("seed = 1\n", "seed = 1\nsettle_within = 1e-4\nmax_settling_periods = 5\n")
    with pytest.raises(
        NotSettled, match=r"decreases slowly from period to period.*set experiment.warm_up = \d+"
    ) as caught:
        run(arm(never, *drives, *FEWER_SAMPLES), tmp_path / "run")
    seconds = float(str(caught.value).rsplit("= ", 1)[1].rstrip("."))
    assert 20.0 <= seconds <= 90.0  # 1e-4 of the motion is left after five or six times 6 s


def test_an_upright_arm_is_balanced_before_torque_is_cut(
    arm: Arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its stabiliser's springs leave it where gravity, friction and an offset hold it, from where it may fall."""
    pushed = [(f"offset = {each}", "offset = 0.08") for each in ("0.004", "-0.003")]
    upright = arm(*pushed, ("peak_torque = [0.60, 0.35]", "peak_torque = [0.3, 0.2]"), *QUICK, base="fake_inverted")

    def left_at(name: str) -> float:
        run(upright, tmp_path / name)
        last = load_samples(tmp_path / name / "samples.npy", 2)[-1]
        return float(np.abs(last["position"] - np.array(upright.arm.rest_pose)).max())

    assert left_at("balanced") <= 0.025
    assert '"balanced"' in (tmp_path / "balanced" / "events.jsonl").read_text(encoding="utf-8")
    monkeypatch.setattr("hil.experiment.stream.must_balance", lambda _: False)
    assert left_at("as it is") > 0.04


# Before torque is switched on


@pytest.mark.parametrize(
    ("change", "kind", "said"),
    [
        (("id = 2", "id = 7"), NoReply, r"'elbow' \(ID 7, XM430-W350\) does not answer at 1000000 baud"),
        (("baud = 1_000_000", "baud = 57600"), NoReply, r"'shoulder' \(ID 1.*at 57600 baud"),
        (('model = "XM430-W350"', 'model = "XM540-W270"'), WrongModel, r"an XM430-W350 answers at ID 1"),
        (("rest_pose = [-1.5707963, 0.0]", "rest_pose = [-1.5707963, 0.7]"), ExperimentError, r"set zero_ticks = 1592"),
        ((SERVO_1, SERVO_1 + 'registers = { "Drive Mode" = 8 }\n'), WrongSetting, r"'shoulder'.*Drive Mode is 8"),
        ((SERVO_1, SERVO_1 + "input_voltage_v = 5.0\n"), ServoFault, r"'shoulder' \(ID 1.*input voltage"),
    ],
)
def test_what_forbids_an_experiment_is_found_before_torque(
    arm: Arm, tmp_path: Path, ports: list[Any], change: tuple[str, str], kind: type[Exception], said: str
) -> None:
    with pytest.raises(kind, match=said):
        run(arm(change), tmp_path / "run")
    assert_no_torque(ports[0])
    assert ports[0].bus.plant.position == pytest.approx([-np.pi / 2, 0.0], abs=5e-3), "the arm did not move"


def test_a_servo_in_another_mode_is_brought_into_current_mode_and_back(
    arm: Arm, tmp_path: Path, ports: list[Any]
) -> None:
    seen: list[int] = []
    look = at_sample(10, lambda: seen.extend(servo.operating_mode for servo in ports[0].bus.servos.values()))
    run(arm(*QUICK), tmp_path / "run", look)  # like servos from the factory, the fake starts in position mode
    assert seen == [0, 0]
    assert [servo.operating_mode for servo in ports[0].bus.servos.values()] == [3, 3]


def test_factory_return_delay_is_waited_for(arm: Arm, tmp_path: Path) -> None:
    slow = ("zero_ticks = 2048\n\n[fake.arm]", "zero_ticks = 2048\nreturn_delay_us = 500\n\n[fake.arm]")
    samples = load_samples(run(arm(slow, *QUICK), tmp_path / "run").samples_path, 2)
    assert not samples["missing"].any()


def test_a_run_folder_that_is_taken_or_not_writable(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    config = arm()
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "something").touch()
    with pytest.raises(RunFolderError, match="not empty"):
        RunFolder.create(taken, config)
    with pytest.raises(RunFolderError, match="cannot be written"):
        RunFolder.create(taken / "something" / "run", config)
    assert ports == []


def test_driver_errors_are_one_family() -> None:
    assert issubclass(TorqueNotOff, DriverError)
    assert not issubclass(TorqueNotOff, ExperimentError)
