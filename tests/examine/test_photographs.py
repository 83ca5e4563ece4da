"""Bad photographs: found and named among views whose renderings are known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage
from support.small_capture import blobs, make_dataset, photograph

from drgs.examine.photographs import bad_photographs, look_for_bad_photographs
from drgs.results.alignment import align

GREY = (0.4, 0.4, 0.4)


@pytest.fixture(scope="module")
def clean():
    """Views whose photographs are renderings with a little noise, and these renderings."""
    scene, rng, views, images = blobs(), np.random.default_rng(0), [], []
    for view in make_dataset(24).train:
        image = photograph(scene, view, GREY).image
        noisy = np.clip(image + rng.normal(0, 0.01, image.shape), 0, 1)
        views.append(replace(view, image=noisy.astype(np.float32)))
        images.append(image)
    return views, images


def judged(views, images, held_out=slice(0, 0)):
    """A short fit with these renderings; ``held_out`` were not fitted."""
    alignments = [align(v, image, GREY) for v, image in zip(views, images, strict=True)]
    is_test = np.zeros(len(views), bool)
    is_test[held_out] = True
    parts = {True: [], False: []}
    for row in zip(views, alignments, images, is_test, strict=True):
        parts[bool(row[3])].append(row[:3])
    (test, a, b), (train, c, d) = (
        zip(*parts[key], strict=True) if parts[key] else ((), (), ()) for key in (True, False)
    )
    dataset = SimpleNamespace(train=train, test=test)
    return SimpleNamespace(dataset=dataset, alignments=a, images=b, trained=c, trained_images=d)


def blurred(views, k):
    views[k] = replace(views[k], image=ndimage.gaussian_filter(views[k].image, (1.2, 1.2, 0)))


def overexposed(views, k):
    views[k] = replace(views[k], image=np.clip(2.5 * views[k].image, 0, 1))


def swapped(views, k):
    a, b = views[k], views[k + 9]
    views[k], views[k + 9] = replace(a, image=b.image), replace(b, image=a.image)


def covered(views, k):
    image = views[k].image.copy()
    image[:10, :12] = (0.5, 0.3, 0.2)
    views[k] = replace(views[k], image=image)


def elsewhere(views, k):
    rng = np.random.default_rng(1)
    image = ndimage.gaussian_filter(rng.uniform(size=views[k].image.shape), (3, 3, 0)) * 8 - 3.5
    views[k] = replace(views[k], image=np.clip(image, 0, 1).astype(np.float32))


CASES = {
    blurred: ({3}, "blurred"),
    overexposed: ({3}, "overexposed"),
    swapped: ({3, 12}, "swapped"),
    covered: ({3}, "something before the camera"),
    elsewhere: ({3}, "of another place"),
}


@pytest.mark.parametrize("spoil", CASES)
@pytest.mark.parametrize("held_out", [slice(0, 0), slice(0, 24, 2), slice(1, 24, 2)])
def test_bad_photographs_are_named_with_the_reason(clean, spoil, held_out):
    views, images = [*clean[0]], clean[1]
    spoil(views, 3)
    bad, reason = CASES[spoil]
    found = bad_photographs(judged(views, images, held_out))
    assert found.keys() == {views[k].name for k in bad}
    assert all(why.startswith(reason) for why in found.values()), found


def test_good_photographs_are_not_named(clean):
    fit = judged(*clean)
    finding = look_for_bad_photographs(fit)
    assert not finding.is_likely and bad_photographs(fit) == {}
    assert look_for_bad_photographs(fit, among=["r_3"]) is None
    few = judged(clean[0][:5], clean[1][:5])
    assert bad_photographs(few) == {}


def test_a_reflection_inside_a_photograph_is_not_before_the_camera(clean):
    views, images = [*clean[0]], clean[1]
    image = views[3].image.copy()
    image[6:18, 6:20] += 0.5
    views[3] = replace(views[3], image=np.clip(image, 0, 1))
    fit = judged(views, images)
    assert fit.trained[3].psnr < min(each.psnr for k, each in enumerate(fit.trained) if k != 3) - 5
    assert bad_photographs(fit) == {}


def test_many_bad_photographs_are_no_single_ones(clean):
    views, images = [*clean[0]], clean[1]
    for k in range(5):
        covered(views, 4 * k)
    finding = look_for_bad_photographs(judged(views, images))
    assert len(finding.changes["data.leave_out"]) == 5 and not finding.is_likely
    assert "1 more" in finding.evidence


def test_swapped_photographs_are_found_where_all_look_alike(clean):
    ramp = np.linspace(0, 1, clean[1][0].shape[1])[None, :, None]
    views = [replace(v, image=(0.35 * v.image + 0.6 * ramp).astype(np.float32)) for v in clean[0]]
    images = [0.35 * image + 0.6 * ramp for image in clean[1]]
    swapped(views, 3)
    found = bad_photographs(judged(views, images))
    assert found.keys() == {views[3].name, views[12].name}
    assert all(why.startswith("swapped") for why in found.values()), found


def test_a_fit_without_bad_photographs_confirms_them_by_less(clean):
    """Photographs that were left out differ more from one another than those of the first fit."""
    views, images = [*clean[0]], [*clean[1]]
    rng = np.random.default_rng(2)
    noise = iter(np.geomspace(0.005, 0.03, len(images)))
    images = [image + rng.normal(0, next(noise), image.shape) for image in images]
    covered(views, 3)
    fit = judged(views, images)
    assert bad_photographs(fit) == {}
    finding = look_for_bad_photographs(fit, among=[views[3].name])
    assert finding is not None and finding.changes["data.leave_out"] == [views[3].name]
