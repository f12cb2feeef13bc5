"""`hil setup` restores what a killed run left on all servos of the port; every other command reports it."""

import json
import os
import re
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import serial

from hil.config.schema import Config, load_config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import TorqueHeld, TorqueNotOff
from hil.fakes.bus.faults import Fault, FaultKind
from hil.setup.finding import Level
from hil.setup.preflight import check_arm
from hil.setup.session import killed_run, settings_file
from hil.setup.session.servo_session import servo_session
from tests.support.bench import SHORT, Arm, Bench
from tests.support.command_line import hil
from tests.support.edits import replaced
from tests.support.paths import CONFIGS
from tests.support.processes import forked

POSITION_MODE = 3
WHAT = "settings from an earlier run"


@pytest.fixture
def kill(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> Callable[[Config], None]:
    """Kills a run while torque is on: the program sends nothing more, and the watchdogs trip."""

    def killed(config: Config) -> None:
        with (
            monkeypatch.context() as gone,
            pytest.raises(TorqueNotOff),
            servo_session(config) as bus,
            bus.torque(0.1),
        ):
            gone.setattr(bench.port, "write", _lost)
            clock = bus.port.clock
            clock.wait_until(clock.now() + 1.0)
            bus.exchange([0.0] * len(bus.joints))
        monkeypatch.setattr(bench.port, "write", type(bench.port).write.__get__(bench.port))
        bench.port.close()
        assert all(servo.torque_enabled and servo.operating_mode == 0 for servo in bench.servos.values())

    return killed


def _lost(_: bytes) -> int:
    raise serial.SerialException("no such program")


def torque_on(bench: Bench, servo: int, mode: int) -> None:
    """Do what another program does to move a servo."""
    for register, value in ((64, 0), (98, 0), (11, mode), (64, 1)):
        bench.servos[servo].write(register, bytes((value,)))
    assert bench.servos[servo].torque_enabled


def elbow_only(path: Path) -> Config:
    """The configuration of the same arm without its shoulder."""
    text = path.read_text(encoding="utf-8")
    first = text.index("[[joints]]")
    text = text[:first] + text[text.index("[[joints]]", first + 1) :]
    for key, value in (("rest_pose", "[0.0]"), ("peak_torque", "[0.2]")):
        text = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
    text = re.sub(r"(?m)^gravity = \S+", "gravity = 0.0", text)
    path.with_name("elbow.toml").write_text(text, encoding="utf-8")
    return load_config(path.with_name("elbow.toml"))


def shared(config: Config, path: Path) -> Config:
    """Let a configuration use the port of the fake arm that the file `path` describes."""
    port = config.port.model_copy(update={"url": f"fake://{path}"})
    return config.model_copy(update={"port": port})


# hil setup


def test_setup_restores_every_servo_that_a_killed_run_left_on_the_port(
    arm: Arm, bench: Bench, kill: Any, state_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = arm(SHORT)
    kill(config)
    assert hil("setup", config.url, "--id", 1, "--return-delay-us", 20, "--yes") == 0
    said = capsys.readouterr().err
    for servo in (1, 2):
        assert f"ID {servo}: an earlier run ended before it could restore this servo; its torque was still on" in said
    assert said.count("Operating Mode 0 -> 3") == 2
    assert bench.changed() == ["Return Delay Time of 1: 0 -> 10"]
    assert list(state_folder.glob("*.json")) == []


@pytest.mark.parametrize(("writes", "left"), [(1, (1, 2)), (4, (2,))])
def test_a_cable_lost_while_setup_restores_leaves_no_doubt_about_torque(
    arm: Arm,
    bench: Bench,
    kill: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *,
    writes: int,
    left: tuple[int, ...],
) -> None:
    config = arm(SHORT)
    kill(config)
    write = type(bench.port).write
    sent: list[bytes] = []

    def until_lost(data: bytes) -> int:
        sent.append(data)
        return _lost(data) if len([each for each in sent if each[7] == 3]) > writes else write(bench.port, data)

    monkeypatch.setattr(bench.port, "write", until_lost)
    assert hil("setup", config.url, "--id", 1, "--return-delay-us", 20, "--yes") == 1
    said = capsys.readouterr().err
    torque = next(line for line in said.splitlines() if "perhaps with TORQUE ON" in line)
    assert [number for number in (1, 2) if f"ID {number} (" in torque] == list(left)
    assert "hil check, record, identify or setup on this port restores them" in torque


def silent_while_restoring(bench: Bench, monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Silence servo 1 for a while when the first setting of an earlier run is restored."""
    write = type(bench.port).write
    begun: list[bool] = []

    def silencing(data: bytes) -> int:
        is_setting = data[7] == 3 and data[8] in (11, 38)  # Operating Mode, Current Limit
        if is_setting and data[4] == 1 and not begun:
            begun.append(True)
            bus = bench.port.bus
            bus.faults.add(Fault(kind=FaultKind.SILENT_SERVO, servo=1, at=bus.time, duration=seconds))
        return write(bench.port, data)

    monkeypatch.setattr(bench.port, "write", silencing)


def restoring(command: str, config: Config) -> list[object]:
    """A command that restores what a killed run left: `hil setup` of servo 2, or `hil check` of the arm."""
    return ["setup", config.url, "--id", 2, "--yes"] if command == "setup" else ["check", config.path]


@pytest.mark.parametrize("command", ["setup", "check"])
def test_a_servo_that_reboots_while_it_is_restored_is_tried_again(
    command: str, arm: Arm, bench: Bench, kill: Any, state_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = arm(SHORT)
    kill(config)
    silent_while_restoring(bench, monkeypatch, 0.3)
    assert hil(*restoring(command, config)) == 0
    assert bench.changed() == [] and list(state_folder.glob("*.json")) == []


@pytest.mark.parametrize("command", ["setup", "check"])
def test_a_command_that_leaves_a_servo_unrestored_ends_with_an_error(
    command: str,
    arm: Arm,
    bench: Bench,
    kill: Any,
    state_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = arm(SHORT)
    kill(config)
    silent_while_restoring(bench, monkeypatch, 20.0)
    assert hil(*restoring(command, config)) == 1
    said = " ".join("".join(capsys.readouterr()).split())
    assert "not yet restored after an earlier run" in said or "settings from an earlier run: cannot be restored" in said
    assert "too late" not in said, "no reply was"
    assert len(list(state_folder.glob("*.json"))) == 1


@pytest.mark.parametrize("command", ["setup", "check"])
def test_a_signal_while_servos_are_restored_leaves_no_doubt_about_torque(
    command: str,
    arm: Arm,
    bench: Bench,
    kill: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = arm(SHORT)
    kill(config)

    def stopped(*_: Any) -> Any:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(killed_run, "put_back", stopped)
    assert hil(*restoring(command, config)) == 128 + signal.SIGTERM
    said = capsys.readouterr().err
    torque = next(line for line in said.splitlines() if "perhaps with TORQUE ON" in line)
    assert [number for number in (1, 2) if f"ID {number} (" in torque] == [1, 2]


def test_a_pipe_in_place_of_a_settings_file_is_a_damaged_file(
    arm: Arm, bench: Bench, capsys: pytest.CaptureFixture[str], state_folder: Path
) -> None:
    """Reading it would wait for a writer that never comes."""
    config = arm(SHORT)
    with servo_session(config):
        pass
    pipe = settings_file.settings_path(config.url, 2, "XM430-W350")
    os.mkfifo(pipe)
    assert f"ID 2: {pipe} is damaged or cannot be read" in scanned(config, capsys)


def test_setup_restores_the_other_servos_too_if_torque_is_off_already(
    arm: Arm, bench: Bench, kill: Any, state_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = arm(SHORT)
    kill(config)
    for servo in bench.servos.values():
        servo.write(64, b"\0")
    assert hil("setup", config.url, "--id", 1) == 0
    said = capsys.readouterr().err
    assert "ID 2: an earlier run" in said and "torque" not in said
    assert bench.changed() == [] and list(state_folder.glob("*.json")) == []
    assert hil("setup", config.url, "--id", 1) == 0
    assert capsys.readouterr().err == "", "nothing is left to announce"


@pytest.mark.parametrize("needed", [1, 2])
def test_setup_does_not_cut_torque_that_another_program_has_switched_on_since(
    arm: Arm, bench: Bench, kill: Any, capsys: pytest.CaptureFixture[str], needed: int
) -> None:
    """In position mode, the servo holds the arm, which would otherwise fall."""
    config = arm(SHORT)
    kill(config)
    torque_on(bench, 2, POSITION_MODE)
    assert hil("setup", config.url, "--id", needed) == (0 if needed == 1 else 2)
    said = capsys.readouterr().err
    assert "ID 2: its torque is on in Operating Mode 3" in said and "Stop that program" in said
    assert bench.servos[2].torque_enabled and bench.servos[2].operating_mode == POSITION_MODE
    assert not bench.servos[1].torque_enabled and bench.servos[1].operating_mode == POSITION_MODE
    assert settings_file.servos_on_file(config.url) == [(2, "XM430-W350")]


def test_check_and_run_do_not_cut_it_either(arm: Arm, bench: Bench, kill: Any) -> None:
    config = arm(SHORT)
    kill(config)
    torque_on(bench, 2, POSITION_MODE)
    with pytest.raises(TorqueHeld, match=r"^Joint 'elbow' \(ID 2"), servo_session(config):
        pass
    assert bench.servos[2].torque_enabled
    found = [each for each in check_arm(config) if "elbow" in each.where]
    assert any(each.level is Level.STOP and each.what == "torque" for each in found)
    assert bench.servos[2].torque_enabled


def test_setup_still_refuses_torque_that_no_run_left(
    arm: Arm, bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    config = arm(SHORT)
    with servo_session(config):
        pass
    torque_on(bench, 1, POSITION_MODE)
    assert hil("setup", config.url, "--id", 1, "--new-id", 7, "--yes") == 2
    assert "has torque on, which locks its EEPROM. Stop the program" in capsys.readouterr().err
    torque_on(bench, 1, 0)
    bench.servos[1].trip_watchdog()
    assert hil("setup", config.url, "--id", 1, "--new-id", 7, "--yes") == 2
    assert "A program left it on when it ended, and the servo's watchdog has tripped" in capsys.readouterr().err
    assert bench.servos[1].torque_enabled


def test_setup_names_the_servos_that_it_cannot_restore(
    arm: Arm, bench: Bench, kill: Any, state_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = arm(SHORT)
    kill(config)
    bench.port.bus.faults.add(Fault(kind="silent_servo", servo=2, at=0.0))
    assert hil("setup", config.url, "--id", 1) == 0
    (waiting,) = state_folder.glob("*.json")
    said = capsys.readouterr().err
    assert f"ID 2: not yet restored after an earlier run ({waiting}). " in said and "does not answer" in said
    assert {each.split(" of ")[1][0] for each in bench.changed()} == {"2"}
    bench.port.bus.faults.clear()
    waiting.write_text("{", encoding="utf-8")
    assert hil("setup", config.url, "--id", 1) == 0
    assert f"not yet restored after an earlier run. {waiting} is damaged" in capsys.readouterr().err
    assert hil("setup", config.url, "--id", 2) == 2
    assert bench.servos[2].torque_enabled, "its own program is not known"


# hil check and runs of another configuration


def test_a_servo_that_is_not_in_the_configuration_is_left_alone_and_what_a_killed_run_left_on_it_is_named(
    arm: Arm, bench: Bench, kill: Any, tmp_path: Path
) -> None:
    config = arm(SHORT)
    kill(config)
    elbow = shared(elbow_only(config.path), config.path)
    (kept,) = (each for each in map(_kept, (1, 2)) if each.id == 1)

    def assert_named(text: str) -> None:
        assert f"({kept.since}, {config.path})" in text and str(kept.path) in text
        assert "its torque is still on, Operating Mode is 0 and was 3, Goal Current is 0 and was 1193" in text
        assert text.endswith(f"type: hil check {config.path}")

    found = {(each.what, each.found): each for each in check_arm(elbow)}
    assert_named(found[WHAT, "not restored on ID 1, XM430-W350"].fix)
    assert found[WHAT, "not restored on ID 1, XM430-W350"].level is Level.WARNING
    said: list[str] = []
    with servo_session(elbow, say=said.append):
        pass
    assert_named(next(each for each in said if each.startswith("ID 1, XM430-W350: ")))
    assert bench.servos[1].torque_enabled and bench.servos[1].operating_mode == 0
    assert bench.servos[2].operating_mode == POSITION_MODE
    assert hil("check", config.path) == 0
    assert bench.changed() == []


def _kept(servo: int) -> settings_file.Kept:
    (path,) = settings_file.state_folder().glob(f"*_ID{servo}_*.json")
    kept = settings_file._parsed(path.read_bytes())
    assert kept is not None
    return kept


def test_a_configuration_from_which_the_servo_was_removed_is_not_named_as_the_remedy(
    arm: Arm, bench: Bench, kill: Any
) -> None:
    config = arm(SHORT)
    kill(config)
    elbow = shared(elbow_only(config.path), config.path)
    config.path.write_text(config.path.with_name("elbow.toml").read_text(encoding="utf-8"), encoding="utf-8")
    (found,) = (each for each in check_arm(elbow) if each.found.startswith("not restored on ID 1"))
    assert found.fix.endswith(f"type: hil setup {config.url} --id 1")
    assert hil("setup", config.url, "--id", 1) == 0
    assert bench.changed() == []


# hil scan


def scanned(config: Config, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert hil("scan", config.url, "--baud", 1_000_000) == 0
    return capsys.readouterr().out


def test_scan_names_what_a_killed_run_left_and_the_command_that_restores_it(
    arm: Arm, bench: Bench, kill: Any, capsys: pytest.CaptureFixture[str], state_folder: Path
) -> None:
    config = arm(SHORT)
    kill(config)
    before = bench.changed()
    out = scanned(config, capsys)
    assert out.count("torque on; watchdog tripped; settings not restored after an earlier run") == 2
    assert f"{config.path}) ended before it could restore this servo: its torque is still on, Operating Mode" in out
    assert out.splitlines()[-1] == f"Next: hil check {config.path}"
    assert bench.changed() == before and len(list(state_folder.glob("*.json"))) == 2, "nothing is written"
    assert hil("scan", config.url, "--baud", 1_000_000, "--json") == 0
    servo = json.loads(capsys.readouterr().out)["servos"][0]
    assert servo["restore"] == f"hil check {config.path}" and "Operating Mode is 0 and was 3" in servo["left"]
    assert hil("init", config.url, "--yes", "--out", config.path.with_name("new.toml")) == 1
    assert "Operating Mode is 0 and was 3" in capsys.readouterr().err
    assert hil("check", config.path) == 0
    out = scanned(config, capsys)
    assert out.splitlines()[-1].startswith("Next: hil init") and "torque" not in out and "restore" not in out


def test_a_file_of_an_earlier_version_names_no_configuration(
    arm: Arm, bench: Bench, kill: Any, capsys: pytest.CaptureFixture[str], state_folder: Path
) -> None:
    config = arm(SHORT)
    kill(config)
    for path in state_folder.glob("*.json"):
        values = json.loads(path.read_text(encoding="utf-8"))
        del values["config"]
        path.write_text(json.dumps(values), encoding="utf-8")
    assert scanned(config, capsys).splitlines()[-1] == f"Next: hil setup {config.url} --id 1"
    assert hil("setup", config.url, "--id", 1) == 0
    assert bench.changed() == []


def test_scan_names_torque_that_no_run_left_and_a_damaged_file(
    arm: Arm, bench: Bench, capsys: pytest.CaptureFixture[str], state_folder: Path
) -> None:
    config = arm(SHORT)
    with servo_session(config):
        pass
    torque_on(bench, 1, POSITION_MODE)
    damaged = settings_file.settings_path(config.url, 2, "XM430-W350")
    damaged.write_text("{", encoding="utf-8")
    out = scanned(config, capsys)
    assert "torque on" in out and "watchdog" not in out
    assert f"ID 2: {damaged} is damaged" in out


def test_pose_names_what_a_killed_run_left(bench: Bench, kill: Any, capsys: pytest.CaptureFixture[str]) -> None:
    config = load_config(CONFIGS / "fake_open_manipulator_x.toml")
    kill(config)
    hil("pose", config.path)
    said = capsys.readouterr().err
    assert said.count("ended before it could restore this servo: its torque is still on") == len(bench.servos)
    assert "Operating Mode is " in said and f"type: hil check {config.path}" in said


# Processes


def test_a_process_killed_in_its_run_is_named_by_scan_and_restored_by_setup(
    arm_file: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two programs, a real SIGKILL between them, and the fake arm in a third process."""
    path, link = arm_file(), tmp_path / "tty"
    words = ["hil", "fake", str(path), "--pty", "--link", str(link), "--quiet"]
    served = forked.start(words, stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout is not None and served.stdout.readline()
        real = path.with_name("real.toml")
        text = path.read_text(encoding="utf-8").split("\n[fake]\n")[0]
        real.write_text(replaced(text, ('"fake://"', f'"{link}"')), encoding="utf-8")
        code = (
            "import os, signal, sys; from pathlib import Path; from hil.config.schema import load_config;"
            "from hil.setup.session.servo_session import servo_session\n"
            "with servo_session(load_config(Path(sys.argv[1]))) as bus, bus.torque(0.1):\n"
            "    os.kill(os.getpid(), signal.SIGKILL)"
        )
        assert forked.run([forked.CODE, code, str(real)]).returncode == -9
        assert hil("check", elbow_only(real).path) in (0, 1)
        assert f"hil check {real}" in " ".join(capsys.readouterr().out.split())
        assert hil("scan", link, "--baud", 1_000_000) == 0
        out = capsys.readouterr().out
        assert "torque on; watchdog tripped; settings not restored after an earlier run" in out
        assert out.splitlines()[-1] == f"Next: hil check {real}"
        assert hil("setup", link, "--id", 1) == 0
        with ServoBus.connect(load_config(real).bus) as bus:
            servos = [bus.servo(joint) for joint in bus.joints]
            assert [servo.read("Operating Mode") for servo in servos] == [POSITION_MODE, POSITION_MODE]
            assert [servo.read("Torque Enable") for servo in servos] == [0, 0]
        assert settings_file.servos_on_file(str(link)) == []
    finally:
        served.terminate()
        served.wait()
