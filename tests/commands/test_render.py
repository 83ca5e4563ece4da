"""``python -m drgs.render``, against the float64 reference and PSNR computed plainly."""

import json
import re
from dataclasses import replace
from itertools import combinations

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
import yaml
from conftest import REPOSITORY
from support import lenses, small_capture
from support.commands import assert_ends_well
from support.folders import visible
from support.openexr import read_exr
from support.render_command import EIGHT_BITS, assert_shows, rendered, run, sensor, write_scene
from support.small_capture import (
    FIELD_OF_VIEW,
    FOCUS,
    HEIGHT,
    WIDTH,
    assert_images_agree,
    blobs,
    decibels,
    make_dataset,
    photograph,
    pose_around,
    write_dataset,
    write_fit,
)

from drgs.cameras.orbits import orbit_of_gaussians, orbit_of_views
from drgs.core.errors import UserNote
from drgs.datasets import load_dataset
from drgs.export import __main__ as export
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import splatting as reference
from drgs.results.folder import VIEWS
from drgs.results.refined_cameras import write_views

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
POSE = pose_around(0.8, 0.3)
VIEW = small_capture.view("", POSE, None)


def photo(fit, name, background, split="test"):
    """A photograph of the dataset over a background."""
    rgba = iio.imread(fit.parent / "data" / split / f"{name}.png") / 255
    return rgba[:, :, :3] * rgba[:, :, 3:] + np.array(background) * (1 - rgba[:, :, 3:])


def test_a_fit_is_rendered_from_its_test_views_and_measured(fit, tmp_path, capsys):
    run(fit, "--out", tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    printed = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()}
    scores = []
    for view in make_dataset().test:
        expected = assert_shows(tmp_path / f"{view.name}.png", view, WHITE)
        scores.append(decibels(expected, photo(fit, view.name, WHITE)))
        # float32 against float64.
        assert metrics["views"][view.name]["psnr"] == pytest.approx(scores[-1], abs=1e-3)
        assert float(printed[view.name][0]) == pytest.approx(scores[-1], abs=0.006)
    assert metrics["mean"]["psnr"] == pytest.approx(np.mean(scores), abs=1e-3)
    assert float(printed["mean"][0]) == pytest.approx(np.mean(scores), abs=0.006)
    ssims = [score["ssim"] for score in metrics["views"].values()]
    assert metrics["mean"]["ssim"] == pytest.approx(np.mean(ssims))
    assert (metrics["split"], metrics["num_views"], metrics["num_gaussians"]) == ("test", 4, 30)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("optimised", "name"),
    [(True, "refined_cameras.json"), (False, "refined_cameras.json"), (True, "cameras.json")],
)
def test_refined_cameras_are_used_or_mentioned(tmp_path, capsys, optimised, name):
    """Whether the fit's folder or its PLY file is named, as its configuration says."""
    dataset = make_dataset(2, 1)
    found = write_fit(tmp_path, dataset, cameras={"optimise": optimised})
    path = found / name
    refined = [replace(v, camera_to_world=pose_around(1.4, 0.6)) for v in dataset.train]
    write_views(path, replace(dataset, train=refined))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"lens_change": {}}))
    said = f"cameras: as refined, from {path}\n"
    if not optimised:
        said = f"cameras: as the dataset has them; those of {path} are used with --set cameras.opti"
    for what in ([found], [found / "point_cloud.ply", "--scene", found / "config.yml"]):
        run(*what, "--split", "train", "--out", tmp_path / "out")
        assert said in capsys.readouterr().out
        for view in refined if optimised else dataset.train:
            assert_shows(tmp_path / "out" / f"{view.name}.png", view, WHITE)


def test_background_is_composited_behind_splats_and_photographs(fit, tmp_path):
    background = (0.0, 0.5, 0.25)
    run(fit, "--background", *background, "--out", tmp_path)
    expected = assert_shows(tmp_path / "r_1.png", make_dataset().test[1], background)
    score = decibels(expected, photo(fit, "r_1", background))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["views"]["r_1"]["psnr"] == pytest.approx(score, abs=1e-3)


