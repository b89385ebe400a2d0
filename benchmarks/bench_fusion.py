"""The error-state filter beside the plain reference (filterpy) and gtsam's fixed lag: one run, equal results.

    python benchmarks/bench_fusion.py [--seconds 120] [--plain-seconds 20] [--rounds 5] [--quick]

A simulated log, IMU 200 Hz, camera 30 Hz, white noise. Every frame brings one pose: without objects in the state the
camera's, else one of the objects', whose poses in the world are estimated (6 states each, and 12 more with biases).
Times are CPU time of this process. Each way runs over the log with all frames and with every fourth, in turns; the
difference of the medians is what an update costs (with the two half IMU steps around it), the rest an IMU sample.
The plain reference and gtsam (lag 2 s, every frame a keyframe) get the first --plain-seconds of the same log.
Streaming hands over sample by sample, in order or with every pose 50 ms behind the IMU. Peak memory and the warm start
are those of fresh processes. A run whose results are not the reference's ends with an error.
"""

from __future__ import annotations

import argparse
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fusion.coarse_offset import coarse_offset
from fusion.fuse import fuse, run_filter
from fusion.measurements import OBJECT_POSE
from fusion.nav_state import StateLayout
from fusion.online import Estimator
from fusion.options import DetectionBias, Estimate, FuseOptions, Graph
from fusion.prepare import Problem, pose_problem
from fusion.simulate import SimulationOptions, simulate
from poet_loc.io.log_folder import write_log

Way = Callable[[Problem, FuseOptions], Any]
LATE_NS = 50_000_000
TOLERANCE_M = 1e-6
WARM_START = """
import time; began = time.perf_counter()
import sys
from fusion.fuse import fuse
from fusion.options import FuseOptions
from poet_loc.io.log_folder import read_log
result = fuse(read_log(sys.argv[1]), FuseOptions(measurements="camera"))
print(time.perf_counter() - began, time.process_time())
"""


@dataclass(frozen=True)
class Case:
    """How many objects are in the state, and whether with biases."""

    objects: int
    biases: bool = False
    camera: bool = False
    """Frames bring camera poses although objects are in the state."""

    @property
    def name(self) -> str:
        return f"{self.objects}{' + biases' if self.biases else ''}{', camera' if self.camera else ''}"


def problem_of(case: Case, seconds: float) -> tuple[Problem, FuseOptions]:
    """Return a log in which every frame brings one pose."""
    measurements = "objects" if case.objects and not case.camera else "camera"
    options = FuseOptions(
        measurements=measurements,
        bias=DetectionBias(use=case.biases),
        estimate=Estimate(map="approximate" if measurements == "objects" else "known"),
    )
    simulation = SimulationOptions(
        duration_s=seconds, objects=max(case.objects, 1), symmetric_objects=0, noise="white", camera_poses=True
    )
    log = simulate(simulation)
    unstated = {name: replace(poses, covariances=None) for name, poses in log.object_poses.items()}
    problem = pose_problem(replace(log, object_poses=unstated), options)
    if case.camera:
        problem = replace(problem, layout=StateLayout(n_objects=case.objects, objects=case.objects > 0))
        return problem, options
    stamps, first = np.unique(problem.measurements.stamps_ns, return_index=True)
    seen = np.diff(np.append(first, len(problem.measurements)))
    return with_frames(problem, first + np.arange(len(stamps)) % seen), options


def with_frames(problem: Problem, rows: Any) -> Problem:
    m = problem.measurements
    columns = (m.stamps_ns, m.kinds, m.objects, m.rotations, m.translations, m.covariances)
    return replace(problem, measurements=type(m)(*(np.ascontiguousarray(column[rows]) for column in columns)))


def first_seconds(problem: Problem, seconds: float) -> Problem:
    """Return the start of a log, which ends with an IMU sample."""
    imu, end = problem.imu, problem.imu.stamps_ns[0] + round(seconds * 1e9)
    imu = imu[imu.stamps_ns <= end]
    rows = np.flatnonzero(problem.measurements.stamps_ns <= imu.stamps_ns[-1])
    return with_frames(replace(problem, imu=imu), rows)


def one_call(problem: Problem, options: FuseOptions) -> Any:
    return run_filter(problem, options).T_world_imu.translation[-1]


def reference(problem: Problem, options: FuseOptions) -> Any:
    from fusion.reference_filter import run_reference

    return run_reference(problem, options).T_world_imu.translation[-1]


def fixed_lag(problem: Problem, options: FuseOptions) -> Any:
    from fusion.graph import run_graph

    options = replace(options, estimator="graph", graph=Graph(keyframe_rate_hz=30.0))
    return run_graph(problem, options).T_world_imu.translation[-1]


