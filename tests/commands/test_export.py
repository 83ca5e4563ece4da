"""``drgs.export``: fits and files for other programs, and pages of them."""

import base64
import gzip
import json
import os
import sys
import zipfile
from dataclasses import replace
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.commands import assert_ends_well, assert_refused
from support.folders import contents, to_earlier_layout
from support.formats import (
    FLOAT32,
    PRECISION,
    assert_within,
    each_of,
    gaussians_within_ranges,
    matched,
    turned,
)
from support.html_page import HtmlPage
from support.small_capture import blobs, make_dataset

from drgs.export import __main__ as export
from drgs.export import decimation
from drgs.export import mesh as surface
from drgs.gaussians.parameters import Gaussians
from drgs.io.formats import read_gaussians, writable_formats
from drgs.io.ply import read_points
from drgs.render import __main__ as render
from drgs.results.refined_cameras import write_views

FITTED_WITH = {"antialiased": True, "low_pass": 0.1}
VIEWER_RENDERING = {"antialiased": False, "low_pass": 0.3}


def run(*arguments):
    return assert_ends_well(export.main, *arguments)


@pytest.fixture
def model(tmp_path):
    gaussians = gaussians_within_ranges(300, degree=1)
    gaussians.save(tmp_path / "model.ply")
    return tmp_path / "model.ply"


@pytest.fixture
def fit(tmp_path):
    """A folder as a fit leaves it, whose cameras are held with z up."""
    folder = tmp_path / "run"
    folder.mkdir()
    configure(folder, FITTED_WITH)
    replace(blobs(20), rendered_with=FITTED_WITH).save(folder / "point_cloud_drgs.ply")
    viewers = replace(blobs(30), rendered_with=VIEWER_RENDERING)
    viewers.save(folder / "point_cloud.ply")
    write_views(folder / "views.json", make_dataset(6, 1))
    return folder


def configure(folder, model, **sections):
    data = {"path": "photographs", "background": [0.25, 0.5, 0.75]}
    (folder / "config.yml").write_text(yaml.safe_dump({"data": data, "model": model, **sections}))


@pytest.mark.parametrize("each", each_of(writable_formats()))
def test_each_format_is_written_beside_its_source(model, each):
    out = model.with_name(f"model{each.value.suffix}")
    options = []
    if each.name == "ply":
        out = model.with_name("out.ply")
        options = ["--out", out]
    outcome = run(model, "--format", each.name, *options)
    assert f"written: {out} (" in outcome.stdout
    expected = Gaussians.load(model)
    assert_within(PRECISION[each.name], expected, matched(expected, Gaussians.load(out)))
    assert read_gaussians(out)[0].name == each.name


@pytest.mark.parametrize("is_earlier", [False, True])
def test_export_uses_the_file_for_viewers_or_notes_what_they_miss(fit, is_earlier):
    own, for_viewers = "point_cloud_drgs.ply", "point_cloud.ply"
    if is_earlier:
        to_earlier_layout(fit)
        own, for_viewers = "point_cloud.ply", "point_cloud_viewers.ply"
    outcome = run(fit, "--format", "glb")
    assert outcome.stdout.splitlines() == [
        f"{fit}/{for_viewers}: 30 Gaussians",
        "up: 0 0 1 (the training cameras')",
        f"written: {fit}.glb (0.0 MB)",
    ]
    found = Gaussians.load(fit.with_name("run.glb"))
    assert found.rendered_with is None and found.num_gaussians == 30

    outcome = run(fit / own, "--out", fit.with_name("a.glb"))
    assert f"export {fit}/{for_viewers} instead" in outcome.stdout
    assert Gaussians.load(fit.with_name("a.glb")).rendered_with == FITTED_WITH

    (fit / for_viewers).unlink()
    outcome = run(fit, "--format", "spz")
    note = "made to be rendered with low_pass 0.1, antialiased true; programs that do not will show"
    assert f"note: {fit}/{own}: {note}" in outcome.stdout
    assert "no room for low_pass 0.1" in outcome.stdout
    assert Gaussians.load(fit.with_name("run.spz")).rendered_with == {"antialiased": True}


