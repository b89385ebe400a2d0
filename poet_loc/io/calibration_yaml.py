"""calibration.yaml: Kalibr's camera chain and IMU in one file or either alone, also as OpenCV writes YAML."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform

from poet_loc.core.input_error import InputError
from poet_loc.core.records import Calibration, Camera, ImuNoise
from poet_loc.io.input_text import line_of, read_text
from poet_loc.io.json_fields import FieldError, number, numbers, required, rigid_matrix, whole_number
from poet_loc.io.whole_folder import write_whole_file

_DENSITIES = ("gyroscope_noise_density", "accelerometer_noise_density")
_WALKS = ("gyroscope_random_walk", "accelerometer_random_walk")
_NOISE = (*_DENSITIES, *_WALKS, "update_rate")
_CAMERA = (
    *("T_cam_imu", "T_imu_cam", "intrinsics", "distortion_model", "distortion_coeffs", "resolution"),
    *("timeshift_cam_imu", "camera_model"),
)
_COEFFICIENTS = {"none": (0,), "radtan": (4, 5), "equidistant": (4,), "fov": (1,)}
_LONGEST_LEVER_M = 10.0
_FIX = "write it as Kalibr's camchain (cam0: ..) and imu (imu0: ..) do"


def read_calibration(path: str | Path, camera: str = "cam0") -> Calibration:
    """Read camera, IMU noise and what lies between them, as far as the file has them.

    `T_imu_cam` is taken in place of `T_cam_imu`; keys that Kalibr writes and nobody needs here are passed over.
    Raises InputError for a wrong value, a missing noise density, and a key that looks misspelt.
    """
    text = read_text(path)
    content = _parse(path, text)
    with _told_with_line(path, text):
        if not isinstance(content, Mapping):
            raise FieldError("is no mapping")
        noise = content if set(_NOISE) & set(content) else content.get("imu0")
        chain = content.get(camera)
        if noise is None and chain is None:
            raise FieldError(f"has neither {camera} nor imu0")
        if not all(part is None or isinstance(part, Mapping) for part in (noise, chain)):
            raise FieldError(f"{camera} and imu0 hold keys and values")
        return Calibration(
            T_cam_imu=None if chain is None else _extrinsics(chain),
            timeshift_cam_imu_s=0.0 if chain is None else _timeshift(chain),
            camera=None if chain is None else _camera(chain),
            imu=None if noise is None else _noise(noise),
        )


def names_imu_cam(path: str | Path, camera: str = "cam0") -> bool:
    """Return whether the transform of a camera that `read_calibration` reads stands under the name T_imu_cam."""
    content = _parse(path, read_text(path))
    chain = content.get(camera) if isinstance(content, Mapping) else None
    return isinstance(chain, Mapping) and "T_imu_cam" in chain


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write what the calibration has, in Kalibr's names."""
    content: dict[str, Any] = {}
    cam0: dict[str, Any] = {}
    if calibration.T_cam_imu is not None:
        cam0["T_cam_imu"] = calibration.T_cam_imu.as_matrix().tolist()
    if calibration.camera is not None:
        cam0 |= _camera_fields(calibration.camera)
    if cam0 or calibration.timeshift_cam_imu_s:
        content["cam0"] = cam0 | {"timeshift_cam_imu": float(calibration.timeshift_cam_imu_s)}
    if calibration.imu is not None:
        content["imu0"] = {name: float(getattr(calibration.imu, name)) for name in _NOISE}
    write_whole_file(path, [yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)])


def _parse(path: str | Path, text: str) -> Any:
    # OpenCV: "%YAML:1.0" is no YAML directive, and its matrices carry a tag that only names their layout.
    text = re.sub(r"\A%YAML:\s*1\.0[^\n]*", "", text).replace("!!opencv-matrix", "")
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = None if mark is None else mark.line + 1
        what = getattr(error, "problem", None) or "cannot be read"
        raise InputError(f"is no YAML: {what}", path=path, line=line, fix="correct the file") from error


@contextmanager
def _told_with_line(path: str | Path, text: str) -> Iterator[None]:
    try:
        yield
    except FieldError as error:
        key = re.match(r"\w+", str(error))
        line = line_of(text, rf"(?m)^\s*{key.group()}\s*:") if key else None
        raise InputError(str(error), path=path, line=line, fix=_FIX) from None


