"""docs/architecture.md agrees with the code: files and functions exist, imports are as stated, and the steps work."""

import ast
import os
import re
import shutil
import tomllib
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from tests.support.processes import forked

PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
FOLDERS = ("drivers", "estimator", "fakes")


def section(title: str) -> str:
    """The text under a heading, up to the next of the same or a higher level."""
    found = re.search(rf"^(##+) {re.escape(title)}\n(.*?)(?=^#{{2,3}} |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert found, title
    return found[2]


def test_every_file_that_is_named_exists() -> None:
    named = set(re.findall(r"`((?:hil|drivers|estimator|fakes|tests|docs)/[\w/]*(?:\.\w+|/)?)`", PAGE))
    assert len(named) > 20
    assert not [name for name in named if not (ROOT / name).exists()]


def test_the_data_path_names_functions_of_its_files() -> None:
    rows = re.findall(r"^\| [^|]+ \| `([\w/]+\.py)` \| `(\w+)` \|", section("The data path"), re.MULTILINE)
    assert len(rows) > 12
    for file, name in rows:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert name in {getattr(node, "name", "") for node in tree.body}, f"{file} has no {name}"


def test_the_import_table_is_what_the_linter_holds() -> None:
    rows = re.findall(r"^\| `(hil\.\w+)` \| `(\w+)/` \| (.*) \|$", section("Who may import whom"), re.MULTILINE)
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    forbidden = {
        contract["source_modules"][0]: set(contract["forbidden_modules"])
        for contract in settings["contracts"]
        if contract["type"] == "forbidden" and contract["source_modules"][0].removeprefix("hil.") in FOLDERS
    }
    assert {package for package, _, _ in rows} == set(forbidden) == {f"hil.{folder}" for folder in FOLDERS}
    inside = {path.stem if path.is_file() else path.name for path in (ROOT / "hil").iterdir()}
    others = {f"hil.{name}" for name in inside if not name.startswith("_") and name != "py" and "." not in name}
    for package, _, said in rows:
        allowed = set(re.findall(r"`(hil\.\w+)`", said)) | {package}
        everything = {name for name in others if _is_code(name)}
        free = everything - forbidden[package] - {package}
        # A leaf without imports needs no contract; no allowed import may be forbidden.
        assert not allowed & forbidden[package]
        assert free <= allowed | LEAVES, f"{package} may import {sorted(free - allowed - LEAVES)} too"


MOST_MODULES = 18
LEAVES = {"hil.unit_hints", "hil.toml_errors", "hil.toml_file", "hil.description"}
"""Modules that import nothing else of hil, or only leaves."""


def _is_code(name: str) -> bool:
    path = ROOT / "hil" / name.removeprefix("hil.")
    return any(path.glob("*.py")) or path.with_suffix(".py").is_file()


def test_leaves_import_nothing_of_hil() -> None:
    for leaf in LEAVES - {"hil.description"}:  # that one is checked by import-linter
        text = (ROOT / f"{leaf.replace('.', '/')}.py").read_text(encoding="utf-8")
        assert set(re.findall(r"^\s*(?:from|import) (hil\b(?:\.\w+)?)", text, re.MULTILINE)) <= LEAVES, leaf


@pytest.mark.parametrize("top", ["drivers", "estimator", "fakes", "hil", "benchmarks", "tests"])
def test_a_folder_can_be_read_at_a_glance(top: str) -> None:
    for folder in [ROOT / top, *(path for path in (ROOT / top).rglob("*") if path.is_dir())]:
        modules = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(modules) <= MOST_MODULES, f"{folder.relative_to(ROOT)} has {len(modules)} modules"


def blocks(title: str) -> list[tuple[str, str]]:
    """The code blocks of a section: file name and text."""
    found: list[tuple[str, str]] = re.findall(r'^```\w+ title="(.*?)"\n(.*?)^```', section(title), re.M | re.S)
    assert found
    return found


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the code that may be modified, with bytecode and compiled loops: only what changes is recompiled."""
    shutil.copytree(ROOT / "hil", tmp_path / "hil", ignore=shutil.ignore_patterns("configs", *FOLDERS))
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, tmp_path / "hil" / folder)
    return tmp_path


def follow(copy: Path, title: str) -> set[str]:
    """Carry out the steps of a section; return the changed files."""
    touched = set()
    for name, text in blocks(title):
        file = name.removesuffix(" (new file)")
        path = copy / (f"hil/{file}" if file.split("/")[0] in FOLDERS else file)
        touched.add(file)
        if name != file:
            assert not path.exists()
            path.write_text(text, encoding="utf-8")
            continue
        first, rest = text.split("\n", 1)
        before = path.read_text(encoding="utf-8")
        assert before.count(f"\n{first}\n") == 1, f"{file}: {first!r}"
        path.write_text(before.replace(f"\n{first}\n", f"\n{first}\n{rest}"), encoding="utf-8")
    return touched


FORGET = """
import sys
for name in [name for name in sys.modules if name.split(".")[0] == "hil"]:
    del sys.modules[name]
from numba.core.config import reload_config
reload_config()
"""
"""Code that forgets what the process has of hil, but not the libraries, and reads numba's variables again."""


def run(copy: Path, code: str, **options: str) -> None:
    """Run `code` in a process that imports the copy. options: further environment variables."""
    environment = {**os.environ, "PYTHONPATH": str(copy), **options}
    code = f"{FORGET}import hil; assert hil.__file__.startswith({str(copy)!r}), hil.__file__\n{code}"
    words = [forked.CODE, code]
    done = forked.run(words, cwd=copy, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_servo_model_as_described(copy: Path) -> None:
    assert follow(copy, "A servo model") == {"drivers/servo_model.py"}
    run(
        copy,
        """
from hil.drivers.servo_model import servo_model
from hil.fakes.servo.registers import load_model
assert servo_model("XD430-T210").torque_per_ampere.value > 1.0
assert load_model("XD430-T210").operating_modes
""",
    )


def test_a_friction_term_as_described(copy: Path) -> None:
    """The new term has correct derivatives and is known everywhere; not compiled, which takes most of the time."""
    touched = follow(copy, "A friction term")
    equations = {"estimator/simulation/arm.py", "estimator/simulation/sensitivity.py", "estimator/models/friction.py"}
    assert touched == {"estimator/models/terms.py", *equations, "hil/config/experiment.py"}
    run(copy, FRICTION.replace("SAMPLES", "100"), NUMBA_DISABLE_JIT="1")


@pytest.mark.slow
def test_a_friction_term_as_described_is_identified(copy: Path) -> None:
    follow(copy, "A friction term")
    run(copy, FRICTION.replace("SAMPLES", "1000") + IDENTIFIED)


FRICTION = """
import numpy as np
from hil.config.experiment import ModelConfig
from hil.estimation.model_from_config import wanted_model
from hil.estimator.excitation.multisine import design_multisine
from hil.estimator.models.parameters import Physics
from hil.estimator.models.terms import term_of
from hil.estimator.simulation.arm import simulate, steps_per_sample
from hil.estimator.simulation.drive import torque_and_slopes
from hil.estimator.simulation.sensitivity import Sensitive

truth = {"inertia_1": 0.02, "gravity_1": 0.5, "viscous_1": 0.03, "coulomb_1": 0.05, "offset_1": 0.002,
         "coulomb_width_1": 0.05, "drag_1": 0.004, "lag": 1e-3}
rate = 200.0
wave = design_multisine(rate, 5.0, ((1, 2, 4, 6, 9, 13, 17, 20),), (0.6,), 1)
steps = steps_per_sample(rate)
motor, slopes = torque_and_slopes(wave.torque, rate, 3e-4, steps, delay=0.0, lag=1e-3)
motor, slopes = motor[:, :SAMPLES], slopes[:, :, :SAMPLES]

state = np.array([[-1.5], [0.3]])
def moved(drag):
    return simulate(Physics.of(truth | {"drag_1": drag}), state, motor, 1.0 / (rate * steps))[0]
motion = Sensitive(Physics.of(truth), state, ("drag_1", "velocity_1"), 1.0 / (rate * steps))
position, derivative = motion.advance(motor, slopes)
assert np.allclose(position, moved(0.004), atol=1e-9)
differences = (moved(0.004 + 1e-6) - moved(0.004 - 1e-6)) / 2e-6
assert np.abs(differences).max() > 0.1, np.abs(differences).max()
assert np.allclose(derivative[:, :, 0], differences, atol=1e-4 * np.abs(differences).max())
faster = np.array([[0.0], [1e-6]])
up, down = (simulate(Physics.of(truth), state + sign * faster, motor, 1.0 / (rate * steps))[0] for sign in (1, -1))
by_velocity = (up - down) / 2e-6
assert np.allclose(derivative[:, :, 1], by_velocity, atol=1e-4 * np.abs(by_velocity).max())

model = wanted_model(ModelConfig(friction="coulomb", drive="lag", drag=True), 1)
assert dict(zip(model.names, model.units))["drag_1"] == term_of("drag_1").unit

from hil.arm_model import ArmModel, JointFacts
facts = JointFacts("joint", "XM430-W350", "current", 1.8, 0.1, 2.3, (-3.1, 3.1), 6.0)
with_drag, without = (ArmModel(truth | {"drag_1": drag}, {}, 9.81, (-1.57,), (facts,)) for drag in (0.004, 0.0))
assert np.allclose(with_drag.friction_torque([-2.0]) - without.friction_torque([-2.0]), -0.004 * 4.0)
"""

IDENTIFIED = """
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.identify import identify
rest = np.array([[-1.5], [0.0], [0.0]])
for _ in range(8):
    position, rest = simulate(Physics.of(truth), rest, motor, 1.0 / (rate * steps))
tick = 2 * np.pi / 4096
period = SettledPeriod(rate=rate, torque=wave.torque, position=np.round(position / tick) * tick,
                       command_to_sample=3e-4, position_step=np.array([tick]), periods=1)
found = identify(period, model)
assert abs(found.parameters["drag_1"] - 0.004) < 5 * found.std[found.names.index("drag_1")] < 0.002, found.parameters
"""


def test_a_fault_as_described(copy: Path) -> None:
    assert follow(copy, "A fault") == {"fakes/bus/faults.py", "fakes/bus/fault_effects.py"}
    run(
        copy,
        """
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.bus.faults import parse_fault
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import EmulatedServo
class Still:
    joints, position, velocity, current = 1, (0.0,), (0.0,), (0.0,)
    def advance(self, until, current): pass
servo = EmulatedServo(load_model("XM430-W350"), 1)
clock = VirtualClock()
bus = FakeBus([servo], Still(), clock)
clock.wait_until(clock.now() + 1.0)
bus.read(1, 0.0)
servo.write(64, bytes([1]))
assert servo.torque_enabled
bus.faults.add(parse_fault("torque_lost:servo=1,at=2"))
clock.wait_until(clock.now() + 0.5)
bus.read(1, 0.0)
assert servo.torque_enabled
clock.wait_until(clock.now() + 1.0)
bus.read(1, 0.0)
assert not servo.torque_enabled and bus.faults.happened[0].kind == "torque_lost"
""",
    )


def test_an_export_as_described(copy: Path, identified_once: Path) -> None:
    assert follow(copy, "An export") == {"hil/export/markdown.py", "hil/export/formats.py"}
    run(
        copy,
        f"""
from pathlib import Path
from hil.export.formats import export
written = export(Path({str(identified_once)!r}), "md", Path("arm.md"))
assert "| inertia_1 | 0.0" in written.path.read_text() and "kg m^2" in written.path.read_text()
assert written.left_out
""",
    )


def test_a_plant_as_described(copy: Path) -> None:
    assert follow(copy, "A plant") == {"my_wheel.py"}
    table = re.search(r"^```toml\n(.*?)^```", section("A plant"), re.MULTILINE | re.DOTALL)
    assert table
    text = (ROOT / "configs" / "fake_two_link.toml").read_text(encoding="utf-8")
    before, fake = text.split("[fake]\n")
    servos = "".join(re.findall(r"^\[\[fake\.servos\]\]\n(?:[^\[\n].*\n|\n)*", fake, re.MULTILINE))
    assert servos
    (copy / "arm.toml").write_text(before + table[1] + "\n" + servos, encoding="utf-8")
    run(
        copy,
        """
from pathlib import Path
from hil.config.schema import load_config
from hil.fakes import allow_code
allow_code()
plant = load_config(Path("arm.toml")).fake.make_plant()
plant.advance(0.1, (1.0, 0.0))
assert abs(plant.velocity[0] - 9.0) < 1e-9 and plant.position[1] == 0.0
""",
    )


def test_hooks_run_what_make_lint_runs() -> None:
    hooks = re.findall(
        r"entry: \.venv/bin/([\w-]+)( \w+)?", (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    )
    lint = re.search(r"^lint:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert lint
    assert {"".join(hook) for hook in hooks} == set(re.findall(r"\$\(BIN\)/([\w-]+(?: (?:check|format))?)", lint[1]))
