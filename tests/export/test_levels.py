"""Levels of detail: each Gaussian is in one leaf of its level, where lod-meta.json says."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.formats import gaussians_within_ranges

from drgs.export import levels
from drgs.export.levels import LOD_META, encode_levels
from drgs.gaussians.parameters import Gaussians


def leaves_of(node):
    if "children" not in node:
        return [node]
    leaves = [leaf for child in node["children"] for leaf in leaves_of(child)]
    corners = [np.array([leaf["bound"][end] for leaf in leaves]) for end in ("min", "max")]
    np.testing.assert_array_equal(node["bound"]["min"], corners[0].min(axis=0))
    np.testing.assert_array_equal(node["bound"]["max"], corners[1].max(axis=0))
    return leaves


def half_sides(g):
    rotations = Rotation.from_quat(g.quats[:, [1, 2, 3, 0]].astype(float)).as_matrix()
    return np.abs(rotations * g.scales.astype(float)[:, None]).sum(axis=2)


def written(tmp_path, files):
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    meta = json.loads((tmp_path / LOD_META).read_text())
    return meta, [Gaussians.load(tmp_path / name) for name in meta["filenames"]]


@pytest.mark.parametrize("file_size", [1000, 40])
def test_leaves_name_all_gaussians_once_with_their_boxes(monkeypatch, tmp_path, file_size):
    monkeypatch.setattr(levels, "LEAF_SIZE", 30)
    monkeypatch.setattr(levels, "FILE_SIZE", file_size)
    g = gaussians_within_ranges(300)
    means = np.random.default_rng(1).normal(size=(300, 3)) * [5, 1, 1]
    g = Gaussians(**{**vars(g), "means": means.astype(np.float32)})
    parts = [g, g[::2], g[:7]]
    files = encode_levels(parts)
    assert list(files)[-1] == LOD_META and files == encode_levels(parts)
    meta, read = written(tmp_path, files)
    assert meta["lodLevels"] == 3 and meta["counts"] == [300, 150, 7] and meta["count"] == 457
    assert (len(read) == 3) == (file_size == 1000)
    used = [np.zeros(part.num_gaussians, int) for part in read]
    for leaf in leaves_of(meta["tree"]):
        assert sum(lod["count"] for lod in leaf["lods"].values()) <= 30
        low, high = np.array(leaf["bound"]["min"]), np.array(leaf["bound"]["max"])
        for level, lod in leaf["lods"].items():
            assert meta["filenames"][lod["file"]].startswith(f"{level}_")
            rows = np.arange(lod["offset"], lod["offset"] + lod["count"])
            used[lod["file"]][rows] += 1
            own = read[lod["file"]][rows]
            distance = np.linalg.norm(own.means[:, None] - parts[int(level)].means, axis=2)
            source = parts[int(level)][distance.argmin(axis=1)]
            assert distance.min(axis=1).max() < 1e-3  # 16 bits of log(1 + |x|), |x| < 20
            sides = half_sides(source)
            # Means and scales are float32.
            assert (source.means - sides >= low - 1e-5).all()
            assert (source.means + sides <= high + 1e-5).all()
    assert all((each == 1).all() for each in used)


def test_gaussians_at_one_place_are_one_leaf(monkeypatch):
    monkeypatch.setattr(levels, "LEAF_SIZE", 10)
    g = gaussians_within_ranges(20)
    g = Gaussians(**{**vars(g), "means": 0 * g.means})
    tree = json.loads(encode_levels([g, g[[1]]])[LOD_META])["tree"]
    assert tree["lods"] == {
        "0": {"file": 0, "offset": 0, "count": 20},
        "1": {"file": 1, "offset": 0, "count": 1},
    }


def test_leaves_are_small_if_many_means_share_a_coordinate(monkeypatch):
    monkeypatch.setattr(levels, "LEAF_SIZE", 10)
    g = gaussians_within_ranges(20)
    means = np.where(np.arange(20)[:, None] < 12, 0, [[1.0, 0, 0]]) * np.arange(20)[:, None]
    g = Gaussians(**{**vars(g), "means": means.astype(np.float32)})
    leaves = leaves_of(json.loads(encode_levels([g])[LOD_META])["tree"])
    assert [leaf["lods"]["0"]["count"] for leaf in leaves] == [12, 8]
