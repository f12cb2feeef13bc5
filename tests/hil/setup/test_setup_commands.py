"""scan, check and setup on the fake bus: findings, changes, and what must stay unchanged."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import serial
from typer.testing import CliRunner

from hil import fakes
from hil.cli.app import app
from hil.cli.views.setup_view import print_scan
from hil.config.schema import Config, load_config
from hil.drivers.errors import NoReply, PortLost, WrongSetting
from hil.drivers.port import Port, open_port
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.faults import Fault
from hil.fakes.description import load_fake
from hil.fakes.protocol_fake import open_fake
from hil.plan import chain_plan
from hil.plan.chain_model import described_torque, known_chain
from hil.plan.chain_plan import NoHeadroom
from hil.setup import preflight
from hil.setup.finding import Finding, Level
from hil.setup.preflight import check_arm
from hil.setup.scan import Asking, Found, Heard, listen, scan
from hil.setup.servo_settings import open_servo, set_up
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

Arm = Callable[..., Config]
ArmFile = Callable[..., Path]

SERVO_2 = 'id = 2\nmodel = "XM430-W350"\nzero_ticks = 2048\n'


@pytest.fixture
def port(arm_file: ArmFile) -> Iterator[Callable[..., Port]]:
    """Opens the port of the fake arm with changes to its TOML; `._serial.bus` has its servos."""
    opened = []
    fakes.register()

    def make(*changes: tuple[str, str], baud: int = 1_000_000) -> Port:
        opened.append(open_port(f"fake://{arm_file(*changes)}", baud))
        return opened[-1]

    yield make
    for each in opened:
        each.close()


def invoke(*words: object, answer: str = "") -> Any:
    return CliRunner().invoke(app, [str(word) for word in words], input=answer)


# scan


def test_scan_finds_servos_at_every_baud(port: Callable[..., Port]) -> None:
    heard = list(scan(port((SERVO_2, SERVO_2 + "baud = 57600\ninput_voltage_v = 11.5\n"))))
    found = {(servo.baud, servo.id): servo for each in heard for servo in each.servos}
    assert set(found) == {(57_600, 2), (1_000_000, 1)}
    elbow = found[57_600, 2]
    assert (elbow.model, elbow.firmware, elbow.temperature, elbow.trouble) == ("XM430-W350", 48, 35.0, "")
    assert elbow.voltage == pytest.approx(11.5)
    assert len(heard) == 8


def test_scan_says_what_ails_a_servo(port: Callable[..., Port]) -> None:
    (heard,) = scan(port((SERVO_2, SERVO_2 + "input_voltage_v = 5.0\n")), [1_000_000])
    assert heard.servos[1].trouble == "hardware error: input voltage; reboot it"


def test_scan_of_more_servos_than_init_describes_says_so() -> None:
    out = invoke("scan", "fake://configs/leg.toml", "--baud", 1_000_000).output
    assert "`hil init` describes arms of one or two joints" in out and "docs/estimating.md" in out
    assert "describes arms" not in invoke("scan", "fake://configs/fake_two_link.toml", "--baud", 1_000_000).output


def test_scan_hears_that_answers_are_damaged(port: Callable[..., Port], monkeypatch: pytest.MonkeyPatch) -> None:
    read = FakeBus.read
    monkeypatch.setattr(FakeBus, "read", lambda bus, *a: read(bus, *a).replace(b"\x55", b"\x54"))
    (heard,) = scan(port(), [1_000_000])
    assert heard.servos == ()
    assert "same ID" in heard.trouble


@pytest.mark.parametrize("turned", [0, 300])
def test_scan_sees_two_servos_with_one_id_although_their_pings_are_alike(turned: int) -> None:
    """As with two new servos, both of ID 1; those that have just been switched on differ in their positions only."""
    description = load_fake(CONFIGS / "fake_pendulum.toml")
    (servo,) = description.servos
    other = servo.model_copy(update={"joint": 1, "zero_ticks": servo.zero_ticks + turned})
    twins = open_fake(description.model_copy(update={"servos": (servo, other)}))
    (found,) = listen(Port("fake://", 1_000_000, twins), 0.01).servos
    assert ("second servo with ID 1" in found.trouble) == bool(turned)


def test_scan_goes_past_a_baud_that_the_adapter_cannot_do(
    port: Callable[..., Port], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = port()
    reconfigure = opened._serial._reconfigure_port

    def refuse(*words: Any) -> None:
        if opened._serial.baudrate == 4_500_000:
            raise ValueError("Invalid baud rate")
        reconfigure(*words)

    monkeypatch.setattr(opened._serial, "_reconfigure_port", refuse)
    refused, fine = scan(opened, [4_500_000, 1_000_000])
    assert "4500000 baud" in refused.trouble
    assert len(fine.servos) == 2


def test_scan_command(arm_file: ArmFile) -> None:
    result = invoke("scan", arm_file(), "--baud", 1_000_000, "--json")
    assert result.exit_code == 0
    assert [servo["id"] for servo in json.loads(result.stdout)["servos"]] == [1, 2]
    result = invoke("scan", arm_file(), "--baud", 9600)
    assert result.exit_code == 1
    assert "No servo answered" in result.stdout


@pytest.mark.parametrize(
    ("port", "command"),
    [
        ("arm9", "init arm9 --out my_arm.toml"),
        ("COM3", "init COM3 --out my_arm.toml"),
        ("/dev/ttyUSB0", "init /dev/ttyUSB0 --out my_arm.toml"),
        ("only_fake.toml", "init only_fake.toml --out my_arm.toml"),
        ("xm430_two_link", "check xm430_two_link"),
        ("arm.toml", "check arm.toml"),
    ],
)
def test_after_a_scan_a_device_is_described_and_a_configuration_checked(
    port: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("arm9").symlink_to("/dev/null")
    Path("only_fake.toml").write_text("[fake]\n", encoding="utf-8")
    print_scan([Heard(1_000_000, (Found(1_000_000, 1, 1020, "XM430-W350", 48, 12.0, 35.0, ""),), "")], port)
    assert capsys.readouterr().out.splitlines()[-1] == f"Next: hil {command}"


def test_a_scan_says_what_to_do_about_torque_that_is_on(capsys: pytest.CaptureFixture[str]) -> None:
    first, second = (Found(1_000_000, number, 1020, "XM430-W350", 48, 12.0, 35.0, "torque on") for number in (1, 2))
    print_scan([Heard(1_000_000, (first, second._replace(left="A killed run ...")), "")], "/dev/null")
    said = capsys.readouterr().out
    assert "Torque is on at ID 1: another program" in said and "at ID 2: another" not in said


# check


def look(config: Config) -> dict[tuple[str, str], Finding]:
    fakes.register()
    return {(finding.where.split(" (")[0], finding.what): finding for finding in check_arm(config)}


def test_a_healthy_arm_is_ready(arm: Arm) -> None:
    found = look(arm())
    assert {finding.level for finding in found.values()} == {Level.OK}
    assert "400 Hz wanted, 900 Hz possible with Fast Sync Read, one write" in found["bus", "rate"].found


def test_a_rest_pose_inside_the_floor_is_found_by_the_check(tmp_path: Path) -> None:
    urdf = "open_manipulator_x_like.urdf"
    (tmp_path / urdf).write_bytes((CONFIGS / urdf).read_bytes())
    text = (CONFIGS / "fake_open_manipulator_x.toml").read_text(encoding="utf-8")
    text = replaced(text, ("period = 10.0", "period = 5.0"), ("rate = 400.0", "rate = 200.0"))
    (tmp_path / "arm.toml").write_text(text, encoding="utf-8")
    found = look(load_config(tmp_path / "arm.toml"))
    assert found["arm", "rest pose"].level is found["experiment", "path"].level is Level.OK
    high = re.sub(r'(?m)^floor = "none".*$', "floor = 0.2", text)
    assert high != text
    (tmp_path / "arm.toml").write_text(high, encoding="utf-8")
    wrong = look(load_config(tmp_path / "arm.toml"))["arm", "rest pose"]
    assert wrong.level is Level.STOP and "arm.rest_pose puts" in wrong.fix
    described = (tmp_path / urdf).read_text(encoding="utf-8")
    (tmp_path / urdf).write_text(re.sub(r"<box size=", "<mesh filename=", described, count=1), encoding="utf-8")
    doubted = look(load_config(tmp_path / "arm.toml"))["arm", "description"]
    assert doubted.level is Level.WARNING and "is not used: there is no such file" in doubted.fix


def test_check_reports_a_path_that_a_run_would_refuse() -> None:
    spatial = load_config(CONFIGS / "fake_open_manipulator_x.toml")
    (missing,) = preflight._path(spatial.model_copy(update={"joint_path": None}))
    assert missing.level is Level.STOP and "experiment.pilot = true, which finds" in missing.fix
    weak = [joint.model_copy(update={"current_limit": 0.1}) for joint in spatial.joints]
    (heavy,) = preflight._path(spatial.model_copy(update={"joints": weak}))
    assert heavy.level is Level.STOP and "lower joint_path.speed or swing" in heavy.fix
    known = known_chain(spatial)
    thought, path = described_torque(spatial, known), chain_plan._designed(known, spatial, "identify", 1)
    designed = spatial.model_copy(update={"joints": weak, "joint_path": None})
    with pytest.raises(NoHeadroom, match="current_limit") as found:
        chain_plan._check_torque(designed, thought, path)
    assert "joint_path" not in str(found.value), "the file has no such table"


@pytest.mark.parametrize(
    ("change", "what", "level", "fix"),
    [
        ((SERVO_2, SERVO_2 + "return_delay_us = 500\n"), "return delay", Level.WARNING, "--return-delay-us 0"),
        ((SERVO_2, SERVO_2 + 'registers = { "Drive Mode" = 8 }\n'), "drive mode", Level.STOP, "torque on"),
        ((SERVO_2, SERVO_2 + 'registers = { "Drive Mode" = 1 }\n'), "drive mode", Level.STOP, "them with hil init"),
        ((SERVO_2, SERVO_2 + 'registers = { "Homing Offset" = -1025 }\n'), "homing offset", Level.STOP, "to 4"),
        ((SERVO_2, SERVO_2 + 'registers = { "Current Limit" = 100 }\n'), "current limit", Level.STOP, "is 0.8 A"),
        ((SERVO_2, SERVO_2 + 'registers = { "Shutdown" = 0 }\n'), "shuts down on", Level.WARNING, "factory value"),
        ((SERVO_2, SERVO_2 + "temperature_c = 79.0\n"), "temperature", Level.WARNING, "cool down"),
        ((SERVO_2, SERVO_2 + "input_voltage_v = 5.0\n"), "voltage", Level.STOP, "supply"),
        ((SERVO_2, SERVO_2 + "input_voltage_v = 5.0\n"), "hardware error", Level.STOP, "power-cycle"),
        (
            (SERVO_2, SERVO_2 + 'input_voltage_v = 5.0\nregisters = { "Shutdown" = 53 }\n'),
            *("hardware error", Level.STOP, "torque stays off until it is rebooted"),
        ),
        ((SERVO_2, SERVO_2 + "firmware = 38\n"), "firmware", Level.OK, ""),
        ((SERVO_2, SERVO_2.replace("2048", "3000")), "pose", Level.STOP, "zero_ticks = 3000"),
        (("id = 2", "id = 7"), "answers", Level.STOP, "hil scan"),
        (('model = "XM430-W350"', 'model = "XM540-W270"'), "model", Level.STOP, "Correct `model`"),
    ],
)
def test_what_would_stop_an_experiment_is_found_with_how_to_mend_it(
    arm: Arm, change: tuple[str, str], what: str, level: Level, fix: str
) -> None:
    found = look(arm(change))
    finding = next(finding for (where, each), finding in found.items() if each == what and finding.level is level)
    assert fix in finding.fix
    if level is Level.STOP:
        assert "Fix the servo problems above first" in found["bus", "rate"].fix


def test_a_torque_that_identify_would_miss_is_missed_by_the_check(arm: Arm) -> None:
    finding = look(
        arm(("peak_torque = [0.80, 0.42]", "pilot = false"), ("rest_pose =", "link_lengths = [0.2, 0.2]\nrest_pose ="))
    )["experiment", "torque"]
    assert finding.level is Level.STOP and "pilot = true" in finding.fix


def test_a_rate_that_the_bus_cannot_hold_is_a_stop_with_the_rate_that_it_can(arm: Arm) -> None:
    found = look(arm(("rate = 400.0", "rate = 1200.0")))
    assert found["bus", "rate"].level is Level.STOP
    assert found["bus", "rate"].fix.startswith("Set experiment.rate to at most 900")


def test_an_arm_that_needs_two_writes_is_found(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bus receives only the first packet of each write."""
    write = FakeBus.write
    monkeypatch.setattr(FakeBus, "write", lambda bus, data: write(bus, data[: 7 + (data[5] | data[6] << 8)]))
    finding = look(arm())["bus", "rate"]
    assert finding.level is Level.STOP
    assert finding.fix == "Set port.one_write = false and port.fast_sync_read = true."


