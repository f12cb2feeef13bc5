"""The wheel as users get it: small, complete, and working without a checkout; imports stay fast."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import hil
from hil.config.bundled import bundled_configs, find_config
from hil.config.schema import load_config
from tests.support.packages import build, unpack
from tests.support.paths import ROOT

MOST_CODE_BYTES = 1_220_000
"""Upper bound for the modules, compressed, without the archive's directory, which grows with their number [bytes].

It is raised deliberately, when features need it, not when something has slipped into the wheel.
"""

MOST_DATA_BYTES = 60_000
"""Upper bound for configurations, templates and tables: recordings, runs or pictures would exceed it [bytes]."""

KINDS = {".py", ".typed", ".toml", ".urdf", ".j2", ".js", ".css"}
"""Suffixes of the files in the wheel; its metadata aside."""


def test_the_wheel_is_small_and_whole(wheel: Path) -> None:
    assert hil.__version__ in wheel.name
    content = zipfile.ZipFile(wheel)
    names = content.namelist()
    files = [each for each in content.infolist() if ".dist-info" not in each.filename]
    code = [each for each in files if each.filename.endswith(".py")]
    size, code_size = (sum(each.compress_size for each in some) for some in (files, code))
    assert code_size < MOST_CODE_BYTES and size - code_size < MOST_DATA_BYTES
    assert {Path(each.filename).suffix for each in files} <= KINDS
    for needed in ("hil/configs/fake_two_link.toml", "hil/report/page.js", "hil/py.typed", "hil/estimator/identify.py"):
        assert needed in names
    assert not [name for name in names if name.startswith("tests") or "configs/runs/" in name]


def test_the_wheel_of_the_sdist_is_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    """The links hil/drivers -> ../drivers are not followed: the sdist contains their targets."""
    with tarfile.open(build("sdist", ROOT, tmp_path / "sdist")) as sdist:
        assert not [member.name for member in sdist if member.issym()]
        sdist.extractall(tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    again = build("wheel", source, tmp_path / "wheel")
    contents = []
    for built in (wheel, again):
        with zipfile.ZipFile(built) as archive:
            contents.append({name: archive.read(name) for name in archive.namelist() if not name.endswith("RECORD")})
    assert contents[0].keys() == contents[1].keys()
    assert contents[0] == contents[1]
    assert {name.partition("/")[0] for name in contents[1]} == {"hil", f"hil-{hil.__version__}.dist-info"}


@pytest.mark.slow
def test_a_bundled_arm_is_checked_by_name_without_a_checkout(wheel: Path, tmp_path: Path) -> None:
    """tests/project/test_beside_others.py does the same in an environment of its own, from the same unpacked wheel."""
    unpack(wheel, tmp_path / "installed")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "installed")}
    code = (
        "import sys, hil.cli.app; print(hil.__file__); sys.argv = ['hil', 'check', 'fake_two_link']; hil.cli.app.main()"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True)
    assert done.stdout.startswith(str(tmp_path / "installed"))


@pytest.mark.slow
def test_a_clean_environment_identifies_a_bundled_arm(wheel: Path, tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", wheel], check=True, cwd=tmp_path)
    command = [tmp_path / "venv" / "bin" / "hil", "identify", "fake_two_link", "--out", "run"]
    subprocess.run(command, check=True, cwd=tmp_path)
    assert (tmp_path / "run" / "report.html").is_file()


def test_a_bare_name_is_a_file_first_and_a_bundled_arm_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_config(Path("fake_two_link")) == bundled_configs()["fake_two_link"]
    assert find_config(Path("no_such_arm")) == Path("no_such_arm")
    assert find_config(Path("fake_two_link.toml")) == Path("fake_two_link.toml")
    Path("fake_two_link").touch()
    assert find_config(Path("fake_two_link")) == Path("fake_two_link")


def test_import_and_help_load_nothing_heavy() -> None:
    """Slow imports would break the limits of 0.1 s for `import hil` and 0.3 s of processor time for `hil --help`."""
    heavy = "{'numpy', 'scipy', 'numba', 'pydantic', 'serial', 'dynamixel_sdk', 'rich', 'jinja2', 'matplotlib'}"
    for code in ("import sys, hil", "import sys, hil.cli.app", "import sys, hil.fakes.pytest_plugin"):
        check = f"{code}; loaded = {heavy} & set(sys.modules); assert not loaded, loaded"
        subprocess.run([sys.executable, "-c", check], check=True)


def test_every_bundled_configuration_is_valid() -> None:
    assert bundled_configs()
    for path in bundled_configs().values():
        config = load_config(path)
        said = "not tested on hardware" in path.read_text(encoding="utf-8")
        assert said != config.is_fake, f"{path.name} must say whether it was tested on hardware"


def test_version_changelog_and_citation_agree() -> None:
    assert f"## {hil.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited and cited[1] == hil.__version__


def test_shell_completion_is_offered() -> None:
    environment = {**os.environ, "_HIL_COMPLETE": "complete_bash", "COMP_WORDS": "hil exp", "COMP_CWORD": "1"}
    hil_command = Path(sys.executable).with_name("hil")
    done = subprocess.run([hil_command], env=environment, capture_output=True, text=True, check=False)
    assert "export" in done.stdout
