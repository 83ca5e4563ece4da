"""Masks, depths, motion and transparency of frames."""

import json
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image
from support.datasets import edit, load, load_noting, look_at, refusal, view_at

from drgs.cameras.radial_tangential import RadialTangential
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.datasets import load_dataset
from drgs.datasets.images import smaller_view


# Data of a frame besides its photograph
def frame_of(meta, name="01.png"):
    """The frame of a photograph; frames are in another order than names."""
    return next(f for f in meta["frames"] if f["file_path"].endswith(name))


def give(folder, name="01.png", **values):
    edit(folder / "transforms.json", lambda m: frame_of(m, name).update(values))


def view_named(dataset, name="01"):
    return next(view for view in (*dataset.train, *dataset.test) if view.name == name)


def index_of(folder, name="01.png"):
    """Return the frame of a photograph in the file, as errors name it."""
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    return next(k for k, f in enumerate(frames) if f["file_path"].endswith(name))


GREY_MASK = np.array([[0, 127, 128, 255, 1, 254, 200, 100]] * 6, np.uint8)


@pytest.mark.parametrize(
    "pixels",
    [GREY_MASK, np.repeat(GREY_MASK[..., None], 3, axis=2), GREY_MASK.astype(np.uint16) * 257],
    ids=["grey", "rgb", "grey16"],
)
def test_mask_keeps_pixels_brighter_than_half(photographs, pixels):
    iio.imwrite(photographs / "mask.png", pixels)
    give(photographs, mask_path="mask.png")
    give(photographs, "08.png", mask_path="mask")  # of a test view; .png is added
    dataset = load(photographs)
    expected = np.array([[0, 0, 1, 1, 0, 1, 1, 0]] * 6)
    for name in ("01", "08"):
        mask = np.asarray(view_named(dataset, name).mask)
        assert mask.dtype == np.float32
        np.testing.assert_array_equal(mask, expected)
    assert view_named(dataset, "02").mask is None
    assert "ignored" not in dataset.description


def test_one_bit_mask_is_read(photographs):
    kept = np.random.default_rng(0).integers(0, 2, (6, 8)).astype(bool)
    rendered = Image.fromarray(kept)
    assert rendered.mode == "1"
    rendered.save(photographs / "mask.png")
    give(photographs, mask_path="mask.png")
    np.testing.assert_array_equal(view_named(load(photographs)).mask, kept)


def test_masks_may_be_ignored(photographs):
    iio.imwrite(photographs / "mask.png", GREY_MASK)
    give(photographs, mask_path="mask.png")
    dataset = load(photographs, ignore_masks=True)
    assert all(view.mask is None for view in dataset.train)
    assert dataset.description.endswith("; masks (mask_path) ignored")


def test_downscaled_mask_keeps_fully_covered_pixels(photographs):
    mask = np.full((6, 8), 255, np.uint8)
    mask[0, 0], mask[3, 5] = 0, 0
    iio.imwrite(photographs / "mask.png", mask)
    give(photographs, mask_path="mask.png")
    view = view_named(load(photographs, image_size=4))
    expected = np.ones((3, 4))
    expected[0, 0] = expected[1, 2] = 0
    np.testing.assert_array_equal(view.mask, expected)


@pytest.mark.parametrize("kind", ["mask", "depth"])
def test_an_image_of_another_size_than_the_photograph_is_refused(photographs, kind):
    key = {"mask": "mask_path", "depth": "depth_file_path"}[kind]
    iio.imwrite(photographs / "other.png", np.ones((4, 8), np.uint16))
    give(photographs, **{key: "other.png"})
    assert refusal(photographs) == (
        f"{photographs / 'other.png'}: must be 8 x 6 px, as the photograph is, got 8 x 4; "
        "resize it, or leave it out of the frame"
    )


@pytest.mark.parametrize(
    ("key", "ignore", "kind"),
    [("mask_path", "masks", "masks"), ("depth_file_path", "depth", "files of depth")],
)
def test_missing_mask_or_depth_is_reported(photographs, key, ignore, kind):
    give(photographs, **{key: "nowhere.png"})
    where = f"{photographs / 'transforms.json'}: frames[{index_of(photographs)}].{key}"
    assert refusal(photographs) == (
        f"{where}: there is no image {photographs / 'nowhere.png'} (or with .png added); put them "
        f"there, or set data.ignore_{ignore}; not there: 1 of 1 {kind}"
    )
    give(photographs, **{key: 3})
    assert refusal(photographs) == f"{where} must be text, got 3"


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
    assert view_named(dataset, "03").mask is not None and view_named(dataset, "03").depth is None
    path = photographs / "transforms.json"
    assert notes == [
        f"{path}: not there: 1 of 4 masks (gone.png); their photographs are left out",
        f"{path}: not there: 1 of 3 files of depth (gone.npy); their photographs have no depth",
    ]


