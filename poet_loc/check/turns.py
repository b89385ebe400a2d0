"""Checks of the gyroscope against turn rates from poses: unit, axes, T_cam_imu, readings of rotations, time offset."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from poet_loc.check.finding import Evidence, Finding
from poet_loc.check.pose_sources import READINGS, PoseSource, Reading, pose_sources, reread
from poet_loc.core.records import Calibration, ImuSamples
from poet_loc.core.trajectory import Trajectory
from poet_loc.core.turn_match import Match, correlation_under, match_turns
from poet_loc.io.log_folder import Log, object_poses_file

Array = NDArray[np.float64]
Direction = Literal["as is", "inverse"]

_TELLING = 0.45  # correlation from which a source is believed
_MARGIN = 0.25  # by which another hypothesis must fit better ..
_CLEAN, _CLEAN_MARGIN = 0.97, 0.05  # .. and where it fits as well as this
_DEGREES = 180.0 / np.pi
_UNIT_MARGIN = 3.0  # on real detections the scale is off by less than 2
_FAINT, _ABOVE_CHANCE = 0.2, 0.1  # correlation from which a source tells that much
_LEAST_IMU = 50  # samples
_AGREES = 0.02  # correlation that a rotation may lack beside the best one
_SAME_OFFSET_S = 0.03


@dataclass(frozen=True)
class _Compared:
    """A source, its match, and the correlation of each hypothesis."""

    source: PoseSource
    match: Match
    """Of the file as it is, or with its rotations the other way round where that fits far better."""
    as_it_is: Match | None
    telling: bool
    """It turns enough like the gyroscope to judge by; a time offset may stand out all the same."""
    fits: dict[tuple[Reading, Direction], float]

    def best_of(self, direction: Direction) -> float:
        """Return the best correlation over readings; a reading other than the file's own has to earn it."""
        return max(fit - 0.05 * (reading != "as is") for (reading, way), fit in self.fits.items() if way == direction)


@dataclass(frozen=True)
class Turning:
    """How fast the gyroscope turns beside the poses of a file that turn with it."""

    over_poses: float
    """1 where it is in rad/s."""
    correlation: float
    file: str
    bias: Array
    """(3,) rad/s that the gyroscope reads beside those turns."""

    @classmethod
    def of(cls, match: Match, file: str, factor: float = 1.0) -> Turning:
        """Take what a match says of a gyroscope that was divided by a factor."""
        bias = match.gyroscope_mean * factor - match.poses_mean
        return cls(match.gyroscope_scale * factor, match.correlation, file, bias)

    @property
    def in_degrees(self) -> bool:
        """Whether no other unit explains it: 57 is far from 1, and from what noise in the poses does to it."""
        return _DEGREES / _UNIT_MARGIN < self.over_poses < _DEGREES * _UNIT_MARGIN

    def as_degrees(self) -> Finding:
        """Return the finding that the gyroscope is in degrees per second."""
        what = "the gyroscope turns 57 times as fast as the poses: degrees"
        fix = "multiply by pi/180: rad/s belong here"
        evidence: Evidence = {"gyroscope_over_poses": self.over_poses, "against": self.file}
        evidence |= {"correlation": self.correlation}
        return Finding("gyroscope-degrees", "error", "imu.csv", what, fix, evidence, _gyroscope_in_radians)


def gyroscope_beside_poses(log: Log) -> Turning | None:
    """Return what the file says whose poses turn most like the gyroscope; None where none turns enough like it.

    Turns that the gyroscope comes nowhere near are gross errors of the poses; which those are depends on its unit, so
    it is read both ways.
    """
    if log.imu is None or len(log.imu) < _LEAST_IMU:
        return None
    found = []
    for source in pose_sources(log):
        rates = source.turn_rates()
        for factor in (1.0, _DEGREES):
            imu = replace(log.imu, angular_velocity=log.imu.angular_velocity / factor)
            match = match_turns(imu, rates)
            if match is not None and match.correlation > max(_FAINT, match.offset.background + _ABOVE_CHANCE):
                found.append(Turning.of(match, source.file, factor))
    return max(found, key=lambda each: each.correlation, default=None)


