"""Masks, depth and random backgrounds: what is compared, against numpy; and what it is good for."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits
from support.helpers import single

from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.results.metrics import ssim
from drgs.training.effects.base import training_effects
from drgs.training.steps import view_of

# Values of order 1 in single precision: sums of 2304 numbers, SSIM's windows.
VALUE = 2e-6


def attached(values):
    """A tensor with derivatives enabled."""
    tensor = mi.TensorXf(np.asarray(values, np.float32))
    dr.enable_grad(tensor)
    return tensor


def numpy_loss(image, target, weight=0.2) -> float:
    """(1 - w) L1 + w (1 - SSIM) in float64."""
    image, target = (np.asarray(values, np.float64) for values in (image, target))
    return (1 - weight) * np.abs(image - target).mean() + weight * (1 - ssim(image, target))


def random_image(seed, *shape) -> np.ndarray:
    return single(np.random.default_rng(seed).uniform(0.05, 0.95, shape))


HEIGHT, WIDTH = 24, 32


def mask_of(index) -> np.ndarray:
    """1 outside a rectangle that differs from view to view; none at all in the first view."""
    mask = np.ones((HEIGHT, WIDTH), np.float32)
    mask[2 * index : 2 * index + 12, 4 : 4 + 5 * index] = 0
    return mask


def masked_dataset(spoiled=True, masks=True):
    """Return views whose masked pixels show something else, if ``spoiled``. One view has no
    mask."""
    dataset = fits.plain_dataset()
    views = []
    for index, view in enumerate(dataset.train):
        mask, image = mask_of(index), view.image
        if spoiled:
            image = np.where(mask[..., None] > 0, image, [1.0, 0.0, 1.0]).astype(np.float32)
        views.append(replace(view, image=image, mask=mask if masks and index else None))
    return replace(dataset, train=tuple(views))


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_loss_is_computed_on_masked_images(weight):
    trainer = fits.make_trainer(masked_dataset(), loss__dssim_weight=weight)
    for index in (0, 3):
        view, photo = trainer.views[index], masked_dataset().train[index]
        image = random_image(index, HEIGHT, WIDTH, 3)
        shown, loss, _ = trainer.compare(mi.TensorXf(image), view)
        mask = mask_of(index)[..., None]
        expected = numpy_loss(image * mask, photo.image * mask, weight)
        assert float(loss[0]) == pytest.approx(expected, rel=VALUE)
        np.testing.assert_array_equal(np.array(shown), (image * mask).astype(np.float32))
        if index:
            unmasked = numpy_loss(image, photo.image, weight)
            assert unmasked != pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_masked_pixels_have_no_derivative(weight):
    """Though SSIM's windows reach into them; all others have one."""
    trainer = fits.make_trainer(masked_dataset(), loss__dssim_weight=weight)
    for index in (0, 3):
        image = attached(random_image(index, HEIGHT, WIDTH, 3))
        _, loss, _ = trainer.compare(image, trainer.views[index])
        dr.backward(loss)
        gradient = np.array(dr.grad(image))
        left_out = mask_of(index) == 0
        assert (gradient[left_out] == 0).all()
        assert (gradient[~left_out] != 0).all()
        assert left_out.any() == (index > 0)


def test_derivatives_of_a_masked_loss_equal_central_differences():
    trainer = fits.make_trainer(masked_dataset())
    view, photo, mask = trainer.views[2], masked_dataset().train[2], mask_of(2)[..., None]
    values = random_image(2, HEIGHT, WIDTH, 3)
    image = attached(values)
    _, loss, _ = trainer.compare(image, view)
    dr.backward(loss)
    gradient = np.array(dr.grad(image)).astype(np.float64)
    rng, step = np.random.default_rng(0), 1e-6
    for flat in rng.choice(values.size, 40, replace=False):
        both = []
        for sign in (1, -1):
            moved = values.copy()
            moved.flat[flat] += sign * step
            both.append(numpy_loss(moved * mask, photo.image * mask))
        difference = (both[0] - both[1]) / (2 * step)
        # Single precision of the gradient; rounding of the loss, 1e-16, over the step.
        assert gradient.flat[flat] == pytest.approx(difference, abs=1e-4 * np.abs(gradient).max())