def test_a_cable_that_is_pulled_during_the_check_is_named(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(*_: object, **__: object) -> int:
        raise PortLost("The cable is out.")

    monkeypatch.setattr("hil.drivers.servo.Servo.ping", lost)
    finding = look(arm())["joint 'shoulder'", "port"]
    assert (finding.level, finding.found, finding.fix) == (Level.STOP, "lost", "The cable is out.")


def test_check_changes_nothing(arm: Arm, ports: list[Any]) -> None:
    look(arm())
    servos = ports[0].bus.servos.values()
    assert all(servo.read(11, 1)[1] == b"\x03" for servo in servos), "still in position mode"
    assert not any(servo.torque_enabled for servo in servos)


def test_check_does_not_touch_an_arm_that_somebody_drives(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    open_port = serial.serial_for_url

    def driven(*args: Any, **kwargs: Any) -> Any:
        port = open_port(*args, **kwargs)
        for servo in port.bus.servos.values():
            servo.write(64, b"\1")
        return port

    monkeypatch.setattr(serial, "serial_for_url", driven)
    found = look(arm())
    assert found["joint 'elbow'", "torque"].level is Level.STOP
    assert found["bus", "rate"].found == "not measured"


def test_a_port_that_does_not_open_is_a_finding(arm: Arm) -> None:
    found = look(arm(('url = "fake://"', 'url = "/dev/no-such-port"')))
    assert found["/dev/no-such-port", "port"].level is Level.STOP


def test_check_command(arm_file: ArmFile) -> None:
    result = invoke("check", arm_file())
    assert result.exit_code == 0
    assert "Next: hil identify" in result.stdout, "without link lengths there is no dry run"
    result = invoke("check", arm_file(("[arm]\n", "[arm]\nlink_lengths = [0.147, 0.18]\n")))
    assert "Next: hil dry-run" in result.stdout
    result = invoke("check", arm_file((SERVO_2, SERVO_2 + "input_voltage_v = 5.0\n")), "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["ready"] is False


# setup


def test_everything_is_set_after_a_question_each_and_read_back(port: Callable[..., Port]) -> None:
    asked: list[str] = []

    def yes(question: str) -> bool:
        asked.append(question)
        return True

    opened = port()
    changes = set_up(open_servo(opened, 2), yes, new_id=9, new_baud=57_600, return_delay_us=20)
    assert [(change.register, change.written) for change in changes] == [
        ("Return Delay Time", True),
        ("ID", True),
        ("Baud Rate", True),
    ]
    assert len(asked) == 3
    assert opened.baud == 57_600
    assert open_servo(opened, 9).read("Return Delay Time") == 10


def test_nothing_is_written_without_a_yes(port: Callable[..., Port]) -> None:
    opened = port()
    changes = set_up(open_servo(opened, 2), lambda _: False, new_id=9, new_baud=57_600, return_delay_us=20)
    assert not any(change.written for change in changes)
    assert open_servo(opened, 2).read("Return Delay Time") == 0


def test_what_is_so_already_is_not_asked_for(port: Callable[..., Port]) -> None:
    def never(question: str) -> bool:
        raise AssertionError(question)

    changes = set_up(open_servo(port(), 2), never, new_id=2, new_baud=1_000_000, return_delay_us=0)
    assert not any(change.written for change in changes)


def test_an_id_that_is_taken_is_not_given_twice(port: Callable[..., Port]) -> None:
    with pytest.raises(WrongSetting, match="ID 1 is taken"):
        set_up(open_servo(port(), 2), lambda _: True, new_id=1, new_baud=None, return_delay_us=None)


def test_a_stop_between_two_changes_names_the_first(port: Callable[..., Any]) -> None:
    questions = iter([True])

    def asked(_question: str) -> bool:
        if (answer := next(questions, None)) is None:
            raise KeyboardInterrupt
        return answer

    with pytest.raises(KeyboardInterrupt) as stopped:
        set_up(open_servo(port(), 2), asked, new_id=9, return_delay_us=20)
    assert stopped.value.__notes__ == ["Already changed: Return Delay Time from 0 to 20."]


def test_a_servo_with_torque_is_left_alone(port: Callable[..., Port]) -> None:
    opened = port()
    open_servo(opened, 2).write("Torque Enable", 1)
    with pytest.raises(WrongSetting, match="torque on"):
        open_servo(opened, 2)


def test_a_servo_that_is_not_there(port: Callable[..., Port]) -> None:
    with pytest.raises(NoReply, match="The servo with ID 5 does not answer"):
        open_servo(port(), 5)


def test_setup_command_asks(arm_file: ArmFile) -> None:
    words = ("setup", arm_file(), "--id", 2, "--new-id", 9)
    assert "left at 2" in invoke(*words, answer="n\n").stdout
    assert "2 -> 9, read back" in invoke(*words, answer="y\n").stdout
    assert json.loads(invoke(*words, "--yes", "--json").stdout)["changes"][0]["written"] is True
    assert invoke(*words, "--json").exit_code == 2
    assert invoke("setup", arm_file(), "--id", 2, "--new-baud", 12345).exit_code == 2


def test_setup_reports_the_units_that_it_asks_in(arm_file: ArmFile) -> None:
    words = ("setup", arm_file(), "--id", 2, "--yes")
    assert "Return Delay Time: 0 us -> 20 us, read back" in invoke(*words, "--return-delay-us", 20).stdout
    assert "Return Delay Time is already 0 us." in invoke(*words, "--return-delay-us", 0).stdout
    assert "Baud Rate: 1000000 baud -> 57600 baud, read back" in invoke(*words, "--new-baud", 57_600).stdout
    assert json.loads(invoke(*words, "--return-delay-us", 20, "--json").stdout)["changes"] == [
        {"register": "Return Delay Time", "before": 0, "after": 20, "written": True, "unit": "us"}
    ]


def test_an_odd_return_delay_is_refused(arm_file: ArmFile) -> None:
    result = invoke("setup", arm_file(), "--id", 2, "--yes", "--return-delay-us", 3)
    assert result.exit_code == 2
    assert "--return-delay-us 3: servos accept only even values from 0 to 508." in " ".join(result.output.split())


@pytest.mark.parametrize("kind", ["lost_reply", "corrupted_reply", "lost_instruction", "truncated_reply"])
@pytest.mark.parametrize("place", range(14))
def test_one_lost_packet_loses_no_servo(port: Callable[..., Port], kind: str, place: int) -> None:
    """Any single packet may be lost, including the status reply to the change itself."""
    opened = port()
    servo = open_servo(opened, 2)
    bus = opened._serial.bus
    strikes, count = bus.faults.strikes, iter(range(10_000))
    bus.faults.strikes = lambda *given: next(count) == place and strikes(*given)
    bus.faults.add(Fault(kind=kind))
    changes = set_up(servo, lambda _: True, new_id=9, new_baud=57_600)
    bus.faults.clear()
    bus.faults.strikes = strikes
    assert [change.written for change in changes] == [True, True]
    assert opened.baud == 57_600
    assert open_servo(opened, 9).read("Baud Rate") == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"new_id": 9}, "answers neither at that ID nor at ID 2"),
        ({"new_baud": 57_600}, "from 1000000 to 57600 baud but answers at neither"),
    ],
)
def test_a_servo_that_is_gone_is_said_to_be_at_neither(
    port: Callable[..., Port], change: dict[str, int], said: str
) -> None:
    opened = port()
    servo = open_servo(opened, 2)

    def unplug(_: str) -> bool:
        opened._serial.bus.faults.add(Fault(kind="silent_servo", servo=2))
        return True

    with pytest.raises(NoReply, match=said):
        set_up(servo, unplug, **change)
    assert opened.baud == 1_000_000