def test_orbit_is_around_the_focus_of_the_photographs_or_the_gaussians(fit, tmp_path):
    run(fit, "--orbit", "5", "--out", tmp_path)
    names = [f"orbit_{i:03d}.png" for i in range(5)]
    assert visible(tmp_path) == {"orbit.webp", *names}
    fov = float(np.degrees(FIELD_OF_VIEW))
    cameras = orbit_of_views(make_dataset().train, blobs()).viewpoints(5, WIDTH, HEIGHT, fov)
    for name, camera in zip(names, cameras, strict=True):
        assert_shows(tmp_path / name, camera, WHITE)
    first = (tmp_path / "orbit_000.png").read_bytes()
    run(fit, "--orbit", "1", "--set", "data.background=white", "--out", tmp_path / "set")
    assert (tmp_path / "set" / "orbit_000.png").read_bytes() == first
    arguments = ("--orbit", "3", "--size", "30", "20", "--background", "black", "--fov", "60")
    run(fit / "point_cloud.ply", *arguments, "--out", tmp_path)
    orbit = orbit_of_gaussians(blobs(), np.array([0, 0, 1]), 60)
    for index, camera in enumerate(orbit.viewpoints(3, 30, 20, 60)):
        assert_shows(tmp_path / f"orbit_{index:03d}.png", camera, BLACK)


def test_depths_are_not_opened(tmp_path):
    fit = write_fit(tmp_path, make_dataset(1, 1))
    for path in (tmp_path / "data").glob("transforms_*.json"):
        values = json.loads(path.read_text())
        values["frames"][0]["depth_file_path"] = "nowhere.png"
        path.write_text(json.dumps(values))
    run(fit, "--out", tmp_path / "out")


def write_camera(path, begin, end=None, **values):
    """Write a small camera in the layout of transforms.json; end: its second pose."""
    frame = {"transform_matrix": (begin * [1, -1, -1, 1]).tolist(), **values}
    if end is not None:
        frame["transform_matrix_close"] = (end * [1, -1, -1, 1]).tolist()
    values = {"camera_angle_x": FIELD_OF_VIEW, "w": WIDTH, "h": HEIGHT, "frames": [frame]}
    path.write_text(json.dumps(values))
    return path


@pytest.mark.slow
def test_moving_camera_of_a_file_blurs_the_image(fit, tmp_path):
    """A global shutter that closes where it opened shows what one that stands still does."""
    begin, end = (pose_around(azimuth, 0.3) for azimuth in (0.8, 0.9))
    end[:3, 3] += 0.4 * end[:3, 0]
    for name, close, shutter, samples in (
        ("still", None, "global", 3),
        ("same", begin, "global", 3),
        ("one", end, "global", 1),
        ("global", end, "global", 3),
        ("rolling", end, "rolling", 3),
    ):
        camera = write_camera(tmp_path / f"{name}.json", begin, close, shutter=shutter)
        setting = ("--set", f"data.shutter_samples={samples}")
        run(fit, "--camera", camera, *setting, "--out", tmp_path / name)
    shown = {path.parent.name: rendered(path) for path in tmp_path.glob("*/camera_0.png")}
    # The average of equal images, rounded to 8 bits.
    assert np.abs(shown["same"] - shown["still"]).max() <= 1 / 255 + 1e-9
    for first, second in combinations(("still", "one", "global", "rolling"), 2):
        assert np.abs(shown[first] - shown[second]).max() > 0.05, (first, second)


def test_camera_set_by_options_is_used(fit, tmp_path):
    """A file's background is black; a folder's is that of its configuration."""
    words = ["--origin", *POSE[:3, 3], "--target", *FOCUS, "--fov", np.degrees(FIELD_OF_VIEW)]
    words += ["--size", WIDTH, HEIGHT, "--out", tmp_path]
    for what, background in ((fit / "point_cloud.ply", BLACK), (fit, WHITE)):
        run(what, *words)
        assert_shows(tmp_path / "camera.png", VIEW, background)


