"""``python -m drgs.render``, against the float64 reference and PSNR computed plainly."""

import json
import subprocess
import sys

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
import yaml
from conftest import REPOSITORY
from scipy.spatial.transform import Rotation
from support.small_capture import (
    FIELD_OF_VIEW,
    FOCUS,
    HEIGHT,
    WIDTH,
    assert_pictures_agree,
    blobs,
    decibels,
    make_dataset,
    photograph,
    pose_around,
    write_dataset,
)
from support.small_capture import view as small_view

from drgs import render
from drgs.data.orbits import orbit_of_gaussians, orbit_of_views

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """A folder as a fit leaves it, with its dataset."""
    folder = tmp_path_factory.mktemp("fit")
    write_dataset(folder / "data", make_dataset())
    blobs().save(folder / "run" / "point_cloud.ply")
    config = {"data": {"path": str(folder / "data"), "background": "white"}}
    (folder / "run" / "config.yml").write_text(yaml.safe_dump(config))
    return folder / "run"


def photo(fit, name, background, split="test"):
    """A photograph of the dataset over a background."""
    rgba = iio.imread(fit.parent / "data" / split / f"{name}.png") / 255
    return rgba[:, :, :3] * rgba[:, :, 3:] + np.array(background) * (1 - rgba[:, :, 3:])


def picture(path):
    return iio.imread(path) / 255


def run(*arguments):
    render.main([str(argument) for argument in arguments])


def fails(capsys, *arguments):
    """The line with the error that the command prints, after its usage if need be, with 2."""
    with pytest.raises(SystemExit) as exit_info:
        run(*arguments)
    assert exit_info.value.code == 2
    *usage, line = capsys.readouterr().err.strip().splitlines()
    assert not usage or usage[0].startswith("usage: python -m drgs.render ")
    return line.partition("error: ")[2]


# A picture of 8 bits is within half a level of what was rendered; the renderer is within 1e-4.
EIGHT_BITS = 0.5 / 255 + 1e-4


def assert_shows(path, camera, background):
    """The file is the picture that the reference makes of the blobs."""
    expected = photograph(blobs(), camera, background)
    assert_pictures_agree(picture(path), np.clip(expected.image, 0, 1), expected, EIGHT_BITS)
    return np.clip(expected.image, 0, 1)


# ----------------------------------------------------------------------------------------------
# Views with photographs
# ----------------------------------------------------------------------------------------------


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


def test_a_ply_is_rendered_under_a_configuration(fit, tmp_path):
    run(fit, "--split", "train", "--out", tmp_path / "fit")
    ply = fit / "point_cloud.ply"
    run(ply, "--scene", fit / "config.yml", "--split", "train", "--out", tmp_path / "ply")
    names = {path.name for path in (tmp_path / "fit").iterdir()}
    assert names == {"metrics.json", *(f"r_{i}.png" for i in range(8))}
    for name in names:
        assert (tmp_path / "fit" / name).read_bytes() == (tmp_path / "ply" / name).read_bytes()


@pytest.mark.parametrize("optimised", [True, False])
def test_refined_cameras_beside_the_gaussians_are_used_or_spoken_of(tmp_path, capsys, optimised):
    """Whether the fit's folder or its PLY file is named, as its configuration says."""
    dataset = make_dataset(2, 1)
    write_dataset(tmp_path / "data", dataset)
    found = tmp_path / "run"
    blobs().save(found / "point_cloud.ply")
    config = {"data": {"path": str(tmp_path / "data")}, "cameras": {"optimise": optimised}}
    (found / "config.yml").write_text(yaml.safe_dump(config))
    refined = [
        small_view(v.name, pose_around(0.4 + i, 0.6), None) for i, v in enumerate(dataset.train)
    ]
    frames = [
        {"file_path": v.name, "transform_matrix": (v.camera_to_world * [1, -1, -1, 1]).tolist()}
        for v in refined
    ]
    (found / "cameras.json").write_text(json.dumps({"lens_change": {}, "frames": frames}))
    for name, what in (
        ("folder", [found]),
        ("file", [found / "point_cloud.ply", "--scene", found / "config.yml"]),
    ):
        run(*what, "--split", "train", "--out", tmp_path / name)
        printed = capsys.readouterr().out.splitlines()
        said = [line for line in printed if "cameras.json" in line]
        assert said == [
            f"cameras: as refined, from {found / 'cameras.json'}"
            if optimised
            else f"cameras: as the dataset has them; those of {found / 'cameras.json'} are used "
            "with --set cameras.optimise=true"
        ]
        for view, moved in zip(dataset.train, refined, strict=True):
            seen_from = moved if optimised else view
            assert_shows(tmp_path / name / f"{view.name}.png", seen_from, WHITE)


