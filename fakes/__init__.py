"""Simulated servos at byte level: control tables, a half-duplex bus, and a simulated arm behind it."""


def register() -> None:
    """Register with pyserial the URL `fake://PATH/TO/ARM.toml`; see `hil.fakes.protocol_fake`. Harmless when repeated."""
    import serial

    if __name__ not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(__name__)


def register_for(url: str) -> None:
    """`register` if `url` is one of a fake; for a real arm pyserial is left untouched."""
    if url.startswith("fake://"):
        register()


def allow_code(allowed: bool = True) -> None:
    """Let the [fake] tables opened from now on run functions of other packages as their `plant`; see there."""
    from hil.fakes.plants.plant import allow_code as allow

    allow(allowed)
