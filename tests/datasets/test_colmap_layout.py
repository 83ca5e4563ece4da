"""COLMAP's layout: models, images of several sizes, masks, lenses and points to start from."""

import itertools
import math

import numpy as np
import pytest
from PIL import Image
from support.colmap_models import (
    NAMES,
    PARAMETERS,
    WRITERS,
    some_model,
    write_binary,
    write_dataset,
    write_images,
)
from support.datasets import load, load_noting, refusal, views_by_name

from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.datasets import reader
from drgs.datasets.files import masks_of
from drgs.datasets.film import to_film
from drgs.datasets.images import is_scaled
from drgs.datasets.transforms import LENS_OF_MODEL
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import start_of
from drgs.io.colmap import MODELS

HALF = np.repeat([[255, 0]], 480, axis=0).repeat(320, axis=1).astype(np.uint8)
"""A mask of which the left half counts."""


def model_of(names=NAMES, seed=1):
    return some_model(np.random.default_rng(seed), names, ["PINHOLE"])


def intrinsics(view):
    return view.fx, view.fy, view.cx, view.cy, view.width, view.height


def save(path, mask):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(path)


@pytest.mark.parametrize("below", ["sparse/0", "sparse", "colmap/sparse/0", "Sparse/0"])
@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_views_have_poses_and_intrinsics_of_the_model(tmp_path, below, write):
    model = write_dataset(tmp_path, below=below, write=write)
    dataset = load(tmp_path, test_every=3)
    assert [view.name for view in dataset.test] == ["a", "2"]
    assert [view.name for view in dataset.train] == ["b", "1"]
    poses = {name: pose for name, _, pose in model.images}
    for view in (*dataset.train, *dataset.test):
        name = view.files["image"].relative_to(tmp_path / "images").as_posix()
        np.testing.assert_allclose(view.camera_to_world, poses[name], atol=1e-14)
        assert intrinsics(view) == (600, 620, 320.5, 239, 640, 480) and view.lens is None
        level = np.asarray(view.image)[0, 0, 0] * 255
        assert level == pytest.approx(40 * NAMES.index(name), abs=3)
    assert "(COLMAP layout): 2 train views" in dataset.description
    assert dataset.background == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_intrinsics_follow_the_image_size(tmp_path):
    write_dataset(tmp_path)
    for factor in (2, 4):
        write_images(tmp_path / f"images_{factor}", size=(640 // factor, 480 // factor))
    for factor in (1, 2, 4):
        view = load(tmp_path, downscale=factor).train[0]
        expected = [value / factor for value in (600, 620, 320.5, 239, 640, 480)]
        assert intrinsics(view) == pytest.approx(expected)
    assert refusal(tmp_path, downscale=8).startswith(
        f"data.downscale: {tmp_path} has the folders images, images_2, images_4, got 8"
    )
    # The smallest that are large enough, and from there to the width that is asked for.
    for width, folder in ((640, "images"), (320, "images_2"), (100, "images_4")):
        dataset = load(tmp_path, image_size=width)
        assert f"images of {folder}" in dataset.description
        assert dataset.train[0].width == width
        assert dataset.train[0].fx == pytest.approx(600 * width / 640)
    (tmp_path / "images").rename(tmp_path / "originals")
    assert load(tmp_path).train[0].width == 320  # the largest that are there


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LENS_OF_MODEL))
def test_points_project_like_in_colmap(tmp_path, monkeypatch, name):
    """In double precision, over the image and somewhat beyond, to a few roundings of 1,000 px."""
    monkeypatch.setattr(reader, "MAX_STRETCH", 1.0)  # COLMAP's panoramas have any proportions
    pycolmap = pytest.importorskip("pycolmap")
    write_dataset(tmp_path, [name])
    theirs = pycolmap.Camera(model=name, width=640, height=480, params=PARAMETERS[name])
    points = np.random.default_rng(3).uniform((-0.7, -0.6, 1), (0.7, 0.6, 1), (50, 3))
    points *= np.linspace(0.5, 9, 50)[:, None]
    expected = theirs.img_from_cam(points)
    view = load(tmp_path).train[0]
    found = np.stack(to_film(view, points.T)[:2], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)
    coefficients = dict(zip(MODELS[name][1], PARAMETERS[name], strict=True))
    named = {k: v for k, v in coefficients.items() if k[0] in "kps"}
    assert ({} if view.lens is None else view.lens.coefficients()) == pytest.approx(named)


