"""Motors of the fake servos against the published figures, and those of the driver against the fakes'.

Source: ROBOTIS e-Manual, _data/dxl_x_info.yml (revision 0028038) and _includes/common/compatible_dxl/ (1d23b29,
bad242e) of ROBOTIS-GIT/emanual: stall current and no-load speed of each model at each published voltage.
"""

import math

import pytest

from hil.drivers.servo_model import SERVO_MODELS
from hil.fakes.servo.registers import MODEL_NAMES, load_model

XM430, XH430, XM540, XH540 = (2.1, 2.3, 2.7), (1.2, 1.3, 1.5), (4.2, 4.4, 5.5), (4.5, 4.9, 5.9)
X12, X11, X5 = (11.1, 12.0, 14.8), (9.0, 11.1, 12.0), (3.7, 5.0, 6.0)
PUBLISHED = {
    "XM430-W350": (X12, XM430, (43, 46, 57)),
    "XM430-W210": (X12, XM430, (70, 77, 95)),
    "XH430-W350": (X12, XH430, (27, 30, 37)),
    "XH430-W210": (X12, XH430, (46, 50, 62)),
    "XD430-T350": (X12, XH430, (27, 30, 37)),
    "XD430-T210": (X12, XH430, (46, 50, 62)),
    "XW430-T333": (X12, XH430, (29, 31, 39)),
    "XM540-W270": (X12, XM540, (28, 30, 37)),
    "XM540-W150": (X12, XM540, (50, 53, 66)),
    "XH540-W270": (X12, XH540, (36, 39, 46)),
    "XH540-W150": (X12, XH540, (66, 70, 86)),
    "XD540-T270": (X12, XH540, (36, 39, 46)),
    "XD540-T150": (X12, XH540, (66, 70, 86)),
    "XW540-T260": (X12, XH540, (37, 40, 48)),
    "XW540-T140": (X12, XH540, (67, 72, 88)),
    "XL330-M288": (X5, (1.11, 1.47, 1.74), (76, 103, 123)),
    "XL330-M077": (X5, (1.11, 1.47, 1.74), (278, 383, 456)),
    "XC330-M181": (X5, (1.34, 1.80, 2.15), (95, 129, 155)),
    "XC330-M288": (X5, (1.34, 1.80, 2.15), (59, 81, 97)),
    "XC330-T181": (X11, (0.61, 0.80, 0.88), (83, 104, 113)),
    "XC330-T288": (X11, (0.61, 0.80, 0.88), (52, 65, 71)),
    "XL430-W250": (X11, (1.0, 1.3, 1.4), (47, 57, 61)),
    "XC430-W150": (X11, (1.1, 1.3, 1.4), (80, 99, 106)),
    "XC430-W240": (X11, (1.1, 1.3, 1.4), (52, 65, 70)),
}
RPM = math.tau / 60


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_a_fake_motor_has_the_published_no_load_speed_and_stall_current(name: str) -> None:
    """At other voltages than the nominal one a motor without friction differs by a few percent from the figures."""
    model = load_model(name)
    volts, amperes, speeds = PUBLISHED[name]
    for volt, ampere, speed in zip(volts, amperes, speeds, strict=True):
        near = 0.03 if volt == model.nominal_voltage_v else 0.09
        assert volt / model.back_emf_v_s / RPM == pytest.approx(speed, rel=near)
        assert volt / model.resistance_ohm == pytest.approx(ampere, rel=near)


@pytest.mark.parametrize("name", SERVO_MODELS)
def test_driver_and_fake_agree_on_the_motor(name: str) -> None:
    fake, servo = load_model(name), SERVO_MODELS[name]
    volts, amperes, speeds = PUBLISHED[name]
    assert servo.no_load.voltage == fake.nominal_voltage_v
    assert servo.no_load.speed / RPM == pytest.approx(speeds[volts.index(servo.no_load.voltage)])
    assert [(stall.voltage, stall.current) for stall in servo.stalls] == list(zip(volts, amperes, strict=True))
    assert servo.back_emf == pytest.approx(fake.back_emf_v_s, rel=0.01)
    for stall in servo.stalls:
        # The torque of the fake motor at rest, with the torque constant that a configuration takes by default.
        torque = servo.torque_per_ampere.value * stall.voltage / fake.resistance_ohm
        assert torque == pytest.approx(stall.torque, rel=0.3 if name.startswith("XL330") else 0.15)


def test_every_model_with_facts_has_published_figures() -> None:
    assert set(PUBLISHED) == set(MODEL_NAMES)