def test_psnr_of_an_iteration_uses_kept_pixels():
    trainer, views = fits.make_trainer(masked_dataset()), set()
    for iteration in range(1, 4):
        index = view_of(iteration, len(trainer.views), trainer.config.seed)
        trainer.params.update(trainer.optimizer)
        rendered = mi.render(trainer.scene, sensor=trainer.views[index].sensor)
        difference = np.array(dr.detach(rendered)) - masked_dataset().train[index].image
        expected = -10 * np.log10(np.mean(difference[mask_of(index) > 0] ** 2))
        assert trainer.step().psnr == pytest.approx(expected, abs=1e-4)
        views.add(index)
    assert views - {0}


def test_masked_pixels_do_not_affect_a_fit():
    """To the last bit, whatever is there."""
    states = [
        fits.everything_of(fits.steps(fits.make_trainer(masked_dataset(spoiled)), 6))
        for spoiled in (False, True)
    ]
    assert states[0] == states[1]


@pytest.mark.slow
def test_masks_keep_distractors_out_of_test_views():
    """With the masks, held-out views are about as good as from unspoiled photographs."""
    quality = {}
    for name, dataset in {
        "clean": masked_dataset(spoiled=False, masks=False),
        "masked": masked_dataset(),
        "spoiled": masked_dataset(masks=False),
    }.items():
        trainer = fits.steps(fits.make_trainer(dataset), 40)
        quality[name] = fits.test_psnr(trainer, dataset)
    assert quality["masked"] > quality["spoiled"] + 2, quality
    assert quality["masked"] > quality["clean"] - 1.5, quality


def test_a_dataset_without_masks_has_no_effect():
    config = fits.config_of()
    assert training_effects(config, fits.plain_dataset()) == []
    (effect,) = training_effects(config, masked_dataset())
    assert effect.name == "masks" and effect.state() == {}


def test_coarse_masks_drop_partially_masked_pixels():
    """A large pixel counts where all small ones do."""
    coarse = [{"until": 2, "factor": 4}]
    trainer = fits.make_trainer(masked_dataset(), coarse=coarse)
    view = trainer.stages[0].views[3]
    blocks = mask_of(3).reshape(6, 4, 8, 4).min(axis=(1, 3))
    uploaded = np.array(view.uploads["masks"])
    np.testing.assert_array_equal(uploaded, np.repeat(blocks[..., None], 3, axis=2))
    assert 0 < blocks.mean() < 1
    fits.steps(trainer, 3)


DEPTH_WEIGHT = 0.7


def depth_dataset(without=()):
    """The true photographs with depth; numbers of views that have none."""
    dataset = fits.true_dataset()
    views = [
        replace(view, alpha=None, depth=None if index in without else view.depth)
        for index, view in enumerate(dataset.train)
    ]
    return replace(dataset, train=tuple(views))


def depth_trainer(dataset=None, **changes):
    return fits.make_trainer(
        dataset or depth_dataset(), **{"loss__depth_weight": DEPTH_WEIGHT, **changes}
    )


def penalty_in_numpy(depth, alpha, photo, extent) -> float:
    """weight / extent times the mean of |D - A d| where d is known."""
    known = photo.depth > 0
    error = np.abs(depth - alpha * photo.depth)[known]
    return DEPTH_WEIGHT / extent * error.mean()


def rendered(trainer, view):
    """Return the integrator's output for a view, with derivatives."""
    trainer.params.update(trainer.optimizer)
    return mi.render(trainer.scene, trainer.params, sensor=view.sensor, spp=1)


def test_depth_penalty_matches_rendered_depth_and_alpha():
    trainer, dataset = depth_trainer(), depth_dataset()
    for index in (0, 4):
        view, photo = trainer.views[index], dataset.train[index]
        image = rendered(trainer, view)
        channels = np.array(image).astype(np.float64)
        assert channels.shape == (HEIGHT, WIDTH, 5)
        expected = numpy_loss(channels[..., :3], photo.image) + penalty_in_numpy(
            channels[..., 3], channels[..., 4], photo, dataset.extent
        )
        shown, loss, _ = trainer.compare(image, view)
        assert float(loss[0]) == pytest.approx(expected, rel=10 * VALUE)
        np.testing.assert_array_equal(np.array(shown), channels[..., :3])
        photometric = numpy_loss(channels[..., :3], photo.image)
        assert expected > 1.05 * photometric


def clear_view(dataset):
    """A training view none of whose pixels is near a threshold, its number, and its image."""
    blobs = fits.double(fits.disturbed_blobs())
    for index, photo in enumerate(dataset.train):
        rendered = fits.photograph(blobs, photo)
        if not rendered.near_threshold.any():
            return index, photo
    raise AssertionError("no clear view")