def test_a_background_is_behind_splats_and_photographs(fit, tmp_path):
    background = (0.0, 0.5, 0.25)
    run(fit, "--background", *background, "--out", tmp_path)
    expected = assert_shows(tmp_path / "r_1.png", make_dataset().test[1], background)
    score = decibels(expected, photo(fit, "r_1", background))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["views"]["r_1"]["psnr"] == pytest.approx(score, abs=1e-3)


def test_depths_are_not_opened(tmp_path):
    """There are none: nothing that is rendered looks at them."""
    write_dataset(tmp_path / "data", make_dataset(1, 1))
    for split in ("train", "test"):
        path = tmp_path / "data" / f"transforms_{split}.json"
        values = json.loads(path.read_text())
        values["frames"][0]["depth_file_path"] = "nowhere.png"
        path.write_text(json.dumps(values))
    blobs().save(tmp_path / "blobs.ply")
    (tmp_path / "a.yml").write_text(yaml.safe_dump({"data": {"path": "data"}}))
    run(tmp_path / "blobs.ply", "--scene", tmp_path / "a.yml", "--out", tmp_path / "out")
    assert (tmp_path / "out" / "r_0.png").is_file()


def test_values_of_the_configuration_can_be_set(fit, tmp_path):
    run(fit, "--set", "data.image_size=16", "--out", tmp_path)
    assert picture(tmp_path / "r_0.png").shape == (HEIGHT // 2, WIDTH // 2, 3)


def test_a_picture_equal_to_its_photograph_has_no_number_in_json():
    quality = {"psnr": float("inf"), "views": {"a": {"psnr": 3.5}}}
    assert render._without_infinities(quality) == {"psnr": None, "views": {"a": {"psnr": 3.5}}}


# ----------------------------------------------------------------------------------------------
# Views without
# ----------------------------------------------------------------------------------------------


def test_an_orbit_is_around_what_the_photographs_show(fit, tmp_path):
    run(fit, "--orbit", "5", "--out", tmp_path)
    names = [f"orbit_{i:03d}.png" for i in range(5)]
    assert {path.name for path in tmp_path.iterdir()} == {"orbit.webp", "orbit.gif", *names}
    fov = float(np.degrees(FIELD_OF_VIEW))
    cameras = orbit_of_views(make_dataset().train, blobs()).viewpoints(5, WIDTH, HEIGHT, fov)
    for name, camera in zip(names, cameras, strict=True):
        assert_shows(tmp_path / name, camera, WHITE)


def test_an_orbit_of_a_ply_needs_no_photographs(fit, tmp_path):
    arguments = ("--orbit", "3", "--size", "30", "20", "--background", "black", "--fov", "60")
    run(fit / "point_cloud.ply", *arguments, "--out", tmp_path)
    orbit = orbit_of_gaussians(blobs(), np.array([0, 0, 1]), 60)
    for index, camera in enumerate(orbit.viewpoints(3, 30, 20, 60)):
        assert_shows(tmp_path / f"orbit_{index:03d}.png", camera, (0, 0, 0))


def test_cameras_of_a_transforms_file_give_the_pictures_of_the_split(fit, tmp_path):
    run(fit, "--out", tmp_path / "split")
    transforms = fit.parent / "data" / "transforms_test.json"
    size = ("--size", WIDTH, HEIGHT)
    run(fit, "--camera", transforms, *size, "--out", tmp_path / "cameras")
    for index in range(4):
        expected = (tmp_path / "split" / f"r_{index}.png").read_bytes()
        assert (tmp_path / "cameras" / f"camera_{index}.png").read_bytes() == expected


def write_camera(path, begin, end=None, **says):
    """Of the small size, in the layout of transforms.json; end: its second pose."""
    frame = {"transform_matrix": (begin * [1, -1, -1, 1]).tolist(), **says}
    if end is not None:
        frame["transform_matrix_close"] = (end * [1, -1, -1, 1]).tolist()
    values = {"camera_angle_x": FIELD_OF_VIEW, "w": WIDTH, "h": HEIGHT, "frames": [frame]}
    path.write_text(json.dumps(values))
    return path


@pytest.mark.parametrize("samples", [None, 3])
def test_a_camera_of_a_file_that_moves_is_seen_moving(fit, tmp_path, samples):
    """A global shutter that closes where it opened shows what one that stands still does."""
    begin, end = (pose_around(azimuth, 0.3) for azimuth in (0.8, 0.9))
    end[:3, 3] += 0.4 * end[:3, 0]
    settings = ["--set", f"data.shutter_samples={samples}"] if samples else []
    for name, close, shutter in (
        ("still", None, "global"),
        ("same", begin, "global"),
        ("global", end, "global"),
        ("rolling", end, "rolling"),
    ):
        camera = write_camera(tmp_path / f"{name}.json", begin, close, shutter=shutter)
        run(fit, "--camera", camera, *settings, "--out", tmp_path / name)
    shown = {path.parent.name: picture(path) for path in tmp_path.glob("*/camera_0.png")}
    # The average of equal pictures, rounded to 8 bits.
    assert np.abs(shown["same"] - shown["still"]).max() <= 1 / 255 + 1e-9
    for name in ("global", "rolling"):
        assert np.abs(shown[name] - shown["still"]).max() > 0.1
    assert np.abs(shown["global"] - shown["rolling"]).max() > 0.05
    # In the middle of equal times, each by the reference.
    count = samples or 8
    times = [(k + 0.5) / count for k in range(count)]
    cameras = [small_view("", between(begin, end, time), None) for time in times]
    parts = [photograph(blobs(), camera, WHITE) for camera in cameras]
    clear = ~np.any([part.near_threshold for part in parts], axis=0)
    expected = np.clip(np.mean([part.image for part in parts], axis=0), 0, 1)
    assert clear.mean() > 0.8
    assert np.abs(shown["global"] - expected)[clear].max() <= EIGHT_BITS


@pytest.mark.parametrize("ignored", [(), ("distortion", "motion")])
def test_the_plan_regards_all_cameras_and_names_what_is_ignored(fit, tmp_path, capsys, ignored):
    """Of a file and of a Mitsuba scene, the first of which is a plain one."""
    path = write_camera(tmp_path / "c.json", pose_around(0.8, 0.3))
    values = json.loads(path.read_text())
    close = {"transform_matrix_close": values["frames"][0]["transform_matrix"]}
    values["frames"].append({**values["frames"][0], **close, "k1": 0.1})
    path.write_text(json.dumps(values))
    ignore = ["--ignore", *ignored] if ignored else []
    run(fit, "--camera", path, *ignore, "--out", tmp_path / "file")
    of_file = capsys.readouterr().out
    bent = sensor(pose_around(2.0, 0.3)).replace("perspective", "calibrated")
    lens = '<string name="lens" value="opencv"/><float name="k1" value="0.1"/>'
    bent = bent.replace("<film", f"{lens}<film")
    bent = bent.replace(f'<float name="fov" value="{np.degrees(FIELD_OF_VIEW)}"/>', "")
    settings = f'<string name="ignore" value="{", ".join(ignored)}"/>'
    scene = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)), bent, settings=settings)
    run(scene, "--out", tmp_path / "scene")
    of_scene = capsys.readouterr().out
    if ignored:
        assert "  not simulated: lens distortion (ignored), motion (ignored), anti" in of_file
        assert "  not simulated: lens (ignored), depth of field, motion, anti" in of_scene
    else:
        assert "  lens distortion: opencv (k1) (1 of 2 cameras)\n" in of_file
        assert "  motion: global shutter (1 of 2 cameras)\n" in of_file
        assert "  lens: RadialTangential (k1) (1 of 2 sensors)\n" in of_scene


