"""Object poses and known camera poses become a map of landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from landmarks.landmark_map import map_arrays
from poet_loc.core.geometry import chordal_mean, make_pose
from poet_loc.core.input_error import InputError
from poet_loc.core.records import Landmark, LandmarkMap, ObjectPoses, Symmetry
from poet_loc.core.trajectory import Trajectory

Array = NDArray[np.float64]

_SEEDS = 128  # samples that may start the mean, and by which each start is judged
_STEPS = 50
_CONVERGED = 1e-12


@dataclass(frozen=True)
class MapOptions:
    """How samples of an object's world pose become a landmark, and when they are refused."""

    inlier_distance: float = 0.1
    """Samples at this distance from the mean weigh a quarter, farther ones less, m."""
    inlier_angle_deg: float = 10.0
    """The same for the angle, deg."""
    max_spread_mm: float = 30.0
    """An object whose world position scatters more (median distance from the mean) is refused."""
    max_spread_deg: float = 5.0
    """The same for its world attitude."""
    min_inlier_share: float = 0.5
    """... and one with a smaller share of samples inside the inlier distance and angle."""
    min_samples: int = 5
    """... and one seen less often."""
    max_gap_s: float = 0.1
    """A camera pose is interpolated between poses at most this far apart, s."""
    correlation_s: float = 1.0
    """Samples so close in time share their error: the covariance of the mean counts them once, s."""


@dataclass(frozen=True)
class LandmarkSpread:
    """How well the samples of one object agree on where it stands."""

    object_id: int
    instance: int
    samples: int
    inlier_share: float
    spread_mm: float
    """Median distance from the mean."""
    spread_deg: float
    refused: str = ""
    """Why the object is not in the map; empty: it is."""


@dataclass(frozen=True)
class BuiltMap:
    """The landmarks that could be built, and the spread of every object, refused ones included."""

    landmark_map: LandmarkMap
    spreads: tuple[LandmarkSpread, ...] = field(default_factory=tuple)

    @property
    def refused(self) -> tuple[LandmarkSpread, ...]:
        """Objects that are not in the map."""
        return tuple(spread for spread in self.spreads if spread.refused)


def build_map(
    object_poses: ObjectPoses,
    T_world_cam: Trajectory,
    options: MapOptions | None = None,
    symmetries: Mapping[int, Symmetry] | None = None,
    names: Mapping[int, str] | None = None,
) -> BuiltMap:
    """Return a landmark for each (object_id, instance): the robust mean of T_world_cam * T_cam_obj over the frames.

    symmetries and names are by object id; a symmetric object's samples are turned to agree before they are averaged.
    Geman-McClure weights, started from the sample that most samples agree with. Raises InputError where no detection
    falls inside the trajectory.
    """
    options = options or MapOptions()
    symmetries, names = symmetries or {}, names or {}
    poses, inside = T_world_cam.interpolate(object_poses.stamps_ns, round(options.max_gap_s * 1e9))
    if not inside.any():
        what = "no detection falls inside the span of the camera's trajectory"
        raise InputError(what, fix="bring the stamps of both to one clock, in nanoseconds")
    T_world_obj = poses * object_poses.T_cam_obj
    keys = np.column_stack([object_poses.object_ids, object_poses.instances])
    landmarks, spreads = [], []
    for object_id, instance in np.unique(keys[inside], axis=0).tolist():
        mine = inside & (object_poses.object_ids == object_id) & (object_poses.instances == instance)
        samples = _Samples(
            object_poses.stamps_ns[mine],
            T_world_obj[mine].rotation.as_matrix(),
            T_world_obj[mine].translation,
            symmetries.get(object_id),
        )
        landmark, spread = _built((object_id, instance), samples, names.get(object_id, ""), options)
        spreads.append(spread)
        if not spread.refused:
            landmarks.append(landmark)
    return BuiltMap(LandmarkMap(tuple(landmarks)), tuple(spreads))


