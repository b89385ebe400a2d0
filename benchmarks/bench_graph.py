"""The fixed-lag graph beside the bare gtsam calls on the same graph, paired in one run, at equal results.

    python benchmarks/bench_graph.py [--seconds 20] [--objects 1 4 8] [--rounds 3] [--long 60]

A simulated log with object poses at 30 Hz and an IMU at 200 Hz. **Ours** is the whole estimator: the filter between
keyframes with its gate and rows at the IMU's rate (state and covariance), what makes the graph of it (white rows from
its own compiled models, of the IMU as well), and the joint covariance handed back.
**Bare** is the program that someone writes who has gtsam, the same keyframes and all numbers ready: preintegrate each
IMU sample, make one factor per measurement (a CustomFactor on our compiled error: gtsam has none) and per step of a
bias, insert initial values, call ISAM2 (update in our order of elimination, marginalise), ask for the newest state and
its joint covariance. It gives one state per keyframe. **With rows** is the same program where states at the IMU's rate
are asked for: at each sample it also predicts from the last keyframe's estimate with what it has preintegrated, and
keeps attitude, position and velocity; they have no covariance and know no measurement since that keyframe, as ours do.
**Solver** are ISAM2's calls alone as ours makes them, on factors that are ready. **Peer** is gtsam's
IncrementalFixedLagSmoother (QR) fed with bare's factors, ready, asked for the newest pose only. Times are CPU times of
this process per keyframe, medians over the rounds. Solver must end in our last pose, bare within five millimetres of it
(factors that can be called again let an object's bias act where the object was first seen, and a kernel weigh at the
linearisation; ours do both where the filter is), or the run ends with an error.

--long: the online graph, fed for so many seconds: time per keyframe and memory early and late.
"""

from __future__ import annotations

import argparse
import gc
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gtsam
import numpy as np

from fusion import graph_builder, graph_factors, graph_smoother
from fusion.graph import run_graph
from fusion.graph_factors import bias_factor, robust
from fusion.graph_fixed import FixedBuilder
from fusion.graph_motion import MotionChain
from fusion.graph_online import GraphEstimator
from fusion.graph_smoother import FixedLagSmoother, joint_covariance
from fusion.graph_variables import pose_key
from fusion.options import FuseOptions
from fusion.prepare import pose_problem, time_shift_ns
from fusion.simulate import SimulationOptions, simulate

TOLERANCE_M, TOLERANCE_BARE_M = 1e-6, 5e-3

Row = tuple[Any, Any, Any]

Make = Callable[[], Any]


@dataclass(frozen=True)
class ImuLink:
    """What makes the IMU's factor of two keyframes from its samples."""

    keys: Sequence[int]
    parameters: tuple[Any, Any]
    """Of the preintegration, and the bias that it starts from."""
    samples: Sequence[tuple[Any, Any, float]]

    def __call__(self) -> Any:
        summed = gtsam.PreintegratedCombinedMeasurements(*self.parameters)
        for force, rate, seconds in self.samples:
            summed.integrateMeasurement(force, rate, seconds)
        return gtsam.CombinedImuFactor(*self.keys, summed)

    def with_rows(self, start: gtsam.NavState, bias: gtsam.imuBias.ConstantBias, rows: list[Row]) -> Any:
        """Make it, and append what it predicts at each sample from the state at the first keyframe."""
        summed = gtsam.PreintegratedCombinedMeasurements(*self.parameters)
        for force, rate, seconds in self.samples:
            summed.integrateMeasurement(force, rate, seconds)
            now = summed.predict(start, bias)
            rows.append((now.attitude().matrix(), now.position(), now.velocity()))
        return gtsam.CombinedImuFactor(*self.keys, summed)


@dataclass
class Keyframe:
    """What is asked of gtsam for one keyframe."""

    factors: list[Make] = field(default_factory=list)
    values: list[tuple[int, Make]] = field(default_factory=list)
    lasting: list[int] = field(default_factory=list)
    """Variables that stay."""
    calls: list[tuple[str, tuple[Any, ...]]] = field(default_factory=list)
    """Of ISAM2, in this order."""
    newest: Sequence[int] = ()


