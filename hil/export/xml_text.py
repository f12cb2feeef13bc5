"""Helpers shared by URDF and MJCF export: numbers without loss of precision, comments, and the comment header."""

from xml.etree import ElementTree as ET

from hil import __version__
from hil.arm_model import ArmModel


def numbers(*values: float) -> str:
    """Format numbers as the text of an XML attribute, without loss of precision."""
    return " ".join(repr(float(value)) for value in values)


def comment(parent: ET.Element, text: str) -> None:
    """Append a comment; XML comments cannot contain a double hyphen."""
    parent.append(ET.Comment(f" {text.replace('--', '- -')} "))


def describe(root: ET.Element, model: ArmModel, left: list[str]) -> None:
    """Add comments at the top of the file about its origin and what it cannot represent."""
    comment(
        root,
        f"Written by hil {__version__} from an identified arm. Joint 1 is measured from the horizontal.",
    )
    comment(root, "One of many dynamically equivalent mass distributions; only their base parameters were identified:")
    for name, value in model.values.items():
        comment(root, f"{name} = {value!r} +- {model.stds[name]:.1e}")
    if not all(joint.has_limits for joint in model.joints):
        comment(root, "This file has no joint or drive limits, because the recording does not contain them.")
    for sentence in left:
        comment(root, f"Not representable in this format: {sentence}")


def axis(model: ArmModel) -> str:
    """The joint axis: normal to the vertical x-z plane, or vertical for a horizontal arm."""
    return "0 -1 0" if model.gravity else "0 0 1"


def to_text(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
