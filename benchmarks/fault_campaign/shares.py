"""A share of the campaign: some injections of one configuration, for one worker."""

from concurrent.futures import ProcessPoolExecutor

from benchmarks.fault_campaign.arms import Setting
from benchmarks.fault_campaign.campaign import DoesNotRun, Outcome, inject, prepare

Part = tuple[Setting, int, int, float]


def in_this_process(part: Part) -> tuple[list[Outcome], str]:
    return _all_of(*part)


def in_own_process(part: Part) -> tuple[list[Outcome], str]:
    """Run this share in a new process: injected signals need the main thread, which Dask occupies in its workers."""
    with ProcessPoolExecutor(1) as process:
        return process.submit(_all_of, *part).result()


def _all_of(setting: Setting, count: int, first: int, period: float) -> tuple[list[Outcome], str]:
    try:
        prepare(setting, period)
    except DoesNotRun as why:
        return [], str(why)
    return [inject(setting, seed, period) for seed in range(first, first + count)], ""
