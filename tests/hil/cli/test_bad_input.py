"""Bad inputs over all commands: the right exit code, one message that names it, no traceback, nothing lost."""

import json
import os
import re
import shutil
import signal
import stat
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil.cli.errors import message, stop_behind
from hil.config.schema import load_config
from hil.errors import ConfigError, ExperimentError, StopRequested
from hil.pilot.search import pilot_config
from tests.support.command_line import hil
from tests.support.paths import CONFIGS

ARM = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
JOINT = ("[[joints]]" + ARM.split("[[joints]]")[1].split("\n[")[0] + "\n").replace("id = 1", "id = 3")
CSV = "t,q1,tau1\n" + "".join(f"{0.01 * k:.2f},{0.001 * (k * k % 97):.4f},{0.1 * (k % 7):.2f}\n" for k in range(100))

# Files of the folder in which every command runs, by name.
FILES: dict[str, bytes] = {
    "arm.toml": ARM.encode(),
    "binary.toml": bytes(range(128, 256)),
    "empty.toml": b"",
    "broken.toml": b"[arm\n",
    "bom.toml": b"\xef\xbb\xbf[arm\n",
    "typo.toml": ARM.replace("peak_torque", "peak_torqe").encode(),
    "turned.toml": ARM.replace("rate = 400.0", "raet = 400.0").encode(),
    "escape.toml": ARM.replace('url = "fake://"', 'url = "/dev/x\\u001b[2J"').encode(),
    "large.toml": b"a = [" + b"1," * 2_000_001 + b"]\n",
    "short.toml": b'[columns]\nposition = ["q1"]\ntorque = ["tau1"]\nsegment = 1e-6\n',
    "no_joints.toml": ARM.split("[[joints]]")[0].encode(),
    "twice.toml": ARM.replace("id = 2", "id = 1").encode(),
    "model.toml": ARM.replace('model = "XM430-W350"', 'model = "XM999"').encode(),
    "baud.toml": ARM.replace("baud = 1_000_000", "baud = 1234567").encode(),
    "band.toml": ARM.replace("band = [0.1, 5.0]", "band = [5.0, 0.1]").encode(),
    "text.toml": ARM.replace("rate = 400.0", 'rate = "fast"').encode(),
    "inf.toml": ARM.replace("gravity = 9.81", "gravity = inf").encode(),
    "columns.toml": b'[columns]\nposition = ["q1"]\ntorque = ["tau1"]\n',
    "joints.toml": b'[columns]\nposition = ["q1", "q2", "q3"]\ntorque = ["a", "b", "c"]\n',
    "both.toml": b'[columns]\nposition = ["q1"]\ntorque = ["tau1"]\ncurrent = ["tau1"]\n',
    "unit.toml": b'[columns]\nposition = ["q1"]\ntorque = ["tau1"]\nposition_unit = "grad"\n',
    "good.csv": CSV.encode(),
    "empty.csv": b"",
    "header.csv": b"t,q1,tau1\n",
    "no_header.csv": CSV.partition("\n")[2].encode(),
    "ragged.csv": (CSV + "1,2\n").encode(),
    "words.csv": CSV.replace("0.10,", "soon,", 1).encode(),
    "twice.csv": CSV.replace("t,q1,tau1", "t,q1,q1").encode(),
    "binary.csv": bytes(range(256)) * 9,
    "backwards.csv": ("t,q1,tau1\n" + "\n".join(reversed(CSV.splitlines()[1:]))).encode(),
    "still.csv": ("t,q1,tau1\n" + "".join(f"{0.01 * k:.2f},1.0,0.1\n" for k in range(100))).encode(),
    "unknown.csv": b"a,b,c\n1,2,3\n",
    "not.parquet": b"PAR0 no",
    "not.mcap": b"MCAP no",
    "old.db3": b"SQLite format 3",
    "arm.npz": b"PK",
    "arm.jsonl": b"{}",
    "study.toml": b"[study]\n",
    "seed.toml": ARM.replace("seed = 1\n", "seed = 9223372036854775808\n", 1).encode(),
    "three.toml": ARM.replace("[[joints]]", f"{JOINT}[[joints]]", 1).encode(),
    "degrees.toml": ARM.replace("position_limit = [-3.1, 3.1]", "position_limit = [-178, 178]").encode(),
    "swapped.toml": ARM.replace("position_limit = [-4.2, 1.06]", "position_limit = [1.06, -4.2]").encode(),
    "negative.toml": ARM.replace("velocity_limit = 15.0", "velocity_limit = -15.0").encode(),
    "id.toml": ARM.replace("id = 1", 'id = "1"', 1).encode(),
    "utf16.toml": ARM.encode("utf-16"),
    "millimetres.toml": ARM.replace("[arm]\n", "[arm]\nlink_lengths = [147, 180]\n", 1).encode(),
    "arm.yaml": b"port:\n  url: fake\n",
    "mbaud.toml": ARM.replace("baud = 1_000_000", "baud = 1", 1).encode(),
    "radians.toml": ARM.replace("band = [0.1, 5.0]", "band = [0.7, 200.0]").encode(),
    "kilohertz.toml": ARM.replace("rate = 400.0", "rate = 0.4").encode(),
    "long.toml": ARM.replace("period = 10.0", "period = 10000").encode(),
    "watch.toml": (ARM + "\n[safety]\nwatchdog = 80\n").encode(),
    "date.toml": re.sub(r"(?m)^period = \S+", "period = 2026-11-28", ARM).encode(),
    "ratio.toml": ARM.replace("gear_ratio = 353.5", 'gear_ratio = "353:1"', 1).encode(),
    "fakemm.toml": ARM.replace("length = 0.147", "length = 147.0", 1).encode(),
    "milliamperes.toml": ARM.replace("current_limit = 1.2", "current_limit = 1200", 1).encode(),
    "page.csv": b"<!DOCTYPE html><html><body>404</body></html>",
    "lines.csv": b'{"t": 0, "q1": 0}\n{"t": 1, "q1": 0}\n',
    "long.csv": (CSV + "9" * 200_000 + ",1,1\n").encode(),
    "zip.csv": b"PK\x03\x04" + bytes(range(256)) * 8,
    "milliseconds.csv": ("t,q1,tau1\n" + "".join(f"{5000 * k},{k % 7},{k % 5}\n" for k in range(100))).encode(),
    "short.csv": b"t,q1,tau1\n0,0,0\n0.01,0,0\n",
    "no_numbers.csv": ("t,q1,tau1\n" + "".join(f"{0.01 * k:.2f},nan,nan\n" for k in range(100))).encode(),
    "infinite.csv": CSV.replace("0.10,", "inf,", 1).encode(),
    "notes.txt": b"t,q1\n",
    "file": b"a file",
    "result.json": b"{}",
}

