"""The filter of `fusion/filter_loop.py` once more, in plain numpy on filterpy's linear predict and update.

Written to be read and to hold the compiled filter against, not to be fast; the matrices are in
`fusion/reference_models.py`. What is no linear algebra (where to start, when to start again, which bias has jumped) is
asked of the compiled filter's own functions.
"""

from __future__ import annotations

import numpy as np
from filterpy.kalman import predict, update
from scipy.spatial.transform import Rotation

from fusion import filter_loop, filter_motion, filter_update, imu, memory, odometry
from fusion.ballot import WHOLE
from fusion.bias_spread import follow_spreads
from fusion.columns import OUT_CORE, OUT_SIGMA, Columns, Rows
from fusion.eskf import ACCEPTED, POSITION_ONLY, REJECTED, ROTATION_ONLY
from fusion.fuse import run_filter
from fusion.lasting_share import MET
from fusion.measurements import OBJECT_POSE, ODOMETRY_STEP
from fusion.meeting import PUT, UNKNOWN_MAP, choose_anchor
from fusion.nav_state import (
    ACCEL_BIAS,
    ACCEL_BIAS_ERROR,
    EXTRINSIC_ROTATION,
    GYRO_BIAS,
    GYRO_BIAS_ERROR,
    OBJECT_SIZE,
    OBJECTS,
    POSITION,
    TIME_OFFSET,
    VELOCITY,
    Array,
    Ints,
    pose_at,
    put_pose,
    retract_state,
)
from fusion.noise_scale import PLACE, TURN, scale_of
from fusion.object_biases import BIAS_JUMP, BIAS_JUMP_AT, BIAS_MODEL_SIZE, bias_phi, bias_sigma
from fusion.options import FuseOptions
from fusion.place_watch import ON_MAP, RELEASED, TURNED, status_of
from fusion.prepare import Problem
from fusion.reference_models import (
    ATT,
    BOTH,
    POS,
    POSITION_ROWS,
    ROTATION_ROWS,
    cloning,
    exp,
    layout_from_integers,
    nearest_symmetric,
    odometry_transition,
    process_noise,
    residual_and_jacobian,
    transition,
    transport,
    transport_clock,
)
from fusion.refused_odometry import follow_refusals
from fusion.result import FuseResult
from fusion.scatter import follow_scatter
from fusion.starting import starts
from fusion.votes import VOTE_ACROSS, VOTE_ALONG, VOTE_OBJECT, VOTE_TURN
from poet_loc.core.geometry import make_pose


def run_reference(problem: Problem, options: FuseOptions) -> FuseResult:
    """Run the plain filter over a whole log: the same numbers as `fuse.run_filter`, some hundred times slower."""
    return run_filter(problem, options, loop=run_log, estimator="reference")


def _within(whole: slice, part: slice) -> slice:
    return slice(whole.start + part.start, whole.start + part.stop)