@pytest.mark.parametrize(("low_pass", "is_nearer"), [(0.1, True), (0.18, True), (0.2, False)])
def test_playcanvas_export_uses_the_file_with_the_nearer_low_pass(fit, low_pass, is_nearer):
    """Its viewers add 0.075 square pixels, and 0.1875 is in the middle to 0.3."""
    fitted = {"antialiased": True, "low_pass": low_pass}
    replace(blobs(20), rendered_with=fitted).save(fit / "point_cloud_drgs.ply")
    configure(fit, fitted)
    outcome = run(fit, "--format", "compressed-ply")
    name = "point_cloud_drgs.ply: 20" if is_nearer else "point_cloud.ply: 30"
    assert outcome.stdout.splitlines()[0] == f"{fit}/{name} Gaussians"
    found = Gaussians.load(fit.with_name("run.compressed.ply")).rendered_with
    assert found == (fitted if is_nearer else None)
    outcome = run(fit / "point_cloud_drgs.ply", "--format", "compressed-ply")
    assert ("made to be rendered with" in outcome.stdout) == (not is_nearer)


@pytest.mark.parametrize("suffix", [".compressed.ply", ".spz", ".glb", ".sog"])
def test_exported_file_is_rendered_and_loaded_by_the_plugin(tmp_path, suffix):
    path, images = tmp_path / f"model{suffix}", []
    blobs().save(path)
    expected = Gaussians.load(path)
    expected.save(tmp_path / "again.ply")
    for file in (path, tmp_path / "again.ply"):
        words = [file, "--origin", 0, -4, 1, "--size", 24, 16, "--out", tmp_path / "out"]
        assert_ends_well(render.main, *words)
        images.append((tmp_path / "out" / "camera.png").read_bytes())
    assert images[0] == images[1]
    plugin = mi.load_dict({"type": "splats", "filename": str(path)})
    np.testing.assert_array_equal(np.array(plugin.gaussians.shN), expected.shN)


def test_smoothing_is_baked_in(tmp_path):
    gaussians = gaussians_within_ranges(5)
    replace(gaussians, smoothing=np.full(5, 0.1, np.float32)).save(tmp_path / "model.ply")
    run(tmp_path / "model.ply", "--format", "glb")
    found = Gaussians.load(tmp_path / "model.glb")
    # Mip-Splatting, section 4.1: covariances add up, and the integral stays.
    scales = np.sqrt(np.square(gaussians.scales.astype(np.float64)) + 0.1**2)
    np.testing.assert_allclose(found.scales, scales, rtol=1e-5)
    kept = (gaussians.scales.astype(np.float64) / scales).prod(axis=1)
    np.testing.assert_allclose(found.opacities, gaussians.opacities * kept, rtol=1e-5)


