"""Which hypothesis to believe: the one that the recent past has supported longest.

One frame with two disagreeing votes is a tie, and one frame with one vote cannot tell whether that is a gross error.
Each hypothesis therefore inherits the evidence of the earlier hypothesis that it continues: with the support s of its
own frame (the sum of its votes' weights), the time dt since then and agree in [0, 1],

    evidence = s + exp(-dt / evidence_s) max over earlier hypotheses of (evidence * agree).

A hypothesis that no vote continues fades, and is still given out while it has more evidence than what the frame
offers, for hold_s at most. Only the choice has a memory: the pose and covariance of a hypothesis stem from one frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from landmarks.options import Memory
from landmarks.weighted_consensus import Hypotheses
from poet_loc.core.records import Stamps

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_CONTINUES = 2.0  # squared difference of white errors on average: one of the position, one of the attitude
_KEPT = 8  # hypotheses that are carried on from frame to frame


def choose_by_evidence(stamps_ns: Stamps, hypotheses: Hypotheses, memory: Memory) -> tuple[Indices, Array]:
    """Return the hypothesis that each frame believes, (F,), and its age in s: 0 where the frame's own votes cast it.

    Causal. Every frame needs a hypothesis. Equal evidence goes to the smaller covariance, then to the earlier row.
    """
    support = hypotheses.weights.sum(axis=1)
    similarity = _Similarity(hypotheses, memory)
    bounds = np.searchsorted(hypotheses.frame, np.arange(len(stamps_ns) + 1))
    step_s = np.diff(stamps_ns, prepend=stamps_ns[:1]) * 1e-9
    fade = np.exp(-step_s / memory.evidence_s) if memory.evidence_s > 0.0 else np.zeros(len(stamps_ns))
    chosen, chosen_age = np.empty(len(stamps_ns), np.intp), np.zeros(len(stamps_ns))
    rows, ages, evidence = np.empty(0, np.intp), np.empty(0), np.empty(0)
    for frame in range(len(stamps_ns)):
        own = np.arange(bounds[frame], bounds[frame + 1])
        ages, evidence = ages + step_s[frame], evidence * fade[frame]
        young = ages <= memory.hold_s
        rows, ages, evidence = rows[young], ages[young], evidence[young]
        own_evidence = support[own]
        if rows.size:
            inherited = evidence * similarity(own, rows, ages)
            parent = np.argmax(inherited, axis=1)
            own_evidence = own_evidence + inherited[np.arange(len(own)), parent]
            continued = parent[own_evidence >= evidence[parent]]
            left = np.ones(len(rows), bool)
            left[continued] = False
            rows, ages, evidence = rows[left], ages[left], evidence[left]
        rows, ages = np.concatenate([own, rows]), np.concatenate([np.zeros(len(own)), ages])
        evidence = np.concatenate([own_evidence, evidence])
        best = np.lexsort((similarity.variance[rows], -np.round(evidence, 9)))[:_KEPT]
        rows, ages, evidence = rows[best], ages[best], evidence[best]
        chosen[frame], chosen_age[frame] = rows[0], ages[0]
    return chosen, chosen_age


class _Similarity:
    """How well a pose continues an earlier one, given what the camera may have moved since."""

    def __init__(self, hypotheses: Hypotheses, memory: Memory) -> None:
        self.positions = hypotheses.t_world_cam
        self.quaternions = Rotation.from_matrix(hypotheses.R_world_cam).as_quat()
        self.rotation_variance = memory.white_share * np.trace(hypotheses.covariances[:, :3, :3], axis1=1, axis2=2)
        self.variance = memory.white_share * np.trace(hypotheses.covariances[:, 3:, 3:], axis1=1, axis2=2)
        self.speed_square = 3.0 * memory.speed**2
        self.rate_square = 3.0 * np.radians(memory.turn_rate_deg) ** 2

    def __call__(self, own: Indices, earlier: Indices, ages: Array) -> Array:
        """Return (n, m) of 1 (fits) to 0 (does not): flat inside, steep outside."""
        apart = self.positions[own][:, None] - self.positions[earlier]
        cosine = np.abs(self.quaternions[own] @ self.quaternions[earlier].T)
        angle = 2.0 * np.arccos(np.minimum(cosine, 1.0))
        moved, turned = self.speed_square * ages**2, self.rate_square * ages**2
        square = np.sum(apart**2, axis=-1) / (self.variance[own][:, None] + self.variance[earlier] + moved)
        square += angle**2 / (self.rotation_variance[own][:, None] + self.rotation_variance[earlier] + turned)
        return np.asarray(np.exp(-0.5 * np.maximum(square - _CONTINUES, 0.0)))
