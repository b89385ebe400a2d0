"""The memory beside a filter that late data needs: what was fed, snapshots, and what votes were overwritten."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion.compiled import njit
from fusion.imu_noise import SAMPLE_SIZE
from fusion.memory import END_OF_STATE, N_COUNTERS, VOTES
from fusion.nav_state import Array, Ints
from fusion.votes import VOTE_SIZE

BATCH = 32  # measurements that one call can hand over

# Places in the integer header.
(
    IMU_CAPACITY,
    CAPACITY,
    SNAPSHOTS,
    STATE_SIZE,
    HORIZON,
    AHEAD,
    INTERVAL,
    IMU_COUNT,
    COUNT,
    NEXT,
    FIRST_SNAPSHOT,
    END_SNAPSHOT,
    BEGUN,
    DROPPED,
    DUPLICATES,
    TOO_LATE,
    TOO_EARLY,
    MALFORMED,
    OVERFLOWED,
    REPLAYS,
    RING_HEADER,
) = range(21)


class Ring(NamedTuple):
    """Views of the two arrays."""

    header: Ints
    imu_stamps: Ints
    imu_values: Array  # (., 9) rows of `imu_noise.imu_rows`
    stamps: Ints  # measurements, sorted by stamp and object
    kinds: Ints
    objects: Ints
    decisions: Ints
    rotations: Array
    translations: Array
    covariances: Array
    nis: Array
    snapshot_states: Array  # (S, state size)
    snapshot_counters: Ints  # (S, N_COUNTERS)
    snapshot_used: Array  # (S, VOTES) which votes counted as used
    first_state: Array  # the state before anything began
    overwritten: Array  # (capacity, VOTE_SIZE) what vote number i (modulo capacity) took the place of
    overwritten_stamps: Ints
    sample: Array  # (6,) incoming IMU sample
    new_kinds: Ints  # (BATCH,) incoming measurements
    new_objects: Ints
    new_rotations: Array  # (BATCH, 9), a quaternion (scalar last) in the first four places
    new_translations: Array
    new_covariances: Array


def allocate_ring(
    floats: Array, integers: Ints, imu_capacity: int, capacity: int, horizon_ns: int, ahead_ns: int, interval_ns: int
) -> tuple[Array, Ints]:
    """Return the zeroed arrays beside a filled filter memory, whose state is kept as the one to begin from."""
    state_size, snapshots = int(integers[END_OF_STATE]), horizon_ns // interval_ns + 3
    float_size = SAMPLE_SIZE * imu_capacity + 51 * capacity + snapshots * (state_size + VOTES) + state_size
    float_size += VOTE_SIZE * capacity + 6 + 48 * BATCH
    integer_size = RING_HEADER + imu_capacity + 5 * capacity + snapshots * N_COUNTERS + 2 * BATCH
    ring_floats, ring_integers = np.zeros(float_size), np.zeros(integer_size, dtype=np.int64)
    ring_integers[[IMU_CAPACITY, CAPACITY, SNAPSHOTS, STATE_SIZE]] = imu_capacity, capacity, snapshots, state_size
    ring_integers[[HORIZON, AHEAD, INTERVAL]] = horizon_ns, ahead_ns, interval_ns
    ring_views.py_func(ring_floats, ring_integers).first_state[:] = floats[:state_size]
    return ring_floats, ring_integers


@njit(cache=True, _nrt=True)
def ring_views(f: Array, i: Ints) -> Ring:
    """Return the parts of the two arrays by name."""
    ci, cm, s, size = i[IMU_CAPACITY], i[CAPACITY], i[SNAPSHOTS], i[STATE_SIZE]
    a = SAMPLE_SIZE * ci
    b = a + 9 * cm
    c = b + 3 * cm
    d = c + 36 * cm
    e = d + 3 * cm
    g = e + s * size
    h = g + s * VOTES
    k = h + size
    m = k + VOTE_SIZE * cm
    n = m + 6
    o = n + 9 * BATCH
    p = o + 3 * BATCH
    j = RING_HEADER + ci
    q = j + 5 * cm
    r = q + s * N_COUNTERS
    return Ring(
        i[0:RING_HEADER],
        i[RING_HEADER:j],
        f[0:a].reshape((ci, SAMPLE_SIZE)),
        i[j : j + cm],
        i[j + cm : j + 2 * cm],
        i[j + 2 * cm : j + 3 * cm],
        i[j + 3 * cm : j + 4 * cm],
        f[a:b].reshape((cm, 9)),
        f[b:c].reshape((cm, 3)),
        f[c:d].reshape((cm, 6, 6)),
        f[d:e].reshape((cm, 3)),
        f[e:g].reshape((s, size)),
        i[q:r].reshape((s, N_COUNTERS)),
        f[g:h].reshape((s, VOTES)),
        f[h:k],
        f[k:m].reshape((cm, VOTE_SIZE)),
        i[j + 4 * cm : q],
        f[m : m + 6],
        i[r : r + BATCH],
        i[r + BATCH : r + 2 * BATCH],
        f[n:o].reshape((BATCH, 9)),
        f[o:p].reshape((BATCH, 3)),
        f[p : p + 36 * BATCH].reshape((BATCH, 6, 6)),
    )
