"""What a killed program left is restored by the next one, and what was changed since stays."""

import errno
import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial

from hil.config.schema import Config, load_config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import PortLost, TorqueNotOff, WrongSetting
from hil.errors import RunFolderError
from hil.fakes.bus.faults import Fault
from hil.fakes.servo.servo import EmulatedServo
from hil.setup.finding import Level
from hil.setup.preflight import check_arm
from hil.setup.session import settings_file
from hil.setup.session.saved_settings import SavedSettings
from hil.setup.session.servo_session import servo_session
from hil.setup.session.settings_file import settings_path
from tests.support.bench import SHORT, Arm, Bench, play
from tests.support.command_line import hil
from tests.support.processes import forked


def test_settings_that_a_killed_program_left_are_restored_up_to_a_limit_lowered_since(
    arm: Arm, bench: Bench, state_folder: Path
) -> None:
    config = arm(SHORT)
    joint = config.bus.joints[1]
    with servo_session(config):
        bench.servos[2].write(36, (300).to_bytes(2, "little"))
        kept = settings_path(config.url, joint.id, joint.servo.name)
        left = kept.read_text(encoding="utf-8")
        bench.servos[2].write(36, (885).to_bytes(2, "little"))
    bench.servos[2].write(36, (300).to_bytes(2, "little"))
    kept.write_text(left, encoding="utf-8")
    list(check_arm(config))
    assert kept.exists() and bench.servos[2].value("Goal PWM") == 300, "the rest once the limit allows it"
    bench.servos[2].write(36, (885).to_bytes(2, "little"))
    list(check_arm(config))
    assert not kept.exists() and bench.servos[2].value("Goal PWM") == 885