def test_mask_may_be_an_alpha_channel_or_a_colour_image(photographs):
    """Transparent pixels, and those that are dark in all channels, do not count."""
    counts = np.random.default_rng(0).integers(0, 2, (6, 8)).astype(bool)
    white, zero = np.full((6, 8, 3), 255), 0 * counts
    renders = {}
    renders["01"] = Image.fromarray(np.dstack([white, 255 * counts]).astype(np.uint8))
    renders["02"] = renders["01"].convert("LA")
    renders["03"] = Image.fromarray(counts.astype(np.uint8))
    renders["03"].putpalette([0, 0, 0, 0, 128, 0])  # labels, as annotation tools write them
    renders["04"] = Image.fromarray((40_000 * counts).astype(np.uint16))
    renders["05"] = Image.fromarray(np.dstack([zero, 255 * counts, zero]).astype(np.uint8))
    for name, rendered in renders.items():
        rendered.save(photographs / f"mask{name}.png")
        give(photographs, f"{name}.png", mask_path=f"mask{name}.png")
    dataset = load(photographs)
    for name in renders:
        np.testing.assert_array_equal(view_named(dataset, name).mask, counts, err_msg=name)
    assert dataset.description.endswith("; masks of 5 of 10 photographs")


def test_a_folder_of_unnamed_masks_is_reported(photographs):
    (photographs / "masks").mkdir()
    iio.imwrite(photographs / "masks" / "01.png", GREY_MASK)
    dataset, (note,) = load_noting(photographs)
    assert view_named(dataset).mask is None
    assert note == (
        f"{photographs}: masks are not used, as no mask_path names them: masks/01.png; all pixels "
        "of the photographs count"
    )
    assert load_noting(photographs, ignore_masks=True)[1] == []


@pytest.mark.parametrize("name", ["01.png", "08.png"], ids=["train", "test"])
def test_empty_mask_is_refused(photographs, name):
    iio.imwrite(photographs / "mask.png", np.full((6, 8), 127, np.uint8))
    give(photographs, name, mask_path="mask.png")
    assert refusal(photographs) == (
        f"{photographs / 'mask.png'}: must leave pixels that count (brighter than half), got a "
        "mask without any at the width of the views; remove the view from its file, set a larger "
        "data.image_size or data.ignore_masks"
    )
    assert view_named(load(photographs, ignore_masks=True)).mask is None


def test_mask_that_is_empty_after_downscaling_is_refused(photographs):
    """One of each block of 2 x 2 pixels: none of the larger pixels counts as a whole."""
    mask = np.full((6, 8), 255, np.uint8)
    mask[::2, ::2] = 0
    iio.imwrite(photographs / "mask.png", mask)
    give(photographs, mask_path="mask.png")
    assert np.asarray(view_named(load(photographs)).mask).mean() == 0.75
    assert refusal(photographs, image_size=4) == (
        f"{photographs / 'mask.png'}: must leave pixels that count (brighter than half), got a "
        "mask without any at the width of the views; remove the view from its file, set a larger "
        "data.image_size or data.ignore_masks"
    )


def test_a_broken_mask_is_named(photographs):
    (photographs / "mask.png").write_bytes(b"no image")
    give(photographs, mask_path="mask.png")
    assert refusal(photographs).startswith(f"{photographs / 'mask.png'}: cannot read the image: ")


STEPS = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000


