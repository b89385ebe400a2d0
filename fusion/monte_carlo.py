"""The same function over many seeds: on one core, on all of them, or on a cluster, with the same results."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from distributed import Client

Result = TypeVar("Result")


def simulate_runs(
    function: Callable[[int], Result], seeds: Iterable[int], workers: int = 1, client: Client | None = None
) -> list[Result]:
    """Return function(seed) for each seed, in the order of the seeds.

    workers: processes on this machine, -1 for one per core; client: a dask.distributed client to use instead.
    The function takes all its randomness from the seed, so that the results do not depend on who computed them.
    """
    seeds = list(seeds)
    if client is not None:
        return list(client.gather(client.map(function, seeds, pure=False)))  # type: ignore[no-untyped-call]
    if workers == 1:
        return [function(seed) for seed in seeds]
    from joblib import Parallel, delayed, parallel_config

    with parallel_config("loky", n_jobs=workers, inner_max_num_threads=1):
        return list(Parallel()(delayed(function)(seed) for seed in seeds))