@pytest.mark.parametrize("name", sorted(set(PARAMETERS) - set(LENS_OF_MODEL)))
def test_other_lenses_are_refused_by_name(tmp_path, name):
    write_dataset(tmp_path, [name])
    message = refusal(tmp_path)
    assert f"is of the model {name}, which cannot be rendered" in message
    assert "colmap image_undistorter" in message


def test_masks_are_found_beside_their_images(tmp_path):
    write_dataset(tmp_path)
    save(tmp_path / "masks" / "b.jpg.png", HALF)  # as COLMAP has it
    save(tmp_path / "masks" / "cam" / "1.png", 255 - HALF)
    (tmp_path / "masks" / "c.png").touch()
    dataset, notes = load_noting(tmp_path)
    views = views_by_name(dataset)
    np.testing.assert_array_equal(views["b"].mask, HALF / 255)
    np.testing.assert_array_equal(views["1"].mask, 1 - HALF / 255)
    assert views["2"].mask is None
    assert "; masks of 2 of 4 photographs" in dataset.description
    assert notes == [
        f"{tmp_path}: all pixels count of 2 of 4 photographs, which have no mask (a.jpg, "
        "cam/2.png)",
        f"{tmp_path}: masks of no photograph that has a camera: masks/c.png (the mask of a.jpg is "
        "a.jpg.png or a.png)",
    ]
    dataset, notes = load_noting(tmp_path, ignore_masks=True)
    assert dataset.ignored == ("masks",) and notes == []
    assert all(view.mask is None for view in dataset.train)


@pytest.mark.slow
@pytest.mark.parametrize(
    "pattern",
    [
        *("masks/{0}.jpg.png", "masks/{0}.png", "masks/{0}.jpg", "MASKS/{1}.PNG", "mask/{0}.png"),
        *("masks/{0}_mask.png", "masks/{0}.png.mask.png", "masks/{1}.Mask.PNG"),
        *("masks/{0}-mask.webp", "images/{0}.mask.png", "images/{0}_mask.png"),
    ],
)
def test_common_mask_names_are_found(tmp_path, pattern):
    write_dataset(tmp_path)
    for stem, capital in (("a", "A"), ("cam/1", "cam/1")):
        save(tmp_path / pattern.format(stem, capital), HALF)
    dataset, notes = load_noting(tmp_path)
    views = views_by_name(dataset)
    for name in ("a", "1"):
        np.testing.assert_array_equal(views[name].mask, HALF / 255)
    assert len(notes) == 1 and "2 of 4 photographs, which have no mask (b.jpg" in notes[0]


def test_mask_with_the_full_name_is_preferred(tmp_path):
    (tmp_path / "masks").mkdir()
    for file in ("a.png", "a.jpg.png", "b.png", "b_mask.png"):
        (tmp_path / "masks" / file).touch()
    notes = []
    expected = [tmp_path / "masks" / name for name in ("a.jpg.png", "b.png", "b_mask.png")]
    assert masks_of(tmp_path, ["a.jpg", "b.jpg", "b_mask.jpg"], notes) == expected
    assert len(notes) == 1 and "masks of no photograph that has a camera: masks/a.png" in notes[0]


def test_masks_may_be_larger_than_images(tmp_path):
    """COLMAP's masks belong to its input images. A pixel counts where all of its area does."""
    write_dataset(tmp_path)
    write_images(tmp_path / "images_2", size=(320, 240))
    mask = np.full((480, 640), 255, np.uint8)
    mask[4:7, 10:12] = 0
    save(tmp_path / "masks" / "b.png", mask)
    expected = np.ones((240, 320))
    expected[2:4, 5] = 0
    found = views_by_name(load(tmp_path, downscale=2))["b"].mask
    np.testing.assert_array_equal(np.asarray(found), expected)
    save(tmp_path / "masks" / "b.png", mask[:, :600])
    assert "masks/b.png: must be 320 x 240 px, as the photograph is, got 600 x 480" in (
        refusal(tmp_path, downscale=2)
    )


def start(folder, **init):
    dataset = load(folder)
    config = FitConfig(data={"path": folder}, init=init)
    return start_of(resolve_defaults(config, dataset), dataset)


