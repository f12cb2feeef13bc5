"""The drivers on the fake bus, used as in an experiment; the fake servos are queried for the outcome."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from hil import fakes
from hil.drivers.bus import BusConfig, ServoBus
from hil.drivers.errors import NoReply, ServoRefused, TorqueNotOff, WrongModel, WrongSetting
from hil.drivers.joint import Joint
from hil.drivers.packet import ALERT, HardwareError
from hil.drivers.servo_model import servo_model
from hil.fakes.protocol_fake import FakeSerial
from tests.support.paths import CONFIGS

CONFIG = CONFIGS / "fake_two_link.toml"
JOINTS = (
    Joint("shoulder", 1, servo_model("XM430-W350"), zero_ticks=3072),
    Joint("elbow", 2, servo_model("XM430-W350"), zero_ticks=2048),
)


def opened(url: str = f"fake://{CONFIG}", joints: tuple[Joint, ...] = JOINTS) -> tuple[ServoBus, FakeSerial]:
    fakes.register()
    bus = ServoBus.connect(BusConfig(url, 1_000_000, joints))
    port = bus.port._serial
    assert isinstance(port, FakeSerial)
    return bus, port


@pytest.fixture
def arm() -> Iterator[tuple[ServoBus, FakeSerial]]:
    bus, port = opened()
    with bus:
        bus.check_identity()
        bus.prepare()
        yield bus, port


def test_an_experiment_in_small(arm: tuple[ServoBus, FakeSerial]) -> None:
    bus, port = arm
    assert bus.read_positions() == pytest.approx((-1.5708, 0.0), abs=2e-3)
    with bus.torque(watchdog=0.1):
        servos = port.bus.servos
        assert all(servo.torque_enabled and servo.watchdog_s == pytest.approx(0.1) for servo in servos.values())
        deadline = port.clock.now()
        for sample in range(80):
            deadline += 0.0025
            port.clock.wait_until(deadline)
            state = bus.exchange((0.3, -0.1))
            assert not any(state.missing), sample
        assert port.bus.servos[1].goal_current_ticks == round(0.3 / 2.69e-3)
    assert state.current == pytest.approx((0.3, -0.1), abs=0.01)
    assert state.position[0] > -1.5  # it swung up
    assert state.time_after_read - state.time_before_write == pytest.approx(720e-6 + 60e-6, abs=1e-9)  # Fast Sync Read
    assert not any(servo.torque_enabled for servo in port.bus.servos.values())
    assert port.bus.collisions == 0


def test_a_stalled_host_is_caught_by_the_watchdog(arm: tuple[ServoBus, FakeSerial]) -> None:
    bus, port = arm
    with bus.torque(watchdog=0.1):
        bus.exchange((0.3, 0.0))
        port.clock.wait_until(port.clock.now() + 0.5)
        assert [servo.watchdog_tripped for servo in port.bus.servos.values()] == [True, True]
        assert [servo.motor_current_a for servo in port.bus.servos.values()] == [0.0, 0.0]
        bus.exchange((0.3, 0.0))
        assert port.bus.servos[1].goal_current_ticks == 0


def test_an_alert_is_seen_in_the_exchange(arm: tuple[ServoBus, FakeSerial]) -> None:
    bus, port = arm
    with bus.torque(watchdog=0.1):
        port.bus.servos[2].fail(HardwareError.OVERLOAD)
        assert bus.exchange((0.0, 0.0)).error == (0, ALERT)
        assert not port.bus.servos[2].torque_enabled


def test_a_pulled_servo_is_missing_and_its_torque_is_not_confirmed(arm: tuple[ServoBus, FakeSerial]) -> None:
    bus, port = arm
    with pytest.raises(TorqueNotOff, match="ELBOW"), bus.torque(watchdog=0.1):
        port.bus.servos[2].connected = False
        assert bus.exchange((0.1, 0.1)).missing == (False, True)
    port.clock.wait_until(port.clock.now() + 0.1)
    servos = port.bus.servos
    assert not servos[1].torque_enabled
    assert servos[2].watchdog_tripped  # the watchdog has stopped what the host could not reach
    assert servos[2].motor_current_a == 0.0


def test_absent_servo() -> None:
    bus, _ = opened(joints=(JOINTS[0], Joint("wrist", 7, servo_model("XM430-W350"))))
    with bus, pytest.raises(NoReply, match="ID 7"):
        bus.check_identity()


def test_wrong_model() -> None:
    bus, _ = opened(joints=(Joint("shoulder", 1, servo_model("XM540-W270")),))
    with bus, pytest.raises(WrongModel, match="XM430-W350"):
        bus.check_identity()


def test_servos_on_another_baud_do_not_answer() -> None:
    fakes.register()
    with ServoBus.connect(BusConfig(f"fake://{CONFIG}", 57_600, JOINTS)) as bus, pytest.raises(NoReply, match="57600"):
        bus.servo(JOINTS[0]).ping()


def test_drive_mode_that_forbids_the_experiment(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    text = CONFIG.read_text(encoding="utf-8")
    path.write_text(
        text.replace("[[fake.servos]]\nid = 1\n", '[[fake.servos]]\nid = 1\nregisters = { "Drive Mode" = 8 }\n')
    )
    bus, port = opened(f"fake://{path}")
    with bus, pytest.raises(WrongSetting, match="Drive Mode is 8"):
        bus.prepare()
    assert not port.bus.servos[1].torque_enabled


def test_refusals_are_said(arm: tuple[ServoBus, FakeSerial]) -> None:
    bus, _ = arm
    with pytest.raises(ServoRefused, match="data limit"):
        bus.servo(JOINTS[0]).write("Goal Current", 1194)
    with bus.torque(watchdog=0.1), pytest.raises(ServoRefused, match="access"):
        bus.servo(JOINTS[0]).write("Operating Mode", 3)
