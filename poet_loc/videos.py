"""The stage `render videos`: hand-held videos of the rendered world as log folders, from pixels to the IMU.

Each has its own things on the table, light, motion and IMU errors, and one object in a tilted pose of its own. Beside
the files of a log a folder has those of a BOP scene: rgb/, scene_camera.json, scene_gt.json, scene_gt_info.json.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from poet_loc.core.input_error import InputError, processes, within

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from poet_loc.core.records import LandmarkMap
    from poet_loc.data.world.bop_writer import SceneWriter
    from poet_loc.data.world.sensor import Sensor
    from poet_loc.data.world.view import Assets, Scene
    from poet_loc.detect.options import DetectOptions
    from poet_loc.io.log_folder import Log


@dataclass(frozen=True)
class VideoOptions:
    """Which videos to render."""

    out: Path
    """Folder of the log folders, and of models/."""
    videos: int = 12
    """How many."""
    first: int = 0
    """Number of the first video; others show other things."""
    duration_s: tuple[float, float] = (10.0, 60.0)
    """Shortest and longest video, s; most are nearer to the shortest."""
    frame_rate_hz: float = 30.0
    size: tuple[int, int] = (320, 240)
    """(width, height), pixels."""
    focal_px: float = 410.0
    """Focal length, pixels; 43 degrees for 320 columns."""
    objects: tuple[int, int] = (4, 6)
    """Fewest and most objects on the table."""
    exposure_s: float = 0.008
    """Exposure time, for the motion blur, s."""
    seed: int = 0
    """Seed of scenes, motions and errors."""
    world_seed: int = 0
    """Seed of the ten objects, the clutter and the surfaces."""
    jobs: int = -1
    """Processes; -1: one per core."""
    progress: bool = True
    """Show a progress bar."""

    def __post_init__(self) -> None:
        within("(0, inf)", self, "frame_rate_hz", "focal_px")
        within("[0, inf)", self, "first", "seed", "world_seed", "exposure_s")
        processes("jobs", self.jobs)


_OF_THE_IMAGES = (
    "duration_s", "frame_rate_hz", "size", "focal_px", "objects", "exposure_s", "seed", "world_seed"
)  # fmt: skip


def render_videos(options: VideoOptions) -> list[Path]:
    """Render the videos that are not there yet and return the log folders.  Raises InputError for senseless options."""
    from joblib import Parallel, delayed

    from poet_loc.data.render import show_progress
    from poet_loc.data.rendered import keep_to_options
    from poet_loc.data.world.bop_writer import write_models
    from poet_loc.data.world.view import load_assets

    if options.videos < 1 or not 2.0 <= options.duration_s[0] <= options.duration_s[1]:
        raise InputError(f"cannot render {options.videos} videos of {options.duration_s} s", fix="at least one of 2 s")
    if min(options.size) < 16:
        raise InputError(f"cannot render images of size {options.size}", fix="at least 16 pixels each way")
    if not 1 <= options.objects[0] <= options.objects[1] <= 10:
        raise InputError(f"cannot put {options.objects} of ten objects on the table", fix="1 to 10")
    keep_to_options(options.out, options, *_OF_THE_IMAGES)
    write_models(options.out / "models", load_assets(options.world_seed).objects)
    numbers = range(options.first, options.first + options.videos)
    missing = [number for number in numbers if not video_folder(options, number).exists()]
    workers = Parallel(n_jobs=options.jobs, return_as="generator_unordered")
    done = workers(delayed(render_video)(options, number) for number in missing) if missing else ()
    show_progress(done, options.videos, options.videos - len(missing), "videos", options.progress)
    return [video_folder(options, number) for number in numbers]


def video_folder(options: VideoOptions, number: int) -> Path:
    """Return the log folder of a video."""
    return options.out / f"video_{number:02d}"


def render_video(options: VideoOptions, number: int, folder: Path | None = None, progress: bool = False) -> Path:
    """Render one video and return its log folder, which appears when it is whole.

    folder: where, if not among the others; progress: show a bar of its frames.
    """
    from poet_loc.data.render import show_progress
    from poet_loc.data.world.bop_writer import SceneWriter
    from poet_loc.data.world.view import load_assets
    from poet_loc.io.log_folder import write_log

    assets = load_assets(options.world_seed)
    rng = np.random.default_rng([options.seed, 40, number])
    scene = table_of_video(assets, options, rng)
    log = _recording(options, number, landmarks_of(assets, scene), rng)
    final = folder or video_folder(options, number)
    partial = final.with_suffix(".partial")
    shutil.rmtree(partial, ignore_errors=True)
    writer = SceneWriter(partial, assets, options.size, masks=False, depth=False)
    assert log.frames is not None
    show_progress(_frames(options, assets, scene, log, writer, rng), len(log.frames), 0, "frames", progress)
    writer.close()
    write_log(partial, log)
    partial.rename(final)
    return final


def _frames(
    options: VideoOptions, assets: Assets, scene: Scene, log: Log, writer: SceneWriter, rng: np.random.Generator
) -> Iterator[int]:
    """Render frame by frame."""
    from poet_loc.data.world.sensor import expose
    from poet_loc.data.world.view import place, render_image

    assert log.T_world_cam is not None
    assert log.calibration is not None
    assert log.calibration.camera is not None
    intrinsics = log.calibration.camera.intrinsics
    T_cam_world = log.T_world_cam.T_world_body.inv()
    motion = _image_motion(T_cam_world.as_matrix(), intrinsics) * (options.exposure_s * options.frame_rate_hz)
    sensor = None
    for frame in range(len(T_cam_world)):
        light = render_image(assets, scene, T_cam_world[frame], intrinsics, options.size)
        sensor = sensor or _sensor_of_video(float(light.mean()), rng)
        image = expose(light, replace(sensor, motion=(float(motion[frame, 0]), float(motion[frame, 1]))), rng)
        geometry = place(assets, scene, T_cam_world[frame], intrinsics)
        writer.add(frame, image, sensor.quality, scene, T_cam_world[frame], intrinsics, geometry)
        yield frame


def table_of_video(assets: Assets, options: VideoOptions, rng: np.random.Generator) -> Scene:
    """Return the scene of a video: objects as one would put them down, one of them tilted, and some clutter."""
    from poet_loc.data.world.sampling import compose

    count = int(rng.integers(options.objects[0], options.objects[1] + 1))
    chosen = [int(number) for number in rng.permutation(len(assets.objects))[:count]]
    kinds = ["leaning"] + [str(rng.choice(["usual", "resting"], p=[0.7, 0.3])) for _ in chosen[1:]]
    scene = compose(assets, chosen, kinds, int(rng.integers(1, 4)), rng, reach=0.2)
    return replace(scene, table_half_size=max(scene.table_half_size, 0.6))


def landmarks_of(assets: Assets, scene: Scene) -> LandmarkMap:
    """Return the map of the objects in a scene."""
    from poet_loc.core.records import Landmark, LandmarkMap

    landmarks = []
    for place, number in enumerate(scene.things):
        if number < len(assets.objects):
            thing = assets.objects[number]
            T_world_obj = scene.T_world_thing[place]
            landmarks.append(Landmark(thing.object_id, T_world_obj, name=thing.name, symmetry=thing.symmetry))
    return LandmarkMap(tuple(sorted(landmarks, key=lambda landmark: landmark.object_id)))


def _recording(options: VideoOptions, number: int, landmark_map: LandmarkMap, rng: np.random.Generator) -> Log:
    """Return motion, IMU, calibration and ground truth of a video."""
    from fusion.simulate import SimulationOptions, simulate
    from poet_loc.core.records import Camera
    from poet_loc.io.frames_csv import Frames

    shortest, longest = options.duration_s
    duration_s = shortest + (longest - shortest) * rng.random() ** 2
    seed = int(np.random.default_rng([options.seed, 41, number]).integers(2**31))
    rate_hz = options.frame_rate_hz
    log = simulate(SimulationOptions(duration_s, camera_rate_hz=rate_hz, objects=1, symmetric_objects=0, seed=seed))
    assert log.T_world_cam is not None
    assert log.calibration is not None
    width, height = options.size
    intrinsics = (options.focal_px, options.focal_px, width / 2 - 0.5, height / 2 - 0.5)
    stamps_ns = log.T_world_cam.stamps_ns
    frames = np.arange(len(stamps_ns))
    names = tuple(f"rgb/{frame:06d}.jpg" for frame in frames)
    return replace(
        log,
        object_poses={},
        landmark_map=landmark_map,
        calibration=replace(log.calibration, camera=Camera(intrinsics, resolution=options.size)),
        frames=Frames(stamps_ns, frames, names),
    )


def _image_motion(T_cam_world: NDArray[Any], intrinsics: tuple[float, float, float, float]) -> NDArray[Any]:
    """Return (N, 2) how far the world's origin moves in the image from frame to frame, pixels."""
    origin = T_cam_world[:, :3, 3]
    pixels = origin[:, :2] / origin[:, 2:] * np.array(intrinsics[:2])
    return np.asarray(np.gradient(pixels, axis=0))


