"""Masks, depths, motion and transparency of frames."""

import io
import os
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image
from support.datasets import edit, load, load_noting, look_at, put, refusal, view_at, views_by_name

from drgs.cameras.radial_tangential import RadialTangential
from drgs.core.errors import UserError
from drgs.datasets.images import read_depth, smaller_view


def give(folder, name="01.png", **values):
    """Add values to the frame of a photograph; return how errors name the frame."""
    path, index = folder / "transforms.json", 9 - int(name[:2])  # in reverse order of names
    edit(path, lambda meta: meta["frames"][index].update(values))
    return f"{path}: frames[{index}]."


def blocks(values, factor):
    """(H, W) as (H / factor, W / factor, factor^2): the pixels of each larger pixel."""
    height, width = (size // factor for size in values.shape)
    split = values.reshape(height, factor, width, factor)
    return split.transpose(0, 2, 1, 3).reshape(height, width, factor**2)


GREY_MASK = np.array([[0, 127, 128, 255, 1, 254, 200, 100]] * 6, np.uint8)
COUNTS = GREY_MASK > 127
LABELS = Image.fromarray(COUNTS.astype(np.uint8))
LABELS.putpalette([0, 0, 0, 0, 128, 0])  # as annotation tools write them
ALPHA = np.dstack([np.full((6, 8, 3), 255, np.uint8), np.uint8(255 * COUNTS)])

MASKS = {
    "grey": Image.fromarray(GREY_MASK),
    "rgb": Image.fromarray(np.repeat(GREY_MASK[..., None], 3, axis=2)),
    "16 bits": Image.fromarray(GREY_MASK.astype(np.uint16) * 257),
    "1 bit": Image.fromarray(COUNTS),
    "alpha": Image.fromarray(ALPHA),
    "grey and alpha": Image.fromarray(ALPHA).convert("LA"),
    "labels": LABELS,
    "one channel": Image.fromarray(np.uint8(255 * COUNTS[..., None] * [0, 1, 0])),
}


@pytest.mark.parametrize("mask", MASKS.values(), ids=MASKS)
def test_mask_keeps_pixels_brighter_than_half_and_opaque(photographs, mask):
    mask.save(photographs / "mask.png")
    give(photographs, mask_path="mask.png")
    give(photographs, "08.png", mask_path="mask")  # of a test view; .png is added
    dataset = load(photographs)
    for name in ("01", "08"):
        found = np.asarray(views_by_name(dataset)[name].mask)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, COUNTS)
    assert views_by_name(dataset)["02"].mask is None
    assert dataset.description.endswith("; masks of 2 of 10 photographs")


STEPS = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
DEPTH, SCALE, CLOSE = "depth_file_path", "depth_unit_scale_factor", "transform_matrix_close"
MISSING = "there is no image {0}/nowhere.png (or with .png added); put them there, or set data."

REFUSED_FRAMES = [
    ({"mask_path": 3}, "{1}mask_path must be text, got 3"),
    ({"mask_path": "nowhere.png"}, "{1}mask_path: " + MISSING + "ignore_masks; not there: 1 of 1"),
    ({DEPTH: "nowhere.png"}, "{1}depth_file_path: " + MISSING + "ignore_depth; not there: 1 of 1"),
    ({"mask_path": "other.png"}, "{0}/other.png: must be 8 x 6 px, as the photograph is, got 8 x "),
    ({DEPTH: "other.png"}, "{0}/other.png: must be 8 x 6 px, as the photograph is, got 8 x 4; re"),
    ({"mask_path": "broken.png"}, "{0}/broken.png: cannot read the image: "),
    ({DEPTH: "8 bits.png"}, "{0}/8 bits.png: must be a grey image of 16 bits or an .npy file, go"),
    ({DEPTH: "rgb.png"}, "{0}/rgb.png: must be a grey image of 16 bits or an .npy file, got one o"),
    ({DEPTH: "16 bits.png", SCALE: 0}, "{1}depth_unit_scale_factor must be > 0, got 0"),
    ({CLOSE: np.diag([2, 2, 2, 1]).tolist()}, "{1}transform_matrix_close must be rigid (rotation,"),
    ({CLOSE: np.eye(4).tolist(), "shutter": "curtain"}, "{1}shutter must be one of 'global' or 'r"),
]