def between(begin, end, time):
    """The pose at a time: the centre on a line, turning at a constant rate."""
    turn = Rotation.from_matrix(end[:3, :3] @ begin[:3, :3].T).as_rotvec()
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(time * turn).as_matrix() @ begin[:3, :3]
    pose[:3, 3] = (1 - time) * begin[:3, 3] + time * end[:3, 3]
    return pose


def test_a_camera_placed_by_hand_is_that_camera(fit, tmp_path):
    pose = pose_around(0.8, 0.3)
    fov = np.degrees(FIELD_OF_VIEW)
    arguments = ["--origin", *pose[:3, 3], "--target", *FOCUS, "--fov", fov]
    size = ("--size", WIDTH, HEIGHT)
    run(fit / "point_cloud.ply", *arguments, *size, "--out", tmp_path)
    assert_shows(tmp_path / "camera.png", small_view("", pose, None), WHITE)


# ----------------------------------------------------------------------------------------------
# Mitsuba scenes
# ----------------------------------------------------------------------------------------------


def sensor(pose, pixel_format="rgb"):
    origin, target = (", ".join(map(repr, v)) for v in (pose[:3, 3].tolist(), FOCUS.tolist()))
    return f"""
    <sensor type="perspective">
        <float name="fov" value="{np.degrees(FIELD_OF_VIEW)}"/>
        <float name="near_clip" value="0.2"/>
        <transform name="to_world"><lookat origin="{origin}" target="{target}" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="{WIDTH}"/><integer name="height" value="{HEIGHT}"/>
            <string name="pixel_format" value="{pixel_format}"/><rfilter type="box"/>
            <string name="component_format" value="float32"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
    </sensor>"""


