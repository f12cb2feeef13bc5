"""Section on the predicted and measured peaks of each step, from the pilot to the full run."""

from hil.config.schema import Config
from hil.dry_run.prediction import quantities_of
from hil.report.run_data import RunData
from hil.report.section import Section, Table
from hil.report.words import listed, number
from hil.results.parts import PlayedStep


def steps(data: RunData) -> Section | None:
    """The section; None if the run did not proceed in steps."""
    played = data.result.steps
    if not played:
        return None
    outside = [step.name for step in played if not step.within_quantile]
    said = (
        f"In {listed(outside)}, a peak exceeded the dry run's prediction for 99 of 100 arms."
        if outside
        else "No peak of a limited quantity exceeded the dry run's prediction for 99 of 100 arms."
    )
    tables = tuple(_table(step, data.config) for step in played)
    return Section("steps", "Predicted and measured peaks", (said,), tables)


def _table(step: PlayedStep, config: Config) -> Table:
    names = [joint.name for joint in config.joints]
    rows = [
        (
            f"{joint.name}: {quantity} [{unit}]",
            *(number(peaks[row][index], 3) for peaks in (step.predicted_median, step.predicted_quantile_99, step.seen)),
        )
        for index, joint in enumerate(config.joints)
        for row, (quantity, unit) in enumerate(quantities_of(joint))
    ]
    torque = listed([f"{name} {number(peak, 3)} N m" for name, peak in zip(names, step.peak_torque, strict=True)])
    head = ("joint and peak", "typical arm", "99 of 100 arms", "measured")
    return Table(head, tuple(rows), caption=f"{step.name}, peak torque {torque}")