def check_turns(log: Log) -> Iterator[Finding]:
    """Yield what the turn rates say; nothing where IMU or poses are missing or do not tell."""
    if log.imu is None or len(log.imu) < _LEAST_IMU:
        return
    R_cam_imu = None
    if log.calibration is not None and log.calibration.T_cam_imu is not None:
        R_cam_imu = log.calibration.T_cam_imu.rotation
    every = [each for source in pose_sources(log) if (each := _compare(log.imu, source, R_cam_imu))]
    compared = [each for each in every if each.telling]
    if not compared:
        yield from _offsets(log, every)
        return
    mirrored = list(_axes(compared))
    yield from mirrored
    yield from _gyroscope_unit(max(compared, key=lambda each: each.match.correlation))
    if mirrored:
        return  # no rotation fits mirrored axes: what follows would blame the calibration
    inverted = _is_inverted(compared)
    if inverted:
        yield _inverted_extrinsics(compared)
    misread_findings = list(_readings(compared, "inverse" if inverted else "as is"))
    yield from misread_findings
    if not inverted and R_cam_imu is not None:
        misread = {finding.file for finding in misread_findings}
        yield from _rotation_off([each for each in compared if each.source.file not in misread], R_cam_imu)
    yield from _offsets(log, every)


def _fits_better(fit: float, than: float) -> bool:
    return fit > than + (_CLEAN_MARGIN if fit > _CLEAN else _MARGIN)


def _compare(imu: ImuSamples, source: PoseSource, R_cam_imu: Rotation | None) -> _Compared | None:
    rates = {reading: source.turn_rates(reading) for reading in READINGS}
    as_it_is = match = match_turns(imu, rates["as is"])
    if match is None or match.correlation < _CLEAN:  # a wrong order of the quaternion turns like an inverse
        other = match_turns(imu, rates["inverse"])
        if other is not None and (match is None or other.correlation > match.correlation + 0.01):
            match = other
    if match is None:
        return None
    telling = match.correlation >= max(_TELLING, match.offset.background + 0.1)
    if not telling and not match.offset.distinct:
        return None
    ways: dict[Direction, Rotation] = {}
    if source.body == "imu":
        ways = {"as is": Rotation.identity()}
    elif R_cam_imu is not None:
        ways = {"as is": R_cam_imu.inv(), "inverse": R_cam_imu}
    fits = {
        (reading, way): correlation_under(imu, rates[reading], match.offset.offset_s, rotation)
        for reading in READINGS
        for way, rotation in ways.items()
    }
    return _Compared(source, match, as_it_is, telling, fits)


def _axes(compared: list[_Compared]) -> Iterator[Finding]:
    told = [each for each in compared if each.as_it_is is not None]
    if not told:
        return
    best = max(told, key=lambda each: each.as_it_is.mirrored)  # type: ignore[union-attr]
    match = best.as_it_is
    assert match is not None
    if not _clearly_mirrored(match.mirrored, max(match.correlation, best.match.correlation)):
        return
    if any(each.match.correlation > each.as_it_is.mirrored + 0.03 for each in told):  # type: ignore[union-attr]
        return
    evidence: Evidence = {
        "correlation_best_rotation": match.correlation,
        "correlation_mirrored": match.mirrored,
        "against": best.source.file,
    }
    what = "the gyroscope's axes are left-handed: one axis has the wrong sign or two are swapped"
    fix = "turn one axis round (or swap two back), and look at the accelerometer's axes too"
    yield Finding("axes-mirrored", "error", "imu.csv", what, fix, evidence)


def _clearly_mirrored(mirrored: float, rotated: float) -> bool:
    """Whether a reflection fits far better than any rotation, also of inverted poses: of little, a quarter is left."""
    if mirrored <= _CLEAN:
        return mirrored >= rotated + 0.1
    return mirrored >= rotated + 0.02 or (mirrored >= rotated + 0.005 and 1.0 - mirrored < 0.25 * (1.0 - rotated))


def _gyroscope_unit(compared: _Compared) -> Iterator[Finding]:
    scale = compared.match.gyroscope_scale
    evidence: Evidence = {"gyroscope_over_poses": scale, "against": compared.source.file}
    evidence |= {"correlation": compared.match.correlation}
    turning = Turning.of(compared.match, compared.source.file)
    if turning.in_degrees:
        yield turning.as_degrees()
    elif not 0.6 < scale < 1.7 and compared.match.correlation > 0.8:
        what = "the gyroscope does not turn as fast as the poses"
        fix = "look at its unit and range setting, and at the unit of the stamps"
        yield Finding("gyroscope-scale", "error", "imu.csv", what, fix, evidence)