def write_scene(folder, *sensors, settings=""):
    blobs().save(folder / "model.ply")
    path = folder / "blobs.xml"
    path.write_text(
        f"""<scene version="3.0.0">
        <integrator type="splats">
            <string name="filename" value="model.ply"/>
            <rgb name="background" value="1, 1, 1"/>
            {settings}
        </integrator>
        {"".join(sensors)}
        </scene>"""
    )
    return path


def to_linear(x):
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def to_srgb(x):
    return np.where(x <= 0.0031308, x * 12.92, 1.055 * x ** (1 / 2.4) - 0.055)


def test_a_mitsuba_scene_becomes_linear_exr_and_srgb_png(tmp_path):
    pose = pose_around(0.8, 0.3)
    run(write_scene(tmp_path, sensor(pose)), "--out", tmp_path / "out")
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"blobs.exr", "blobs.png"}
    # The integrator decodes premultiplied splats and background apart; white stays 1.
    picture_on_black = photograph(blobs(), small_view("", pose, None), (0, 0, 0))
    linear = to_linear(picture_on_black.image) + picture_on_black.transmittance[..., None]
    exr = np.array(mi.Bitmap(str(tmp_path / "out" / "blobs.exr")))
    assert_pictures_agree(exr, linear, picture_on_black, 1e-4)
    encoded = np.clip(to_srgb(linear), 0, 1)
    png = picture(tmp_path / "out" / "blobs.png")
    assert_pictures_agree(png, encoded, picture_on_black, EIGHT_BITS)