def test_gradient_of_the_depth_penalty_equals_differences_of_the_reference():
    """Along a direction of each parameter."""
    dataset = depth_dataset()
    trainer = depth_trainer()
    index, photo = clear_view(dataset)
    view = trainer.views[index]
    (effect,) = trainer.effects
    effect.adjust(rendered(trainer, view), view)
    (penalty,) = effect.penalties(view)
    dr.backward(penalty)
    start, step = fits.double(fits.disturbed_blobs()), 1e-6

    def value(gaussians) -> float:
        rendered = reference.render(gaussians, fits.reference_camera(photo))
        return penalty_in_numpy(rendered.depth, rendered.alpha, photo, dataset.extent)

    rng = np.random.default_rng(2)
    for name in PARAMETER_NAMES:
        gradient = np.array(dr.grad(trainer.optimizer[name])).astype(np.float64)
        if name in ("sh0", "shN"):
            assert (gradient == 0).all()
            continue
        # No two terms of the sum cancel.
        direction = np.sign(gradient) * np.abs(rng.normal(size=gradient.shape))
        # |x| bends where a pixel's depth is right: none is so close as this step reaches.
        both = [
            value(replace(start, **{name: getattr(start, name) + s * step * direction}))
            for s in (1, -1)
        ]
        # Single precision, as in test_rendering.
        expected = (both[0] - both[1]) / (2 * step)
        assert np.sum(direction * gradient) == pytest.approx(expected, rel=2e-4), name


@pytest.mark.parametrize(
    ("dataset", "weight"),
    [(depth_dataset, 0.0), (fits.plain_dataset, DEPTH_WEIGHT)],
    ids=["no weight", "no depth"],
)
def test_depth_channels_are_rendered_only_with_a_weight_and_depths(dataset, weight):
    trainer = fits.make_trainer(dataset(), loss__depth_weight=weight)
    assert trainer.effects == [] and trainer.integrator.state.aovs == {}
    image = rendered(trainer, trainer.views[0])
    assert image.shape == (HEIGHT, WIDTH, 3)
    plain = fits.make_trainer(fits.plain_dataset(), loss__depth_weight=0.0)
    states = [fits.everything_of(fits.steps(t, 3)) for t in (trainer, plain)]
    assert states[0] == states[1]


def test_a_view_without_depths_has_the_loss_of_its_colors():
    """And the gradients, to the last bit, of a fit without depths."""
    trainer = depth_trainer(depth_dataset(without=(2,)))
    plain = fits.make_trainer(fits.plain_dataset())
    got = fits.gradients_of_loss(trainer, trainer.views[2])
    expected = fits.gradients_of_loss(plain, plain.views[2])
    for name, values in expected.items():
        np.testing.assert_array_equal(got[name], values, err_msg=name)
    other = fits.gradients_of_loss(trainer, trainer.views[3])
    plain_other = fits.gradients_of_loss(plain, plain.views[3])
    assert np.abs(other["means"] - plain_other["means"]).max() > 0


def test_view_with_unknown_depths_only_has_no_penalty():
    dataset = depth_dataset()
    unknown = np.zeros((HEIGHT, WIDTH), np.float32)
    views = (replace(dataset.train[0], depth=unknown), *dataset.train[1:])
    trainer = depth_trainer(replace(dataset, train=views))
    assert trainer.views[0].uploads["depth"] is None
    assert trainer.views[1].uploads["depth"] is not None
    (effect,) = trainer.effects
    assert list(effect.penalties(trainer.views[0])) == []


def masked_depth_dataset(spoiled=True):
    """Masks in all views but the first; where they leave pixels out, depths are wrong."""
    views = []
    for index, view in enumerate(depth_dataset().train):
        depth, mask = view.depth, mask_of(index)
        if spoiled and index:
            depth = np.where(mask > 0, depth, 77).astype(np.float32)
        views.append(replace(view, depth=depth, mask=mask if index else None))
    return replace(depth_dataset(), train=tuple(views))


def test_depth_penalty_uses_kept_pixels():
    dataset = masked_depth_dataset()
    trainer = depth_trainer(dataset)
    effect = next(e for e in trainer.effects if e.name == "depth")
    for index in (0, 4):
        view, photo = trainer.views[index], dataset.train[index]
        image = rendered(trainer, view)
        channels = np.array(image).astype(np.float64)
        effect.adjust(image, view)
        (penalty,) = effect.penalties(view)
        kept = photo if index == 0 else replace(photo, depth=photo.depth * mask_of(index))
        known = kept.depth > 0
        expected = penalty_in_numpy(channels[..., 3], channels[..., 4], kept, dataset.extent)
        assert float(penalty[0]) == pytest.approx(expected, rel=10 * VALUE)
        assert known.any() and (index == 0 or known.sum() < (photo.depth > 0).sum())