@pytest.mark.parametrize("way", ["origin", "orbit", "camera"])
def test_panoramas_equal_the_reference(fit, tmp_path, way):
    """They are level at any place and along an orbit; poses of a file are kept."""
    pose, words, name = POSE, ["--origin", *POSE[:3, 3], "--target", *FOCUS], "camera"
    if way == "orbit":
        orbit = orbit_of_gaussians(blobs(), (0, 0, 1), 40)
        pose = orbit.viewpoints(3, 60, 30, 40)[1].camera_to_world
        words, name = ["--orbit", 3], "orbit_001"
    if way == "camera":
        frames = [{"transform_matrix": (POSE * [1, -1, -1, 1]).tolist()}]
        (tmp_path / "camera.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
        words, name = ["--camera", tmp_path / "camera.json"], "camera_0"
        axes = pose[:3, :3].T
    else:
        level = pose[:3, 2] * [1, 1, 0] / np.linalg.norm(pose[:2, 2])
        axes = np.array([np.cross([0, 0, -1], level), [0, 0, -1], level])
    out = tmp_path / "out"
    run(fit / "point_cloud.ply", *words, "--panorama", "--size", 60, 30, "--out", out)
    gaussians = {k: getattr(blobs(), k).astype(float) for k in PARAMETER_NAMES}
    camera = reference.Camera(axes, pose[:3, 3], 1, 1, 0, 0, 60, 30, 0.2)
    expected = lenses.render(reference.Gaussians(**gaussians), camera, lenses.Equirectangular())
    image = np.clip(expected.image, 0, 1)
    assert_images_agree(rendered(out / f"{name}.png"), image, expected, EIGHT_BITS)


HEADER = {"antialiased": True, "low_pass": 0.02}
VIEWERS = {"antialiased": False, "low_pass": 0.3}
CAMERA = ["--origin", 0, -4, 1, "--size", 24, 16]
LINES = {
    "  antialiasing: opacities compensated for the low-pass filter (set by the file)",
    "  approximations: low_pass = 0.02 (set by the file)",
}


@pytest.fixture
def shown(tmp_path, capsys):
    """Images of words, in a folder with files and configurations; and what was printed."""
    for name, header in (("plain", None), ("native", HEADER), ("viewers", VIEWERS)):
        replace(blobs(), rendered_with=header).save(tmp_path / f"{name}.ply")
    write_dataset(tmp_path / "data", make_dataset(1, 1))
    config = {"data": {"path": str(tmp_path / "data")}}
    (tmp_path / "plain.yml").write_text(yaml.safe_dump(config))
    (tmp_path / "native.yml").write_text(yaml.safe_dump({**config, "model": HEADER}))

    def render(name, *words, config=None):
        words = [*words, *(["--scene", tmp_path / f"{config}.yml"] if config else CAMERA)]
        run(tmp_path / f"{name}.ply", *words, "--out", tmp_path / "out")
        (image,) = (tmp_path / "out").glob("*.png")
        content = image.read_bytes()
        image.unlink()
        return content, capsys.readouterr().out

    return render


def test_single_file_is_rendered_with_its_header(shown):
    own, said = shown("native")
    plain, plainly_said = shown("plain")
    assert set(said.splitlines()) >= LINES
    assert own != plain and "set by the file" not in plainly_said


@pytest.mark.slow
def test_header_overrides_configuration_and_set_overrides_header(shown):
    own, _ = shown("native", config="native")
    plain, _ = shown("plain", config="plain")
    assert own != plain
    assert shown("native", config="plain")[0] == own
    assert shown("viewers", config="native")[0] == plain
    sets = [
        [word for name, value in values.items() for word in ("--set", f"model.{name}={value}")]
        for values in (HEADER, VIEWERS)
    ]
    assert shown("plain", *sets[0][:2], config="plain")[0] != own
    assert shown("plain", *sets[0], config="plain")[0] == own
    image, said = shown("native", *sets[1], config="plain")
    assert image == plain and "set by the file" not in said


def test_a_mitsuba_scene_becomes_linear_exr_and_srgb_png(tmp_path):
    run(write_scene(tmp_path, sensor(POSE)), "--out", tmp_path / "out")
    assert visible(tmp_path / "out") == {"blobs.exr", "blobs.png"}
    image_on_black = photograph(blobs(), VIEW, BLACK)
    encoded = image_on_black.image + image_on_black.transmittance[..., None]
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    exr = np.array(read_exr(tmp_path / "out" / "blobs.exr"))
    assert_images_agree(exr, linear, image_on_black, 1e-4)
    png = rendered(tmp_path / "out" / "blobs.png")
    assert_images_agree(png, np.clip(encoded, 0, 1), image_on_black, EIGHT_BITS)


def test_a_scene_in_display_space_is_not_encoded_again(tmp_path):
    settings = '<boolean name="srgb_primitives" value="false"/>'
    run(write_scene(tmp_path, sensor(POSE), settings=settings), "--out", tmp_path / "out")
    assert_shows(tmp_path / "out" / "blobs.png", VIEW, WHITE)
    expected = photograph(blobs(), VIEW, WHITE)
    exr = np.array(read_exr(tmp_path / "out" / "blobs.exr"))
    assert_images_agree(exr, expected.image, expected, 1e-4)


def test_every_sensor_of_a_scene_is_rendered(tmp_path):
    sensors = sensor(POSE), sensor(pose_around(2.0, 0.3), "rgba")
    run(write_scene(tmp_path, *sensors), "--out", tmp_path / "out")
    expected = {f"blobs_{i}.{suffix}" for i in range(2) for suffix in ("exr", "png")}
    assert visible(tmp_path / "out") == expected
    assert np.array(read_exr(tmp_path / "out" / "blobs_1.exr")).shape == (HEIGHT, WIDTH, 4)
    assert rendered(tmp_path / "out" / "blobs_1.png").shape == (HEIGHT, WIDTH, 3)


def test_scene_without_splats_is_rendered(tmp_path):
    body = f'{sensor(POSE)}<shape type="sphere"/><emitter type="constant"/>'
    scene = f'<scene version="3.0.0"><integrator type="direct"/>{body}</scene>'
    (tmp_path / "sphere.xml").write_text(scene)
    run(tmp_path / "sphere.xml", "--out", tmp_path / "out")
    assert rendered(tmp_path / "out" / "sphere.png").shape == (HEIGHT, WIDTH, 3)


def test_parameters_of_a_scene_file_can_be_given(tmp_path):
    path = write_scene(tmp_path, sensor(POSE))
    run(path, "--out", tmp_path / "written")
    text = path.read_text().replace('"model.ply"', '"$model"').replace("1, 1, 1", "$color")
    path.write_text(text)
    (tmp_path / "model.ply").rename(tmp_path / "a=b.ply")
    run(path, "-D", "model=a=b.ply", "--define", "color=1, 1, 1", "--out", tmp_path / "given")
    images = [rendered(tmp_path / folder / "blobs.png") for folder in ("given", "written")]
    np.testing.assert_array_equal(*images)


@pytest.mark.slow
def test_the_shipped_scene_shows_objects_among_splats(tmp_path):
    """Some pixels show what is seen there without the model, others do not."""
    path = REPOSITORY / "scenes" / "hybrid.xml"
    values = {"model": str(REPOSITORY / "scenes" / "shapes" / "knot.ply"), "spp": "4"}
    values |= {"width": "60", "height": "40", "light": "none", "shadows": ""}
    definitions = [word for name in values for word in ("-D", f"{name}={values[name]}")]
    run(path, *definitions, "--out", tmp_path)
    shown = np.array(read_exr(tmp_path / "hybrid.exr"))
    scene = mi.load_file(str(path), **values)
    objects = np.array(mi.render(scene, integrator=scene.integrator().state.nested, spp=4))
    # The file has half precision: 11 bits.
    agree = np.all(np.abs(shown - objects) <= 1e-3 * (1 + objects), axis=-1)
    assert 0.3 < agree.mean() < 0.9


# A fit in Earth-centred coordinates is shown like one at the origin

PLACE = np.array([4.2e6, 1.7e5, -4.78e6])
ORIGIN = (4200001.0, 169999.0, -4779998.0)
"""Origin of the Gaussians, which differs from that of the dataset."""


@pytest.fixture(scope="module")
def far(tmp_path_factory):
    """A folder as a fit leaves it, whose world is at ``PLACE``."""
    folder = tmp_path_factory.mktemp("far")
    dataset = make_dataset()
    views = {n: tuple(v.with_offset(PLACE) for v in getattr(dataset, n)) for n in ("train", "test")}
    write_dataset(folder / "data", replace(dataset, **views))
    means = (blobs().means + (PLACE - ORIGIN)).astype(np.float32)
    (folder / "run").mkdir()
    replace(blobs(), means=means, origin=ORIGIN).save(folder / "run" / "point_cloud.ply")
    config = {"data": {"path": str(folder / "data"), "background": "white"}}
    (folder / "run" / "config.yml").write_text(yaml.safe_dump(config))
    write_views(folder / "run" / VIEWS, load_dataset(folder / "data"))
    return folder / "run"


def test_cameras_of_files_and_by_hand_are_in_world_coordinates(far, tmp_path):
    run(far, "--out", tmp_path)
    for camera in make_dataset().test:
        assert_shows(tmp_path / f"{camera.name}.png", camera, WHITE)
    run(far, "--camera", far / VIEWS, "--out", tmp_path / "file")
    assert json.loads((far / VIEWS).read_text())["origin"] == list(
        load_dataset(far.parent / "data").origin
    )
    for index, camera in enumerate(make_dataset().train):
        assert_shows(tmp_path / "file" / f"camera_{index}.png", camera, WHITE)
    pose = pose_around(1.0, 0.4)
    place, target = (PLACE + point for point in (pose[:3, 3], FOCUS))
    hand = ["--fov", np.degrees(FIELD_OF_VIEW), "--size", WIDTH, HEIGHT, "--out", tmp_path / "hand"]
    run(far, "--origin", *place, "--target", *target, *hand)
    assert_shows(tmp_path / "hand" / "camera.png", small_capture.view("a", pose, None), WHITE)


def test_exports_keep_the_origin_and_crop_in_world_coordinates(far, tmp_path):
    whole, half = tmp_path / "whole.glb", tmp_path / "half.ply"
    assert_ends_well(export.main, far, "--out", whole, "--up", 0, 0, 1)
    read = Gaussians.load(whole)
    assert read.origin == ORIGIN
    expected = blobs().means + PLACE
    np.testing.assert_allclose(read.means + np.array(ORIGIN), expected, rtol=0, atol=1e-5)
    low, high = PLACE - 100, PLACE + np.array([FOCUS[0], 100, 100])
    assert_ends_well(export.main, far, "--out", half, "--crop", *low, *high)
    assert Gaussians.load(half).num_gaussians == np.count_nonzero(blobs().means[:, 0] <= FOCUS[0])
    assert_ends_well(export.main, far, "--format", "html", "--out", tmp_path / "page.html")


def test_plugin_renders_relative_to_the_origin_and_notes_it(far, tmp_path):
    pose = pose_around(1.0, 0.4)
    path = write_scene(tmp_path, sensor(pose))
    expected = np.array(mi.render(mi.load_file(str(path))))
    (tmp_path / "model.ply").write_bytes((far / "point_cloud.ply").read_bytes())
    pose[:3, 3] += PLACE - ORIGIN
    numbers = " ".join(repr(float(v)) for v in (pose @ np.diag([-1, -1, 1, 1])).ravel())
    text = re.sub("<lookat[^>]*>", f'<matrix value="{numbers}"/>', path.read_text())
    path.write_text(text)
    with pytest.warns(UserNote, match=r"relative to \(4200001, 169999, -4779998\); place sensors"):
        scene = mi.load_file(str(path))
    # Positions relative to the origin are rounded once more.
    np.testing.assert_allclose(np.array(mi.render(scene)), expected, rtol=0, atol=1e-3)
