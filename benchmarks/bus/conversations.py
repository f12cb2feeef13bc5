"""Random byte-level conversations with fake servos of every X model; every answer is compared with the manual.

    python benchmarks/bus/conversations.py [--conversations N] [--seed S] [--json]

The host is `conversation` with `codec`; the expected answers come from `servo_rules`. None of these uses the fake's own
code. A conversation takes place in virtual time and has one to four servos with random models, IDs, firmware, Return
Delay Time and Status Return Level. It consists of 10 to 30 random actions of the host: single, broadcast and group
instructions, registered writes, resets, Clear, backups, Secondary IDs, changes of ID and baud rate, stuffed packets,
and packets that are damaged, cut short, undefined or preceded by noise.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.bus.conversation.groups import Conversation
from benchmarks.machine import machine

KINDS: tuple[tuple[int, Callable[[Conversation], None]], ...] = (
    (3, Conversation.ping),
    (2, Conversation.ping_all),
    (4, Conversation.read),
    (1, Conversation.read_undefined),
    (2, Conversation.read_span),
    (1, Conversation.malformed),
    (2, Conversation.goal_position),
    (1, Conversation.watchdog),
    (1, Conversation.alarm),
    (8, Conversation.write),
    (3, Conversation.write_wrongly),
    (4, Conversation.torque),
    (4, Conversation.reg_write),
    (3, Conversation.action),
    (1, Conversation.action_all),
    (1, Conversation.reboot),
    (1, Conversation.factory_reset),
    (1, Conversation.factory_reset_all),
    (1, Conversation.clear),
    (2, Conversation.back_up),
    (2, Conversation.level),
    (1, Conversation.delay),
    (1, Conversation.rename),
    (1, Conversation.other_rate),
    (2, Conversation.secondary),
    (5, Conversation.group_read),
    (4, Conversation.group_write),
    (1, Conversation.write_all),
    (1, Conversation.read_all),
    (2, Conversation.stuffing),
    (2, Conversation.damaged),
    (1, Conversation.cut_short),
    (1, Conversation.noise),
    (1, Conversation.nonsense),
)


def converse(seed: int, models: Iterable[str] = (), most: int = 30) -> Conversation:
    """Hold one conversation of at most `most` instructions; stop at the first difference."""
    talk = Conversation(seed, models)
    weights, kinds = [weight for weight, _ in KINDS], [kind for _, kind in KINDS]
    for _ in range(talk.random.randint(10, most)):
        talk.random.choices(kinds, weights)[0](talk)
        if talk.differences:
            break
    return talk


def main() -> None:
    """Hold the conversations and print the differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    chosen = parser.parse_args()
    kinds: Counter[str] = Counter()
    models: Counter[str] = Counter()
    wrong = 0
    for seed in range(chosen.seed, chosen.seed + chosen.conversations):
        talk = converse(seed)
        kinds += talk.kinds
        models.update(servo.model for servo in talk.servos)
        wrong += bool(talk.differences)
        for difference in talk.differences:
            print(f"seed {seed}: {difference}", file=sys.stderr if chosen.json else sys.stdout)
    if chosen.json:
        figures = {
            "conversations": chosen.conversations,
            "differ": wrong,
            "packets": dict(kinds),
            "models": dict(models),
        }
        print(json.dumps(figures | {"models": dict(models), "machine": machine()}))
    else:
        print(f"{wrong} of {chosen.conversations} conversations differ; {sum(kinds.values())} packets: {dict(kinds)}")
        print(f"models: {dict(models)}")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
