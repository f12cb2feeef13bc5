"""Section on the experiment: configuration, hardware, time, versions and events."""

from hil.report.run_data import RunData
from hil.report.section import Folded, Section, Table
from hil.runs.run_folder import Excitation


def provenance(data: RunData) -> Section:
    record, config = data.record, data.config
    servos = "; ".join(f"{joint.name}: {joint.model}, ID {joint.id}" for joint in config.joints)
    rows = [
        ("configuration", record.config),
        ("started", record.started),
        ("port", f"{config.port.url} at {config.port.baud} baud"),
        ("servos", servos),
        ("method", data.result.method),
        ("period", f"{config.experiment.period:g} s at {config.experiment.rate:g} Hz, seed {config.experiment.seed}"),
        ("machine", f"{record.machine}, Python {record.python}"),
        ("versions", ", ".join(f"{name} {version}" for name, version in record.versions.items())),
        ("run folder", data.run.path.name),
    ]
    rows += [_excitation(entry, data.names) for entry in record.excitation]
    folded = [Folded("Configuration", data.run.config_path.read_text(encoding="utf-8-sig"))]
    if data.events:
        start = data.events[0][0]
        lines = [f"{time - start:9.3f} s  {what}" for time, what in data.events]
        folded.append(Folded("Events", "\n".join(lines)))
    return Section("provenance", "How this was measured", (), (Table(("", ""), tuple(rows), 2),), folded=tuple(folded))


def _excitation(entry: Excitation, names: list[str]) -> tuple[str, str]:
    each = "; ".join(
        f"{name}: {len(found)} spectral lines, crest factor {factor:.2f}"
        for name, found, factor in zip(names, entry.lines, entry.crest_factor, strict=True)
    )
    return f"excitation, {entry.role.replace('_', ' ')}", each
