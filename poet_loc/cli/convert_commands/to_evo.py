"""poet-loc convert to-evo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from poet_loc.io.evo_result import write_evo_result
from poet_loc.io.tum import read_tum


@dataclass(frozen=True)
class Arguments:
    """The errors of a trajectory become a result zip that evo_res merges with its own."""

    estimate: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="EST")]
    """TUM file."""
    reference: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REF")]
    """TUM file."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ZIP")]
    """The zip to write."""
    name: str | None = None
    """What the estimate is called; without it, the name of its file."""
    max_difference_s: float = 0.01
    """Stamps match up to this difference, s."""
    overwrite: bool = False
    """Replace a file that is there."""


def execute(arguments: Arguments) -> None:
    """Convert and say the RMSE."""
    estimate, reference = read_tum(arguments.estimate), read_tum(arguments.reference)
    name = arguments.name or arguments.estimate.stem
    error = write_evo_result(arguments.out, estimate, reference, name, arguments.max_difference_s, arguments.overwrite)
    print(f"{arguments.out}: {len(error)} pairs, RMSE {np.sqrt(np.mean(error**2)):.6f} m")
