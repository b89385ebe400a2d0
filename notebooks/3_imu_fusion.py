# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 3 · IMU fusion
#
# One log, two estimators on the same measurements: the error-state Kalman filter and the fixed-lag factor graph. The
# question that matters most is asked last: **do the errors stay inside the sigmas that the estimators claim?**

# %%
# %matplotlib inline
import numpy as np

import poet_loc
from fusion.simulate import SimulationOptions, simulate

# %% [markdown]
# A simulated hand-held flight over a table with eight objects: an IMU at 200 Hz whose biases wander, object poses at
# 30 Hz with white noise whose covariance is written into the log. (A real network's errors are not white: see the
# documentation on correlated errors and `SimulationOptions(noise="network")`.)

# %%
log = simulate(SimulationOptions(duration_s=12.0, noise="white", seed=1))
print(f"{len(log.imu)} IMU samples, {len(log.detections()[1])} detections of {len(log.landmark_map)} landmarks")

# %% [markdown]
# The noise is white here, so the states for lasting errors of each object are switched off.

# %%
from fusion.options import DetectionBias

white = DetectionBias(use=False)
eskf = poet_loc.fuse(log, poet_loc.FuseOptions(bias=white))
graph = poet_loc.fuse(log, poet_loc.FuseOptions(estimator="graph", bias=white))
both = poet_loc.evaluate(poet_loc.localize(log), eskf, graph)
both

# %% [markdown]
# ## Errors against 3 sigma
# The filter knows at every stamp what was measured until then.

# %%
eskf.plot("errors")

# %% [markdown]
# The factor graph, as causal as the filter here, looks back two seconds before it settles on anything. On white noise
# that buys nothing, and its claims agree with the filter's: two programs, one estimate.

# %%
graph.plot("errors")

# %% [markdown]
# ## Consistency
# NEES per degree of freedom is 1 for an estimator that knows its own errors, above 1 for one that is too sure.

# %%
for name in (eskf.name, graph.name):
    row = both.summary[name]
    print(f"{name}: NEES {row['nees']['pose']:.2f}, RMSE {row['position_error_mm']['norm']['rmse']:.1f} mm")
eskf.plot("consistency")

# %% [markdown]
# The biases were found, too.

# %%
from fusion.simulate import simulate_with_truth

truth = simulate_with_truth(SimulationOptions(duration_s=12.0, noise="white", seed=1))[1]
bias_error = eskf.result.gyroscope_bias[-1] - truth.gyroscope_bias[-1]
print("error of the gyroscope bias at the end, in sigma:", np.round(bias_error / eskf.result.sigmas[-1, 9:12], 2))

# %% [markdown]
# ## What must hold

# %%
for name in (eskf.name, graph.name):
    row = both.summary[name]
    assert row["position_error_mm"]["norm"]["rmse"] < 15.0
    assert row["coverage"] > 0.9
    assert 0.2 < row["nees"]["pose"] < 3.0
    assert min(row["inside_3_sigma"].values()) > 0.9
solved = both.summary["localize/robust"]["on_common_frames"]["position_error_mm"]["norm"]["rmse"]
assert both.summary[eskf.name]["on_common_frames"]["position_error_mm"]["norm"]["rmse"] < solved
np.testing.assert_allclose(
    eskf.trajectory.interpolate(graph.trajectory.stamps_ns[100:-100:50])[0].translation,
    graph.trajectory.T_world_body[100:-100:50].translation,
    atol=0.01,
)
assert np.all(np.abs(bias_error) < 5 * eskf.result.sigmas[-1, 9:12])
