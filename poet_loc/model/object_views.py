"""Views of single objects: what the image shows of each, and what its model shows at an estimated pose.

A virtual camera stands where the real one is, looks along the ray to the object without rolling (`ray_rotation`), and
its focal length lets the object's diameter fill the same share of every view. So views of near and far objects, and of
different cameras, look alike. Lengths are in diameters of the object.  Source: Y. Li et al., "DeepIM" (ECCV 2018),
section 3.2, whose zoomed views these are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from poet_loc.model.variants import ray_rotation

VIEW = 64
"""Pixels per side."""

FILL = 0.8
"""Share of the view that the diameter fills."""

_DEPTH_BITS, _POINT_BITS = 15, 16  # of a z-buffer's entry: depth first, so the least entry is the nearest point


@dataclass(frozen=True)
class Views:
    """Where K objects stand in their views."""

    ray: Tensor
    """(K, 3, 3) from view to camera axes."""
    distance: Tensor
    """(K,) from the camera to the origin, diameters."""
    rotation: Tensor
    """(K, 3, 3) of the object in view axes."""

    @property
    def focal(self) -> Tensor:
        """(K,) px."""
        return VIEW * FILL * self.distance


def views_of(translation: Tensor, rotation: Tensor, diameters: Tensor) -> Views:
    """Return the views of objects at t_cam_obj (K, 3) m and R_cam_obj (K, 3, 3) with diameters (K,) m."""
    ray = ray_rotation(translation)
    return Views(ray, translation.norm(dim=1) / diameters, ray.mT @ rotation)


def seen_in_images(images: Tensor, intrinsics: Tensor, image: Tensor, views: Views) -> Tensor:
    """Return what images (B, 3, H, W) with intrinsics (B, 4) show in views (K, 3, VIEW, VIEW), zero outside.

    image (K,) says whose object each is; pixel centres are at integers.
    """
    pixel = torch.arange(VIEW, device=images.device) - (VIEW - 1) / 2
    v, u = torch.meshgrid(pixel, pixel, indexing="ij")
    plane = torch.stack([u, v], -1) / views.focal[:, None, None, None]
    rays = torch.cat([plane, torch.ones_like(plane[..., :1])], -1) @ views.ray.mT[:, None]
    focal, centre = intrinsics[image, None, None, :2], intrinsics[image, None, None, 2:]
    place = focal * rays[..., :2] / rays[..., 2:].clamp(min=1e-3) + centre
    grid = 2 * (place + 0.5) / torch.tensor(images.shape[:1:-1], device=images.device) - 1
    seen = torch.zeros(len(image), 3, VIEW, VIEW, device=images.device)
    for b in image.unique():
        own = torch.nonzero(image == b)[:, 0]
        rows = F.grid_sample(images[b, None].float(), grid[own].flatten(0, 1)[None], align_corners=False)
        seen[own] = rows[0].unflatten(1, (len(own), VIEW)).transpose(0, 1)
    return seen


def render_points(points: Tensor, colours: Tensor, views: Views) -> Tensor:
    """Draw coloured points in views -> (K, 7, VIEW, VIEW): colour, object coordinates in diameters, 1 where drawn.

    points (K, P, 3) in object axes, diameters; colours (K, P, 3) 0..1.  Each point covers the four pixels around it;
    of those that meet the nearest stays.
    """
    count, number = points.shape[:2]
    placed = points @ views.rotation.mT
    depth = 1.0 + placed[..., 2] / views.distance[:, None]  # of the distance
    corner = VIEW * FILL * placed[..., :2] / depth[..., None] + (VIEW - 1) / 2
    u, v = corner.floor().long().unbind(-1)
    cells = []
    for x, y in ((u, v), (u + 1, v), (u, v + 1), (u + 1, v + 1)):
        inside = (x >= 0) & (x < VIEW) & (y >= 0) & (y < VIEW) & (depth > 0.05)
        cells.append(torch.where(inside, y * VIEW + x, VIEW * VIEW))
    level = (depth.clamp(0.0, 8.0) * (1 << _DEPTH_BITS)).long() << _POINT_BITS
    entry = (level + torch.arange(number, device=points.device)).repeat(1, 4)
    empty = 1 << 40
    buffer = torch.full((count, VIEW * VIEW + 1), empty, dtype=torch.int64, device=points.device)
    buffer = buffer.scatter_reduce(1, torch.cat(cells, 1), entry, "amin")[:, :-1]
    drawn = buffer < empty
    nearest = torch.where(drawn, buffer % (1 << _POINT_BITS), 0)[..., None].expand(-1, -1, 3)
    shown = [torch.gather(colours, 1, nearest), torch.gather(points, 1, nearest), torch.ones_like(nearest[..., :1])]
    picture = torch.cat([part.float() for part in shown], -1) * drawn[..., None]
    return picture.mT.unflatten(2, (VIEW, VIEW))
