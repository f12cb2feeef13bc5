from hil.fakes.bus.clock import VirtualClock


def test_waiting_jumps_and_never_goes_back() -> None:
    clock = VirtualClock()
    clock.wait_until(3600.0)
    assert clock.now() == 3600.0
    clock.wait_until(1.0)
    assert clock.now() == 3600.0
