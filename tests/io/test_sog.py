"""SOG: what stands in its images, a folder's meta.json, the palette, and what is refused."""

import io
import json
import shutil
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.formats import FLOAT32, PRECISION, assert_within, gaussians_within_ranges, refusal

from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.io import sog


def unpacked(gaussians):
    with zipfile.ZipFile(io.BytesIO(gaussians.to_bytes("sog"))) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def pixels(content):
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGBA")).reshape(-1, 4).astype(int)


def packed(path, files):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def test_images_hold_the_gaussians_as_specified(tmp_path):
    """Decoded by the formulas of PlayCanvas's manual, in float64, one Gaussian after the other."""
    gaussians = gaussians_within_ranges(90, degree=2)
    gaussians.logit_opacities[0] = -20  # alpha is 0
    files = unpacked(gaussians)
    meta = json.loads(files["meta.json"])
    assert (meta["version"], meta["count"], meta["shN"]["bands"]) == (2, 90, 2)
    image = {name: pixels(content) for name, content in files.items() if name != "meta.json"}
    found = []
    for i in range(90):
        part = meta["means"]
        value = (image["means_l.webp"][i] + 256 * image["means_u.webp"][i])[:3] / 65535
        n = part["mins"] + value * np.subtract(part["maxs"], part["mins"])
        a, b, c, tag = image["quats.webp"][i]
        small = [(v / 255 - 0.5) * 2 / np.sqrt(2) for v in (a, b, c)]
        quat = np.insert(small, tag - 252, np.sqrt(1 - np.sum(np.square(small))))
        label = image["shN_labels.webp"][i][0] + 256 * image["shN_labels.webp"][i][1]
        width = 64 * 8
        first = label // 64 * width + label % 64 * 8
        entry = image["shN_centroids.webp"][first : first + 8, :3]
        found.append(
            {
                "means": np.sign(n) * (np.exp(np.abs(n)) - 1),
                "quats": quat,
                "log_scales": [meta["scales"]["codebook"][v] for v in image["scales.webp"][i][:3]],
                "opacities": image["sh0.webp"][i][3] / 255,
                "sh0": [[meta["sh0"]["codebook"][v] for v in image["sh0.webp"][i][:3]]],
                "shN": [[meta["shN"]["codebook"][v] for v in rgb] for rgb in entry],
            }
        )
    (tmp_path / "a.sog").write_bytes(gaussians.to_bytes("sog"))
    read = Gaussians.load(tmp_path / "a.sog")
    expected = {name: np.array([each[name] for each in found]) for name in found[0]}
    assert 0 in expected["opacities"]
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(read, name), values, rtol=0, atol=8 * FLOAT32)


@pytest.mark.parametrize("values", [{"antialiased": True}, None])
def test_an_unpacked_archive_is_read_by_its_meta_json(tmp_path, values):
    gaussians = replace(gaussians_within_ranges(70, degree=1), rendered_with=values)
    gaussians.save(tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "folder")
    first, second = (Gaussians.load(tmp_path / p) for p in ("a.sog", "folder/meta.json"))
    assert first.rendered_with == second.rendered_with == values
    np.testing.assert_array_equal(first.shN, second.shN)
    (tmp_path / "folder" / "sh0.webp").unlink()
    with pytest.raises(UserError, match=r"folder/sh0.webp: cannot read the file: No such file"):
        Gaussians.load(tmp_path / "folder" / "meta.json")
    shutil.copy(tmp_path / "a.sog", tmp_path / "meta.json")
    assert refusal(tmp_path / "meta.json").startswith("meta.json: not valid JSON: ")


def test_a_codebook_is_nearly_the_best():
    """Below the error of equal steps, and above the optimum of Panter and Dite (1951): the
    integral of the density's cube root, cubed, over 12 n^2, which is sqrt(3) pi / 2 of a normal."""
    values = np.random.default_rng(0).normal(size=(40_000, 3)).astype(np.float32)
    codes, index = sog._codebook(values)
    assert (np.diff(codes) >= 0).all() and codes.shape == (256,)
    nearest = np.abs(values[:500, :, None] - codes).argmin(axis=2)
    np.testing.assert_array_equal(codes[nearest], codes[index[:500]])
    error = np.square(codes[index] - values).mean()
    optimum = np.sqrt(3) * np.pi / 2 / 256**2
    assert 0.9 * optimum < error < 1.3 * optimum < (np.ptp(values) / 255) ** 2 / 12


