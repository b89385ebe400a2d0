# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 4 · The localisation table
#
# Mean ± standard deviation of the absolute error per axis, for each way of turning votes into a camera pose. The
# command line does this for one log or many:
#
#     poet-loc table LOG [LOG ...] --with-fusion
#
# Here it is done in Python, on a simulated log whose detections have the errors of a real network: correlated over
# seconds, biased per object, grossly wrong in runs.

# %%
# %matplotlib inline
import poet_loc
from fusion.simulate import SimulationOptions, simulate
from landmarks.options import MODES

log = simulate(SimulationOptions(duration_s=20.0, objects=6, seed=2))

# %% [markdown]
# Every mode on the same detections. `best` is an oracle: it looks at the ground truth to pick one vote.

# %%
results = [poet_loc.localize(log, poet_loc.LocalizeOptions(mode=mode)) for mode in MODES]
table = poet_loc.evaluate(*results)
table

# %% [markdown]
# Rows are compared on the frames that all of them have; the coverage says how many of the ground-truth frames those
# are. The same table for a paper:

# %%
print(table.tables[0].latex()[:400], "...")

# %% [markdown]
# From above: the diamonds are the landmarks.

# %%
table.plot("top view")

# %% [markdown]
# ## What must hold
# Averaging in everything is worst where there are outliers, looking for agreement helps, and weighing by covariance
# with a memory helps more. (The published order all > out > prev > best needs three votes or more in most frames.)

# %%
rmse = {
    name.removeprefix("localize/"): row["on_common_frames"]["position_error_mm"]["norm"]["rmse"]
    for name, row in table.summary.items()
}
print({mode: round(value, 1) for mode, value in rmse.items()})
assert set(rmse) == set(MODES)
assert rmse["all"] > rmse["out"]
assert rmse["robust"] < rmse["out"]
assert len({row["on_common_frames"]["frames"] for row in table.summary.values()}) == 1
assert table.summary["localize/best"]["oracle"]