def test_a_servo_that_keeps_its_id_is_said_to(port: Callable[..., Port], monkeypatch: pytest.MonkeyPatch) -> None:
    opened = port()
    servo = open_servo(opened, 2)
    monkeypatch.setattr(type(servo), "write_only", lambda *_, **__: None)
    with pytest.raises(NoReply, match="still has its old ID 2"):
        set_up(servo, lambda _: True, new_id=9)
    with pytest.raises(NoReply, match="still at 1000000 baud"):
        set_up(servo, lambda _: True, new_baud=57_600)
    assert opened.baud == 1_000_000


def test_a_baud_at_which_the_id_is_taken_is_refused(port: Callable[..., Port]) -> None:
    opened = port()
    set_up(open_servo(opened, 2), lambda _: True, new_baud=57_600)
    opened.set_baud(1_000_000)
    renamed = open_servo(opened, 1)
    opened._serial.bus.servos[1].write(7, bytes((2,)))
    renamed = open_servo(opened, 2)
    with pytest.raises(WrongSetting, match="At 57600 baud another servo answers to ID 2"):
        set_up(renamed, lambda _: True, new_baud=57_600)
    assert opened.baud == 1_000_000


def test_a_secondary_id_is_taken_away(port: Callable[..., Port]) -> None:
    opened = port()
    (given,) = set_up(open_servo(opened, 2), lambda _: True, secondary_id=1)
    assert given.written
    assert opened._serial.bus.servos[2].shadow_id == 1
    set_up(open_servo(opened, 2), lambda _: True, secondary_id=255)
    assert opened._serial.bus.servos[2].shadow_id is None


