"""Advice on finding a safe peak torque, for messages."""

from hil.config.schema import Config


def how_to_find_torque(config: Config) -> str:
    """Advice on finding a safe value of experiment.peak_torque for this arm."""
    if config.is_chain or config.arm.link_lengths is not None:
        return "`hil dry-run` finds a safe value."
    return (
        "`hil dry-run` finds a safe value, but it needs the length of each link: measure with a ruler from joint to "
        "joint, and from the last joint to the tip; then set arm.link_lengths = [...] in m."
    )