@pytest.mark.parametrize(
    ("place", "values", "unit"),
    [
        ("frame", {}, 1e-3),
        ("top", {"depth_unit_scale_factor": 0.25}, 0.25),
        ("frame", {"depth_unit_scale_factor": 2}, 2.0),
    ],
    ids=["default", "top", "frame"],
)
def test_integer_depths_are_multiples_of_the_unit(photographs, place, values, unit):
    iio.imwrite(photographs / "depth.png", STEPS)
    give(photographs, depth_file_path="depth.png")
    if place == "top":
        edit(photographs / "transforms.json", lambda m: m.update(values))
    else:
        give(photographs, **values)
    dataset = load(photographs)
    depth = view_named(dataset).depth
    assert depth.dtype == np.float32
    # Divided by the largest number of 16 bits and multiplied by it: two roundings, and the unit's.
    np.testing.assert_allclose(depth, STEPS * unit, rtol=4 * 6e-8)
    assert depth[0, 0] == 0  # not known
    assert view_named(dataset, "02").depth is None


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint16])
@pytest.mark.parametrize("shape", [(6, 8), (6, 8, 1)])
@pytest.mark.parametrize(
    ("values", "unit"), [({}, 1.0), ({"depth_unit_scale_factor": 0.25}, 0.25)], ids=["", "stated"]
)
def test_array_depths_are_in_scene_units_or_in_the_given_unit(
    photographs, dtype, shape, values, unit
):
    """Depths that are not finite or not positive are unknown."""
    depths = np.random.default_rng(0).uniform(5, 90, (6, 8)).astype(dtype)
    if dtype != np.uint16:
        depths[0, :5] = [np.nan, np.inf, -1, 0, np.finfo(dtype).max]
    np.save(photographs / "depth.npy", depths.reshape(shape))
    give(photographs, depth_file_path="depth.npy", **values)
    dataset = load(photographs)
    # A power of two: no rounding but that to single precision.
    with np.errstate(over="ignore"):
        expected = (depths * unit).astype(np.float32)
    expected[~(np.isfinite(expected) & (expected > 0))] = 0
    assert (expected > 0).sum() >= 43
    np.testing.assert_array_equal(view_named(dataset).depth, expected)
    assert dataset.description.endswith(f"; depth in units of {unit:g}")


def test_the_description_has_the_units_of_all_depths(photographs):
    iio.imwrite(photographs / "depth.png", STEPS)
    np.save(photographs / "depth.npy", np.ones((6, 8)))
    give(photographs, "01.png", depth_file_path="depth.png")
    give(photographs, "02.png", depth_file_path="depth.npy")
    give(photographs, "03.png", depth_file_path="depth.npy", depth_unit_scale_factor=3)
    dataset = load(photographs)
    assert dataset.description.endswith("; depth in units of 0.001 and 1 and 3")
    assert [float(view_named(dataset, name).depth[5, 7]) for name in ("02", "03")] == [1, 3]


def test_downscaled_depths_average_known_depths(photographs):
    depth = np.random.default_rng(0).uniform(1, 9, (6, 8))
    depth[1, 3] = np.nan
    np.save(photographs / "depth.npy", depth)
    give(photographs, depth_file_path="depth.npy")
    actual = view_named(load(photographs, image_size=4)).depth
    expected = np.nan_to_num(depth.reshape(3, 2, 4, 2).mean(axis=(1, 3)), nan=0)
    np.testing.assert_allclose(actual, expected, rtol=1e-6)
    assert (actual == 0).sum() == 1 and actual[0, 1] == 0


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (
            lambda path: np.save(path, np.ones((6, 8, 3))),
            "depth must be (height, width) real numbers, got shape",
        ),
        (lambda path: path.write_bytes(b"broken"), "cannot read the depth: "),
        (lambda path: path.write_bytes(b""), "cannot read the depth: "),
        (lambda path: np.save(path, np.full((6, 8), None)), "cannot read the depth: "),
    ],
    ids=["colours", "broken", "empty", "objects"],
)
def test_invalid_depth_array_is_refused(photographs, write, message):
    write(photographs / "depth.npy")
    give(photographs, depth_file_path="depth.npy")
    assert refusal(photographs).startswith(f"{photographs / 'depth.npy'}: {message}")


@pytest.mark.parametrize(
    ("pixels", "mode"),
    [(np.full((6, 8), 9, np.uint8), "L"), (np.full((6, 8, 3), 9, np.uint8), "RGB")],
    ids=["8 bits", "colours"],
)
def test_depth_image_must_have_16_bits(photographs, pixels, mode):
    """Numbers of an image of 8 bits would be read as other depths."""
    iio.imwrite(photographs / "depth.png", pixels)
    give(photographs, depth_file_path="depth.png")
    assert refusal(photographs) == (
        f"{photographs / 'depth.png'}: must be a grey image of 16 bits or an .npy file, got one "
        f"of Pillow's mode {mode}; convert it"
    )