def test_a_palette_stands_for_more_gaussians_than_it_has_entries(monkeypatch):
    monkeypatch.setattr(sog, "CELLS", 10)
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(250, 9)).astype(np.float32)
    rows = np.repeat(centres, 8, axis=0) + rng.normal(0, 0.01, (2000, 9)).astype(np.float32)
    palette, labels = sog._palette(rows, 300)
    assert len(palette) <= 300 and labels.min() == 0 and labels.max() < len(palette)
    error = np.square(palette[labels] - rows).sum(axis=1)
    assert np.median(error) < 9 * 0.01**2 * 2
    assert error.mean() < 0.2 * np.square(rows - rows.mean(axis=0)).sum(axis=1).mean()


def test_rounded_values_are_near_and_are_kept_by_the_file(tmp_path, monkeypatch):
    """Nearer than steps of the codes; quaternions with their own signs and lengths."""
    monkeypatch.setattr(sog, "MAX_PALETTE", 30)
    monkeypatch.setattr(sog, "CELLS", 4)
    monkeypatch.setattr(sog, "FITTED_SHARE", 0.5)
    g = gaussians_within_ranges(100)
    values = {n: getattr(g, n) for n in PARAMETER_NAMES}
    values["quats"] = values["quats"] * np.linspace(-3, 2, 100)[:, None].astype(np.float32)
    rounded = sog.Sog().rounding(values)(values)
    lengths = np.linalg.norm(values["quats"], axis=1, keepdims=True)
    # Half a step of 1/sqrt(2)/127.5 in three components, and what they leave for the largest.
    assert (np.abs(rounded["quats"] - values["quats"]) <= 0.012 * lengths).all()
    # Steps of 1/65535 of the range of logarithms, which are as much wider at the greatest values.
    assert np.abs(rounded["means"] - values["means"]).max() < np.ptp(values["means"]) * 1e-4
    rows = np.unique(rounded["shN"].reshape(100, -1), axis=0)
    assert len(rows) <= 30
    Gaussians(**{n: v.astype(np.float32) for n, v in rounded.items()}).save(tmp_path / "a.sog")
    monkeypatch.undo()  # readers have the true limits
    read = np.unique(Gaussians.load(tmp_path / "a.sog").shN.reshape(100, -1), axis=0)
    np.testing.assert_array_equal(read, rows.astype(np.float32))


def test_gaussians_that_are_all_alike_are_kept(tmp_path):
    one = gaussians_within_ranges(1)
    same = {n: np.repeat(getattr(one, n), 5, axis=0) for n in PARAMETER_NAMES}
    Gaussians(**same).save(tmp_path / "a.sog")
    assert_within(PRECISION["sog"], Gaussians(**same), Gaussians.load(tmp_path / "a.sog"))


def with_meta(change):
    def make(files):
        meta = json.loads(files["meta.json"])
        change(meta)
        return {**files, "meta.json": json.dumps(meta)}

    return make


def image_of(width, height):
    stream = io.BytesIO()
    Image.new("RGB", (width, height), (255, 255, 255)).save(stream, "WEBP", lossless=True)
    return stream.getvalue()