def test_a_scene_in_display_space_is_not_encoded_again(tmp_path):
    pose = pose_around(0.8, 0.3)
    settings = '<boolean name="srgb_primitives" value="false"/>'
    run(write_scene(tmp_path, sensor(pose), settings=settings), "--out", tmp_path / "out")
    camera = small_view("", pose, None)
    assert_shows(tmp_path / "out" / "blobs.png", camera, WHITE)
    expected = photograph(blobs(), camera, WHITE)
    exr = np.array(mi.Bitmap(str(tmp_path / "out" / "blobs.exr")))
    assert_pictures_agree(exr, expected.image, expected, 1e-4)


def test_a_scene_in_display_space_inside_aov_is_not_encoded_again(tmp_path):
    """Both files have what the rays of ``aov`` see, at points of its own."""
    pose = pose_around(0.8, 0.3)
    settings = '<boolean name="srgb_primitives" value="false"/>'
    path = write_scene(tmp_path, sensor(pose), settings=settings)
    begin, end = '<integrator type="splats">', "</integrator>"
    aov = '<integrator type="aov"><string name="aovs" value="d:depth"/>'
    text = path.read_text().replace(begin, aov + begin).replace(end, end + end)
    path.write_text(text)
    run(path, "--out", tmp_path / "out")
    root = mi.Bitmap(str(tmp_path / "out" / "blobs.exr")).split()[0][1]
    colors = np.clip(np.array(root.convert(mi.Bitmap.PixelFormat.RGB)), 0, 1)
    assert np.abs(picture(tmp_path / "out" / "blobs.png") - colors).max() <= EIGHT_BITS
    assert np.abs(to_srgb(colors) - colors).max() > 0.1


def test_every_sensor_of_a_scene_is_rendered(tmp_path):
    sensors = sensor(pose_around(0.8, 0.3)), sensor(pose_around(2.0, 0.3), "rgba")
    run(write_scene(tmp_path, *sensors), "--out", tmp_path / "out")
    expected = {f"blobs_{i}.{suffix}" for i in range(2) for suffix in ("exr", "png")}
    assert {p.name for p in (tmp_path / "out").iterdir()} == expected
    assert np.array(mi.Bitmap(str(tmp_path / "out" / "blobs_1.exr"))).shape == (HEIGHT, WIDTH, 4)
    assert picture(tmp_path / "out" / "blobs_1.png").shape == (HEIGHT, WIDTH, 3)


def test_a_scene_of_mitsubas_own_is_rendered_too(tmp_path):
    path = tmp_path / "sphere.xml"
    path.write_text(
        f"""<scene version="3.0.0"><integrator type="direct"/>{sensor(pose_around(0.0, 0.2))}
        <shape type="sphere"/><emitter type="constant"/></scene>"""
    )
    run(path, "--out", tmp_path / "out")
    assert picture(tmp_path / "out" / "sphere.png").shape == (HEIGHT, WIDTH, 3)


def test_ellipsoids_of_a_scene_look_as_the_same_file_of_the_integrator(tmp_path):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    run(path, "--out", tmp_path / "file")
    name = '<string name="filename" value="model.ply"/>'
    text = path.read_text()
    assert name in text
    shape = f'<shape type="ellipsoids">{name}</shape>'
    path.write_text(text.replace(name, "").replace("</scene>", f"{shape}</scene>"))
    run(path, "--out", tmp_path / "shape")
    pair = (np.array(mi.Bitmap(str(tmp_path / d / "blobs.exr"))) for d in ("file", "shape"))
    # float32's exp, log and sigmoid: 1e-7 each, as in tests/integrator/test_ellipsoids.py.
    np.testing.assert_allclose(*pair, atol=1e-5)


def test_parameters_of_a_scene_file_can_be_given(tmp_path):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    path.write_text(
        path.read_text().replace('"model.ply"', '"$model"').replace("1, 1, 1", "$color")
    )
    (tmp_path / "model.ply").rename(tmp_path / "a=b.ply")
    run(path, "-D", "model=a=b.ply", "--define", "color=1, 1, 1", "--out", tmp_path / "given")
    (tmp_path / "a=b.ply").rename(tmp_path / "model.ply")
    run(write_scene(tmp_path, sensor(pose_around(0.8, 0.3))), "--out", tmp_path / "written")
    pictures = [picture(tmp_path / folder / "blobs.png") for folder in ("given", "written")]
    np.testing.assert_array_equal(*pictures)


