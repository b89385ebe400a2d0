"""What the tests of the readers share: a file from a text, and the one line that refuses it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from poet_loc.core.input_error import InputError


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def write_text(text: str | bytes, name: str = "file.txt") -> Path:
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write_text


@pytest.fixture
def refusal() -> Callable[..., InputError]:
    """Call a reader that must refuse; return the error, which is one line with its file and what to do."""

    def refuse(read: Callable[..., object], path: Path, *arguments: object) -> InputError:
        with pytest.raises(InputError) as caught:
            read(path, *arguments)
        message = str(caught.value)
        assert "\n" not in message
        assert message.startswith(str(path))
        assert caught.value.fix
        return caught.value

    return refuse