@pytest.mark.slow
def test_usd_is_written_if_openusd_is_installed(model):
    pxr = pytest.importorskip("pxr.UsdVol")
    from pxr import Usd, UsdGeom

    run(model, "--format", "usd", "--up", 0, -1, 0)
    stage = Usd.Stage.Open(str(model.with_name("model.usdc")))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    splats = pxr.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    expected = turned(Gaussians.load(model), [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    quats = [[q.GetReal(), *q.GetImaginary()] for q in splats.GetOrientationsAttr().Get()]
    harmonics = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    harmonics = harmonics.reshape(300, 4, 3)
    opacities = np.array(splats.GetOpacitiesAttr().Get(), np.float64)
    found = Gaussians(
        means=np.array(splats.GetPositionsAttr().Get()),
        quats=np.array(quats),
        log_scales=np.log(np.array(splats.GetScalesAttr().Get())),
        logit_opacities=np.log(opacities / (1 - opacities)),
        sh0=harmonics[:, :1],
        shN=harmonics[:, 1:],
    )
    precision = replace(PRECISION["glb"], means=4 * FLOAT32, harmonics=8 * FLOAT32)
    assert_within(precision, expected, found)
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    run(model, "--up", 0, -1, 0, "--out", model.with_name("again.usdc"))
    assert model.with_name("again.usdc").read_bytes() == model.with_name("model.usdc").read_bytes()


def test_missing_openusd_is_reported_with_what_to_install(model, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    message = "USD: needs pxr, which is not installed; pip install 'drgs[usd]'"
    assert_refused(export.main, model, "--format", "usd", folder=model.parent, message=message)


def test_options_select_the_exported_gaussians(model):
    """Any two opposite corners span a box."""
    out = model.with_name("out.ply")
    limits = ["--crop", 1, -1, 2, -1, 1, -1, "--min-opacity", 0.2, "--max-size", 0.3]
    outcome = run(model, "--out", out, *limits)
    g = Gaussians.load(model)
    inside = ((g.means >= -1) & (g.means <= [1, 1, 2])).all(axis=1)
    kept = inside & (g.opacities >= 0.2) & (g.scales.max(axis=1) <= 0.3)
    assert 0 < kept.sum() < 300
    assert f"kept: {inside.sum()}; left out by box {(~inside).sum()}" in outcome.stdout
    assert f"kept: {kept.sum()}; left out by size le 0.3 " in outcome.stdout
    assert Gaussians.load(out).means.tolist() == g.means[kept].tolist()


def test_floaters_and_clusters_are_removed_in_world_coordinates(tmp_path):
    """A ball, a smaller one and something faint."""
    far, rng = (1000.0, 0.0, 0.0), np.random.default_rng(0)
    means = rng.uniform(-0.15, 0.15, (291, 3)) + 0.2
    means[200:290, 0] += 5
    means[290, 1] += 3
    opacities = np.append(np.full(290, 0.5), 0.05)
    scales, quats = np.full((291, 3), 0.005), np.tile([1.0, 0, 0, 0], (291, 1))
    g = Gaussians.from_numpy(means, quats, scales, opacities, np.zeros((291, 1, 3)))
    replace(g, origin=far).save(tmp_path / "model.ply")
    out = tmp_path / "out.ply"
    for options, kept, said, left_out in (
        (["--filter-floaters"], 290, "floaters (voxels of 0.0", 1),
        (
            ["--filter-floaters", "0.2", "--filter-cluster", "0.4,0.5"],
            200,
            "cluster (voxels of 0.4)",
            90,
        ),
        (
            ["--filter-cluster", "0.4,0.5", "--seed-pos", 1005, 0, 0],
            90,
            "cluster (voxels of 0.4)",
            201,
        ),
    ):
        outcome = run(tmp_path / "model.ply", "--out", out, *options)
        assert f"kept: {kept}; left out by {said}" in outcome.stdout
        assert f") {left_out}\n" in outcome.stdout
        assert Gaussians.load(out).num_gaussians == kept


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "number", "left", "views"),
    [
        (".", "50%", 15, "6 views of the fit"),
        ("point_cloud_drgs.ply", 7, 7, "64 views around the m"),
    ],
)
def test_decimated_file_has_that_many_gaussians_and_the_same_bytes_again(
    fit, monkeypatch, what, number, left, views
):
    monkeypatch.setattr(decimation, "ITERATIONS", 3)
    contents = []
    for name in ("a.ply", "b.ply"):
        outcome = run(fit / what, "--decimate", number, "--out", fit.with_name(name))
        assert f" to {left}, by {views}" in outcome.stdout
        contents.append(fit.with_name(name).read_bytes())
    assert contents[0] == contents[1]
    assert Gaussians.load(fit.with_name("a.ply")).num_gaussians == left


def test_unpacked_sog_is_the_archive(model):
    packed, unpacked = model.with_name("a.sog"), model.with_name("web") / "meta.json"
    run(model, "--out", packed)
    run(model, "--out", unpacked)
    with zipfile.ZipFile(packed) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    assert {n: (unpacked.parent / n).read_bytes() for n in files} == files
    found = [path.name for path in unpacked.parent.iterdir() if path.name[0] != "."]
    assert sorted(found) == sorted(files)
    run(unpacked, "--format", "spz")
    assert Gaussians.load(model.with_name("web.spz")).num_gaussians == 300


def test_folders_of_levels_that_are_foreign_are_kept(model):
    (model.parent / "model_levels").mkdir()
    (model.parent / "model_levels" / "1_0").write_bytes(b"mine")
    message = "holds 1_0/meta.json, which this command would replace and has not written"
    assert_refused(export.main, model, "--levels", 2, folder=model.parent, message=message)
    for name in ("0_0", "1_0"):
        source = model.parent / "mine" / name / "meta.json"
        run(model, "--out", source)
    message = "holds 0_0/meta.json, 1_0/meta.json, which"
    out = model.parent / "mine" / "lod-meta.json"
    words = (model, "--levels", 2, "--out", out)
    assert_refused(export.main, *words, folder=model.parent, message=message)


@pytest.mark.slow
def test_levels_of_detail_have_half_as_many_gaussians_each(fit, monkeypatch):
    monkeypatch.setattr(decimation, "ITERATIONS", 3)
    run(fit, "--levels", 3)
    folder = fit.with_name("run_levels")
    meta = json.loads((folder / "lod-meta.json").read_text())
    assert meta["counts"] == [20, 10, 5] and meta["filenames"][2] == "2_0/meta.json"
    assert Gaussians.load(folder / "2_0" / "meta.json").num_gaussians == 5
    before = contents(folder)
    run(fit, "--levels", 3)
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("suffix", "up"), [(".glb", [0, 1, 0]), (".spz", [0, 1, 0]), (".compressed.ply", [0, -1, 0])]
)
def test_up_direction_is_kept_in_the_file(model, suffix, up):
    """One format records its up axis; in the others y points down, as in COLMAP's worlds."""
    out = model.with_name(f"out{suffix}")
    direction = np.array([0.0, 3, 4]) / 5
    run(model, "--out", out, "--up", *(1e100 * direction))  # of any length
    heights = np.sort(Gaussians.load(model).means @ direction)
    precision = PRECISION["compressed-ply"].means * 2 if "ply" in suffix else 1e-3
    np.testing.assert_allclose(
        np.sort(read_gaussians(out)[1]["means"] @ np.array(up)), heights, atol=precision
    )


