"""A whole log whose stamps are no nanoseconds is refused; stamps that stand close together are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fusion.options import FuseOptions
from fusion.prepare import pose_problem
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.input_error import InputError


@pytest.fixture(scope="module")
def log():
    return simulate(SimulationOptions(duration_s=3.0, objects=3))


@pytest.mark.parametrize("unit_ns", [1_000, 1_000_000])
@pytest.mark.parametrize("stream", ["imu", "poses"])
def test_stamps_in_another_unit_are_refused(stream, unit_ns, log):
    imu, poses = log.imu, log.object_poses[""]
    if stream == "imu":
        log = replace(log, imu=replace(imu, stamps_ns=imu.stamps_ns // unit_ns))
    else:
        log = replace(log, object_poses={"": replace(poses, stamps_ns=poses.stamps_ns // unit_ns)})
    with pytest.raises(InputError, match=r"imu\.csv.* Hz.*nanoseconds" if stream == "imu" else " Hz.*nanoseconds"):
        pose_problem(log, FuseOptions())


def test_objects_with_a_stamp_each_are_no_fast_camera(log):
    poses = log.object_poses[""]
    apart = replace(poses, stamps_ns=poses.stamps_ns + 50_000 * poses.object_ids)
    problem = pose_problem(replace(log, object_poses={"": apart}), FuseOptions())
    assert len(np.unique(problem.measurements.stamps_ns)) == len(problem.measurements)
