"""A spatial arm from its TOML file to result, model and exports, on the fake bus."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

import hil
from hil.chain_model import ChainArmModel
from hil.cli.views.result_table import print_result, what_next
from hil.config.chain import described_arm
from hil.config.schema import Config, load_config, parse_config
from hil.description.urdf import read_urdf
from hil.errors import ConfigError, ExportError
from hil.estimation import chain_estimate
from hil.estimation.calibrate import AddedMass, CalibrationFit, CalibrationResult, calibrate_runs, calibration_lines
from hil.estimation.chain_estimate import _verdict, stopped_short, unmoved
from hil.estimation.changes.diff import diff_runs
from hil.estimation.comparison import chain_compare
from hil.estimation.comparison.compare import compare_run
from hil.estimation.settled_estimate import estimate_run
from hil.estimation.settled_period import settled_period
from hil.estimation.slips.sticking import sticking_joints
from hil.estimation.unsettled.estimate import estimate_unsettled
from hil.estimator.chain.conflicts import chain_conflicts
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.dynamics import inverse_dynamics
from hil.estimator.chain.model.geometry import Chain, parameter_names
from hil.estimator.chain.mount import better_gravity
from hil.experiment.run import run_experiment
from hil.export.formats import Written, export
from hil.export.mjcf import export_mjcf
from hil.export.posterior import draw_arms
from hil.export.source import Source
from hil.plan.chain_model import KnownChain, known_chain
from hil.plan.chain_plan import make_chain_plan
from hil.plan.plan import IDENTIFY
from hil.results.parts import Quantity
from hil.results.result import SettledResult, result_from_json
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

FOUR = CONFIGS / "fake_open_manipulator_x.toml"
TEXT = FOUR.read_text(encoding="utf-8")


def short(folder: Path) -> Config:
    """The configuration at a quarter of its rate, next to its URDF. Half the period leaves moment_z_2 uncertain."""
    (folder / "open_manipulator_x_like.urdf").write_bytes((CONFIGS / "open_manipulator_x_like.urdf").read_bytes())
    text = replaced(TEXT, ("rate = 400.0", "rate = 100.0"))
    (folder / "arm.toml").write_text(text, encoding="utf-8")
    return load_config(folder / "arm.toml")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    config = short(tmp_path_factory.mktemp("config"))
    run = RunFolder.create(tmp_path_factory.mktemp("runs") / "run", config)
    run_experiment(config, run, config.path, lambda _: None)
    return run


@pytest.fixture(scope="module")
def result(run: RunFolder) -> SettledResult:
    return estimate_run(run)


def test_it_finds_what_the_fake_arm_was_built_with(result: SettledResult) -> None:
    assert result.truth is not None
    away = {name: (found.value - result.truth[name]) / found.std for name, found in result.parameters.items()}
    assert np.mean(np.abs(list(away.values())) < 1.96) > 0.85
    for joint in range(1, 5):
        for term in ("viscous", "coulomb"):
            name = f"{term}_{joint}"
            assert result.parameters[name].value == pytest.approx(result.truth[name], rel=0.02)
    assert result.parameters["moment_z_2"].value == pytest.approx(result.truth["moment_z_2"], rel=0.005)
    assert result.chain is not None
    assert result.chain.groups["moment_x_3"] == "moment_x_3 + 0.124 mass_4"


def test_residual_prediction_and_verdict(result: SettledResult) -> None:
    assert max(result.fit.residual_rms_ticks) < 0.31
    assert result.validation.held_out_rms is not None
    assert max(result.validation.held_out_rms) < 0.01
    assert result.verdict.trust in ("yes", "with care")


def test_with_identified_ratios_the_truth_scales_with_the_first_torque_constant_in_every_row(
    run: RunFolder, result: SettledResult, capsys: pytest.CaptureFixture[str]
) -> None:
    """All values of a spatial arm scale with it, inertias as well as friction."""
    rows = ("inertia_zz_1", "moment_z_2", "viscous_1", "coulomb_3")
    ratios = {f"torque_scale_{joint}": Quantity(1.0, 1e-3, "1") for joint in (2, 3, 4)}
    scaled = {name: replace(each, value=1.03 * each.value) for name, each in result.parameters.items()}
    changed = replace(result, parameters=scaled, extra={**result.extra, **ratios})

    def in_std(factor: float) -> dict[str, float]:
        config = run.load_config()
        first, *others = config.joints
        first = first.model_copy(update={"torque_constant": factor * first.torque_per_goal})
        print_result(changed, config.model_copy(update={"joints": [first, *others]}), run.path, Console(width=200))
        lines = (line.split() for line in capsys.readouterr().out.splitlines())
        return {words[0]: abs(float(words[-1])) for words in lines if words and words[0] in rows}

    as_given, in_its_unit = in_std(1.0), in_std(1.03)
    for name in rows:
        assert in_its_unit[name] < 4.0 < as_given[name], name


def test_a_current_that_is_not_the_commanded_one_lowers_the_verdict(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(run.path, tmp_path / "run")
    samples = load_samples(run.samples_path, 4).copy()
    samples["current"][::5, 1] = -0.8 * np.abs(samples["goal_current"][:, 1]).max()
    monkeypatch.setattr(chain_estimate, "load_samples", lambda *_: samples)
    found = estimate_run(RunFolder.open(tmp_path / "run"))
    assert found.verdict.trust == "with care"
    (said,) = [each for each in found.verdict.sentences if "was not the commanded one" in each]
    assert said.startswith("The current of joint2 was not")
    (warning,) = [each for each in found.warnings if "carried a current opposite to the commanded one" in each]
    assert warning.startswith("joint2 ")


def test_a_joint_that_hardly_moves_is_named(run: RunFolder) -> None:
    config = run.load_config()
    position = np.sin(np.linspace(0.0, 6.0, 50)) * np.array([0.5, 0.5, 0.01, 0.5])[:, None]
    position[2, 7] = np.nan
    assert unmoved(config, position) == ["joint3"]


def test_it_starts_and_ends_where_the_arm_lies(run: RunFolder) -> None:
    config = run.load_config()
    samples = load_samples(run.samples_path, 4)
    rest = np.array(config.arm.rest_pose)
    np.testing.assert_allclose(samples["position"][0], rest, atol=0.05)
    np.testing.assert_allclose(samples["position"][-1], rest, atol=0.05)
    assert np.abs(samples["velocity"][-1]).max() < 0.1
    lows, highs = np.array([joint.position_limit for joint in config.joints]).T
    assert np.all((samples["position"] > lows) & (samples["position"] < highs))


def test_the_result_is_read_back_as_a_model(run: RunFolder, result: SettledResult) -> None:
    model = hil.load_model(run.path)
    assert isinstance(model, ChainArmModel)
    g = model.geometry
    chain = Chain(g.rotation, g.translation, g.axis, g.gravity)
    every = np.array([model.values.get(name, 0.0) for name in parameter_names(4)])
    q, v, a = np.random.default_rng(1).standard_normal((3, 4, 30))
    right = inverse_dynamics(chain, every, q, v, a)
    np.testing.assert_allclose(model.rigid_body_torque(q.T, v.T, a.T).T, right, atol=1e-12)
    back = model.forward_dynamics(q.T, v.T, model.inverse_dynamics(q.T, v.T, a.T))
    np.testing.assert_allclose(back, a.T, atol=1e-8)
    still = np.zeros_like(q)
    np.testing.assert_allclose(model.gravity_torque(q.T).T, inverse_dynamics(chain, every, q, still, still), atol=1e-12)


def test_exports_move_as_identified_and_keep_the_urdf(run: RunFolder, result: SettledResult, tmp_path: Path) -> None:
    model = hil.load_model(run.path)
    said = {name: export(run.path, name, tmp_path / f"arm.{name}").left_out for name in ("urdf", "mjcf")}
    q, v, a = np.random.default_rng(2).standard_normal((3, 4))
    right = model.rigid_body_torque(q, v, a)
    for name in ("urdf", "mjcf"):
        engine = mujoco.MjModel.from_xml_path(str(tmp_path / f"arm.{name}"))
        engine.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        if name == "urdf":  # cannot represent rotors and lists them instead
            found = [float(text.split(" = ")[1].split()[0]) for text in said[name] if text.startswith("armature")]
            engine.dof_armature[:] = found
        engine.dof_damping[:] = 0.0
        data = mujoco.MjData(engine)
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(engine, data)
        np.testing.assert_allclose(data.qfrc_inverse, right, atol=2e-4)
        assert engine.joint("joint3").damping == pytest.approx(0.0)
    before, after = (
        ET.parse(path).getroot() for path in (CONFIGS / "open_manipulator_x_like.urdf", tmp_path / "arm.urdf")
    )
    for tag in ("link", "joint"):
        assert [each.get("name") for each in before.findall(tag)] == [each.get("name") for each in after.findall(tag)]
    for name in ("origin", "axis", "limit", "parent", "child"):
        for old, new in zip(before.findall("joint"), after.findall("joint"), strict=True):
            kept = [None if each is None else each.attrib for each in (old.find(name), new.find(name))]
            assert kept[0] == kept[1]
    assert not read_urdf(tmp_path / "arm.urdf").doubts
    dynamics = after.find("joint[@name='joint2']/dynamics")
    assert dynamics is not None
    assert float(dynamics.get("damping", 0)) == pytest.approx(model.values["viscous_2"])


def test_the_mjcf_has_actuators_in_the_servos_unit_and_the_shapes_of_the_urdf(
    run: RunFolder, result: SettledResult, tmp_path: Path
) -> None:
    model = hil.load_model(run.path)
    left = export(run.path, "mjcf", tmp_path / "arm.mjcf").left_out
    engine = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.mjcf"))
    assert engine.nu == engine.nv == 4
    data = mujoco.MjData(engine)
    data.ctrl[:] = goal = np.array([0.1, -0.2, 0.3, 0.4])
    for _ in range(200):  # the lag's filter settles
        data.qpos[:], data.qvel[:] = 0.0, 0.0
        mujoco.mj_step(engine, data)
    offsets = np.array([model.values[f"offset_{joint}"] for joint in range(1, 5)])
    gains = np.array([model.torque_per_goal(joint) for joint in range(1, 5)])
    np.testing.assert_allclose(data.qfrc_actuator, gains * goal - offsets, rtol=1e-6)
    assert not any(sentence.startswith(("offset", "lag")) for sentence in left)
    arm = read_urdf(CONFIGS / "open_manipulator_x_like.urdf")
    shown = {arm.base, *(joint.link for joint in arm.joints)}
    shapes = ET.parse(CONFIGS / "open_manipulator_x_like.urdf").getroot().findall("link")
    assert engine.ngeom == sum(len(link.findall("collision")) for link in shapes if link.get("name") in shown)


def test_exported_parameters_are_read_back(run: RunFolder, result: SettledResult, tmp_path: Path) -> None:
    for name in ("toml", "json"):
        path = tmp_path / f"arm.{name}"
        export(run.path, name, path)
        again = hil.load_model(path)
        assert isinstance(again, ChainArmModel)
        assert again.values == hil.load_model(run.path).values
    assert json.loads((tmp_path / "arm.json").read_text())["chain"]["urdf"] == "open_manipulator_x_like.urdf"


def test_what_is_not_there_yet_is_refused(run: RunFolder) -> None:
    with pytest.raises(ConfigError, match="only planar arms"):
        estimate_unsettled(run)
    with pytest.raises(ConfigError, match="--mujoco is for planar arms"):
        compare_run(run, True)


def test_it_predicts_a_held_out_path_better_than_regressions(
    run: RunFolder, result: SettledResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chain_compare, "CUTOFFS", (6.0, 10.0))  # the second one is the best of all that are tried
    methods = compare_run(run, False).methods
    assert set(methods) == {"hil", "fourier_lines", "idim_ls"}
    held_out = {name: each.held_out_rms or np.inf for name, each in methods.items()}
    assert held_out["hil"] < 0.5 * min(held_out["fourier_lines"], held_out["idim_ls"])
    worst = {name: each.worst_relative_error or np.inf for name, each in methods.items()}
    assert worst["hil"] < 0.03
    assert worst["hil"] < min(worst["fourier_lines"], worst["idim_ls"])
    assert methods["hil"].parameters["moment_z_2"] == pytest.approx(result.parameters["moment_z_2"].value, rel=1e-6)


def test_a_calibration_asks_for_what_the_kind_of_arm_needs(run: RunFolder, result: SettledResult) -> None:
    for added, message in (
        (AddedMass(0.2, distance=0.1), "give the position of the mass"),
        (AddedMass(0.2, at=(0.1, 0.0, 0.0), joint="wrist"), "the arm's joints are joint1, joint2"),
    ):
        with pytest.raises(ConfigError, match=message):
            calibrate_runs(run, run, added)


def test_drawn_arms_are_physical_and_scatter_as_the_result_says(run: RunFolder, result: SettledResult) -> None:
    source = Source.open(run.path, None)
    drawn = draw_arms(source, 60, torque_constants=False)
    assert drawn.redrawn < 20
    column = drawn.values[:, drawn.names.index("moment_z_2")]
    assert np.std(column) == pytest.approx(result.parameters["moment_z_2"].std, rel=0.5)
    for model in drawn.models[:5]:
        assert np.linalg.eigvalsh(model.mass_matrix(np.zeros(4))).min() > 0.0


def test_the_same_arm_twice_has_not_changed(run: RunFolder, result: SettledResult) -> None:
    difference = diff_runs(run.path, run.path)
    assert difference.changes
    assert not difference.changed


def test_a_path_that_leads_too_near_is_refused_on_a_real_port(tmp_path: Path) -> None:
    text = TEXT.replace('url = "fake://"', 'url = "/dev/ttyUSB0"').replace('floor = "none"', "floor = 0.0")
    config = parse_config(text, FOUR)
    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(ConfigError, match=r"too little clearance: .*floor"):
        run_experiment(config, run, config.path, lambda _: None)


def test_the_way_to_the_path_stays_between_rest_and_path() -> None:
    config = load_config(FOUR)
    plan = make_chain_plan(config)
    assert [segment.role for segment in plan.segments] == ["identify", "held_out"]
    first = plan.segments[0]
    assert len(first.ramp_in) == len(first.ramp_out) == first.ramp_samples == 1200
    # The pieces join continuously.
    joined = np.concatenate((first.ramp_in[-2:], first.period_current[:2]))
    assert np.abs(np.diff(joined, axis=0)).max() < 0.2
    joined = np.concatenate((first.period_current[-2:], first.ramp_out[:2]))
    assert np.abs(np.diff(joined, axis=0)).max() < 0.2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "joint2"', 'name = "elbow"', 'no joint "elbow"'),
        ("swing = [0.9", "swing = [3.9", "outside its position_limit"),
        ("speed = [4.8", "speed = [48.0", "velocity_limit"),
        ("[experiment]", "[experiment]\npilot = true", "the path is designed"),
        ('drive = "lag"', 'drive = "lag"\nripple = true', "model.ripple = true"),
        ("[stabiliser]", "[stabilizer]", "stabili"),
        ('urdf = "open_manipulator_x_like.urdf"\nrest', 'urdf = "none.urdf"\nrest', "cannot be read"),
        ('urdf = "open_manipulator_x_like.urdf"\nrest', "rest", "arm.urdf"),
        ("centre = [0.0, -0.3, 0.3, 0.2]", "centre = [0.0]", "joint_path.centre has 1 entry"),
    ],
)
def test_a_wrong_description_is_named(old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(ConfigError, match=message):
        parse_config(TEXT.replace(old, new, 1), FOUR)


def test_a_run_folder_of_an_older_version_may_have_link_lengths() -> None:
    old = TEXT.replace(
        'urdf = "open_manipulator_x_like.urdf"\nrest',
        'urdf = "open_manipulator_x_like.urdf"\nlink_lengths = [0.1, 0.1, 0.1, 0.1]\nrest',
        1,
    )
    assert parse_config(old, FOUR, recorded=True).arm.link_lengths is None
    with pytest.raises(ConfigError, match="link_lengths"):
        parse_config(old, FOUR)


def test_too_little_torque_for_the_path_is_named() -> None:
    weak = TEXT.replace("current_limit = 1.2", "current_limit = 0.3")
    with pytest.raises(ConfigError, match="needs about"):
        make_chain_plan(parse_config(weak, FOUR))


def test_an_unfinished_calibration_says_so() -> None:
    fit = CalibrationFit(residual_rms_ticks=((0.29,), (0.29,)), misfit=1.0, joints=1)
    result = CalibrationResult(1, {}, {}, fit, contradictory=False)
    said = [" ".join(calibration_lines(replace(result, fit=replace(fit, reached=each)))) for each in (True, False)]
    assert "stopped short of its minimum" not in said[0]
    assert "stopped short of its minimum" in said[1]
    assert "Do not use" not in said[0]
    assert "Do not use" in " ".join(calibration_lines(replace(result, contradictory=True)))


def explained(known: KnownChain, std: NDArray[np.float64]) -> Any:
    """What the verdict needs of an estimate with these standard errors that leaves nothing unexplained."""
    return SimpleNamespace(
        model=ChainModel(known.base),
        names=known.base.names,
        value=known.prior.value,
        std=std,
        over_noise=np.ones(4),
        noise_steps=0.29 * np.ones(4),
        systematic=0.8,
        reached=True,
        from_prior=(),
        unseen=(),
        at_bound=(),
        conflicts=(),
        doubtful_zeros=(),
    )


def test_an_unfinished_fit_is_trusted_with_care(run: RunFolder) -> None:
    config = run.load_config()
    known = known_chain(config)
    estimate = explained(known, 0.01 * known.prior.std)
    verdicts = []
    for estimate.reached in (True, False):
        verdicts.append(_verdict(config, estimate, known, np.full(4, 1e-3), []))
    assert [verdict.trust for verdict in verdicts] == ["yes", "with care"]
    assert "stopped short of its minimum" in verdicts[1].sentences[-1]
    estimate.reached = True
    jumped = _verdict(config, estimate, known, np.full(4, 1e-3), [], ("The position of joint3 jumped.",))
    assert jumped.trust == "with care" and "The position of joint3 jumped." in jumped.sentences
    assert any("zeros were taken from the configuration and not identified:" in each for each in jumped.sentences)
    estimate.doubtful_zeros = ((3, 0.021),)
    shifted = _verdict(config, estimate, known, np.full(4, 1e-3), [])
    assert shifted.trust == "with care"
    assert any("contradicts them: joint3 is off by about 0.021 rad" in each for each in shifted.sentences)
    estimate.doubtful_zeros = ()
    estimate.at_bound = ("back_emf_2",)
    bounded = _verdict(config, estimate, known, np.full(4, 1e-3), [])
    assert bounded.trust == "with care" and "back_emf_2 is at its bound" in " ".join(bounded.sentences)
    estimate.at_bound, estimate.systematic = (), 3.0
    hidden = _verdict(config, estimate, known, np.full(4, 1e-3), [])
    assert hidden.trust == "with care"
    assert "part of it repeats with the motion" in hidden.sentences[0]


def test_a_torque_constant_far_from_the_file_lowers_the_verdict(run: RunFolder) -> None:
    """ "With care" if the motion is explained, "no" if something is missing; link values are only named."""
    config = run.load_config()
    known = known_chain(config)
    prior = replace(known.prior, scale_precision=np.eye(3) / 0.1**2)
    names = (*known.base.names, "torque_scale_2", "torque_scale_3", "lag_ratio_2")
    value = np.concatenate((prior.value, [1.2, 0.5, 1.5]))
    std = np.concatenate((0.01 * prior.std, [0.01, 0.01, 0.1]))
    assert [each.name for each in chain_conflicts(names, value, std, prior)] == ["torque_scale_3"]
    ratio = chain_conflicts(names, value, std, prior)
    value[0] += 5.0 * prior.std[0]
    value[-2] = 1.0
    link = chain_conflicts(names, value, std, prior)
    assert [each.name for each in link] == [known.base.names[0]]
    estimate = explained(known, 0.01 * known.prior.std)
    found = {}
    for estimate.systematic in (0.8, 3.0):
        for estimate.conflicts in (ratio, link):
            verdict = _verdict(config, estimate, known, np.full(4, 1e-3), [])
            found[estimate.systematic, estimate.conflicts[0].name] = verdict.trust
            said = " ".join(verdict.sentences)
            assert estimate.conflicts[0].said in said
            assert ("identify again" in said) == (estimate.systematic > 1.0)
    assert list(found.values()) == ["with care", "yes", "no", "with care"]


def test_a_value_less_certain_than_the_description_is_trusted_with_care(run: RunFolder) -> None:
    """Errors of the model may make a standard error exceed the prior's, although white noise would not."""
    config = run.load_config()
    known = known_chain(config)
    std = 0.01 * known.prior.std
    std[2] = 1.1 * known.prior.std[2]
    estimate = explained(known, std)
    verdict = _verdict(config, estimate, known, np.full(4, 1e-3), [])
    assert verdict.trust == "with care"
    assert known.base.names[2] in verdict.sentences[-1]
    estimate.from_prior = (known.base.names[2],)  # named once is enough
    assert len(_verdict(config, estimate, known, np.full(4, 1e-3), []).sentences) == len(verdict.sentences)