def test_files_are_not_rotated_by_default_nor_where_axes_are_as_expected(model):
    out, expected = model.with_name("out.ply"), Gaussians.load(model)
    run(model, "--out", out, "--up", 0, -1, 0)
    assert_within(replace(PRECISION["glb"], means=4 * FLOAT32), expected, Gaussians.load(out))
    assert "up:" not in run(model, "--out", out).stdout
    np.testing.assert_array_equal(Gaussians.load(out).means, expected.means)


@pytest.mark.parametrize("optimise", [True, False])
def test_up_direction_uses_refined_cameras(fit, optimise):
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    dataset = make_dataset(6, 1)
    views = [replace(v, camera_to_world=turn @ v.camera_to_world) for v in dataset.train]
    write_views(fit / "refined_cameras.json", replace(dataset, train=views))
    configure(fit, FITTED_WITH, cameras={"optimise": optimise})
    outcome = run(fit, "--format", "glb", "--up", "cameras")
    up = "0 -1 0" if optimise else "0 0 1"
    assert f"up: {up} (the training cameras')" in outcome.stdout


TO_SPZ = ("model.ply", "--format", "spz")
REFUSED = [
    (
        ("model.ply",),
        "one of compressed-ply, glb, ply, sog, splat, spz, usd, html, mesh, lod, got none",
    ),
    (("model.ply", "--format", "splt"), "got splt; did you mean splat?"),
    (("model.ply", "--out", "a.obj"), "--format: must be one of"),
    ((*TO_SPZ, "--out", "a.glb"), "name of a spz file must end in .spz"),
    (("model.ply", "--format", "ply", "--out", "a.compressed.ply"), "that of a compressed-ply"),
    (("model.ply", "--format", "ply"), "would replace model.ply, an input; change the name"),
    (("none.ply", "--format", "spz"), "none.ply: there is no such file or folder"),
    ((".", "--format", "spz"), "must be the output folder of a fit that has ended"),
    ((*TO_SPZ, "--up", "cameras"), "--up cameras: needs the output"),
    ((*TO_SPZ, "--up", 0, 0, 0), "--up: must be cameras, or thr"),
    ((*TO_SPZ, "--min-opacity", 2), "nothing is left of 300 Gaussians by opacity ge 2; crop and"),
    ((*TO_SPZ, "--max-size", 1e-9), "nothing is left of 300 Gaussians by size le 1e-09"),
    ((*TO_SPZ, "--filter-floaters", 0), "SIZE must be above 0, OPACITY above 0 and below 1, MI"),
    ((*TO_SPZ, "--filter-floaters", "0.1,0.5,-1"), "MIN at least 0, got 0.1,0.5,-1"),
    ((*TO_SPZ, "--filter-cluster", "1,0.5,0,4"), "must be at most SIZE,OPACITY,MIN, got 1,0.5,0,4"),
    ((*TO_SPZ, "--filter-cluster", 1e-7), "--filter-cluster: voxels of 1e-07 are too small: the"),
    (("--filter-cluster", *TO_SPZ), "must be a finite number, got model.ply"),
    ((*TO_SPZ, "--filter-cluster", "0.1,0.9999999"), "(voxels of 0.1); crop and filter less"),
    ((*TO_SPZ, "--seed-pos", 0, 0, 0), "--seed-pos: needs --filter-cluster"),
    ((*TO_SPZ, "--filter-cluster", "--seed-pos", 1, 2), "expected 3 arguments: --seed-pos X Y Z"),
    ((*TO_SPZ, "--decimate", 0), "--decimate: must be a whole number >= 1, got 0"),
    ((*TO_SPZ, "--decimate", "0%"), "must be above 0% and at most 100%, got 0%"),
    (("model.ply", "--levels", 1), "--levels: must be a whole number >= 2, got 1"),
    ((*TO_SPZ, "--levels", 2), "--levels: needs --format lod; add that, or leave --levels out"),
    (("model.ply", "--levels", 2, "--out", "a.sog"), "lod-meta.json, got that of a sog file"),
    ((*TO_SPZ, "--json"), "--json: needs --info; add that, or leave --json out"),
    ((*TO_SPZ, "--scale", 1e39), "of Gaussian 0 is"),
    (
        (*TO_SPZ, "--filter-value", "opacty,gt,1"),
        "comparison of lt, le, gt, ge, eq, ne, got opacty",
    ),
    ((*TO_SPZ, "--out", "web/meta.json"), "must end in .spz, got that of a sog file"),
]


