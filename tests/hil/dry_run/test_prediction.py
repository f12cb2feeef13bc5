"""Dry runs: their predictions, the torque they allow, and the command."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.api.dry_run import dry_run
from hil.config.schema import Config, load_config, parse_config
from hil.dry_run import amplitude, chain_prediction
from hil.dry_run.amplitude import Amplitude, AmplitudeOptions, largest_amplitude
from hil.dry_run.ensemble import Ensemble, earlier_result, prior_ensemble
from hil.dry_run.prediction import GUARDED, Prediction, predict, quantities_of
from hil.errors import ConfigError, NoSafeTorque, ResultError
from hil.plan.plan import Plan, make_plan
from tests.support.command_line import hil
from tests.support.dry_runs import is_within, prior_study, run_on
from tests.support.edits import replaced
from tests.support.elsewhere import Elsewhere
from tests.support.paths import CONFIGS

Arm = Callable[..., Config]
KNOWN = ("[arm]\n", "[arm]\nlink_lengths = [0.147, 0.180]\n")


@pytest.fixture
def known(arm: Arm) -> Config:
    return arm(KNOWN, ("seed = 1\n", "seed = 1\nheld_out = false\n"))


def test_the_same_prior_gives_the_same_prediction_and_more_torque_larger_peaks(known: Config) -> None:
    ensemble = prior_ensemble(known, 24)
    plan = make_plan(known)
    first, again = predict(known, plan, ensemble), predict(known, plan, ensemble)
    assert (first.values == again.values).all()
    experiment = known.experiment.model_copy(update={"peak_torque": [0.4, 0.21]})
    less = predict(known, make_plan(known.model_copy(update={"experiment": experiment})), ensemble)
    assert (less.median[2] < first.median[2]).all()
    assert (first.quantile[1:] >= first.median[1:] - 1e-9).all() and (first.quantile[0] <= first.median[0]).all()


def test_an_executor_gives_the_same_prediction(known: Config) -> None:
    ensemble, plan, elsewhere = prior_ensemble(known, 40), make_plan(known), Elsewhere()
    here, there = predict(known, plan, ensemble), predict(known, plan, ensemble, executor=elsewhere)
    assert elsewhere.submitted == 3
    assert (here.values == there.values).all() and (here.settled_after == there.settled_after).all()
    found, again = largest_amplitude(known, ensemble), largest_amplitude(known, ensemble, executor=elsewhere)
    assert (found.peak_torque == again.peak_torque).all()


def test_too_much_torque_is_refused_by_the_worst_arms_alone(known: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once a check on all arms has failed, each smaller torque is first tried on the arms that were the worst."""
    simulated: list[int] = []

    def never_safe(
        config: Config, plan: Plan, ensemble: Ensemble, *, briefly: bool = False, **given: Any
    ) -> Prediction:
        if not briefly:
            simulated.append(ensemble.size)
        prediction = predict(config, plan, ensemble, briefly=briefly, **given)
        return replace(prediction, shares=np.maximum(prediction.shares, 0.0 if briefly else 1.0))

    monkeypatch.setattr(amplitude, "predict", never_safe)
    options = AmplitudeOptions(max_rounds=5)
    with pytest.raises(NoSafeTorque, match=r"24 of 24 simulated arms exceed .* of the distance to the lower position_"):
        largest_amplitude(known, prior_ensemble(known, 24), options=options)
    assert simulated == [24, *4 * [options.worst_arms], 24], "the last one is for the message"


def test_a_refusal_names_joint_limit_and_a_stabiliser_that_is_given() -> None:
    """An upright arm whose stabiliser is too soft for the heaviest of the arms falls at any torque."""
    upright = replaced(
        (CONFIGS / "fake_inverted.toml").read_text(),
        KNOWN,
        ("stiffness = [2.5, 1.2] ", "stiffness = [0.1, 0.1]"),
        ("seed = 1\n", "seed = 1\npilot = true\nheld_out = false\n"),
    )
    config = parse_config(upright, CONFIGS / "fake_inverted.toml")
    with pytest.raises(NoSafeTorque) as refused:
        largest_amplitude(config, prior_ensemble(config, 8), options=AmplitudeOptions(max_rounds=2))
    assert re.search(r"of 8 simulated arms exceed .* position_limit of joint '\w+'", str(refused.value))
    assert "omit [stabiliser] so that the pilot proposes one" in str(refused.value)


def test_the_largest_amplitude_keeps_every_simulated_arm_within_its_limits(known: Config) -> None:
    found = largest_amplitude(known, prior_ensemble(known, 48))
    assert found.prediction.stop_chance <= known.safety.limit_chance
    assert (found.prediction.shares[:, :GUARDED] < 1.0).all()
    assert found.prediction.shares[:, :GUARDED].max() > 0.6, "and not for lack of trying"


def test_a_horizontal_arm_is_foreseen_to_wander_and_a_stabiliser_to_hold_it(arm_file: Callable[..., Path]) -> None:
    path = arm_file()  # overwritten by the horizontal arm
    text = (CONFIGS / "fake_horizontal.toml").read_text(encoding="utf-8")
    text = replaced(
        text,
        ("rate = 400.0 ", "rate = 200.0 "),
        ("period = 10.0 ", "held_out = false\nperiod = 4.0 "),
        ("[0.30, 0.18]", "[0.15, 0.09]"),
    )
    before, _, held = text.partition("[stabiliser]")
    widths = {}
    for name, each in (("free", before + "[model]" + held.partition("[model]")[2]), ("held", text)):
        path.write_text(each, encoding="utf-8")
        config = load_config(path)
        plan, ensemble = make_plan(config), prior_ensemble(config, 24)
        assert all(physics.vector[[4, 5]].tolist() == [0.0, 0.0] for physics in ensemble.physics), "nothing weighs"
        foreseen = predict(config, plan, ensemble)
        widths[name] = foreseen.quantile[1] - foreseen.quantile[0]
        seen = run_on(config, Amplitude(plan, plan.segments[0].peak_torque, foreseen), path.parent / name)
        assert seen is not None and is_within(config, seen, foreseen.quantile), name
    assert (widths["held"] < 0.8 * widths["free"]).all()