REFUSED = {
    "version": (with_meta(lambda m: m.pop("version")), "meta.json: version is missing"),
    "later version": (
        with_meta(lambda m: m.update(version=3)),
        "meta.json: version must be one of 2, got 3",
    ),
    "no Gaussians": (
        with_meta(lambda m: m.update(count=0)),
        "meta.json: count must be >= 1, got 0",
    ),
    "too many": (
        with_meta(lambda m: m.update(count=65)),
        "cannot read means_l.webp: 65 to 65,666 pixels were expected, got 8 x 8",
    ),
    "infinite": (
        with_meta(lambda m: m["sh0"]["codebook"].__setitem__(3, 1e999)),
        "meta.json: sh0.codebook[3] must be a finite number, got Infinity",
    ),
    "short codebook": (
        with_meta(lambda m: m["scales"]["codebook"].pop()),
        "meta.json: scales.codebook must have at least 256 items",
    ),
    "far": (
        with_meta(lambda m: m["means"].update(maxs=[0, 0, 100.0])),
        "meta.json: means.maxs[2] must be <= 80",
    ),
    "another folder": (
        with_meta(lambda m: m["quats"].update(files=["../quats.webp"])),
        "meta.json: quats.files[0] must match pattern",
    ),
    "missing image": (
        lambda files: {n: c for n, c in files.items() if n != "sh0.webp"},
        "cannot read sh0.webp: \"There is no item named 'sh0.webp' in the archive",
    ),
    "no image": (
        lambda files: {**files, "scales.webp": b"hello"},
        "cannot read scales.webp: cannot identify image file",
    ),
    "large image": (
        lambda files: {**files, "quats.webp": image_of(900, 900)},
        "cannot read quats.webp: 60 to 65,656 pixels were expected, got 900 x 900",
    ),
    "label": (
        lambda files: {**files, "shN_labels.webp": image_of(8, 8)},
        "shN_labels.webp: indices must be below the palette's 60 entries, got 65,535",
    ),
    "narrow palette": (
        lambda files: {**files, "shN_centroids.webp": image_of(64, 3)},
        "cannot read shN_centroids.webp: 180 to 65,896 pixels in rows of 192 were expected, got 64",
    ),
    "no JSON": (lambda files: {**files, "meta.json": "[" * 99999}, "meta.json: not valid JSON"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_wrong_content_is_refused(tmp_path, name):
    change, message = REFUSED[name]
    files = change(unpacked(gaussians_within_ranges(60, degree=1)))
    assert refusal(packed(tmp_path / "a.sog", files)).startswith(message)


def test_another_file_is_refused(tmp_path):
    (tmp_path / "a.sog").write_bytes(b"hello")
    assert refusal(tmp_path / "a.sog").startswith("cannot read meta.json: File is not a zip")


@pytest.mark.parametrize("name", ["means_l.webp", "meta.json"])
def test_archives_that_declare_much_more_than_they_hold_are_not_unpacked(tmp_path, name):
    files = unpacked(gaussians_within_ranges(60, degree=1)) | {name: bytes(1 << 24)}
    with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        for each, content in files.items():
            archive.writestr(each, content)
    expected = f"cannot read {name}: at most 16 times its "
    assert refusal(tmp_path / "a.sog").startswith(expected)


def test_of_levels_of_detail_the_finest_is_read(tmp_path):
    """Files of a level follow one another; a list without any of level 0 is refused."""
    whole = gaussians_within_ranges(60, degree=1)
    names = []
    for number, rows in enumerate((slice(0, 40), slice(40, 60))):
        part = replace(whole, **{n: getattr(whole, n)[rows] for n in PARAMETER_NAMES})
        folder = tmp_path / f"0_{number}"
        folder.mkdir()
        for name, content in sog.unpack(part.to_bytes("sog")).items():
            (folder / name).write_bytes(content)
        names.append(f"0_{number}/meta.json")
    index = tmp_path / "lod-meta.json"
    index.write_text(json.dumps({"filenames": ["1_0/meta.json", *names]}))
    found = Gaussians.load(index)
    expected = [Gaussians.load(tmp_path / name) for name in names]
    assert found.num_gaussians == 60
    for name in PARAMETER_NAMES:
        joined = np.concatenate([getattr(part, name) for part in expected])
        np.testing.assert_array_equal(getattr(found, name), joined)
    for wrong in ({}, [], {"filenames": ["../0_0/meta.json", 7]}, {"filenames": 7}):
        index.write_text(json.dumps(wrong))
        with pytest.raises(UserError, match="filenames must list files as 0_0"):
            Gaussians.load(index)


def test_version_1_is_named(tmp_path):
    content = {"means": {"shape": [8, 3]}, "scales": {"mins": [-6] * 3, "maxs": [0] * 3}}
    (tmp_path / "meta.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="version 2 of SOG is read, got version 1"):
        Gaussians.load(tmp_path / "meta.json")
