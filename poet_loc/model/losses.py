"""What training minimises: translation and rotation errors, or their negative log likelihood."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from poet_loc.core.input_error import InputError
from poet_loc.core.records import Symmetry
from poet_loc.model.heads import cholesky_factor
from poet_loc.model.matcher import BoxMode, Matches, PoseTargets, match
from poet_loc.model.options import NetworkOptions
from poet_loc.model.poet import PoseOutput


@dataclass(frozen=True)
class LossOptions:
    """Which errors count, and how much."""

    translation_weight: float = 2.0
    """lambda_t of the translation loss."""
    rotation_weight: float = 1.0
    """lambda_rot of the rotation loss."""
    auxiliary: bool = True
    """Every decoder layer is trained, not the last one alone."""
    cost_box: float = 1.0
    """Weight of the boxes' distance when queries are matched with objects."""
    cost_class: float = 1.0
    """Weight of a wrong class when queries are matched with objects."""
    symmetry_aware: bool = False
    """Objects with a known symmetry are compared with the nearest pose that looks the same (not in the paper)."""


def rotation_angle(rotation: Tensor, reference: Tensor) -> Tensor:
    """Return the geodesic distance of matrices (..., 3, 3) in rad, clamped away from 0 and pi by 1e-6 of its cosine."""
    cosine = ((rotation * reference).sum(dim=(-2, -1)) - 1.0) / 2.0
    return torch.acos(cosine.clamp(-1.0 + 1e-6, 1.0 - 1e-6))


def quaternion_wxyz(matrix: Tensor) -> Tensor:
    """Return unit quaternions w, x, y, z (..., 4) of rotation matrices, accurate and differentiable at every angle.

    Source: S. W. Shepperd, "Quaternion from rotation matrix" (1978): the largest component is the pivot.
    """
    m = matrix.flatten(-2).unbind(-1)
    trace = m[0] + m[4] + m[8]
    rows = torch.stack(
        [
            torch.stack([1 + trace, m[7] - m[5], m[2] - m[6], m[3] - m[1]], -1),
            torch.stack([m[7] - m[5], 1 + 2 * m[0] - trace, m[1] + m[3], m[2] + m[6]], -1),
            torch.stack([m[2] - m[6], m[1] + m[3], 1 + 2 * m[4] - trace, m[5] + m[7]], -1),
            torch.stack([m[3] - m[1], m[2] + m[6], m[5] + m[7], 1 + 2 * m[8] - trace], -1),
        ],
        dim=-2,
    )  # (..., 4, 4), each row 4 q_k q
    pivot = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = rows.gather(-2, pivot[..., None, None].expand(*pivot.shape, 1, 4)).squeeze(-2)
    return F.normalize(chosen, dim=-1)


def rotation_vector(matrix: Tensor) -> Tensor:
    """Return v (..., 3) with Exp(v) = matrix and |v| <= pi."""
    quaternion = quaternion_wxyz(matrix)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine_sq = quaternion[..., 1:].square().sum(-1, keepdim=True)
    small = sine_sq < 1e-12
    sine = torch.where(small, torch.ones_like(sine_sq), sine_sq).sqrt()
    scale = torch.where(small, torch.full_like(sine, 2.0), 2.0 * torch.atan2(sine, quaternion[..., :1]) / sine)
    return scale * quaternion[..., 1:]


def nearest_symmetric(rotation: Tensor, reference: Tensor, symmetry: Symmetry) -> Tensor:
    """Return the reference (..., 3, 3), turned about its symmetry axis to where it is nearest to `rotation`."""
    axis = torch.tensor(symmetry.axis, dtype=reference.dtype, device=reference.device)
    axis = axis / axis.norm()
    cross = torch.linalg.cross(torch.eye(3, dtype=axis.dtype, device=axis.device), axis.expand(3, 3)).mT
    relative = rotation.detach().mT @ reference
    # tr(A S(theta)) = const + b cos theta + c sin theta, so its maximum is at atan2(c, b)
    b = relative.diagonal(dim1=-2, dim2=-1).sum(-1) - torch.einsum("i,...ij,j->...", axis, relative, axis)
    c = (relative * cross.mT).sum(dim=(-2, -1))
    angle = torch.atan2(c, b)
    if symmetry.order != "continuous":
        step = 2.0 * math.pi / symmetry.order
        angle = torch.round(angle / step) * step
    turn = (
        torch.outer(axis, axis)
        + angle.cos()[..., None, None] * (torch.eye(3, dtype=axis.dtype, device=axis.device) - torch.outer(axis, axis))
        + angle.sin()[..., None, None] * cross
    )
    return reference @ turn


