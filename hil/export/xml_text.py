"""The little that URDF and MJCF share: numbers that read back exactly, comments, the file's head."""

from xml.etree import ElementTree as ET

from hil import __version__
from hil.arm_model import ArmModel


def numbers(*values: float) -> str:
    """Numbers as an attribute, each to its last digit."""
    return " ".join(repr(float(value)) for value in values)


def comment(parent: ET.Element, text: str) -> None:
    """Append a comment; XML allows no double hyphen in one."""
    parent.append(ET.Comment(f" {text.replace('--', '- -')} "))


def describe(root: ET.Element, model: ArmModel, left: list[str]) -> None:
    """Say at the head of the file where it comes from and what it lacks."""
    comment(
        root, f"Written by hil {__version__} from an identified arm. Angles are hil's: joint 1 from the horizontal."
    )
    comment(root, "One of many mass distributions that move alike; only their base parameters were measured:")
    for name, value in model.values.items():
        comment(root, f"{name} = {value!r} +- {model.stds[name]:.1e}")
    for sentence in left:
        comment(root, f"Not representable in this format: {sentence}")


def axis(model: ArmModel) -> str:
    """The joints' axis: across the vertical x-z plane, or upright for an arm in a horizontal plane."""
    return "0 -1 0" if model.gravity else "0 0 1"


def to_text(root: ET.Element) -> str:
    """The document."""
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