def _refuse_misspelt(fields: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for name in fields:
        near = [] if name in known else difflib.get_close_matches(str(name), known, n=1, cutoff=0.85)
        if near and near[0] not in fields:
            raise FieldError(f"{name} is an unknown key: {near[0]} is meant, it seems")


def _matrix(value: Any) -> Any:
    """Return the rows of a matrix, also of OpenCV's {rows, cols, data}."""
    if isinstance(value, Mapping) and {"rows", "cols", "data"} <= set(value):
        rows, cols = whole_number(value["rows"], "rows"), whole_number(value["cols"], "cols")
        return numbers(value["data"], "data", (rows * cols,)).reshape(rows, cols)
    return value


def _extrinsics(chain: Mapping[str, Any]) -> RigidTransform | None:
    _refuse_misspelt(chain, _CAMERA)
    if "T_cam_imu" in chain and "T_imu_cam" in chain:
        raise FieldError("T_imu_cam stands beside T_cam_imu: keep one of them")
    name = "T_imu_cam" if "T_imu_cam" in chain else "T_cam_imu"
    if name not in chain:
        return None
    transform = rigid_matrix(_matrix(chain[name]), name)
    lever = float(np.linalg.norm(transform.translation))
    if lever > _LONGEST_LEVER_M:
        raise FieldError(f"{name} has a lever arm of {lever:.0f} m, it looks like millimetres")
    return transform if name == "T_cam_imu" else transform.inv()


def _timeshift(chain: Mapping[str, Any]) -> float:
    return number(chain.get("timeshift_cam_imu", 0.0), "timeshift_cam_imu")


def _camera(chain: Mapping[str, Any]) -> Camera | None:
    if "intrinsics" not in chain:
        return None
    if chain.get("camera_model", "pinhole") != "pinhole":
        raise FieldError(f"camera_model is {chain['camera_model']!r}: only pinhole is known here")
    fx, fy, cx, cy = numbers(chain["intrinsics"], "intrinsics", (4,)).tolist()
    if min(fx, fy) <= 0:
        raise FieldError("intrinsics need positive focal lengths fx, fy")
    model = chain.get("distortion_model", "none")
    if model not in _COEFFICIENTS:
        raise FieldError(f"distortion_model is {model!r}: {', '.join(_COEFFICIENTS)} are known here")
    coefficients = _coefficients(chain.get("distortion_coeffs") or [])
    if model == "none" and not any(coefficients):
        coefficients = []  # written as zeros
    if len(coefficients) not in _COEFFICIENTS[model] and (len(coefficients) or model != "none"):
        raise FieldError(f"distortion_coeffs has {len(coefficients)} values, {model} needs {_COEFFICIENTS[model][0]}")
    return Camera(
        (fx, fy, cx, cy),
        model,
        tuple(coefficients),
        _resolution(chain.get("resolution")),
    )


def _coefficients(value: Any) -> list[float]:
    values = _matrix(value)
    if isinstance(values, np.ndarray):
        values = values.ravel().tolist()
    if not isinstance(values, list):
        raise FieldError(f"distortion_coeffs is {values!r}, no list")
    return [number(each, "distortion_coeffs") for each in values]


def _resolution(value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    width, height = numbers(value, "resolution", (2,))
    if min(width, height) < 1 or width != int(width) or height != int(height):
        raise FieldError(f"resolution is {value}: width and height in pixels belong there")
    return int(width), int(height)


def _noise(fields: Mapping[str, Any]) -> ImuNoise:
    _refuse_misspelt(fields, _NOISE)
    values = {name: number(required(fields, name), name) for name in _NOISE}
    for name in (*_DENSITIES, "update_rate"):
        if values[name] <= 0:
            raise FieldError(f"{name} is {values[name]:g}: more than zero belongs there")
    for name in _WALKS:
        if values[name] < 0:
            raise FieldError(f"{name} is {values[name]:g}: it cannot be negative")
    return ImuNoise(**values)


def _camera_fields(camera: Camera) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "camera_model": "pinhole",
        "intrinsics": [float(value) for value in camera.intrinsics],
        "distortion_model": camera.distortion_model,
        "distortion_coeffs": [float(value) for value in camera.distortion_coeffs],
    }
    if camera.resolution is not None:
        fields["resolution"] = [int(value) for value in camera.resolution]
    return fields
