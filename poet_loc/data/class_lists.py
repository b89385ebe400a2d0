"""Classes and symmetric classes of YCB-V and LM-O, and the files that the official code reads them from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

from poet_loc.core.input_error import InputError

ClassList = Literal["ycbv", "lmo"]

YCBV = (
    *("002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle"),
    *("007_tuna_fish_can", "008_pudding_box", "009_gelatin_box", "010_potted_meat_can", "011_banana"),
    *("019_pitcher_base", "021_bleach_cleanser", "024_bowl", "025_mug", "035_power_drill", "036_wood_block"),
    *("037_scissors", "040_large_marker", "051_large_clamp", "052_extra_large_clamp", "061_foam_brick"),
)
CLASSES: dict[str, dict[int, str]] = {
    "ycbv": dict(enumerate(YCBV, start=1)),
    "lmo": {1: "ape", 5: "can", 6: "cat", 8: "driller", 9: "duck", 10: "eggbox", 11: "glue", 12: "holepuncher"},
}
"""Object id and name, in the order of the classes."""
SYMMETRIC: dict[str, frozenset[str]] = {
    "ycbv": frozenset({"024_bowl", "036_wood_block", "051_large_clamp", "052_extra_large_clamp", "061_foam_brick"}),
    "lmo": frozenset({"eggbox", "glue"}),
}
"""Classes that ADD(-S) measures by the nearest point."""


def write_class_files(name: ClassList, folder: str | Path) -> tuple[Path, Path]:
    """Write {name}_classes.json and {name}_symmetries.json as the official code reads them; return their paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    classes, symmetries = folder / f"{name}_classes.json", folder / f"{name}_symmetries.json"
    classes.write_text(json.dumps({str(key): value for key, value in CLASSES[name].items()}, indent=1) + "\n")
    flags = {value: value in SYMMETRIC[name] for value in CLASSES[name].values()}
    symmetries.write_text(json.dumps(flags, indent=1) + "\n")
    return classes, symmetries


def read_class_file(path: str | Path) -> dict[int, str]:
    """Read a classes file, object id to name in the order of the classes.  Raises InputError if it is no such file."""
    try:
        content = json.loads(Path(path).read_text())
        return {int(key): str(value) for key, value in content.items()}
    except FileNotFoundError:
        raise InputError("no such file", path=path) from None
    except (ValueError, AttributeError) as error:
        raise InputError(f"not a classes file ({error})", path=path, fix='write {"1": "name", ...}') from None
