"""Mutation testing of the safety code: which small changes its tests do not detect.

    python benchmarks/safety/mutations.py [MODULE ...] [--json] [--every N]

Each mutation changes one operator, comparison, number or boolean of a module (except in strings, annotations and zip's
`strict`); the module's tests then run in a child process. Mutations that no test detects survive. A mutation that makes
a test hang counts as detected after `PATIENCE_S`. With NUMBA_DISABLE_JIT=1, compiled modules are tested as plain
Python, because compiling every mutation would be the slowest step; modules whose records are read by field name
(`checks`, `repetition`) need the compiler.
"""

import argparse
import ast
import copy
import importlib
import json
import os
import signal
import sys
import tempfile
import time
import types
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import hypothesis
import numba
import pytest

ROOT = Path(__file__).parents[2]
PATIENCE_S = 300

_EXPERIMENT = "tests/hil/experiment"
TESTS = {
    "hil/experiment/guard.py": [
        *(
            f"{_EXPERIMENT}/{name}"
            for name in ("test_guard.py", "test_guard_silence.py", "checks/test_joint_faults.py")
        ),
        *(f"{_EXPERIMENT}/{name}" for name in ("test_held_at_rest.py", "test_status_check.py", "checks/test_apart.py")),
        f"{_EXPERIMENT}/stops",
    ],
    "hil/experiment/command_limits.py": [f"{_EXPERIMENT}/test_command_limits.py", f"{_EXPERIMENT}/test_guard.py"],
    "hil/experiment/checks/joint_checks.py": [f"{_EXPERIMENT}/checks/test_work.py", f"{_EXPERIMENT}/test_guard.py"],
    "hil/experiment/checks/joint_faults.py": [
        f"{_EXPERIMENT}/checks/test_joint_faults.py",
        f"{_EXPERIMENT}/test_guard.py",
        f"{_EXPERIMENT}/stops",
    ],
    "hil/experiment/checks/current_noise.py": [
        *(f"{_EXPERIMENT}/checks/test_current_noise.py", f"{_EXPERIMENT}/checks/test_following.py"),
        f"{_EXPERIMENT}/test_guard.py",
    ],
    "hil/experiment/checks/work.py": [f"{_EXPERIMENT}/checks/test_work.py", f"{_EXPERIMENT}/test_guard.py"],
    "hil/experiment/checks/following.py": [f"{_EXPERIMENT}/checks/test_following.py"],
    "hil/experiment/checks/consistency.py": [
        *(f"{_EXPERIMENT}/checks/test_disagreement.py", f"{_EXPERIMENT}/checks/test_jumps_and_noise.py"),
        f"{_EXPERIMENT}/checks/test_consistency.py",
    ],
    "hil/experiment/status_check.py": [f"{_EXPERIMENT}/test_status_check.py"],
    "hil/experiment/repetition.py": [f"{_EXPERIMENT}/test_repetition.py"],
    "hil/experiment/deadlines.py": [f"{_EXPERIMENT}/test_deadlines.py"],
    "hil/experiment/silence.py": [
        *(f"{_EXPERIMENT}/{name}" for name in ("test_deadlines.py", "test_guard_silence.py", "test_guard.py"))
    ],
    "hil/experiment/stop_request.py": [f"{_EXPERIMENT}/test_stop_request.py"],
    "hil/plan/silence.py": [f"{_EXPERIMENT}/test_deadlines.py"],
    "hil/plan/brake.py": ["tests/hil/plan/test_brake.py"],
    "hil/drivers/preparation/cadence.py": ["tests/drivers/preparation/test_cadence.py"],
    "hil/experiment/stopping/pace.py": [f"{_EXPERIMENT}/stopping/test_{name}.py" for name in ("pace", "way_down")],
    "hil/experiment/stopping/way_down.py": [f"{_EXPERIMENT}/stopping/test_way_down.py"],
    "hil/experiment/stopping/position_steps.py": [f"{_EXPERIMENT}/stopping/test_position_steps.py"],
    "hil/plan/recent_motion.py": ["tests/hil/plan/test_recent_motion.py", "tests/hil/plan/test_brake.py"],
    "hil/experiment/pace.py": [f"{_EXPERIMENT}/stream/test_stream_schedule.py"],
    "hil/experiment/stream.py": [
        *(f"{_EXPERIMENT}/stream/test_stream_{name}.py" for name in ("schedule", "findings")),
        *(f"{_EXPERIMENT}/test_run.py", f"{_EXPERIMENT}/stops"),
    ],
    "hil/drivers/exchange.py": [
        *("tests/drivers/test_exchange_cycles.py", "tests/drivers/test_heard_instead.py"),
        *("tests/drivers/test_exchange.py", "tests/drivers/test_read_back_exchange.py"),
    ],
    "hil/drivers/read_back_exchange.py": [
        *("tests/drivers/test_read_back_exchange.py", "tests/drivers/test_exchange_cycles.py"),
        "tests/drivers/test_read_back.py",
    ],
    "hil/drivers/others/heard.py": [
        *("tests/drivers/test_heard_instead.py", "tests/drivers/test_exchange_cycles.py"),
        "tests/drivers/test_exchange.py",
    ],
    "hil/drivers/others/read_back.py": [
        *("tests/drivers/test_sightings.py", "tests/drivers/test_read_back_exchange.py"),
        "tests/drivers/test_read_back.py",
    ],
    "hil/drivers/torque/switch.py": [
        *(f"tests/drivers/torque/test_{name}.py" for name in ("switch", "switch_times", "reports")),
        "tests/drivers/test_bus.py",
    ],
    "hil/drivers/torque/off.py": [
        *("tests/drivers/torque/test_off.py", "tests/drivers/torque/test_answers_again.py"),
        "tests/drivers/test_bus.py",
    ],
    "hil/estimator/models/standstill.py": ["tests/estimator/models/test_standstill.py"],
    "hil/experiment/chain_watch.py": [f"{_EXPERIMENT}/test_chain_watch.py"],
    "hil/runs/recording.py": ["tests/hil/runs/test_recording.py"],
}
"""Modules, and the tests that should detect mutations."""

