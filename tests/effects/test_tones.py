"""Vignetting and responses, found in photographs of a floor whose tones are known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.small_capture import pose_around

from drgs.cameras.equirectangular import Equirectangular
from drgs.datasets.types import View
from drgs.effects.photometry import Photometry
from drgs.effects.tones import find_tones

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0
NUM_VIEWS = 24


def brightness(x, y):
    """Colours (..., 3) of the floor z = 0."""
    waves = np.sin(2.1 * x + 0.4), np.cos(1.7 * y), np.sin(1.3 * (x + y))
    return 0.4 + 0.12 * np.stack(waves, axis=-1)


def photographs(corners=0.0, exponents=(1.0,), reach=0.8):
    """Photographs of the floor by cameras that look at places up to ``reach`` from its middle.

    corners: share by which they are darker; exponents: of cameras, which take turns.
    """
    rng, views = np.random.default_rng(0), []
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    s = (np.square(x - WIDTH / 2) + np.square(y - HEIGHT / 2)) * 4 / (WIDTH**2 + HEIGHT**2)
    for k in range(NUM_VIEWS):
        pose = pose_around(2.4 * k, 2.0 + k % 3)
        pose[:2, 3] += rng.uniform(-reach, reach, 2)
        across, down = (x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL
        ray = np.stack([across, down, np.ones_like(x)], axis=-1) @ pose[:3, :3].T
        at = pose[:3, 3] - ray * (pose[2, 3] / ray[..., 2])[..., None]
        image = np.exp(0.1 * rng.normal()) * brightness(at[..., 0], at[..., 1])
        image = (image * (1 - corners * s[..., None])) ** exponents[k % len(exponents)]
        lens = {"fx": FOCAL + 1e-6 * (k % len(exponents)), "fy": FOCAL}
        middle = {"cx": WIDTH / 2, "cy": HEIGHT / 2, "width": WIDTH, "height": HEIGHT}
        image = np.clip(image, 0, 1).astype(np.float32)
        views.append(View(f"{k}", pose, **lens, **middle, image=image))
    return views


def floor(size=2.5):
    """Gaussians on the floor."""
    x, y = np.meshgrid(*2 * [np.linspace(-size, size, 50)])
    means = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    return SimpleNamespace(means=means, logit_opacities=np.full(len(means), 4.0))


def tones_of(views, gaussians=None, num_cameras=1):
    rows = [k % num_cameras for k in range(len(views))]
    return find_tones(views, rows, gaussians or floor())


@pytest.mark.parametrize("corners", [0.0, 0.15, 0.3])
def test_corners_are_measured_in_spite_of_exposures(corners):
    (value,), (error,) = tones_of(photographs(corners)).falloff
    # A line through log(1 - c s) is less steep where most of s is, below 0.5.
    assert value == pytest.approx(np.log1p(-corners), abs=0.03) and error < 0.01


def test_exponents_are_measured_relative_to_the_first_camera():
    found = tones_of(photographs(0.2, (1.0, 1.1)), num_cameras=2)
    np.testing.assert_allclose(found.response[0], [0, 0.1], atol=0.02)
    # Exponents make the second camera's darker, too.
    np.testing.assert_allclose(found.falloff[0], [-0.2, -0.22], atol=0.03)
    same = tones_of(photographs(0.2, (1.0, 1.0)), num_cameras=2)
    np.testing.assert_allclose(same.response[0], 0, atol=0.01)


def test_what_stays_in_the_middle_of_all_photographs_shows_no_falloff():
    assert tones_of(photographs(0.3, reach=0.0), floor(0.4)).falloff is None


def test_no_falloff_of_panoramas_and_of_few_points():
    views = photographs(0.3)
    turned = [replace(view, lens=Equirectangular()) for view in views]
    assert tones_of(turned).falloff is None
    few = SimpleNamespace(means=floor().means[:5], logit_opacities=np.full(5, 4.0))
    assert tones_of(views, few).falloff is None
    hidden = SimpleNamespace(means=floor().means, logit_opacities=np.full(2500, -4.0))
    assert tones_of(views, hidden).falloff is None


@pytest.mark.parametrize(
    ("corners", "exponents", "likely"),
    [
        (0.0, (1.0,), set()),
        (0.3, (1.0,), {"vignetting"}),
        (-0.3, (1.0,), set()),
        (0.0, (1.0, 1.1), {"response"}),
    ],
)
def test_findings_need_no_fit(corners, exponents, likely):
    views = photographs(corners, exponents)
    dataset = SimpleNamespace(test=tuple(views[:8]), train=tuple(views[8:]))
    found = Photometry.look_for(SimpleNamespace(dataset=dataset, gaussians=floor()))
    assert {each.effect for each in found if each.is_likely} == likely
    assert all(each.is_measured for each in found) and len(found) == len(exponents)
    assert found[0].changes == {"colors.vignetting_lr": 0.03}
