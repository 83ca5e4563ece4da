"""Files of twice the size are halved in four ways, and a fit takes turns with them."""

from dataclasses import replace

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits
from support.datasets import edit, load, view_at

from drgs.config.schema import DataConfig
from drgs.datasets import load_dataset
from drgs.datasets.images import compact_photograph, shift_pixels, smaller_view, without_images
from drgs.io.images import to_uint8


def halved(view, pixels):
    image, alpha = compact_photograph(to_uint8(pixels), (0.0, 0.0, 0.0), view.width)
    return replace(view, image=image, alpha=alpha)


def test_views_of_shifted_pixels_have_what_is_on_their_rays():
    """An image of where on the film its pixels are: shifted ones look there through theirs."""
    view = replace(view_at((4, 0, 0), (0, 0, 0), 12, 8), cx=5.3, cy=4.4)
    y, x = np.mgrid[:16, :24] / 2 + 0.25  # px of the view
    ones = np.ones_like(x)
    views = shift_pixels(halved(view, np.stack([x / 12, y / 8, ones, ones], axis=2)))
    assert views[0].K.tolist() == view.K.tolist() and len(views) == 4
    for shifted in views[1:]:
        column, row = np.meshgrid(np.arange(12) + 0.5, np.arange(8) + 0.5)
        x = (column - shifted.cx) / shifted.fx * view.fx + view.cx
        y = (row - shifted.cy) / shifted.fy * view.fy + view.cy
        for found, expected in ((shifted.image[..., 0], x / 12), (shifted.image[..., 1], y / 8)):
            # The file's numbers are rounded to bytes.
            np.testing.assert_allclose(found[:-1, :-1], expected[:-1, :-1], atol=0.6 / 255)


def test_pixels_beyond_the_edge_repeat_it():
    view = view_at((4, 0, 0), (0, 0, 0), 2, 1)
    plane = np.array([[1.0, 2, 3, 4], [5, 6, 7, 8]]) / 255
    right, below, both = shift_pixels(halved(view, np.stack([plane] * 4, axis=2)))[1:]
    expected = {"right": [4.5, 6], "below": [5.5, 7.5], "both": [6.5, 8]}
    for name, shifted in (("right", right), ("below", below), ("both", both)):  # in float32
        np.testing.assert_allclose(255 * np.asarray(shifted.alpha), [expected[name]], rtol=1e-6)


def test_only_files_of_twice_the_size_with_alpha_are_shifted(blender, photographs):
    folder, images = blender
    view = load(folder, image_size=3, background=(0.2, 0.4, 0.6)).train[1]
    numbers = images["train", 1] / 255
    alpha = numbers[..., 3]
    colors = [numbers[..., c] * alpha + v * (1 - alpha) for c, v in enumerate((0.2, 0.4, 0.6))]
    whole = np.stack([*colors, alpha], axis=2)
    for found, (x, y) in zip(shift_pixels(view), ((0, 0), (1, 0), (0, 1), (1, 1)), strict=True):
        expected = whole[y : y + 2, x : x + 4].reshape(1, 2, 2, 2, 4).mean(axis=(1, 3))
        actual = np.dstack([found.image, found.alpha])  # float32
        np.testing.assert_allclose(actual[:1, :2], expected, atol=1e-6)
    views = [load(folder, image_size=size).train[1] for size in (None, 2, 4)]
    views += [load(photographs, image_size=4).train[0]]  # without alpha
    views += [smaller_view(view, 3)]
    image = np.asarray(view.image)
    views += [replace(view, image=image), replace(view, alpha=image[..., 0])]
    assert [len(shift_pixels(each)) for each in views] == [1] * 7


def test_processes_without_an_image_have_the_same_cameras(blender):
    """Images that another process has, as they are read and as they are given away."""
    config = DataConfig(path=blender[0], image_size=3)
    read, unread = load_dataset(config), load_dataset(config, lambda name: False)
    expected = [view.K.tolist() for view in shift_pixels(read.train[1])]
    for view in (unread.train[1], without_images(read.train[1])):
        assert [each.K.tolist() for each in shift_pixels(view)] == expected
        with pytest.raises(RuntimeError, match="another process"):
            np.asarray(shift_pixels(view)[3].image)


@pytest.mark.parametrize("plane", ["mask", "depth"])
def test_views_with_masks_or_depths_are_not_shifted(blender, plane):
    folder, _ = blender
    values = {"mask": np.full((4, 6), 255, np.uint8), "depth": np.full((4, 6), 1000, np.uint16)}
    iio.imwrite(folder / "plane.png", values[plane])
    names = {"mask": "mask_path", "depth": "depth_file_path"}
    first = {names[plane]: "plane.png"}
    edit(folder / "transforms_train.json", lambda meta: meta["frames"][0].update(first))
    first, second, _ = load(folder, image_size=3).train
    assert (len(shift_pixels(first)), len(shift_pixels(second))) == (1, 4)


def test_fit_takes_turns_with_the_shifted_pixels_by_round():
    """Four rounds of six views, of which one cannot be shifted; nor can coarse stages'."""
    dataset = fits.shifted_dataset()
    first, *others = dataset.train
    dataset = replace(dataset, train=(replace(first, image=np.asarray(first.image)), *others))
    trainer, seen = fits.make_trainer(dataset, coarse=[{"until": 2, "factor": 2}]), {}
    for iteration in range(1, 25):
        trainer.iteration = iteration
        view = trainer.last_step.views[-1].view
        params = mi.traverse(view.sensor)
        x, y = (params[f"principal_point_offset_{axis}"][0] for axis in "xy")
        offset = round(x * view.width, 6), round(y * view.height, 6)
        seen.setdefault(view.index, []).append(offset)
    shifts = [(0, 0), (0.5, 0), (0, 0.5), (0.5, 0.5)]
    assert seen == {0: [(0, 0)] * 4} | {index: shifts for index in range(1, 6)}
