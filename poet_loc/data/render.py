"""The stage `render`: the synthetic world as a BOP data set, the same bytes for the same seed.

A scene is written into a folder of its own name plus .partial and renamed when it is whole, so that an interrupted run
goes on where it stopped.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poet_loc.core.input_error import InputError, at_least, processes
from poet_loc.data.rendered import keep_to_options


@dataclass(frozen=True)
class RenderOptions:
    """What to render."""

    out: Path
    """Folder of the BOP data set: models/, and one folder per split."""
    split: str = "train"
    """Name of the split's folder; another name with the same seed shows the same images."""
    images: int = 1000
    """Images in all."""
    first_scene: int = 0
    """Number of the first scene; scenes of other numbers show other images (validation: 900000)."""
    images_per_scene: int = 250
    """Images per scene folder, each with its own things, light and camera."""
    size: tuple[int, int] = (320, 240)
    """(width, height), pixels."""
    seed: int = 0
    """Seed of scenes, cameras and sensors."""
    world_seed: int = 0
    """Seed of the ten objects, the clutter and the surfaces."""
    masks: bool = True
    """Write mask/ and mask_visib/."""
    depth: bool = True
    """Write depth/ (0.1 mm)."""
    jobs: int = -1
    """Processes; -1: one per core."""
    progress: bool = True
    """Show a progress bar."""

    def __post_init__(self) -> None:
        at_least(0, self, "first_scene", "seed", "world_seed")
        processes("jobs", self.jobs)


def render(options: RenderOptions) -> Path:
    """Render random scenes of the world into options.out / options.split and return that folder.

    Raises InputError for sizes or counts that make no sense, and for a folder with images of other options.
    """
    from joblib import Parallel, delayed

    from poet_loc.data.world.bop_writer import write_models
    from poet_loc.data.world.view import load_assets

    if options.images < 1 or options.images_per_scene < 1 or min(options.size) < 16:
        raise InputError(f"cannot render {options.images} images of size {options.size}", fix="use positive numbers")
    folder = options.out / options.split
    keep_to_options(options.out, options, "world_seed")
    keep_to_options(folder, options, "seed", "size", "images_per_scene", "masks", "depth")
    write_models(options.out / "models", load_assets(options.world_seed).objects)
    counts = [options.images_per_scene] * (options.images // options.images_per_scene)
    if options.images % options.images_per_scene:
        counts.append(options.images % options.images_per_scene)
    numbers = [options.first_scene + index for index in range(len(counts))]
    missing = [
        (number, count) for number, count in zip(numbers, counts) if not _is_whole(folder / f"{number:06d}", count)
    ]
    workers = Parallel(
        n_jobs=min(len(missing), options.jobs) if options.jobs > 0 else options.jobs, return_as="generator_unordered"
    )
    tasks = (delayed(render_scene)(options, number, count) for number, count in missing)
    done = workers(tasks) if missing else ()
    show_progress(done, len(counts), len(counts) - len(missing), "scenes", options.progress)
    return folder


def _is_whole(scene: Path, count: int) -> bool:
    return len(list((scene / "rgb").glob("*.jpg"))) >= count


def render_scene(options: RenderOptions, number: int, count: int) -> int:
    """Render the images of one scene folder and return its number."""
    from poet_loc.data.world.bop_writer import SceneWriter
    from poet_loc.data.world.sampling import random_intrinsics, random_scene, random_view
    from poet_loc.data.world.sensor import expose, random_sensor
    from poet_loc.data.world.view import load_assets, place, render_image

    assets = load_assets(options.world_seed)
    final = options.out / options.split / f"{number:06d}"
    partial = final.with_suffix(".partial")
    shutil.rmtree(partial, ignore_errors=True)
    writer = SceneWriter(partial, assets, options.size, options.masks, options.depth)
    for index in range(count):
        rng = np.random.default_rng([options.seed, 10, number, index])
        scene, T_cam_world = random_scene(assets, rng), random_view(rng).inv()
        intrinsics = random_intrinsics(options.size, rng)
        light = render_image(assets, scene, T_cam_world, intrinsics, options.size)
        sensor = random_sensor(rng, float(light.mean()))
        geometry = place(assets, scene, T_cam_world, intrinsics)
        writer.add(index, expose(light, sensor, rng), sensor.quality, scene, T_cam_world, intrinsics, geometry)
    writer.close()
    shutil.rmtree(final, ignore_errors=True)  # one with fewer images, as an earlier run was asked for
    partial.rename(final)
    return number


def show_progress(done: Iterable[object], total: int, already: int, noun: str, visible: bool) -> None:
    """Draw a bar while `done` yields one result after the other."""
    with progress_bar("rendering", noun, total, visible, already) as advance:
        for _ in done:
            advance(1)


@contextmanager
def progress_bar(
    verb: str, noun: str, total: int | None, visible: bool = True, already: int = 0
) -> Iterator[Callable[[int], None]]:
    """Yield what advances a bar on stderr; nothing is drawn where that is no terminal.  total None: not known."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(verb), BarColumn(), MofNCompleteColumn(), TextColumn(noun), TimeRemainingColumn())
    shown = visible and sys.stderr.isatty()
    with Progress(*columns, console=Console(stderr=True), disable=not shown) as progress:
        task = progress.add_task(noun, total=total, completed=already)
        yield lambda count: progress.advance(task, count)
