"""Events and callbacks run in threads, so that blocking ones cannot delay the program."""

import json
import os
import threading
import time
from pathlib import Path

from hil.config.schema import load_config
from hil.runs.background import Background
from hil.runs.event_log import LATE_NAME, EventLog
from hil.runs.run_folder import RunFolder
from tests.support.paths import CONFIGS


def make_run(folder: Path) -> RunFolder:
    return RunFolder.create(folder / "run", load_config(CONFIGS / "fake_two_link.toml"))


def lines(path: Path) -> list[str]:
    return [json.loads(line)["event"] for line in path.read_text(encoding="utf-8").splitlines()]


def test_all_is_done_in_order_and_nothing_is_left() -> None:
    done: list[int] = []
    work = Background(done.append, 1000)
    for number in range(500):
        work.put(number)
    assert work.close(5.0) == [] and done == list(range(500)) and work.dropped == 0


def test_what_finds_the_queue_full_is_dropped_and_counted_and_what_is_stuck_is_given_back() -> None:
    free = threading.Event()
    begun = threading.Event()

    def act(_: int) -> None:
        begun.set()
        free.wait()

    work = Background(act, 3)
    work.put(0)
    assert begun.wait(5.0)
    for number in range(1, 10):
        work.put(number)
    assert work.dropped == 6
    assert work.close(0.05) == [0, 1, 2, 3]
    free.set()


def test_an_exception_is_kept_and_the_next_item_is_tried() -> None:
    done: list[int] = []

    def act(number: int) -> None:
        if number == 1:
            raise OSError("disk")
        done.append(number)

    work = Background(act, 10)
    for number in range(3):
        work.put(number)
    work.close(5.0)
    assert done == [0, 2] and str(work.failure) == "disk"


def test_after_it_was_abandoned_nothing_more_is_done() -> None:
    free, done = threading.Event(), []

    def act(number: int) -> None:
        free.wait()
        done.append(number)

    work = Background(act, 10)
    work.put(1)
    work.put(2)
    assert work.close(0.05) == [1, 2]
    free.set()
    work._thread.join(5.0)
    assert done == [1], "what was in progress ends; what was returned belongs to the caller"


def test_events_are_on_file_when_the_log_is_left(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    with EventLog(run) as log:
        for number in range(50):
            log.note(float(number), f"event {number}")
    assert lines(run.path / "events.jsonl") == [f"event {number}" for number in range(50)]
    assert not (run.path / LATE_NAME).exists()


def test_an_events_file_that_blocks_holds_up_nobody_and_the_last_line_is_on_file(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    os.mkfifo(run.path / "events.jsonl")  # without a reader, opening it blocks indefinitely
    with EventLog(run) as log:
        started = time.process_time()
        for number in range(2000):
            log.note(0.0, f"event {number}")
        assert time.process_time() - started < 2.0
    late = lines(run.path / LATE_NAME)
    assert late[0] == "event 0" and late[-1].endswith("events were dropped: the disk could not keep up")


def test_a_full_disk_is_no_reason_to_stop(tmp_path: Path, monkeypatch: object) -> None:
    run = make_run(tmp_path)
    (run.path / "events.jsonl").mkdir()  # a folder cannot be appended to
    with EventLog(run) as log:
        log.note(0.0, "torque is off")
    assert log.failure is not None
