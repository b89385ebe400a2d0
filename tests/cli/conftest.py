"""A small simulated log folder that the commands run on."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fusion.simulate import SimulationOptions, simulate
from poet_loc.io.log_folder import write_log


@pytest.fixture(scope="session")
def clean_log(tmp_path_factory) -> Path:
    """A log of eight seconds that nobody changes."""
    folder = tmp_path_factory.mktemp("logs") / "table_top"
    folder.mkdir()
    write_log(folder, simulate(SimulationOptions(duration_s=8.0, seed=3)))
    return folder


@pytest.fixture
def log(clean_log, tmp_path) -> Path:
    """A copy of it to be spoilt."""
    return Path(shutil.copytree(clean_log, tmp_path / "log"))