def calls_of(problem: Problem, late_ns: int) -> list[tuple[bool, tuple[Any, ...]]]:
    """Return the arguments of feed_imu and of the poses' method, in order of arrival."""
    imu, m = problem.imu, problem.measurements
    arrival = np.r_[imu.stamps_ns, np.minimum(m.stamps_ns + late_ns, imu.stamps_ns[-1])]
    q, keys, calls = Rotation.from_matrix(m.rotations.reshape(-1, 3, 3)).as_quat(), problem.keys, []
    for i in np.lexsort((np.r_[np.ones(len(imu)), np.zeros(len(m))], arrival)):
        if i < len(imu):
            calls.append((True, (int(imu.stamps_ns[i]), imu.angular_velocity[i], imu.specific_force[i])))
            continue
        j = i - len(imu)
        pose, R = (m.translations[j], q[j]), m.covariances[j]
        if m.kinds[j] == OBJECT_POSE:
            pose, R = ([keys[m.objects[j]][0]], pose[0][None], pose[1][None]), None  # type: ignore[assignment]
        calls.append((False, (int(m.stamps_ns[j]), *pose, R)))
    return calls


class Streaming:
    """Sample by sample; what arrives is prepared before the clock starts."""

    def __init__(self, late_ns: int) -> None:
        self._late_ns, self._calls = late_ns, dict[int, Any]()

    def prepare(self, problem: Problem, options: FuseOptions) -> None:
        estimator = Estimator(problem.calibration, problem.landmark_map, options, layout=problem.layout)
        self._calls[id(problem)] = estimator, calls_of(problem, self._late_ns)

    def __call__(self, problem: Problem, options: FuseOptions) -> Any:
        estimator, calls = self._calls[id(problem)]
        estimator.reset()
        feed_imu = estimator.feed_imu
        pose = estimator.feed_object_poses if options.measurements == "objects" else estimator.feed_camera_pose
        for is_imu, arguments in calls:
            if is_imu:
                feed_imu(*arguments)
            else:
                pose(*arguments)
        return estimator.state().position  # type: ignore[union-attr]


def timed(way: Way, problem: Problem, options: FuseOptions) -> tuple[float, Any]:
    start = time.process_time()
    result = way(problem, options)
    return time.process_time() - start, result


@dataclass(frozen=True)
class Cost:
    whole_s: float
    per_sample_us: float
    per_update_us: float
    end: Any

    def __str__(self) -> str:
        return f"{self.per_sample_us:9.2f}{self.per_update_us:9.2f}"


def costs(ways: dict[str, Way], problem: Problem, options: FuseOptions, rounds: int) -> dict[str, Cost]:
    """Return what each way costs, all of them in turns."""
    few = with_frames(problem, slice(None, None, 4))
    for way in ways.values():
        if isinstance(way, Streaming):
            way.prepare(problem, options)
            way.prepare(few, options)
        way(few, options)  # compiled and warm
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    ends = {}
    for _ in range(rounds):
        for name, way in ways.items():
            whole, ends[name] = timed(way, problem, options)
            spent[name].append((whole, timed(way, few, options)[0]))
    found = {}
    for name, pairs in spent.items():
        whole, fewer = (statistics.median(column) for column in zip(*pairs))
        update = max(0.0, (whole - fewer) / (len(problem.measurements) - len(few.measurements)))
        sample = (whole - update * len(problem.measurements)) / len(problem.imu)
        found[name] = Cost(whole, 1e6 * sample, 1e6 * update, ends[name])
    return found


def peak_memory(arguments: argparse.Namespace, way: str) -> float:
    """Return by how many MB a fresh process grows over what it had imported and compiled."""
    command = [sys.executable, __file__, "--seconds", str(arguments.seconds), "--peak-of", way]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1])


def print_peak(arguments: argparse.Namespace) -> None:
    ways: dict[str, Way] = {"one call": one_call, "streaming": Streaming(LATE_NS), "reference": reference}
    way = ways.get(arguments.peak_of, fixed_lag)
    problem, options = problem_of(Case(0), arguments.seconds)
    for part in (first_seconds(problem, 5.0), problem):
        if isinstance(way, Streaming):
            way.prepare(part, options)
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
        before = resident_kb("VmRSS")
        way(part, options)
    print((resident_kb("VmHWM") - before) / 1024.0)


def resident_kb(which: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(which)).split()[1])