# command line, exit code, part of the message; there is a run folder `run`, and broken copies of it (see `make`).
CASES: list[tuple[str, int, str]] = [
    # configuration files, by every command that takes one
    *((f"{command} nowhere.toml", 2, "nowhere.toml") for command in ("identify", "record", "check", "dry-run")),
    *((f"{command} binary.toml", 2, "binary.toml") for command in ("identify", "record", "check", "dry-run")),
    *((f"{command} empty.toml", 2, "empty.toml") for command in ("identify", "check", "dry-run")),
    *((f"{command} broken.toml", 2, "not valid TOML") for command in ("identify", "record", "check", "dry-run")),
    ("identify bom.toml", 2, "not valid TOML"),
    ("identify typo.toml", 2, "peak_torqe"),
    ("check typo.toml", 2, "peak_torqe"),
    ("dry-run typo.toml", 2, "peak_torqe"),
    ("check turned.toml", 2, "experiment.raet is not a known key; did you mean rate?"),
    ("check escape.toml", 2, "port.url = '/dev/x\\x1b[2J': must not contain"),
    ("check large.toml", 2, "it is larger than 4 MB"),
    ("identify no_joints.toml", 2, "joints"),
    ("identify twice.toml", 2, "two joints have the same id 1"),
    ("identify model.toml", 2, "XM999"),
    ("check baud.toml", 2, "1234567"),
    ("identify band.toml", 2, "band"),
    ("identify text.toml", 2, "rate"),
    ("identify inf.toml", 2, "gravity"),
    ("identify .", 2, "."),
    ("identify", 2, "Missing argument"),
    ("identify arm.toml broken.toml", 2, "unexpected extra argument"),
    ("identify arm.toml --out run", 2, "not empty"),
    ("identify arm.toml --out file", 2, "file"),
    ("identify arm.toml --out file/below", 2, "file"),
    ("record arm.toml --out run", 2, "not empty"),
    ("identify arm.toml --outt run", 2, "No such option"),
    ("identify run", 2, "run"),
    ("nonsense", 2, "No such command"),
    # recordings
    ("estimate nowhere", 2, "nowhere"),
    ("estimate nowhere.csv", 2, "nowhere.csv"),
    ("estimate file", 2, "file"),
    ("estimate .", 2, "not a run folder"),
    ("estimate good.csv --config short.toml", 2, "columns.segment = 1e-06 s: a segment must hold at least 8 samples"),
    ("estimate good.csv good.csv --config columns.toml", 2, "good.csv and good.csv hold the same samples"),
    ("estimate . --config columns.toml", 2, "not a run folder"),
    ("estimate empty.csv", 2, "is empty"),
    ("estimate header.csv", 2, "no line of numbers, only a header"),
    ("estimate no_header.csv", 2, "no header line"),
    ("estimate ragged.csv", 2, "line 102: 2 fields for 3 columns"),
    ("estimate words.csv", 2, "words.csv, line 12: column 't' is 'soon'; it must be a finite number."),
    ("estimate twice.csv", 2, "two columns are named 'q1'"),
    ("estimate binary.csv", 2, "binary"),
    ("estimate backwards.csv", 2, "time goes back"),
    ("estimate still.csv", 2, "the position of joint 1 is always 1 rad"),
    ("estimate unknown.csv", 2, "a, b, c"),
    ("estimate not.parquet", 2, "not.parquet"),
    ("estimate not.mcap", 2, "not.mcap cannot be read: it is not an MCAP file, or it is incomplete or damaged."),
    ("estimate old.db3", 2, ".db3 files are not supported"),
    ("estimate arm.npz --config columns.toml --out other", 2, ".npz files are not supported. Recordings are CSV"),
    ("estimate arm.jsonl --out other", 2, ".jsonl files are not supported"),
    ("estimate notes.txt", 2, "no line of numbers"),
    ("estimate good.csv --config nowhere.toml", 2, "nowhere.toml"),
    ("estimate good.csv --config binary.toml", 2, "binary.toml"),
    ("estimate good.csv --config broken.toml", 2, "not valid TOML"),
    ("estimate good.csv --config joints.toml", 2, "position"),
    ("estimate good.csv --config both.toml", 2, "columns.torque and columns.current are both given"),
    (
        "estimate good.csv --config unit.toml",
        2,
        "columns.position_unit = 'grad': must be one of 'rad', 'mrad', 'deg', 'turns' or 'ticks'.",
    ),
    ("estimate good.csv --config columns.toml --out run", 2, "not empty"),
    ("estimate good.csv --config columns.toml --out file", 2, "file"),
    ("estimate good.csv run", 2, "not both"),
    ("estimate run run", 2, "one run folder"),
    ("estimate run --out other", 2, "--out is for"),
    # damaged run folders
    *((f"{command} cut_config", 2, "config.toml") for command in ("estimate", "report", "compare")),
    *((f"{command} cut_samples", 2, "samples.npy") for command in ("estimate", "report", "compare")),
    *((f"{command} cut_run", 2, "run.json") for command in ("estimate", "report", "compare")),
    *((f"{command} cut_result", 2, "result.json") for command in ("report", "export --format toml", "diff run")),
    *((f"{command} no_result", 2, "hil estimate") for command in ("report", "export --format toml", "diff run")),
    ("estimate old_schema", 2, "schema"),
    ("report new_result", 2, "newer"),
    ("runs nowhere", 2, "nowhere"),
    ("runs file", 2, "is not a folder"),
    ("note nowhere --text x", 2, "nowhere"),
    ("note file --text x", 2, "not a run folder"),
    ("export run --format mjcf --out .", 2, ". is a folder"),
    ("export run --format mjcf --out nowhere/arm.xml", 2, "the folder nowhere does not exist"),
    ("export run --format mjcf --samples 0", 2, "from 2"),
    ("export run --format csv --samples 3 --out arms", 2, "not 'csv'"),
    ("estimate run --config columns.toml", 2, "--config is for recordings"),
    ("estimate run/config.toml", 2, "give the folder of a run"),
    ("check run", 2, "did you mean run/config.toml"),
    ("check degrees.toml", 2, "at most 12.57 rad is allowed. If it is in degrees"),
    ("check seed.toml", 2, "experiment.seed = 9223372036854775808: must be at most 9223372036854775807."),
    ("check three.toml", 2, "three.toml: joints: 3 joints need arm.urdf"),
    ("fake koch --fault lost_reply:probability=nan", 2, "probability = nan: must be a finite number."),
    ("dry-run arm.toml --arms 3", 2, "Invalid value for '--arms': 3 must be at least 20."),
    ("calibrate run run2 --mass nan", 2, "Invalid value for '--mass': nan must be a finite number."),
    ("fake koch --seed x", 2, "Invalid value for '--seed': x must be a whole number."),
    ("check swapped.toml", 2, "the first value must be the smaller one"),
    ("check negative.toml", 2, "must be greater than 0"),
    ("check id.toml", 2, "must be a whole number"),
    ("check utf16.toml", 2, "UTF-16 text"),
    ("identify millimetres.toml", 2, "If it is in mm"),
    ("estimate page.csv", 2, "page.csv cannot be read: it is HTML, XML or JSON"),
    ("estimate lines.csv", 2, "lines.csv cannot be read: it is HTML, XML or JSON"),
    ("estimate long.csv", 2, "long.csv, line 102 is too long: at most 131072 characters can be read."),
    ("estimate zip.csv", 2, "a binary one"),
    ("estimate milliseconds.csv", 2, "Is time in seconds?"),
    ("estimate no_numbers.csv", 2, "no numbers"),
    ("estimate infinite.csv", 2, "line 12"),
    ("diff run run --png nowhere/wear.png", 2, "nowhere/wear.png cannot be written"),
    ("diff run run --png wear.docx", 2, "docx"),
    ("note nowhere --name x", 2, "not a run folder"),
    ("runs arm.toml", 2, "not a folder"),
    ("init run --yes --out new.toml", 2, "it is a folder, not a serial port"),
    ("init arm.toml --yes --out nowhere/new.toml", 2, "the folder nowhere does not exist"),
    ("setup arm.toml --id 1 --new-id 2 --yes", 2, "ID 2 is taken"),
    ("setup arm.toml --id 9 --return-delay-us 0 --yes", 1, "ID 9 does not answer"),
    ("report run --out nowhere/page.html", 2, "nowhere/page.html"),
    ("report run --out /", 2, "/ is a folder: give the name of the file to write"),
    ("report run --svg arm.toml", 2, "arm.toml"),
    ("diff run nowhere", 2, "nowhere"),
    ("diff run", 2, "Missing argument"),
    ("diff run file", 2, "file"),
    ("diff run result.json", 2, "result.json"),
    # results
    ("report nowhere", 2, "nowhere"),
    ("report .", 2, "result.json"),
    ("report run --out file/below.html", 2, "file"),
    ("report run --svg file", 2, "file"),
    ("export run --format step", 2, "'step' is not a format"),
    ("export run", 2, "Missing option"),
    ("export nowhere --format urdf", 2, "nowhere"),
    ("export run --format urdf --format mjcf --out x", 2, "exactly one"),
    ("export run --format toml --out nowhere/deep/arm.toml", 2, "nowhere/deep"),
    ("export run --format mjcf --link-length -1", 2, "link-length"),
    ("export run --format mjcf --samples 0 --out drawn", 2, "samples"),
    ("export run --format mjcf --samples many", 2, "samples"),
    ("export run --format csv --samples 3 --out drawn", 2, "csv"),
    ("calibrate run", 2, "Missing argument"),
    ("calibrate run run --mass 0.1 --distance 0.1", 2, "given twice"),
    ("calibrate run nowhere --mass 0.1 --distance 0.1", 2, "nowhere"),
    ("calibrate run no_result --mass 0 --distance 0.1", 2, "mass"),
    ("calibrate run no_result --mass heavy --distance 0.1", 2, "mass"),
    # the bus
    ("scan nowhere.toml", 2, "nowhere.toml"),
    ("scan /dev/ttyNOPE", 2, "/dev/ttyNOPE"),
    ("scan /dev/null", 2, "not a serial port"),
    ("scan file", 2, "file"),
    ("scan /dev/ttyNOPE --baud 57600", 2, "there is no such device"),
    ("setup /dev/ttyNOPE --baud 57600 --id 1 --new-id 2", 2, "/dev/ttyNOPE"),
    ("setup /dev/null --baud 57600 --id 1 --new-id 2", 2, "/dev/null"),
    ("setup /dev/ttyNOPE --id 300 --new-id 2", 2, "252"),
    ("setup arm.toml --id 1 --new-id 999", 2, "252"),
    ("init /dev/ttyNOPE --out new.toml", 2, "/dev/ttyNOPE"),
    ("init /dev/null --out new.toml", 2, "/dev/null"),
    ("init arm.toml --out arm.toml", 2, "arm.toml"),
    # fakes, studies, schema
    ("fake nowhere", 2, "nowhere"),
    ("fake broken.toml --pty", 2, "not valid TOML"),
    ("fake arm.toml --pty --fault foo", 2, "there is no kind 'foo'"),
    ("fake arm.toml --pty --fault silent:servo=9", 2, "9"),
    ("fake arm.toml --pty --fault silent:at=soon", 2, "soon"),
    ("fake arm.toml --pty --link file", 2, "file"),
    ("hand nowhere 1:to=0.5", 2, "nowhere"),
    ("study nowhere.toml", 2, "nowhere.toml"),
    ("study study.toml", 2, "study.toml"),
    ("study broken.toml", 2, "not valid TOML"),
    ("schema --out nowhere/deep/schema.json", 2, "nowhere/deep"),
    ("dry-run arm.toml --arms 0", 2, "arms"),
    ("dry-run arm.toml", 2, "link_lengths"),
    # thirty more, as typed by a first-time user (2026-11-22)
    ("identfy arm.toml", 2, "Did you mean 'identify'?"),
    ("--versoin", 2, "--version"),
    ("identify arm.toml --live paper", 2, "must be terminal, rerun"),
    ("record arm.toml --live", 2, "--live"),
    ("identify study.toml", 2, "Type: hil study study.toml"),
    ("identify columns.toml", 2, "Type: hil estimate FILE.csv --config columns.toml"),
    ("study arm.toml", 2, "describes an arm, not a study"),
    ("check arm.toml extra", 2, "extra"),
    ("dry-run arm.toml --arms ten", 2, "--arms"),
    ("dry-run arm.toml --result arm.toml", 2, "is not a hil result file"),
    ("dry-run arm.toml --picture x.pdf", 2, "must end in .png, .svg or .html"),
    ("dry-run arm.toml --picture nowhere/x.png", 2, "the folder nowhere does not exist"),
    ("scan fake_tow_link", 2, "did you mean fake_two_link?"),
    ("scan arm.toml --baud 12", 2, "12: servos support 9600"),
    ("setup arm.toml --id 1 --baud 12 --new-id 3", 2, "12: servos support 9600"),
    ("fake fake_two_lnk", 2, "did you mean fake_two_link?"),
    ("fake arm.toml --fault lost_replyy", 2, "Did you mean lost_reply?"),
    ("fake arm.toml --fault lost_reply:probability=2", 2, "probability = 2.0: must be at most 1.0"),
    ("fake arm.toml --fault lost_reply:at=-1", 2, "at = -1.0: must be at least 0.0"),
    ("fake arm.toml --move 1", 2, 'move "1": give either `to` (angle, rad) or `ticks`'),
    ("fake arm.toml --move 1:to=nan", 2, "to = nan: must be a finite number"),
    ("fake arm.toml --move 1:to=1,duration=0", 2, "duration = 0.0: must be greater than 0"),
    ("fake arm.toml --seed -1", 2, "--seed"),
    ("hand arm.toml 1:to=2", 2, "no fake arm is served here"),
    ("note nowhere", 2, "nowhere is not a run folder"),
    ("note . --name x", 2, "is not a run folder"),
    (
        "estimate good.csv",
        2,
        "good.csv: no recording has two segments of 1 s, one to fit and one to check; the longest",
    ),
    ("estimate short.csv", 2, "short.csv: the recording has 2 samples"),
    ("estimate run list.csv", 2, "give either one run folder or recordings"),
    ("estimate arm.toml", 2, "give the folder of a run"),
    ("estimate arm.toml --out other", 2, "To read a recording, hil estimate needs a CSV, Parquet"),
    ("export run --format stl", 2, "'stl' is not a format"),
    (
        "check arm.yaml",
        2,
        "arm.yaml: judging by its name, it is YAML; hil's files are TOML. `hil init` writes one.",
    ),
    ("check mbaud.toml", 2, "port.baud = 1: must be one of 9600,"),
    ("identify mbaud.toml", 2, "If it is in millions, write 1000000."),
    ("check radians.toml", 2, "If it is in rad/s, write [0.1114, 31.83]"),
    ("check kilohertz.toml", 2, "experiment.rate = 0.4: must be at least 20.0. If it is in kHz, write 400."),
    ("dry-run long.toml", 2, "experiment.period = 10000: must be at most 1000.0. If it is in ms, write 10."),
    ("check watch.toml", 2, "safety.watchdog = 80: must be at most 2.54. If it is in ms, write 0.08."),
    ("check date.toml", 2, "experiment.period = 2026-11-28: must be a number"),
    ("check ratio.toml", 2, "fake.arm.drives[1].gear_ratio = '353:1': must be a number"),
    ("fake arm.toml --move 1:to=90", 2, "to = 90.0: must be at most 12.57. If it is in degrees, write 1.571."),
    ("fake fakemm.toml", 2, "fake.arm.links[1].length = 147.0: must be at most 3.0. If it is in mm, write 0.147"),
    (
        "identify milliamperes.toml",
        2,
        "joints[1].current_limit = 1200: must be at most 30.0. If it is in mA, write 1.2.",
    ),
    ("export no_result --format mjcf", 2, "hil estimate no_result"),
    ("export .. --format mjcf", 2, ".. is not a run folder but contains run folders: did you mean ../here?"),
    ("export nothing --format mjcf", 2, "nothing is not a run folder: it has neither a result nor a recording."),
    ("calibrate run run --mass -1", 2, "--mass"),
    ("pose arm.toml", 2, "arm.urdf is missing"),
]


