"""Reversed columns are found and named; a recording with correct signs raises no suspicion."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.config.recording import load_recording_config
from hil.errors import CsvError
from hil.estimation.unsettled.slips import refuse_slips
from hil.estimator.baselines import signs
from hil.estimator.baselines.signs import Signs, suspect_signs
from hil.estimator.baselines.torque_faults import suspect_uneven
from hil.estimator.baselines.zero import turned_zeros
from hil.estimator.data.recording import Recording
from hil.recordings.convert import convert
from hil.recordings.csv_file import read_csv_table
from tests.support.paths import CONFIGS, DATA
from tests.support.recorded_motion import two_joints


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Both joints driven, four and ten rad/s."""
    columns = load_recording_config(CONFIGS / "recordings" / "dfki_double_pendulum.toml").columns
    return convert(read_csv_table(DATA / "dfki_double_pendulum" / "c1_sinusoids_143601.csv"), columns).recordings[0]


def turned(recording: Recording, torque: tuple[int, int], position: tuple[int, int]) -> Recording:
    return replace(
        recording,
        torque=recording.torque * np.array(torque)[:, None],
        position=recording.position * np.array(position)[:, None],
    )


def test_right_signs_raise_no_suspicion(recording: Recording) -> None:
    assert suspect_signs([recording]) is None
    assert suspect_signs([turned(recording, (-1, -1), (-1, -1))]) is None, (
        "a mirrored arm is equivalent, so there is no evidence"
    )


@pytest.mark.parametrize(
    ("torque", "position"),
    [((1, -1), (1, 1)), ((-1, 1), (1, 1)), ((-1, -1), (1, 1)), ((1, 1), (1, -1)), ((1, 1), (-1, 1))],
)
def test_a_reversed_column_is_named(recording: Recording, torque: tuple[int, int], position: tuple[int, int]) -> None:
    suspicion = suspect_signs([turned(recording, torque, position)])
    assert suspicion is not None
    assert suspicion.signs == Signs(torque, position)
    assert suspicion.residual <= suspicion.residual_given


def test_all_torques_reversed_shows_in_negative_inertia(recording: Recording) -> None:
    suspicion = suspect_signs([turned(recording, (-1, -1), (1, 1))])
    assert suspicion is not None
    assert any(name.startswith("inertia") for name in suspicion.impossible)


def test_the_words() -> None:
    assert Signs((1, -1), (1, -1)).reversed_columns == ("the torque of joint 2", "the position of joint 2")
    assert Signs((1, -1), (1, 1)).said() == "the sign of the torque of joint 2"
    assert Signs((-1, -1), (1, 1)).said() == "the signs of both torques"
    assert Signs((1, -1), (1, -1)).said() == "the signs of the torque of joint 2 and the position of joint 2"
    assert Signs((1, -1, -1), (1, 1, 1)).said() == "the signs of the torques of joints 2 and 3"
    assert Signs((1, -1, -1), (1, 1, 1)).said(("a", "b", "c")) == "the signs of the torques of b and c"
    assert Signs((-1, -1, -1), (1, 1, 1)).said() == "the signs of all torques"


def test_too_short_a_recording_says_nothing(recording: Recording) -> None:
    short = replace(
        recording,
        time=recording.time[:60],
        torque=recording.torque[:, :60],
        position=recording.position[:, :60],
    )
    assert suspect_signs([short]) is None


def test_swapped_position_columns_are_named() -> None:
    motion = two_joints(8.0)
    given = Recording(motion.time, motion.torque, motion.position, np.full(2, 2 * np.pi / 4096), "held")
    refuse_slips([given], "arm.csv")
    with pytest.raises(CsvError, match="the position columns of joints 1 and 2 seem to be swapped"):
        refuse_slips([replace(given, position=given.position[::-1].copy())], "arm.csv")


@pytest.mark.parametrize(("given", "left", "offered"), [(0.81, 0.83, False), (0.2, 0.2, True)])
def test_a_reversed_sign_that_explains_hardly_anything_is_not_offered(
    monkeypatch: pytest.MonkeyPatch, recording: Recording, given: float, left: float, offered: bool
) -> None:
    def fitted(_: object, tried: Signs) -> Any:
        value, residual = (1.0, left) if tried.reversed_columns else (-1.0, given)
        return SimpleNamespace(
            relative_residual=np.array([residual]), value=np.array([value]), std=np.array([0.1]), names=("inertia_1",)
        )

    monkeypatch.setattr(signs, "_fit", fitted)
    assert (suspect_signs([recording]) is not None) is offered


@pytest.mark.parametrize(("joint", "late", "early"), [(1, 2, 1), (0, 1, 2)])
def test_a_joint_that_is_logged_later_than_the_other_is_named(joint: int, late: int, early: int) -> None:
    motion = two_joints(10.0)
    good = Recording(motion.time, motion.torque, motion.position, np.full(2, 0.0015), "held")
    assert suspect_uneven([good]) is None
    shifted = good.position.copy()
    shifted[joint, 3:] = good.position[joint, :-3]
    found = suspect_uneven([replace(good, position=shifted)])
    assert found is not None
    assert (found.late, found.early) == (late, early)
    assert found.by == pytest.approx(0.015, abs=0.0051)