def test_settings_are_found_by_their_adapter_whatever_its_port_is_called_now(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a pulled cable, ttyUSB0 may come back as ttyUSB1, and another arm's adapter as ttyUSB0."""
    plugged = {"/dev/ttyUSB0": "usb-A", "/dev/ttyUSB1": "usb-B"}
    monkeypatch.setattr("hil.setup.session.settings_file.adapter_name", lambda port: plugged.get(port, ""))
    kept = settings_file.keep("/dev/ttyUSB0", 1, "XM430-W350", {"Operating Mode": 3}, {"Operating Mode": 0})
    plugged.clear()
    assert settings_file.load("/dev/ttyUSB0", 1, "XM430-W350") is None
    plugged.update({"/dev/ttyUSB0": "usb-B", "/dev/ttyUSB1": "usb-A"})
    assert settings_file.load("/dev/ttyUSB0", 1, "XM430-W350") is None
    assert settings_file.load("/dev/ttyUSB1", 1, "XM430-W350") == kept
    settings_file.forget(kept)
    assert settings_file.load("/dev/ttyUSB1", 1, "XM430-W350") is None


def test_settings_are_found_by_a_link_and_by_the_device_behind_it(tmp_path: Path) -> None:
    device, link, other = tmp_path / "ttyX", tmp_path / "arm", tmp_path / "other"
    device.touch(), other.touch(), link.symlink_to(device)
    kept = settings_file.keep(str(link), 1, "XM430-W350", {"Operating Mode": 3}, {"Operating Mode": 0})
    assert settings_file.load(str(device), 1, "XM430-W350") == kept
    assert settings_file.load(str(other), 1, "XM430-W350") is None
    assert settings_file.load(str(device), 2, "XM430-W350") is None
    again = settings_file.keep(str(device), 1, "XM430-W350", kept.settings, kept.changed)
    assert settings_file.load(str(link), 1, "XM430-W350") == again
    assert len(list(settings_file.state_folder().iterdir())) == 1


def test_a_servo_whose_watchdog_has_tripped_is_not_said_to_be_driven(arm: Arm, bench: Bench) -> None:
    config = arm(SHORT)
    with servo_session(config):
        pass
    bench.servos[1].write(64, b"\1")
    bench.servos[1].trip_watchdog()
    torque = next(each for each in check_arm(config) if each.what == "torque")
    assert torque.level is Level.STOP and "the servo's watchdog has tripped" in torque.fix


def test_threads_that_save_at_once_and_a_folder_removed_meanwhile_are_no_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each thread of a program may run its own copy of one fake arm, whose settings have one file."""
    settings = {"Operating Mode": 3}

    def save(_: int) -> None:
        settings_file.forget(settings_file.keep("fake://arm.toml", 1, "XM430-W350", settings, {}))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(save, range(200)))
    assert not list(settings_file.state_folder().iterdir())
    removed = iter([True, False])

    def removing(descriptor: int) -> None:
        if next(removed, False):
            shutil.rmtree(settings_file.state_folder())

    monkeypatch.setattr(os, "fsync", removing)
    kept = settings_file.keep("fake://arm.toml", 1, "XM430-W350", settings, {})
    assert settings_file.load("fake://arm.toml", 1, "XM430-W350") == kept


def test_settings_that_cannot_be_saved_are_said_in_one_sentence(
    arm: Arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    config, said = arm(SHORT), list[str]()
    bus: Any = SimpleNamespace(port=SimpleNamespace(url=config.url))
    settings = {"Current Limit": 910, "Operating Mode": 3, "Shutdown": 52}
    SavedSettings(bus, said.append).save(config.bus.joints[0], settings, {})
    assert "cannot be saved where" in said[0] and ".json cannot be written: Not a directory. If this program" in said[0]
    assert "Operating Mode 3, Current Limit 910." in said[0] and "servo_settings.json" in said[0]


def test_nothing_is_left_of_a_file_that_could_not_be_written(
    state_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunFolderError, match="No space left"):
        settings_file.keep("fake://arm.toml", 1, "XM430-W350", {}, {})
    assert list(state_folder.rglob("*")) == [] or not [each for each in state_folder.rglob("*") if each.is_file()]


@pytest.mark.parametrize("contents", ["", '{"schema": 1, "port": "fa', '{"schema": 99}'])
def test_a_damaged_file_is_neither_ignored_nor_overwritten(
    arm: Arm, bench: Bench, state_folder: Path, contents: str
) -> None:
    """The servos may still have the killed run's settings, which must not be taken for their own."""
    config = arm(SHORT)
    joint = config.bus.joints[1]
    path = settings_path(config.url, joint.id, joint.servo.name)
    path.parent.mkdir(parents=True)
    path.write_text(contents, encoding="utf-8")
    with (
        pytest.raises(WrongSetting, match=r"ID2_XM430-W350\.json is damaged .*servo_settings\.json"),
        servo_session(config),
    ):
        pass
    assert bench.changed() == [] and path.read_text(encoding="utf-8") == contents
    assert any(
        finding.level is Level.STOP and "is damaged" in finding.fix and finding.where == str(joint)
        for finding in check_arm(config)
    )
    path.unlink()
    with servo_session(config):
        pass


def test_a_file_that_cannot_be_removed_is_named(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    config, said = arm(SHORT), list[str]()

    def read_only(_path: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    with servo_session(config, say=said.append):
        monkeypatch.setattr(Path, "unlink", read_only)
    assert len([each for each in said if "cannot be removed: Read-only" in each and "Remove it" in each]) == 2


def test_a_file_that_was_never_written_need_not_be_removed(state_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a read-only disk, removing a file that does not exist fails too."""

    def read_only(_path: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "unlink", read_only)
    kept = settings_file.Kept("fake://arm.toml", 1, "XM430-W350", {}, {}, 0, "")
    assert settings_file.forget(kept) == ""


class _Gone(BaseException):
    """Simulates the end of the program."""


def test_a_killed_run_is_put_back_by_the_next_one_and_by_check(
    arm: Arm, tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = arm(SHORT)

    def kill() -> None:
        with pytest.raises(TorqueNotOff), servo_session(config) as bus, bus.torque(0.1):
            write = bench.port.write
            monkeypatch.setattr(bench.port, "write", _raise)  # nothing leaves a killed program
            bench.port.clock.wait_until(bench.port.clock.now() + 1.0)
            raise _Gone
        monkeypatch.setattr(bench.port, "write", write)
        bench.port.close()

    kill()
    assert bench.changed(), "mode and torque are as the killed run left them"
    play(config, tmp_path / "next")
    assert "earlier run" in capsys.readouterr().err
    assert bench.changed() == []
    kill()
    levels = [finding.level for finding in check_arm(config)]
    assert Level.STOP not in levels
    assert bench.changed() == []


def _raise(_: bytes) -> int:
    raise serial.SerialException("no such program")


def test_what_somebody_set_since_a_kill_stays(arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)
    for servo in bench.servos.values():
        servo.write(11, bytes((4,)))
    list(check_arm(config))
    assert [servo.operating_mode for servo in bench.servos.values()] == [4, 4]


def test_what_was_put_back_in_part_is_put_back_whole(arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)
    for servo in bench.servos.values():
        servo.write(11, bytes((3,)))
        servo.write(102, (7).to_bytes(2, "little"))
    list(check_arm(config))
    assert bench.changed() == []


LOWERED = 60
"""A Current Limit that is too low for the arm [ticks]."""


def kill(config: Config, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as gone, pytest.raises(PortLost), servo_session(config) as bus:
        gone.setattr(bench.port, "write", _raise)  # nothing leaves a killed program
        bus.exchange([0.0, 0.0])
    monkeypatch.setattr(bench.port, "write", type(bench.port).write.__get__(bench.port))
    bench.port.close()


def lower(servo: EmulatedServo, limit: int) -> None:
    servo.write(38, limit.to_bytes(2, "little"))
    assert servo.value("Current Limit") == limit


def test_a_current_limit_that_another_program_lowered_before_a_kill_stays_on_file_until_it_is_restored(
    arm: Arm, tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch, state_folder: Path
) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)
    lower(bench.servos[2], LOWERED)
    for number in range(3):
        said: list[str] = []
        with (
            pytest.raises(WrongSetting, match="Current Limit is 60, but") as refused,
            servo_session(config, say=said.append),
        ):
            play(config, tmp_path / str(number))
        assert "restore" not in " ".join(refused.value.__notes__), "nothing is promised"
        assert f"ts Current Limit is {LOWERED} and was 1193 before the run of" in said[-1]
        assert ("this one will" in said[-1]) is (number == 0), "all the rest is restored once"
        assert bench.changed() == [f"Current Limit of 2: 1193 -> {LOWERED}", f"Goal Current of 2: 1193 -> {LOWERED}"]
    (found,) = (each for each in check_arm(config) if each.what == "settings from an earlier run")
    assert found.level is Level.WARNING and "was 1193 before the run of" in found.fix
    lower(bench.servos[2], 1193)
    with servo_session(config):
        pass
    assert bench.changed() == [] and list(state_folder.glob("*.json")) == []


def test_a_current_limit_that_another_program_lowered_and_that_suffices_is_the_servos_own(
    arm: Arm, tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch, state_folder: Path
) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)
    lower(bench.servos[2], 900)
    said: list[str] = []
    with servo_session(config, say=said.append):
        play(config, tmp_path / "next")
    assert "Its Current Limit is 900 and was 1193" in said[-1]
    assert bench.changed() == ["Current Limit of 2: 1193 -> 900", "Goal Current of 2: 1193 -> 900"]
    assert list(state_folder.glob("*.json")) == []


@pytest.mark.parametrize("answers", [True, False])
def test_a_start_that_is_stopped_before_it_reaches_a_servo_restores_it_too_or_says_so(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch, state_folder: Path, answers: bool
) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)

    def stop(said: str) -> None:
        assert "'shoulder'" in said
        if not answers:
            bench.port.bus.faults.add(Fault(kind="silent_servo", servo=2, at=0.0))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped, servo_session(config, say=stop):
        pass
    waiting = [each.name for each in state_folder.glob("*.json")]
    if answers:
        assert bench.changed() == [] and waiting == []
        return
    assert len(waiting) == 1 and {each.split(" of ")[1][0] for each in bench.changed()} == {"2"}
    (told,) = (note for note in stopped.value.__notes__ if "are not restored yet" in note)
    assert "left on joint 'elbow' (ID 2, XM430-W350)" in told and told.endswith(f"{waiting[0]}.")


def test_a_killed_process_on_a_pty_is_put_back(arm_file: Any, tmp_path: Path) -> None:
    """Two programs, a real SIGKILL between them, and the fake arm in a third process."""
    path = arm_file()
    link = tmp_path / "arm"
    words = ["hil", "fake", str(path), "--pty", "--link", str(link), "--quiet"]
    served = forked.start(words, stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout is not None and served.stdout.readline()
        real = path.with_name("real.toml")
        real.write_text(path.read_text().split("\n[fake]\n")[0].replace('"fake://"', f'"{link}"'))
        config = load_config(real)
        code = (
            "import os, signal, sys; from pathlib import Path; from hil.config.schema import load_config;"
            "from hil.setup.session.servo_session import servo_session\n"
            "with servo_session(load_config(Path(sys.argv[1]))): os.kill(os.getpid(), signal.SIGKILL)"
        )
        killed = forked.run([forked.CODE, code, str(real)])
        assert killed.returncode == -9
        with ServoBus.connect(config.bus) as bus:
            assert [bus.servo(joint).read("Operating Mode") for joint in bus.joints] == [0, 0]
        assert hil("check", real) in (0, 1)
        with ServoBus.connect(config.bus) as bus:
            assert [bus.servo(joint).read("Operating Mode") for joint in bus.joints] == [3, 3]
    finally:
        served.terminate()
        served.wait()
