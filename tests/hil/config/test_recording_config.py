"""A configuration for recordings refuses unknown tables and keys; that of a whole experiment remains usable."""

from pathlib import Path

import pytest

from hil.config.recording import load_recording_config, parse_recording_config
from hil.config.schema import load_config
from hil.errors import ConfigError
from tests.support.paths import CONFIGS


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[colums]\nrate = 200.0\n", "arm.toml: colums is not a known key; did you mean columns?"),
        ("[modle]\nfriction = 'coulomb'\n", "arm.toml: modle is not a known key; did you mean model?"),
        ("[arm]\nurfd = 'a.urdf'\n", "arm.toml: arm.urfd is not a known key; did you mean urdf?"),
        ("[[joints]]\nnmae = 'a'\n", "arm.toml: joints[1].nmae is not a known key; did you mean name?"),
        ("[zzz]\n", "arm.toml: zzz is not a known key; allowed: port, joints, arm, "),
        ("[safty]\n", "arm.toml: safty is not a known key; did you mean safety?"),
    ],
)
def test_an_unknown_table_or_key_is_an_error(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_recording_config(text, Path("arm.toml"))
    assert said in str(error.value)


@pytest.mark.parametrize("name", ["first_time", "fake_open_manipulator_x"])
def test_the_file_of_an_experiment_is_accepted(name: str) -> None:
    config = load_recording_config(CONFIGS / f"{name}.toml")
    assert config.joint_names


def test_columns_in_the_file_of_an_experiment_are_checked(tmp_path: Path) -> None:
    text = (CONFIGS / "first_time.toml").read_text(encoding="utf-8") + "\n[columns]\npositoin = ['q']\n"
    (tmp_path / "arm.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"columns\.positoin is not a known key; did you mean position\?"):
        load_config(tmp_path / "arm.toml")
