"""The options of the landmark solver: the one home of their defaults."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from poet_loc.core.input_error import InputError, refuse_other_words, within

Mode = Literal["all", "out", "prev", "best", "robust"]
"""all: every vote is averaged; out: the largest set of votes that agree; prev: the same, ties by the previous frame;
best: the single vote nearest the ground truth, an oracle; robust: weighted consensus with covariances and memory."""

MODES: tuple[Mode, ...] = ("all", "out", "prev", "best", "robust")
ORACLES: tuple[Mode, ...] = ("best",)
"""Modes that look at the ground truth: no method, only a bar to measure against."""

TieRule = Literal["score", "close", "compact", "order"]
"""Which of several equally large sets of agreeing votes wins: the one with the highest sum of scores, the one whose
objects are nearest to the camera on average, the one with the smallest spread, or the first in the order of the map;
what still ties goes to the nearest objects, then to the order of the map."""


@dataclass(frozen=True)
class VoteNoise:
    """What one object pose is off by, where the detections bring no covariance: aligned with the viewing ray."""

    across: float = 0.008
    """1-sigma across the viewing ray, as a share of the distance."""
    along: float = 0.035
    """1-sigma along the viewing ray, as a share of the distance."""
    least: float = 0.002
    """1-sigma in every direction that is added, m: an object that touches the lens is not known without error."""
    rotation_deg: float = 3.0
    """1-sigma of rotation about each axis, deg."""
    use_detections: bool = True
    """Take a detection's own covariance where it brings one."""


@dataclass(frozen=True)
class Memory:
    """What `robust` keeps of the past: which hypotheses about the camera were supported for how long."""

    evidence_s: float = 5.0
    """Time constant with which support from earlier frames fades, s; 0: every frame on its own. A hypothesis that no
    vote supports for so long is forgotten."""
    hold_s: float = 2.0
    """A pose that no vote of the frame supports is given out so long while it has more evidence than the votes, s;
    0: every pose is cast by its own frame."""
    speed: float = 0.25
    """1-sigma of the camera's velocity per axis, m/s: how fast an older pose loses its say."""
    turn_rate_deg: float = 25.0
    """1-sigma of the camera's turn rate per axis, deg/s."""
    white_share: float = 0.25
    """Share of a vote's variance that is new in every frame; the rest lasts for seconds, as networks' errors do."""


@dataclass(frozen=True)
class SolverOptions:
    """How votes become a camera pose."""

    mode: Mode = "robust"
    """all | out | prev | best (an oracle: needs the ground truth) | robust"""
    distance: float = 0.1
    """Votes agree (out, prev) when their positions are at most this far apart, m."""
    angle_deg: float = 10.0
    """... and their attitudes at most this far apart, deg."""
    tie_rule: TieRule = "score"
    """out, and prev in its first frame: score | close | compact | order."""
    position_average: Literal["mean", "median"] = "mean"
    """all, out, prev: average of the positions, per axis."""
    rotation_average: Literal["chordal", "geodesic"] = "chordal"
    """all, out, prev: chordal (nearest to the sum of the matrices) or geodesic (Karcher) mean of the attitudes."""
    vote_weights: Literal["equal", "score"] = "equal"
    """all, out, prev: what a vote weighs in the means."""
    trust_instances: bool = False
    """Of several landmarks of one class, take the one whose instance number the detection brings, not the best fit."""
    noise: VoteNoise = field(default_factory=VoteNoise)
    """Noise of detections without a covariance."""
    gate_probability: float = 0.99
    """robust: share of good detections within the gate; beyond it a detection counts as refused."""
    memory: Memory = field(default_factory=Memory)
    """robust: what is kept of the past."""

    def __post_init__(self) -> None:
        refuse_other_words(self)
        within("(0, 1)", self, "gate_probability")
        within("[0, 1]", self, "memory.white_share")
        within("(0, inf)", self, "noise.rotation_deg")
        within("[0, inf)", self, "noise.across", "noise.along", "noise.least")
        within("(0, inf]", self, "distance", "angle_deg")
        within("[0, inf]", self, "memory.evidence_s", "memory.hold_s")
        within("[0, inf)", self, "memory.speed", "memory.turn_rate_deg")
        if self.noise.least + min(self.noise.across, self.noise.along) == 0.0:
            raise InputError("noise.least is 0 and so is another part of the noise", fix="give one of them more than 0")
