"""How a chain's fit goes from one stage to the next: tempering, softening, restarts from narrower Coulomb steps."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from benchmarks import chain as bench
from hil.estimator.chain import identify
from hil.estimator.chain.fit import starts
from hil.estimator.chain.fit.objective import ChainProblem
from hil.estimator.chain.fit.options import DEFAULTS
from hil.estimator.chain.fit.stage1 import fit_lines
from hil.estimator.chain.fit.stage2 import ChainFit
from hil.estimator.chain.fit.starts import REPEATED
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.dynamics import inverse_dynamics
from hil.estimator.chain.simulation.sensitivity import Simulation
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.levenberg_marquardt import Minimum, Quadratic


@pytest.fixture(scope="module")
def setup() -> bench.Setup:
    return bench.set_up(bench.BENCHES[4], 1)


def sticking(often: int) -> SettledPeriod:
    """A period of 1 s in which each reading is repeated this many times."""
    time = (np.arange(400) // often * often) / 400.0
    position = 0.5 * np.sin(2.0 * np.pi * np.outer([1, 2, 3, 3], time) + 0.1)
    return SettledPeriod(400.0, np.cos(position), position, 0.0, np.full(4, bench.TICK))


def problem_of(setup: bench.Setup, period: SettledPeriod) -> tuple[ChainProblem, np.ndarray]:
    model = ChainModel(setup.base)
    return starts.first_problem([period], model, fit_lines([period], model, setup.prior), setup.prior, DEFAULTS)


@pytest.mark.parametrize("often", [1, 16, 50])
@pytest.mark.parametrize("off", [0.5, 3.0])
def test_the_prior_counts_as_much_more_as_the_residual_exceeds_the_noise(
    setup: bench.Setup, monkeypatch: pytest.MonkeyPatch, often: int, off: float
) -> None:
    """However often a joint that sticks repeats its readings."""
    period = sticking(often)
    problem, x = problem_of(setup, period)

    def of_data(of: ChainProblem, x: np.ndarray) -> Quadratic:  # every sample is off by as many standard deviations
        cost = sum(float(np.sum((weight[:: of.every] * off * period.noise) ** 2)) for weight in of.weights)
        return Quadratic(cost, np.eye(x.size), np.zeros(x.size))

    monkeypatch.setattr(ChainProblem, "_of_data", of_data)
    for every in (1, 2):
        tempered, at = replace(problem, every=every).tempered(x)
        assert tempered.prior_weight == pytest.approx(max(1.0, off**2))
        assert at.cost == pytest.approx(of_data(tempered, x).cost + tempered.prior_cost(x))
        assert np.any(at.normal != np.eye(x.size))  # the prior's part is in it


def test_problems_that_differ_in_weights_share_one_simulation(
    setup: bench.Setup, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the same sums of squares as without sharing; one that differs in anything else is simulated anew."""
    problem, x = problem_of(setup, sticking(1))
    x = starts.towards_prior(problem, x, DEFAULTS)
    simulated: list[Simulation] = []
    go_on = Simulation.go_on
    monkeypatch.setattr(Simulation, "go_on", lambda self, *args: simulated.append(self) or go_on(self, *args))

    def fresh(other: ChainProblem) -> ChainProblem:
        return replace(other, latest=type(other.latest)())

    first = problem.evaluate(x)
    once = len(simulated)
    lighter = replace(problem, weights=tuple(0.5 * weight for weight in problem.weights), reach=0.1, prior_weight=2.0)
    shared, positions, cost = lighter.evaluate(x), problem.positions(x), problem.cost(x)
    assert len(simulated) == once
    assert shared.cost == fresh(lighter).evaluate(x).cost
    assert cost == pytest.approx(first.cost)
    np.testing.assert_array_equal(positions, fresh(problem).positions(x))
    others: tuple[dict[str, Any], ...] = (
        {"softness": 1.0},
        {"steps": 3},
        {"finer": 4},
        {"steps": 1, "every": 2},
        {"state_scale": 1.1 * problem.state_scale},
    )
    for other in others:
        changed = replace(problem, **other)
        problem.evaluate(x)
        assert changed.cost(x) == pytest.approx(fresh(changed).cost(x), rel=1e-12), other


@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0, 400.0])
@pytest.mark.parametrize("softness", DEFAULTS.softness)
def test_the_observer_forgets_an_error_equally_fast_at_every_rate(
    setup: bench.Setup, rate: float, softness: float
) -> None:
    """At 20 Hz, gains proportional to the sampling interval made the stiffest observer's error grow."""
    period = replace(sticking(1), rate=rate)
    problem = replace(problem_of(setup, period)[0], softness=softness)
    for every in (1, 2):
        gain = replace(problem, every=every).gain(period)
        corrected = np.array([[1.0 - gain[0, 0], 0.0], [-gain[1, 0], 1.0]])
        per_sample = np.array([[1.0, every / rate], [0.0, 1.0]]) @ corrected
        kept = np.exp(-2.0 * np.pi * softness * every / rate)
        np.testing.assert_allclose(np.linalg.eigvals(per_sample), [kept, kept], atol=1e-6)