def gaussian_loss(error: Tensor, uncertainty: Tensor) -> Tensor:
    """Return the mean negative log likelihood of errors (K, 3), without its constant.

    uncertainty (K, 3): log variances, 1/2 (exp(-s) e^2 + s) summed over the axes (A. Kendall and Y. Gal, "What
    uncertainties do we need", 2017, eq. 8); (K, 6): a Cholesky factor L, 1/2 |L^-1 e|^2 + log det L.
    """
    if uncertainty.shape[-1] == 3:
        return 0.5 * (torch.exp(-uncertainty) * error.square() + uncertainty).sum() / len(error)
    factor = cholesky_factor(uncertainty)
    white = torch.linalg.solve_triangular(factor, error[..., None], upper=False)[..., 0]
    log_determinant = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return (0.5 * white.square().sum(-1) + log_determinant).sum() / len(error)


class PoseLoss:
    """Matches queries with objects and adds up the losses of every output.

    Without a match the loss is zero, with zero gradients, instead of 0 / 0.
    """

    def __init__(
        self,
        network: NetworkOptions,
        options: LossOptions,
        box_mode: BoxMode,
        symmetries: Mapping[int, Symmetry] | None = None,
    ) -> None:
        if options.symmetry_aware and network.rotation != "6d":
            raise InputError(f"symmetry_aware needs rotation 6d, not {network.rotation}")
        self.network, self.options, self.box_mode = network, options, box_mode
        self.symmetries = dict(symmetries or {}) if options.symmetry_aware else {}

    def __call__(self, output: PoseOutput, targets: Sequence[PoseTargets]) -> dict[str, Tensor]:
        """Return `total` and its parts loss_trans, loss_rot, loss_trans_0, loss_rot_0, ... by the official names."""
        specific = self.network.class_mode == "specific"
        costs = self.options.cost_box, self.options.cost_class
        matches = match(output.queries, targets, self.box_mode, specific, *costs)
        losses = self._parts(output, targets, matches, "")
        if self.options.auxiliary:
            for layer, earlier in enumerate(output.auxiliary):
                losses |= self._parts(earlier, targets, matches, f"_{layer}")
        weights = {"trans": self.options.translation_weight, "rot": self.options.rotation_weight}
        total = sum((weights[name.split("_")[1]] * value for name, value in losses.items()), start=torch.zeros(()))
        return {"total": total, **losses}

    def _parts(
        self, output: PoseOutput, targets: Sequence[PoseTargets], matches: Matches, suffix: str
    ) -> dict[str, Tensor]:
        names = f"loss_trans{suffix}", f"loss_rot{suffix}"
        if len(matches) == 0:
            nothing = 0.0 * (output.translation.sum() + output.rotation.sum())
            for uncertainty in (output.translation_uncertainty, output.rotation_uncertainty):
                nothing = nothing if uncertainty is None else nothing + 0.0 * uncertainty.sum()
            return dict.fromkeys(names, nothing)
        index = matches.images, matches.queries
        true_t = _gather(matches, [target.translation for target in targets])
        true_r = _gather(matches, [target.rotation for target in targets])
        t, r = output.translation[index], output.rotation[index]
        if output.translation_uncertainty is not None and output.rotation_uncertainty is not None:
            true_r = self._seen_alike(r, true_r, targets, matches)
            return {
                names[0]: gaussian_loss(true_t - t, output.translation_uncertainty[index]),
                names[1]: gaussian_loss(rotation_vector(r @ true_r.mT), output.rotation_uncertainty[index]),
            }
        translation = torch.linalg.vector_norm(t - true_t, dim=-1).mean()
        return {names[0]: translation, names[1]: self._rotation(r, true_r, targets, matches)}

    def _rotation(self, r: Tensor, true_r: Tensor, targets: Sequence[PoseTargets], matches: Matches) -> Tensor:
        if self.network.rotation == "6d":
            return rotation_angle(r, self._seen_alike(r, true_r, targets, matches)).mean()
        agreement = (r * quaternion_wxyz(true_r)).sum(-1)
        if self.network.rotation == "quat":
            return -torch.log(agreement.square() + 1e-4).mean()
        return torch.log(1.0 - agreement.abs() + 1e-4).mean()

    def _seen_alike(self, r: Tensor, true_r: Tensor, targets: Sequence[PoseTargets], matches: Matches) -> Tensor:
        if not self.symmetries:
            return true_r
        labels = _gather(matches, [target.labels for target in targets])
        nearest = true_r.clone()
        for label, symmetry in self.symmetries.items():
            chosen = labels == label
            nearest[chosen] = nearest_symmetric(r[chosen], true_r[chosen], symmetry)
        return nearest


def _gather(matches: Matches, columns: Sequence[Tensor]) -> Tensor:
    starts = torch.tensor([0, *(len(column) for column in columns)]).cumsum(0)[:-1].to(matches.images.device)
    return torch.cat(list(columns))[starts[matches.images] + matches.targets]
