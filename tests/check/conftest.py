"""One good log that the tests spoil."""

from __future__ import annotations

import pytest

from fusion.simulate import SimulationOptions, simulate
from poet_loc.io.log_folder import Log


@pytest.fixture(scope="session")
def good_log() -> Log:
    """Fifteen seconds with everything that the checks look at."""
    return simulate(SimulationOptions(duration_s=15.0, objects=5, symmetric_objects=1, seed=0))
