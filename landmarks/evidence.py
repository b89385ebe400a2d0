"""Which hypothesis to believe: the one that the recent past has supported longest.

One frame with two disagreeing votes is a tie, and one frame with one vote cannot tell whether that is a gross error.
Each hypothesis therefore inherits the evidence of the earlier hypothesis that it continues: with the support s of its
own frame (the sum of its votes' weights), the time dt since then and agree in [0, 1],

    evidence = s + exp(-dt / evidence_s) max over earlier hypotheses of (evidence * agree).

A hypothesis that no vote continues fades, and is still given out while it has more evidence than what the frame
offers, for hold_s at most. Only the choice has a memory: the pose and covariance of a hypothesis stem from one frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from landmarks.options import Memory
from landmarks.weighted_consensus import Hypotheses
from poet_loc.core.records import Stamps

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_CONTINUES = 2.0  # squared difference of white errors on average: one of the position, one of the attitude
_AGREED = 1.5  # support above it means that votes agree: the caster's own counts 1
_VAGUE = 9.0  # times the other's variance
_KEPT = 8  # hypotheses that are carried on from frame to frame


@dataclass(frozen=True)
class _Beliefs:
    """Hypotheses that are alive."""

    rows: Indices
    """Row of the hypotheses."""
    ages: Array
    """Time since a vote supported it, s."""
    evidence: Array

    def __getitem__(self, index: slice | Indices | NDArray[np.bool_]) -> _Beliefs:
        return _Beliefs(self.rows[index], self.ages[index], self.evidence[index])

    def older(self, time_s: float, fade: float, oldest_s: float) -> _Beliefs:
        aged = _Beliefs(self.rows, self.ages + time_s, self.evidence * fade)
        return aged[aged.ages <= oldest_s]


def choose_by_evidence(stamps_ns: Stamps, hypotheses: Hypotheses, memory: Memory) -> tuple[Indices, Array]:
    """Return the hypothesis that each frame believes, (F,), and its age in s: 0 where the frame's own votes cast it.

    Causal. Every frame needs a hypothesis. Equal evidence goes to the smaller covariance, then to the earlier row.
    """
    support = hypotheses.weights.sum(axis=1)
    similarity = _Similarity(hypotheses, memory)
    bounds = np.searchsorted(hypotheses.frame, np.arange(len(stamps_ns) + 1))
    step_s = np.diff(stamps_ns, prepend=stamps_ns[:1]) * 1e-9
    fade = np.exp(-step_s / memory.evidence_s) if memory.evidence_s > 0.0 else np.zeros(len(stamps_ns))
    chosen, age_s = np.empty(len(stamps_ns), np.intp), np.zeros(len(stamps_ns))
    beliefs = _Beliefs(np.empty(0, np.intp), np.empty(0), np.empty(0))
    for frame in range(len(stamps_ns)):
        own = np.arange(bounds[frame], bounds[frame + 1])
        earlier = beliefs.older(step_s[frame], fade[frame], memory.evidence_s)
        beliefs = _continued(_Beliefs(own, np.zeros(len(own)), support[own]), earlier, similarity)
        order = np.lexsort((similarity.variance[beliefs.rows], -np.round(beliefs.evidence, 9)))
        beliefs = beliefs[order]
        # two votes that agree need no memory to be believed
        oldest_s = memory.hold_s if support[own].max() < _AGREED else 0.0
        given = int(np.argmax(beliefs.ages <= oldest_s))
        chosen[frame], age_s[frame] = beliefs.rows[given], beliefs.ages[given]
        beliefs = beliefs[:_KEPT]
    return chosen, age_s


def _continued(own: _Beliefs, earlier: _Beliefs, similarity: _Similarity) -> _Beliefs:
    """Return the frame's own hypotheses with what they inherit, and the earlier ones that they do not replace."""
    if not len(earlier.rows):
        return own
    inherited = earlier.evidence * similarity(own.rows, earlier.rows, earlier.ages)
    parent = np.argmax(inherited, axis=1)
    evidence = own.evidence + inherited[np.arange(len(parent)), parent]
    left = np.ones(len(earlier.rows), bool)
    left[parent[evidence >= earlier.evidence[parent]]] = False
    return _Beliefs(
        np.concatenate([own.rows, earlier.rows[left]]),
        np.concatenate([own.ages, earlier.ages[left]]),
        np.concatenate([evidence, earlier.evidence[left]]),
    )


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
        square = np.sum(apart**2, axis=-1) / (_both(self.variance[own], self.variance[earlier]) + moved)
        square += angle**2 / (_both(self.rotation_variance[own], self.rotation_variance[earlier]) + turned)
        return np.asarray(np.exp(-0.5 * np.maximum(square - _CONTINUES, 0.0)))


def _both(own: Array, earlier: Array) -> Array:
    """Return (n, m) sums of variances; a pose that is hardly known continues a well known one only if it is near."""
    smaller = np.minimum(own[:, None], earlier)
    return np.asarray(smaller + np.minimum(np.maximum(own[:, None], earlier), _VAGUE * smaller))