def test_the_shipped_scene_shows_objects_among_splats(tmp_path):
    """Some pixels show what is seen there without the model, others do not."""
    path = REPOSITORY / "scenes" / "hybrid.xml"
    values = {"model": str(REPOSITORY / "scenes" / "shapes" / "knot.ply"), "spp": "4"}
    values |= {"width": "60", "height": "40"}
    definitions = [word for name in values for word in ("-D", f"{name}={values[name]}")]
    run(path, *definitions, "--out", tmp_path)
    shown = np.array(mi.Bitmap(str(tmp_path / "hybrid.exr")))
    scene = mi.load_file(str(path), **values)
    objects = np.array(mi.render(scene, integrator=scene.integrator().nested, spp=4))
    # The file has half precision: 11 bits.
    agree = np.all(np.abs(shown - objects) <= 1e-3 * (1 + objects), axis=-1)
    assert 0.3 < agree.mean() < 0.9


# ----------------------------------------------------------------------------------------------
# Errors
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("what", "arguments", "message"),
    [
        ("nowhere.ply", [], "there is no such file or folder"),
        ("../data", [], "there is no config.yml in it"),
        ("config.yml", [], "must be a PLY file, a Mitsuba scene (.xml) or the output folder"),
        ("point_cloud.ply", [], "say what to render: --orbit N"),
        ("point_cloud.ply", ["--split", "test"], "needs photographs"),
        ("point_cloud.ply", ["--orbit", "2", "--data", "x"], "--data: needs --scene"),
        (
            "point_cloud.ply",
            ["--orbit", "0"],
            "--orbit: must be a whole number >= 1",
        ),
        ("point_cloud.ply", ["--orbit", "2", "--up", "0", "0", "0"], "up must not be zero"),
        ("point_cloud.ply", ["--orbit", "2", "--variant", "scalar_rgb"], "--variant: must be"),
        ("", ["--orbit", "2", "--split", "test"], "--split: not allowed with argument --orbit"),
        ("", ["--orbit", "2", "--up", "0", "0", "1"], "--up: is not used here"),
        ("", ["--size", "8", "8"], "--size: is not used with --split"),
        ("", ["--origin", "0", "0", "0"], "must not be zero or parallel"),
        ("", ["--origin", "0", "0", "nan"], "--origin: must be a finite number, got nan"),
        ("", ["--origin", "3", "0", "0", "--fov", "180"], "--fov: must be between 0 and 180"),
        (
            "",
            ["--origin", "3", "0", "0", "--size", "0", "9"],
            "--size: must be a whole",
        ),
        ("", ["--background", "pink"], "or a picture's file, got pink"),
        ("", ["--background", "0", "0", "1.5"], "got 0 0 1.5"),
        ("", ["--camera", "nowhere.json", "--size", "8", "8"], "nowhere.json: cannot read"),
        ("", ["--data", "nowhere"], "data.path: there is no folder"),
        ("", ["--set", "data.imagesize=3"], "did you mean data.image_size?"),
        ("", ["-D", "model=x.ply"], "--define: is for the parameters of a Mitsuba scene (.xml)"),
    ],
)
def test_user_errors_are_one_line_and_write_nothing(
    fit, tmp_path, capsys, what, arguments, message
):
    assert message in fails(capsys, fit / what, *arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


EXACT = ["--set", "model.projection=exact"]


@pytest.mark.parametrize("mode", ["--camera", "--split"])
def test_the_exact_projection_of_a_bent_lens_is_refused(tmp_path, capsys, mode):
    """With status 2, before anything is written; without the distortion it is rendered."""
    write_dataset(tmp_path / "data", make_dataset(1, 1))
    blobs().save(tmp_path / "blobs.ply")
    (tmp_path / "a.yml").write_text(yaml.safe_dump({"data": {"path": "data"}}))
    path = tmp_path / "data" / "transforms_test.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"k1": 0.1}))
    arguments = [tmp_path / "blobs.ply", "--scene", tmp_path / "a.yml", *EXACT]
    if mode == "--split":
        arguments += ["--split", "test"]
    else:
        arguments += ["--camera", path, "--size", WIDTH, HEIGHT]
    message = fails(capsys, *arguments, "--out", tmp_path / "out")
    assert message.startswith(
        "model.projection must be ewa or unscented for lenses that are no pinholes, such as that "
        f"of view {'r_0' if mode == '--split' else 'camera_0'} (opencv: k1), got exact; or "
        "give --ignore distortion"
    )
    assert not (tmp_path / "out").exists()
    run(*arguments, "--ignore", "distortion", "--out", tmp_path / "out")
    assert list((tmp_path / "out").glob("*.png"))


def test_the_folder_of_a_fit_is_not_overwritten(fit, capsys):
    assert "holds a fit" in fails(capsys, fit, "--out", fit)


def test_an_output_folder_that_is_a_file_is_an_error(fit, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert "cannot write" in fails(capsys, fit, "--out", tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("no xml", "blobs.xml: "),
        ('<scene version="3.0.0"/>', "must hold an integrator and at least one sensor"),
        (
            '<scene version="3.0.0"><integrator type="splats">'
            '<string name="filename" value="nowhere.ply"/></integrator></scene>',
            "nowhere.ply: cannot read the file",
        ),
        (
            '<scene version="3.0.0"><integrator type="splats">'
            '<string name="filename" value="model.ply"/></integrator>'
            '<sensor type="irradiancemeter"/></scene>',
            "the sensor must be of type perspective, thinlens, orthographic or calibrated",
        ),
        (
            '<scene version="3.0.0"><integrator type="splats"/>'
            '<sensor type="perspective"/></scene>',
            "splats: there are no Gaussians: give the integrator 'filename' or tensors",
        ),
    ],
    ids=["not XML", "empty", "model missing", "wrong sensor", "no Gaussians"],
)
def test_errors_of_a_mitsuba_scene_are_one_line(tmp_path, capsys, content, message):
    path = write_scene(tmp_path)
    path.write_text(content)
    assert message in fails(capsys, path, "--out", tmp_path / "out")


def test_options_for_gaussians_are_refused_with_a_scene(tmp_path, capsys):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    message = fails(capsys, path, "--orbit", "3", "--out", tmp_path / "out")
    assert message.startswith("--orbit: is not used with a Mitsuba scene")


@pytest.mark.parametrize("word", ["model", "=model.ply"])
def test_parameters_without_a_name_or_a_value_are_refused(tmp_path, capsys, word):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    message = fails(capsys, path, "-D", word, "--out", tmp_path / "out")
    assert message.startswith(f"argument --define/-D: must be NAME=VALUE, got {word}")


@pytest.mark.parametrize("name", ["path", "parallel", "optimize"])
def test_parameters_that_mitsubas_loader_has_itself_are_refused(tmp_path, capsys, name):
    """Also where the file has one: it cannot be given from Python."""
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    path.write_text(path.read_text().replace("model.ply", f"${name}"))
    message = fails(capsys, path, "-D", f"{name}=model.ply", "--out", tmp_path / "out")
    assert (
        message.startswith(f"argument --define/-D: the name {name} is taken")
        and "rename" in message
    )


def test_parameters_that_a_scene_file_does_not_have_are_refused(tmp_path, capsys):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    message = fails(capsys, path, "-D", "colour=1", "--out", tmp_path / "out")
    assert message.startswith(f"{path}: ") and "colour" in message


def test_it_is_a_command(fit, tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "drgs.render", fit, "--orbit", "1", "--out", tmp_path / "out"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    assert f"orbit_000: {WIDTH}x{HEIGHT}" in result.stdout
