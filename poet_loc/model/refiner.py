"""Corrects estimated poses: compares the image with a view of each object's model, and moves the model until they fit.

A small network sees both views and says of each cell how far the image's object is from the model's, and how sure that
is; the pose follows in closed form (`flow_pose`). A few rounds, each from a new view, end at the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from poet_loc.core.input_error import at_least
from poet_loc.model.flow_pose import CELL, flow_jacobian, solve_flow, step_pose
from poet_loc.model.object_views import Views, render_points, seen_in_images, views_of
from poet_loc.model.residual import ResidualBlock, convolve

_CHANNELS = 10  # seen colours, drawn colours, object coordinates, drawn
_CLASS_CODE = 64
_WEIGHTS = (-6.0, 4.0)  # least and largest logarithm of a weight


@dataclass(frozen=True)
class RefinerOptions:
    """Everything that a refiner's weights depend on."""

    class_count: int = 10
    points: int = 4000
    """Coloured points per model; they are part of the weights."""
    widths: tuple[int, int, int] = (48, 96, 96)
    """Channels of the maps of 32, 16 and 8 cells."""
    rounds: int = 3
    """Comparisons, one after the other."""

    def __post_init__(self) -> None:
        at_least(1, self, "class_count", "points", "rounds")


@dataclass(frozen=True)
class Estimates:
    """K objects in a batch of images, and where they are thought to be."""

    image: Tensor
    """(K,) number in the batch."""
    classes: Tensor
    """(K,) from 1."""
    translation: Tensor
    """(K, 3) t_cam_obj, m."""
    rotation: Tensor
    """(K, 3, 3) R_cam_obj."""
    log_variance: Tensor | None = None
    """(K, 6) of e_t (m^2) and of e_r (rad^2) in R = Exp(e_r) R_true, camera axes."""


@dataclass(frozen=True)
class Comparison:
    """What one round found out."""

    views: Views
    coordinates: Tensor
    """(K, N, 3) object coordinates of the cells, diameters."""
    drawn: Tensor
    """(K, N) True where the model covers a cell."""
    flow: Tensor
    """(K, N, 2) cells."""
    corrected: Estimates


class PoseRefiner(nn.Module):
    """Network, models and rounds; needs intrinsics."""

    points: Tensor
    colours: Tensor
    diameters: Tensor

    def __init__(self, options: RefinerOptions) -> None:
        """The models are blank until `show` or a checkpoint fills them in."""
        super().__init__()
        self.options = options
        shape = (options.class_count, options.points, 3)
        self.register_buffer("points", torch.zeros(shape))  # diameters
        self.register_buffer("colours", torch.zeros(shape, dtype=torch.uint8))
        self.register_buffer("diameters", torch.ones(options.class_count))  # m
        fine, middle, coarse = options.widths
        entry = nn.Sequential(nn.PixelUnshuffle(2), convolve(4 * _CHANNELS, fine), ResidualBlock(fine))
        self.fine = nn.Sequential(entry, convolve(fine, middle, 2), ResidualBlock(middle))
        self.coarse = nn.Sequential(convolve(middle, coarse, 2), ResidualBlock(coarse))
        self.back = nn.Conv2d(coarse, middle, 1)
        self.merge = ResidualBlock(middle)
        self.flow = nn.Conv2d(middle, 4, 1)
        nn.init.normal_(self.flow.weight, std=0.01)
        nn.init.zeros_(self.flow.bias)  # type: ignore[arg-type]
        self.log_prior = nn.Parameter(torch.full((6,), 2.0))
        self.class_code = nn.Embedding(options.class_count + 1, _CLASS_CODE)
        self.spread = nn.Sequential(nn.Linear(coarse + 7 + _CLASS_CODE, 64), nn.ReLU(), nn.Linear(64, 6))

    def show(self, points: Tensor, colours: Tensor, diameters: Tensor) -> None:
        """Take in models: points (C, P, 3) m in object axes, colours (C, P, 3) uint8, diameters (C,) m."""
        self.points.copy_(points / diameters[:, None, None])
        self.colours.copy_(colours)
        self.diameters.copy_(diameters)

    def forward(self, images: Tensor, intrinsics: Tensor, start: Estimates) -> Estimates:
        """Return corrected estimates; images (B, 3, H, W) in 0..1, intrinsics (B, 4) fx, fy, cx, cy px."""
        if not len(start.classes):
            return replace(start, log_variance=start.translation.new_zeros(0, 6))
        for _ in range(self.options.rounds):
            start = self.compare(images, intrinsics, start).corrected
        return start

    def compare(self, images: Tensor, intrinsics: Tensor, start: Estimates) -> Comparison:
        """Do one round."""
        model = start.classes - 1
        with torch.autocast(images.device.type, enabled=False):
            views = views_of(start.translation, start.rotation, self.diameters[model])
            seen = seen_in_images(images, intrinsics, start.image, views)
            drawn = render_points(self.points[model], self.colours[model].float() / 255.0, views)
        both = torch.cat([seen - 0.45, drawn[:, :3], 2.0 * drawn[:, 3:6], drawn[:, 6:]], 1)
        fine = self.fine(both.contiguous(memory_format=torch.channels_last))
        coarse = self.coarse(fine)
        finer = F.interpolate(self.back(coarse), scale_factor=2, mode="nearest")
        answer = self.flow(self.merge(fine + finer))
        with torch.autocast(images.device.type, enabled=False):
            return self._correct(start, views, drawn[:, 3:], answer.float(), coarse.float().mean((2, 3)))

    def _correct(self, start: Estimates, views: Views, drawn: Tensor, answer: Tensor, summary: Tensor) -> Comparison:
        share = F.avg_pool2d(drawn[:, 3:], CELL)
        coordinates = (F.avg_pool2d(drawn[:, :3], CELL) / share.clamp(min=1e-6)).flatten(2).mT
        covered = share.flatten(1) > 0.3
        flow, log_weight = answer.flatten(2).mT.split(2, dim=-1)
        weight = log_weight.clamp(*_WEIGHTS).exp() * covered[..., None]
        step, variances = solve_flow(flow_jacobian(coordinates, views), flow, weight, self.log_prior.exp())
        size = self.diameters[start.classes - 1]
        t, R = step_pose(step, views, size)
        known = torch.cat([summary, variances.log(), views.distance.log()[:, None]], 1).detach()
        log_variance = self.spread(torch.cat([known, self.class_code(start.classes)], 1)) - 6.0
        corrected = Estimates(start.image, start.classes, t, R, log_variance)
        return Comparison(views, coordinates, covered, flow, corrected)
