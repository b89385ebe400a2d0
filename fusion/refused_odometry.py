"""Odometry beside an IMU that is refused again and again: the IMU's velocity has gone wrong.

A velocity that a few gross errors have spoilt, at a start above all, refuses the odometry that would mend it, and runs
away. The gyroscope tells this from odometry that has lost its way: that one turns otherwise, too.
"""

from __future__ import annotations

from fusion.ballot import LOST_SHARE, START_WINDOW_S
from fusion.columns import Columns
from fusion.compiled import njit
from fusion.eskf import POSITION_ONLY
from fusion.filter_update import LIMIT_ROTATION, is_unsettled
from fusion.memory import CLONED_AT, NOW, REFUSED_ODOMETRY, UNSURE_AT, VOTE_HEAD, Memory, Work
from fusion.nav_state import CLONE, EXTRINSIC_ROTATION, POSITION_ERROR
from fusion.so3_kernels import apply, multiply
from fusion.starting import first_vote, start_again_in_place, used_since

IN_A_ROW = 3
TURNS_ALIKE = 3.0
"""Odometry turns as the gyroscope does up to so many times the limit of a good rotation: its bias may be spoilt too."""


@njit(cache=True)
def follow_refusals(m: Memory, w: Work, log: Columns, j: int) -> None:
    """Count odometry's ways refused in a row; too many, and a state that nothing else holds starts again.

    j is the odometry that was taken last: w holds its residual.
    """
    if log.decisions[j] & POSITION_ONLY:
        m.counters[REFUSED_ODOMETRY] = 0
    elif log.nis[j, 1] <= TURNS_ALIKE * m.limits[LIMIT_ROTATION]:
        m.counters[REFUSED_ODOMETRY] += 1
    if m.counters[REFUSED_ODOMETRY] >= IN_A_ROW and is_unsettled(m) and not _is_held(m):
        _start_again_as_it_moves(m, w)


@njit(cache=True)
def _is_held(m: Memory) -> bool:
    """Tell whether the poses of the last second bear the state out: then it is odometry that is wrong."""
    first = first_vote(m, m.start[START_WINDOW_S], 0)
    return used_since(m, first) > m.start[LOST_SHARE] * (m.counters[VOTE_HEAD] - first)


@njit(cache=True)
def _start_again_as_it_moves(m: Memory, w: Work) -> None:
    """Start again about where the state is, its velocity changed by what odometry shows of the mean one since then."""
    R_wc, missed, then = w.step[36:45], w.step[45:48], m.layout[CLONE]
    seconds = (m.counters[NOW] - m.counters[CLONED_AT]) * 1e-9
    multiply(m.x[then : then + 9], m.x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9], R_wc)
    apply(R_wc, w.residual[3], w.residual[4], w.residual[5], missed)
    start_again_in_place(m, w, missed, seconds)
    for i in range(3):
        m.P[POSITION_ERROR + i, POSITION_ERROR + i] += (IN_A_ROW * missed[i]) ** 2
    m.counters[REFUSED_ODOMETRY], m.counters[UNSURE_AT] = 0, m.counters[NOW]