def test_depth_may_be_ignored(photographs):
    """Then its file is not opened: there is none."""
    give(photographs, depth_file_path="nowhere.png")
    dataset = load(photographs, ignore_depth=True)
    assert all(view.depth is None for view in dataset.train)
    assert dataset.description.endswith("; depth (depth_file_path) ignored")
    assert dataset.ignored == ("depth",)


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_a_fit_without_a_depth_loss_does_not_open_depths(photographs, weight):
    give(photographs, depth_file_path="nowhere.png")
    fit = FitConfig(data={"path": str(photographs)}, loss={"depth_weight": weight})
    assert load_dataset(fit.data_for_rendering).ignored == ("depth",)
    if weight == 0:
        assert load_dataset(fit.data_for_training).ignored == ("depth",)
    else:
        with pytest.raises(UserError, match="there is no image"):
            load_dataset(fit.data_for_training)


def test_ignored_frame_data_is_listed(photographs):
    edit(photographs / "transforms.json", lambda m: m.update(k1=0.1))
    values = {"mask_path": "nowhere.png", "depth_file_path": "nowhere.png"}
    give(photographs, transform_matrix_close=np.eye(4).tolist(), **values)
    names = ("distortion", "motion", "masks", "depth")
    dataset = load(photographs, **{f"ignore_{name}": True for name in names})
    assert dataset.ignored == names
    for view in (*dataset.train, *dataset.test):
        assert (view.lens, view.motion, view.mask, view.depth) == (None,) * 4


def test_mask_of_the_file_is_the_default_of_its_frames(photographs):
    masks = np.random.default_rng(0).integers(0, 2, (2, 6, 8), np.uint8)
    for name, mask in zip(("all", "one"), masks, strict=True):
        iio.imwrite(photographs / f"{name}.png", 255 * mask)
    edit(photographs / "transforms.json", lambda m: m.update(mask_path="all.png"))
    give(photographs, "02.png", mask_path="one.png")
    dataset = load(photographs)
    for view in (*dataset.train, *dataset.test):
        np.testing.assert_array_equal(view.mask, masks[int(view.name == "02")])


def test_depth_unit_must_be_positive(photographs):
    iio.imwrite(photographs / "depth.png", STEPS)
    give(photographs, depth_file_path="depth.png", depth_unit_scale_factor=0)
    where = f"{photographs / 'transforms.json'}: frames[{index_of(photographs)}]."
    assert refusal(photographs) == f"{where}depth_unit_scale_factor must be > 0, got 0"


@pytest.mark.parametrize(
    ("place", "values", "shutter"),
    [
        ("frame", {}, "global"),
        ("frame", {"shutter": "rolling"}, "rolling"),
        ("top", {"shutter": "rolling"}, "rolling"),
    ],
)
def test_closing_pose_is_read(photographs, place, values, shutter):
    center = (3.9, 0.5, 1.1)
    give(photographs, transform_matrix_close=look_at(center, (0, 0, 0)).tolist())
    if place == "top":
        edit(photographs / "transforms.json", lambda m: m.update(values))
    else:
        give(photographs, **values)
    dataset = load(photographs)
    motion = view_named(dataset).motion
    assert motion.shutter == shutter
    np.testing.assert_allclose(motion.close_to_world[:3, 3], center)
    ahead = motion.close_to_world[:3, :3].T @ (np.zeros(3) - center)
    np.testing.assert_allclose(ahead, [0, 0, np.linalg.norm(center)], atol=1e-12)
    assert view_named(dataset, "02").motion is None
    assert motion.samples == 8
    assert view_named(load(photographs, shutter_samples=3)).motion.samples == 3
    ignored = load(photographs, ignore_motion=True)
    assert view_named(ignored).motion is None
    assert ignored.description.endswith("; motion (transform_matrix_close) ignored")


def test_shutter_without_a_closing_pose_is_static(photographs):
    edit(photographs / "transforms.json", lambda m: m.update(shutter="rolling"))
    assert all(view.motion is None for view in load(photographs).train)


def test_wrong_motion_is_refused_with_the_key(photographs):
    where = f"{photographs / 'transforms.json'}: frames[{index_of(photographs)}]."
    give(photographs, transform_matrix_close=np.diag([2, 2, 2, 1]).tolist())
    assert refusal(photographs) == (
        f"{where}transform_matrix_close must be rigid (rotation, translation, row 0 0 0 1) to "
        "0.0001: off by 3, det R is 8, got "
        "[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]"
    )
    give(photographs, transform_matrix_close=np.eye(4).tolist(), shutter="curtain")
    assert refusal(photographs) == (
        f"{where}shutter must be one of 'global' or 'rolling', got \"curtain\""
    )


