"""The fixed-lag graph beside the bare gtsam calls on the same graph, paired in one run, at equal results.

    python benchmarks/bench_graph.py [--seconds 20] [--objects 1 4 8] [--rounds 3]

A simulated log with object poses at 30 Hz and an IMU at 200 Hz. Ours is the whole estimator: the filter between
keyframes with its gate and rows at the IMU's rate, preintegration, making factors, and the joint covariance handed
back. Bare are the calls that it made of gtsam's ISAM2 (update, marginalise, estimate, joint covariance) made again with
the same factors, nothing else. The peer is gtsam's IncrementalFixedLagSmoother (QR) fed the same factors, asked for
the estimate of the newest pose only. Times are CPU times of this process per keyframe, medians over the rounds. The
bare calls must end in our last pose, or the run ends with an error.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from fusion import graph_smoother
from fusion.graph import run_graph
from fusion.graph_smoother import FixedLagSmoother
from fusion.graph_variables import pose_key
from fusion.options import FuseOptions
from fusion.prepare import pose_problem
from fusion.simulate import SimulationOptions, simulate

TOLERANCE_M = 1e-6


@dataclass
class Tape:
    """What the estimator asked of gtsam."""

    calls: list[tuple[str, tuple[Any, ...]]] = field(default_factory=list)
    lasting: list[list[int]] = field(default_factory=list)
    """Per update: variables that stay."""


def recording(tape: Tape) -> type:
    """Return an ISAM2 that writes its calls down."""

    class Recorded(gtsam.ISAM2):
        def update(self, *arguments: Any) -> Any:
            tape.calls.append(("update", arguments))
            return super().update(*arguments)

        def marginalizeLeaves(self, keys: Any) -> None:
            tape.calls.append(("marginalizeLeaves", (keys,)))
            super().marginalizeLeaves(keys)

        def calculateEstimate(self, keys: Any) -> Any:
            tape.calls.append(("calculateEstimate", (keys,)))
            return super().calculateEstimate(keys)

        def jointBayesNet(self, *arguments: Any) -> Any:
            tape.calls.append(("jointBayesNet", arguments))
            return super().jointBayesNet(*arguments)

    return Recorded


def record(problem: Any, options: FuseOptions) -> Tape:
    tape, own, update = Tape(), gtsam.ISAM2, FixedLagSmoother._update

    def watched(self: FixedLagSmoother) -> None:
        tape.lasting.append([variable.key for variable in self.builder.lasting])
        update(self)

    graph_smoother.gtsam.ISAM2, FixedLagSmoother._update = recording(tape), watched
    try:
        run_graph(problem, options)
    finally:
        graph_smoother.gtsam.ISAM2, FixedLagSmoother._update = own, update
    return tape


def bare(tape: Tape, options: FuseOptions) -> gtsam.Pose3:
    """Make the recorded calls."""
    isam = gtsam.ISAM2(graph_smoother.isam_parameters(options.graph))
    for name, arguments in tape.calls:
        found = getattr(isam, name)(*arguments)
        if name == "calculateEstimate":
            estimate = found
    return newest_pose(estimate)


def newest_pose(estimate: gtsam.Values) -> gtsam.Pose3:
    keys = estimate.keys()
    return estimate.atPose3(max(key for key in keys if chr(gtsam.Symbol(key).chr()) == "x"))


def peer(tape: Tape, options: FuseOptions) -> gtsam.Pose3:
    """Feed gtsam's own fixed-lag smoother with the recorded factors, keyframe by keyframe."""
    params = graph_smoother.isam_parameters(options.graph)
    params.relinearizeSkip = 1
    smoother = gtsam.IncrementalFixedLagSmoother(options.graph.lag_s * options.graph.keyframe_rate_hz, params)
    updates = [arguments for name, arguments in tape.calls if name == "update" and arguments[0].size() > 0]
    for k, ((graph, values, *_), lasting) in enumerate(zip(updates, tape.lasting, strict=True)):
        smoother.update(graph, values, dict.fromkeys([*values.keys(), *lasting], float(k)))
        pose = smoother.calculateEstimatePose3(pose_key(k))
    return pose


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    start = time.process_time()
    result = function(*arguments)
    return time.process_time() - start, result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--objects", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    options = FuseOptions(estimator="graph")
    print(f"{'objects':8}{'keyframes':>10}{'ours, ms':>10}{'bare, ms':>10}{'ours / bare':>13}{'peer / ours':>13}")
    for objects in asked.objects:
        log = simulate(SimulationOptions(duration_s=asked.seconds, objects=objects, symmetric_objects=0))
        problem = pose_problem(log, options)
        tape = record(problem, options)
        times: list[tuple[float, float, float]] = []
        for _ in range(asked.rounds):
            ours_s, result = timed(run_graph, problem, options)
            bare_s, pose = timed(bare, tape, options)
            times.append((ours_s, bare_s, timed(peer, tape, options)[0]))
        count = len(tape.lasting)
        ours, own = (statistics.median(column) * 1e3 / count for column in list(zip(*times, strict=True))[:2])
        ratio = statistics.median(a / b for a, b, _ in times)
        beside = statistics.median(c / a for a, _, c in times)
        print(f"{objects:<8}{count:>10}{ours:10.2f}{own:10.2f}{ratio:13.2f}{beside:13.1f}")
        if np.linalg.norm(result.T_world_imu.translation[-1] - pose.translation()) > TOLERANCE_M:
            sys.exit(f"{objects} objects: the bare calls end in another pose")


if __name__ == "__main__":
    main()
