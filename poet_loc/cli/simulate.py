"""poet-loc simulate: one simulated log, or the errors of the estimators over many."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from fusion.monte_carlo import simulate_runs
from fusion.simulate import SimulationOptions, simulate
from fusion.simulation_options import refuse_unread as refuse_unread_by_simulation
from landmarks.options import Mode
from poet_loc.cli.arguments import Flat, refuse_overwrite_without
from poet_loc.cli.estimates import FUSIONS, Fusion, StageOptions, estimate_log, refuse_one_estimator
from poet_loc.cli.terminal import Silent, print_tables
from poet_loc.cli.unread import refuse_unread
from poet_loc.core.input_error import InputError, processes
from poet_loc.io.log_folder import write_log
from poet_loc.io.whole_folder import whole_folder
from poet_loc.report.summary import RowSummary, Summary, to_summary
from poet_loc.report.tables import Column, Table

_AXES = ("x", "y", "z", "yaw", "roll", "pitch")


@dataclass(frozen=True)
class Arguments:
    """Write one simulated log folder, or run many simulated logs through the estimators."""

    out: Path | None = None
    """Write the simulated log to this folder."""
    runs: int = 0
    """Localise and fuse so many logs, with seeds from --seed on, and print their errors."""
    modes: tuple[Mode, ...] = ("prev", "best", "robust")
    """Modes of the solver in those runs."""
    fusions: tuple[Fusion, ...] = FUSIONS
    """Estimators and what they fuse in those runs."""
    workers: int = -1
    """Processes that share the runs; -1: one per core."""
    cluster: str | None = None
    """Address of a dask scheduler (tcp://..) whose workers take the runs instead."""
    overwrite: bool = False
    """Replace a log folder that holds something."""
    simulation: Flat[SimulationOptions] = field(default_factory=SimulationOptions)
    options: StageOptions = field(default_factory=StageOptions)


def execute(arguments: Arguments) -> None:
    """Write the log, print the table of the runs, or both."""
    refuse_one_estimator(arguments.options.fusion)
    processes("workers", arguments.workers)
    if arguments.out is None and arguments.runs < 1:
        raise InputError("nothing to do", fix="give --out LOG, --runs N, or both")
    refuse_unread_by_simulation(arguments.simulation)
    refuse_overwrite_without(arguments.out, "--out", arguments.overwrite)
    _refuse_unread(arguments)
    if arguments.out is not None:
        with whole_folder(arguments.out, arguments.overwrite) as folder:
            write_log(folder, simulate(arguments.simulation))
        print(arguments.out)
    if arguments.runs > 0:
        print_tables([runs_table(_summaries(arguments))])


def _refuse_unread(arguments: Arguments) -> None:
    """Raise InputError for options that the log, or the runs, do not read."""
    if arguments.runs > 0:
        refuse_unread(arguments.options, [simulate(arguments.simulation)], arguments.modes, arguments.fusions)
        return
    usual = Arguments()
    for name in ("modes", "fusions", "workers", "cluster", "options"):
        if getattr(arguments, name) != getattr(usual, name):
            raise InputError(f"--{name} changes nothing without --runs", fix="give --runs N, or leave it out")


def summary_of_run(seed: int, arguments: Arguments) -> Summary:
    """Return the summary of one simulated log; an estimator that never started is not in it."""
    log = simulate(replace(arguments.simulation, seed=seed))
    estimates = estimate_log(log, None, arguments.options, Silent(), arguments.modes, arguments.fusions)
    assert estimates.evaluation is not None
    return to_summary(estimates.evaluation)


def runs_table(summaries: Sequence[Summary]) -> Table:
    """Return the errors of each estimator over all runs: RMSE of the runs, their spread, and consistency."""
    columns = [Column("estimate"), Column("runs", "Runs")]
    columns += [Column("RMSE", "Position error", "mm"), Column("worst run", "Position error", "mm")]
    columns += [Column("RMSE", "Attitude error", "deg"), Column("worst run", "Attitude error", "deg")]
    columns += [Column("coverage", "Runs", "%"), Column("NEES/dof", "Pose")]
    columns += [Column(axis, "Inside 3σ", "%") for axis in _AXES]
    names = dict.fromkeys(name for summary in summaries for name in summary)
    rows = tuple(tuple(_row(name, [summary[name] for summary in summaries if name in summary])) for name in names)
    note = f"RMSE over the {len(summaries)} runs of the norm and of the angle, on each estimate's own frames."
    return Table("Simulated logs", tuple(columns), rows, notes=(note,))


def _row(name: str, summaries: Sequence[RowSummary]) -> Iterator[str]:
    position = np.array([summary["position_error_mm"]["norm"]["rmse"] for summary in summaries], dtype=float)
    attitude = np.array([summary["attitude_error_deg"]["angle"]["rmse"] for summary in summaries], dtype=float)
    yield from (f"{name} (oracle)" if summaries[0]["oracle"] else name, f"{len(summaries)}")
    for values, digits in ((position, 1), (attitude, 2)):
        yield f"{np.sqrt(np.nanmean(values**2)):.{digits}f}"
        yield f"{np.nanmax(values):.{digits}f}"
    yield f"{100 * np.mean([summary['coverage'] for summary in summaries]):.1f}"
    nees = [summary["nees"]["pose"] for summary in summaries if summary["nees"]]
    yield f"{np.mean(nees):.2f}" if nees else "–"
    inside = [summary["inside_3_sigma"] for summary in summaries if summary["inside_3_sigma"]]
    for axis in _AXES:
        yield f"{100 * np.mean([shares[axis] for shares in inside]):.1f}" if inside else "–"


def _summaries(arguments: Arguments) -> list[Summary]:
    first = arguments.simulation.seed
    function = partial(summary_of_run, arguments=arguments)
    seeds = range(first, first + arguments.runs)
    if arguments.cluster is None:
        return simulate_runs(function, seeds, arguments.workers)
    try:
        from distributed import Client
    except ImportError:
        raise InputError("a cluster needs dask.distributed", fix="pip install 'poet-loc[cluster]'") from None
    try:
        client = Client(arguments.cluster)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        what = f"no dask scheduler answers at {arguments.cluster}: {error}"
        raise InputError(what, fix="start one with dask scheduler, and give its tcp://HOST:PORT") from None
    with client:
        return simulate_runs(function, seeds, client=client)
