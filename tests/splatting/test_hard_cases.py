"""Hard inputs stay finite and as accurate as float32 can be: an image and gradients for each.

Every family is rendered and differentiated in float64 and in float32 and compared with the
float64 reference (whose analytic gradients are compared with central differences in
``test_reference_splatting.py``, and for these families below).

In float32, every pixel and every single derivative may be wrong by

    30 (noise + 2^-24 sqrt(1 + n / 25) |value|)

where *noise* is what the problem's conditioning turns one rounding everywhere into (see
``conditioning.py``), and n the number of Gaussians. 30 is lambda sqrt(k): between two places
where the model rounds once, a kernel makes at most some k = 25 roundings (from quaternion and
scales to M, M M^T, its determinant and the factor of its inverse; from a pixel's offset to alpha;
in the sums over the 16 pixels of a micro-tile and the micro-tiles of a splat), and lambda = 6 is
exceeded with a probability of 3e-8 a number. A sum over n layers has n more.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.hard_cases import FAMILIES, allowed, cotangents_of, errors_over_bounds, expected
from support.helpers import both_precisions, image_planes, kernel_gradients, render

from drgs.reference import splatting as reference

# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


all_families = pytest.mark.parametrize("name", FAMILIES)


# ----------------------------------------------------------------------------------------------
# Image and gradients of every family
# ----------------------------------------------------------------------------------------------


@both_precisions
@all_families
def test_image_and_gradients_are_within_the_bound(precision, name):
    case = FAMILIES[name]
    image_bounds, gradient_bounds = allowed(name)
    rendered, gradients = expected(name)
    marked = case.rendered.near_threshold
    assert marked.sum() <= max(2, 0.01 * marked.size)
    _, frame = render(case, precision)
    ratios = errors_over_bounds(
        image_planes(frame, case), rendered, image_bounds, precision, marked
    )
    actual = kernel_gradients(case, precision, cotangents_of(name))
    ratios |= errors_over_bounds(actual, gradients, gradient_bounds, precision)
    assert max(ratios.values()) <= 1, ratios


def test_error_bounds_are_tight():
    """A bound that allows anything proves nothing: most families have five digits or more."""
    relative = []
    for name in FAMILIES:
        bounds, values = allowed(name)[0]["image"], expected(name)[0]["image"]
        relative.append(bounds.max() / max(np.abs(values).max(), 1e-300))
    assert np.median(relative) < 2e-5 and max(relative) < 1e-2, sorted(relative)


def test_bound_distinguishes_textbook_from_stable_formulas():
    """The conic by xx yy - xy^2 in float32 loses needles: the bound tells the two apart."""
    case = FAMILIES["needles of ratio 1e6"]
    affine = reference.local_affine(case.gaussians, case.camera)
    M = affine.axes2d.astype(np.float32)
    low_pass = np.float32(0.3) * np.eye(2, dtype=np.float32)
    cov2d = M @ np.swapaxes(M, 1, 2) + low_pass
    a, b, c = cov2d[:, 0, 0], cov2d[:, 0, 1], cov2d[:, 1, 1]
    conics = np.stack([np.stack([c, -b], -1), np.stack([-b, a], -1)], -2)
    conics = conics / (a * c - b * b)[:, None, None]
    splats = reference.project(case.gaussians, case.camera)
    splats = replace(splats, conics=conics.astype(np.float64))
    colors = reference.sh_colors(case.gaussians, case.camera, case.degree)
    rendered = reference.composite(splats, colors, case.background, case.width, case.height)
    error = np.abs(rendered.image - case.rendered.image)
    assert (error > allowed(case.name)[0]["image"]).mean() > 0.05


@pytest.mark.slow
@all_families
def test_reference_gradient_is_the_slope_of_the_reference(name):
    """Central differences along a random direction of all parameters.

    Means move parallel to the film where depths are tied or a mean is at the near plane: a
    change of order or visibility has no derivative.
    """
    case = FAMILIES[name]
    cotangents, (_, gradients) = cotangents_of(name), expected(name)
    gaussians, camera = case.gaussians, case.camera
    rng = np.random.default_rng(3)
    step = 2.0**-20
    z = (gaussians.means - camera.center) @ camera.rotation[2]
    film = rng.normal(0, 1, (len(z), 3)) * np.maximum(np.abs(z), camera.near)[:, None] / camera.fx
    gaps = np.abs(np.subtract.outer(z, z)) + np.where(np.eye(len(z)), np.inf, 0)
    tied = (gaps.min(axis=1, initial=np.inf) < 100 * step) | (np.abs(z - camera.near) < 0.02)
    film[:, 2] *= np.where(tied, 0, 1)
    norms = np.linalg.norm(gaussians.quats, axis=1)
    direction = {
        "means": film @ camera.rotation,
        "quats": rng.normal(0, 0.1, (len(z), 4)) * norms[:, None],
        "log_scales": rng.normal(0, 0.1, (len(z), 3)),
        "logit_opacities": rng.normal(0, 0.1, len(z)),
        "sh0": rng.normal(0, 0.1, gaussians.sh0.shape),
        "shN": rng.normal(0, 0.1, gaussians.shN.shape),
    }  # fmt: skip

    def moved(sign):
        return {key: getattr(gaussians, key) + sign * step * d for key, d in direction.items()}

    def loss(fields):
        rendered = reference.render(
            reference.Gaussians(**fields), camera, case.background, case.rendered_degree,
            case.antialiased,
        )  # fmt: skip
        pairs = [
            (cotangents.d_image, rendered.image),
            (cotangents.d_alpha, rendered.alpha),
            (cotangents.d_depth, rendered.depth),
        ]
        return np.concatenate([np.ravel(weights * values) for weights, values in pairs])

    fields, fields_before = moved(1), moved(-1)
    after, before = loss(fields), loss(fields_before)
    slope = np.sum(after - before) / (2 * step)
    # The actual changes of the parameters: far from the origin, means move in coarse steps.
    terms = [gradients[key] * (fields[key] - fields_before[key]) / (2 * step) for key in direction]
    analytic = sum(term.sum() for term in terms)
    size = np.sqrt(sum((term**2).sum() for term in terms))
    # step^2 = 1e-12 times third derivatives of some 1e3 to 1e5, and roundings of the loss's terms,
    # one for each layer.
    rounding = 2.0**-53 * np.sqrt(len(z) * np.sum(after**2)) / step
    assert abs(slope - analytic) <= 1e-6 * size + 6 * rounding
