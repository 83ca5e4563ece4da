"""Fits of a few blobs to photographs of them, made by the float64 reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig
from drgs.datasets.images import compact_photograph
from drgs.datasets.types import Dataset, View
from drgs.effects.base import TrainingEffect
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import render_views
from drgs.io.images import to_uint8
from drgs.results.metrics import ssim
from drgs.training.trainer import Trainer
from support import small_capture as capture
from support.small_capture import WHITE, double, photograph
from support.viewer_rendering import VIEWER_RENDERING

FROZEN_GAUSSIANS = {
    "optimizer__means_lr": 1e-20,
    "optimizer__means_lr_final": 1e-20,
    **{f"optimizer__{name}_lr": 0.0 for name in ("quats", "scales", "opacities", "sh0", "shN")},
}
"""Rates of a fit that optimises only its effects."""


CAMERA_RATES = {
    "cameras__rotation_lr": 1e-3,
    "cameras__translation_lr": 2e-3,
    "cameras__focal_lr": 3e-3,
    "cameras__principal_lr": 4e-3,
}


def photometric_loss(image, target, weight=0.2) -> float:
    """(1 - w) L1 + w (1 - SSIM) in float64; SSIM's images are clipped."""
    image, target = (np.asarray(values, np.float64) for values in (image, target))
    return (1 - weight) * np.abs(image - target).mean() + weight * (1 - ssim(image, target))


@cache
def true_blobs() -> Gaussians:
    """Return the photographed blobs: numpy float32, degree 1."""
    return capture.blobs(25)


@cache
def true_dataset(background=WHITE) -> Dataset:
    """6 views to train on and 3 to measure on, with alpha, and depth where alpha is above 0.1."""
    dataset = capture.make_dataset(6, 3)
    blobs = double(true_blobs())

    def seen(view: View) -> View:
        rendered = photograph(blobs, view, background)
        opaque = rendered.alpha > 0.1
        depth = np.where(opaque, rendered.depth / np.where(opaque, rendered.alpha, 1), 0)
        renders = {"image": np.clip(rendered.image, 0, 1), "alpha": rendered.alpha, "depth": depth}
        return replace(view, **{k: v.astype(np.float32) for k, v in renders.items()})

    return replace(with_all_views(dataset, seen), background=background)


def plain_dataset() -> Dataset:
    """The same photographs and nothing besides."""
    return with_views(true_dataset(), lambda v: replace(v, alpha=None, depth=None))


def transparent_dataset(background=WHITE) -> Dataset:
    """The photographs with alpha and without depth."""
    return with_views(true_dataset(background), lambda v: replace(v, depth=None))


def two_camera_dataset(dataset: Dataset | None = None) -> Dataset:
    """Photographs, every other one by another camera with nearly the same intrinsics."""
    dataset = dataset or plain_dataset()
    train = [replace(v, cx=v.cx + 1e-4 * (k % 2)) for k, v in enumerate(dataset.train)]
    return replace(dataset, train=tuple(train))


def shifted_dataset() -> Dataset:
    """The photographs with alpha, from files of twice the size: four equal pixels each."""

    def halved(view: View) -> View:
        pixels = to_uint8(np.dstack([view.image, view.alpha]))
        large = pixels.repeat(2, axis=0).repeat(2, axis=1)
        image, alpha = compact_photograph(large, (0.0, 0.0, 0.0), view.width)
        return replace(view, image=image, alpha=alpha)

    return with_views(transparent_dataset(), halved)


def with_views(dataset: Dataset, change: Callable[[View], View]) -> Dataset:
    """Changes of the training views."""
    return replace(dataset, train=tuple(map(change, dataset.train)))


def with_all_views(dataset: Dataset, change: Callable[[View], View]) -> Dataset:
    """Changes of all views."""
    return replace(with_views(dataset, change), test=tuple(map(change, dataset.test)))


def mask_of(index: int) -> np.ndarray:
    """1 outside a rectangle that differs from view to view; none at all in the first view."""
    mask = np.ones((capture.HEIGHT, capture.WIDTH), np.float32)
    mask[2 * index : 2 * index + 12, 4 : 4 + 5 * index] = 0
    return mask