class ReferenceFilter:
    """State and covariance of a filter's memory, moved by dense matrices."""

    def __init__(self, floats: Array, integers: Ints) -> None:
        self.m = memory.views.py_func(floats, integers)
        self.layout = layout_from_integers(self.m.layout)
        self.work = memory.work_views.py_func(self.m.work, self.layout.n_error)
        self.zero = np.zeros(self.layout.n_error)

    @property
    def tracking(self) -> bool:
        """Whether the start is past."""
        return bool(self.m.counters[memory.MODE] == memory.TRACKING)

    def advance(self, imu_stamps: Ints, imu_values: Array, until: int) -> None:
        """Integrate the IMU, linear in time between samples, up to a stamp."""
        m, c = self.m, self.m.counters
        while c[memory.NOW] < until:
            k, now = c[memory.IMU_AT], c[memory.NOW]
            stop = min(imu_stamps[k + 1], until)
            middle = 0.5 * ((now - imu_stamps[k]) + (stop - imu_stamps[k]))
            share = middle / (imu_stamps[k + 1] - imu_stamps[k])
            if m.noise[odometry.IS_ODOMETRY]:
                self._step_by_odometry((stop - now) * 1e-9, imu_values[k])
            else:
                values = imu_values[k] + share * (imu_values[k + 1] - imu_values[k])
                self._step((stop - now) * 1e-9, (imu_stamps[k + 1] - imu_stamps[k]) * 1e-9, values, imu_values[k + 1])
            c[memory.NOW] = stop
            c[memory.IMU_AT] += stop == imu_stamps[k + 1]
        filter_motion.give_up_where_lost(m, imu_values[c[memory.IMU_AT], 3:6])

    def _step(self, dt: float, interval: float, values: Array, sample: Array) -> None:
        m = self.m
        if not self.tracking:  # no covariance yet; the compiled step also keeps the mean specific force
            imu.propagate_nominal(m.x, dt, values[:3].copy(), values[3:6].copy(), self.work.step)
            filter_motion.watch_gravity(m, self.work, dt)
            return
        m.x[:], F = transition(m.x, dt, values[:3], values[3:6], self.layout)
        self.spread(F, process_noise(self.layout.n_error, dt, interval, m.noise, sample))

    def _step_by_odometry(self, dt: float, twist: Array) -> None:
        m = self.m
        m.x[:], F = odometry_transition(m.x, dt, twist[:3], twist[3:6], self.layout)
        if self.tracking:
            Q = np.zeros_like(F)
            Q[ATT, ATT] = (m.noise[odometry.ROTATION_WALK] ** 2 + twist[odometry.ROTATION_DOUBT]) * dt * np.eye(3)
            Q[POS, POS] = (m.noise[odometry.TRANSLATION_WALK] ** 2 + twist[odometry.TRANSLATION_DOUBT]) * dt * np.eye(3)
            self.spread(F, Q)

    def spread(self, A: Array, Q: Array) -> None:
        """Map the error by A and add noise: P <- A P A^T + Q."""
        _, self.m.P[:] = predict(self.zero, self.m.P, A, Q)

    def condition(self, residual: Array, H: Array, R: Array) -> Array:
        """Condition the error on a residual; return its mean, which the nominal state has yet to take over."""
        error, self.m.P[:] = update(self.zero, self.m.P, residual, R, H)
        return np.asarray(error)

    def decay_biases(self) -> None:
        """Let the object biases relax since the last measurement: Gauss-Markov, x <- phi x, P <- Phi P Phi + Q.

        A bias far outside its sigma is a gross error in a run: it does not fade, and wanders as far as it jumps.
        """
        m, c, layout = self.m, self.m.counters, self.layout
        seconds = (c[memory.NOW] - c[memory.BIAS_TIME]) * 1e-9
        c[memory.BIAS_TIME] = c[memory.NOW]
        if not layout.bias_kinds:
            return
        Phi, Q = np.eye(layout.n_error), np.zeros((layout.n_error, layout.n_error))
        for kind in range(layout.bias_kinds):
            model = m.bias_model[kind * BIAS_MODEL_SIZE : (kind + 1) * BIAS_MODEL_SIZE]
            for k in range(layout.n_objects):
                for part in (ROTATION_ROWS, POSITION_ROWS):
                    sigma = np.array([bias_sigma(m.bias_model, kind, i) for i in range(6)])[part]
                    rows = _within(layout.error_slice("biases", k, kind), part)
                    phi = np.array([bias_phi(m.bias_model, kind, i, seconds) for i in range(6)])[part]
                    bias = m.x[_within(layout.nominal_bias(k, kind), part)]
                    if np.max(np.abs(bias) / sigma) <= model[BIAS_JUMP_AT] or np.all(phi == 1.0):
                        bias *= phi
                        Phi[rows, rows] = np.diag(phi)
                    else:
                        sigma = sigma * model[BIAS_JUMP]
                    Q[rows, rows] = np.diag((1.0 - phi**2) * sigma**2)
        self.spread(Phi, Q)

    def gate(self, residual: Array, S: Array, nis: Array) -> int:
        """Decide what of a measurement to use; write its NIS [both, rotation, position] into nis (3,)."""
        limits = self.m.limits
        for i, rows in enumerate((BOTH, ROTATION_ROWS, POSITION_ROWS)):
            nis[i] = residual[rows] @ np.linalg.solve(S[rows, rows], residual[rows])
        if filter_update.is_far(self.m, residual):
            return REJECTED
        if nis[0] <= limits[filter_update.LIMIT_BOTH]:
            return ACCEPTED
        if limits[filter_update.PARTIAL] >= 1 and nis[2] <= limits[filter_update.LIMIT_POSITION]:
            return REJECTED if filter_update.is_blunder(self.m, nis[1]) else POSITION_ONLY
        if limits[filter_update.PARTIAL] >= 2 and nis[1] <= limits[filter_update.LIMIT_ROTATION]:
            return ROTATION_ONLY
        return REJECTED

    def take(self, log: Columns, j: int, correcting: bool = True) -> int:
        """Gate measurement j, which is at the filter's stamp, correct with what passes, and return what that was."""
        m, kind, k, nis = self.m, int(log.kinds[j]), int(log.objects[j]), log.nis[j]
        if kind == OBJECT_POSE and not m.known[k]:
            nis[0] = np.inf
            return REJECTED
        residual, H, R, decision = self._meet_gate(log, j)
        status = status_of(m, kind, k)
        if not correcting:
            return decision
        if status != ON_MAP:
            fits = status == TURNED and nis[2] <= m.limits[filter_update.LIMIT_POSITION]
            decision = POSITION_ONLY if fits else REJECTED
        if decision != REJECTED:
            rows = {ACCEPTED: BOTH, POSITION_ONLY: POSITION_ROWS, ROTATION_ONLY: ROTATION_ROWS}[decision]
            self.correct(residual[rows], H[rows], R[rows, rows])
        return decision if status == ON_MAP else decision | RELEASED

    def _meet_gate(self, log: Columns, j: int) -> tuple[Array, Array, Array, int]:
        """Return residual, Jacobian and covariance of measurement j, and what the gate lets through; write its NIS."""
        residual, H, R = self._predict(log, j)
        self.work.residual[:] = residual
        if log.kinds[j] == OBJECT_POSE:
            follow_scatter(self.m, int(log.objects[j]), log.translations[j], residual)
        return residual, H, R, self.gate(residual, H @ self.m.P @ H.T + R, log.nis[j])

    def _predict(self, log: Columns, j: int) -> tuple[Array, Array, Array]:
        """Return residual, Jacobian and covariance of measurement j."""
        m, kind, k = self.m, int(log.kinds[j]), int(log.objects[j])
        R_m, R = log.rotations[j].reshape(3, 3), self._widened(log, j)
        if kind == OBJECT_POSE and m.orders[k] != 1:
            R_m, R = self._fit_symmetry(k, R_m, R)
        rate, offset = self.work.rate, self.work.offset[0]
        return *residual_and_jacobian(kind, k, R_m, log.translations[j], m.x, rate, offset, self.layout), R

    def _widened(self, log: Columns, j: int) -> Array:
        """Return the covariance of measurement j, as much larger than stated as its kind's errors are."""
        root = np.repeat([scale_of(self.m, log.kinds[j], part) for part in (TURN, PLACE)], 3)
        return np.asarray(root[:, None] * log.covariances[j] * root)

    def _settle(self, log: Columns, j: int, vote: Array) -> int:
        residual, H, R, decision = self._meet_gate(log, j)
        if decision != ACCEPTED:
            return REJECTED
        whole = np.repeat([vote[VOTE_TURN], (2.0 * vote[VOTE_ACROSS] + vote[VOTE_ALONG]) / 3.0], 3)
        turn, place = np.add.reduceat(residual**2 / whole, [0, 3])
        limits = self.m.limits * (filter_update.FAR_OFF if log.kinds[j] == OBJECT_POSE else 1.0)
        off = turn > limits[filter_update.LIMIT_ROTATION] or place > limits[filter_update.LIMIT_POSITION]
        self.correct(residual if off else 0.0 * residual, H, R)
        return ACCEPTED

    def correct(self, residual: Array, H: Array, R: Array) -> None:
        """Update the error state from zero, move the nominal state by it, and carry the covariance along."""
        m, before = self.m, self.m.x.copy()
        error = self.condition(residual, H, R)
        m.x[:] = retract_state(before, error, self.layout)
        self.spread(transport(before, m.x, error, self.layout), np.zeros_like(m.P))
        if self.layout.time_offset:
            rate, force = self.work.rate, self.work.force
            self.spread(transport_clock(before, m.x, error, rate, force, self.layout), np.zeros_like(m.P))
            rate -= error[GYRO_BIAS_ERROR : GYRO_BIAS_ERROR + 3]
            force -= error[ACCEL_BIAS_ERROR : ACCEL_BIAS_ERROR + 3]

    def clone(self) -> None:
        """Let the clone be the pose of now."""
        m, start = self.m, self.layout.clone_start
        self.spread(cloning(m.x, self.layout), np.zeros_like(m.P))
        m.x[start : start + 12] = m.x[:12]
        m.counters[memory.CLONED], m.counters[memory.CLONED_AT] = 1, m.counters[memory.NOW]

    def _put_object(self, log: Columns, j: int) -> None:
        """Put an object whose pose in the world is unknown where detection j sees it.

        With 0 = H_x dx + H_o do + e its error is do = -H_o^-1 (H_x dx + e).
        """
        m, layout, x, k = self.m, self.layout, self.m.x, int(log.objects[j])
        R_m, t_m, R = log.rotations[j].reshape(3, 3), log.translations[j], self._widened(log, j)
        rate, offset, at = self.work.rate, self.work.offset[0], OBJECTS + OBJECT_SIZE * k
        T_world_imu = make_pose(
            Rotation.from_matrix(x[:9].reshape(3, 3) @ exp((x[TIME_OFFSET] - offset) * rate)),
            x[POSITION : POSITION + 3] + (x[TIME_OFFSET] - offset) * x[VELOCITY : VELOCITY + 3],
        )
        put_pose(x, at, T_world_imu * pose_at(x, EXTRINSIC_ROTATION) * make_pose(Rotation.from_matrix(R_m), t_m))
        filter_update.forget_biases(m, k, False)
        _, H = residual_and_jacobian(OBJECT_POSE, k, R_m, t_m, x, rate, offset, layout)
        rows = layout.error_slice("objects", k)
        inverse = np.linalg.inv(H[:, rows])
        H[:, rows] = 0.0
        A, Q = np.eye(layout.n_error), np.zeros_like(m.P)
        A[rows], Q[rows, rows] = -inverse @ H, inverse @ R @ inverse.T
        self.spread(A, Q)
        m.known[k], m.pairs[k, MET] = 1.0, m.counters[memory.NOW]

    def _fit_symmetry(self, k: int, R_m: Array, R: Array) -> tuple[Array, Array]:
        """Turn a measured rotation to the look-alike that fits best; a continuous symmetry says nothing of its turn."""
        x, axis, order = self.m.x, self.m.axes[k], int(self.m.orders[k])
        seconds = x[TIME_OFFSET] - self.work.offset[0]
        R_ic = x[EXTRINSIC_ROTATION : EXTRINSIC_ROTATION + 9].reshape(3, 3)
        at = OBJECTS + OBJECT_SIZE * k
        R_co = (x[:9].reshape(3, 3) @ exp(seconds * self.work.rate) @ R_ic).T @ x[at : at + 9].reshape(3, 3)
        R_m = nearest_symmetric(R_m, R_co, axis, order)
        if order == 0:
            R = R.copy()
            R[:3, :3] += 1e3 * np.outer(R_m @ axis, R_m @ axis)
        return R_m, R

    def order(self, first: int, last: int, log: Columns) -> list[int]:
        """Return the order in which a stamp is taken in: an unsure state hears the best fit first."""
        order = list(range(first, last))
        if np.trace(self.m.P[POS, POS]) <= self.m.limits[filter_update.SETTLED]:
            return order
        for j in order:
            self.take(log, j, correcting=False)
        return sorted(order, key=lambda j: float(log.nis[j, 0]))

    def _settle_at_agreed(self, log: Columns, first: int, last: int) -> None:
        """Tie the state to those poses of its start's stamp that agreed (`filter_update.settle`)."""
        m, slot = self.m, int(self.m.counters[memory.VOTE_HEAD]) - 1
        for j in reversed(range(first, last if not self.layout.time_offset else first)):
            at = slot % len(m.vote_stamps)
            if m.vote_stamps[at] == m.counters[memory.NOW] and m.votes[at, VOTE_OBJECT] == log.objects[j]:
                slot -= 1
                if m.inliers[at] & WHOLE and log.decisions[j] == REJECTED:
                    log.decisions[j] = self._settle(log, j, m.votes[at])

    def measure(self, log: Columns, first: int, last: int) -> None:
        """Take in all measurements of one stamp, then see whether to start or to start again."""
        m, kinds, decisions, c = self.m, log.kinds, log.decisions, self.m.counters
        decisions[first:last] = REJECTED
        first, odometry = first + int(np.count_nonzero(kinds[first:last] == ODOMETRY_STEP)), first
        if self.tracking:
            self.decay_biases()
            for j in range(odometry, first if c[memory.CLONED] else odometry):
                decisions[j] = self.take(log, j)
                follow_refusals(m, self.work, log, j)
        if odometry < first == last:
            if self.tracking:
                self.clone()
            return
        if m.meeting[UNKNOWN_MAP]:
            choose_anchor(m, kinds, log.objects, first, last)
        follow_spreads(m, log, first, last)
        if self.tracking:
            if filter_update.is_lost(m) and c[memory.UNSURE_AT] <= c[memory.LAST_UPDATE]:
                c[memory.UNSURE_AT] = c[memory.NOW]
            for j in self.order(first, last, log):
                decisions[j] = self.take(log, j)
            for j in range(first, last if (decisions[first:last] & ACCEPTED).any() else first):
                if decisions[j] == REJECTED:  # refused before the others had moved the state: ask again
                    decisions[j] = self.take(log, j)
            for j in range(first, last if len(m.supposed) else first):
                if kinds[j] == OBJECT_POSE and filter_loop.meet(m, self.work, log, j) == PUT:
                    self._put_object(log, j)
                    decisions[j] = ACCEPTED
        filter_loop.account(m, self.work, log, first, last)
        if starts(m, self.work):
            self._settle_at_agreed(log, first, last)
        if odometry < first and self.tracking:
            self.clone()


