"""Orders of the float64 reference, and pixels that are near a decision."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.reference_lenses import gaussians_at
from support.reference_loops import MARKED_DISTANCES, UNCUT, camera_gaussian

from drgs.reference import rays
from drgs.reference import splatting as reference
from drgs.reference.rays import ImageModel


def straight_camera(focal=20.0) -> reference.Camera:
    """9 x 9 px, at the origin."""
    return reference.Camera(np.eye(3), np.zeros(3), focal, focal, 4.5, 4.5, 9, 9)


def test_splat_around_the_camera_is_invisible_in_entry_order():
    gaussians, camera = gaussians_at([0, 0, 1.0], 0.4), straight_camera()
    for extent, exists in [(2.4, True), (2.6, False)]:
        for order, alpha in [("entry", 0.5 * exists), ("pixel", 0.5)]:
            model = ImageModel("exact", order, extent=extent, low_pass=0.0)
            assert rays.render(gaussians, camera, model=model).alpha[4, 4] == alpha


def test_splats_with_their_peak_behind_the_camera_are_invisible():
    """A needle whose line passes the camera: rays to one side meet it in front, others behind."""
    camera, angle = straight_camera(focal=4.0), math.radians(80)
    quat = [math.cos(angle / 2), 0, math.sin(angle / 2), 0]
    gaussians = gaussians_at([0, 0, 0.5], [2.0, 0.05, 0.05], quats=quat)
    mean, factor = camera_gaussian(gaussians, camera, 0)
    precision = np.linalg.inv(factor @ factor.T)
    middle_row = np.column_stack([(np.arange(9) - 4) / 4, np.zeros(9), np.ones(9)])
    behind = middle_row @ precision @ mean <= 0
    assert 1 <= behind.sum() <= 5
    for projection, order in [("exact", "center"), ("exact", "pixel"), ("ewa", "pixel")]:
        model = replace(UNCUT, projection=projection, order=order, low_pass=0.0)
        alpha = rays.render(gaussians, camera, model=model).alpha[4]
        assert not alpha[behind].any() and alpha[~behind].all(), (projection, order)
    # EWA does not need depths when sorted by center.
    model = replace(UNCUT, low_pass=0.0)
    assert rays.render(gaussians, camera, model=model).alpha[4].all()


def test_ties_are_composited_by_index():
    gaussians = gaussians_at(np.tile([0, 0, 2.0], (3, 1)), colors=np.eye(3))
    for model in (
        ImageModel("ewa", "pixel"),
        ImageModel("exact", "pixel"),
        ImageModel("exact", "entry", extent=3.0),
    ):
        rendered = rays.render(gaussians, straight_camera(), model=model)
        # The middle of the film is the middle of a pixel: G = 1.
        np.testing.assert_allclose(rendered.image[4, 4], [0.5, 0.25, 0.125], rtol=0, atol=1e-15)


@pytest.mark.parametrize(("relative", "is_marked"), MARKED_DISTANCES)
def test_pixels_near_a_decision_are_marked(relative, is_marked):
    camera = straight_camera(focal=10.0)

    # At (1, 0) px from the mean of a splat of 1 px^2: rho = 1.
    one = gaussians_at([0, 0, 1.0])
    model = ImageModel(extent=math.sqrt(1 / (1 + relative)), low_pass=0.0)
    cut = rays.render(one, camera, model=model)
    assert (cut.alpha[4, 5] > 0) == (relative < 0) and not cut.near_threshold[4, 4]

    two = gaussians_at([[0, 0, 2.0], [0, 0, 2.0 * (1 + relative)]])
    ordered, by_center = (
        rays.render(two, camera, model=ImageModel("exact", order)) for order in ("pixel", "center")
    )
    assert not by_center.near_threshold[4, 4]

    around = gaussians_at([0, 0, 1.0], 0.5 * (1 + relative))
    model = ImageModel("exact", "entry", extent=2.0, low_pass=0.0)
    entered = rays.render(around, camera, model=model)
    assert (entered.alpha[4, 4] > 0) == (relative < 0)

    marks = [cut.near_threshold[4, 5], ordered.near_threshold[4, 4], entered.near_threshold[4, 4]]
    assert marks == [is_marked] * 3


def test_ambiguous_order_is_found_among_all_splats():
    gaussians = gaussians_at([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 2.0 + 1e-7]])
    camera, model = straight_camera(), ImageModel("exact", "pixel")
    assert rays.render(gaussians, camera, model=model).near_threshold[4, 4]
    apart = replace(gaussians, means=[[0, 0, 2.0], [0, 0, 2.5], [0, 0, 3.0]])
    assert not rays.render(apart, camera, model=model).near_threshold[4, 4]


def test_splats_behind_the_stop_mark_no_pixels():
    """Two clamped splats finish the pixel; a third, of alpha 0.99, is before or behind them."""
    for third, marked in [(1.0, True), (4.0, False)]:
        opacities = np.array([0.9999, 0.9999, reference.ALPHA_MAX])
        gaussians = gaussians_at([[0, 0, 2.0], [0, 0, 3.0], [0, 0, third]], opacity=opacities)
        rendered = rays.render(gaussians, straight_camera(), model=ImageModel("exact", "pixel"))
        assert rendered.transmittance[4, 4] == 1 - reference.ALPHA_MAX
        assert rendered.near_threshold[4, 4] == marked, third


def test_disabled_cuts_mark_no_pixels():
    """An alpha that underflows to 0 is not near a cut of 0, nor T = 0 near a stop of 0."""
    gaussians = replace(gaussians_at([0, 0, 1], 1e-3), logit_opacities=[2.0])
    rendered = rays.render(gaussians, straight_camera(), model=replace(UNCUT, low_pass=0.0))
    assert rendered.alpha[0, 0] == 0 and not rendered.near_threshold.any()