def test_masked_depths_do_not_affect_a_fit():
    """To the last bit, whatever they say."""
    states = [
        fits.everything_of(fits.steps(depth_trainer(masked_depth_dataset(spoiled)), 6))
        for spoiled in (False, True)
    ]
    assert states[0] == states[1]


def test_view_with_all_known_depths_masked_has_no_penalty():
    dataset = depth_dataset()
    first = replace(dataset.train[0], mask=(dataset.train[0].depth == 0).astype(np.float32))
    trainer = depth_trainer(replace(dataset, train=(first, *dataset.train[1:])))
    assert trainer.views[0].uploads["depth"] is None
    assert trainer.views[1].uploads["depth"] is not None


@pytest.mark.slow
def test_depth_supervision_recovers_depths():
    """From few views that are close to each other, where colours say little about depth."""
    errors = {}
    for weight in (0.0, 2.0):
        dataset = depth_dataset()
        dataset = replace(dataset, train=dataset.train[:1])
        trainer = fits.make_trainer(dataset, loss__depth_weight=weight, optimizer__means_lr=2e-3)
        gaussians = fits.double(fits.steps(trainer, 40).gaussians())
        photo = fits.true_dataset().train[0]
        rendered = fits.photograph(gaussians, photo)
        known = (photo.depth > 0) & (rendered.alpha > 0.1)
        depth = rendered.depth[known] / rendered.alpha[known]
        errors[weight] = np.abs(depth - photo.depth[known]).mean()
    assert errors[2.0] < 0.5 * errors[0.0], errors


def test_a_fit_with_depths_and_masks_resumes_to_the_same_bytes():
    dataset = depth_dataset(without=(1,))
    views = [replace(v, mask=mask_of(i)) for i, v in enumerate(dataset.train)]
    dataset = replace(dataset, train=tuple(views))
    fits.assert_resumes_to_the_same_bytes(lambda: depth_trainer(dataset), 4, 5)


@pytest.mark.parametrize("dataset", [masked_dataset, depth_dataset], ids=["masks", "depth"])
def test_no_kernel_is_compiled_after_all_views_were_seen(dataset):
    fits.assert_no_new_kernels(fits.make_trainer(dataset()))


GREY = (0.25, 0.5, 0.75)


def transparent_dataset(background=GREY):
    return fits.with_views(fits.true_dataset(background), lambda v: replace(v, depth=None))


def random_trainer(dataset=None, **changes):
    return fits.make_trainer(
        dataset or transparent_dataset(), **{"data__random_background": True, **changes}
    )


def color_of(trainer) -> np.ndarray:
    return np.array(trainer.integrator.state.background).astype(np.float64).ravel()


def colors(trainer, count):
    """Return the backgrounds of the coming iterations."""
    found = []
    for effect in trainer.effects:
        original = effect.before_render

        def before(trainer, view, original=original):
            original(trainer, view)
            found.append(color_of(trainer))

        effect.before_render = before
    fits.steps(trainer, count)
    return np.array(found)


@pytest.mark.slow
def test_random_colors_depend_on_seed_and_iteration_only():
    first, again, other = (colors(random_trainer(seed=seed), 5) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(np.concatenate([first, other]), axis=0)) == 10
    begun = random_trainer(seed=3)
    begun.restore(fits.steps(random_trainer(seed=3), 3).state())
    np.testing.assert_array_equal(colors(begun, 2), first[3:])


@pytest.mark.slow
def test_random_colors_are_uniform_in_the_cube():
    """Their means and variances are those of uniform numbers: 1/2 and 1/12."""
    trainer = random_trainer()
    (effect,) = trainer.effects
    found = []
    for iteration in range(1, 401):
        trainer.iteration = iteration
        effect.before_render(trainer.fit_state(), trainer.views[0])
        found.append(color_of(trainer))
    fits.end_view(effect, trainer, trainer.views[0])
    found = np.array(found)
    assert found.min() >= 0 and found.max() <= 1
    # Standard errors: 0.289 / 20 = 0.0145, and 0.0037 for the variance; five of them.
    np.testing.assert_allclose(found.mean(axis=0), 0.5, atol=0.073)
    np.testing.assert_allclose(found.var(axis=0), 1 / 12, atol=0.02)