EQUIVALENT = {
    ("nogil=True", "True  ->  False"): "compiled code does not hold the interpreter's lock: only other threads notice",
    ("FINE = -1", "1  ->  2"): "joint_checks: any negative number",
    ("    align=True,", "True  ->  False"): "joint_checks: where the fields lie in memory",
    ("self._sample = np.zeros((4,", "4  ->  8"): "joint_checks: more rows than are used",
    (
        "_look(joints, self._sample, 0, 0, 0.0, 0.0,",
        "0  ->  1",
    ): "joint_checks: compiled by a call for none of the joints",
    ("_look(joints, self._sample, 0, 0, 0.0, 0.0,", "0.0  ->  1.0"): "joint_checks: as above",
    (
        "* copysign(1.0, lacking)",
        "self._constants[index] * (goal - carried) * copysign(1.0, lacking)  ->  "
        "self._constants[index] * (goal - carried) / copysign(1.0, lacking)",
    ): "joint_faults: 1 or -1",
    ("abs(currents[0]) > least", "0  ->  1"): "joint_faults: all of them are the same",
    ("_add(slow, SLOW_S, moved, memory.seen", "0.0  ->  1.0"): "consistency: the next line replaces what it adds up",
    ("notes = np.ceil(LAG_S / same.since", "0.05  ->  0.1"): "consistency: at a few rates, 27 ms then count as 30 ms",
    ("return -1.0", "1.0  ->  2.0"): "work, following: any negative number",
    ("_OF_OTHERS * others else -1.0", "1.0  ->  2.0"): "work: any negative number",
    ("count & (count - 1) == 0", "1  ->  2"): "current_noise: the same for every count from 2 on",
    ("@dataclass(frozen=True)", "True  ->  False"): "nothing tries to change it",
    (
        "_add(self._former, self._sums",
        "0  ->  1",
    ): "repetition: compiled by a call without positions, which changes nothing",
    ("_add(self._former, self._sums", "False  ->  True"): "repetition: as above",
    ("_add(self._former, self._sums", "True  ->  False"): "repetition: as above",
    ("if -limit <= goal <= limit", "-limit  ->  +limit"): "command_limits: only takes the way that is slower",
    ("if -limit <= goal <= limit", "-slew  ->  +slew"): "command_limits: only takes the way that is slower",
    ("len(self._plans[0].read.request)", "0  ->  1"): "exchange: the requests for all spans have the same length",
    ("rest[_SEEN] = angle, 1.0", "1.0  ->  2.0"): "standstill: any positive number",
    ("up, down = (beyond", "distance > 0.0  ->  distance <= 0.0"): "standstill: the two sides swap their names",
    ("ARMS = 96", "96  ->  192"): "chain_watch: the size of the ensemble, of which only mean and covariance are used",
    ("towards = ", "self._was_above * 1.0  ->  self._was_above / 1.0"): "chain_watch: the same number",
    ("towards = ", "self._was_below * 1.0  ->  self._was_below / 1.0"): "chain_watch: the same number",
    (
        "approach, before = velocity * towards",
        "velocity * towards  ->  velocity / towards",
    ): "chain_watch: it is 1, -1 or, for joints that no end stop can block, 0",
    (
        "approach, before = velocity * towards",
        "self._velocity * towards  ->  self._velocity / towards",
    ): "chain_watch: as above",
    (
        "may_lie = ",
        "torque * self._falls_to  ->  torque / self._falls_to",
    ): "chain_watch: it is 1, -1 or 0",
    ("self._seen_at = 0.0", "0.0  ->  1.0"): "chain_watch: not used before the first sample",
    (
        "self._was_irregular = False",
        "False  ->  True",
    ): "guard: after a regular exchange, one more is processed like an irregular one",
    (
        "np.load(path, allow_pickle=False, mmap_mode",
        "False  ->  True",
    ): "recording: no pickle can be mapped into memory",
    ("if volt > 0.0 and", "0.0  ->  1.0"): "guard: no servo runs on 1 V",
    ("self._deadline = self._sent_at = self._heard_at = 0.0", "0.0  ->  1.0"): "way_down: set when lowering begins",
    ("if longer != 0.0", "0.0  ->  1.0"): "way_down: then 0 s longer is set, too",
    ("for _ in range(0, self._plan.end_samples", "0  ->  1"): "stream: a multiple of the window has as many steps",
    ("ticks.wait() if number else", "0.0  ->  1.0"): "stream: a value that is not used",
    ("abs(travels[-1].moved)", "-1  ->  +1"): "recent_motion: the last of two",
    ("self._states: deque[State]", "3  ->  6"): "recent_motion: more exchanges are kept than are used",
    ("low = max((each.low", "0.0  ->  1.0"): "recent_motion: without any travel, the upper end is 0 as well",
    (
        "waited = 0.0 if self._asked_at is None",
        "0.0  ->  1.0",
    ): "silence: a reply is missing only if it has been asked for",
    ("_NEVER = ", "62  ->  124"): "exchange: more cycles than any run has",
    ("AFTER_LOSS = 5", "5  ->  10"): "exchange: replies that are late by more cycles are recognised as well",
    (
        "self._goals_since = 0",
        "0  ->  1",
    ): "read_back: the first read-back, which is of modes, sets it",
    ("if not answer or answer[0] or", "0  ->  1"): "read_back: the faster of two ways is hardly ever taken",
    ("if not answer or answer[0] or", "2  ->  4"): "read_back: the faster of two ways is never taken",
    (
        "plan = self._usual if left >= 0",
        "0  ->  1",
    ): "exchange: which registers are due is asked a cycle early, and none are",
    ("self.fields += [ids[place]", "0  ->  1"): "exchange: a goal takes its place before it is sent",
    ("REMEMBERED = 128", "128  ->  256"): "exchange: older goals are hardly ever held",
    ("_LONGEST_REPLY = ", "1024  ->  2048"): "exchange: longer than any reply",
    ("self._looks = [0]", "0  ->  1"): "read_back: only differences of these counts matter",
    ("self.place = (", "self.place + 1  ->  self.place - 1"): "read_back: the servos take turns in either order",
    ("self._cycles = 0", "0  ->  1"): "status_check: of the goals sent before the first agreement, one more is known",
    ("self._agreed_at = [0]", "0  ->  1"): "status_check: of the goals sent before the first agreement, all are known",
    (
        "self._clock = [",
        "0.0  ->  1.0",
    ): "status_check: a clock's offset and its time, not used before the first reading",
}
"""Mutations that have no effect the tests could detect: part of the line and the mutation, with the reason."""