def recording(tape: list[Keyframe]) -> type:
    """Return an ISAM2 that writes its calls down."""

    class Recorded(gtsam.ISAM2):
        def update(self, *arguments: Any) -> Any:
            tape[-1].calls.append(("update", arguments))
            return super().update(*arguments)

        def marginalizeLeaves(self, keys: Any) -> None:
            tape[-1].calls.append(("marginalizeLeaves", (keys,)))
            super().marginalizeLeaves(keys)

        def jointBayesNet(self, *arguments: Any) -> Any:
            tape[-1].calls.append(("jointBayesNet", arguments))
            tape[-1].newest = arguments[0]
            return super().jointBayesNet(*arguments)

    return Recorded


def record(problem: Any, options: FuseOptions) -> list[Keyframe]:
    """Return what the estimator asks of gtsam."""
    tape, update, take = [Keyframe()], FixedLagSmoother._update, graph_builder.GraphBuilder.take

    def watched_update(self: FixedLagSmoother) -> None:
        tape[-1].lasting = [variable.key for variable in self.builder.lasting]
        update(self)

    def watched_take(self: graph_builder.GraphBuilder) -> Any:
        added = take(self)
        if not isinstance(self, FixedBuilder):
            tape[-1].values = [(key, _maker(added[1], key)) for key in list(added[1].keys())]
        return added

    extend = FixedLagSmoother.extend

    def watched_extend(self: FixedLagSmoother, *arguments: Any) -> None:
        tape.append(Keyframe())
        extend(self, *arguments)

    with (
        patch.object(graph_smoother.gtsam, "ISAM2", recording(tape)),
        patch.object(FixedLagSmoother, "_update", watched_update),
        patch.object(FixedLagSmoother, "extend", watched_extend),
        patch.object(graph_builder.GraphBuilder, "take", watched_take),
    ):
        run_graph(problem, options)
    return tape


class FactorNotes:
    """How to make each factor again, noted while the estimator makes it, keyframe by keyframe."""

    def __init__(self, options: FuseOptions) -> None:
        self.made: list[list[Make]] = [[]]
        self._kernel = options.graph
        self._covariance: Any = None
        self._parameters: tuple[Any, Any] = None, None
        self._samples: list[Any] = []

    def robust(self, kernel: Any, covariance: Any) -> Any:
        """Note the covariance that the next CustomFactor will have."""
        self._covariance = covariance.copy()
        return robust(kernel, covariance)

    def custom(self, make: type) -> Callable[..., Any]:
        """Return what makes a CustomFactor and notes it."""

        def noted(_: Any, keys: Any, error: Any) -> Any:
            covariance = self._covariance
            self.made[-1].append(lambda: make(robust(self._kernel, covariance), keys, error))
            return self.made[-1][-1]()

        return noted

    def bias(self, *arguments: Any) -> Any:
        """Make the step of an object's bias and note it."""
        self.made[-1].append(lambda: bias_factor(*arguments[:4]))
        return bias_factor(*arguments)

    def preintegrated(self, make: type) -> type:
        """Return a preintegration that notes its samples."""
        notes = self

        class Noted(make):  # type: ignore[misc, valid-type]
            def __init__(self, parameters: Any, bias: Any) -> None:
                notes._parameters, notes._samples = (parameters, bias), []
                super().__init__(parameters, bias)

            def integrateMeasurement(self, *step: Any) -> None:
                notes._samples.append(tuple(np.array(one) for one in step))
                super().integrateMeasurement(*step)

        return Noted

    def link(self, make: Callable[..., Any]) -> Callable[..., Any]:
        """Return what makes the IMU's factor and notes it with its preintegration."""

        def noted(chain: MotionChain, *arguments: Any) -> Any:
            factor, predicted = make(chain, *arguments)
            self.made[-1].append(ImuLink(list(factor.keys()), self._parameters, self._samples))
            return factor, predicted

        return noted

    def take(self, make: Callable[..., Any]) -> Callable[..., Any]:
        """Return what hands a keyframe's factors over and notes those that are priors: few, and ready."""

        def noted(builder: graph_builder.GraphBuilder) -> Any:
            every = [builder.graph.at(i) for i in range(builder.graph.size())]
            first = len(self.made) == 1
            priors = [factor for factor in every if first or isinstance(factor, gtsam.PriorFactorVector)]
            self.made[-1] += [lambda prior=prior: prior for prior in priors]
            self.made.append([])
            return make(builder)

        return noted


