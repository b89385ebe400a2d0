"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from poet_loc.core.input_error import InputError


def write_whole_file(path: str | Path, parts: Iterable[str]) -> None:
    """Write text to a file through a temporary sibling, so that an interruption leaves the old file.

    Raises InputError where the folder is missing or may not be written.
    """
    path = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".partial", dir=path.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="\n") as file:
            file.writelines(parts)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def not_there(target: str | Path, overwrite: bool = False) -> None:
    """Raise InputError for a file that is there and must not be overwritten, or that is a folder."""
    if Path(target).is_dir():
        raise InputError("is a folder", path=target, fix="name a file")
    if Path(target).exists() and not overwrite:
        raise InputError("is there already", path=target, fix="choose another name or pass --overwrite")


def folder_is_there(target: str | Path) -> None:
    """Raise InputError for a file to be written where there is no folder: told before the work, not behind it."""
    if not Path(target).parent.is_dir():
        raise InputError("lies in no folder that is there", path=target, fix="make the folder or choose another place")


@contextmanager
def whole_folder(target: str | Path, overwrite: bool = False, inputs: Iterable[str | Path] = ()) -> Iterator[Path]:
    """Yield a temporary sibling folder that takes the target's place when the block ends well.

    A target that holds anything is an InputError unless overwrite is set; then the old folder is replaced as a whole.
    An exception or an interruption removes the temporary folder and leaves the old one as it was.
    inputs: paths that the block reads; none may lie in a folder that is to be replaced.
    """
    target = Path(target)
    place = target.resolve()
    _check_target(target, place, overwrite, inputs)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{place.name}.", suffix=".partial", dir=place.parent))
    except OSError as error:
        raise _cannot_write(target, error) from error
    try:
        os.chmod(temporary, 0o777 & ~_umask())
        yield temporary
        _put_in_place(temporary, place)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _check_target(target: Path, place: Path, overwrite: bool, inputs: Iterable[str | Path]) -> None:
    if place.exists() and not place.is_dir():
        raise InputError("is a file, not a folder", path=target, fix="choose another --out")
    if not place.is_dir() or not any(place.iterdir()):
        return
    if not overwrite:
        raise InputError("has results", path=target, fix="choose another --out or pass --overwrite")
    if Path.cwd().resolve().is_relative_to(place) or Path.home().resolve().is_relative_to(place):
        raise InputError("holds the working or the home folder", path=target, fix="choose another --out")
    for source in inputs:
        if Path(source).resolve().is_relative_to(place):
            raise InputError(f"holds the input {source}", path=target, fix="choose another --out")


def _put_in_place(temporary: Path, place: Path) -> None:
    if not place.exists():
        temporary.rename(place)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{place.name}.", suffix=".old", dir=place.parent))
    try:
        place.rename(old)  # onto an empty folder, which POSIX replaces
        try:
            temporary.rename(place)
        except BaseException:
            old.rename(place)
            raise
    finally:
        if place.exists():
            shutil.rmtree(old, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _cannot_write(path: Path, error: OSError) -> InputError:
    return InputError(f"cannot be written: {error.strerror}", path=path, fix="choose another place")