def warm_start(problem_seconds: float = 5.0) -> tuple[float, float]:
    """Return wall and CPU seconds of a fresh process from its first import to a log's estimate; the least of three."""
    log = simulate(SimulationOptions(duration_s=problem_seconds, noise="white", camera_poses=True))
    with tempfile.TemporaryDirectory() as folder:
        write_log(Path(folder), log)
        command = [sys.executable, "-c", WARM_START, folder]
        runs = [subprocess.run(command, check=True, capture_output=True, text=True).stdout.split() for _ in range(4)]
    wall, cpu = zip(*((float(a), float(b)) for a, b in runs[1:]))
    return min(wall), min(cpu)


def check(case: Case, ends: dict[str, Any], plain: Any) -> None:
    for name, end in ends.items():
        if float(np.linalg.norm(end - plain)) > TOLERANCE_M:
            sys.exit(f"{case.name} objects: {name} and the reference disagree")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--plain-seconds", type=float, default=20.0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="a miniature: a few seconds, one round, few objects")
    parser.add_argument("--peak-of", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.seconds, arguments.plain_seconds, arguments.rounds = 8.0, 4.0, 1
    if arguments.peak_of:
        print_peak(arguments)
        return

    cases = [Case(0), *(Case(k) for k in (1, 4, 8, 16)), Case(8, biases=True), Case(8, camera=True)]
    cases = [Case(0), Case(1), Case(8, camera=True)] if arguments.quick else cases
    print(f"{arguments.seconds:.0f} s, IMU 200 Hz, one pose 30 times a second; CPU us per IMU sample and per update")
    titles = ("one call", "streaming", "50 ms late", "reference")
    print(f"{'objects':>14} {'states':>7}" + "".join(f"{title:>18}" for title in titles) + f"{'gtsam, ms/update':>22}")
    fast: dict[str, Cost] = {}
    for case in cases:
        problem, options = problem_of(case, arguments.seconds)
        start = first_seconds(problem, arguments.plain_seconds)
        streaming: dict[str, Way] = {"one call": one_call, "streaming": Streaming(0), "50 ms late": Streaming(LATE_NS)}
        found = costs(streaming, problem, options, arguments.rounds)
        found |= costs({"reference": reference}, start, options, 1)
        ends = {name: way(start, options) for name, way in streaming.items() if name == "one call"}
        check(case, ends, found["reference"].end)
        check(case, {name: found[name].end for name in ("streaming", "50 ms late")}, found["one call"].end)
        graph = "" if case.camera else f"{keyframe_ms(start, options):20.2f}"
        line = "".join(str(found[title]) for title in titles)
        print(f"{case.name:>14} {problem.layout.n_error:>7}{line}{graph}", flush=True)
        fast[case.name] = found["one call"]
        if case == Case(0):
            print_ratios(problem, found)
    print(
        f"8 objects in the state: {fast['8, camera'].whole_s / fast['0'].whole_s:.1f} x the cost of none (goal: <= 4)"
    )
    share = coarse_share(arguments.seconds)
    print(f"time offset from turn rates, before a log of 8 objects is fused: {share:.2f} x the cost of the filter")
    wall, cpu = warm_start()
    print(f"warm start, import to the estimate of a 5 s log: {wall:.2f} s, {cpu:.2f} s CPU (goal: < 1 s)")
    for way in ("one call", "streaming", "reference", "gtsam") if Path("/proc/self/clear_refs").exists() else ():
        print(f"peak memory of the whole log, {way}: {peak_memory(arguments, way):.1f} MB")


def coarse_share(seconds: float) -> float:
    """Return what finding a log's time offset before it is fused costs beside the filter on 8 objects."""
    log = simulate(SimulationOptions(duration_s=seconds))
    poses, cost = log.object_poses[""], {}
    for name, call in (("offset", lambda: coarse_offset(log, object_poses=poses)), ("filter", lambda: fuse(log))):
        call()
        began = time.process_time()
        call()
        cost[name] = time.process_time() - began
    return cost["offset"] / cost["filter"]


def print_ratios(problem: Problem, found: dict[str, Cost]) -> None:
    """Print the goals on camera poses: the reference's cost of the whole log from its costs per sample and update."""
    samples, updates, plain = len(problem.imu), len(problem.measurements), found["reference"]
    plain_s = 1e-6 * (samples * plain.per_sample_us + updates * plain.per_update_us)
    goals = {"one call": 80, "streaming": 15, "50 ms late": math.nan}
    for name, goal in goals.items():
        told = "" if math.isnan(goal) else f" (goal: >= {goal})"
        print(f"{'':22}{name}: whole log {plain_s / found[name].whole_s:.0f} x as fast as the reference{told}")


def keyframe_ms(problem: Problem, options: FuseOptions) -> float:
    """Return what gtsam's fixed lag costs per frame, each of them a keyframe."""
    return 1e3 * timed(fixed_lag, problem, options)[0] / len(problem.measurements)


if __name__ == "__main__":
    main()
