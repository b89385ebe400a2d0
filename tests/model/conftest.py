from __future__ import annotations

from pathlib import Path

import pytest
from official_fixture import FixtureA


@pytest.fixture(scope="session")
def fixture_a(shared_fixtures: Path) -> FixtureA:
    return FixtureA(shared_fixtures / "poet_official")
