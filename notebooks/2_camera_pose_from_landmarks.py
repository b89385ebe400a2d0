# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 2 · Camera pose from landmarks
#
# A network sees an object at `T_cam_obj`. If the map knows where that object stands, `T_world_obj`,
# the camera must be at
#
# $$T_{world,cam} = T_{world,obj}\; T_{cam,obj}^{-1}$$
#
# which is one **vote**. This notebook looks at one vote, two, many, at an outlier, and at the five ways to make one
# pose of them.

# %%
# %matplotlib inline
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import RigidTransform, Rotation

import poet_loc
from landmarks.localize import LocalizeOptions
from poet_loc.core.geometry import make_pose
from poet_loc.core.records import Landmark, LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.io.log_folder import Log

# %% [markdown]
# A map of four objects, and a camera two metres away that looks at them.

# %%
places = [(0.0, 0.0, 0.1), (0.3, 0.1, 0.1), (-0.2, 0.25, 0.05), (0.1, -0.3, 0.1)]
landmark_map = LandmarkMap(
    tuple(Landmark(k + 1, make_pose(Rotation.from_rotvec([0, 0, 0.5 * k]), place)) for k, place in enumerate(places))
)
T_world_cam = make_pose(Rotation.from_euler("xyz", [-120, 0, 90], degrees=True), [2.0, 0.0, 0.9])
stamps = np.array([1_700_000_000_000_000_000])


def log_of(T_cam_obj: RigidTransform, ids: list[int]) -> Log:
    """Return a log of one frame with these detections."""
    n = len(ids)
    column = np.zeros(n, dtype=np.int64)
    poses = ObjectPoses(np.repeat(stamps, n), column, np.array(ids), column, np.ones(n), T_cam_obj)
    truth = Trajectory(stamps, RigidTransform.concatenate([T_world_cam]))
    return Log(path="one frame", object_poses={"": poses}, landmark_map=landmark_map, T_world_cam=truth)


def seen(ids: list[int], turn_deg: float = 0.0, seed: int = 0) -> RigidTransform:
    """Return T_cam_obj of some objects, each turned by a random error of so many degrees."""
    T_true = T_world_cam.inv() * landmark_map.T_world_obj[np.array(ids) - 1]
    axes = np.random.default_rng(seed).standard_normal((len(ids), 3))
    axes *= np.radians(turn_deg) / np.linalg.norm(axes, axis=1, keepdims=True)
    return make_pose(Rotation.from_rotvec(axes) * T_true.rotation, T_true.translation)


def solved(T_cam_obj: RigidTransform, ids: list[int], mode: str = "all") -> np.ndarray:
    """Return where the solver puts the camera."""
    return poet_loc.localize(log_of(T_cam_obj, ids), LocalizeOptions(mode=mode)).trajectory.T_world_body.translation[0]


def miss_mm(T_cam_obj: RigidTransform, ids: list[int], mode: str = "all") -> float:
    """Return how far the solved camera is from the true one."""
    return float(1e3 * np.linalg.norm(solved(T_cam_obj, ids, mode) - T_world_cam.translation))


# %% [markdown]
# ## One object
# Perfect detections give a perfect camera. But an error of three degrees in the object's *rotation* moves the camera by
# the lever arm: $3° \cdot 2\,m \approx 10\,cm$.

# %%
exact, turned = miss_mm(seen([1]), [1]), miss_mm(seen([1], turn_deg=3.0), [1])
distance = np.linalg.norm(T_world_cam.translation - places[0])
print(f"exact {exact:.6f} mm, turned by 3 deg {turned:.0f} mm at {distance:.2f} m")

# %% [markdown]
# ## Two, many
# Errors of different objects differ, so their mean is better: roughly by the square root of their number.

# %%
trials = {
    n: [miss_mm(seen(list(range(1, n + 1)), 3.0, seed), list(range(1, n + 1))) for seed in range(40)] for n in (1, 2, 4)
}
for n, misses in trials.items():
    print(f"{n} objects: {np.sqrt(np.mean(np.square(misses))):5.1f} mm RMSE")

# %% [markdown]
# ## An outlier, and the modes
# One of four objects is mistaken by half a turn. `all` averages it in; `out` and `prev` look for the largest set of
# votes that agree; `robust` weighs votes by covariance and refuses the one that contradicts; `best` is an oracle that
# picks the vote nearest to the truth, a bar to measure against and no method.

# %%
ids = [1, 2, 3, 4]
spoiled = seen(ids, turn_deg=1.5, seed=5)
half_turn = Rotation.from_rotvec([[0, 0, np.pi * (k == 2)] for k in range(4)])
spoiled = make_pose(spoiled.rotation * half_turn, spoiled.translation)
misses = {mode: miss_mm(spoiled, ids, mode) for mode in ("all", "out", "prev", "best", "robust")}
for mode, miss in misses.items():
    print(f"{mode:7s} {miss:7.1f} mm")

# %% [markdown]
# From above: each object's vote for where the camera is. The third is seen half a turn wrong, so it votes for the other
# side of the table, and drags the mean of all with it.

# %%
votes = (landmark_map.T_world_obj * spoiled.inv()).translation
figure = Figure(figsize=(8.4, 3.4), layout="constrained")
axes = figure.subplots()
objects = landmark_map.T_world_obj.translation
axes.plot(*objects[:, :2].T, "D", color="black", markerfacecolor="white", label="landmarks")
axes.plot(*votes[:, :2].T, "o", color="#56B4E9", label="votes")
for number, (x, y, _) in zip(ids, votes, strict=True):
    axes.annotate(str(number), (x, y), xytext=(4, 6 * number - 16), textcoords="offset points", fontsize=7)
axes.plot(*T_world_cam.translation[:2], "*", color="black", markersize=12, label="true camera", zorder=1)
for mode, colour in (("all", "#D55E00"), ("robust", "#009E73")):
    axes.plot(*solved(spoiled, ids, mode)[:2], "x", color=colour, markersize=9, markeredgewidth=2, label=mode)
axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", ylim=(-0.8, 0.8))
axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
figure

# %% [markdown]
# Who was refused is part of the result, as is the covariance of the pose.

# %%
robust = poet_loc.localize(log_of(spoiled, ids), LocalizeOptions(mode="robust"))
print("votes used:", robust.result.estimates.voted, " refused:", robust.result.voter_columns["refused"][0])
sigma = np.sqrt(np.diag(robust.estimate.pose_covariances[0]))
print("1-sigma of the position, mm:", np.round(1e3 * sigma[3:], 1))

# %% [markdown]
# ## What must hold

# %%
assert exact < 1e-6
assert 0.0 < turned <= np.radians(3.0) * distance * 1e3 + 1e-6
rmse = {n: np.sqrt(np.mean(np.square(values))) for n, values in trials.items()}
assert rmse[4] < rmse[2] < rmse[1]
assert np.argmax(np.linalg.norm(votes - T_world_cam.translation, axis=1)) == 2
assert misses["all"] > 5 * misses["out"]
assert misses["all"] > 5 * misses["robust"]
assert robust.result.voter_columns["refused"][0] == "3:0"
assert np.all(sigma > 0)