@dataclass(frozen=True)
class _Samples:
    """World poses of one object, S of them."""

    stamps_ns: NDArray[np.int64]
    rotations: Array
    positions: Array
    symmetry: Symmetry | None

    def __getitem__(self, index: NDArray[np.intp]) -> _Samples:
        return _Samples(self.stamps_ns[index], self.rotations[index], self.positions[index], self.symmetry)

    def errors(self, rotation: Array, position: Array) -> Array:
        """Return xi with sample = pose Exp(xi), position apart, (S, 6), after the symmetric turn that fits best."""
        turned = np.swapaxes(rotation, -1, -2) @ self.turned_to(rotation)
        return np.hstack([Rotation.from_matrix(turned).as_rotvec(), (self.positions - position) @ rotation])

    def turned_to(self, rotation: Array) -> Array:
        """Return the rotations in the symmetric turn nearest to one rotation."""
        if self.symmetry is None:
            return self.rotations
        alone = Landmark(0, make_pose(Rotation.identity(), np.zeros(3)), symmetry=self.symmetry)
        arrays, first = map_arrays(LandmarkMap((alone,))), np.zeros(len(self.rotations), np.intp)
        return arrays.nearest_symmetry(first, self.rotations, np.broadcast_to(rotation, self.rotations.shape))


def _built(key: tuple[int, int], samples: _Samples, name: str, options: MapOptions) -> tuple[Landmark, LandmarkSpread]:
    rotation, position = _seed(samples, options)
    for _ in range(_STEPS):
        weights = 1.0 / (1.0 + _square(samples.errors(rotation, position), options)) ** 2
        before = rotation, position
        rotation = chordal_mean(samples.turned_to(rotation), weights)
        position = np.average(samples.positions, axis=0, weights=weights)
        if max(np.abs(rotation - before[0]).max(), np.abs(position - before[1]).max()) < _CONVERGED:
            break
    errors = samples.errors(rotation, position)
    covariance = _covariance_of_mean(samples.stamps_ns, errors, options)
    pose = make_pose(Rotation.from_matrix(rotation), position)
    landmark = Landmark(key[0], pose, key[1], name, covariance, samples.symmetry)
    return landmark, _spread(key, errors, options)


def _seed(samples: _Samples, options: MapOptions) -> tuple[Array, Array]:
    """Return the sample, of some spread evenly over time, that agrees best with the others."""
    count = len(samples.stamps_ns)
    few = samples[np.unique(np.linspace(0, count - 1, min(count, _SEEDS)).round().astype(np.intp))]
    losses = []
    for rotation, position in zip(few.rotations, few.positions, strict=True):
        square = _square(few.errors(rotation, position), options)
        losses.append(float(np.sum(square / (1.0 + square))))
    best = int(np.argmin(losses))
    return few.rotations[best], few.positions[best]


def _square(errors: Array, options: MapOptions) -> Array:
    """Return the squared distance from the mean in units of the inlier distance and angle."""
    scale = np.repeat([np.radians(options.inlier_angle_deg), options.inlier_distance], 3)
    return np.asarray(np.sum((errors / scale) ** 2, axis=-1))


def _spread(key: tuple[int, int], errors: Array, options: MapOptions) -> LandmarkSpread:
    angle_deg = np.degrees(np.linalg.norm(errors[:, :3], axis=1))
    distance_mm = 1e3 * np.linalg.norm(errors[:, 3:], axis=1)
    inlier_share = float(np.mean(_square(errors, options) < 1.0))
    spread_mm, spread_deg = (float(np.median(each)) for each in (distance_mm, angle_deg))
    reasons = [
        (len(errors) < options.min_samples, f"seen {len(errors)} times only"),
        (inlier_share < options.min_inlier_share, f"only {inlier_share:.0%} of its poses agree"),
        (spread_mm > options.max_spread_mm, f"its position scatters by {spread_mm:.0f} mm"),
        (spread_deg > options.max_spread_deg, f"its attitude scatters by {spread_deg:.1f} deg"),
    ]
    refused = ", ".join(reason for applies, reason in reasons if applies)
    return LandmarkSpread(*key, len(errors), inlier_share, spread_mm, spread_deg, refused)


def _covariance_of_mean(stamps_ns: NDArray[np.int64], errors: Array, options: MapOptions) -> Array | None:
    """Return (6, 6) of xi with T_true = T_world_obj Exp(xi); None where too few samples agree to tell."""
    inside = _square(errors, options) < 1.0
    if inside.sum() < 2:
        return None
    independent = len(np.unique(stamps_ns[inside] // max(round(options.correlation_s * 1e9), 1)))
    return np.asarray(errors[inside].T @ errors[inside] / inside.sum() / independent)