def run_log(floats: Array, integers: Ints, log: Columns, rows: Rows) -> int:
    """Filter a whole log: `filter_loop.run_log` with the same arguments and the same rows."""
    f = ReferenceFilter(floats, integers)
    stamps, imu_stamps, imu_values = log.stamps, log.imu_stamps, log.imu_values
    filter_motion.begin(f.m, imu_stamps[0], imu_values[0, 3:6].copy(), 0)
    j, row, since = int(np.searchsorted(stamps, imu_stamps[0])), 0, imu_stamps - imu_stamps[0]
    for end in imu_stamps:
        due = -1
        while due <= end:
            due = filter_loop.due(f.m, stamps[j]) if j < len(stamps) else end + 1
            stamp = min(due, end)
            f.advance(imu_stamps, imu_values, stamp)
            if due <= end:
                last = int(np.searchsorted(stamps, stamps[j] + 1))
                imu = np.array([np.interp(stamp - imu_stamps[0], since, imu_values[:, i]) for i in range(6)])
                f.work.rate[:] = imu[:3] - f.m.x[GYRO_BIAS : GYRO_BIAS + 3]
                f.work.force[:] = imu[3:] - f.m.x[ACCEL_BIAS : ACCEL_BIAS + 3]
                f.work.offset[0] = (stamp - stamps[j]) * 1e-9
                f.measure(log, j, last)
                f.m.counters[memory.LAST_STAMP] = stamps[j]
                filter_loop.retime(f.m)
                j = last
            if f.tracking and (row == 0 or rows.stamps[row - 1] != stamp):
                rows.stamps[row], rows.core[row] = stamp, f.m.x[:OUT_CORE]
                rows.sigma[row] = np.sqrt(np.diag(f.m.P)[:OUT_SIGMA].clip(min=0.0))
                rows.covariance[row] = f.m.P[:6, :6].ravel()
                row += 1
    return row
