"""Masks, depth and random backgrounds: what is compared, against numpy."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits
from support.helpers import single
from support.small_capture import HEIGHT, WIDTH, reference_camera
from support.small_fits import mask_of, photometric_loss

from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference

# Values of order 1 in single precision: sums of 2304 numbers, SSIM's windows.
VALUE = 2e-6

DEPTH_WEIGHT = 0.7


def random_image(seed) -> np.ndarray:
    return single(np.random.default_rng(seed).uniform(0.05, 0.95, (HEIGHT, WIDTH, 3)))


def spoiled_dataset(color=(1.0, 0.0, 1.0), depth=77):
    """Masked pixels show another colour and depth. The first view has no mask."""

    def spoil(view):
        if view.mask is None:
            return view
        kept = view.mask > 0
        image = np.where(kept[..., None], view.image, color).astype(np.float32)
        return replace(
            view, image=image, depth=np.where(kept, view.depth, depth).astype(np.float32)
        )

    return fits.with_views(fits.masked(fits.true_dataset()), spoil)


def masked_trainer(**changes):
    return fits.make_trainer(spoiled_dataset(), loss__depth_weight=0.0, **changes)


@pytest.mark.parametrize("weight", [0.0, 0.2])
def test_loss_is_computed_on_masked_images(weight):
    """Masked pixels have no derivative, though SSIM's windows reach into them; others have one."""
    trainer = masked_trainer(loss__dssim_weight=weight)
    for index in (0, 3):
        view, photo = trainer.views[index], spoiled_dataset().train[index]
        values, mask = random_image(index), mask_of(index)[..., None]
        image = mi.TensorXf(values)
        dr.enable_grad(image)
        shown, loss, _ = trainer.compare(image, view)
        expected = photometric_loss(values * mask, photo.image * mask, weight)
        assert float(loss[0]) == pytest.approx(expected, rel=VALUE)
        np.testing.assert_array_equal(np.array(shown), (values * mask).astype(np.float32))
        dr.backward(loss)
        gradient = np.array(dr.grad(image))
        np.testing.assert_array_equal(gradient != 0, np.broadcast_to(mask > 0, gradient.shape))


def test_psnr_of_an_iteration_uses_kept_pixels():
    trainer, views = masked_trainer(), set()
    for _ in range(3):
        before = [rendered(trainer, view) for view in trainer.views]
        report = trainer.step()
        index = trainer.last_step.views[-1].view.index
        difference = np.array(before[index]) - spoiled_dataset().train[index].image
        expected = -10 * np.log10(np.mean(difference[mask_of(index) > 0] ** 2))
        assert report.psnr == pytest.approx(expected, abs=1e-4)
        views.add(index)
    assert views - {0}


@pytest.mark.parametrize("weight", [0.0, DEPTH_WEIGHT], ids=["colors", "depths"])
def test_masked_pixels_do_not_affect_a_fit(weight):
    """To the last bit, whatever is there."""
    states = [
        fits.everything_of(fits.steps(fits.make_trainer(dataset, loss__depth_weight=weight), 6))
        for dataset in (spoiled_dataset(), spoiled_dataset((0.0, 1.0, 0.0), 3))
    ]
    assert states[0] == states[1]


def depth_trainer(dataset=None):
    return fits.make_trainer(dataset or fits.true_dataset(), loss__depth_weight=DEPTH_WEIGHT)


def penalty_in_numpy(depth, alpha, photo) -> float:
    """weight / extent times the mean of |D - A d| where d is known and kept."""
    known = (photo.depth > 0) & (photo.mask is None or photo.mask > 0)
    error = np.abs(depth - alpha * photo.depth)[known]
    return DEPTH_WEIGHT / fits.true_dataset().extent * error.mean()


def rendered(trainer, view):
    """Return the integrator's output for a view, with derivatives."""
    trainer.params.update(trainer.optimizer)
    return mi.render(trainer.scene, trainer.params, sensor=view.sensor, spp=1)


@pytest.mark.parametrize("dataset", [fits.true_dataset, spoiled_dataset], ids=["all", "masked"])
def test_depth_penalty_matches_rendered_depth_and_alpha(dataset):
    trainer = depth_trainer(dataset())
    for index in (0, 4):
        view, photo = trainer.views[index], dataset().train[index]
        image = rendered(trainer, view)
        channels = np.array(image).astype(np.float64)
        assert channels.shape == (HEIGHT, WIDTH, 5)
        mask = np.ones((HEIGHT, WIDTH, 1)) if photo.mask is None else photo.mask[..., None]
        photometric = photometric_loss(mask * channels[..., :3], mask * photo.image)
        penalty = penalty_in_numpy(channels[..., 3], channels[..., 4], photo)
        shown, loss, _ = trainer.compare(image, view)
        assert float(loss[0]) == pytest.approx(photometric + penalty, rel=10 * VALUE)
        np.testing.assert_allclose(np.array(shown), mask * channels[..., :3], atol=1e-7)
        assert penalty > 0.04 * photometric


