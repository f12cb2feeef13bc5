"""Call one client's functions on a fake arm; print the results as one line of JSON. Arguments: CLIENT DEVICE.

This script is run by `benchmarks/bus/clients.py`. It does not import hil, so it runs in any environment that has the
client. A call is wrong if it raises or if its result differs from that of a real servo.
"""

import builtins
import importlib
import importlib.metadata
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

BAUD = 1_000_000
Call = tuple[str, Callable[[], Any], Any]
"""Name, call, and expected result: a value, or a predicate if several values are correct."""


def near(wanted: float, off: float) -> Callable[[Any], bool]:
    return lambda got: abs(got - wanted) <= off


def anything(_: Any) -> bool:
    return True


def dynamixel_sdk(device: str) -> Iterator[Call]:
    """Calls made with dynamixel-sdk to fake_two_link: two XM430-W350, IDs 1 and 2."""
    import dynamixel_sdk as sdk

    port, handler = sdk.PortHandler(device), sdk.PacketHandler(2.0)
    yield "openPort", port.openPort, True
    yield "setBaudRate", lambda: port.setBaudRate(BAUD), True
    yield "ping", lambda: handler.ping(port, 1), (1020, 0, 0)
    yield "broadcastPing", lambda: handler.broadcastPing(port), ({1: [1020, 48], 2: [1020, 48]}, 0)
    for size, address, value in ((1, 65, 1), (2, 84, 700), (4, 112, 77)):
        write, read = getattr(handler, f"write{size}ByteTxRx"), getattr(handler, f"read{size}ByteTxRx")
        yield f"write{size}ByteTxRx", lambda w=write, a=address, v=value: w(port, 1, a, v), (0, 0)
        yield f"read{size}ByteTxRx", lambda r=read, a=address: r(port, 1, a), (value, 0, 0)
    yield "readTxRx", lambda: handler.readTxRx(port, 1, 144, 3), ([120, 0, 35], 0, 0)
    yield "writeTxRx", lambda: handler.writeTxRx(port, 1, 76, 4, [1, 0, 2, 0]), (0, 0)
    yield "regWriteTxRx", lambda: handler.regWriteTxRx(port, 1, 65, 1, [0]), (0, 0)
    yield "action", lambda: handler.action(port, 254), 0
    yield "refused: data range", lambda: handler.write1ByteTxRx(port, 1, 64, 9), (0, 4)
    yield "refused: access", lambda: handler.write4ByteTxRx(port, 1, 132, 9), (0, 7)
    yield "clearMultiTurn", lambda: handler.clearMultiTurn(port, 1), (0, 0)
    write = sdk.GroupSyncWrite(port, handler, 84, 2)
    yield "GroupSyncWrite.addParam", lambda: write.addParam(1, [10, 0]) and write.addParam(2, [20, 0]), True
    yield "GroupSyncWrite.txPacket", write.txPacket, 0
    read = sdk.GroupSyncRead(port, handler, 84, 2)
    yield "GroupSyncRead.addParam", lambda: read.addParam(1) and read.addParam(2), True
    for call in ("txRxPacket", "fastSyncRead"):
        yield f"GroupSyncRead.{call}", getattr(read, call), 0
        yield f"GroupSyncRead.getData after {call}", lambda: [read.getData(i, 84, 2) for i in (1, 2)], [10, 20]
    bulk = sdk.GroupBulkRead(port, handler)
    yield "GroupBulkRead.addParam", lambda: bulk.addParam(1, 84, 2) and bulk.addParam(2, 146, 1), True
    for call in ("txRxPacket", "fastBulkRead"):
        yield f"GroupBulkRead.{call}", getattr(bulk, call), 0
        yield f"GroupBulkRead.getData after {call}", lambda: [bulk.getData(1, 84, 2), bulk.getData(2, 146, 1)], [10, 35]
    yield "reboot", lambda: handler.reboot(port, 1), (0, 0)
    yield "ping after reboot", lambda: (time.sleep(0.5), handler.ping(port, 1))[1], (1020, 0, 0)
    yield "factoryReset, ID and baud kept", lambda: handler.factoryReset(port, 2, 2), (0, 0)


