"""Estimate a spatial arm's parameters from its run folder in two stages, and validate them on a held-out path."""

import time
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from hil.config.chain import described_arm, doubted_inertias
from hil.config.schema import Config
from hil.config.varying_delay import varying_delay
from hil.description.arm import ArmDescription
from hil.errors import RecordingCutShort
from hil.estimation.chain_mount import MountDoubt, mass_on_the_other_side, mounted_otherwise
from hil.estimation.drive.currents import settled_current_findings
from hil.estimation.model_from_config import voltage_driven
from hil.estimation.result import QUANTISATION_FLOOR_TICKS, arm_facts, quantities
from hil.estimation.result_checks import describe_chain_choice
from hil.estimation.settled_period import settled_period
from hil.estimation.settled_warnings import warnings_of
from hil.estimation.slips.position_jumps import jump_disturbances
from hil.estimation.slips.sticking import sticking_joints
from hil.estimation.torque_constants import RATIO, contradictions, ratios_of
from hil.estimation.truth import back_emf, scaled
from hil.estimator.arrays import Array
from hil.estimator.chain.choice import choose_chain
from hil.estimator.chain.identify import SYSTEMATIC, ChainEstimate, identify_chain
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.model.tilt import TILT, tilt_between
from hil.estimator.chain.mount import LIKELY, SURE, better_gravity, opposed_moments
from hil.estimator.chain.simulation.prediction import predict
from hil.estimator.models.bounds import bound_sentence
from hil.estimator.models.conflicts import Trust, conflict_sentences, contradicted, lowered
from hil.fakes.plants.arm import armature
from hil.plan.chain_model import KnownChain, known_chain, torque_constant_stds
from hil.plan.plan import HELD_OUT, IDENTIFY
from hil.results.parts import ChainFacts, Covariance, RunTiming, SettledFit, Validation, Verdict
from hil.results.result import SettledResult
from hil.runs.period_file import PlayedPeriod, save_periods
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFacts, RunFolder
from hil.runs.timing import timing

EXPLAINED = 1.2  # ratio of residual to noise up to which the model counts as complete
NOISY = 1.05  # ratio of noise to encoder rounding above which the noise is mentioned
PREDICTED = 0.01  # held-out prediction error relative to the motion, up to which the model is trusted
WRONG = 0.05  # the same, beyond which the model is rejected
UNMOVED = 0.03  # range of motion [rad] below which a joint shows neither friction nor inertia


def estimate_chain_run(run: RunFolder, config: Config, facts: RunFacts) -> SettledResult:
    """Estimate from the recording in `run` and write its result.json. Raises HilError, EstimationError."""
    samples = load_samples(run.samples_path, len(config.joints))
    started = time.perf_counter()
    known = known_chain(config)
    model = wanted_chain_model(config, known)
    period = settled_period(config, facts, samples, IDENTIFY)
    if config.model.friction == "auto":
        choice = choose_chain(period, model, known.prior)
        estimate = choice.estimate
    else:
        choice, estimate = None, identify_chain(period, model, known.prior, test_zeros=True)
    model = estimate.model
    played = {IDENTIFY: PlayedPeriod(period.rate, period.torque, period.position, estimate.position)}
    beyond = None
    if HELD_OUT in facts.segments:
        with suppress(RecordingCutShort):  # the run ended in the held-out part: use what is complete
            other = settled_period(config, facts, samples, HELD_OUT)
            predicted = predict(model, estimate.parameters, other)
            played[HELD_OUT] = PlayedPeriod(other.rate, other.torque, other.position, predicted)
            beyond = played[HELD_OUT].error_beyond(other.noise)
    held_out = played[HELD_OUT].relative_error if HELD_OUT in played else None
    seconds = round(time.perf_counter() - started, 3)
    linear = len(model.linear_names)
    currents = settled_current_findings(config, samples)
    truth, extra = true_chain_parameters(config, known), quantities(estimate, linear, len(estimate.names))
    result = SettledResult(
        method="settled period, least squares on Fourier coefficients, then maximum likelihood of one-step-ahead "
        f"position predictions with an observer of {estimate.softness:g} Hz; {model.description}",
        config=facts.config,
        joints=len(config.joints),
        parameters=quantities(estimate, 0, linear),
        extra=extra,
        covariance=Covariance(estimate.names, tuple(map(tuple, estimate.covariance.tolist()))),
        fit=SettledFit(
            residual_rms_ticks=tuple(estimate.residual_steps.tolist()),
            quantisation_floor_ticks=round(QUANTISATION_FLOOR_TICKS, 4),
            samples_per_period=period.samples,
            periods=period.periods,
            model=model.description,
            outliers=estimate.outliers,
            correlation_time=estimate.correlation_time,
        ),
        validation=Validation(
            held_out_rms=None if held_out is None else tuple(map(float, held_out)),
            residual_over_floor=tuple(estimate.over_noise.tolist()),
        ),
        verdict=_verdict(
            config,
            estimate,
            known,
            beyond,
            unmoved(config, period.position),
            (*jump_disturbances(config, facts, samples), *currents.disturbances),
            better_gravity(period, model, described_arm(config).parameters),
            sticking_joints(period.position, period.rate, period.position_step),
        ),
        model_choice=None if choice is None else describe_chain_choice(choice),
        warnings=(
            *currents.warnings,
            *warnings_of(config, facts, samples, period),
            *doubted_inertias(described_arm(config)),
        ),
        timing=RunTiming.of(timing(samples, config.experiment.rate), seconds),
        arm=arm_facts(config),
        chain=chain_facts(described_arm(config), known.base, estimate.from_prior),
        truth=truth,
        truth_scaled=scaled(truth, config, extra),
    )
    save_periods(run.path, played)
    run.write_result(result)
    return result


