"""Arguments of the wrong type are TypeErrors that name the argument."""

from typing import Any

import pytest

import hil


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"config": 5}, "config must be a path, not 5"),
        ({"out": 5}, "out must be a path, not 5"),
        ({"all_samples": "yes"}, "all_samples must be True or False, not 'yes'"),
    ],
)
def test_a_wrong_argument_of_estimate_is_named(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(TypeError, match=said):
        hil.estimate("arm.csv", **arguments)


def test_a_model_is_read_from_a_path() -> None:
    with pytest.raises(TypeError, match="path must be a run folder or a file, not 123"):
        hil.load_model(123)  # type: ignore[arg-type]