def dynamixel_easy_sdk(device: str) -> Iterator[Call]:
    """Calls made with dynamixel_easy_sdk to koch: XL430-W250 and XL330-M288."""
    from dynamixel_easy_sdk.connector import Connector
    from dynamixel_easy_sdk.data_types import OperatingMode

    connector = Connector(device, BAUD)
    motor: Any = None

    def create() -> list[int]:
        nonlocal motor
        motors = connector.createAllMotors()
        motor = motors[2]
        return [each.id for each in motors]

    yield "createAllMotors", create, [1, 2, 3, 4, 5, 6]
    yield "ping", motor.ping, 1200
    yield "isTorqueOn", lambda: bool(motor.isTorqueOn()), False
    yield "setOperatingMode", lambda: motor.setOperatingMode(OperatingMode.EXTENDED_POSITION), None
    yield "getOperatingMode", motor.getOperatingMode, OperatingMode.EXTENDED_POSITION
    for name, value in (
        ("PositionPGain", 500),
        ("PositionIGain", 1),
        ("PositionDGain", 2),
        ("VelocityPGain", 90),
        ("VelocityIGain", 900),
    ):
        yield f"set{name}", lambda n=name, v=value: getattr(motor, f"set{n}")(v), None
    for name, value in (
        ("HomingOffset", 10),
        ("MaxPositionLimit", 4000),
        ("MinPositionLimit", 50),
        ("VelocityLimit", 300),
        ("CurrentLimit", 1000),
        ("PWMLimit", 800),
    ):
        yield f"set{name}", lambda n=name, v=value: getattr(motor, f"set{n}")(v), None
        if name != "HomingOffset":
            yield f"get{name}", lambda n=name: getattr(motor, f"get{n}")(), value
    yield "enableTorque", motor.enableTorque, None
    yield "isTorqueOn, on", lambda: bool(motor.isTorqueOn()), True
    yield "setGoalPosition", lambda: motor.setGoalPosition(motor.getPresentPosition() + 200), None
    yield "LEDOn", motor.LEDOn, None
    yield "isLEDOn", lambda: bool(motor.isLEDOn()), True
    yield "LEDOff", motor.LEDOff, None
    for name in ("Position", "Velocity", "Current", "PWM"):
        yield f"getPresent{name}", lambda n=name: getattr(motor, f"getPresent{n}")(), lambda got: isinstance(got, int)
    yield "disableTorque", motor.disableTorque, None
    group = connector.createGroupExecutor()
    yield "stageLEDOn", lambda: group.addCmd(motor.stageLEDOn()), None
    yield "executeWrite", group.executeWrite, None
    yield "stageGetPresentPosition", lambda: group.addCmd(motor.stageGetPresentPosition()), None
    yield "executeRead", group.executeRead, lambda got: len(got) == 1
    yield "reboot", motor.reboot, None


def rustypot(device: str) -> Iterator[Call]:
    """Calls made with rustypot to fake_two_link, through its XL430 controller, which uses the same addresses."""
    import rustypot as library

    client = library.Xl430PyController(device, BAUD, 0.5)
    yield "ping", lambda: client.ping(1), True
    yield "ping of nobody", lambda: client.ping(7), False
    yield "scan", lambda: client.scan([1, 2, 3]), {1: 1020, 2: 1020}
    yield "sync_read_model_number", lambda: client.sync_read_model_number([1, 2]), [1020, 1020]
    yield "read_raw_data", lambda: list(client.read_raw_data(1, 144, 3)), [120, 0, 35]
    yield "write_operating_mode", lambda: client.write_operating_mode(1, 4), anything
    yield "sync_write_goal_pwm", lambda: client.sync_write_goal_pwm([1, 2], [100, 200]), anything
    yield "sync_read_goal_pwm", lambda: client.sync_read_goal_pwm([1, 2]), [100, 200]
    yield "sync_read_present_position", lambda: client.sync_read_present_position([1, 2]), lambda p: len(p) == 2
    yield "write_raw_data, stuffed", lambda: client.write_raw_data(1, 116, [0xFF, 0xFF, 0xFD, 0xFF]), anything
    yield "read_raw_data, stuffed", lambda: list(client.read_raw_data(1, 116, 4)), [0xFF, 0xFF, 0xFD, 0xFF]
    yield "write_torque_enable", lambda: client.write_torque_enable(1, 1), anything
    yield "sync_read_torque_enable", lambda: [bool(on) for on in client.sync_read_torque_enable([1, 2])], [True, False]
    yield "reboot", lambda: client.reboot(1), True


