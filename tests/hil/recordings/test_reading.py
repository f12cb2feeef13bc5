"""Recordings as other programs write them, converted to SI units."""

import json
import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.arm_model import ArmModel, JointFacts
from hil.config.csv_columns import Columns
from hil.config.schema import load_config
from hil.description.arm import ArmFileError
from hil.description.files import read_arm
from hil.errors import ConfigError, CsvError
from hil.estimation.unsettled.slips import refuse_slips
from hil.estimator.data.recording import Recording
from hil.recordings.convert import Converted, convert
from hil.recordings.encoder import encoder_step
from hil.recordings.files import read_tables
from hil.recordings.missing_codes import without_codes
from hil.recordings.periodic import mean_period
from hil.recordings.units import split_head, unit_of, wrapped

STEP = 2.0 * np.pi / 4096
TIME = 0.005 * np.arange(800)
ANGLES = np.round(np.stack((0.7 * np.sin(3.0 * TIME) - 1.5, 0.5 * np.cos(4.0 * TIME))) / STEP) * STEP
TORQUES = np.stack((0.3 * np.sin(3.0 * TIME + 1.0), 0.1 * np.cos(4.0 * TIME)))
HEAD = ("time", "q1", "q2", "tau1", "tau2")


def write(
    path: str,
    head: tuple[str, ...] = HEAD,
    scale: tuple[float, ...] = (1.0,) * 5,
    delimiter: str = ",",
    comma: str = ".",
    before: str = "",
    end: str = "",
) -> Path:
    """The recording as CSV; `scale` of each column."""
    table = np.column_stack((TIME, ANGLES.T, TORQUES.T)) * scale
    rows = [delimiter.join(f"{value:.9g}".replace(".", comma) for value in row) + end for row in table]
    Path(path).write_text(before + delimiter.join(head) + end + "\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return Path(path)


def read(path: Path, columns: Columns | None = None) -> Converted:
    (table,) = read_tables(path)
    return convert(table, columns or Columns())


def check(found: Converted) -> None:
    (recording,) = found.recordings
    assert recording.time == pytest.approx(TIME, abs=1e-9)
    assert recording.position == pytest.approx(ANGLES, abs=1e-8)
    assert recording.torque == pytest.approx(TORQUES, abs=1e-8)
    assert recording.position_step == pytest.approx([STEP, STEP], rel=1e-4) and found.stepped == (True, True)


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    "make",
    [
        lambda: write("a.csv"),
        lambda: write("a.csv", delimiter=";", comma=","),
        lambda: write("a.csv", delimiter="\t", comma=","),
        lambda: write("a.tsv", delimiter="\t"),
        lambda: write("a.txt", delimiter=" "),
        lambda: write("a.csv", before="\ufeff"),
        lambda: write("a.csv", before="# rig 3, Tuesday\n# 200 Hz\n"),
        lambda: write("a.csv", end=","),
        lambda: write("a.csv", delimiter=";", end=";"),
        lambda: write("a.csv", delimiter=";", comma=",", before="sep=;\n"),
        lambda: write("a.csv", ("t [ms]", "q1 [deg]", "q2 [deg]", "tau1 [mNm]", "tau2 [mNm]"), deg(1e3, 1e3)),
        lambda: write(
            "a.csv", ("Time (s)", "Position 1 (°)", "Position 2 (°)", "Torque 1 (Nm)", "Torque 2 (Nm)"), deg()
        ),
        lambda: write(
            "a.csv", ("timestamp_us", "pos_1_deg", "pos_2_deg", "effort_1_mNm", "effort_2_mNm"), deg(1e6, 1e3)
        ),
        lambda: write("a.csv", ("t", "q_shoulder", "q_elbow", "tau_shoulder", "tau_elbow")),
        lambda: write("a.csv", HEAD, deg(), before="") and with_units("a.csv", "s,deg,deg,Nm,Nm"),
    ],
)
def test_the_same_numbers_however_they_were_written(make: Callable[[], Path]) -> None:
    check(read(make()))