def target_of(view) -> np.ndarray:
    return np.array(view.target.image)


def test_target_is_the_transparent_image_over_the_random_color():
    """The image was composited over the dataset's background; its colours are unknown here."""
    trainer, dataset = random_trainer(), transparent_dataset()
    (effect,) = trainer.effects
    blobs = fits.double(fits.true_blobs())
    for iteration, index in ((1, 0), (2, 3)):
        view, photo = trainer.views[index], dataset.train[index]
        trainer.iteration = iteration
        effect.before_render(trainer.fit_state(), view)
        color = color_of(trainer)
        assert np.abs(color - GREY).max() > 0.1
        premultiplied = fits.photograph(blobs, photo, (0, 0, 0)).image
        expected = premultiplied + (1 - photo.alpha[..., None]) * color
        clear = (premultiplied + (1 - photo.alpha[..., None]) * np.array(GREY) <= 1).all(axis=-1)
        assert clear.mean() > 0.9  # the others were clipped when the photograph was made
        np.testing.assert_allclose(target_of(view)[clear], expected[clear], atol=4e-7)
        fits.end_view(effect, trainer, view)


def test_rendering_is_over_the_same_random_color():
    """True blobs look like the true photographs, whatever is behind them."""
    trainer = fits.make_trainer(
        transparent_dataset(), fits.true_blobs(), data__random_background=True
    )
    for _ in range(3):
        report = trainer.step()
        if report.iteration == 1:
            assert report.psnr > 60


def test_background_of_the_dataset_is_restored():
    trainer = random_trainer()
    photographs = [np.array(view.photograph.image) for view in trainer.views]
    for _ in range(4):
        trainer.step()
        np.testing.assert_allclose(color_of(trainer), GREY, rtol=1e-7)
        for view, photograph in zip(trainer.views, photographs, strict=True):
            assert view.target is view.photograph
            np.testing.assert_array_equal(target_of(view), photograph)


def test_opaque_photographs_are_refused():
    with pytest.raises(UserError) as error:
        random_trainer(fits.plain_dataset())
    assert str(error.value) == (
        "data.random_background: the photographs must be transparent where the background is to "
        "be seen, got opaque ones"
    )


def test_masked_pixels_are_black_over_any_color():
    """SSIM's windows that reach into it see the same black in both images."""
    dataset = transparent_dataset()
    views = [replace(view, mask=mask_of(index)) for index, view in enumerate(dataset.train)]
    trainer = random_trainer(replace(dataset, train=tuple(views)))
    names = [effect.name for effect in trainer.effects]
    assert names == ["background", "masks"]
    trainer.iteration = 1
    view = trainer.views[3]
    trainer.effects[0].before_render(trainer.fit_state(), view)
    left_out = mask_of(3) == 0
    assert left_out.any() and (target_of(view)[left_out] == 0).all()
    expected = trainer.views[2]
    assert (target_of(expected)[mask_of(2) > 0] > 0).all()


def test_a_fit_resumes_to_the_same_bytes():
    coarse = [{"until": 3, "factor": 2}]
    fits.assert_resumes_to_the_same_bytes(lambda: random_trainer(coarse=coarse), 2, 4)


def test_random_color_needs_no_new_kernel():
    fits.assert_no_new_kernels(random_trainer())


@pytest.mark.slow
def test_random_background_makes_background_coloured_splats_opaque():
    """White before white: only another background tells how opaque they are."""
    start = replace(
        fits.true_blobs(), logit_opacities=fits.true_blobs().logit_opacities - np.float32(3)
    )
    white = replace(
        fits.true_blobs(),
        sh0=np.full_like(fits.true_blobs().sh0, 0.5 / reference.C_00),
        shN=np.zeros_like(fits.true_blobs().shN),
    )
    start = replace(start, sh0=white.sh0, shN=white.shN)
    errors = {}
    for is_random in (False, True):
        dataset = fits.with_views(
            fits.true_dataset(),
            lambda v: replace(v, image=np.ones_like(v.image), depth=None),
        )
        trainer = fits.make_trainer(dataset, start, data__random_background=is_random)
        fits.steps(trainer, 30)
        gaussians = fits.double(trainer.gaussians())
        errors[is_random] = np.mean(
            [np.abs(fits.photograph(gaussians, v).alpha - v.alpha).mean() for v in dataset.test]
        )
    assert errors[True] < 0.5 * errors[False], errors