def dxl2(device: str) -> Iterator[Call]:
    """Calls made with dynamixel-python to fake_two_link."""
    library = importlib.import_module("dxl2")
    bus = library.v2.MotorBus(device, BAUD, timeout=0.3)
    yield "connect", bus.connect, anything
    yield "ping", lambda: bus.ping(1).data, {"model_number": 1020, "firmware_version": 48}
    yield "broadcast_ping", lambda: set(bus.broadcast_ping().data), {1, 2}
    yield "ping of nobody", lambda: bus.ping(9).timeout, True
    yield "write", lambda: bus.write(1, 65, 1, 1).ok, True
    yield "read", lambda: bus.read(1, 65, 1).data, 1
    yield "write, signed", lambda: bus.write(1, 102, 2, -5, signed=True).ok, True
    yield "read, signed", lambda: bus.read(1, 102, 2, signed=True).data, -5
    yield "reg_write", lambda: bus.reg_write(2, 65, 1, 1).ok, True
    yield "action", lambda: bus.action(2).ok, True
    params = library.v2.SyncParams(65, 1)
    params.add_motor(1)
    params.add_motor(2)
    yield "sync_read", lambda: bus.sync_read(params).data, [1, 1]
    yield "fast_sync_read", lambda: bus.fast_sync_read(params).data, [1, 1]
    bulk = library.v2.BulkParams()
    bulk.add_address(1, 65, 1)
    bulk.add_address(2, 146, 1)
    yield "bulk_read", lambda: bus.bulk_read(bulk).data, [1, 35]
    yield "fast_bulk_read", lambda: bus.fast_bulk_read(bulk).data, [1, 35]
    yield "control_table_backup", lambda: bus.control_table_backup(1).ok, True
    yield "control_table_restore", lambda: bus.control_table_restore(1).ok, True
    yield "clear_position", lambda: bus.clear_position(1).ok, True
    yield "reboot", lambda: bus.reboot(1).ok, True


def pypot(device: str) -> Iterator[Call]:
    """Calls that pypot makes on xl320, an arm of two XL-320, the only servos with which pypot uses Protocol 2.0."""
    from pypot.dynamixel import Dxl320IO

    # pypot discards pending output before each packet; on a pty, this would drop a Sync Write that is still unread.
    importlib.import_module("serial").Serial.flushOutput = lambda _: None
    io = Dxl320IO(device, baudrate=BAUD, timeout=0.3)
    yield "ping", lambda: io.ping(1), True
    yield "ping of nobody", lambda: io.ping(7), False
    yield "scan", lambda: io.scan([1, 2, 3]), [1, 2]
    yield "get_model", lambda: list(io.get_model([1, 2])), ["XL-320", "XL-320"]
    yield "set_LED_color", lambda: io.set_LED_color({1: "pink"}), None
    yield "get_LED_color", lambda: list(io.get_LED_color([1])), ["pink"]
    yield "get_angle_limit", lambda: [tuple(map(round, limit)) for limit in io.get_angle_limit([1])], [(-150, 150)]
    yield "set_goal_position", lambda: io.set_goal_position({1: 30.0}), None
    yield "get_goal_position", lambda: io.get_goal_position([1])[0], near(30.0, 0.5)
    yield "enable_torque", lambda: io.enable_torque([1]), None
    yield "is_torque_enabled", lambda: list(io.is_torque_enabled([1, 2])), [True, False]