def deg(time: float = 1.0, torque: float = 1.0) -> tuple[float, ...]:
    return (time, 180.0 / np.pi, 180.0 / np.pi, torque, torque)


def with_units(path: str, units: str) -> Path:
    head, _, rest = Path(path).read_text(encoding="utf-8").partition("\n")
    Path(path).write_text(f"{head}\n{units}\n{rest}", encoding="utf-8")
    return Path(path)


def test_ticks_and_voltages_need_their_sizes() -> None:
    path = write("a.csv", ("t", "q1", "q2", "u1", "u2"), (1.0, 1.0 / STEP, 1.0 / STEP, 10.0, 10.0))
    given = {"position": ["q1", "q2"], "voltage": ["u1", "u2"], "torque_per_volt": [0.1, 0.1]}
    check(read(path, Columns(**given, position_unit="ticks", ticks_per_turn=4096)))  # type: ignore[arg-type]
    given = given | {"torque_per_volt": None, "torque_constant": [1.8, 1.8], "resistance": [18.0, 18.0]}
    check(read(path, Columns(**given, position_unit="ticks", ticks_per_turn=4096)))  # type: ignore[arg-type]
    pwm = {"position": ["q1", "q2"], "pwm": ["u1", "u2"], "torque_per_volt": [0.1, 0.1], "supply_voltage": 100.0}
    check(read(path, Columns(**pwm, pwm_unit="%", position_unit="ticks", ticks_per_turn=4096)))  # type: ignore[arg-type]
    with pytest.raises(CsvError, match="is it in percent"):
        read(path, Columns(**pwm, position_unit="ticks", ticks_per_turn=4096))  # type: ignore[arg-type]


def spoilt(change: Callable[[list[str]], list[str]]) -> Converted:
    path = write("a.csv")
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([head, *change(rows)]) + "\n", encoding="utf-8")
    return read(path)


@pytest.mark.parametrize(
    ("change", "said", "recordings"),
    [
        (lambda rows: [each for row in rows for each in (row, row)], "800 repeated rows were left out", 1),
        (lambda rows: [*rows[:300], *rows[340:]], "columns read: time = time", 1),
        (lambda rows: [*rows[:300], "nan,,,,", *rows[300:]], "1 rows without a time", 1),
        (lambda rows: [*rows[:300], rows[301], rows[300], *rows[302:]], "1 rows out of order were sorted", 1),
        (lambda rows: [*rows[:300], rows[300].rpartition(",")[0] + ",", *rows[301:]], "torque was filled in", 1),
        (lambda rows: [*rows, *rows], "treated as 2 recordings", 2),
        (lambda rows: [*rows[:300], rows[300].replace("1.5,", "1.5001,"), *rows[300:]], "columns read", 1),
    ],
)
def test_rows_that_can_be_put_right_are_and_it_is_said(
    change: Callable[[list[str]], list[str]], said: str, recordings: int
) -> None:
    found = spoilt(change)
    assert said in " ".join(found.notes) and len(found.recordings) == recordings


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: rows[::-1], "time goes back"),
        (lambda rows: [row.replace(row.split(",")[0], row.split(",")[0][:3], 1) for row in rows], "too coarse"),
        (lambda rows: ["x" + row for row in rows], r"line 2: column 'time' is 'x\S+'; it must be a finite number\.$"),
        (lambda rows: [f"1.3.2026,{row.partition(',')[2]}" for row in rows], "'time' is '1.3.2026'; .*ISO 8601"),
        (lambda rows: [f"-inf,{row.partition(',')[2]}" for row in rows], "'time' is '-inf'; it .* finite number\\.$"),
        (lambda rows: [*rows[:9], "1,2,3", *rows[9:]], "line 11: 3 fields for 5 columns"),
        (lambda rows: [], "no line of numbers, only a header"),
    ],
)
def test_rows_that_cannot_are_named(change: Callable[[list[str]], list[str]], said: str) -> None:
    with pytest.raises(CsvError, match=said):
        spoilt(change)