def wanted_chain_model(config: Config, known: KnownChain) -> ChainModel:
    """The model requested by the configuration.

    Ratios of torque constants are parameters if the configuration gives their uncertainty. Each joint has its own lag:
    servo models differ, and neglecting half a millisecond biases the inertias of light joints by several percent.
    """
    wanted = config.model
    scales = known.base.chain.joints > 1 and (wanted.torque_scale or known.prior.scale_precision is not None)
    return ChainModel(
        known.base,
        wanted.fixed_friction,
        wanted.drive,
        wanted.zeros,
        scales,
        wanted.base_tilt,
        lags=known.base.chain.joints > 1,
        by_voltage=voltage_driven(config),
    )


def true_chain_parameters(config: Config, known: KnownChain) -> dict[str, float] | None:
    """True parameters of the fake arm by name [SI]; None for a real arm, or for a fake arm that is not spatial."""
    chain = None if config.fake is None else config.fake.chain
    if not config.is_fake or chain is None:
        return None
    rotors = [armature(drive) for drive in chain.drives]
    every = np.column_stack((np.stack([body.parameters for body in chain.bodies]), rotors)).reshape(-1)
    truth = dict(zip(known.base.names, known.base.of_all(every).tolist(), strict=True))
    for quantity in ("viscous", "coulomb", "offset"):
        for joint, drive in enumerate(chain.drives, start=1):
            truth[f"{quantity}_{joint}"] = getattr(drive, quantity)
    assert config.fake is not None
    for name, damping in back_emf(config, config.fake, chain.drives).items():
        truth[name] += damping
    if config.model.base_tilt:
        truth |= dict(zip(TILT, tilt_between(known.base.chain.gravity, chain.gravity_vector), strict=True))
    return truth


def chain_facts(arm: ArmDescription, base: BaseParameters, from_prior: tuple[str, ...]) -> ChainFacts:
    """The part of the description that a model needs. from_prior: base parameters that the data barely constrain."""
    chain = base.chain
    return ChainFacts(
        urdf=arm.path.name,
        rotation=tuple(tuple(map(tuple, each)) for each in chain.rotation.tolist()),
        translation=tuple(map(tuple, chain.translation.tolist())),
        axis=tuple(map(tuple, chain.axis.tolist())),
        gravity=tuple(chain.gravity.tolist()),
        groups=dict(zip(base.names, base.groups, strict=True)),
        from_prior=from_prior,
        held=arm.held,
        doubts=arm.doubts,
    )


def unmoved(config: Config, position: Array) -> list[str]:
    """Names of the joints that move too little to be identified. position: (joints, samples) [rad]."""
    reach = np.ptp(np.where(np.isnan(position), np.nanmean(position, axis=1, keepdims=True), position), axis=1)
    return [joint.name for joint, each in zip(config.joints, reach, strict=True) if each < UNMOVED]