def test_alpha_is_kept(photographs):
    """Only transparent photographs have an alpha channel."""
    rgba = np.random.default_rng(0).integers(0, 256, (6, 8, 4), np.uint8)
    iio.imwrite(photographs / "images" / "01.png", rgba)
    dataset = load(photographs)
    np.testing.assert_allclose(view_named(dataset).alpha, rgba[..., 3] / 255, rtol=1e-6)
    assert view_named(dataset, "02").alpha is None
    smaller = view_named(load(photographs, image_size=4))
    blocks = (rgba[..., 3] / 255).reshape(3, 2, 4, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(smaller.alpha, blocks, rtol=1e-6)


def test_alpha_of_synthetic_images_is_kept(blender):
    folder, images = blender
    for width, shape in ((None, (4, 1, 6, 1)), (3, (2, 2, 3, 2))):
        view = load(folder, image_size=width).train[1]
        expected = (images["train", 1][..., 3] / 255).reshape(shape).mean(axis=(1, 3))
        np.testing.assert_allclose(view.alpha, expected, rtol=1e-6)
    assert load(folder).test[1].alpha is None


def test_synthetic_frames_support_masks_depths_lenses_and_motion(blender):
    """Mask, depth, lens and second pose, of both splits; what is ignored is named."""
    folder, _ = blender
    close = look_at((4, 0.5, 0), (0, 0, 0)).tolist()
    mask = np.ones((4, 6), np.uint8)
    mask[0, 1] = mask[3, 3:] = 0
    iio.imwrite(folder / "mask.png", 255 * mask)
    np.save(folder / "depth.npy", np.arange(24.0).reshape(4, 6))
    values = {"mask_path": "mask.png", "depth_file_path": "depth.npy", "k1": 0.1}
    values |= {"transform_matrix_close": close, "shutter": "rolling"}
    for split in ("train", "val"):
        edit(folder / f"transforms_{split}.json", lambda m: m["frames"][1].update(values))
    dataset = load(folder, ignore_distortion=True)
    assert dataset.ignored == ("distortion",)
    assert dataset.description.endswith(
        "; lens opencv (k1) ignored; masks of 2 of 6 photographs; depth in units of 1"
    )
    assert load(folder).train[1].lens == RadialTangential.from_coefficients(k1=0.1)
    for views in (dataset.train, dataset.test):
        np.testing.assert_array_equal(views[1].mask, mask)
        np.testing.assert_array_equal(views[1].depth, np.arange(24.0).reshape(4, 6))
        assert views[1].motion.shutter == "rolling"
        np.testing.assert_allclose(views[1].motion.close_to_world[:3, 3], (4, 0.5, 0))
        for view in (views[0], views[2]):
            assert (view.lens, view.motion, view.mask, view.depth) == (None,) * 4
    smaller = load(folder, image_size=3).train[1]
    np.testing.assert_array_equal(smaller.mask, mask.reshape(2, 2, 3, 2).min(axis=(1, 3)))
    assert smaller.depth.shape == (2, 3)


def test_coarse_views_have_smaller_masks_depths_and_alpha():
    """Blocks of pixels are averaged; a block is known if all its pixels are."""
    rng = np.random.default_rng(4)
    depth = rng.uniform(1, 5, (30, 40)).astype(np.float32)
    mask = np.ones((30, 40), np.float32)
    mask[3, 7], depth[8, 9] = 0, 0
    alpha = rng.uniform(0, 1, (30, 40)).astype(np.float32)
    view = view_at((4, 0, 0), (0, 0, 0))
    view = replace(view, alpha=alpha, mask=mask, depth=depth)
    smaller = smaller_view(view, 5)

    def blocks(values):
        return values.reshape(6, 5, 8, 5).transpose(0, 2, 1, 3).reshape(6, 8, 25)

    np.testing.assert_allclose(smaller.alpha, blocks(alpha).mean(axis=2), rtol=1e-5)
    np.testing.assert_array_equal(smaller.mask, blocks(mask).min(axis=2))
    known = (blocks(depth) > 0).all(axis=2)
    expected = np.where(known, blocks(depth).mean(axis=2), 0)
    np.testing.assert_allclose(smaller.depth, expected, rtol=1e-5)
    assert np.asarray(smaller.mask).sum() == known.sum() == 47
    plain = smaller_view(view_at((4, 0, 0), (0, 0, 0)), 5)
    assert plain.alpha is plain.mask is plain.depth is None
