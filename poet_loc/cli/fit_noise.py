"""poet-loc fit-noise: what the noise of detections is, from logs with ground truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from fusion.fit_noise import FitNoiseOptions, FittedNoise, fit_noise
from poet_loc.cli.arguments import Flat, refuse_overwrite_without, refuse_twice
from poet_loc.cli.noise_file import noise_text
from poet_loc.io.log_folder import read_log
from poet_loc.io.whole_folder import folder_is_there, not_there, write_whole_file


@dataclass(frozen=True)
class Arguments:
    """Fit white noise, varying and steady bias of detections to logs with ground truth."""

    logs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """The log folders, all of one detector."""
    detections: str | None = None
    """NAME of object_poses_NAME.csv; without it object_poses.csv, or the only one there is."""
    out: Path | None = None
    """Write the options here, for --noise-from of fuse and run."""
    overwrite: bool = False
    """Replace that file if it is there."""
    options: Flat[FitNoiseOptions] = field(default_factory=FitNoiseOptions)


def execute(arguments: Arguments) -> None:
    """Fit, print the parts, and write the file that was asked for."""
    refuse_overwrite_without(arguments.out, "--out", arguments.overwrite)
    if arguments.out is not None:
        not_there(arguments.out, arguments.overwrite)
        folder_is_there(arguments.out)
    refuse_twice(arguments.logs)
    logs = (read_log(path, arguments.detections) for path in arguments.logs)
    fitted = fit_noise(logs, arguments.detections, arguments.options)
    print("\n".join(_lines(fitted)))
    if arguments.out is not None:
        write_whole_file(arguments.out, [noise_text(*fitted.options())])
        print(f"written to {arguments.out}: fuse and run take it as --noise-from")


def _lines(fitted: FittedNoise) -> list[str]:
    lines = [
        f"{fitted.detections} good detections, {100 * fitted.gross_share:.1f} % gross errors left out",
        f"{'1-sigma of':<22}{'white':>9}{'varying':>9}{'over':>8}{'steady':>9}",
    ]
    share = ("% of distance", 100.0)
    units = {"rotation": ("deg per axis", 180.0 / math.pi), "across": share, "along": share}
    for name, part in fitted.parts.items():
        unit, scale = units[name]
        sizes = (scale * part.white, scale * part.varying, part.correlation_s, scale * part.steady)
        lines.append(f"{name + ', ' + unit:<22}{sizes[0]:9.3f}{sizes[1]:9.3f}{sizes[2]:6.1f} s{sizes[3]:9.3f}")
    if fitted.scatter.any():
        turned, across, along = np.array([180.0 / math.pi, 100.0, 100.0]) * fitted.scatter
        lines.append(f"usual scatter from one detection to the next: {turned:.3f} deg, {across:.3f} and {along:.3f} %")
    means = fitted.options()[1].means
    if means:
        lines.append(f"{'mean error of object':<22}{'rotation x y z, deg':>27}{'across x y, along, %':>29}")
    for object_id, *mean in means:
        shares = "".join(f"{100.0 * share:9.2f}" for share in mean[3:])
        lines.append(f"{object_id:<22}" + "".join(f"{angle:9.2f}" for angle in mean[:3]) + f"  {shares}")
    return lines