@pytest.mark.parametrize(("values", "message"), REFUSED_FRAMES)
def test_wrong_frame_data_is_refused_with_the_file_or_key(photographs, values, message):
    iio.imwrite(photographs / "other.png", np.ones((4, 8), np.uint16))
    iio.imwrite(photographs / "8 bits.png", np.ones((6, 8), np.uint8))
    iio.imwrite(photographs / "rgb.png", np.ones((6, 8, 3), np.uint8))
    iio.imwrite(photographs / "16 bits.png", STEPS)
    (photographs / "broken.png").write_bytes(b"no image")
    where = give(photographs, **values)
    assert refusal(photographs).startswith(message.format(photographs, where))


def test_missing_masks_drop_their_photographs_and_missing_depths_do_not(photographs):
    """A photograph without its mask would be fitted where it must not; one without depth can be
    used."""
    iio.imwrite(photographs / "mask.png", GREY_MASK)
    np.save(photographs / "depth.npy", np.ones((6, 8)))
    for name in ("01", "02", "03", "04"):
        give(photographs, f"{name}.png", mask_path="mask.png", depth_file_path="depth.npy")
    give(photographs, "02.png", mask_path="gone.png")
    give(photographs, "03.png", depth_file_path="gone.npy")
    dataset, notes = load_noting(photographs)
    assert [view.name for view in dataset.train] == ["01", "03", "04", "05", "06", "07", "08"]
    view = views_by_name(dataset)["03"]
    assert view.mask is not None and view.depth is None
    path = photographs / "transforms.json"
    assert notes == [
        f"{path}: not there: 1 of 4 masks (gone.png); their photographs are left out",
        f"{path}: not there: 1 of 3 files of depth (gone.npy); their photographs have no depth",
    ]


def test_depth_that_is_zero_everywhere_is_reported(photographs):
    np.save(photographs / "depth.npy", np.zeros((6, 8)))
    give(photographs, "03.png", depth_file_path="depth.npy")
    _, notes = load_noting(photographs)
    (note,) = (note for note in notes if "depth" in note)
    assert "whose depth is 0 everywhere, which means not known: 1 (images/03.png)" in note


def test_a_folder_of_unnamed_masks_is_reported(photographs):
    (photographs / "masks").mkdir()
    iio.imwrite(photographs / "masks" / "01.png", GREY_MASK)
    dataset, (note,) = load_noting(photographs)
    assert views_by_name(dataset)["01"].mask is None
    message = "masks are not used, as no mask_path names them: masks/01.png; all pixels of the ph"
    assert note.startswith(f"{photographs}: {message}")
    assert load_noting(photographs, ignore_masks=True)[1] == []


CHESSBOARD = np.full((6, 8), 255, np.uint8)
CHESSBOARD[::2, ::2] = 0


@pytest.mark.parametrize(
    ("name", "mask", "options"),
    [
        ("01.png", np.full((6, 8), 127, np.uint8), {}),
        ("08.png", np.full((6, 8), 127, np.uint8), {}),  # of a test view
        ("01.png", CHESSBOARD, {"image_size": 4}),  # none of the larger pixels counts as a whole
    ],
)
def test_empty_mask_is_refused(photographs, name, mask, options):
    iio.imwrite(photographs / "mask.png", mask)
    give(photographs, name, mask_path="mask.png")
    message = "must leave pixels that count (brighter than half), got a mask without any at the w"
    assert refusal(photographs, **options).startswith(f"{photographs / 'mask.png'}: {message}")


DEPTHS = np.random.default_rng(0).uniform(5, 90, (6, 8))
DEPTHS[0, :5] = [np.nan, np.inf, -1, 0, np.finfo(np.float64).max]


