"""Changes to the text of a configuration."""

FEWER_SAMPLES = (("rate = 400.0 ", "rate = 200.0 "), ("ramp = 1.0 ", "ramp = 0.5 "))
"""Changes that halve the number of samples, to which the processor time of a fake arm is proportional."""

WITHOUT_HELD_OUT = (FEWER_SAMPLES[0], ("ramp = 1.0 ", "held_out = false\nramp = 0.5 "))
"""The same without held-out data: a quarter of the samples."""

QUICK = (
    FEWER_SAMPLES[0],
    ("period = 2.0 ", "period = 1.0 "),
    ("band = [0.5, 6.0]", "band = [1.0, 6.0]"),
    ("ramp = 1.0 ", "held_out = false\nramp = 0.3 "),
)
"""The same with half the period: an eighth of the samples."""


QUICK_WITH_HELD_OUT = (*QUICK[:3], ("ramp = 1.0 ", "ramp = 0.3 "))
"""As `QUICK`, with held-out data: a quarter of the samples."""


def replaced(text: str, *changes: tuple[str, str]) -> str:
    """The text with the first occurrence of each old string replaced by the new one; each must occur."""
    for old, new in changes:
        assert old in text, f"{old!r} is not in the text"
        text = text.replace(old, new, 1)
    return text


def with_second_servo(text: str, zero_ticks: int = 1000) -> str:
    """The text of a fake arm with a second, mirrored servo on its first joint: ID 3."""
    joints, fake = text.split("[fake]", 1)
    joints = replaced(joints, ("id = 1\n", "id = [1, 3]\n"), ("direction = 1 ", "direction = [1, -1] #"))
    second = f'id = 3\nmodel = "XM430-W350"\njoint = 1\ndirection = -1\nzero_ticks = {zero_ticks}\n'
    return f"{joints}[fake]{fake}\n[[fake.servos]]\n{second}"