_SLOW_IMPORTS = (
    *("numpy", "scipy", "numba", "pydantic", "serial", "hil.estimator.identify"),
    *("hil.estimation.settled_estimate", "hil.dry_run.ensemble", "hil.plan.chain_plan"),
)
"""Modules that are imported once, before the child processes are forked; they import few of the modules under test."""

Change = Callable[[], None]

_COMPARE = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_OPERATE = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitAnd: ast.BitOr}


def mutants(source: str) -> Iterator[tuple[int, str, str]]:
    """Yield each mutation: line, description, and mutated source."""
    tree = ast.parse(source)
    count = sum(1 for _ in _spots(tree))
    for number in range(count):
        changed = copy.deepcopy(tree)
        node, change = list(_spots(changed))[number]
        line = node.lineno
        before = ast.unparse(node)
        change()
        yield line, f"{before}  ->  {ast.unparse(node)}", ast.unparse(ast.fix_missing_locations(changed))


def _spots(tree: ast.AST) -> Iterator[tuple[ast.expr, Change]]:
    """Yield every node that can be changed, with a function that changes it."""
    silent = set(_of_messages(tree))
    for node in ast.walk(tree):
        if node in silent:
            continue
        if isinstance(node, ast.Compare):
            for index, operator in enumerate(node.ops):
                if type(operator) in _COMPARE:
                    yield node, _set(node.ops, index, _COMPARE[type(operator)]())
        elif isinstance(node, ast.BinOp) and type(node.op) in _OPERATE:
            yield node, partial(setattr, node, "op", _OPERATE[type(node.op)]())
        elif isinstance(node, ast.BoolOp):
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield node, partial(setattr, node, "op", other)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            yield node, partial(setattr, node, "op", ast.UAdd())
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            yield node, partial(setattr, node, "value", _other(node.value))