def _verdict(
    config: Config,
    estimate: ChainEstimate,
    known: KnownChain,
    held_out: Array | None,
    still: list[str],
    disturbances: tuple[str, ...] = (),
    gravity: Array | None = None,
    sticking: tuple[int, ...] = (),
) -> Verdict:
    """The verdict, with reasons.

    held_out: relative prediction error on the held-out path (joints,); None if no path was held out. still: names of
    joints that hardly moved. gravity: direction of gravity for which recording and description agree; see
    `better_gravity`. sticking: joints that stick, numbered from 0.
    """
    joints = [joint.name for joint in config.joints]
    certain = estimate.std[: known.base.count] / known.prior.std
    weakest = known.base.names[int(np.argmax(certain))]
    explained = is_explained(estimate)
    sentences = [_unexplained(config, estimate, gravity)]
    trust: Trust = "yes" if explained else "with care"
    mount = doubted_mount(config, estimate, known, gravity)
    if mount is not None:
        sentences += mount.said
    if held_out is None:
        sentences.append("No second path was recorded, so the prediction could not be validated.")
        trust = "with care"
    else:
        error = float(np.max(held_out))
        joint = joints[int(np.argmax(held_out))]
        sentences.append(
            f"A held-out path is predicted to within {100 * error:.2f} % of its motion's RMS (worst joint: {joint}), "
            "excluding encoder noise."
        )
        trust = "no" if error > WRONG else "with care" if error > PREDICTED else trust
    if estimate.doubtful_zeros:
        trust = lowered(trust, "with care")
    if said := about_zeros(config, estimate):
        sentences.append(said)
    if still:
        trust = "no"
        sentences.append(
            f"{', '.join(still)} hardly moved, so the recording reveals little about their inertia and friction: "
            "increase joint_path.swing and speed, and check that nothing blocks the motion."
        )
    cautions = [
        *disturbances,
        _from_prior(estimate),
        vague(known.prior, known.base.names, estimate.std, estimate.from_prior),
        ""
        if estimate.reached
        else stopped_short([joints[each] for each in sticking], "Use faster motion ([joint_path])"),
        bound_sentence(estimate.at_bound) if estimate.at_bound else "",
        *contradicting_torques(config, estimate),
    ]
    if any(cautions):
        trust = lowered(trust, "with care")
        sentences += filter(None, cautions)
    trust = lowered(trust, contradicted(estimate.conflicts, explained))
    sentences += conflict_sentences(estimate.conflicts, explained)
    if estimate.unseen:
        sentences.append(
            f"Not identifiable from gravity in this motion: {', '.join(estimate.unseen)} (assumed to be zero, with "
            "the standard errors given)."
        )
    if mount is None:
        return Verdict(trust, weakest, tuple(sentences))
    return Verdict(lowered(trust, mount.at_most), weakest, tuple(sentences), mount.first)


def _from_prior(estimate: ChainEstimate) -> str:
    """Name the parameters that come from the description; "" if there are none."""
    if not estimate.from_prior:
        return ""
    return (
        f"The recording reveals little about {', '.join(estimate.from_prior)}: these values come from the URDF. Use "
        "wider and faster motion ([joint_path]) to identify them, or accept them: they hardly affect the motion."
    )


def doubted_mount(
    config: Config, estimate: ChainEstimate, known: KnownChain, gravity: Array | None
) -> MountDoubt | None:
    """Return the contradiction between the centres of mass and the description, if there is one."""
    arm, explained = described_arm(config), is_explained(estimate)
    sure = SURE if gravity is None else LIKELY
    opposed = opposed_moments(estimate.names, estimate.value, estimate.std, known.prior, sure)
    if gravity is None:
        return mass_on_the_other_side(arm, opposed, explained)
    return mounted_otherwise(arm, opposed, known.base.chain.gravity, gravity, explained)


def stopped_short(sticking: Sequence[str], remedy: str) -> str:
    """State that the fit stopped short of its minimum, and name the joints that stick.

    remedy: what to do about joints that stick.
    """
    said = "The fit stopped short of its minimum; the standard errors include the remaining distance to the minimum."
    if not sticking:
        return said
    return (
        f"{said} {', '.join(sticking)} sticks at times, which can be the cause. {remedy}, so that fewer joints stick."
    )


