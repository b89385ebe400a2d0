"""What the kernels of a start share: the votes that count now, with the motion that they correct, and a correction."""

from __future__ import annotations

from typing import NamedTuple

from fusion.compiled import njit
from fusion.memory import Memory, Work
from fusion.nav_state import Array, Ints

# Places in the options of the start.
(
    MIN_VOTES,
    LONGEST_WINDOW_S,
    MAX_ANGLE,
    MAX_DISTANCE,
    MAX_LEVER,
    MAX_SPEED,
    MAX_TILT,
    START_WINDOW_S,
    START_MIN_SPAN_S,
    LOST_WINDOW_S,
    LOST_SHARE,
    LOST_MIN_VOTES,
    MIN_SHARE,
    MIN_OBJECTS,
    MIN_PLACES,
    LEAD,
    LOST_SIGMA,
    FEW_VOTES,
    FEW_SPAN_S,
    IS_GIVEN,
    GIVEN_POSE,
) = range(21)
GIVEN_POSE_SIZE = 12  # rotation, position

AT_ITS_PLACE, WHOLE = 1, 2  # what of a vote agrees with a correction
CORRECTION_SIZE = 22

_AGREED = 96  # where the work space keeps the agreed correction


class Ballot(NamedTuple):
    """The votes first..head-1 of a ring (modulo its length, a power of two), and what else tells a correction."""

    votes: Array  # (ring, VOTE_SIZE), places in votes.py
    stamps: Ints  # (ring,)
    first: int
    head: int
    now: int  # the stamp at which position and velocity become a correction's d and v
    up: Array  # (3,) where the integrated motion has up; zero: nothing feels gravity
    gravity: Array  # (3,) in the world
    options: Array  # of the start, places above
    scratch: Array  # 256 floats


class Correction(NamedTuple):
    """How the integrated motion becomes the true one: p_true = C (p - o) + d + v t, o being origin's at t."""

    C: Array  # (9,) rotation, on the left
    d: Array  # (3,) m
    v: Array  # (3,) m/s
    origin: Array  # (6,) position and velocity that are taken off the integrated motion: it may be far wrong in them
    support: Array  # (1,) how much the votes support it
    agreed: Ints  # (ring,) what of each vote agrees


@njit(cache=True, _nrt=True)
def correction_in(room: Array, agreed: Ints) -> Correction:
    """Return the correction that lies in `room` (CORRECTION_SIZE,)."""
    return Correction(room[0:9], room[9:12], room[12:15], room[15:21], room[21:22], agreed)


@njit(cache=True)
def seconds_since(ballot: Ballot, i: int) -> float:
    """Return when vote i was cast, s, counted from now."""
    return (ballot.stamps[i] - ballot.now) * 1e-9


@njit(cache=True, _nrt=True)
def agreed_correction(m: Memory, w: Work) -> Correction:
    """Return the correction that `starting.adopt` takes."""
    return correction_in(w.step[_AGREED : _AGREED + CORRECTION_SIZE], m.inliers)
