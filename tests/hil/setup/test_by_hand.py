"""The arm moved by hand, compared with its description."""

import json
from collections.abc import Iterator

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.config.chain import base_up, described_arm
from hil.config.schema import load_config
from hil.description.motion import _towards, end_point, moves
from hil.setup.by_hand import MOVED, Moved, guided, judge, pose_of
from tests.support.paths import CONFIGS

ARM = load_config(CONFIGS / "fake_viperx_300.toml")


class VirtualClock:
    """Time advances when the program waits."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def wait_until(self, deadline: float) -> None:
        self.time = max(self.time, deadline)


def change(**by: float) -> np.ndarray:
    return np.array([by.get(joint.name, 0.0) for joint in ARM.joints])


@pytest.mark.parametrize(
    ("moved", "well", "words"),
    [
        (change(elbow=0.4), True, "'elbow' moved by +0.40 rad, as described"),
        (change(elbow=-0.4), False, "set direction = -1"),
        (change(shoulder=0.4), False, "'shoulder' (ID 2) moved by +0.40 rad instead: swap the ids"),
        (change(elbow=0.02), False, "'elbow' did not move: is 3 the ID of its servo?"),
        (change(elbow=0.4, wrist_angle=0.3), True, "wrist_angle moved with it"),
    ],
)
def test_what_a_hand_moved_is_judged(moved: np.ndarray, well: bool, words: str) -> None:
    found = judge(ARM, 2, "", moved, moved[2:3])
    assert found.well is well
    assert words in found.found


@pytest.mark.parametrize(
    ("first", "second", "directions", "words"),
    [
        (0.4, 0.39, [1, -1], "as described, and so did its second servo"),
        (0.4, -0.4, [1, 1], "work against each other: set direction = [1, -1]"),
        (-0.4, 0.4, [1, 1], "set direction = [-1, 1] and determine zero_ticks again"),
        (-0.4, -0.4, [1, -1], "set direction = [-1, 1] and determine zero_ticks again"),
        (0.4, 0.0, [1, -1], "Is ID 9 on this joint"),
    ],
)
def test_two_servos_of_a_joint_are_compared(first: float, second: float, directions: list[int], words: str) -> None:
    elbow = ARM.joints[2].model_copy(update={"servos": [3, 9], "turns": directions})
    arm = ARM.model_copy(update={"joints": [*ARM.joints[:2], elbow, *ARM.joints[3:]]})
    found = judge(arm, 2, "", change(elbow=first), np.array([first, second]))
    assert found.well is words.startswith("as described")
    assert words in found.found


def test_words_are_those_of_the_motion() -> None:
    arm, angles = described_arm(ARM), np.array([0.1, -0.5, 0.6, 0.0, 0.4, 0.0])
    for joint in range(5):
        step = np.zeros(6)
        step[joint] = 1e-4
        way = end_point(arm, angles + step) - end_point(arm, angles)
        told = moves(arm, angles, joint)
        if "about its own axis" not in told:
            main = int(np.argmax(np.abs(way)))
            assert f"({'+' if way[main] > 0 else '-'}{'xyz'[main]})" in told


@pytest.mark.parametrize(
    ("base", "told"),
    [
        ((0.0, 0.0, 0.0), ("up (+z)", "down (-z)", "forwards (+x)", "to the left (+y)")),
        ((0.2, -0.3, 1.0), ("up (+z)", "down (-z)", "forwards (+x)", "to the left (+y)")),
        ((np.pi, 0.0, 0.0), ("down (+z)", "up (-z)", "forwards (+x)", "to the right (+y)")),  # from the ceiling
        ((0.0, np.pi / 2, 0.0), ("forwards (+z)", "backwards (-z)", "down (+x)", "to the left (+y)")),  # on a wall
        ((np.pi / 2, 0.0, 0.0), ("to the right (+z)", "to the left (-z)", "forwards (+x)", "up (+y)")),  # on its side
    ],
)
def test_up_is_opposite_to_gravity_however_the_base_is_mounted(
    base: tuple[float, float, float], told: tuple[str, ...]
) -> None:
    up = base_up(ARM.model_copy(update={"arm": ARM.arm.model_copy(update={"base": list(base)})}))
    ways = np.array([[0.1, 0, 1], [0, 0.1, -1], [1, 0.1, 0], [0, 1, 0.1]])
    assert tuple(_towards(way, up) for way in ways) == told


def test_every_joint_is_asked_for_and_waited_for() -> None:
    """Each joint is moved within 0.5 s of the request and then held; the fourth is moved in the wrong direction."""
    clock, asked = VirtualClock(), list[tuple[float, str]]()

    def read() -> tuple[float, ...]:
        angles = np.zeros(6)
        for index, (since, _) in enumerate(asked):
            angles[index] = (-1 if index == 3 else 1) * 0.3 * min(1.0, (clock.now() - since) / 0.5)
        return tuple(angles.tolist())

    found = list(guided(ARM, read, clock, lambda text: asked.append((clock.now(), text)), lambda _: (0.0,)))
    assert [each.well for each in found] == [True, True, True, False, True, True]
    assert all(abs(each.angles[index]) > 0.99 * 0.3 > MOVED for index, each in enumerate(found))
    assert all(joint.name in text for joint, (_, text) in zip(ARM.joints, asked, strict=True))
    assert clock.now() < 12.0


def test_patience_ends() -> None:
    clock = VirtualClock()
    moves_: Iterator[Moved] = guided(ARM, lambda: (0.0,) * 6, clock, lambda _: None, lambda _: (0.0,))
    assert "did not move" in next(moves_).found
    assert clock.now() < 61.0


@pytest.mark.parametrize("name", ["wx250s", "leg"])
def test_without_a_hand_each_joint_of_the_fake_arm_is_asked_for(name: str) -> None:
    """Some joints of the WidowX have two servos."""
    path = CONFIGS / f"{name}.toml"
    shown = CliRunner().invoke(app, ["pose", str(path), "--guide", "--json"])
    assert shown.exit_code == 1 and isinstance(shown.exception, SystemExit), shown.exception
    moved = json.loads(shown.stdout)["moved"]
    assert len(moved) == len(load_config(path).joints) and all("did not move" in each["found"] for each in moved)


def test_the_pose_of_the_fake_arm_is_its_rest_pose() -> None:
    shown = CliRunner().invoke(app, ["pose", str(ARM.path), "--json"])
    assert shown.exit_code == 0, shown.output
    angles = json.loads(shown.stdout)["angles"]
    np.testing.assert_allclose(list(angles.values()), ARM.arm.rest_pose, atol=0.02)
    table = CliRunner().invoke(app, ["pose", str(ARM.path)], env={"COLUMNS": "200"})
    assert "moves the end" in table.output


def test_whole_turns_are_taken_off() -> None:
    rest = np.array(ARM.arm.rest_pose)
    turned = rest + 2 * np.pi * np.array([0, -2, 1, 0, 2, -1])
    np.testing.assert_allclose(pose_of(ARM, tuple(turned)).angles, rest, atol=1e-9)


def test_an_arm_without_description_has_none_to_compare() -> None:
    shown = CliRunner().invoke(app, ["pose", str(CONFIGS / "fake_two_link.toml")])
    assert "arm.urdf is missing" in str(shown.exception)
