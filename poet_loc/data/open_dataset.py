"""Finds out what kind of data set a path is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from poet_loc.core.input_error import InputError
from poet_loc.data.annotation_dataset import FOLDERS, AnnotationDataset
from poet_loc.data.bop_dataset import BopDataset


def open_dataset(
    path: str | Path,
    images: str | Path | None = None,
    object_ids: Sequence[int] = (),
    least_visible: float = 0.05,
    keyframes: str | Path | None = None,
    keep_empty: bool = False,
) -> AnnotationDataset | BopDataset:
    """Open an annotation file (.json) or a BOP split folder.

    images: folder of an annotation file's images; without it, the published layout: ROOT/annotations/SPLIT.json beside
    ROOT/train, ROOT/val or ROOT/test_all.  The other arguments are those of `BopDataset`.
    """
    path = Path(path)
    if path.suffix == ".json":
        if keyframes is not None or object_ids:
            raise InputError(
                "key frames and object ids are chosen in a BOP folder, not in an annotation file", path=path
            )
        folder = path.parent.parent / FOLDERS.get(path.stem, "train") if images is None else Path(images)
        return AnnotationDataset(path, folder)
    if images is not None:
        raise InputError("images belong to an annotation file; a BOP folder has its own", path=path)
    return BopDataset(path, object_ids, least_visible, keyframes, keep_empty)