def torques_of(path: Path, q: NDArray[np.float64], a: NDArray[np.float64]) -> NDArray[np.float64]:
    """MuJoCo's gravity and inertial torques (2, joints) [N m] of an exported arm at standstill."""
    engine = mujoco.MjModel.from_xml_path(str(path))
    engine.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(engine)
    found = []
    for acceleration in (np.zeros_like(a), a):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, 0.0, acceleration
        mujoco.mj_inverse(engine, data)
        found.append(data.qfrc_inverse.copy())
    return np.stack((found[0], found[1] - found[0]))


def test_the_torque_constant_scales_gravity_inertia_and_friction_of_drawn_arms_alike(
    run: RunFolder, result: SettledResult, tmp_path: Path
) -> None:
    source = Source.open(run.path)
    joints = tuple(replace(joint, torque_per_goal_std=0.1 * joint.torque_per_goal) for joint in source.model.joints)
    source = replace(source, model=replace(source.model, joints=joints))
    given, varied = (draw_arms(source, 4, torque_constants=each) for each in (False, True))
    q, a = np.random.default_rng(3).standard_normal((2, 4))
    assert np.ptp(varied.torque_factor) > 0.05
    for number, factor in enumerate(varied.torque_factor.tolist()):
        paths = [tmp_path / f"{name}_{number}.xml" for name in ("given", "varied")]
        for path, drawn in zip(paths, (given, varied), strict=True):
            export_mjcf(replace(source, model=drawn.models[number]), path)
        before, after = (torques_of(path, q, a) for path in paths)
        np.testing.assert_allclose(after, factor * before, rtol=2e-3, atol=2e-5)
        frictions = [ET.parse(path).find(".//joint[@name='joint2']") for path in paths]
        loss = [0.0 if each is None else float(each.get("frictionloss", 0)) for each in frictions]
        assert loss[1] == pytest.approx(factor * loss[0])


