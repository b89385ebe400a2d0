"""Where the network looked for the poses that it tells."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from poet_loc.detect.estimator import Estimator
from poet_loc.detect.image_source import open_images
from poet_loc.detect.options import DetectOptions
from poet_loc.model.attention_points import attend

Array = NDArray[np.float64]


def attention_of_images(
    source: str | Path, options: DetectOptions | None = None, most: int = 60
) -> dict[int, tuple[Array, Array]]:
    """Return by stamp the points (K, 2), px, and weights (K,) of the decoder's last layer, all objects together.

    At most so many images, evenly spread.  Raises InputError where no image can be read.
    """
    options = options or DetectOptions()
    images = open_images(source, options.stamps, options.rate, options.keyframes)
    estimator = Estimator(options, images.intrinsics, images.path)
    step = max(1, -(-len(images.files) // most))
    looked = {}
    with torch.no_grad():
        for picture in islice(images, 0, most * step, step):
            batch, features = estimator.features([picture])
            queries = estimator.queries([picture], batch, features)
            _, attention = attend(estimator.network, batch, queries)
            count = queries.counts[0]
            if count:
                points, weights = attention.points[-1, :count], attention.weights[-1, :count]
                looked[picture.stamp_ns] = (
                    points.flatten(0, 1).double().cpu().numpy(),
                    weights.flatten().double().cpu().numpy(),
                )
    return looked