def _set(ops: list[ast.cmpop], index: int, operator: ast.cmpop) -> Change:
    return lambda: ops.__setitem__(index, operator)


def _other(value: float | bool) -> float | bool:
    if isinstance(value, bool):
        return not value
    return value + 1 if value == 0 else 2 * value


def _of_messages(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield nodes in formatted strings and annotations, which are not mutated."""
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr | ast.AnnAssign):
            yield from ast.walk(node if isinstance(node, ast.JoinedStr) else node.annotation)
        elif isinstance(node, ast.keyword) and node.arg == "strict":
            yield node.value
        elif isinstance(node, ast.FunctionDef):
            for part in (node.returns, *(argument.annotation for argument in node.args.args)):
                if part is not None:
                    yield from ast.walk(part)


def survivors(module: str, every: int) -> tuple[int, list[str]]:
    """Number of mutations tried, and descriptions of those that survived although they are not `EQUIVALENT`."""
    source = (ROOT / module).read_text(encoding="utf-8")
    tried, left = 0, []
    with tempfile.TemporaryDirectory() as cache:
        if not _passes(module, source, cache):
            raise SystemExit(f"The tests of {module} fail without any mutation.")
        for number, (line, what, changed) in enumerate(mutants(source)):
            if number % every:
                continue
            tried += 1
            if _passes(module, changed, cache) and not _is_equivalent(source.splitlines()[line - 1], what):
                left.append(f"{module}:{line}: {what}")
    return tried, left


def _is_equivalent(line: str, what: str) -> bool:
    return any(part in line and change == what for part, change in EQUIVALENT)


def _passes(module: str, source: str, cache: str) -> bool:
    """Return whether the module's tests pass with this source; they run in a forked child with all libraries loaded.

    cache: folder of compiled code that is reused unless the module itself is compiled; compiling takes longest.
    """
    sys.stdout.flush()
    child = os.fork()
    if not child:
        _test_in_child(module, source, cache)
    until = time.monotonic() + PATIENCE_S
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status) == 0
        if time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return False
        time.sleep(0.02)


def _test_in_child(module: str, source: str, cache: str) -> None:
    code = 1
    try:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        name = module.removesuffix(".py").replace("/", ".")
        if name in sys.modules:
            # It was imported beforehand: modules that took names from it are imported again.
            for loaded in [each for each in sys.modules if each == "hil" or each.startswith("hil.")]:
                del sys.modules[loaded]
        mutated = types.ModuleType(name)
        mutated.__file__ = str(ROOT / module)
        sys.modules[name] = mutated
        parent, _, leaf = name.rpartition(".")
        setattr(importlib.import_module(parent), leaf, mutated)  # tests patch it by its dotted name
        exec(compile(source, module, "exec"), mutated.__dict__)
        is_compiled = "numba" in source or "estimator.compiled" in source
        with tempfile.TemporaryDirectory() as fresh:
            # Code compiled earlier, without this mutation, must not be reused.
            vars(numba.config)["CACHE_DIR"] = fresh if is_compiled else cache
            code = int(pytest.main(["-q", "-x", "-n", "0", "-p", "no:cacheprovider", *TESTS[module]]))
    except BaseException:
        code = 1
    finally:
        os._exit(code)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=list(TESTS))
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--every", type=int, default=1, help="try only every N-th mutation")
    options = parser.parse_args()
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    for library in _SLOW_IMPORTS:
        importlib.import_module(library)
    hypothesis.settings.register_profile("mutations", database=None, derandomize=True)
    hypothesis.settings.load_profile("mutations")
    told = {}
    for module in options.modules:
        tried, left = survivors(module, options.every)
        told[module] = {"tried": tried, "survived": len(left), "which": left}
        if not options.json:
            print(f"{module:36s} {tried:4d} tried, {len(left):3d} survived", *left, sep="\n    ", flush=True)
    if options.json:
        print(json.dumps(told))


if __name__ == "__main__":
    main()