@pytest.mark.parametrize("softness", DEFAULTS.softness)
def test_a_slowly_sampled_motion_is_followed(setup: bench.Setup, softness: float) -> None:
    """At 20 Hz, without which no fit can start."""
    path = bench.path_of(bench.BENCHES[4], setup, 101)
    torque = inverse_dynamics(setup.base.chain, setup.described, path.position, path.velocity, path.acceleration)
    period = SettledPeriod(20.0, torque[:, 10::20], path.position[:, ::20], 0.0, np.full(4, bench.TICK))
    problem, x = problem_of(setup, period)
    positions = replace(problem, softness=softness).positions(starts.towards_prior(problem, x, DEFAULTS))
    assert positions is not None
    assert np.abs(positions[0] - period.position).max() < 0.5


def test_repeated_readings_count_as_a_few(setup: bench.Setup) -> None:
    counted = [float(np.sum(starts.repeated(sticking(often)) ** 2)) for often in (1, REPEATED, 16, 50)]
    np.testing.assert_allclose(counted, [1600, 1600, 1600 * REPEATED / 16, 1600 * REPEATED / 50])


def test_the_lag_starts_between_the_delay_of_stage_1_and_the_typical_lag() -> None:
    assert starts.initial_lag(4e-3, DEFAULTS) == pytest.approx(2e-3)
    assert starts.initial_lag(-1e-3, DEFAULTS) >= DEFAULTS.min_initial_lag


@dataclass(frozen=True)
class Softer:
    """A problem whose minimum has a known cost under each observer, from the data and from the prior.

    before: cost of the data elsewhere, relative to that.
    """

    costs: dict[float, tuple[float, float]]
    periods: tuple[SettledPeriod, ...]
    steps: int = 2
    softness: float = 0.0
    every: int = 1
    before: float = 1.0
    prior_weight: float = 1.0

    def cost(self, x: np.ndarray) -> float:
        data, prior = self.costs[self.softness]
        return self.before * data + self.prior_weight * prior

    def prior_cost(self, x: np.ndarray) -> float:
        return self.costs[self.softness][1]

    def tempered(self, x: np.ndarray) -> tuple["Softer", None]:
        return self, None

    def minimise(self, x: np.ndarray, ftol: float, at: None) -> Minimum:
        return Minimum(x + 1.0, Quadratic(sum(self.costs[self.softness]), np.eye(2), np.zeros(2)), 1)


@pytest.mark.parametrize(
    ("costs", "before", "kept", "fits"),
    [
        ({3.0: (1e3, 0.0), 1.5: (4e3, 0.0), 1.0: (9e3, 0.0)}, 2.0, 1.0, 3),  # as much as the softness explains
        ({3.0: (1e3, 0.0), 1.5: (4e3, 0.0), 1.0: (9e3, 0.0)}, 1.2, 1.0, 2),  # the last one need not be fitted for that
        ({3.0: (1e3, 0.0), 1.5: (4e3, 0.0), 1.0: (9e4, 0.0)}, 1.2, 1.5, 2),  # the softest observer loses the motion
        ({3.0: (1e3, 1e6), 1.5: (9e4, 0.0), 1.0: (9e5, 0.0)}, 1.2, 3.0, 1),  # so does this, whatever the prior costs
        ({3.0: (1e3, 0.0), 1.5: (1e3, 1e6), 1.0: (1e3, 1e6)}, 1.2, 1.0, 2),  # only the prior counts more
    ],
)
def test_the_softest_observer_that_follows_is_kept(
    costs: dict[float, tuple[float, float]], before: float, kept: float, fits: int
) -> None:
    problem: Any = Softer(costs, (sticking(1),), before=before)
    x, softness, spent = starts.softened(problem, np.zeros(2), DEFAULTS)
    assert softness == kept
    np.testing.assert_array_equal(x, fits)
    assert spent == 2 * (fits if kept == 1.0 else fits + 1)


def fit_of(setup: bench.Setup, period: SettledPeriod, width: float, off: float) -> ChainFit:
    """A fit with Coulomb steps of this width whose residual is this many encoder steps."""
    model = ChainModel(setup.base)
    value = np.array([width if name.startswith("coulomb_width") else 0.5 for name in model.names])
    nothing = np.zeros((value.size, value.size))
    return ChainFit(
        value,
        nothing,
        nothing[0],
        nothing,
        (np.zeros((2, 4)),),
        (period.position + off * bench.TICK,),
        outliers=0,
        correlation_time=1.0,
        iterations=1,
        softness=1.0,
        remaining=0.0,
        neglected=nothing,
    )


