"""What the images of a folder were rendered from, so that no run goes on with anything else among them."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

from poet_loc.core.input_error import InputError
from poet_loc.io.whole_folder import write_whole_file

RECORD = "rendered.json"


def keep_to_options(folder: Path, options: Any, *names: str) -> None:
    """Write these options of a dataclass into folder/rendered.json; the folder is made.

    Raises InputError where the folder's images were rendered with others, or cannot be written.
    """
    asked = {each.name: getattr(options, each.name) for each in fields(options) if each.name in names}
    asked = json.loads(json.dumps(asked))  # tuples become lists, as they are in the file
    path = folder / RECORD
    there = json.loads(path.read_text()) if path.exists() else {}
    for name, value in asked.items():
        if there.get(name, value) != value:
            option = f"--{name.replace('_', '-')}"
            what = f"was rendered with {option} {_words(there[name])}, not {_words(value)}"
            raise InputError(what, path=folder, fix="choose another --out, or the same options")
    if not there.keys() >= asked.keys():
        folder.mkdir(parents=True, exist_ok=True)
        write_whole_file(path, [json.dumps(there | asked, indent=1, sort_keys=True) + "\n"])


def _words(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
