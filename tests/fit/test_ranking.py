"""Ranking of training photographs: spoiled ones come first, with the cause."""

from dataclasses import replace

import numpy as np
import pytest
from support.small_capture import HEIGHT, WIDTH, decibels, make_dataset

from drgs.datasets.images import without_images
from drgs.fit.ranking import NUM_HINTS, rank_photographs

WHITE = (1.0, 1.0, 1.0)


def wave(index, shift=0.0):
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    parts = [np.sin(0.5 * (x + shift) + 0.2 * y + index + k) for k in range(3)]
    return (0.5 + 0.25 * np.stack(parts, axis=-1)).astype(np.float32)


def blurred(image):
    """Columns averaged over half a wave."""
    return np.mean([np.roll(image, k, axis=1) for k in range(-3, 4)], axis=0)


def blocked(image):
    image = image.copy()
    image[6:16, 8:20] = (0.9, 0.1, 0.1)
    return image


SPOILED = {
    3: lambda image: wave(3, shift=1.0),
    5: lambda image: image * np.float32(0.7),
    8: blurred,
    11: blocked,
}
HINTS = {
    3: "pose (off by 1.0 px)",
    5: "exposure or white balance (red, green, blue -30%, -30%, -30%)",
    8: "blurred",
    11: "something moved, or is seen here alone",
}


@pytest.fixture
def views():
    """Photographs of waves, with a little noise, four of which are spoiled."""
    rng = np.random.default_rng(0)
    found = []
    for index, view in enumerate(make_dataset(16).train):
        image = SPOILED.get(index, lambda image: image)(wave(index))
        noise = rng.normal(0, 0.01, image.shape)
        found.append(replace(view, image=(image + noise).astype(np.float32)))
    return found


def render(views):
    return [wave(int(view.name.removeprefix("r_"))) for view in views]


def test_spoiled_photographs_come_first_with_the_cause(views):
    ranked = rank_photographs(views, render, WHITE)
    assert {int(each.name[2:]) for each in ranked[:4]} == SPOILED.keys()
    for each in ranked[:4]:
        assert HINTS[int(each.name[2:])] in each.hint, each
    assert all(each.hint == "" for each in ranked[4:])
    by_name = {view.name: view for view in views}
    scores = [each.psnr for each in ranked]
    assert scores == sorted(scores)
    for each in ranked:
        (image,) = render([by_name[each.name]])
        assert each.psnr == pytest.approx(
            decibels(image, by_name[each.name].image), abs=1e-4
        )  # a mean in float32


def test_the_worst_have_images_of_both(views):
    ranked = rank_photographs(views, render, WHITE)
    assert [each.images is not None for each in ranked] == [k < NUM_HINTS for k in range(16)]
    index = int(ranked[0].name[2:])
    np.testing.assert_array_equal(ranked[0].images[:, :WIDTH], views[index].image)
    np.testing.assert_array_equal(ranked[0].images[:, WIDTH:], wave(index))


def test_fewer_photographs_than_hints_and_none(views):
    assert len(rank_photographs(views[:2], render, WHITE)) == 2
    assert rank_photographs([], render, WHITE) == []


def test_photographs_of_other_processes_are_left_out(views):
    shared = [without_images(view) if k % 2 else view for k, view in enumerate(views)]
    ranked = rank_photographs(shared, render, WHITE)
    assert sorted(each.name for each in ranked) == sorted(view.name for view in views[::2])


def test_photographs_of_one_pixel_have_no_cause():
    pixel = np.full((1, 1, 3), 0.5, np.float32)
    views = [replace(v, width=1, height=1, image=pixel) for v in make_dataset(3).train]
    ranked = rank_photographs(views, lambda views: [pixel * 0.5 for _ in views], WHITE)
    assert [each.hint for each in ranked] == ["", "", ""]
    assert ranked[0].images.shape == (1, 2, 3)


def test_large_photographs_are_measured_as_they_are_and_shown_small():
    rng = np.random.default_rng(0)
    seen, other = rng.uniform(size=(2, 180, 240, 3)).astype(np.float32)
    (view,) = make_dataset(1).train
    large = replace(view, width=240, height=180, image=seen)
    (ranked,) = rank_photographs([large], lambda views: [other for _ in views], WHITE)
    assert ranked.psnr == pytest.approx(decibels(other, seen), abs=1e-4)
    means = [image.reshape(90, 2, 120, 2, 3).mean(axis=(1, 3)) for image in (seen, other)]
    np.testing.assert_allclose(ranked.images, np.concatenate(means, axis=1), atol=1e-6)  # float32