def restarts(
    setup: bench.Setup, monkeypatch: pytest.MonkeyPatch, *answers: tuple[float, float]
) -> tuple[list[tuple[float, float | None]], ChainFit]:
    """The widths from which `_best_fit` starts, with those of the fit it starts near, and its result.

    answers: width and residual of each fit.
    """
    period, model, tried = sticking(1), ChainModel(setup.base), []

    def fit(*given: Any) -> ChainFit:
        near: ChainFit | None = given[6] if len(given) > 6 else None
        tried.append((given[4].initial_width, None if near is None else float(near.value[-13])))
        return fit_of(setup, period, *answers[len(tried) - 1])

    monkeypatch.setattr(identify, "fit_periods", fit)
    found = identify._best_fit([period], model, fit_lines([period], model, setup.prior), setup.prior, DEFAULTS, ())
    return tried, found


def test_an_explained_motion_is_fitted_once(setup: bench.Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    tried, _ = restarts(setup, monkeypatch, (0.02, 0.29))
    assert [width for width, _ in tried] == [0.03]


def test_a_better_minimum_is_kept_and_ends_the_restarts(setup: bench.Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    tried, found = restarts(setup, monkeypatch, (0.02, 0.5), (0.004, 0.29))
    assert [width for width, _ in tried] == [0.03, 0.005]
    assert found.positions[0][0, 0] == pytest.approx(sticking(1).position[0, 0] + 0.29 * bench.TICK)


def test_a_worse_minimum_is_dropped(setup: bench.Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    tried, found = restarts(setup, monkeypatch, (0.02, 0.5), (0.004, 0.6), (0.001, 0.7))
    assert [width for width, _ in tried] == [0.03, 0.005, 0.001]
    assert found.value[-13] == 0.02


def test_a_fit_does_not_start_again_from_its_own_minimum(setup: bench.Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    """With all Coulomb steps as narrow already, the restart would be the same fit."""
    tried, _ = restarts(setup, monkeypatch, (0.004, 0.5), (0.0009, 0.45))
    assert tried == [(0.03, None), (0.001, 0.004)]


@pytest.mark.parametrize("last", [0.29, 3.0])
def test_a_fit_far_from_any_explanation_is_repeated_by_way_of_free_zeros(
    setup: bench.Setup, monkeypatch: pytest.MonkeyPatch, last: float
) -> None:
    """The restart begins with the values found beside free zeros, and is kept only if it explains more."""
    period, model, tried = sticking(1), ChainModel(setup.base), []
    freed = {name: 0.1 * number for number, name in enumerate(replace(model, zeros=True).names)}

    def fit(*given: Any) -> ChainFit:
        tried.append((given[1].zeros, given[6] if len(given) > 6 else None))
        off = (2.0, 0.3, last)[len(tried) - 1]
        names = given[1].names
        return replace(fit_of(setup, period, 0.0009, off), value=np.array([freed[name] for name in names]))

    monkeypatch.setattr(identify, "fit_periods", fit)
    no_widths = replace(DEFAULTS, other_initial_widths=(10.0,))
    found = identify._best_fit([period], model, fit_lines([period], model, setup.prior), setup.prior, no_widths, ())
    assert [zeros for zeros, _ in tried] == [False, True, False]
    np.testing.assert_array_equal(tried[2][1].value, [freed[name] for name in model.names])
    off = min(last, 2.0)
    assert found.positions[0][0, 0] == pytest.approx(period.position[0, 0] + off * bench.TICK)


def test_a_restart_keeps_all_but_wide_coulomb_steps(setup: bench.Setup) -> None:
    problem, _ = problem_of(setup, sticking(1))
    names = problem.coordinates.names
    for width, expected in ((0.02, 0.005), (0.002, 0.002)):
        near = fit_of(setup, sticking(1), width, 0.5)
        x = starts.narrowed(problem, near.value, near.starts, replace(DEFAULTS, initial_width=0.005))
        wanted = [expected if name.startswith("coulomb_width") else 0.5 for name in names]
        np.testing.assert_allclose(problem.coordinates.values(x[: problem.count]), wanted)


@pytest.mark.parametrize(
    ("first", "second", "chosen"),
    [
        (1.0, 0.5, "first"),  # explained: no second start
        (5.0, 1.0, "second"),
        (5.0, 6.0, "first"),
    ],
)
def test_a_motion_that_is_not_explained_is_fitted_from_the_prior_too(
    setup: bench.Setup, monkeypatch: pytest.MonkeyPatch, first: float, second: float, chosen: str
) -> None:
    problem, x = problem_of(setup, sticking(1))
    level = {0.0: first, 1.0: second}
    found = [Minimum(np.full(2, at), Quadratic(1.0, np.eye(2), np.zeros(2)), 1) for at in level]
    monkeypatch.setattr(starts, "towards_prior", lambda _, x, options: x)
    monkeypatch.setattr(starts, "softened", lambda *_: (x, 1.0, 1))
    monkeypatch.setattr(starts, "resolved", lambda problem, *_: (problem, found[0], 1))
    monkeypatch.setattr(starts, "_softened_later", lambda *_: (replace(problem, softness=1.0), found[1], 10))
    monkeypatch.setattr(starts, "_level", lambda _, x: level[float(x[0])])
    _, minimum, spent = starts.started(problem, x, DEFAULTS)
    assert minimum is found[chosen == "second"]
    assert spent == (2 if first <= DEFAULTS.poor else 12)
