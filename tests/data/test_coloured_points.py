"""Coloured points of BOP models: on the surface, in the colours of texture or vertices."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from poet_loc.core.input_error import InputError
from poet_loc.data.coloured_points import coloured_points
from poet_loc.data.world.bop_writer import write_models
from poet_loc.data.world.objects import household_objects

HEADER = ["ply", "format ascii 1.0"]
SQUARE = [(0, 0, 0), (100, 0, 0), (100, 100, 0), (0, 100, 0)]


def model(folder, columns: list[str], rows: list[tuple], comment: str = "comment made by a test"):
    folder.mkdir(exist_ok=True)
    head = [*HEADER, comment, "element vertex 4", *[f"property {column}" for column in columns]]
    head += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    lines = [" ".join(map(str, (*place, *row))) for place, row in zip(SQUARE, rows, strict=True)]
    (folder / "obj_000001.ply").write_text("\n".join([*head, *lines, "4 0 1 2 3", ""]))
    sizes = {"diameter": 141.4, "min_x": 0, "min_y": 0, "min_z": 0, "size_x": 100, "size_y": 100, "size_z": 0}
    (folder / "models_info.json").write_text(json.dumps({"1": sizes}))
    return folder


PLACE = ["float x", "float y", "float z"]


def test_a_texture_colours_the_points_with_its_first_row_on_top(tmp_path):
    rows = [(0, 0), (1, 0), (1, 1), (0, 1)]
    folder = model(tmp_path / "m", [*PLACE, "float texture_u", "float texture_v"], rows, "comment TextureFile t.png")
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, 32:, 2] = 200  # right half red, in OpenCV's order
    image[:32, :, 1] = 100  # upper half green
    cv2.imwrite(str(folder / "t.png"), image)
    points, colours, diameters = coloured_points(folder, 3000)
    assert points.shape == colours.shape == (1, 3000, 3)
    assert diameters[0] == pytest.approx(0.1414)
    x, y = points[0, :, 0], points[0, :, 1]
    assert np.all(points[0, :, 2] == 0)
    clear = (np.abs(x - 0.05) > 0.01) & (np.abs(y - 0.05) > 0.01)
    assert np.array_equal(colours[0, clear, 0], np.where(x > 0.05, 200, 0)[clear])
    assert np.array_equal(colours[0, clear, 1], np.where(y > 0.05, 100, 0)[clear])
    corners = [np.mean((x < 0.05) == a, where=(y < 0.05)) for a in (True, False)]
    assert corners == pytest.approx([0.5, 0.5], abs=0.05)  # as many everywhere


def test_colours_of_vertices_blend_and_without_any_all_is_gray(tmp_path):
    columns = [*PLACE, "uchar red", "uchar green", "uchar blue"]
    folder = model(tmp_path / "m", columns, [(0, 0, 9), (200, 0, 9), (200, 100, 9), (0, 100, 9)])
    points, colours, _ = coloured_points(folder, 500)
    np.testing.assert_allclose(colours[0, :, 0], 2000 * points[0, :, 0], atol=0.51)
    np.testing.assert_allclose(colours[0, :, 1], 1000 * points[0, :, 1], atol=0.51)
    plain = coloured_points(model(tmp_path / "plain", PLACE, [()] * 4), 50)[1]
    assert np.all(plain == 128)


def test_a_missing_texture_is_named(tmp_path):
    rows = [(0, 0), (1, 0), (1, 1), (0, 1)]
    folder = model(tmp_path / "m", [*PLACE, "float texture_u", "float texture_v"], rows, "comment TextureFile t.png")
    with pytest.raises(InputError, match=r"t\.png"):
        coloured_points(folder, 10)


def test_the_worlds_models_come_with_their_colours(tmp_path):
    things = household_objects()
    write_models(tmp_path, things)
    points, colours, diameters = coloured_points(tmp_path, 500)
    for k, thing in enumerate(things):
        assert diameters[k] == pytest.approx(thing.diameter, abs=1e-6)
        assert np.all(np.abs(points[k]) <= thing.extent / 2 + 1e-6)
        assert colours[k].std() > 5
    again = coloured_points(tmp_path, 500)
    assert np.array_equal(points, again[0])
    assert np.array_equal(colours, again[1])