def test_a_scan_tells_of_servos_as_they_answer_and_how_long_it_will_take(port: Callable[..., Port]) -> None:
    told: list[Asking] = []
    list(scan(port(), (1_000_000, 57_600), told.append))
    assert [asking.servo for asking in told if asking.servo] == [(1, "XM430-W350"), (2, "XM430-W350")]
    left = [asking.left_s for asking in told if asking.servo is None]
    assert left == sorted(left, reverse=True)
    assert 1.4 < left[0] < 1.8
    first = next(place for place, asking in enumerate(told) if asking.servo)
    assert told[first].left_s > 1.4


def test_scan_over_tcp_asks_once_and_the_servos_say_their_baud(
    port: Callable[..., Port], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = port()
    opened.url = "socket://bench:4000"
    opened.baud = 9_600  # of no consequence: the other end has 1 MBd
    monkeypatch.setattr(Port, "set_baud", lambda self, baud: setattr(self, "baud", baud))
    told: list[Asking] = []
    (heard,) = scan(opened, (9_600, 57_600), told.append)
    assert {asking.baud for asking in told} == {None}
    assert heard.baud == opened.baud == 1_000_000
    assert [(servo.baud, servo.id) for servo in heard.servos] == [(1_000_000, 1), (1_000_000, 2)]
