"""What a run found, as figures and recordings take it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from poet_loc.core.records import Camera, LandmarkMap, ObjectPoses
from poet_loc.core.trajectory import Trajectory
from poet_loc.report.evaluate import Body, Estimate, Evaluation
from poet_loc.report.fused import Fused, Gates
from poet_loc.report.seen_images import SeenImages

Mask = NDArray[np.bool_]
Stamps = NDArray[np.int64]

REFUSED, POSITION_ONLY, ROTATION_ONLY, ACCEPTED = range(4)
DECISIONS = ("refused", "position only", "rotation only", "accepted")


@dataclass(frozen=True)
class RunRecord:
    """Estimates, what they were made from, and what is true, as far as it is known; all on the camera's clock."""

    estimates: tuple[Estimate, ...]
    references: Mapping[Body, Trajectory] = field(default_factory=dict)
    evaluation: Evaluation | None = None
    fused: tuple[Fused, ...] = ()
    """The full states behind the fused estimates."""
    landmark_map: LandmarkMap | None = None
    detections: ObjectPoses | None = None
    voted: Mapping[str, Mask] = field(default_factory=dict)
    """By the estimate's name, (D,): which detections it used."""
    camera: Camera | None = None
    T_cam_imu: RigidTransform | None = None
    images: SeenImages | None = None

    @property
    def start_ns(self) -> int:
        """The first stamp of anything: the zero of the time axes."""
        stamps = [estimate.trajectory.stamps_ns for estimate in self.estimates]
        stamps += [reference.stamps_ns for reference in self.references.values()]
        return min((int(column[0]) for column in stamps if len(column)), default=0)

    @property
    def decisions(self) -> dict[str, Decisions]:
        """What each estimate made of each detection, by the estimate's name."""
        found = {}
        if self.detections is not None:
            for name, voted in self.voted.items():
                found[name] = Decisions.of_votes(self.detections, voted)
        for fused in self.fused:
            if fused.gate is not None:
                found[fused.name] = Decisions.of_gate(fused.gate, int(fused.stamps_ns[0]))
        return found

    def landmark_label(self, object_id: int, instance: int) -> str:
        """Return a landmark's name, or its id where it has none; a negative id stands for a whole camera pose."""
        if object_id < 0:
            return "camera pose"
        for landmark in self.landmark_map or ():
            if landmark.key == (object_id, instance) and landmark.name:
                return f"{landmark.name} #{instance}" if instance else str(landmark.name)
        return f"object {object_id}" + (f" #{instance}" if instance else "")


@dataclass(frozen=True)
class Decisions:
    """What an estimator made of M measurements of landmarks."""

    stamps_ns: Stamps
    keys: NDArray[np.int64]
    """(M, 2) object id and instance"""
    decisions: NDArray[np.int64]
    """(M,) index into DECISIONS"""

    @classmethod
    def of_votes(cls, detections: ObjectPoses, voted: Mask) -> Decisions:
        """Return the decisions of a solver: a vote counts or does not."""
        keys = np.stack([detections.object_ids, detections.instances], axis=1)
        return cls(detections.stamps_ns, keys, np.where(voted, ACCEPTED, REFUSED))

    @classmethod
    def of_gate(cls, gate: Gates, start_ns: int) -> Decisions:
        """Return the decisions of a filter, which accepts position and rotation each by itself, since its start.

        The poses until then made the start: nothing was decided about them.
        """
        since = gate.stamps_ns > start_ns
        keys = np.stack([gate.object_ids, gate.instances], axis=1)
        decisions = POSITION_ONLY * gate.position_accepted + ROTATION_ONLY * gate.rotation_accepted
        return cls(gate.stamps_ns[since], keys[since], decisions[since].astype(np.int64))

    def lanes(self) -> dict[tuple[int, int], tuple[Stamps, NDArray[np.int64]]]:
        """Return stamps and decisions of each landmark, by its key in ascending order."""
        found = {}
        for object_id, instance in np.unique(self.keys, axis=0).tolist():
            of_landmark = (self.keys == (object_id, instance)).all(axis=1)
            found[object_id, instance] = (self.stamps_ns[of_landmark], self.decisions[of_landmark])
        return found
