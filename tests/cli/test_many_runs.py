"""poet-loc simulate --runs: the same table whoever computed it."""

from __future__ import annotations

import sys

import pytest

from poet_loc.cli.main import main

RUNS = ["simulate", "--runs", "3", "--seed", "7", "--duration-s", "4", "--objects", "3", "--symmetric-objects", "0"]
RUNS += ["--camera-rate-hz", "15", "--imu-rate-hz", "100", "--modes", "prev", "--fusions", "eskf/objects"]


@pytest.fixture(scope="module")
def alone() -> list[str]:
    """The arguments for which the runs are computed one after the other, in this process."""
    return [*RUNS, "--workers", "1"]


def shown(arguments: list[str], capsys) -> str:
    assert main(arguments) == 0
    return capsys.readouterr().out


def test_two_processes_print_the_same_table(alone, capsys):
    table = shown(alone, capsys)
    assert "| fuse/eskf/objects" in table
    assert shown([*RUNS, "--workers", "2"], capsys) == table


def test_a_cluster_of_two_workers_prints_the_same_table(alone, capsys):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp://", dashboard_address=None
    ) as cluster:
        assert cluster.scheduler_address.startswith("tcp://")
        assert shown([*RUNS, "--cluster", cluster.scheduler_address], capsys) == shown(alone, capsys)


def test_a_cluster_without_dask_is_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main([*RUNS, "--cluster", "tcp://127.0.0.1:1"]) == 1
    said = capsys.readouterr().err
    assert "poet-loc[cluster]" in said
    assert len(said.splitlines()) == 1