def test_an_arm_without_physically_consistent_links_is_not_exported_silently(
    run: RunFolder, result: SettledResult, tmp_path: Path
) -> None:
    """The names and the size of the difference are in the file and on the terminal; a large one is refused."""
    source = Source.open(run.path)
    model = source.model
    assert isinstance(model, ChainArmModel)
    stated = dict(model.values)
    wider = {name: max(std, 0.5 * abs(stated[name])) for name, std in model.stds.items()}
    least = min((name for name in model.groups if name.startswith("armature")), key=lambda name: stated[name])
    slightly = replace(source, model=replace(model, values=stated | {least: -0.1 * stated[least]}, stds=wider))
    left = export_mjcf(slightly, tmp_path / "slightly.xml")
    found = Written("mjcf", tmp_path / "slightly.xml", left)
    assert re.search(r"no physically consistent links have the identified values.* differ by .* % \(joint", left[0])
    assert "is not equivalent to the identified one" in found.warning
    text = (tmp_path / "slightly.xml").read_text()
    assert left[0] in text and "NOT dynamically equivalent" in text
    assert Written("mjcf", run.path, export_mjcf(source, tmp_path / "arm.xml")).warning == ""
    assert "NOT dynamically equivalent" not in (tmp_path / "arm.xml").read_text()
    inertias = {name: -value for name, value in stated.items() if name.startswith(("inertia", "armature"))}
    with pytest.raises(ExportError, match="more than 20 % are not exported"):
        export_mjcf(replace(source, model=replace(model, values=stated | inertias, stds=wider)), tmp_path / "no.xml")
    assert not (tmp_path / "no.xml").exists()


