"""`hil.check`: find everything that would prevent an experiment, before it starts."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.api.configuration import ConfigLike, loaded
from hil.api.progress import OnProgress, Progress, forgiving, ignore
from hil.config.schema import Config
from hil.errors import ConfigError
from hil.results.display import html_table
from hil.setup.finding import Finding, Level
from hil.setup.preflight import check_arm

_ALWAYS_HELD_HZ = 150.0
"""Rate [Hz] from which the stabiliser's delay certainly does not matter. At this rate and above, the delay is not
checked, because loading the pilot for the check takes a second.
"""

__all__ = ["CheckReport", "Finding", "Level", "check"]


@dataclass(frozen=True, repr=False)
class CheckReport:
    """The findings of a check, in the order in which they were made.

    config: the configuration file of the arm, as passed by the caller.
    """

    config: Path
    findings: tuple[Finding, ...]

    @property
    def ready(self) -> bool:
        """Whether no finding blocks an experiment."""
        return not self.problems

    @property
    def problems(self) -> tuple[Finding, ...]:
        """Findings that block an experiment."""
        return tuple(finding for finding in self.findings if finding.level is Level.STOP)

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that do not block an experiment but deserve attention."""
        return tuple(finding for finding in self.findings if finding.level is Level.WARNING)

    def to_json(self) -> dict[str, Any]:
        """The object that `hil check --json` prints."""
        findings = [
            {"level": str(each.level), "where": each.where, "what": each.what, "found": each.found, "fix": each.fix}
            for each in self.findings
        ]
        return {"ready": self.ready, "findings": findings}

    def __repr__(self) -> str:
        state = "ready" if self.ready else _counted(len(self.problems), "blocking problem")
        lines = [f"{self.config}: {state}, {_counted(len(self.warnings), 'warning')}"]
        for each in (*self.problems, *self.warnings):
            lines.append(f"  {each.level:>8} {each.where}: {each.what}: {each.found}")
            lines += [f"{'':11}{line}" for line in each.fix.splitlines()]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = [(str(each.level), each.where, each.what, each.found, each.fix) for each in self.findings]
        return html_table(("", "where", "what", "found", "what to do"), rows)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def check(config: ConfigLike, *, on_progress: OnProgress = ignore) -> CheckReport:
    """Check port, servos, pose and sample rate with torque off (`hil check` as a function). Nothing moves.

    A check that cannot be carried out is reported as a finding, not raised as an exception.

    Raises:
        ConfigError: the configuration is wrong.
    """
    checked, shown = loaded(config)
    forgiving(on_progress)(Progress("check", "Checking the arm"))
    return CheckReport(shown, (*check_arm(checked), *_held_by_pilot(checked)))


def _held_by_pilot(config: Config) -> Iterator[Finding]:
    """Report whether the rate is too low for the stabiliser that the pilot of a planar arm would add."""
    is_doubtful = config.experiment.pilot and config.stabiliser is None and config.experiment.rate < _ALWAYS_HELD_HZ
    if config.is_chain or config.arm.link_lengths is None or not is_doubtful:
        return
    from hil.pilot.belief import prior_belief
    from hil.pilot.gains import with_stabiliser
    from hil.pilot.options import PilotOptions

    try:
        with_stabiliser(config, prior_belief(config, PilotOptions().arms))
    except ConfigError as error:
        yield Finding(Level.STOP, "experiment", "rate", f"{config.experiment.rate:g} Hz", str(error))
