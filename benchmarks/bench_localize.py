"""The landmark solver beside a plain loop over frames with scipy, paired in one run, at equal results.

    python benchmarks/bench_localize.py [--frames 20000] [--plain-frames 100] [--objects 5] [--rounds 3]

A simulated log: a fifth of the detections are gross errors, a tenth is missing. The plain loop (the oracle of the
tests) solves the first frames of the same log; a ratio is plain / ours in CPU time per frame of this process, the
median over the rounds. The first frames' results must agree, or the run ends with an error.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "landmarks"))

from per_frame_solver import solve_per_frame
from table_worlds import detect, fly_around, gross_errors, make_map, small_errors

from landmarks.camera_pose import MODES, SolverOptions, solve

TOLERANCE_M = 1e-4
"""Both descents of the robust mode stop within some micrometres of the optimum."""


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    start = time.process_time()
    result = function(*arguments)
    return time.process_time() - start, result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--plain-frames", type=int, default=100)
    parser.add_argument("--objects", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()

    rng = np.random.default_rng(0)
    landmarks, truth = make_map(rng, range(options.objects)), fly_around(rng, options.frames)
    errors = small_errors(rng, options.frames, options.objects)
    gross = rng.random(errors.shape[:2]) < 0.2
    errors[gross] = gross_errors(rng, int(gross.sum()))
    poses = detect(truth, landmarks, errors, rng.random(gross.shape) < 0.9)
    few = poses[poses.frames < options.plain_frames]
    print(f"{options.frames} frames, {len(poses)} detections of {options.objects} objects; plain loop: {len(few)}")
    print(f"{'mode':8}{'ours, s CPU':>14}{'plain / ours per frame':>26}{'largest difference':>22}")
    for mode in MODES:
        solver = SolverOptions(mode=mode)
        ours_s, ratios = [], []
        for _ in range(options.rounds):
            seconds, estimates = timed(solve, poses, landmarks, solver, truth)
            plain_seconds, plain = timed(solve_per_frame, few, landmarks, solver, truth)
            ours_s.append(seconds)
            ratios.append(plain_seconds / len(plain) / (seconds / len(estimates.camera_poses)))
        ours = estimates.camera_poses.T_world_cam.translation[: len(plain)]
        difference = float(np.linalg.norm(ours - plain.translation, axis=1).max())
        print(f"{mode:8}{statistics.median(ours_s):14.2f}{statistics.median(ratios):26.0f}{difference:20.1e} m")
        if difference > TOLERANCE_M:
            sys.exit(f"{mode}: the two solvers disagree")


if __name__ == "__main__":
    main()