def record_factors(problem: Any, options: FuseOptions) -> list[Keyframe]:
    """Return the same with a maker of every factor: those that a graph has whose factors can be called again."""
    notes, preintegrated = FactorNotes(options), gtsam.PreintegratedCombinedMeasurements
    with (
        patch.object(graph_factors, "robust", notes.robust),
        patch.object(graph_factors.gtsam, "CustomFactor", notes.custom(gtsam.CustomFactor)),
        patch.object(graph_builder, "bias_factor", notes.bias),
        patch.object(gtsam, "PreintegratedCombinedMeasurements", notes.preintegrated(preintegrated)),
        patch.object(MotionChain, "link", notes.link(MotionChain.link)),
        patch.object(graph_builder.GraphBuilder, "take", notes.take(graph_builder.GraphBuilder.take)),
    ):
        again = replace(options, graph=replace(options.graph, relinearize_every=10**9))  # able to, but never does
        tape = record(problem, again)
    for keyframe, factors in zip(tape, notes.made, strict=False):
        keyframe.factors = factors
    return tape


def _maker(values: gtsam.Values, key: int) -> Make:
    """Return what makes a variable's value anew from its numbers."""
    kind = chr(gtsam.Symbol(key).chr())
    if kind in "xeo":
        T = values.atPose3(key).matrix()
        return lambda: gtsam.Pose3(T)
    if kind == "b":
        bias = values.atConstantBias(key)
        force, rate = bias.accelerometer(), bias.gyroscope()
        return lambda: gtsam.imuBias.ConstantBias(force, rate)
    vector = values.atVector(key)
    return lambda: vector


def bare(tape: list[Keyframe], options: FuseOptions, rows: list[Row] | None = None) -> gtsam.Pose3:
    """Build and solve the graph by gtsam alone; append states at the IMU's rate to rows, where that is asked for."""
    isam, start = gtsam.ISAM2(graph_smoother.isam_parameters(options.graph)), None
    for keyframe in tape:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for make in keyframe.factors:
            if rows is not None and start is not None and isinstance(make, ImuLink):
                graph.add(make.with_rows(*start, rows))
            else:
                graph.add(make())
        for key, make in keyframe.values:
            values.insert(key, make())
        for name, arguments in keyframe.calls:
            if name == "update" and arguments[0].size() > 0:
                isam.update(graph, values, *arguments[2:])
            elif name != "jointBayesNet":
                getattr(isam, name)(*arguments)
        if keyframe.newest:
            joint_covariance(isam, keyframe.newest)
            newest = isam.calculateEstimate(keyframe.newest)
            if rows is not None:
                pose, velocity, bias = keyframe.newest[:3]
                start = gtsam.NavState(newest.atPose3(pose), newest.atVector(velocity)), newest.atConstantBias(bias)
    return newest.atPose3(keyframe.newest[0])


def bare_with_rows(tape: list[Keyframe], options: FuseOptions) -> gtsam.Pose3:
    """Do that and give states at the IMU's rate."""
    rows: list[Row] = []
    pose = bare(tape, options, rows)
    assert len(rows) > 10 * len(tape)
    return pose


def solver(tape: list[Keyframe], options: FuseOptions) -> gtsam.ISAM2:
    """Make the recorded calls of ISAM2."""
    isam = gtsam.ISAM2(graph_smoother.isam_parameters(options.graph))
    for keyframe in tape:
        for name, arguments in keyframe.calls:
            getattr(isam, name)(*arguments)
    return isam


def peer(tape: list[Keyframe], options: FuseOptions) -> gtsam.Pose3:
    """Feed gtsam's own fixed-lag smoother with the recorded factors, keyframe by keyframe."""
    params = graph_smoother.isam_parameters(options.graph)
    params.relinearizeSkip = 1
    smoother = gtsam.IncrementalFixedLagSmoother(options.graph.lag_s * options.graph.keyframe_rate_hz, params)
    for k, keyframe in enumerate(tape):
        graph, values = keyframe.calls[0][1][:2]
        smoother.update(graph, values, dict.fromkeys([*values.keys(), *keyframe.lasting], float(k)))
        pose = smoother.calculateEstimatePose3(pose_key(k))
    return pose


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    start = time.process_time()
    result = function(*arguments)
    return time.process_time() - start, result