def make(here: Path, identified: Path) -> None:
    """The files above, a run folder and broken copies of it."""
    here.mkdir()
    for name, content in FILES.items():
        (here / name).write_bytes(content)
    broken: dict[str, dict[str, bytes | None]] = {
        "run": {},
        "cut_config": {"config.toml": b"\xff\xfe"},
        "cut_samples": {"samples.npy": b"\x93NUMPY"},
        "cut_run": {"run.json": b'{"schema": 1'},
        "cut_result": {"result.json": b'{"schema": 1, "method"'},
        "no_result": {"result.json": None},
        "old_schema": {"run.json": b'{"schema": 0}'},
        "new_result": {"result.json": json.dumps({"schema": 99}).encode()},
    }
    for name, changed in broken.items():
        (here / name).mkdir()
        for path in identified.iterdir():
            if path.is_file() and path.name not in changed:
                shutil.copy(path, here / name / path.name)
        for file, content in changed.items():
            if content is not None:
                (here / name / file).write_bytes(content)
    (here / "nothing").mkdir()


@pytest.fixture(scope="module")
def parent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("parent")


@pytest.fixture
def folder(parent: Path, identified_once: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """What `make` makes, once for all tests, since it takes as long as most of them; what one of them adds is removed,
    and if one changes something it is made again.
    """
    here = parent / "here"
    if not here.exists():
        make(here, identified_once)
    monkeypatch.chdir(here)
    monkeypatch.setattr(sys, "argv", sys.argv)
    before, there = contents(here), set(here.rglob("*"))
    yield here
    monkeypatch.chdir(parent)
    for path in set(here.rglob("*")) - there:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    if contents(here) != before:
        shutil.rmtree(here)


def contents(folder: Path) -> dict[str, tuple[int, ...]]:
    """All files with what changes if anything is written to them: a time that no program can set, and the size."""
    return {
        str(path.relative_to(folder)): (status.st_ino, status.st_size, status.st_ctime_ns)
        for path in sorted(folder.rglob("*"))
        if stat.S_ISREG((status := path.stat()).st_mode)
    }


LONG = "x" * 5000


@pytest.mark.parametrize(
    "line",
    [
        *("check", "identify", "dry-run", "estimate", "report", "runs", "note", "export --format urdf", "fake", "scan"),
        *("init", "pose", "compare", f"diff {LONG}", "fake koch --pty --link", "schema --out"),
    ],
)
def test_a_name_too_long_for_a_file_is_said_briefly(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil(*line.split(), LONG) == 2
    assert capsys.readouterr().err == f"hil: {LONG[:80]}...: File name too long.\n"


@pytest.mark.parametrize(("line", "code", "said"), CASES, ids=[case[0] for case in CASES])
def test_bad_input_is_named(line: str, code: int, said: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(folder)
    found = hil(*line.split())
    shown = capsys.readouterr()
    error = " ".join(shown.err.replace("│", " ").split())
    assert found == code, error
    assert said in error, error
    assert "Traceback" not in shown.err + shown.out
    assert "errno" not in error.lower() and "object has no attribute" not in error
    after = contents(folder)
    assert {name: after.get(name) for name in before} == before, "what was there is there"
    assert not [name for name in after.keys() - before.keys() if name.startswith("runs" + os.sep)]


def test_there_are_at_least_a_hundred_and_twenty() -> None:
    assert len(CASES) >= 190 and len({case[0] for case in CASES}) == len(CASES)


def test_a_byte_order_mark_is_no_mistake_and_other_encodings_are_named(tmp_path: Path) -> None:
    text = (CONFIGS / "first_time.toml").read_text(encoding="utf-8")
    marked = tmp_path / "marked.toml"
    marked.write_text(text, encoding="utf-8-sig")
    assert load_config(marked).joints == load_config(CONFIGS / "first_time.toml").joints
    marked.write_text(text, encoding="utf-16")
    with pytest.raises(ConfigError, match=r"UTF-16.*as UTF-8"):
        load_config(marked)
    marked.write_text(text.replace("[-4.2, 1.06]", "[-4.2, 1,06]"), encoding="utf-8")
    with pytest.raises(ConfigError, match="The decimal separator is a point"):
        load_config(marked)


def test_a_band_with_too_few_lines_is_a_mistake_in_the_file(tmp_path: Path) -> None:
    text = (CONFIGS / "first_time.toml").read_text(encoding="utf-8")
    file = tmp_path / "short.toml"
    file.write_text(text.replace("period = 10.0", "period = 0.2"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"short\.toml: experiment\.band = \[0\.1, 5\] Hz contains only 1 multiple"):
        load_config(file)
    file.write_text(text.replace("period = 10.0", "period = 0.5"), encoding="utf-8")
    config = load_config(file)
    assert pilot_config(config).experiment.period == config.experiment.period, "half of it has one line for two joints"


def test_a_file_without_its_ending_is_suggested(tmp_path: Path) -> None:
    (tmp_path / "my_arm.toml").write_text("", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"Did you mean .*my_arm\.toml\?"):
        load_config(tmp_path / "my_arm")


def test_a_closed_terminal_does_not_hide_the_stop() -> None:
    stop = StopRequested("stopped", number=signal.SIGHUP)
    closed = OSError(5, "Input/output error")
    closed.__context__ = BrokenPipeError()
    closed.__context__.__context__ = stop
    assert stop_behind(closed) is stop
    assert stop_behind(OSError()) is None
    assert stop_behind(ValueError()) is None


@pytest.mark.parametrize(("is_replaced", "told"), [(False, "hil: then\nPreceded by: first"), (True, "hil: then")])
def test_what_led_to_an_error_is_told_unless_the_error_replaces_it(is_replaced: bool, told: str) -> None:
    error = ExperimentError("then")
    error.__context__, error.__suppress_context__ = ConfigError("first"), is_replaced
    assert message(error) == told


def test_the_same_message_is_given_once() -> None:
    again = StopRequested("Stopped by Ctrl-C.", number=signal.SIGINT)
    again.__context__ = StopRequested("Stopped by Ctrl-C.", number=signal.SIGINT)
    assert message(again) == "hil: Stopped by Ctrl-C."
