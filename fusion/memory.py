"""The filter's memory: two flat buffers, so that a call hands over two arrays and a snapshot is one copy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.compiled import njit
from fusion.measurements import MAX_COLUMNS
from fusion.nav_state import CORE, LAYOUT_SIZE, StateLayout
from fusion.votes import VOTE_SIZE

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

VOTES = 256  # a second of eight objects at 30 Hz; a power of two, so that places are found without a division

# Counters, part of what a snapshot keeps.
(
    NOW,
    IMU_AT,
    MODE,
    BIAS_TIME,
    STARTED_AT,
    VOTE_HEAD,
    RESTARTS,
    LAST_UPDATE,
    UP_COUNT,
    TAPE_END,
    REFUSED_ROW,
    CLONED,  # 1 where the clone is that of the last odometry
    REPLACED,  # how often an object of an unknown map was put elsewhere
    ANCHOR,  # 1 + the object that anchors a world whose map is unknown, 0: none yet
    DELAY,  # by how much later than their stamps measurements are taken in, ns
    LEAST_DELAY,  # the least that this ever was
    LAST_STAMP,  # of the measurements taken in last
    UNSURE_AT,  # when the attitude was last so unsure that poses are judged anew: votes from before do not count
    CLONED_AT,  # when the clone was made
    REFUSED_ODOMETRY,  # how often in a row odometry's way was refused, its turn not
    UNHELD_ROW,  # how many poses in a row were refused, or let in by a gross error's bias alone
    UNHELD_SINCE,  # the stamp of the first of these
    FIRST_VOTE,  # cast since the motion began anew: none from before count
    N_COUNTERS,
) = range(24)
INITIALISING, TRACKING = 0, 1

TALLY_SIZE, PLACE_SIZE = 8, 15  # rows of tallies and places, see place_watch.py
SCATTER_SIZE = 11  # see scatter.py
SCALE_SIZE = 3  # see noise_scale.py
PAIR_SIZE = 9  # see lasting_share.py
SUPPOSED, SUPPOSED_SIZE = 6, 16  # hypotheses of each unknown object's pose, see meeting.py

# Integer header: where things stand in the float buffer, sizes.
(
    AT_X,
    AT_P,
    AT_SCALES,
    AT_REFUSED,
    AT_KNOWN,
    AT_TALLIES,
    AT_PLACES,
    AT_SUPPOSED,
    AT_SCATTER,
    AT_STATED,
    AT_PAIRS,
    AT_UP,
    END_OF_STATE,
    AT_NOISE,
    AT_LIMITS,
    AT_START,
    AT_BIAS_MODEL,
    AT_SPREAD_MODEL,
    AT_USUAL_SCATTER,
    AT_MOVED,
    AT_MEETING,
    AT_AXES,
    AT_PRIOR,
    AT_WORK,
    AT_VOTES,
    AT_USED,
    H_N,
    H_NX,
    H_K,
    H_SUPPOSED,
    AT_LAYOUT,
    AT_COUNTERS,
    AT_ORDERS,
    AT_COLUMNS,
    AT_VOTE_STAMPS,
    AT_INLIERS,
    AT_TAPE,
    TAPE_SIZE,
    HEADER,
) = range(39)


class Memory(NamedTuple):
    """Views of the two buffers."""

    x: Array
    P: Array
    scales: Array  # (2, .) how much larger than stated object and camera poses err: places in noise_scale.py
    refused: Array  # (K, 2) how often in a row each object's rotation and position were refused
    known: Array  # (K,) 1 where an object's pose in the world is known, 0 before it was first seen
    tallies: Array  # (K + 1, .) how the measurements of each object, and camera poses, fared: places in place_watch.py
    places: Array  # (K, .) where each object stands against the map: places in place_watch.py
    supposed: Array  # (K, SUPPOSED, .) where an object of unknown pose may be: places in meeting.py; or (0, ..)
    scatter: Array  # (K, .) how much each object's detections differ from one to the next: places in scatter.py
    stated: Array  # (K, 3) how much more noise than usual the detections of each object state: rotation, across, along
    pairs: Array  # (K + 1, .) how each object's detections disagree with its neighbour's: places in lasting_share.py
    up: Array  # (3,) running mean of the specific force in the axes of the integrated motion
    noise: Array  # of the motion: places in imu.py and odometry.py
    limits: Array  # places: filter_update.LIMIT_BOTH and following
    start: Array
    bias_model: Array
    spread_model: Array  # of detections that state no noise: places in bias_spread.py
    usual_scatter: Array  # (5,) of such detections, 0 where it is not known (`scatter.usual_scatter`)
    moved: Array  # when an object counts as moved: places in place_watch.py
    meeting: Array  # when an object of unknown pose is put where it is seen: places in meeting.py
    axes: Array  # (K, 3) symmetry axes
    prior: Array  # (n,) 1-sigma of the error state at the start
    work: Array
    votes: Array
    used: Array  # (VOTES,) 1 where the filter took a vote's position in
    tape: Array  # what the smoother needs of it (`fusion/tape.py`); empty where nobody asks
    layout: Ints
    counters: Ints
    orders: Ints  # (K,) symmetry order, 1 none, 0 continuous
    columns: Ints
    vote_stamps: Ints
    inliers: Ints


def allocate(layout: StateLayout) -> tuple[Array, Ints]:
    """Return the zeroed buffers of a filter with this layout; `views` gives their parts names."""
    n, nx, K = layout.n_error, layout.n_nominal, layout.n_objects
    header = np.zeros(HEADER, dtype=np.int64)
    header[H_N], header[H_NX], header[H_K], header[H_SUPPOSED] = n, nx, K, K if layout.objects else 0
    sizes: Sequence[tuple[int, int]] = (
        (AT_X, nx),
        (AT_P, n * n),
        (AT_SCALES, 2 * SCALE_SIZE),
        (AT_REFUSED, 2 * max(K, 1)),
        (AT_KNOWN, max(K, 1)),
        (AT_TALLIES, TALLY_SIZE * (max(K, 1) + 1)),
        (AT_PLACES, PLACE_SIZE * max(K, 1)),
        (AT_SUPPOSED, SUPPOSED * SUPPOSED_SIZE * header[H_SUPPOSED]),
        (AT_SCATTER, SCATTER_SIZE * max(K, 1)),
        (AT_STATED, 3 * max(K, 1)),
        (AT_PAIRS, PAIR_SIZE * (max(K, 1) + 1)),
        (AT_UP, 3),
        (END_OF_STATE, 0),
        (AT_NOISE, 12),
        (AT_LIMITS, 12),
        (AT_START, 32),
        (AT_BIAS_MODEL, 16),
        (AT_SPREAD_MODEL, 5),
        (AT_USUAL_SCATTER, 5),
        (AT_MOVED, 12),
        (AT_MEETING, 8),
        (AT_AXES, 3 * max(K, 1)),
        (AT_PRIOR, n),
        (AT_WORK, work_size(n)),
        (AT_VOTES, VOTES * VOTE_SIZE),
        (AT_USED, VOTES),
    )
    at = 0
    for name, size in sizes:
        header[name] = at
        at += size
    floats = np.zeros(at)
    whole = HEADER
    counts: Sequence[tuple[int, int]] = (
        (AT_LAYOUT, LAYOUT_SIZE),
        (AT_COUNTERS, N_COUNTERS),
        (AT_ORDERS, max(K, 1)),
        (AT_COLUMNS, MAX_COLUMNS),
        (AT_VOTE_STAMPS, VOTES),
        (AT_INLIERS, VOTES),
    )
    for name, size in counts:
        header[name] = whole
        whole += size
    integers = np.zeros(whole, dtype=np.int64)
    integers[:HEADER] = header
    integers[header[AT_LAYOUT] : header[AT_LAYOUT] + LAYOUT_SIZE] = layout.as_integers()
    integers[header[AT_ORDERS] : header[AT_ORDERS] + max(K, 1)] = 1
    return floats, integers


@njit(cache=True)
def work_size(n: int) -> int:
    """Return how many floats of work space a filter with n error states needs."""
    return (
        256 + 45 + 6 + 17 * CORE + 3 * n + 6 + 6 * MAX_COLUMNS + 6 * n + 36 + 36 + 36 + 6 + 6 * n + n + 12 + 128 + 6 + 1
    )


@njit(cache=True, _nrt=True)
def views(floats: Array, integers: Ints) -> Memory:
    """Return the parts of the two buffers by name."""
    n, nx, K = integers[H_N], integers[H_NX], max(integers[H_K], 1)
    f, i = floats, integers

    return Memory(
        f[i[AT_X] : i[AT_X] + nx],
        f[i[AT_P] : i[AT_P] + n * n].reshape((n, n)),
        f[i[AT_SCALES] : i[AT_SCALES] + 2 * SCALE_SIZE].reshape((2, SCALE_SIZE)),
        f[i[AT_REFUSED] : i[AT_REFUSED] + 2 * K].reshape((K, 2)),
        f[i[AT_KNOWN] : i[AT_KNOWN] + K],
        f[i[AT_TALLIES] : i[AT_TALLIES] + TALLY_SIZE * (K + 1)].reshape((K + 1, TALLY_SIZE)),
        f[i[AT_PLACES] : i[AT_PLACES] + PLACE_SIZE * K].reshape((K, PLACE_SIZE)),
        f[i[AT_SUPPOSED] : i[AT_SCATTER]].reshape((i[H_SUPPOSED], SUPPOSED, SUPPOSED_SIZE)),
        f[i[AT_SCATTER] : i[AT_SCATTER] + SCATTER_SIZE * K].reshape((K, SCATTER_SIZE)),
        f[i[AT_STATED] : i[AT_STATED] + 3 * K].reshape((K, 3)),
        f[i[AT_PAIRS] : i[AT_PAIRS] + PAIR_SIZE * (K + 1)].reshape((K + 1, PAIR_SIZE)),
        f[i[AT_UP] : i[AT_UP] + 3],
        f[i[AT_NOISE] : i[AT_NOISE] + 12],
        f[i[AT_LIMITS] : i[AT_LIMITS] + 12],
        f[i[AT_START] : i[AT_START] + 32],
        f[i[AT_BIAS_MODEL] : i[AT_BIAS_MODEL] + 16],
        f[i[AT_SPREAD_MODEL] : i[AT_SPREAD_MODEL] + 5],
        f[i[AT_USUAL_SCATTER] : i[AT_USUAL_SCATTER] + 5],
        f[i[AT_MOVED] : i[AT_MOVED] + 12],
        f[i[AT_MEETING] : i[AT_MEETING] + 8],
        f[i[AT_AXES] : i[AT_AXES] + 3 * K].reshape((K, 3)),
        f[i[AT_PRIOR] : i[AT_PRIOR] + n],
        f[i[AT_WORK] : i[AT_WORK] + work_size(n)],
        f[i[AT_VOTES] : i[AT_VOTES] + VOTES * VOTE_SIZE].reshape((VOTES, VOTE_SIZE)),
        f[i[AT_USED] : i[AT_USED] + VOTES],
        f[i[AT_TAPE] : i[AT_TAPE] + i[TAPE_SIZE]],
        i[i[AT_LAYOUT] : i[AT_LAYOUT] + LAYOUT_SIZE],
        i[i[AT_COUNTERS] : i[AT_COUNTERS] + N_COUNTERS],
        i[i[AT_ORDERS] : i[AT_ORDERS] + K],
        i[i[AT_COLUMNS] : i[AT_COLUMNS] + MAX_COLUMNS],
        i[i[AT_VOTE_STAMPS] : i[AT_VOTE_STAMPS] + VOTES],
        i[i[AT_INLIERS] : i[AT_INLIERS] + VOTES],
    )


class Work(NamedTuple):
    """Scratch space of one update or one propagation."""

    step: Array  # what propagate_nominal leaves
    blocks: Array
    basis: Array
    core: Array
    rows: Array
    residual: Array
    H: Array
    PHt: Array
    S: Array
    R: Array
    L: Array
    white: Array
    Z: Array
    error: Array
    measured: Array  # R_m (9), t_m (3)
    scratch: Array
    rate: Array  # (3,) unbiased angular velocity at the measurements' stamp, rad/s
    force: Array  # (3,) unbiased specific force there, m/s^2
    offset: Array  # (1,) by how much later than their stamp says measurements are taken in, s


@njit(cache=True, _nrt=True)
def work_views(work: Array, n: int) -> Work:
    """Return the parts of the work space by name."""
    a = 256
    b = a + 45
    c = b + 6
    d = c + 17 * CORE
    e = d + 3 * n
    g = e + 6
    h = g + 6 * MAX_COLUMNS
    j = h + 6 * n
    k = j + 36
    m = k + 36
    o = m + 36
    p = o + 6
    q = p + 6 * n
    r = q + n
    s = r + 12
    return Work(
        work[0:256],
        work[a:b],
        work[b:c],
        work[c:d].reshape((17, CORE)),
        work[d:e].reshape((3, n)),
        work[e:g],
        work[g:h].reshape((6, MAX_COLUMNS)),
        work[h:j].reshape((6, n)),
        work[j:k].reshape((6, 6)),
        work[k:m].reshape((6, 6)),
        work[m:o].reshape((6, 6)),
        work[o:p],
        work[p:q].reshape((6, n)),
        work[q:r],
        work[r:s],
        work[s : s + 128],
        work[s + 128 : s + 131],
        work[s + 131 : s + 134],
        work[s + 134 : s + 135],
    )
