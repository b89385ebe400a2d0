# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 1 · One image
#
# From pixels to object poses: the embedded network looks at a rendered image that it was not trained on. Boxes
# become queries, each query looks at a handful of points, out comes a pose, and a comparison with the object's model
# makes it better and says how sure it is.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image

from poet_loc.data.render import RenderOptions, render
from poet_loc.data.samples import to_tensor
from poet_loc.detect.attention_overlay import draw_attention
from poet_loc.detect.options import DetectOptions
from poet_loc.detect.overlay import draw_overlay
from poet_loc.detect.stage import sightings
from poet_loc.io.bop import read_bop_scene
from poet_loc.model.attention_points import attend
from poet_loc.model.backbone import batch_images
from poet_loc.model.embedded import load_embedded
from poet_loc.model.object_views import render_points, seen_in_images, views_of

folder = Path(tempfile.mkdtemp())
views = RenderOptions(folder, "test", 3, 950000, 3, masks=False, depth=False, jobs=1, progress=False)
scene_folder = render(views) / "950000"
pictures = sorted((scene_folder / "rgb").iterdir())


def show(*images: np.ndarray) -> Figure:
    """Return a figure of images side by side."""
    figure = Figure(figsize=(4.2 * len(images), 3.2), layout="constrained")
    for axes, image in zip(np.atleast_1d(figure.subplots(1, len(images))), images, strict=True):
        axes.imshow(image)
        axes.axis("off")
    return figure


# %% [markdown]
# ## Detections
# The intrinsics belong to each image here, as BOP writes them; with a log they come from its `calibration.yaml`.

# %%
scene = read_bop_scene(scene_folder)
found = []
for picture, K in zip(pictures, scene.camera_matrices, strict=True):
    intrinsics = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    seen = next(iter(sightings(picture, DetectOptions(intrinsics=intrinsics, threads=1))))
    found.append((seen, intrinsics))
    print(f"{picture.name}: objects {seen.object_ids.tolist()}, scores {np.round(seen.scores, 2).tolist()}")

# %% [markdown]
# ## Pose axes
# x red, y green, z blue, 5 cm long.

# %%
drawn = []
for number, (seen, intrinsics) in enumerate(found):
    draw_overlay(seen, intrinsics, 0.05, folder / f"{number}.png")
    drawn.append(np.asarray(Image.open(folder / f"{number}.png")))
show(*drawn)

# %% [markdown]
# ## Attention points
# Where the decoder's last layer looked for the poses of the first image; the larger and brighter, the more it counts.

# %%
network, _ = load_embedded()
first, intrinsics = found[0]
pixels = first.picture.pixels
batch = batch_images([to_tensor(pixels)], torch.tensor([intrinsics]), 32)
output, attention = attend(network, batch)
count = output.queries.counts[0]
points, weights = attention.points[-1, :count].flatten(0, 1), attention.weights[-1, :count].flatten(0, 1)
show(draw_attention(pixels, points.double().numpy(), weights.double().numpy()))

# %% [markdown]
# ## Models beside the image
# The decoder's poses are a start. The refiner looks at each object (above) and at its model, drawn at that pose
# (below), estimates how far one is from the other, and moves the model. Left: at the start; right: after its rounds.

# %%
with torch.no_grad():
    start = network.poses(network.extract(batch), batch.mask, output.queries, batch.intrinsics)
refiner, model = network.refiner, output.queries.classes[0, :count] - 1
pairs = []
for poses in (start, output):
    views = views_of(poses.translation[0, :count], poses.rotation[0, :count], refiner.diameters[model])
    image = seen_in_images(batch.images, batch.intrinsics, torch.zeros(count, dtype=torch.int64), views)
    drawn_model = render_points(refiner.points[model], refiner.colours[model] / 255.0, views)[:, :3]
    rows = [torch.cat(list(row), 2) for row in (image, drawn_model)]
    pairs.append(torch.cat(rows, 1).permute(1, 2, 0).clamp(0, 1).numpy())
show(*pairs)

# %% [markdown]
# ## How wrong, and how sure?
# Each detection is compared with the annotation of the same object; the network's own 1-sigma stands beside the error.

# %%
truth = scene.annotations
names, errors, sigmas = [], [], []
for number, (seen, _) in enumerate(found):
    for row, object_id in enumerate(seen.object_ids):
        same = np.flatnonzero((truth.image_ids == scene.image_ids[number]) & (truth.object_ids == object_id))
        if len(same) == 1:
            error = 1e3 * np.linalg.norm(seen.translations[row] - truth.T_cam_obj[int(same[0])].translation)
            errors.append(error)
            sigmas.append(1e3 * np.sqrt(np.trace(seen.covariances[row][3:, 3:])))
            names.append(f"{object_id}\n({number})")

figure = Figure(figsize=(8.4, 2.6), layout="constrained")
axes = figure.subplots()
axes.bar(names, errors, color="#56B4E9", label="error")
axes.errorbar(
    names, [0.0] * len(names), [[0.0] * len(names), sigmas], fmt="none", ecolor="black", capsize=4, label="1σ"
)
axes.set_xlabel("object (image)")
axes.set_ylabel("position error [mm]")
axes.legend(frameon=False)
figure

# %% [markdown]
# ## What must hold

# %%
assert sum(len(seen.object_ids) for seen, _ in found) >= 3
assert len(errors) >= 2
assert np.median(errors) < 100.0  # objects stand half a metre to a metre away
assert np.mean(np.array(errors) < 3.0 * np.array(sigmas)) > 0.8
for seen, _ in found:
    assert np.all(seen.translations[:, 2] > 0.1)
    assert np.allclose(np.linalg.det(seen.rotations), 1.0)
    assert np.all(np.linalg.eigvalsh(seen.covariances) > 0.0)
assert float(weights.min()) >= 0.0