def _sensor_of_video(mean_light: float, rng: np.random.Generator) -> Sensor:
    """Return settings that stay the same through a video; its first frame is exposed well."""
    from poet_loc.data.world.sensor import random_sensor

    sensor = random_sensor(rng, mean_light)
    exposure = 0.22 / max(mean_light, 0.02) * np.exp(rng.normal(0.0, 0.15))
    blur, noise = min(sensor.blur, 0.6), min(sensor.noise, 0.02)
    return replace(sensor, exposure=float(exposure), blur=blur, noise=noise, quality=90)


def log_from_pixels(
    options: VideoOptions, number: int = 0, detection: DetectOptions | None = None, folder: Path | None = None
) -> Log:
    """Render a video, detect its objects with the embedded network, and return the log, object_poses.csv included.

    This is the demonstration's world: nothing in the poses comes from anywhere but the pixels.  folder: where the video
    goes, if not among the others of options.out.
    """
    from poet_loc.data.world.bop_writer import write_models
    from poet_loc.data.world.view import load_assets
    from poet_loc.detect.stage import detect_in_log
    from poet_loc.io.log_folder import read_log

    write_models(options.out / "models", load_assets(options.world_seed).objects)
    folder = folder or video_folder(options, number)
    if not folder.exists():
        render_video(options, number, folder, options.progress)
    detect_in_log(folder, "", detection, overwrite=True, progress=options.progress)
    return read_log(folder)