@pytest.mark.parametrize("number", ["1_000", "1e300", "-1e300"])
def test_what_python_alone_takes_for_a_number_and_what_nobody_measures_are_named(number: str) -> None:
    path = write("odd.csv")
    lines = path.read_text().splitlines()
    lines[9] = ",".join([*lines[9].split(",")[:-1], number])
    path.write_text("\n".join(lines))
    with pytest.raises(CsvError, match=rf"line 10: column '.*' is '{number}'; it must be a finite number"):
        read(path)


@pytest.mark.parametrize("what", ["fifo", "device"])
def test_a_pipe_or_device_is_refused_before_it_is_opened(tmp_path: Path, what: str) -> None:
    path = tmp_path / "rec.csv"
    if what == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(CsvError, match="pipe or a device"):
        read_tables(path)
    with pytest.raises(ConfigError, match="pipe or a device"):
        load_config(path)
    with pytest.raises(ArmFileError, match="pipe or a device"):
        read_arm(path)


def test_parquet_and_a_lerobot_dataset() -> None:
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pa.table(dict(zip(HEAD, (TIME, *ANGLES, *TORQUES), strict=True))), "a.parquet")
    check(read(Path("a.parquet")))
    texts = [list(map(str, column)) for column in (TIME, *ANGLES, *TORQUES)]
    parquet.write_table(pa.table(dict(zip(HEAD, texts, strict=True))), "texts.parquet")
    check(read(Path("texts.parquet")))
    names = {"motors": ["shoulder.pos", "elbow.pos"]}
    features = {"observation.state": {"names": names}, "action": {"names": ["shoulder.effort", "elbow.effort"]}}
    Path("set/meta").mkdir(parents=True)
    Path("set/data/chunk-000").mkdir(parents=True)
    Path("set/meta/info.json").write_text(json.dumps({"features": features}), encoding="utf-8")
    table = {"observation.state": ANGLES.T.tolist(), "action": TORQUES.T.tolist(), "timestamp": TIME}
    both = pa.table(
        {name: [*values, *values] for name, values in table.items()} | {"episode_index": [0] * 800 + [1] * 800}
    )
    parquet.write_table(both, "set/data/chunk-000/episode_000000.parquet")
    columns = Columns(
        position=["observation.state.shoulder.pos", "observation.state.elbow.pos"],
        torque=["action.shoulder.effort", "action.elbow.effort"],
    )
    first, second = read_tables(Path("set"))
    check(convert(first, columns))
    check(convert(second, columns))
    Path("b.parquet").write_text("no", encoding="utf-8")
    with pytest.raises(CsvError, match=r"b\.parquet cannot be read"):
        read_tables(Path("b.parquet"))


def test_mcap_with_joint_states_and_what_else_was_logged() -> None:
    writer_of = pytest.importorskip("mcap.writer")
    with Path("a.mcap").open("wb") as file:
        writer = writer_of.Writer(file)
        writer.start()
        schema = writer.register_schema(name="x", encoding="jsonschema", data=b"{}")
        topics = [writer.register_channel(t, "json", schema) for t in ("/joint_states", "/battery")]
        for k, time in enumerate(TIME):
            stamp = 1_700_000_000_000_000_000 + round(1e9 * time)
            named = {"name": ["shoulder", "elbow"], "position": ANGLES[:, k].tolist(), "effort": TORQUES[:, k].tolist()}
            messages = [named, {"voltage": 12.0, "note": "fine"}]
            for channel, message in zip(topics, messages[: 1 + (k % 100 == 0)], strict=False):
                writer.add_message(channel, stamp, json.dumps(message).encode(), stamp)
        writer.finish()
    (table,) = read_tables(Path("a.mcap"))
    assert table.columns["/battery.voltage"] == pytest.approx(np.full(800, 12.0))
    check(convert(table, Columns()))
    Path("b.mcap").write_bytes(b"\x89MCAP0\r\nnothing")
    with pytest.raises(CsvError, match=r"b\.mcap cannot be read"):
        read_tables(Path("b.mcap"))


