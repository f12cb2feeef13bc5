"""An installed wheel next to a user's own packages `drivers`, `estimator` and `fakes`: imports do not collide."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.packages import unpack

THEIR_TESTS = """
import drivers, estimator, fakes
import hil, hil.drivers, hil.estimator, hil.fakes
from hil.drivers.packet import encode

def test_theirs_are_theirs():
    assert drivers.OWNER == estimator.OWNER == fakes.OWNER == "stranger"

def test_ours_are_ours():
    for package in (hil.drivers, hil.estimator, hil.fakes):
        assert package.__name__.startswith("hil.") and not hasattr(package, "OWNER")

def test_the_fixture_works(fake_arm):
    port = fake_arm()
    assert not port.bus.servos[1].torque_enabled
"""


@pytest.fixture(scope="module", params=["unpacked", pytest.param("installed", marks=pytest.mark.slow)])
def environment(request: pytest.FixtureRequest, wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """bin/ of a fresh environment with the wheel: unpacked next to borrowed dependencies, or installed by pip."""
    folder = tmp_path_factory.mktemp("environment")
    binaries = folder / "bin"
    if request.param == "installed":
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        subprocess.run(
            [binaries / "python", "-m", "pip", "install", "--quiet", wheel, "pytest"], check=True, cwd=folder
        )
        return binaries
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    packages = folder / "lib" / version / "site-packages"
    unpack(wheel, packages)
    (packages / "borrowed.pth").write_text(str(Path(np.__file__).parents[1]), encoding="utf-8")
    for name, module, function in (("pytest", "pytest", "console_main"), ("hil", "hil.cli.app", "main")):
        script = binaries / name
        script.write_text(f"#!{binaries / 'python'}\nfrom {module} import {function}\n{function}()\n", encoding="utf-8")
        script.chmod(0o755)
    return binaries


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A user's project with its own packages, module and tests."""
    for name in ("drivers", "fakes"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text('OWNER = "stranger"\n', encoding="utf-8")
    (tmp_path / "estimator.py").write_text('OWNER = "stranger"\n', encoding="utf-8")
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_theirs.py").write_text(THEIR_TESTS, encoding="utf-8")
    (tmp_path / "conftest.py").touch()  # plain pytest adds the folder of a conftest.py to the path
    return tmp_path


def run(project: Path, *command: str | Path) -> str:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "PYTHON"))}
    environment["NUMBA_DISABLE_JIT"] = "1"  # nothing moves for long enough to be worth compiling for
    done = subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_strangers_tests_pass_under_pytest_and_python_m_pytest(environment: Path, project: Path) -> None:
    for command in ((environment / "pytest",), (environment / "python", "-m", "pytest")):
        assert "3 passed" in run(project, *command, "-p", "no:cacheprovider")


def test_the_command_works_among_them(environment: Path, project: Path) -> None:
    """As script, and, where the project's folder precedes all others, as module and as library in one process."""
    assert run(project, environment / "hil", "--version").startswith("hil 0.")
    code = (
        "import runpy, sys, hil, fakes\n"
        "assert hil.check('fake_two_link').ready and fakes.OWNER == 'stranger'\n"
        "print(hil.__file__, flush=True)\n"
        "sys.argv[1:] = ['check', 'fake_two_link']\n"
        "runpy.run_module('hil', run_name='__main__', alter_sys=True)\n"
    )
    where, said = run(project, environment / "python", "-c", code).split("\n", 1)
    assert Path(where).is_relative_to(environment.parent)
    assert "Ready" in said
