# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 5 · Your own log
#
# What is needed: the object poses that your network saw, the map of the objects, and for fusion an IMU with its
# calibration. This notebook writes such files as another program would, brings them into a log folder, has the doctor
# look at them, fits the noise, and fuses. Each step is also a command:
#
#     poet-loc convert ...            # ROS bags, EuRoC, BOP, PoET's results.json, TUM: see the page on formats
#     poet-loc check LOG              # what is wrong with it, and how to repair it
#     poet-loc fit-noise LOG --out noise.yaml
#     poet-loc run LOG --out RUN --noise-from noise.yaml

# %%
# %matplotlib inline
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import poet_loc
from fusion.fit_noise import fit_noise
from fusion.simulate import SimulationOptions, simulate
from poet_loc.io.log_folder import write_log

folder = Path(tempfile.mkdtemp())

# %% [markdown]
# ## The files
# A log is a folder. Stamps are integer nanoseconds of one clock, lengths metres, quaternions scalar last.

# %%
mine = folder / "mine"
mine.mkdir()
write_log(mine, simulate(SimulationOptions(duration_s=20.0, objects=6, symmetric_objects=0, covariances=False, seed=4)))
for path in sorted(mine.iterdir()):
    print(f"{path.name:22s}{path.stat().st_size / 1e3:9.0f} kB")
print((mine / "object_poses.csv").read_text()[:180])

# %% [markdown]
# ## A mistake is told in one line
# The commonest one is millimetres. The reader refuses what cannot be, with file, line, and what to do.

# %%
lines = (mine / "object_poses.csv").read_text().splitlines()
cells = [line.split(",") for line in lines[1:]]
columns = lines[0].split(",")
for name in ("tx", "ty", "tz"):
    k = columns.index(name)
    for row in cells:
        row[k] = str(1e3 * float(row[k]))
wrong = folder / "wrong"
wrong.mkdir()
write_log(wrong, replace(poet_loc.read_log(mine), path=wrong))
(wrong / "object_poses.csv").write_text("\n".join([lines[0], *map(",".join, cells)]) + "\n")
complaint = ""
try:
    poet_loc.read_log(wrong)
except poet_loc.InputError as error:
    complaint = str(error).replace(str(folder), "...")
print(complaint)

# %% [markdown]
# ## Noise from a log with ground truth
# One log with motion capture is enough to learn what your network gets wrong: what is white, what lasts for
# seconds, what stays.

# %%
log = poet_loc.read_log(mine)
fitted = fit_noise([log])
for name, part in fitted.parts.items():
    print(
        f"{name:9s} white {part.white:.4f}  varying {part.varying:.4f} over {part.correlation_s:.1f} s"
        f"  steady {part.steady:.4f}"
    )
noise, bias = fitted.options()

# %% [markdown]
# ## Fuse

# %%
fused = poet_loc.fuse(log, poet_loc.FuseOptions(noise=noise, bias=bias))
fused

# %% [markdown]
# Without ground truth the same calls work; then there are sigmas, but no errors.

# %%
blind = poet_loc.fuse(replace(log, T_world_cam=None, T_world_imu=None), poet_loc.FuseOptions(noise=noise, bias=bias))
blind.plot()

# %% [markdown]
# ## What must hold

# %%
assert "millimetres" in complaint
assert fitted.detections > 1000
assert 0.0 <= fitted.gross_share < 0.3
assert all(part.white > 0.0 for part in fitted.parts.values())
assert blind.evaluation is None
np.testing.assert_allclose(blind.trajectory.T_world_body.translation, fused.trajectory.T_world_body.translation)
settled = fused.evaluation["fuse/eskf/objects"]
assert np.median(np.linalg.norm(settled.errors[:, :3], axis=1)) < 0.05