GRAVITY = {"standing": (0.0, 0.0, -1.0), "hanging": (0.0, 0.0, 1.0), "wall": (0.0, 1.0, 0.0)}


@pytest.mark.parametrize("assumed", GRAVITY)
def test_the_mount_with_which_the_recording_agrees_with_the_description_is_found(run: RunFolder, assumed: str) -> None:
    config = run.load_config()
    arm, known = described_arm(config), known_chain(config)
    period = settled_period(config, run.load_facts(), load_samples(run.samples_path, 4), IDENTIFY)
    chain = replace(known.base.chain, gravity=9.81 * np.array(GRAVITY[assumed]))
    model = ChainModel(BaseParameters.of(chain))
    found = better_gravity(period, model, arm.parameters)
    assert found is None if assumed == "standing" else found == pytest.approx(9.81 * np.array(GRAVITY["standing"]))


def test_the_verdict_names_a_mount_and_what_is_still_right(run: RunFolder) -> None:
    config = run.load_config()
    known = known_chain(config)
    estimate = explained(known, 0.01 * known.prior.std)
    estimate.value = np.where([name == "moment_x_3" for name in known.base.names], -1.0, 1.0) * known.prior.value
    up = np.array([0.0, 0.0, 9.81])
    turned = _verdict(config, estimate, known, np.full(4, 1e-3), [], (), up)
    said = " ".join(turned.sentences)
    assert turned.trust == "with care"
    assert "moment_x_3 is -" in said and "joint joint3)" in said and "moment_z_2" not in said
    assert "hanging upside down, base = [3.1416, 0.0, 0.0]" in said
    assert "torques at the measured angles are right" in said
    assert "zero of joint1" not in said, "it turns about the vertical"
    assert turned.first is not None and turned.first.startswith("set base = [3.1416, 0.0, 0.0]")
    estimate.systematic = 3.0
    distorted = _verdict(config, estimate, known, np.full(4, 1e-3), [], (), up)
    assert distorted.trust == "no" and "distorted as well" in " ".join(distorted.sentences)
    estimate.systematic = 0.8
    unknown = _verdict(config, estimate, known, np.full(4, 1e-3), [])
    said = " ".join(unknown.sentences)
    assert unknown.trust == "with care" and "none of them agrees better" in said
    causes = [said.index(each) for each in ("`base`, the orientation", "`direction` and the axis", "90 or 180 degrees")]
    assert causes == sorted(causes)
    assert unknown.first is not None and "zero_ticks of joint3" in unknown.first
    estimate.value = known.prior.value
    assert _verdict(config, estimate, known, np.full(4, 1e-3), []).first is None


def test_the_next_command_is_not_export_if_something_must_be_corrected_first(
    run: RunFolder, result: SettledResult
) -> None:
    doubted = replace(result, verdict=replace(result.verdict, trust="with care", first="set base = [3.1416, 0.0, 0.0]"))
    first, after = what_next(doubted, run.path).splitlines()
    assert first == "First set base = [3.1416, 0.0, 0.0]." and after.startswith("Next: hil check ")
    assert result_from_json(doubted.to_json()).verdict == doubted.verdict


def test_only_joints_that_stick_are_said_to_stick() -> None:
    time = np.arange(2000) / 200.0
    step = 2.0 * np.pi / 4096
    moving = 0.3 * np.sin(2.0 * np.pi * 0.3 * time)
    position = step * np.round(np.stack((moving, np.where(moving > 0.2, 0.2, moving))) / step)
    assert sticking_joints(position, 200.0, np.full(2, step)) == (1,)
    position[0, ::50] = np.nan
    assert sticking_joints(position, 200.0, np.full(2, step)) == (1,)
    assert "can be the cause" in stopped_short(["elbow"], "Use faster motion")
    assert "stick" not in stopped_short([], "Use faster motion")
