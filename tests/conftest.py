"""Where tests find the shared data and fixtures: beside the repository, and skipped with a reason where missing."""

from __future__ import annotations

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED = REPOSITORY.parent / "shared"


def pytest_sessionstart() -> None:
    """Remove compiled kernels that are older than any source they may have been compiled from.

    numba's cache notices a change of a function's own file, not of the modules from which the function takes others:
    after such a change it would go on running the old code.
    """
    newest = max(source.stat().st_mtime for source in (REPOSITORY / "fusion").glob("*.py"))
    for pattern in ("*.nbi", "*.nbc"):
        for cached in (REPOSITORY / "fusion" / "__pycache__").glob(pattern):
            try:
                if cached.stat().st_mtime < newest:
                    cached.unlink()
            except FileNotFoundError:  # another worker was faster
                continue


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
