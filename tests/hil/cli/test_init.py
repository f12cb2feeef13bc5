"""`hil init` creates a valid file from the servos on the bus and a few answers."""

import io
import math
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from hil.config.schema import load_config, parse_config, port_url
from hil.drivers.port import open_port
from hil.drivers.servo_model import SERVO_MODELS, Mode
from hil.errors import ExperimentError
from hil.fakes.bus.hand import Move
from hil.setup.bus_rate import SHARE, ExchangeMode, choose_mode
from hil.setup.config_template import RATES, ArmAnswers, JointAnswers, arm_toml
from hil.setup.interview import interview
from hil.setup.scan import Found, Heard, scan
from tests.support.command_line import hil

ArmFile = Callable[..., Path]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", sys.argv)


def test_defaults_make_a_file_that_runs(arm_file: ArmFile, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("init", arm_file(), "--baud", 1_000_000, "--yes", "--out", "mine.toml") == 0
    printed = capsys.readouterr()
    assert "hil check mine.toml" in printed.out
    assert "shoulder did not move" in printed.err
    config = load_config(Path("mine.toml"))
    assert [(joint.id, joint.model) for joint in config.joints] == [(1, "XM430-W350"), (2, "XM430-W350")]
    assert [joint.zero_ticks for joint in config.joints] == pytest.approx([3072, 2048], abs=2)
    assert config.experiment.pilot and config.experiment.peak_torque is None and config.model.friction == "auto"
    assert config.arm.link_lengths == [0.13, 0.13], "what a servo like this usually carries"
    assert "NOT yet run on this arm" in Path("mine.toml").read_text(encoding="utf-8")
    assert hil("check", "mine.toml") == 0
    assert hil("init", arm_file(), "--yes", "--out", "mine.toml") == 2
    assert "mine.toml already exists" in capsys.readouterr().err
    assert hil("init", "nonsense", "--yes", "--out", "mine.toml") == 2
    assert "Cannot open port 'nonsense'" in capsys.readouterr().err


class _Interrupted(io.StringIO):
    """Standard input at which Ctrl-C is typed."""

    def readline(self, _size: int | None = -1, /) -> str:
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("typed", "code", "said"),
    [(io.StringIO(), 2, "Add --yes"), (_Interrupted(), 130, "hil: Stopped by Ctrl-C.")],
    ids=["end of input", "Ctrl-C"],
)
@pytest.mark.parametrize("command", ["init", "setup"])
def test_a_question_without_an_answer_ends_the_command(
    command: str,
    typed: io.StringIO,
    code: int,
    said: str,
    arm_file: ArmFile,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = ["--baud", 1_000_000] if command == "init" else ["--id", 1, "--return-delay-us", 20]
    monkeypatch.setattr(sys, "stdin", typed)
    assert hil(command, arm_file(), *options) == code
    printed = capsys.readouterr().err
    assert said in printed
    assert "Aborted" not in printed
    assert (f"Next: hil {command}" in printed) == (code == 130)


def test_answers_are_asked_again_until_they_make_sense(arm_file: ArmFile) -> None:
    answers = {
        "IDs of the arm's": ["7", "1 1", "2"],
        "Name of the joint": ["wrist"],
        "Is the arm hanging": ["perhaps", "flat"],
        "Length from wrist to the tip": ["0", "85"],
        "How far may wrist": ["far", "720", "45"],
    }
    said: list[str] = []

    def ask(question: str, usual: str) -> str:
        kept = next((given for start, given in answers.items() if question.startswith(start)), [])
        return kept.pop(0) if kept else usual

    url = port_url(str(arm_file()))
    port = open_port(url, 1_000_000)
    try:
        arm = interview(port, url, list(scan(port, (1_000_000,))), ask, said.append)
    finally:
        port.close()
    (joint,) = arm.joints
    assert (joint.id, joint.name, joint.rest) == (2, "wrist", 0.0)
    assert joint.zero_ticks == pytest.approx(2048, abs=2)
    assert joint.swing == pytest.approx(math.pi / 4)
    assert arm.gravity == 0.0 and joint.length == pytest.approx(0.085)
    assert [text.split(":")[0] for text in said] == [
        "'7'",
        "'1 1'",
        "LEFT OUT",
        "'perhaps'",
        "wrist did not move",
        "'0'",
        "'far'",
        "'720'",
    ]
    assert parse_config(arm_toml(arm), Path("x.toml")).joints[0].position_limit == pytest.approx([-0.79, 0.79])


def test_two_joints_are_not_given_the_same_name(arm_file: ArmFile) -> None:
    given = ["elbow", "elbow", "wrist"]
    said: list[str] = []

    def ask(question: str, usual: str) -> str:
        return given.pop(0) if question.startswith("Name of the joint") else usual

    port = open_port(port_url(str(arm_file())), 1_000_000)
    try:
        arm = interview(port, "fake://", list(scan(port, (1_000_000,))), ask, said.append)
    finally:
        port.close()
    assert [joint.name for joint in arm.joints] == ["elbow", "wrist"]
    assert said[0] == "Another joint is already named elbow: give this one a different name."


@pytest.mark.parametrize(
    ("stance", "tilt", "rest", "gravity"),
    [("hanging", "60", -math.pi / 2, 4.905), ("upright", "0", math.pi / 2, 9.81), ("flat", "no question", 0.0, 0.0)],
)
def test_which_way_up_the_arm_is_says_rest_and_gravity(
    arm_file: ArmFile, stance: str, tilt: str, rest: float, gravity: float
) -> None:
    answers = {"Is the arm hanging": stance, "By how many degrees is the arm's plane": tilt}

    def ask(question: str, usual: str) -> str:
        return next((given for start, given in answers.items() if question.startswith(start)), usual)

    port = open_port(port_url(str(arm_file())), 1_000_000)
    try:
        arm = interview(port, "fake://", list(scan(port, (1_000_000,))), ask, lambda _: None)
    finally:
        port.close()
    config = parse_config(arm_toml(replace(arm, url="/dev/ttyUSB0")), Path("x.toml"))
    assert config.arm.gravity == pytest.approx(gravity) and config.arm.rest_pose == pytest.approx([rest, 0.0], abs=1e-4)
    assert config.stabiliser is None, "the pilot proposes one where it is needed"


def test_a_bus_that_makes_no_arm_is_said(arm_file: ArmFile) -> None:
    url = port_url(str(arm_file()))
    port = open_port(url, 1_000_000)
    one = Found(57_600, 1, 1020, "XM430-W350", 48, 12.0, 30.0, "")
    try:
        for heard, text in (
            ([Heard(57_600, (), "")], "No servo that hil can drive answered"),
            ([Heard(57_600, (one,), ""), Heard(1_000_000, (one._replace(id=2),), "")], "more than one baud"),
        ):
            with pytest.raises(ExperimentError, match=text):
                interview(port, url, heard, lambda _, usual: usual, lambda _: None)
    finally:
        port.close()


SET_TO_0 = r": {}\). Set it to 0 .* run the same command again"


@pytest.mark.parametrize(
    ("register", "value", "said"),
    [
        ("Drive Mode", 1, SET_TO_0.format(1)),
        ("Drive Mode", 4, ""),
        ("Drive Mode", 8, SET_TO_0.format(8)),
        ("Homing Offset", 1024, ""),
        ("Homing Offset", 1025, r": 1025\). Position Control Mode ignores .* again, with hil init"),
    ],
)
def test_a_setting_that_check_refuses_is_said_before_anything_is_measured(
    arm_file: ArmFile, register: str, value: int, said: str
) -> None:
    """Directions and zeros measured on a reversed servo, or beside an ignored offset, are wrong later."""
    servo = "[[fake.servos]]\nid = 2\n"
    changed = arm_file((servo, f'{servo}registers = {{ "{register}" = {value} }}\n'))
    port = open_port(port_url(str(changed)), 1_000_000)
    asked: list[str] = []

    def ask(question: str, usual: str) -> str:
        asked.append(question.split(" ", 1)[0])
        return usual

    try:
        with pytest.raises(ExperimentError, match=f"ID 2.*{said}") if said else nullcontext():
            interview(port, "fake://", list(scan(port, (1_000_000,))), ask, lambda _: None)
    finally:
        port.close()
    assert not said or asked == ["IDs"]


@pytest.mark.parametrize("model", SERVO_MODELS)
@pytest.mark.parametrize("baud", [57_600, 1_000_000, 4_000_000])
def test_every_model_and_baud_gives_a_file_that_is_valid(model: str, baud: int) -> None:
    joints = (JointAnswers('the "first"', 1, model, 3072, -math.pi / 2), JointAnswers("elbow", 2, model, 2048, 0.0))
    config = parse_config(arm_toml(ArmAnswers("/dev/ttyUSB0", baud, joints, 9.81, "A test.")), Path("x.toml"))
    assert config.joints[0].name == 'the "first"'
    assert (config.joints[0].drive_mode is Mode.PWM) == (model == "XL430-W250")
    assert config.experiment.rate * 2 * 78 * 10 / baud < 1.1


def test_friction_that_holds_the_arm_aside_is_read_from_both_sides(arm_file: ArmFile) -> None:
    port = open_port(port_url(str(arm_file())), 1_000_000)
    bus = port._serial.bus

    def ask(question: str, usual: str) -> str:
        for start, angle in (("Let the arm hang", 0.2), ("Friction may hold the arm to one side", -0.1)):
            if question.startswith(start):
                bus.hand.move(Move(servo=2, to=angle, duration=0.1))
                port.clock.wait_until(port.clock.now() + 0.5)
                bus.advance(port.clock.now())
        return usual

    said: list[str] = []
    try:
        arm = interview(port, "fake://", list(scan(port, (1_000_000,))), ask, said.append)
    finally:
        port.close()
    unit = 2 * math.pi / 4096
    assert arm.joints[1].zero_ticks == pytest.approx(2048 + 0.05 / unit, abs=3)
    assert any(text.startswith("elbow came to rest at two positions 19") and "steps apart" in text for text in said), (
        said
    )


@pytest.mark.parametrize(("sustained", "chosen"), [(52.0, 40), (900.0, 400), (370.0, 300), (23.0, 20), (61.0, 50)])
def test_the_highest_rate_with_a_margin_is_chosen(sustained: float, chosen: int) -> None:
    mode = ExchangeMode(True, True, 0.001, SHARE / sustained, 0.001, 0.05, 0)
    bus = SimpleNamespace(config=SimpleNamespace(fast_sync_read=True, one_write=True))
    assert choose_mode(bus, [mode], RATES)[1] == chosen  # type: ignore[arg-type]


def test_a_file_with_nothing_but_a_fake_is_a_port(tmp_path: Path) -> None:
    path = tmp_path / "fake.toml"
    path.write_text("[fake]\n", encoding="utf-8")
    assert port_url(str(path)) == f"fake://{path}"