def test_fit_starts_from_the_points_of_the_model(tmp_path):
    """Without those of a large error or a short track, if that is asked for."""
    model, points = write_dataset(tmp_path), tmp_path / "sparse" / "0" / "points3D.bin"
    positions, colors, errors, lengths = map(np.array, zip(*model.points, strict=True))
    error, length = float(np.sort(errors)[-3]), int(np.median(lengths))
    precise, long = {"max_point_error": error}, {"min_track_length": length}
    for init, kept in (
        ({"num_points": 9}, errors > 0),
        (precise, errors <= error),
        (long, lengths >= length),
        (precise | long, (errors <= error) & (lengths >= length)),
    ):
        found, count = start(tmp_path, **init), kept.sum()
        np.testing.assert_allclose(found.means, positions[kept], rtol=1e-6)
        np.testing.assert_allclose(found.colors, colors[kept] / 255, rtol=1e-6)
        assert 4 <= count < 9 or init == {"num_points": 9}
        shown = "the points" if count == 9 else f"{count} of 9 points"
        assert found.description == f"{shown} of {points}"
    assert load(tmp_path, ignore_points=True).point_cloud is None


@pytest.mark.parametrize(
    ("init", "message"),
    [
        ({"max_point_error": 1e-9}, r"leave none of \d+ points \(their errors are"),
        ({"max_point_error": 1.0, "point_cloud": "cloud.ply"}, r"only COLMAP's .*cloud.ply"),
        ({"min_track_length": 2, "start": "random"}, r"init.min_track_length: .* other points; "),
    ],
)
def test_limits_that_leave_no_points_are_refused(tmp_path, monkeypatch, init, message):
    write_dataset(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cloud.ply").touch()
    with pytest.raises(UserError, match=message):
        start(tmp_path, **init)


@pytest.mark.parametrize(
    ("model", "images"),
    [
        ("sparse/0", "."),
        (".", "images"),
        (".", "."),
        ("dense/0/sparse", "dense/0/images"),
        ("dense/sparse", "dense/images"),
    ],
)
@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_models_and_photographs_are_found_in_common_places(tmp_path, model, images, write):
    there = model_of()
    write(tmp_path / model, there)
    write_images(tmp_path / images)
    if "dense" in model:  # beside the model of the photographs as taken
        write(tmp_path / "sparse" / "0", model_of(seed=2))
    dataset, notes = load_noting(tmp_path)
    np.testing.assert_allclose(dataset.test[0].camera_to_world, there.images[0][2], atol=1e-14)
    assert dataset.test[0].files["image"] == tmp_path / images / "a.jpg" and notes == []


@pytest.mark.parametrize(
    ("rename", "is_noted"),
    [
        (str, False),
        (str.upper, True),
        (lambda name: name.replace(".jpg", ".png").replace("1.png", "1.tif"), True),
        (lambda name: f"images/{name}", True),
        (lambda name: name.replace("/", "\\"), True),
        (lambda name: f"C:\\scans\\garden\\{name}".replace("/", "\\"), True),
    ],
    ids=["right", "case", "suffix", "images", "backslashes", "of another machine"],
)
def test_photograph_is_found_under_a_similar_name(tmp_path, rename, is_noted):
    model = model_of()
    model.images = [(rename(name), camera, pose) for name, camera, pose in model.images]
    write_binary(tmp_path / "sparse" / "0", model)
    write_images(tmp_path / "images")
    dataset, notes = load_noting(tmp_path, test_every=2)
    views = [view for pair in zip(dataset.test, dataset.train, strict=True) for view in pair]
    assert [view.files["image"] for view in views] == [tmp_path / "images" / n for n in NAMES]
    for view, (_, _, pose) in zip(views, model.images, strict=True):
        np.testing.assert_allclose(view.camera_to_world, pose, atol=1e-14)
    assert [": taken under nearly the same name: " in note for note in notes] == [True] * is_noted


@pytest.mark.parametrize("below", ["sparse/0", "."])
def test_list_selects_the_test_views(tmp_path, below):
    write_dataset(tmp_path)
    (tmp_path / below / "test.txt").write_text("\ufeff# held out\r\nb.jpg\r\ncam/2.png\r\n")
    dataset, notes = load_noting(tmp_path)
    assert [view.name for view in dataset.test] == ["b", "2"]
    assert [view.name for view in dataset.train] == ["a", "1"]
    assert "measured on 2 views (split test, by test.txt)" in dataset.description and not notes
    (tmp_path / below / "test.txt").write_text("b\nz.jpg\n")
    dataset, notes = load_noting(tmp_path)
    assert [view.name for view in dataset.test] == ["b"]
    assert len(notes) == 1 and notes[0].endswith("test.txt has names that no frame has: z.jpg")


def test_folders_define_the_splits(tmp_path):
    names = ("train/a.jpg", "test/a.jpg", "test/b.jpg", "train/c.jpg")
    write_binary(tmp_path / "sparse" / "0", model_of(names))
    write_images(tmp_path / "images", names)
    dataset = load(tmp_path)
    assert [view.name for view in dataset.test] == ["test_a", "test_b"]
    assert [view.name for view in dataset.train] == ["train_a", "train_c"]


def test_missing_images_are_left_out_unless_most_are_missing(tmp_path):
    write_dataset(tmp_path)
    (tmp_path / "images" / "b.jpg").unlink()
    dataset, notes = load_noting(tmp_path)
    assert [view.name for view in (*dataset.test, *dataset.train)] == ["a", "1", "2"]
    assert notes == [f"{tmp_path}/sparse/0: not there: 1 of 4 photographs (b.jpg); left out"]
    for name in NAMES[2:]:
        (tmp_path / "images" / name).unlink()
    message = refusal(tmp_path)
    assert "image b.jpg: there is no image" in message and "images/b.jpg" in message
    assert message.endswith("; not there: 3 of 4 photographs")


@pytest.mark.parametrize("original", [(4032, 3024), (3000, 4003), (101, 997)])
def test_scaled_images_are_distinguished_from_cropped_ones(original):
    """However their sides were rounded; a crop by three px of each is none of them."""
    width, height = original
    for factor in (1.7, 2, 4, 5.003, 8):
        rounded = ((math.floor(side / factor), math.ceil(side / factor)) for side in original)
        assert all(is_scaled(size, original) for size in itertools.product(*rounded))
        cropped = round(width / factor), round(height / factor) - 3 * math.ceil(height / width)
        assert not is_scaled(cropped, original)
    assert is_scaled(original, original) and not is_scaled((width, height - 1), original)


def test_image_rotated_after_colmap_is_rotated_by_exif(tmp_path):
    """COLMAP reads images as they are stored: where the stored size is the camera's, it is right.

    Where another program has turned what COLMAP saw, EXIF says how it is turned back.
    """
    write_dataset(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6
    for name, size in (("a.jpg", (480, 640)), ("b.jpg", (640, 480))):
        write_images(tmp_path / "images", [name], size, exif=exif)
    for name, view in views_by_name(load(tmp_path)).items():
        assert np.asarray(view.image).shape == (480, 640, 3), name


def test_exif_rotation_by_180_degrees_is_ignored_like_in_colmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    write_dataset(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 3
    pixels = np.random.default_rng(5).integers(0, 256, (480, 640, 3), np.uint8)
    path = tmp_path / "images" / "cam" / "1.png"
    Image.fromarray(pixels).save(path, exif=exif)
    read = pycolmap.Bitmap.read(str(path), True).to_array()
    image = np.asarray(views_by_name(load(tmp_path))["1"].image)
    np.testing.assert_array_equal(np.round(image * 255), read)


def without(name):
    return lambda folder: (folder / name).rename(folder / "elsewhere")


REFUSED = [
    (without("images"), "there is no folder images (or images_2, images_4, images_8)"),
    (without("sparse"), "there is no model of COLMAP in sparse/0"),
    (lambda folder: write_images(folder / "images", ["b.jpg"], (480, 640)), "was 640 x 480 px for"),
]


def test_part_of_a_panorama_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(PARAMETERS, "EQUIRECTANGULAR", (1280.0, 480.0))
    write_dataset(tmp_path, ["EQUIRECTANGULAR"])
    message = "w and h of a panorama must be its size, 640 x 480 px, got 1280 x 480; give whole"
    assert message in refusal(tmp_path)


@pytest.mark.parametrize(("change", "message"), REFUSED)
def test_incomplete_or_inconsistent_dataset_is_refused(tmp_path, change, message):
    write_dataset(tmp_path)
    change(tmp_path)
    assert message in refusal(tmp_path, type="colmap")