def lerobot_bus(device: str) -> Iterator[Call]:
    """Calls made with LeRobot's DynamixelMotorsBus to koch."""
    from lerobot.motors import Motor, MotorNormMode
    from lerobot.motors.dynamixel import DynamixelMotorsBus

    models = ("xl430-w250",) * 2 + ("xl330-m288",) * 4
    names = [f"joint_{number}" for number in range(1, 7)]
    motors = {n: Motor(i, m, MotorNormMode.DEGREES) for i, (n, m) in enumerate(zip(names, models, strict=True), 1)}
    bus = DynamixelMotorsBus(port=device, motors=motors)
    yield "connect", bus.connect, None
    yield "broadcast_ping", bus.broadcast_ping, {1: 1060, 2: 1060} | dict.fromkeys(range(3, 7), 1200)
    yield "ping", lambda: bus.ping("joint_3"), 1200
    yield "configure_motors", bus.configure_motors, None
    yield "disable_torque", bus.disable_torque, None
    yield "write", lambda: [bus.write("Operating_Mode", name, 4) for name in names], anything
    yield "read", lambda: bus.read("Operating_Mode", "joint_6", normalize=False), 4
    yield "reset_calibration", bus.reset_calibration, None
    yield "set_half_turn_homings", bus.set_half_turn_homings, lambda got: len(got) == 6
    yield (
        "sync_read, half a turn each",
        lambda: set(bus.sync_read("Present_Position", normalize=False).values()),
        (lambda got: all(abs(ticks - 2047) < 20 for ticks in got)),
    )
    yield "read_calibration", bus.read_calibration, lambda got: len(got) == 6
    yield "write_calibration", lambda: bus.write_calibration(bus.read_calibration()), None
    yield "is_calibrated", lambda: bus.is_calibrated, True
    yield "enable_torque", bus.enable_torque, None
    goals = dict.fromkeys(names, 2247)
    yield "sync_write", lambda: bus.sync_write("Goal_Position", goals, normalize=False), None
    yield (
        "moved",
        lambda: (time.sleep(1.5), bus.sync_read("Present_Position", normalize=False))[1],
        (lambda got: all(abs(ticks - 2247) < 100 for ticks in got.values())),
    )
    yield "disconnect", bus.disconnect, None


def lerobot_koch(device: str) -> Iterator[Call]:
    """Calls made with LeRobot's unmodified KochFollower to koch; `hil hand` stands in for the person."""
    import tempfile
    from pathlib import Path

    motors_bus = importlib.import_module("lerobot.motors.motors_bus")
    follower = importlib.import_module("lerobot.robots.koch_follower")

    def hand(*moves: str) -> None:
        subprocess.run([*json.loads(os.environ["HIL"]), "hand", device, *moves], check=True)
        time.sleep(0.6)

    def answer(prompt: str = "") -> str:
        if "middle" in prompt:
            hand(*(f"{i}:ticks=2047,duration=0.3" for i in range(1, 7)))
        return ""

    ranges = iter((1400, 2700, 2047))

    def pressed() -> bool:
        for ticks in ranges:
            hand(*(f"{i}:ticks={ticks},duration=0.3" for i in range(1, 7)))
            return False
        return True

    builtins.input = answer
    motors_bus.enter_pressed = pressed
    folder = Path(tempfile.mkdtemp())
    config = follower.KochFollowerConfig(port=device, id="fake", calibration_dir=folder, use_degrees=True)
    robot = follower.KochFollower(config)
    yield "connect and calibrate", robot.connect, None
    yield "is_calibrated", lambda: robot.is_calibrated, True
    yield (
        "calibrated ranges",
        lambda: [round(m.range_max - m.range_min, -2) for m in robot.calibration.values()],
        (lambda got: all(abs(span - 1300) <= 100 for span in (got[1], got[2], got[3], got[5]))),
    )
    yield "get_observation", robot.get_observation, lambda got: len(got) == 6
    action = {"wrist_roll.pos": 20.0}
    yield "send_action", lambda: robot.send_action(action), action
    yield "torque", robot.bus.enable_torque, None
    yield (
        "act",
        lambda: (robot.send_action(action), time.sleep(1.5), robot.get_observation()["wrist_roll.pos"])[2],
        (near(20.0, 5.0)),
    )
    yield "disconnect", robot.disconnect, None
    again = follower.KochFollower(config)
    yield "reconnect, calibrated", lambda: again.connect(calibrate=False), None
    yield "is_calibrated again", lambda: again.is_calibrated, True
    yield "observation again", again.get_observation, lambda got: len(got) == 6
    yield "disconnect again", again.disconnect, None