def test_seen_peaks_stay_within_the_predicted_ones() -> None:
    study = prior_study(8)
    assert study["within_quantile"] >= 11 / 12 and study["limit_touched"] == 0


def test_without_link_lengths_there_is_no_prior(arm: Arm) -> None:
    with pytest.raises(ConfigError, match=r"set arm\.link_lengths"):
        prior_ensemble(arm(), 4)


def test_pilot_needs_link_lengths_and_peak_torque_may_be_left_out(arm_file: Callable[..., Path]) -> None:
    with pytest.raises(ConfigError, match=r"pilot = true needs arm\.link_lengths"):
        load_config(arm_file(("seed = 1\n", "seed = 1\npilot = true\n")))
    text = arm_file(KNOWN).read_text(encoding="utf-8").replace("peak_torque", "# peak_torque")
    config = parse_config(text, Path("arm.toml"))
    assert config.experiment.peak_torque is None
    with pytest.raises(ConfigError, match="peak_torque is missing"):
        make_plan(config)


@pytest.mark.usefixtures("few_stops")
@pytest.mark.parametrize(("peak", "code"), [("[0.20, 0.10]", 0), ("[1.60, 1.20]", 1)])
def test_the_verdict_is_the_exit_code(
    arm_file: Callable[..., Path], capsys: pytest.CaptureFixture[str], peak: str, code: int
) -> None:
    path = arm_file(KNOWN, ("[0.80, 0.42]", peak), ("seed = 1\n", "seed = 1\nheld_out = false\n"))
    assert hil("dry-run", path, "--arms", "20", "--json") == code
    said: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert said["safe"] is (code == 0) and said["arms"] == 20
    elbow = said["asked"]["joints"]["elbow"]
    assert set(elbow) == {"lowest position", "highest position", "velocity", "current", "torque", "power"}
    assert elbow["velocity"]["limit"] == 20.0 and elbow["velocity"]["unit"] == "rad/s"


def test_the_earlier_run_must_fit_the_arm(identified: Path, tmp_path: Path) -> None:
    text = (CONFIGS / "fake_pendulum.toml").read_text(encoding="utf-8")
    for pendulum in (
        text,
        replaced(text, ("peak_torque = [0.35]", "pilot = true"), ("[arm]\n", "[arm]\nlink_lengths = [0.1]\n")),
    ):
        with pytest.raises(ConfigError, match=r"describes 1 joint; the earlier run .* identified 2\. Name a run of"):
            dry_run(parse_config(pendulum, CONFIGS / "fake_pendulum.toml"), result=identified, arms=20)
    config = load_config(CONFIGS / "fake_two_link.toml")
    said = json.loads((identified / "result.json").read_text(encoding="utf-8"))
    eye = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    chain = {"urdf": "a", "rotation": [eye] * 2, "translation": eye[:2], "axis": eye[:2], "gravity": eye[0]}
    for change, words in (
        ({"chain": chain}, "describes a planar arm; .* spatial"),
        ({"parameters": {**said["parameters"], "inertia_1": {"value": None, "std": 0.1, "unit": "kg m^2"}}}, "finite"),
    ):
        path = tmp_path / "changed.json"
        path.write_text(json.dumps({**said, **change}), encoding="utf-8")
        with pytest.raises(ConfigError if "chain" in change else ResultError, match=words):
            earlier_result(config, path)


def test_every_joint_is_shown_with_the_unit_of_its_own_goal() -> None:
    config = load_config(CONFIGS / "koch.toml")
    units = {joint.name: quantities_of(joint)[3] for joint in config.joints}
    assert units["wrist_roll"] == ("current", "A") and units["shoulder_pan"] == ("voltage", "V")


@pytest.mark.usefixtures("few_stops")
def test_a_table_for_a_person_with_what_the_servos_say(
    arm_file: Callable[..., Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    path = arm_file(KNOWN, ("[0.80, 0.42]", "[0.20, 0.10]"), ("seed = 1\n", "seed = 1\nheld_out = false\n"))
    assert hil("dry-run", path, "--arms", "20", "--servos") == 0
    said = capsys.readouterr().out
    for part in (
        "SAFE",
        "Largest safe torque",
        "own current limit 3.21 A",
        "At 400 cycles per second with torque off",
        "settle",
    ):
        assert part in said, part


def test_bounds_of_a_path_enclose_its_peaks_wherever_its_centre_is() -> None:
    """Distances to the limits and the bounds made of them start at the same values."""
    rest, centre = np.array([0.0, -0.5]), np.array([0.9, 0.2])
    limits = np.array([[-2.0, -1.0], [2.0, 1.5], [3.0, 3.0]])
    values = np.array([[0.0, -0.6], [1.2, 0.7], [1.0, 1.5]]) * (1.0 + 1e-3 * np.arange(5)[:, None, None])
    found = Prediction(
        values,
        chain_prediction._shares(values, limits, rest, centre),
        limits,
        np.ones(5, int),
        np.empty(0),
        rest,
        100.0,
        centre,
    )
    np.testing.assert_allclose(found.quantile, found.median, atol=0.05)