def test_a_ros_2_bag(tmp_path: Path) -> None:
    ros2 = pytest.importorskip("mcap_ros2.writer")
    definition = (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
        + "=" * 80
        + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        + "=" * 80
        + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/metadata.yaml").write_text("rosbag2_bagfile_information: {}\n", encoding="utf-8")
    with (tmp_path / "bag/bag_0.mcap").open("wb") as file:
        writer = ros2.Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", definition)
        for k, time in enumerate(TIME):
            stamp = 1_700_000_000_000_000_000 + round(1e9 * time)
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""}
            body = {"position": ANGLES[:, k].tolist(), "velocity": [], "effort": TORQUES[:, k].tolist()}
            # Logged late by a tenth of a second now and then: the header says when it was.
            logged = stamp + (k % 7) * 10_000_000
            message = {"header": header, "name": ["shoulder", "elbow"], **body}
            writer.write_message("/joint_states", schema, message, logged, logged)
        writer.finish()
    check(read(tmp_path / "bag"))


def test_an_encoder_step_is_found_through_the_digits_that_were_written() -> None:
    random = np.random.default_rng(1)
    angle = np.cumsum(random.normal(0.0, 0.02, 3000))
    for step in (STEP, 2.0 * np.pi / 1024):
        assert encoder_step(np.round(np.round(angle / step) * step, 5)) == pytest.approx(step, rel=1e-3)
    assert encoder_step(angle) is None
    assert encoder_step(np.full(50, 1.0)) is None
    # A joint that hardly moves shows a few steps: these are no jumps.
    assert encoder_step(np.repeat([0.0, step, 2.0 * step, step], 300)) == pytest.approx(step)


def test_a_periodic_recording_is_averaged() -> None:
    time = 0.005 * np.arange(2200)
    torque = 0.3 * np.sin(2.0 * np.pi * time / 2.0)[None] + 0.1 * np.sin(2.0 * np.pi * time / 0.5)[None]
    settling = 0.4 * np.exp(-2.0 * time)
    table = np.column_stack((time, np.sin(2.0 * np.pi * time / 2.0) + settling, torque[0]))
    Path("a.csv").write_text(
        "t,q1,tau1\n" + "\n".join(",".join(map(str, row)) for row in table.tolist()), encoding="utf-8"
    )
    (recording,) = read(Path("a.csv")).recordings
    found = mean_period(recording)
    assert found is not None and found.seconds == pytest.approx(2.0) and 3 <= found.periods <= 5
    assert found.recording.position[0] == pytest.approx(np.sin(np.pi * (found.recording.time + 1.0)), abs=0.01)


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("effort_1_Ncm", "effort_1", "N cm"),
        ("tau_2_kgcm", "tau_2", "kgf cm"),
        ("torque1_ozin", "torque1", "ozf in"),
        ("i_1_amps", "i_1", "A"),
        ("pos_1_degrees", "pos_1", "deg"),
        ("torque 1 [in·lb]", "torque 1", "lbf in"),
        ("q_a", "q_a", None),
        ("motor_step", "motor_step", None),
    ],
)
def test_units_are_read_from_headers(header: str, name: str, unit: str | None) -> None:
    bare, stated = split_head(header)
    assert bare == name and (None if stated is None else unit_of(stated)) == unit


