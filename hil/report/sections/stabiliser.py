"""Section on the stabiliser's contribution to the commanded torque."""

from hil.report.run_data import RunData
from hil.report.section import Section, Table
from hil.report.words import number


def stabiliser(data: RunData) -> Section | None:
    """The section; None if no stabiliser was used."""
    share = data.result.stabiliser
    if share is None:
        return None
    rows = [
        (name, number(rms, 3), number(peak, 3), number(whole, 3), f"{100 * part:.0f} %")
        for name, rms, peak, whole, part in zip(
            data.names, share.rms, share.peak, share.commanded_rms, share.share, strict=True
        )
    ]
    head = ("joint", "stabiliser RMS [N m]", "stabiliser peak [N m]", "total torque RMS [N m]", "share of RMS")
    words = (
        share.said(data.names),
        "The software spring and damper held the arm at its pose during the periods. The estimate uses the total "
        "commanded torque, including that of the spring and damper, and simulates both together with the arm.",
    )
    return Section("stabiliser", "Stabiliser", words, (Table(head, tuple(rows)),))