def test_quarter_turns_are_preferred_to_an_angle_that_explains_hardly_more() -> None:
    """Joint 2 of an excellent recording was turned by 0.56 rad for 1 % of the residual, and its fit failed."""
    motion = two_joints(8.0)
    torque = motion.torque + 0.3 * np.random.default_rng(1).standard_normal(motion.torque.shape)
    hanging = motion.position + np.array([[np.pi / 2], [0.0]])
    zeros = turned_zeros([Recording(motion.time, torque, hanging, np.full(2, 1.5e-3), between="held")])
    np.testing.assert_allclose(zeros, [-np.pi / 2, 0.0], atol=1e-12)


@pytest.mark.parametrize("turned", [(0.0, 0.0), (np.pi, 0.0), (0.0, np.pi), (np.pi, np.pi)])
def test_an_origin_that_is_half_a_turn_off_is_found_from_the_sign_of_gravity(turned: tuple[float, float]) -> None:
    """The residual does not reveal this, because the weights may be negative."""
    motion = two_joints(8.0)
    position = motion.position + np.array(turned)[:, None]
    zeros = turned_zeros([Recording(motion.time, motion.torque, position, np.full(2, 1.5e-3), between="held")])
    if turned == (0.0, 0.0):
        assert zeros is None
        return
    assert zeros is not None
    np.testing.assert_allclose(np.cos(zeros + turned), 1.0, atol=1e-12)


def test_the_zero_of_a_reversed_angle_changes_its_sign(recording: Recording) -> None:
    with pytest.raises(CsvError, match=r"the position of joint 1 is reversed.* zero = \[-0\.3000, 0\.2000\]\.$"):
        refuse_slips([turned(recording, (1, 1), (-1, 1))], "arm.csv", (0.3, 0.2))
    with pytest.raises(CsvError, match=r"the signs of both torques are reversed.* Correct this in the file\.$"):
        refuse_slips([turned(recording, (-1, -1), (1, 1))], "arm.csv", (0.3, 0.2))
    half = turned(recording, (1, 1), (-1, 1))
    half = replace(half, position=half.position + np.array([[np.pi], [0.0]]))
    with pytest.raises(CsvError, match=r"zero = \[2\.8416, 0\.2000\]\.$"):
        refuse_slips([half], "arm.csv", (0.3, 0.2))
    with pytest.raises(CsvError, match=r"the position of joint 1 is reversed.* Correct this in the file\.$"):
        refuse_slips([turned(recording, (1, 1), (-1, 1))], "arm.csv", (0.3, 0.2), zero_is_set=False)


def test_joints_in_the_wrong_order_have_their_zeros_in_the_wrong_order() -> None:
    motion = two_joints(8.0)
    order = slice(None, None, -1)
    exchanged = Recording(motion.time, motion.torque[order], motion.position[order], np.full(2, 1.5e-3), "held")
    with pytest.raises(CsvError, match=r"ARM\.toml, and exchange the two values of zero as well\.$"):
        refuse_slips([exchanged], "arm.csv", (0.0, 0.0))
    with pytest.raises(CsvError, match=r"of --config ARM\.toml\.$"):
        refuse_slips([exchanged], "arm.csv")


@pytest.fixture(scope="module")
def unzeroed() -> Recording:
    """Angles with zeros that nobody knows."""
    motion = two_joints(12.0)
    position = motion.position + np.array([[0.9], [-1.1]])
    return Recording(motion.time, motion.torque, position, np.full(2, 1.5e-3), "held")


@pytest.mark.parametrize("joint", [0, 1])
def test_an_angle_and_its_torque_reversed_are_named_together_if_the_zeros_are_unknown(
    unzeroed: Recording, joint: int
) -> None:
    """Only the torque was named, since without the zeros nothing explained the motion."""
    refuse_slips([unzeroed], "arm.csv", zero_is_set=False)
    sign = (-1, 1) if joint == 0 else (1, -1)
    said = "the signs of the torque of joint 2 and the position of joint 2 are reversed"
    with pytest.raises(CsvError, match=said):
        refuse_slips([turned(unzeroed, sign, sign)], "arm.csv", zero_is_set=False)
    refuse_slips([turned(turned(unzeroed, sign, sign), (1, -1), (1, -1))], "arm.csv", zero_is_set=False)


def test_exchanged_angles_with_unknown_zeros_are_named(unzeroed: Recording) -> None:
    with pytest.raises(CsvError, match="the position columns of joints 1 and 2 seem to be swapped"):
        refuse_slips([replace(unzeroed, position=unzeroed.position[::-1].copy())], "arm.csv", zero_is_set=False)


def test_the_zero_of_joint_2_is_found_even_if_that_of_joint_1_is_right(unzeroed: Recording) -> None:
    zeros = turned_zeros([replace(unzeroed, position=unzeroed.position + np.array([[-0.9], [0.0]]))])
    assert zeros is not None
    np.testing.assert_allclose(zeros, [0.0, 1.1], atol=0.1)


@pytest.mark.parametrize(("stated", "true"), [("deg", "rad"), ("rad", "turns"), ("turns", "rad")])
def test_angles_in_another_unit_are_named(stated: str, true: str) -> None:
    motion, zero = two_joints(12.0), np.array([[0.4], [-0.3]])
    factor = signs.ANGLE_UNITS[stated] / signs.ANGLE_UNITS[true]
    given = Recording(motion.time, motion.torque, factor * (motion.position - zero) + zero, np.full(2, 1e-4), "held")
    with pytest.raises(CsvError, match=f'as if {true} had been read as {stated}.*position_unit = "{true}"'):
        refuse_slips([given], "arm.csv", (0.4, -0.3))