@pytest.mark.parametrize(
    ("file", "values", "top", "frame", "unit"),
    [
        ("depth.png", STEPS, {}, {}, 1e-3),
        ("depth.png", STEPS, {SCALE: 0.25}, {}, 0.25),
        ("depth.png", STEPS, {}, {SCALE: 2}, 2.0),
        ("depth.npy", DEPTHS, {}, {}, 1.0),
        ("depth.npy", DEPTHS, {}, {SCALE: 0.25}, 0.25),
    ],
)
def test_depths_are_multiples_of_the_unit(photographs, file, values, top, frame, unit):
    """Depths that are not finite or not positive are unknown."""
    write = iio.imwrite if values is STEPS else np.save
    write(photographs / file, values)
    give(photographs, depth_file_path=file, **frame)
    edit(photographs / "transforms.json", lambda meta: meta.update(top))
    dataset = load(photographs)
    depth = views_by_name(dataset)["01"].depth
    with np.errstate(over="ignore"):
        expected = (values * unit).astype(np.float32)
    expected[~(np.isfinite(expected) & (expected > 0))] = 0
    assert depth.dtype == np.float32 and (expected > 0).sum() >= 43
    # Divided by the largest number of 16 bits and multiplied by it: two roundings, and the unit's.
    np.testing.assert_allclose(depth, expected, rtol=4 * 6e-8)
    assert views_by_name(dataset)["02"].depth is None
    assert dataset.description.endswith(f"; depth in units of {unit:g}")


def test_ignored_frame_data_is_listed_and_not_opened(photographs):
    put(photographs / "transforms.json", "k1", 0.1)
    values = {"mask_path": "nowhere.png", "depth_file_path": "nowhere.png"}
    give(photographs, transform_matrix_close=np.eye(4).tolist(), **values)
    names = ("distortion", "motion", "masks", "depth")
    dataset = load(photographs, **{f"ignore_{name}": True for name in names})
    assert dataset.ignored == names
    assert dataset.description.endswith(
        "; lens opencv (k1) ignored; masks (mask_path) ignored; "
        "depth (depth_file_path) ignored; motion (transform_matrix_close) ignored"
    )
    for view in (*dataset.train, *dataset.test):
        assert (view.lens, view.motion, view.mask, view.depth) == (None,) * 4


ROLLING = {"shutter": "rolling"}


@pytest.mark.parametrize(
    ("top", "frame", "shutter"),
    [({}, {}, "global"), ({}, ROLLING, "rolling"), (ROLLING, {}, "rolling")],
)
def test_closing_pose_is_read(photographs, top, frame, shutter):
    close = look_at((3.9, 0.5, 1.1), (0, 0, 0))
    give(photographs, transform_matrix_close=close.tolist(), **frame)
    edit(photographs / "transforms.json", lambda meta: meta.update(top))
    dataset = load(photographs)
    motion = views_by_name(dataset)["01"].motion
    assert (motion.shutter, motion.samples) == (shutter, 8)
    # In OpenCV axes.
    np.testing.assert_allclose(motion.close_to_world, close * [1, -1, -1, 1], atol=1e-15)
    assert views_by_name(dataset)["02"].motion is None
    assert views_by_name(load(photographs, shutter_samples=3))["01"].motion.samples == 3


def test_synthetic_frames_support_masks_depths_lenses_and_motion(blender):
    """Both splits have them, also at another size."""
    folder, images = blender
    close = look_at((4, 0.5, 0), (0, 0, 0)).tolist()
    mask = np.ones((4, 6), np.uint8)
    mask[0, 1] = mask[3, 3:] = 0
    iio.imwrite(folder / "mask.png", 255 * mask)
    np.save(folder / "depth.npy", np.arange(24.0).reshape(4, 6))
    values = {"mask_path": "mask.png", "depth_file_path": "depth.npy", "k1": 0.1}
    values |= {CLOSE: close, "shutter": "rolling"}
    for split in ("train", "val"):
        edit(folder / f"transforms_{split}.json", lambda meta: meta["frames"][1].update(values))
    dataset = load(folder)
    assert dataset.train[1].lens == RadialTangential.from_coefficients(k1=0.1)
    for views in (dataset.train, dataset.test):
        np.testing.assert_array_equal(views[1].mask, mask)
        np.testing.assert_array_equal(views[1].depth, np.arange(24.0).reshape(4, 6))
        assert views[1].motion.shutter == "rolling"
        np.testing.assert_allclose(views[1].motion.close_to_world[:3, 3], (4, 0.5, 0))
        for view in (views[0], views[2]):
            assert (view.lens, view.motion, view.mask, view.depth) == (None,) * 4
    smaller = load(folder, image_size=3).train[1]
    np.testing.assert_array_equal(smaller.mask, blocks(mask, 2).min(axis=2))
    alpha = blocks(images["train", 1][..., 3] / 255, 2).mean(axis=2)
    np.testing.assert_allclose(smaller.alpha, alpha, rtol=1e-6)
    assert smaller.depth.shape == (2, 3)