def masked(dataset: Dataset) -> Dataset:
    """Masks in all training views but the first."""
    views = [replace(v, mask=mask_of(i) if i else None) for i, v in enumerate(dataset.train)]
    return replace(dataset, train=tuple(views))


def disturbed_blobs(amount=0.15, seed=4) -> Gaussians:
    """The true blobs, moved, resized and recoloured: where a fit begins."""
    rng, blobs = np.random.default_rng(seed), true_blobs()
    scale = {"means": 0.3 * amount, "log_scales": amount, "sh0": 2 * amount}
    noise = {n: rng.normal(0, s, getattr(blobs, n).shape) for n, s in scale.items()}
    moved = {n: (getattr(blobs, n) + v).astype(np.float32) for n, v in noise.items()}
    return replace(blobs, **moved)


def config_of(**changes) -> FitConfig:
    """Return the configuration of a fit with a constant population; changes: by names such as
    ``model.smoothing``."""
    config = FitConfig(
        data={"path": "."},
        model={"sh_degree": 1, "sh_increase_every": 1, **VIEWER_RENDERING},
        densify={
            "start": 1_000_000,
            "stop": 1_000_001,
            "strategy": "adc",
            "adc": {"reset_every": 1_000_000},
        },
        iterations=400,
    )
    return with_changes(config, changes)


def make_trainer(
    dataset: Dataset, gaussians: Gaussians | None = None, room: int = 2 << 30, **changes
) -> Trainer:
    """See :func:`config_of`; ``__`` is written for the dot."""
    values = {key.replace("__", "."): value for key, value in changes.items()}
    return Trainer(config_of(**values), dataset, gaussians or disturbed_blobs(), room=room)


def with_numbers(trainer: Trainer, **values) -> Trainer:
    """Continue from other numbers of an effect, by name: rows for all views; moments stay."""
    (effect,) = trainer.effects
    state = effect.state()
    for name, value in values.items():
        key = f"{name}.value"
        state[key] = np.reshape(value, state[key].shape).astype(np.float32)
    effect.restore(state)
    return trainer


def steps(trainer: Trainer, count: int) -> Trainer:
    """After ``count`` more iterations."""
    for _ in range(count):
        trainer.step()
    return trainer


def test_psnr(trainer: Trainer, dataset: Dataset) -> float:
    """dB, mean over the views to measure on."""
    trainer.gaussians()  # the scene gets the parameters
    images = render_views(trainer.scene, dataset.test)
    pairs = zip(images, dataset.test, strict=True)
    return float(np.mean([capture.decibels(image, view.image) for image, view in pairs]))


test_psnr.__test__ = False


def everything_of(trainer: Trainer) -> dict[str, bytes]:
    """The bytes of all that a fit is."""
    return {name: value.tobytes() for name, value in trainer.state().items()}


def assert_resumes_to_the_same_bytes(make: Callable[[], Trainer], before: int, after: int) -> None:
    """A fit that is interrupted, and one that is not."""
    whole = steps(make(), before + after)
    interrupted = steps(make(), before)
    resumed = make()
    resumed.restore(interrupted.state())
    steps(resumed, after)
    expected, got = everything_of(whole), everything_of(resumed)
    assert expected.keys() == got.keys()
    differ = [name for name, value in expected.items() if got[name] != value]
    assert not differ
    begun = everything_of(interrupted)
    assert any(begun[name] != value for name, value in expected.items())


def end_view(effect: TrainingEffect, trainer: Trainer, view) -> None:
    """Let an effect take its step, as the trainer does."""
    derivatives = {name: dr.grad(leaf) for name, leaf in effect.leaves(view).items()}
    effect.after_backward(trainer.fit_state(), view, derivatives)


def gradients_of_loss(trainer: Trainer, view) -> dict[str, np.ndarray]:
    """Return gradients of the Gaussians' parameters, through the effects; no step is taken."""
    trainer.params.update(trainer.optimizer)
    image = mi.render(trainer.scene, trainer.params, sensor=view.sensor, spp=1)
    _, loss, _ = trainer.compare(image, view)
    dr.set_grad(trainer.optimizer, 0)
    dr.backward(loss)
    return {
        key: np.array(dr.grad(value)).astype(np.float64) for key, value in trainer.optimizer.items()
    }