@pytest.mark.parametrize(("words", "message"), REFUSED)
def test_invalid_exports_are_refused(model, monkeypatch, words, message):
    monkeypatch.chdir(model.parent)
    assert_refused(export.main, *words, folder=model.parent, message=message)


def test_foreign_file_is_kept_and_own_file_is_replaced(model):
    out = model.with_name("model.spz")
    out.write_bytes(b"mine")
    message = "holds model.spz, which this command would replace and has not written"
    assert_refused(export.main, model, "--format", "spz", folder=model.parent, message=message)
    out.unlink()
    run(model, "--format", "spz")
    first = out.read_bytes()
    run(model, "--format", "spz", "--min-opacity", 0.5)
    assert out.read_bytes() != first


def exported(what, out, *options):
    """Return the command's output, the page, its scene and its Gaussians."""
    outcome = run(what, "--out", out, *options)
    page = HtmlPage(out.read_text())
    model = out.with_suffix(".ply")
    model.write_bytes(gzip.decompress(base64.b64decode(page.texts["splats"])))
    return outcome.stdout, page, json.loads(page.texts["scene"]), Gaussians.load(model)


@pytest.mark.parametrize("order", ["center", "pixel"])
def test_page_of_a_fit_shows_its_own_gaussians_if_the_page_supports_them(fit, tmp_path, order):
    configure(fit, {**FITTED_WITH, "order": order})
    said, page, scene, gaussians = exported(fit, tmp_path / "a.html")
    name, count, low_pass = ("point_cloud_drgs.ply", 20, 0.1)
    if order == "pixel":
        name, count, low_pass = ("point_cloud.ply", 30, 0.3)
    assert said.splitlines()[0] == f"{fit}/{name}: {count} Gaussians"
    assert "note" not in said and gaussians.num_gaussians == count
    assert scene["lowPass"] == pytest.approx(low_pass)
    assert scene["antialiased"] == (order == "center")
    assert scene["settings"]["background"]["color"] == [0.25, 0.5, 0.75]
    assert page.texts["title"].strip() == "run: Gaussian splats"


