"""Bundled configurations adapted for a campaign: other rates, short periods, and a fake arm if they have none."""

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

CONFIGS = Path(__file__).parents[2] / "configs"
RATES = (20, 100, 400, 1000)
PERIOD_S = 2.0
SCHEME = "campaign://"

MIXED = "xl430_and_xl330"
"""An arm that is in no file: one joint is voltage-driven and has no Goal Current register; the other is current-driven.
"""

_MIXED_FROM = ("xl430_two_link", "xl330_two_link")
"""The files from which the joints of `MIXED` are taken, in this order."""

_DONOR = "fake_two_link"
_DONOR_TORQUE = 0.312  # N m, peak torque of joint 1 in xm430_two_link.toml, an arm like the donor's
_FAST_BAUD = 4_000_000  # 1 kHz does not fit on a wire of 1 Mbaud


@dataclass(frozen=True)
class Setting:
    """One bundled configuration, or `MIXED`, at one rate [Hz]."""

    name: str
    rate: int


def names() -> list[str]:
    """The bundled configurations of planar arms, by file name; spatial arms are left out, since cutting torque would
    drop them.
    """
    return sorted(path.stem for path in CONFIGS.glob("*.toml") if "urdf = " not in path.read_text(encoding="utf-8"))


def settings() -> list[Setting]:
    """Every bundled configuration and the mixed arm at every rate."""
    return [Setting(name, rate) for name in [*names(), MIXED] for rate in RATES]


def make_document(setting: Setting, period: float = PERIOD_S) -> dict[str, Any]:
    """The configuration as a document, with this rate and with multisines of `period` [s] that soon count as settled.

    Only the experiment is shortened; limits, torques, models and safety settings are unchanged.
    """
    document = _load(setting.name)
    experiment: dict[str, Any] = document["experiment"]
    if experiment.pop("pilot", False):
        # A pilot's steps are ordinary runs, but finding their torques takes as long as hundreds of injections.
        experiment["peak_torque"] = _load(_DONOR)["experiment"]["peak_torque"]
    experiment.pop("lines", None)
    experiment.pop("design", None)
    experiment |= {
        "rate": float(setting.rate),
        "period": period,
        "band": [1.0 / period, min(5.0, setting.rate / 4 - 0.05)],
        "ramp": 0.3,
        "rest": 0.2,
        "periods": 1,
        "settle_within": 0.9,
        "held_out": False,
    }
    if "fake" not in document:
        document["fake"] = _fake_arm(document)
    baud = _FAST_BAUD if setting.rate >= RATES[-1] else document["port"].get("baud", 1_000_000)
    document["port"] |= {"url": f"{SCHEME}arm", "baud": baud}
    for servo in document["fake"]["servos"]:
        servo["baud"] = baud
    return document


def dump(document: dict[str, Any]) -> str:
    """Format the document as TOML; tables below the first level are written inline."""
    lines = []
    for key, value in document.items():
        if isinstance(value, dict):
            lines += [f"\n[{key}]", *(f"{name} = {_inline(each)}" for name, each in value.items())]
        else:
            lines.insert(0, f"{key} = {_inline(value)}")
    return "\n".join(lines) + "\n"


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{name} = {_inline(each)}" for name, each in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return json.dumps(value) if isinstance(value, str | bool | int) else repr(value)


def _load(name: str) -> dict[str, Any]:
    if name == MIXED:
        document, other = map(_load, _MIXED_FROM)
        document["joints"][1] = other["joints"][1]
        return document
    return tomllib.loads((CONFIGS / f"{name}.toml").read_text(encoding="utf-8"))


def _fake_arm(document: dict[str, Any]) -> dict[str, Any]:
    """A fake arm for a configuration of real servos: the fake arm of `_DONOR`, scaled to the configured torques."""
    arm = _load(_DONOR)["fake"]["arm"]
    share = document["experiment"]["peak_torque"][0] / _DONOR_TORQUE
    for link in arm["links"]:
        link["mass"] *= share
        link["inertia"] *= share
    for drive, joint in zip(arm["drives"], document["joints"], strict=True):
        for key in ("mass", "rotor_inertia", "viscous", "coulomb", "offset"):
            drive[key] *= share
        # A voltage-driven motor is emulated by resistance and back-EMF, a current-driven one by this constant.
        drive["torque_constant"] = joint.get("torque_constant", 1.8)
    arm["start"] = document["arm"]["rest_pose"]
    servos = [
        {"id": joint["id"], "model": joint["model"], "zero_ticks": joint["zero_ticks"], "direction": joint["direction"]}
        for joint in document["joints"]
    ]
    return {"seed": 1, "adapter_latency_us": 60.0, "servos": servos, "arm": arm}