def contradicting_torques(config: Config, estimate: ChainEstimate) -> tuple[str, ...]:
    """One sentence for each joint whose torque constant is inconsistent with that of the first joint."""
    std = torque_constant_stds(config)
    spreads = {f"{RATIO}_{joint}": float(np.hypot(std[0], std[joint - 1])) for joint in range(2, std.size + 1)}
    ratios = ratios_of(estimate.names, estimate.value, estimate.std)
    return contradictions([joint.name for joint in config.joints], ratios, spreads, "constant", estimate.conflicts)


def about_zeros(config: Config, estimate: ChainEstimate) -> str:
    """State that encoder zeros were not fitted, and which ones the recording contradicts; "" if they were fitted."""
    if estimate.model.zeros:
        return ""
    held = "The encoder zeros were taken from the configuration and not identified"
    if not estimate.doubtful_zeros:
        return (
            f"{held}: if they contain an error that this motion does not reveal, or if `direction` or `base` is wrong, "
            "the link parameters are wrong even though the torques are correct. Use `hil pose` to check the angles by "
            "hand."
        )
    off = ", ".join(
        f"{config.joints[joint - 1].name} is off by about {by:.2g} rad" for joint, by in estimate.doubtful_zeros
    )
    return (
        f"{held}, but the recording contradicts them: {off} (true minus measured angle). The parameters of these links "
        "are wrong: correct zero_ticks, or identify the zeros with [model] zeros = true."
    )


def vague(prior: Prior, names: tuple[str, ...], std: Array, from_prior: tuple[str, ...]) -> str:
    """Name the base parameters not in `from_prior` whose standard errors exceed the prior's; "" if there are none."""
    found = [name for name in prior.surpassing(names, std) if name not in from_prior]
    if not found:
        return ""
    return (
        f"The standard errors of {', '.join(found)} exceed the assumed uncertainty of the URDF's values. Model errors, "
        "or a fit that stopped short, outweigh the information in the recording."
    )


def is_explained(estimate: ChainEstimate) -> bool:
    """Whether the residual is only noise, with no sign of an effect missing from the model."""
    return float(estimate.over_noise.max()) <= EXPLAINED and estimate.systematic <= SYSTEMATIC


def _unexplained(config: Config, estimate: ChainEstimate, gravity: Array | None) -> str:
    over, joint = float(estimate.over_noise.max()), int(np.argmax(estimate.over_noise))
    noise = float(estimate.noise_steps[joint])
    measured = (
        f"the noise of its angle ({noise:.2g} encoder steps RMS; rounding alone is 0.29)"
        if noise > NOISY * QUANTISATION_FLOOR_TICKS
        else "its noise, which is only encoder rounding"
    )
    said = f"The largest residual ({config.joints[joint].name}) is {over:.2f} times {measured};"
    if is_explained(estimate):
        return f"{said} nothing remains unexplained."
    if gravity is not None:
        return f"{said} the model is incomplete, probably because the arm is not mounted as configured."
    causes = (
        "torque ripple or cogging, play or elasticity of the gears, a cable, friction that changes with time, joints "
        "whose position or axis differs from the description, or whose key `direction` is wrong"
    )
    if not estimate.model.base_tilt and np.any(estimate.model.base.chain.gravity):
        causes = f"a base that is not level ([model] base_tilt = true identifies it), {causes}"
    tried = ""
    if estimate.model.friction != "stribeck_load":
        if config.model.friction == "auto":
            tried = " Load-dependent friction was tried and does not explain it."
        else:
            causes = f'load-dependent friction ([model] friction = "auto" tries that), {causes}'
    if over > EXPLAINED:
        if likely := varying_delay(config):
            return f"{said} the model is incomplete.{tried} {likely} Other possible causes: {causes}."
        return f"{said} the model is incomplete.{tried} Possible causes: {causes}."
    return (
        f"{said} but part of it repeats with the motion. This increases standard errors by a factor of up to "
        f"{estimate.systematic:.1f}, and some values may be wrong by more than their standard errors. The model "
        f"lacks a small effect. Possible causes: {causes}.{tried}"
    )