def compare(objects: int, seconds: float, rounds: int) -> None:
    """Print one row of the table."""
    options = FuseOptions(estimator="graph")
    problem = pose_problem(
        simulate(SimulationOptions(duration_s=seconds, objects=objects, symmetric_objects=0)), options
    )
    own, by_hand = record(problem, options), record_factors(problem, options)
    contestants = (run_graph, problem), (bare, by_hand), (bare_with_rows, by_hand), (solver, own), (peer, by_hand)
    times: list[list[float]] = []
    for _ in range(rounds):
        row = [timed(function, on, options) for function, on in contestants]
        times.append([spent for spent, _ in row])
        last = row[0][1].T_world_imu.translation[-1]
        solved = row[3][1].calculateEstimatePose3(own[-1].newest[0])
        ends = [pose.translation() for pose in (row[1][1], row[2][1], solved)]
        for end, most in zip(ends, (TOLERANCE_BARE_M, TOLERANCE_BARE_M, TOLERANCE_M), strict=True):
            if np.linalg.norm(end - last) > most:
                sys.exit(f"{objects} objects: the calls end {np.linalg.norm(end - last):.1e} m from our pose")
    each = [statistics.median(row[i] for row in times) * 1e3 / len(own) for i in range(4)]
    ratios = [statistics.median(row[a] / row[b] for row in times) for a, b in ((0, 1), (0, 2), (0, 3), (4, 0))]
    print(
        f"{objects:<8}{len(own):>10}{each[0]:10.2f}{each[1]:10.2f}{each[2]:11.2f}{each[3]:12.2f}"
        f"{ratios[0]:13.2f}{ratios[1]:14.2f}{ratios[2]:15.2f}{ratios[3]:13.1f}"
    )


def memory_mb() -> float:
    """Return what this process holds in memory now."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def run_long(seconds: float, objects: int) -> None:
    """Feed the online graph and print time and memory per keyframe of each fifth of the way."""
    log = simulate(SimulationOptions(duration_s=seconds, objects=objects, symmetric_objects=0))
    options = FuseOptions(estimator="graph")
    assert log.imu is not None
    assert log.calibration is not None
    estimator, imu, seen = GraphEstimator(log.calibration, log.landmark_map, options), log.imu, log.detections()[1]
    q, shift_ns = seen.T_cam_obj.rotation.as_quat(), time_shift_ns(log.calibration)
    extend, keyframes, m = FixedLagSmoother.extend, 0, 0

    def counted(self: FixedLagSmoother, *arguments: Any) -> None:
        nonlocal keyframes
        keyframes += 1
        extend(self, *arguments)

    print(f"online, {objects} object(s)\n{'until, s':>10}{'keyframes':>12}{'ms each':>10}{'memory, MB':>13}")
    with patch.object(FixedLagSmoother, "extend", counted):
        for fifth in np.array_split(np.arange(len(imu.stamps_ns)), 5):
            began, before = time.process_time(), keyframes
            for i in fifth:
                estimator.feed_imu(imu.stamps_ns[i], imu.angular_velocity[i], imu.specific_force[i])
                while m < len(q) and seen.stamps_ns[m] + shift_ns <= imu.stamps_ns[i]:
                    of = slice(m, int(np.searchsorted(seen.stamps_ns, seen.stamps_ns[m], side="right")))
                    R = None if seen.covariances is None else seen.covariances[of]
                    poses = seen.T_cam_obj.translation[of], q[of], R, seen.instances[of]
                    estimator.feed_object_poses(seen.stamps_ns[m], seen.object_ids[of], *poses)
                    m = of.stop
            spent, count = time.process_time() - began, keyframes - before
            until = (imu.stamps_ns[fifth[-1]] - imu.stamps_ns[0]) * 1e-9
            print(f"{until:10.0f}{count:12}{spent * 1e3 / count:10.2f}{memory_mb():13.1f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--objects", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--long", type=float, default=60.0)
    asked = parser.parse_args()
    titles = f"{'objects':8}{'keyframes':>10}{'ours, ms':>10}{'bare, ms':>10}{'with rows':>11}{'solver, ms':>12}"
    print(f"{titles}{'ours / bare':>13}{'ours / rows':>14}{'ours / solver':>15}{'peer / ours':>13}")
    for objects in asked.objects:
        compare(objects, asked.seconds, asked.rounds)
    if asked.long > 0.0:
        run_long(asked.long, asked.objects[0])


if __name__ == "__main__":
    main()