def test_gradient_of_the_depth_penalty_equals_differences_of_the_reference():
    """Along a direction of each parameter."""
    trainer, step = depth_trainer(), 1e-6
    start = fits.double(trainer.gaussians())
    pairs = zip(fits.true_dataset().train, trainer.views, strict=True)
    photo, view = next(p for p in pairs if not fits.photograph(start, p[0]).near_threshold.any())
    (effect,) = trainer.effects
    effect.adjust(rendered(trainer, view), view)
    (penalty,) = effect.penalties(view)
    dr.backward(penalty)

    def value(gaussians) -> float:
        image = reference.render(gaussians, reference_camera(photo))
        return penalty_in_numpy(image.depth, image.alpha, photo)

    rng = np.random.default_rng(2)
    for name in PARAMETER_NAMES:
        gradient = np.array(dr.grad(trainer.optimizer[name])).astype(np.float64)
        if name in ("sh0", "shN"):
            assert (gradient == 0).all()
            continue
        # No two terms of the sum cancel.
        direction = np.sign(gradient) * np.abs(rng.normal(size=gradient.shape))
        moves = (getattr(start, name) + s * step * direction for s in (1, -1))
        # |x| bends where a pixel's depth is right: none is so close as this step reaches.
        after, before = (value(replace(start, **{name: values})) for values in moves)
        expected = (after - before) / (2 * step)
        # Single precision, as in test_rendering.
        assert np.sum(direction * gradient) == pytest.approx(expected, rel=2e-4), name


@pytest.mark.parametrize(
    ("dataset", "weight"),
    [(fits.true_dataset, 0.0), (fits.plain_dataset, DEPTH_WEIGHT)],
    ids=["no weight", "no depth"],
)
def test_depth_channels_are_rendered_only_with_a_weight_and_depths(dataset, weight):
    trainer = fits.make_trainer(dataset(), loss__depth_weight=weight)
    assert trainer.effects == [] and trainer.integrator.state.aovs == {}
    assert rendered(trainer, trainer.views[0]).shape == (HEIGHT, WIDTH, 3)


NO_DEPTHS = {
    "none": lambda view: replace(view, depth=None),
    "unknown": lambda view: replace(view, depth=np.zeros((HEIGHT, WIDTH), np.float32)),
    "masked": lambda view: replace(view, mask=(view.depth == 0).astype(np.float32)),
}


@pytest.mark.parametrize("change", NO_DEPTHS.values(), ids=NO_DEPTHS)
def test_view_without_known_depths_has_no_penalty(change):
    views = fits.true_dataset().train
    trainer = depth_trainer(replace(fits.true_dataset(), train=(change(views[0]), *views[1:])))
    effect = next(effect for effect in trainer.effects if effect.name == "depth")
    assert list(effect.penalties(trainer.views[0])) == []
    assert trainer.views[1].uploads["depth"] is not None


GREY = (0.25, 0.5, 0.75)


def random_trainer(dataset=None, **changes):
    return fits.make_trainer(
        dataset or fits.transparent_dataset(GREY), data__random_background=True, **changes
    )


def color_of(trainer) -> np.ndarray:
    return np.array(trainer.integrator.state.background).astype(np.float64).ravel()


def random_colors(trainer, iterations) -> np.ndarray:
    """Return the backgrounds of these iterations."""
    effect, found = trainer.effects[0], []
    for iteration in iterations:
        trainer.iteration = iteration
        effect.before_render(trainer.fit_state(), trainer.views[0])
        found.append(color_of(trainer))
        fits.end_view(effect, trainer, trainer.views[0])
    return np.array(found)


@pytest.mark.slow
def test_random_colors_are_uniform_and_depend_on_seed_and_iteration_only():
    """Their means and variances are those of uniform numbers: 1/2 and 1/12."""
    first, other = (random_colors(random_trainer(seed=s), range(1, 401)) for s in (3, 4))
    np.testing.assert_array_equal(random_colors(random_trainer(seed=3), (3, 4)), first[2:4])
    assert len(np.unique(np.concatenate([first, other]), axis=0)) == 800
    assert first.min() >= 0 and first.max() <= 1
    # Standard errors: 0.289 / 20 = 0.0145, and 0.0037 for the variance; five of them.
    np.testing.assert_allclose(first.mean(axis=0), 0.5, atol=0.073)
    np.testing.assert_allclose(first.var(axis=0), 1 / 12, atol=0.02)


def test_target_is_the_transparent_image_over_the_random_color():
    """The image was composited over the dataset's background; its colours are unknown here."""
    trainer, dataset = random_trainer(), fits.transparent_dataset(GREY)
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
        target = np.array(view.target.image)
        np.testing.assert_allclose(target[clear], expected[clear], atol=4e-7)
        fits.end_view(effect, trainer, view)


def test_background_of_the_dataset_is_restored():
    """Rendered over the random colour, true blobs look like the true photographs."""
    trainer = fits.make_trainer(
        fits.transparent_dataset(GREY), fits.true_blobs(), data__random_background=True
    )
    assert trainer.step().psnr > 60
    np.testing.assert_allclose(color_of(trainer), GREY, rtol=1e-7)
    assert all(view.target is view.photograph for view in trainer.views)


def test_opaque_photographs_are_refused():
    with pytest.raises(UserError, match=r"^data\.random_background: .* must be transparent where"):
        random_trainer(fits.plain_dataset())


def test_masked_pixels_are_black_over_any_color():
    """SSIM's windows that reach into it see the same black in both images."""
    trainer = random_trainer(fits.masked(fits.transparent_dataset(GREY)))
    assert [effect.name for effect in trainer.effects] == ["background", "masks"]
    view = trainer.views[3]
    trainer.effects[0].before_render(trainer.fit_state(), view)
    target = np.array(view.target.image)
    np.testing.assert_array_equal(target.any(axis=-1), mask_of(3) > 0)
