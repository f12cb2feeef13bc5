"""Simulated servos at byte level: control tables, a half-duplex bus, and a simulated arm behind it."""

__all__ = ["allow_code", "register", "register_for"]


def register() -> None:
    """Register the pyserial URL `fake://PATH/TO/ARM.toml`; see `hil.fakes.protocol_fake`. Safe to call twice."""
    import serial

    if __name__ not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(__name__)


def register_for(url: str) -> None:
    """Call `register` if `url` is that of a fake arm; for a real arm, leave pyserial untouched."""
    if url.startswith("fake://"):
        register()


def allow_code(allowed: bool = True) -> None:
    """Set whether [fake] tables opened from now on may call functions of other packages through `plant`.

    See `hil.fakes.plants.plant` for why this is off by default.
    """
    from hil.fakes.plants.plant import allow_code as allow

    allow(allowed)
