"""Random bytes and mutated packets on the fake bus: it must not raise or hang, and must answer the next valid packet.

    python benchmarks/bus/fake_noise.py [--json] [--packets N] [--seed N]

Every tenth piece of noise is followed by a pause long enough for a reboot or a long reply to end. A servo is then
pinged at its current ID and baud rate, which the noise may have changed.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from random import Random

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.machine import machine
from hil.drivers.packet import BROADCAST_ID, Framer, Instruction, encode
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import EmulatedServo

ASK_EVERY = 10
PAUSE_S = 3.0  # longer than a reboot or the longest reply at the lowest baud rate
IDS = (1, 2, 7, BROADCAST_ID)


class Still:
    """Two joints that never move."""

    joints = 2
    position = velocity = current = (0.0, 0.0)

    def advance(self, until: float, current: object) -> None:
        pass


class NoiseRun:
    """A bus of two servos that receives noise. `asked`, `answered`: numbers of pings sent in between and of replies."""

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)
        self.clock = VirtualClock()
        self.servos = [
            EmulatedServo(load_model(name), number) for number, name in ((1, "XM430-W350"), (2, "XL330-M288"))
        ]
        self.bus = FakeBus(self.servos, Still(), self.clock)
        self.sent = self.asked = self.answered = 0

    def run(self, packets: int) -> None:
        """Send this many pieces of noise."""
        while self.sent < packets:
            self.bus.write(self._piece())
            self.bus.read(4096, 0.0005)
            self.sent += 1
            if self.sent % ASK_EVERY == 0:
                self._ask()

    def _piece(self) -> bytes:
        random = self.random
        kind = random.randrange(4)
        if kind == 0:
            return random.randbytes(random.randrange(40))
        if kind == 1:  # mostly header bytes
            return bytes(random.choices((0xFF, 0xFD, 0x00, 0x01, 0xFE, 0x03, 0x55, 0x82), k=random.randrange(40)))
        instruction = random.choice(list(Instruction)) if random.random() < 0.8 else random.randrange(256)
        body = random.randbytes(random.randrange(20))
        if random.random() < 0.5:
            body = random.randrange(700).to_bytes(2, "little") + body
        packet = bytearray(encode(random.choice(IDS), instruction, body))
        if kind == 3:
            for _ in range(random.randrange(1, 4)):
                self._mutate(packet)
        return bytes(packet)

    def _mutate(self, packet: bytearray) -> None:
        random = self.random
        if not packet:
            return
        at = random.randrange(len(packet))
        match random.randrange(4):
            case 0:
                packet[at] ^= 1 << random.randrange(8)
            case 1:
                del packet[at]
            case 2:
                packet.insert(at, random.randrange(256))
            case 3:
                del packet[at + 1 :]

    def _ask(self) -> None:
        """Ping a servo at its current ID and baud rate; servos with the same ID are given different ones first."""
        for number, servo in enumerate(self.servos, start=1):
            if servo.id == self.servos[2 - number].id:
                servo.memory.set("ID", number)
                servo.write(*_LED)
        self.clock.wait_until(self.clock.now() + PAUSE_S)
        self.bus.read(100_000, 0.0)
        servo = self.random.choice(self.servos)
        self.bus.baud = servo.baud
        self.bus.write(encode(servo.id, Instruction.PING))
        replies = list(Framer().feed(self.bus.read(1000, 0.1)))
        self.asked += 1
        self.answered += [reply.id for reply in replies] == [servo.id]


_LED = (65, b"\x00")  # any write makes a servo apply the contents of its control table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--packets", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    started = time.perf_counter()
    noise = NoiseRun(options.seed)
    noise.run(options.packets)
    seconds = time.perf_counter() - started
    figures = {"packets": noise.sent, "asked": noise.asked, "answered": noise.answered, "seconds": round(seconds, 1)}
    if options.json:
        print(json.dumps(figures))
        return
    print(machine())
    print(f"{noise.sent} pieces of noise in {seconds:.0f} s, no exception; {noise.answered} of {noise.asked} answered")


if __name__ == "__main__":
    main()
