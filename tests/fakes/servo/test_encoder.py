"""Errors of Present Position: noise and periodic errors; motor or supply current in Present Current."""

import math
import statistics
from collections.abc import Callable
from typing import Any

import pytest
from pydantic import ValidationError

from hil.fakes.description import FakeServo
from hil.fakes.servo.encoder import Encoder, Reading
from hil.fakes.servo.registers import load_model

Make = Callable[..., Any]


def read(bench: Any, angle: float) -> int:
    bench.plant.position[0] = angle
    return int(bench.read(1, 132, 4))


def test_an_eccentric_magnet_errs_once_a_turn(make_bench: Make) -> None:
    bench = make_bench({"encoder": Encoder(once_ticks=40.0, once_phase=0.5), "zero_ticks": 1024})
    for ticks in (1024, 1500, 3000):
        angle = (ticks - 1024) / 4096 * math.tau
        expected = ticks + 40.0 * math.sin(math.tau * ticks / 4096 + 0.5)
        assert read(bench, angle) == pytest.approx(expected, abs=0.51)


def test_a_tilted_magnet_errs_twice_a_turn_and_the_same_in_every_turn(make_bench: Make) -> None:
    bench = make_bench({"encoder": Encoder(twice_ticks=30.0, twice_phase=-0.3), "zero_ticks": 2048})
    errors = [read(bench, angle) - 2048 - angle / math.tau * 4096 for angle in (0.4, 0.4 + math.pi, 0.4 + math.tau)]
    assert errors == pytest.approx([30.0 * math.sin(0.5)] * 3, abs=0.51)


def test_noise_is_white_and_of_the_described_size(make_bench: Make) -> None:
    bench = make_bench({"encoder": Encoder(noise_ticks=3.0)})
    samples = [read(bench, 1.0) for _ in range(2000)]
    assert statistics.stdev(samples) == pytest.approx(3.0, rel=0.1)
    neighbours = [a * b for a, b in zip(_centred(samples), _centred(samples)[1:], strict=False)]
    assert abs(statistics.mean(neighbours)) < 0.1 * 9.0


def _centred(samples: list[int]) -> list[float]:
    mean = statistics.mean(samples)
    return [sample - mean for sample in samples]


def test_the_same_seed_gives_the_same_noise() -> None:
    first, second, other = (Reading(Encoder(noise_ticks=1.0), seed) for seed in ("1", "1", "2"))
    ours = [first.sample(0.0) for _ in range(5)]
    assert ours == [second.sample(0.0) for _ in range(5)]
    assert ours != [other.sample(0.0) for _ in range(5)]


def test_position_control_goes_where_the_encoder_says(make_bench: Make) -> None:
    wrong, right = (
        make_bench({"encoder": encoder}) for encoder in (Encoder(once_ticks=50.0, once_phase=1.5), Encoder())
    )
    assert wrong.servo().present.ticks(0.0) == pytest.approx(right.servo().present.ticks(0.0) + 50.0 * math.sin(1.5))


@pytest.mark.parametrize(("senses_supply", "share"), [(None, 1.0), (False, 1.0), (True, 0.5)])
def test_a_sensor_in_the_supply_sees_the_motor_s_current_while_the_bridge_is_on(
    make_bench: Make, senses_supply: bool | None, share: float
) -> None:
    model = load_model("XM430-W350")
    volt = model.resistance_ohm * 1.0 / 0.5
    bench = make_bench(
        {"senses_supply": senses_supply, "input_voltage_v": volt, "registers": {"Min Voltage Limit": 95}}
    )
    bench.arm(goal_ticks=round(1.0 / model.current_unit_a))
    bench.plant.current[0] = 1.0
    bench.plant.velocity[0] = 0.0
    measured = int.from_bytes(bench.servo().present.state(0.0, 0.0, 1.0)[:2], "little", signed=True)
    assert measured * model.current_unit_a == pytest.approx(share, abs=0.02)


def test_a_description_says_what_is_allowed() -> None:
    servo = FakeServo.model_validate(
        {"id": 1, "model": "XM430-W350", "zero_ticks": 0, "encoder": {"noise_ticks": 0.5, "twice_ticks": 2.0}}
    )
    assert servo.encoder.noise_ticks == 0.5
    with pytest.raises(ValidationError, match="noise_ticks"):
        FakeServo.model_validate({"id": 1, "model": "XM430-W350", "zero_ticks": 0, "encoder": {"noise_ticks": -1.0}})
