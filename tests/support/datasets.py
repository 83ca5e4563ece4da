"""Folders of small datasets in both layouts, and clouds of points."""

import json
import warnings

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from drgs.config.schema import DataConfig
from drgs.core.errors import UserError, UserNote
from drgs.datasets import load_dataset
from drgs.datasets.types import Dataset, View


def look_at(center, target, up=(0, 0, 1)):
    """(4, 4) camera to world in OpenGL axes (x right, y up, z backward)."""
    center, target = np.asarray(center, float), np.asarray(target, float)
    back = (center - target) / np.linalg.norm(center - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, center], axis=1)
    return matrix


def view_at(center, target, width=40, height=30):
    matrix = look_at(center, target)
    matrix[:3, 1:3] *= -1
    image = np.zeros((height, width, 3), np.float32)
    return View("v", matrix, width, width, width / 2, height / 2, width, height, image=image)


def dataset_of(views, half_extent=None):
    return Dataset(tuple(views), tuple(views), "test", (1.0, 1.0, 1.0), half_extent, "")


def write_points(path, positions, colors):
    kinds = [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    rows = np.empty(len(positions), kinds)
    for name, column in zip([n for n, _ in kinds], np.hstack([positions, colors]).T, strict=True):
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


CENTERS = [(4, 0, 0), (0, 4, 1), (-3, 0, 2)]


def edit(path, change):
    """Apply ``change`` to the parsed JSON of ``path``."""
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def set_value(document, keys, value):
    """Set a value, or remove it if None; keys: such as ``frames 1 file_path``."""
    *parents, last = (int(key) if key.isdigit() else key for key in keys.split())
    for key in parents:
        document = document[key]
    if value is None:
        del document[last]
    else:
        document[last] = value


def put(path, keys, value):
    """Set a value in a JSON file, or remove it if None."""
    edit(path, lambda meta: set_value(meta, keys, value))


def load(folder, **options):
    return load_dataset(DataConfig(path=folder, **options))


def views_by_name(dataset):
    return {view.name: view for view in (*dataset.train, *dataset.test)}


def load_noting(folder, **options):
    """The dataset, and the notes that loading it gave."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dataset = load(folder, **options)
    assert all(issubclass(warning.category, UserNote) for warning in caught)
    notes = [str(warning.message) for warning in caught]
    assert not any("\n" in note for note in notes) and len(set(notes)) == len(notes)
    return dataset, notes


def refusal(folder, **options):
    with pytest.raises(UserError) as error:
        load(folder, **options)
    return str(error.value)