def _is_inverted(compared: list[_Compared]) -> bool:
    telling = [each for each in compared if each.source.body == "cam" and each.fits]
    if not telling:
        return False
    gain = [each.best_of("inverse") - each.best_of("as is") for each in telling]
    return float(np.mean(gain)) > _MARGIN


def _inverted_extrinsics(compared: list[_Compared]) -> Finding:
    telling = [each for each in compared if each.source.body == "cam"]
    best = max(telling, key=lambda each: each.best_of("inverse"))
    evidence: Evidence = {
        "correlation_as_written": best.best_of("as is"),
        "correlation_inverted": best.best_of("inverse"),
        "against": best.source.file,
        "sources": len(telling),
    }
    what = "T_cam_imu is the other direction: the gyroscope and the poses turn alike only with its inverse"
    fix = "write the inverse, or name it T_imu_cam; Kalibr's T_cam_imu maps imu coordinates into cam"
    return Finding("extrinsics-inverted", "error", "calibration.yaml", what, fix, evidence, _inverse_extrinsics)


def _readings(compared: list[_Compared], direction: Direction) -> Iterator[Finding]:
    for each in compared:
        way: Direction = "as is" if each.source.body == "imu" else direction
        fits = {reading: each.fits[reading, way] for reading in READINGS if (reading, way) in each.fits}
        if not fits:
            continue
        best = max(fits, key=lambda reading: fits[reading])
        others = max(fit for reading, fit in fits.items() if reading != best)
        clear = _fits_better(fits[best], fits["as is"]) and fits[best] > others + _CLEAN_MARGIN
        if best == "as is" or fits[best] < _TELLING or not clear or _is_another_body(each, fits[best]):
            continue
        evidence: Evidence = {f"correlation_{reading.replace(' ', '_')}": fit for reading, fit in fits.items()}
        repair = _reread(each.source.file, best)
        if best == "wxyz":
            what = "quaternions are written w, x, y, z, it seems: only so they turn as the gyroscope does"
            fix = "write qx, qy, qz, qw: the scalar comes last"
            yield Finding("quaternion-order", "error", each.source.file, what, fix, evidence, repair)
        else:
            what = "the poses are the other direction, it seems: only inverted they turn as the gyroscope does"
            name = "T_cam_obj" if each.source.stream.of_object else f"T_world_{each.source.body}"
            yield Finding("poses-inverted", "error", each.source.file, what, f"write {name}", evidence, repair)


def _is_another_body(compared: _Compared, fit: float) -> bool:
    """Whether the file as it is, on a body turned otherwise, fits better than the reading of it that fits best."""
    return compared.as_it_is is not None and compared.as_it_is.correlation > fit


def _rotation_off(compared: list[_Compared], R_cam_imu: Rotation) -> Iterator[Finding]:
    telling = [each for each in compared if each.source.body == "cam" and each.fits and each.as_it_is is each.match]
    if not telling:
        return
    best = max(telling, key=lambda each: each.match.correlation)
    written = best.fits["as is", "as is"]
    if any(each.match.correlation - each.fits["as is", "as is"] < _AGREES for each in telling):
        return  # then the others are of another body
    if best.match.correlation < 0.6 or not _fits_better(best.match.correlation, written):
        return
    R_cam_imu_data = best.match.R_imu_body.inv()
    angle = np.degrees((R_cam_imu * R_cam_imu_data.inv()).magnitude())
    q = ", ".join(f"{value:.3f}" for value in R_cam_imu_data.as_quat(canonical=True))
    evidence: Evidence = {
        "off_by_deg": float(angle),
        "correlation_as_written": written,
        "correlation_best_rotation": best.match.correlation,
        "q_xyzw_of_data": q,
        "against": best.source.file,
    }
    what = "the rotation of T_cam_imu does not fit the data, in neither direction"
    fix = "calibrate it (Kalibr), or look for swapped axes of the IMU; the rotation that fits is in the evidence"
    yield Finding("extrinsics-rotation", "error", "calibration.yaml", what, fix, evidence)


