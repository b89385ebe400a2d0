"""Where tests find the shared data and fixtures: beside the repository, and skipped with a reason where missing."""

from __future__ import annotations

from pathlib import Path

import pytest
from headless_browser import NAMES, Browser, find_browser

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED = REPOSITORY.parent / "shared"


def _shared_folder(name: str) -> Path:
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"the shared folder {name} is not beside this checkout")
    return folder


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with ycbv_dope/ and euroc_v101/."""
    return _shared_folder("data")


@pytest.fixture(scope="session")
def shared_fixtures() -> Path:
    """Folder with poet_official/."""
    return _shared_folder("fixtures")


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Browser:
    """Chromium without a window."""
    found = find_browser(tmp_path_factory.mktemp("browser"))
    if found is None:
        pytest.skip(f"no browser is installed: none of {', '.join(NAMES)}")
    return found