def test_smaller_views_average_known_pixels():
    """Blocks of pixels are averaged; a block is known if all its pixels are."""
    rng = np.random.default_rng(4)
    depth = rng.uniform(1, 5, (30, 40)).astype(np.float32)
    mask = np.ones((30, 40), np.float32)
    mask[3, 7], depth[8, 9] = 0, 0
    alpha = rng.uniform(0, 1, (30, 40)).astype(np.float32)
    image = rng.uniform(0, 1, (30, 40, 3)).astype(np.float32)
    view = replace(view_at((4, 0, 0), (0, 0, 0)), image=image, cx=13.0)
    smaller = smaller_view(replace(view, alpha=alpha, mask=mask, depth=depth), 5)
    for channel in range(3):
        means = blocks(image[..., channel], 5).mean(axis=2)
        np.testing.assert_allclose(smaller.image[..., channel], means, rtol=1e-6)
    # Points on the film are at a fifth of their place, counted from the corner.
    np.testing.assert_allclose(smaller.K[:2], view.K[:2] / 5, rtol=1e-12)
    np.testing.assert_array_equal(smaller.camera_to_world, view.camera_to_world)
    np.testing.assert_allclose(smaller.alpha, blocks(alpha, 5).mean(axis=2), rtol=1e-5)
    np.testing.assert_array_equal(smaller.mask, blocks(mask, 5).min(axis=2))
    known = (blocks(depth, 5) > 0).all(axis=2)
    expected = np.where(known, blocks(depth, 5).mean(axis=2), 0)
    np.testing.assert_allclose(smaller.depth, expected, rtol=1e-5)
    assert np.asarray(smaller.mask).sum() == known.sum() == 47
    plain = smaller_view(view, 5)
    assert plain.alpha is plain.mask is plain.depth is None


def header(shape):
    stream = io.BytesIO()
    description = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, description)
    return stream.getvalue()


def archive():
    stream = io.BytesIO()
    np.savez(stream, a=np.ones(3))
    return stream.getvalue()


UNREADABLE, NO_NUMBERS = "cannot read the depth: ", "depth must be (height, width) real numbers"

INVALID_DEPTHS = {
    "of 8 TB": (header((10**6, 10**6)), UNREADABLE),
    "of more than there is": (header((2**40, 2**40)), UNREADABLE),
    "cut off": (header((4, 6)) + bytes(80), UNREADABLE),
    "no numbers": (b"hello", UNREADABLE),
    "empty": (b"", UNREADABLE),
    "of objects": (np.full((4, 6), None), UNREADABLE),
    "of several arrays": (archive(), NO_NUMBERS),
    "of text": (np.full((4, 6), "x"), NO_NUMBERS),
    "complex": (np.ones((4, 6), complex), NO_NUMBERS),
    "of records": (np.ones((4, 6), [("a", "f4")]), NO_NUMBERS),
    "of colours": (np.ones((4, 6, 3)), NO_NUMBERS),
    "of another size": (np.ones((6, 4)), "must be 6 x 4 px"),
    "a pipe": (None, f"{UNREADABLE}must be a regular file, got a named pipe"),
}


@pytest.mark.parametrize(("content", "message"), INVALID_DEPTHS.values(), ids=INVALID_DEPTHS)
def test_invalid_depth_file_is_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "a.npy"
    if content is None:
        os.mkfifo(path)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    with pytest.raises(UserError) as error:
        read_depth(path, 1.0, (6, 4))
    assert f"{path}: {message}" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["f2", "f4", "f8", ">f4", "u1", "i4"])
def test_depth_of_any_real_type_is_read(tmp_path, kind):
    values = np.arange(24).reshape(4, 6).astype(kind)
    for array in (values, values[:, :, None]):
        np.save(tmp_path / "a.npy", array)
        depth = read_depth(tmp_path / "a.npy", 0.5, (6, 4))
        np.testing.assert_array_equal(depth, values.astype(np.float32) / 2)