def lerobot_shadows(device: str) -> Iterator[Call]:
    """Calls made with LeRobot to viperx_300, ALOHA's arm, whose shadow servos obey commands to their Secondary ID."""
    from lerobot.motors import Motor, MotorNormMode
    from lerobot.motors.dynamixel import DynamixelMotorsBus

    motors = {f"m{i}": Motor(i, "xm540-w270" if i < 8 else "xm430-w350", MotorNormMode.DEGREES) for i in range(1, 10)}
    bus = DynamixelMotorsBus(port=device, motors=motors)
    yield "connect", bus.connect, None
    yield "secondary IDs", lambda: [bus.read("Secondary_ID", m, normalize=False) for m in ("m3", "m5")], [2, 4]
    leader = "m2"
    before: dict[str, int] = {}
    yield "sync_read", lambda: before.update(bus.sync_read("Present_Position", normalize=False)), None
    yield "enable_torque of the leader", lambda: bus.enable_torque([leader]), None
    yield "the shadow has torque", lambda: bus.read("Torque_Enable", "m3", normalize=False), 1
    yield "write", lambda: bus.write("Goal_Position", leader, before[leader] + 150, normalize=False), None
    moved: dict[str, int] = {}
    yield (
        "sync_read, moved",
        lambda: (time.sleep(1.5), moved.update(bus.sync_read("Present_Position", normalize=False))),
        (anything),
    )
    yield (
        "leader and shadow move together",
        lambda: moved["m3"] - before["m3"],
        lambda got: abs(got - (moved[leader] - before[leader])) <= 3 and got > 50,
    )
    yield "disconnect", bus.disconnect, None


CLIENTS: dict[str, tuple[Callable[[str], Iterator[Call]], str]] = {
    "dynamixel_sdk": (dynamixel_sdk, "dynamixel-sdk"),
    "dynamixel_easy_sdk": (dynamixel_easy_sdk, "dynamixel-sdk"),
    "rustypot": (rustypot, "rustypot"),
    "dxl2": (dxl2, "dynamixel-python"),
    "pypot": (pypot, "pypot"),
    "lerobot_bus": (lerobot_bus, "lerobot"),
    "lerobot_koch": (lerobot_koch, "lerobot"),
    "lerobot_shadows": (lerobot_shadows, "lerobot"),
}
"""By client name: its calls, and its package on PyPI."""


def run(name: str, device: str) -> dict[str, Any]:
    """Return the results of one client's calls, or `missing` if the client is not installed in this environment."""
    calls, package = CLIENTS[name]
    try:
        version = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return {"client": name, "missing": package}
    results = []
    _be_patient()
    try:
        for call, act, wanted in calls(device):
            results.append({"call": call, "wrong": _wrong(act, wanted)})
    except Exception as error:
        results.append({"call": "(client)", "wrong": f"{type(error).__name__}: {error}"})
    return {"client": name, "package": package, "version": version, "results": results}


def _be_patient() -> None:
    """Extend dynamixel-sdk's reply timeout of 34 ms, which a busy machine sometimes exceeds."""
    try:
        importlib.import_module("dynamixel_sdk.port_handler").LATENCY_TIMER = 200
    except ImportError:
        return


def _wrong(act: Callable[[], Any], wanted: Any) -> str:
    """Return a description of what is wrong with a call's result; "" if it is correct."""
    try:
        got = act()
        right = wanted(got) if callable(wanted) else got == wanted
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "" if right else f"gave {got!r}"


if __name__ == "__main__":
    print(json.dumps(run(sys.argv[1], sys.argv[2])))