def unreadable_calibration(log: Log) -> bool:
    """Whether calibration.yaml is there and holds nothing that could be read: what it states is not known."""
    return log.calibration is None and (log.path / "calibration.yaml").exists()


def _offsets(log: Log, compared: list[_Compared]) -> Iterator[Finding]:
    if unreadable_calibration(log):
        compared = [each for each in compared if each.source.body == "imu"]
    stated = log.calibration.timeshift_cam_imu_s if log.calibration else 0.0
    late = []
    for each in compared:
        expected = stated if each.source.body == "cam" else 0.0
        if each.match.contradicts(expected):
            late.append((each, each.match.offset.offset_s - expected))
    of_camera = [each for each, _ in late if each.source.body == "cam"]
    best = max(of_camera, key=lambda each: each.match.correlation, default=None)
    agree = best is not None and all(_agree(best, each) for each in compared if each.source.body == "cam")
    for each, off in late:
        shared = agree and each.source.body == "cam"
        if not shared or each is best:
            yield _offset_finding(each, off, stated, shared)


def _agree(best: _Compared, other: _Compared) -> bool:
    apart = abs(other.match.offset.offset_s - best.match.offset.offset_s)
    return apart < max(_SAME_OFFSET_S, other.match.offset_error_s)


def _offset_finding(each: _Compared, off: float, stated: float, shared: bool) -> Finding:
    measured = each.match.offset.offset_s
    evidence: Evidence = {
        "measured_t_imu_minus_t_pose_s": round(measured, 4),
        "expected_s": stated if each.source.body == "cam" else 0.0,
        "sigma_s": round(each.match.offset.sigma_s, 4),
        "correlation": each.match.correlation,
        "correlation_far_away": each.match.offset.background,
    }
    way = "late" if off < 0 else "early"
    what = (
        f"its stamps are {abs(off) * 1e3:.0f} ms {way}: what the gyroscope feels at t stands here at "
        f"t {'+' if off < 0 else '-'} {abs(off) * 1e3:.0f} ms"
    )
    if shared:
        fix = f"set timeshift_cam_imu: {measured:.4f} in calibration.yaml (t_imu = t_cam + timeshift_cam_imu)"
        repair = _with_timeshift(measured)
        return Finding("time-offset", "error", each.source.file, what, fix, evidence, repair)
    fix = f"add {off:+.4f} s to its stamps (t_imu = t_cam + timeshift_cam_imu, and not every file is off)"
    return Finding("time-offset", "error", each.source.file, what, fix, evidence)


def _gyroscope_in_radians(log: Log) -> Log:
    assert log.imu is not None
    return replace(log, imu=replace(log.imu, angular_velocity=log.imu.angular_velocity / _DEGREES))


def _inverse_extrinsics(log: Log) -> Log:
    assert log.calibration is not None
    assert log.calibration.T_cam_imu is not None
    return replace(log, calibration=replace(log.calibration, T_cam_imu=log.calibration.T_cam_imu.inv()))


def _with_timeshift(timeshift_s: float):  # type: ignore[no-untyped-def]
    def repair(log: Log) -> Log:
        calibration = log.calibration or Calibration()
        return replace(log, calibration=replace(calibration, timeshift_cam_imu_s=round(timeshift_s, 4)))

    return repair


def _reread(file: str, reading: Reading):  # type: ignore[no-untyped-def]
    def repair(log: Log) -> Log:
        if file == "camera_poses.csv":
            assert log.camera_poses is not None
            T = reread(log.camera_poses.T_world_cam, reading)
            return replace(log, camera_poses=replace(log.camera_poses, T_world_cam=T))
        for name, poses in log.object_poses.items():
            if object_poses_file(name) == file:
                other = replace(poses, T_cam_obj=reread(poses.T_cam_obj, reading))
                return replace(log, object_poses={**log.object_poses, name: other})
        field = file.split(".")[0]
        trajectory = getattr(log, field)
        turned = reread(trajectory.T_world_body, reading)
        fields: dict[str, Any] = {field: Trajectory(trajectory.stamps_ns, turned)}
        return replace(log, **fields)

    return repair