@pytest.mark.parametrize("name", ["point_cloud_drgs.ply", "."])
def test_file_is_shown_as_a_whole_with_z_up(fit, tmp_path, name):
    options = ("--up", 0, 0, 1) if name == "." else ()
    _, _, scene, gaussians = exported(fit / name, tmp_path / "a.html", *options)
    heights, expected = np.sort(-gaussians.means[:, 1]), np.sort(blobs(20).means[:, 2])
    assert np.corrcoef(heights, expected)[0, 1] > 0.9999  # rounded to 10 bits
    black = scene["settings"]["background"]["color"] == [0, 0, 0]
    assert black == (name != ".")


def mesh_points(path):
    if path.suffix == ".ply":
        return read_points(path)[0]
    scene = pytest.importorskip("trimesh").load(path, process=False)
    x, y, z = np.asarray(scene.to_mesh().vertices).T
    return np.stack([x, -z, y], axis=1)


@pytest.mark.slow
def test_mesh_is_where_the_gaussians_are(fit, tmp_path, monkeypatch):
    """The fit's cameras are turned with the model; a file gets cameras of its own."""
    pytest.importorskip("skimage", reason="the extra mesh is not installed")
    monkeypatch.setattr(surface, "VIEWS_PER_RING", 6)
    monkeypatch.setattr(surface, "RING_SIDE_PX", 60)
    g, found = blobs(20), {}
    cases = {
        "a.ply": (fit, 6),
        "a.glb": (fit, 6, "--up", 0, 0, 1),
        "b.ply": (fit, 6, "--up", 0, 1, 0),
        "c.ply": (fit / "point_cloud_drgs.ply", 24),
    }
    for name, (what, num_views, *options) in cases.items():
        out = tmp_path / name
        outcome = run(what, "--format", "mesh", "--mesh-size", 40, "--out", out, *options)
        assert f"{num_views} views: " in outcome.stdout and "note: " not in outcome.stdout
        found[name] = mesh_points(out)
    found["b.ply"] = found["b.ply"] @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    for name, points in found.items():
        offsets = points[:, None] - g.means
        rotations = Rotation.from_quat(g.quats, scalar_first=True).as_matrix()
        local = np.einsum("pni,nij->pnj", offsets, rotations) / g.scales
        sigmas = np.linalg.norm(local, axis=2).min(axis=1)  # of the nearest, by Mahalanobis
        share = (sigmas < 3).mean()
        assert len(points) > 1000 and share > 0.9, (name, share)
    np.testing.assert_array_equal(found["a.ply"].shape, found["a.glb"].shape)
    np.testing.assert_allclose(found["a.ply"], found["a.glb"], atol=1e-5)


@pytest.mark.parametrize("kind", ["meta.json", "lod-meta.json"])
def test_a_stop_at_any_file_leaves_one_model_or_none(tmp_path, monkeypatch, kind):
    """An earlier export is there until all of the new one is on the disk."""
    monkeypatch.setattr(export, "reduce_to", lambda source, count, variant: source)
    for seed, name in enumerate("ab"):
        gaussians_within_ranges(60, degree=0, seed=seed).save(tmp_path / f"{name}.ply")
    out, levels = tmp_path / "web" / kind, ["--levels", "2"] if kind.startswith("lod") else []
    index = out.parent / ("0_0/meta.json" if levels else kind)
    means = {}
    for name in "ab":
        run(tmp_path / f"{name}.ply", "--out", out, *levels)
        means[name] = Gaussians.load(index).means.tobytes()
    seen, found, names = 0, set(), ("replace", "unlink", "open")
    real = {name: getattr(os, name) for name in names}
    for stop in range(100):
        run(tmp_path / "b.ply", "--out", out, *levels)
        left = iter(range(stop))

        def stopped(*args, name, left=left, **options):
            if str(tmp_path / "web") in str(args[0]) and next(left, None) is None:
                raise KeyboardInterrupt
            return real[name](*args, **options)

        with monkeypatch.context() as patched:
            for name in names:
                patched.setattr(os, name, partial(stopped, name=name))
            try:
                export.main([*map(str, (tmp_path / "a.ply", "--out", out, *levels))])
            except (KeyboardInterrupt, SystemExit):
                seen += 1
            else:
                break
        if index.exists():
            found.add(Gaussians.load(index).means.tobytes())
    assert seen > 10 and found <= set(means.values()) and means["b"] in found
