"""poet-loc: object-relative localisation from 6D object poses, landmarks and an IMU.

The names below are the stable interface; everything else may move. Each is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fusion.graph_online import GraphEstimator
    from fusion.online import Estimator, OnlineState
    from fusion.online_input import OnlineOptions
    from fusion.options import FuseOptions
    from landmarks.localize import LocalizeOptions
    from poet_loc.api import Comparison, FusedTrajectory, Localization, evaluate, fuse, localize
    from poet_loc.core.input_error import InputError
    from poet_loc.core.records import Calibration, LandmarkMap
    from poet_loc.core.trajectory import Trajectory
    from poet_loc.io.calibration_yaml import read_calibration
    from poet_loc.io.landmarks_json import read_landmarks
    from poet_loc.io.log_folder import Log, read_log
    from poet_loc.report.evaluate import EvaluateOptions

__all__ = [
    "Calibration",
    "Comparison",
    "Estimator",
    "EvaluateOptions",
    "FuseOptions",
    "FusedTrajectory",
    "GraphEstimator",
    "InputError",
    "LandmarkMap",
    "Localization",
    "LocalizeOptions",
    "Log",
    "OnlineOptions",
    "OnlineState",
    "Trajectory",
    "evaluate",
    "fuse",
    "localize",
    "read_calibration",
    "read_landmarks",
    "read_log",
]

_HOMES = {
    "poet_loc.api": ("Comparison", "FusedTrajectory", "Localization", "evaluate", "fuse", "localize"),
    "poet_loc.core.input_error": ("InputError",),
    "poet_loc.core.records": ("Calibration", "LandmarkMap"),
    "poet_loc.core.trajectory": ("Trajectory",),
    "poet_loc.io.calibration_yaml": ("read_calibration",),
    "poet_loc.io.landmarks_json": ("read_landmarks",),
    "poet_loc.io.log_folder": ("Log", "read_log"),
    "poet_loc.report.evaluate": ("EvaluateOptions",),
    "fusion.graph_online": ("GraphEstimator",),
    "fusion.online": ("Estimator", "OnlineState"),
    "fusion.online_input": ("OnlineOptions",),
    "fusion.options": ("FuseOptions",),
    "landmarks.localize": ("LocalizeOptions",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'poet_loc' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
