# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 6 · Unknown map and self-calibration
#
# What if nobody measured where the objects stand, or where the camera sits on the IMU? Both can be states of the
# filter. An unknown map needs one anchor: the first landmark's pose defines the world, the others are taken in where
# they are first seen. What is estimated is switched on by `FuseOptions.estimate`.

# %%
# %matplotlib inline
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

import poet_loc
from fusion.options import DetectionBias, Estimate
from fusion.simulate import SimulationOptions, simulate
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import Landmark, LandmarkMap

log = simulate(SimulationOptions(duration_s=15.0, objects=5, symmetric_objects=0, noise="white", seed=6))
white = DetectionBias(use=False)  # the simulated noise is white


def rmse_mm(result: poet_loc.FusedTrajectory) -> float:
    """Return the RMSE of the position, after the first three seconds."""
    row = result.evaluation.rows[0]
    late = row.stamps_ns > row.stamps_ns[0] + 3_000_000_000
    return float(1e3 * np.sqrt(np.mean(np.sum(row.errors[late, :3] ** 2, axis=1))))


# %% [markdown]
# ## A map that is off
# Every landmark is misplaced by some centimetres. Believing the map moves the trajectory; an *approximate* map is
# corrected on the way.

# %%
rng = np.random.default_rng(0)
off = LandmarkMap(
    tuple(
        replace(
            landmark,
            covariance=np.diag(np.repeat([np.radians(3.0) ** 2, 0.03**2], 3)),
            T_world_obj=make_pose(
                landmark.T_world_obj.rotation * Rotation.from_rotvec(np.radians(3.0) * rng.standard_normal(3)),
                landmark.T_world_obj.translation + 0.03 * rng.standard_normal(3),
            ),
        )
        for landmark in log.landmark_map
    )
)
known = poet_loc.fuse(log, poet_loc.FuseOptions(bias=white))
believed = poet_loc.fuse(
    replace(log, landmark_map=LandmarkMap(tuple(replace(each, covariance=None) for each in off))),
    poet_loc.FuseOptions(bias=white),
)
corrected = poet_loc.fuse(
    replace(log, landmark_map=off), poet_loc.FuseOptions(bias=white, estimate=Estimate(map="approximate"))
)
for name, result in (("true map", known), ("map believed", believed), ("map estimated", corrected)):
    print(f"{name:14s}{rmse_mm(result):7.1f} mm")

# %% [markdown]
# ## No map at all
# Only the first landmark keeps its pose; those of the others are forgotten (here: put far away).

# %%
anchor, *others = log.landmark_map
nowhere = make_pose(Rotation.identity(), [50.0, 50.0, 50.0])
unknown_map = LandmarkMap((anchor, *(Landmark(each.object_id, nowhere, each.instance) for each in others)))
unknown = poet_loc.fuse(
    replace(log, landmark_map=unknown_map), poet_loc.FuseOptions(bias=white, estimate=Estimate(map="unknown"))
)
print(f"unknown map   {rmse_mm(unknown):7.1f} mm")
unknown.plot("errors")

# %% [markdown]
# ## A camera that sits elsewhere
# The calibration is wrong by 2 cm and 2 degrees.

# %%
T_cam_imu = log.calibration.T_cam_imu
shifted = make_pose(
    T_cam_imu.rotation * Rotation.from_rotvec(np.radians([2.0, -1.0, 1.0])), T_cam_imu.translation + [0.02, -0.01, 0.01]
)
moved = replace(log, calibration=replace(log.calibration, T_cam_imu=shifted))
trusted = poet_loc.fuse(moved, poet_loc.FuseOptions(bias=white))
calibrated = poet_loc.fuse(moved, poet_loc.FuseOptions(bias=white, estimate=Estimate(extrinsics=True)))
print(f"wrong extrinsics trusted {rmse_mm(trusted):7.1f} mm, estimated {rmse_mm(calibrated):7.1f} mm")

found = calibrated.calibrated
off_before = np.linalg.norm(shifted.inv().translation - T_cam_imu.inv().translation)
off_after = found.T_imu_cam.translation - T_cam_imu.inv().translation
off_sigma = np.sqrt(np.diag(found.extrinsic_covariance))[3:]
print(f"camera misplaced by {1e3 * off_before:.0f} mm before and {1e3 * np.linalg.norm(off_after):.0f} mm after;")
print("error in sigma:", np.round(off_after / off_sigma, 1))

# %% [markdown]
# ## What must hold
# Estimating costs little where the calibration is right and saves much where it is wrong, and the filter must stay
# honest about it: NEES per degree of freedom near 1.

# %%
assert rmse_mm(known) < 15.0
assert rmse_mm(corrected) < rmse_mm(believed)
assert rmse_mm(unknown) < 40.0
assert rmse_mm(calibrated) < rmse_mm(trusted)
assert np.linalg.norm(off_after) < off_before
assert np.all(np.abs(off_after) < 5 * off_sigma)
assert len(unknown.calibrated.landmark_map) == len(log.landmark_map)
for result in (corrected, unknown, calibrated):
    nees = float(np.nanmean(result.evaluation.rows[0].nees))
    print(f"NEES {nees:.2f}")
    assert nees < 4.0