def swung(slip: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """A simulated arm's recording whose positions (joints, samples) are stored incorrectly."""
    time = np.arange(2000) * 0.005
    position = np.stack([0.8 * np.sin(2.1 * time) + 0.3 * np.sin(7.3 * time), 0.9 * np.sin(3.3 * time + 1.0)])
    velocity = np.gradient(position, 0.005, axis=1)
    acceleration = np.gradient(velocity, 0.005, axis=1)
    values = {
        **{"inertia_1": 0.018, "coupling": 0.0033, "inertia_2": 0.0028, "armature_2": 0.01},
        **{"gravity_1": 0.55, "gravity_2": 0.22, "viscous_1": 0.045, "viscous_2": 0.04},
    }
    values |= {f"{name}_{joint}": 0.0 for name in ("coulomb", "offset") for joint in (1, 2)}
    facts = JointFacts("joint", "XM430-W350", "current", 1.8, 0.1, 1.2, (-3.0, 0.5), 10.0)
    arm = ArmModel(values, values, 9.81, (-1.57, 0.0), (facts,) * 2)
    torque = arm.inverse_dynamics(position.T, velocity.T, acceleration.T).T
    return Recording(time, torque, slip(position), np.full(2, 0.0015), "linear")


@pytest.mark.parametrize(
    ("slip", "said"),
    [
        (lambda q: q * np.array([[1.0], [-1.0]]), "the sign of the position of joint 2 is reversed"),
        (lambda q: np.cumsum(q, axis=0), 'angles = "absolute"'),
    ],
)
def test_a_plain_slip_is_refused_before_the_fit(slip: Callable[[np.ndarray], np.ndarray], said: str) -> None:
    with pytest.raises(CsvError, match=said):
        refuse_slips([swung(slip)], "arm.csv")


@pytest.mark.parametrize(
    ("zero", "given", "said"),
    [
        ((-np.pi / 2, 0.0), True, 'angles = "absolute"$'),
        ((-np.pi / 2, -np.pi / 2), True, r'angles = "absolute" and zero = \[-1.5708, 0.0000\]$'),
        ((0.3, 0.0), True, 'angles = "absolute"$'),
        ((0.0, 0.0), False, 'angles = "absolute"$'),
    ],
)
def test_absolute_angles_are_recognised_with_any_zero(zero: tuple[float, float], given: bool, said: str) -> None:
    """As recorded, angle 1 is 0 where the columns' zero says, and angle 2 is measured from the same direction."""
    origin = zero[0] if given else -np.pi / 2
    recording = swung(lambda q: np.stack([q[0] - origin, q[0] - origin + q[1]]) + np.array(zero)[:, None])
    with pytest.raises(CsvError, match=said):
        refuse_slips([recording], "arm.csv", zero if given else None)


@pytest.mark.parametrize("offset", [0.0, np.pi / 2])
def test_joints_in_the_wrong_order_are_refused_before_the_fit(offset: float) -> None:
    """Also where the angles are measured from the hanging pose."""
    recording = swung(lambda q: q)
    position = recording.position[::-1] + np.array([[0.0], [offset]])
    with pytest.raises(CsvError, match="joints seem to be in the wrong order"):
        refuse_slips([replace(recording, torque=recording.torque[::-1].copy(), position=position)], "arm.csv")


def test_swapped_torques_are_refused_before_the_fit() -> None:
    recording = swung(lambda q: q)
    with pytest.raises(CsvError, match="torque columns of joints 1 and 2 seem to be swapped"):
        refuse_slips([replace(recording, torque=recording.torque[::-1].copy())], "arm.csv")


@pytest.mark.parametrize(
    ("low", "sizes", "bits"),
    [(-1024.0, (32,), 32), (-1024.0, (16, 32), 32), (-200.0, (16, 32), 16), (0.0, (16, 32), None)],
)
def test_registers_read_as_unsigned_numbers_are_recognised(
    low: float, sizes: tuple[int, ...], bits: int | None
) -> None:
    values = np.round(np.linspace(low, 900.0, 500))
    assert wrapped(values % 2.0 ** (bits or 16), sizes) == bits
    assert wrapped(np.linspace(0.0, 65535.0, 65536), sizes) is None, "numbers of all sizes"
    assert wrapped(values + 0.5, sizes) is None


def test_unsigned_ticks_and_currents_are_taken_as_signed_and_it_is_said(tmp_path: Path) -> None:
    path = tmp_path / "raw.csv"
    position = [round(-1500 + 800 * math.sin(0.05 * k)) for k in range(400)]
    current = [round(150 * math.sin(0.03 * k)) for k in range(400)]
    rows = (f"{0.01 * k:.2f},{p % 2**32},{i % 2**16}\n" for k, (p, i) in enumerate(zip(position, current, strict=True)))
    path.write_text("t,position [ticks],current [mA]\n" + "".join(rows), encoding="utf-8")
    columns = Columns(position=["position"], current=["current"], ticks_per_turn=4096, torque_constant=[1.5])
    found = convert(read_tables(path)[0], columns)
    (recording,) = found.recordings
    assert recording.position[0] == pytest.approx(np.array(position) * 2 * np.pi / 4096)
    assert recording.torque[0] == pytest.approx(np.array(current) * 1.5e-3)
    said = " ".join(found.notes)
    assert "column 'position [ticks]' wraps at 2^32" in said and "column 'current [mA]' wraps at 2^16" in said


def test_a_code_for_missing_values_is_left_out_and_it_is_said(tmp_path: Path) -> None:
    path = tmp_path / "coded.csv"
    position = [-999.0 if k in (50, 51, 200) else math.sin(0.05 * k) for k in range(400)]
    rows = (f"{0.01 * k:.2f};{p};{math.sin(0.03 * k)}\n" for k, p in enumerate(position))
    path.write_text("Zeit;Winkel;Moment\ns;Bogen;Nm\n" + "".join(rows), encoding="utf-8")  # one unit is unknown
    given = {"time": "Zeit", "position": ["Winkel"], "torque": ["Moment"]}
    found = convert(read_tables(path)[0], Columns(**given, position_unit="rad"))  # type: ignore[arg-type]
    assert np.flatnonzero(np.isnan(found.recordings[0].position[0])).tolist() == [50, 51, 200]
    assert "'Winkel' contains -999, which is far from all its other values" in " ".join(found.notes)
    with pytest.raises(CsvError, match="states the unit 'Bogen', which is not one of rad"):
        convert(read_tables(path)[0], Columns(**given))  # type: ignore[arg-type]


@pytest.mark.parametrize("values", [[99.0, 99.0, 50.0, 10.0, 0.0], [-999.0, 1.0, 2.0, 3.0], [99.0] * 5])
def test_values_among_others_single_ones_and_constants_are_no_codes(values: list[float]) -> None:
    kept, code = without_codes(np.array(values))
    assert kept.tolist() == values and code is None


def test_rows_stamped_when_they_arrived_are_not_called_coarse(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    stamp = np.maximum.accumulate(0.005 * np.arange(400) + random.uniform(0.0, 0.02, 400))
    path = tmp_path / "bursts.csv"
    rows = "".join(f"{at:.6f},{math.sin(0.1 * k):.6f},{k % 7}\n" for k, at in enumerate(stamp))
    path.write_text("t,q1,tau1\n" + rows, encoding="utf-8")
    with pytest.raises(CsvError, match=r"stamped when they arrived, in bursts.*columns\.rate") as refused:
        convert(read_tables(path)[0], Columns())
    assert "more digits" not in str(refused.value)


def test_a_right_recording_is_not_refused() -> None:
    refuse_slips([swung(lambda q: q)], "arm.csv")


def test_lengths_are_no_angles(tmp_path: Path) -> None:
    path = tmp_path / "tip.csv"
    path.write_text("t,x [mm],y [mm],tau1,tau2\n0,1,2,0,0\n", encoding="utf-8")
    with pytest.raises(CsvError, match=r"x \[mm\] and y \[mm\] are lengths"):
        convert(read_tables(path)[0], Columns())


def test_absolute_angles_are_made_relative(tmp_path: Path) -> None:
    path = tmp_path / "absolute.csv"
    rows = "".join(
        f"{0.01 * k:.2f},{math.sin(0.1 * k):.6f},{2 * math.sin(0.1 * k):.6f},{k % 7},{k % 5}\n" for k in range(200)
    )
    path.write_text("t,q1,q2,tau1,tau2\n" + rows, encoding="utf-8")
    (recording,) = convert(read_tables(path)[0], Columns(angles="absolute")).recordings
    assert recording.position[1] == pytest.approx(recording.position[0], abs=2e-6)


@pytest.mark.parametrize("scale", [180.0 / math.pi, 60.0])
def test_angles_beyond_any_arm_are_refused_at_once(scale: float) -> None:
    """As degrees under a header without a unit, or one that states another."""
    path = write("a.csv", scale=(1.0, 1.0, scale, 1.0, 1.0))
    with pytest.raises(CsvError, match=r"column 'q2' goes from .* Is it in degrees\?.*config=\"ARM.toml\""):
        read(path)
    assert read(path, Columns(position_unit="rad")).recordings, "the user says so"
    stated = write("b.csv", ("time", "q1", "q2 [rad]", "tau1", "tau2"), scale=(1.0, 1.0, 60.0, 1.0, 1.0))
    with pytest.raises(CsvError, match="unit in the column's header"):
        read(stated)


def test_whole_numbers_beyond_degrees_are_taken_for_ticks(tmp_path: Path) -> None:
    path = tmp_path / "ticks.csv"
    rows = "".join(f"{0.01 * k:.2f},{round(2048 + 900 * math.sin(0.1 * k))},{k % 7}\n" for k in range(200))
    path.write_text("t,present_position_1,tau_1\n" + rows, encoding="utf-8")
    with pytest.raises(CsvError, match=r"Is it in encoder ticks\?.*position_unit = \"ticks\" and ticks_per_turn"):
        convert(read_tables(path)[0], Columns())


def test_a_speed_beyond_any_servo_is_refused_and_rotation_is_not() -> None:
    table = np.column_stack((TIME, 9.0 * TIME, 300.0 * TIME, TORQUES.T))
    lines = [",".join(HEAD), *(",".join(f"{value:.9g}" for value in row) for row in table)]
    for name, columns, wrong in (("q1", "0,1,3", False), ("q2", "0,2,4", True)):
        kept = [",".join(line.split(",")[int(each)] for each in columns.split(",")) for line in lines]
        Path("a.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")
        if not wrong:
            assert read(Path("a.csv")).recordings, f"{name} rotates on and on"
            continue
        with pytest.raises(CsvError, match="more than 5 times that of any servo"):
            read(Path("a.csv"))


def test_a_column_named_datetime_is_the_time_and_one_without_a_name_is_named() -> None:
    Path("a.csv").write_text(
        "datetime,q1,tau1,\n"
        + "".join(
            f"2026-03-01T00:00:{time:09.6f},{angle:.6f},{torque:.6f},0\n"
            for time, angle, torque in zip(TIME, ANGLES[0], TORQUES[0], strict=True)
        ),
        encoding="utf-8",
    )
    (note, *_) = read(Path("a.csv")).notes
    assert "time = datetime" in note and "Not used: a column without a name." in note


def test_the_example_of_a_file_of_one_joint_has_its_own_names() -> None:
    Path("a.csv").write_text("t,q1,cmd\n0,0,0\n1,1,1\n", encoding="utf-8")
    with pytest.raises(CsvError, match=r'time = "t"\nposition = \["q1"\]\ntorque = \["cmd"\]'):
        read(Path("a.csv"))


def test_three_joints_need_a_urdf() -> None:
    Path("a.csv").write_text("t,q1,q2,q3,tau1,tau2,tau3\n0,1,2,3,4,5,6\n", encoding="utf-8")
    with pytest.raises(CsvError, match=r"q1, q2, q3 seem to be the positions of 3 joints; .* arm\.urdf") as caught:
        read(Path("a.csv"))
    assert "torque" not in str(caught.value)


def test_an_angle_that_wraps_is_to_be_unwrapped() -> None:
    def wrapped(rows: list[str]) -> list[str]:
        return [*rows[:9], *(f"{t},{float(q) + 6.28},{r}" for t, q, r in (row.split(",", 2) for row in rows[9:]))]

    with pytest.raises(CsvError, match="unwrap the angle"):
        spoilt(wrapped)
