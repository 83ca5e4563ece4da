"""Lenses against the float64 reference: what they see, pictures, gradients; and by themselves."""

import math
from dataclasses import replace
from itertools import pairwise

import drjit as dr
import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Cotangents,
    assert_arrays_agree,
    assert_pictures_agree,
    both_precisions,
    clear,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
    picture_of,
    plane_cotangents,
    rows,
    single,
)
from support.kernels import drain_kernels
from support.lens_scenes import (
    LENSES,
    LensCase,
    camera_behind,
    directions,
    gaussians_at_points,
    kernel_lens,
    lens_camera,
    moved,
    points_at,
    points_near_the_end,
)
from test_reference_effects import camera_at_origin, gaussians_at, whitened_samples
from test_reference_splatting import numeric_gradients

from drgs.accuracy.pipeline import pipeline_of
from drgs.accuracy.unscented import unscented_shape
from drgs.cameras import fisheye, orthographic, polynomials
from drgs.cameras.radial_tangential import RadialTangential
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import effects
from drgs.reference import splatting as reference
from drgs.reference.effects import Fisheye, OpenCV, Orthographic
from drgs.splatting import rendering
from drgs.splatting.projection import ewa, load_rows, plain_opacity, project

every_lens = pytest.mark.parametrize("name", LENSES)

FORMS = ("rational", "barrel", "fisheye", "orthographic")
"""One of each form; of a barrel, pixels that show nothing. Where Dr.Jit differentiates, or kernels
take long to compile, the others, which are these without some terms, tell no more."""

every_form = pytest.mark.parametrize("name", FORMS)
antialiased_too = pytest.mark.parametrize(
    ("name", "antialiased"),
    [(name, False) for name in LENSES] + [(name, True) for name in ("rational", "fisheye")],
)
every_opencv = pytest.mark.parametrize(
    "name", [name for name, lens in LENSES.items() if isinstance(lens, OpenCV)]
)

# Relative to the largest value of each array.
#
# float64: the reference's J, by differences, is off by 1e-13 of itself. Measured 4e-13.
#
# float32: as in test_rendering, and a few roundings more on the way to the film.
PICTURE = {FLOAT64: 1e-11, FLOAT32: 2e-5}


# ----------------------------------------------------------------------------------------------
# Pictures
# ----------------------------------------------------------------------------------------------


def large_scene(case, rng):
    """Splats as large as the film, most with their means beside it."""
    camera = camera_behind(case, rng)
    size = np.array([case.width, case.height])
    film = rng.uniform(-0.4, 1.4, (case.count, 2)) * size
    distances = rng.uniform(1, 3, case.count)
    points = points_at(case.lens, camera, film, distances)
    near_the_end = points_near_the_end(case.lens, camera, film, distances)
    points = np.where(np.isnan(points), near_the_end, points)
    sizes = rng.uniform(0.1, 0.8, (case.count, 3)) * max(size)
    logits = rng.normal(-1.0, 1.0, case.count)
    return gaussians_at_points(case, rng, camera, points, sizes, logits), camera


def case_of(name, **others) -> LensCase:
    """Wide films, and tall ones of another degree, antialiased."""
    return LensCase(name, 37, 29, 1, lens=LENSES[name], **others)


@both_precisions
@antialiased_too
def test_picture_equals_the_reference(precision, name, antialiased):
    case = clear(case_of(name, antialiased=antialiased))
    _, frame = case.render(precision)
    assert_pictures_agree(picture_of(frame, case), case.picture, PICTURE[precision])


@both_precisions
@every_lens
def test_tiles_hold_all_that_large_splats_reach(precision, name):
    """The reference evaluates every splat at every pixel."""
    case = clear(case_of(name, recipe=large_scene, count=20))
    _, frame = case.render(precision)
    assert_pictures_agree(picture_of(frame, case), case.picture, PICTURE[precision])
    splats = effects.project(*case.scene, case.lens)
    x, y = splats.means2d[splats.visible].T
    beside = (x < 0) | (y < 0) | (x > case.width) | (y > case.height)
    assert beside.sum() >= 5 and (case.picture.alpha > 0.5).mean() > 0.3


@every_lens
def test_a_lens_changes_the_picture(name):
    """Otherwise the tests above would compare a pinhole with itself."""
    case = clear(case_of(name))
    plain = reference.render(*case.scene, case.background)
    assert np.abs(plain.image - case.picture.image).max() > 0.01


# ----------------------------------------------------------------------------------------------
# Derivatives
# ----------------------------------------------------------------------------------------------

# Central differences with a step of 1e-6: the reference's J carries noise of 1e-13, so that a
# quotient is off by 1e-7 of its largest terms; curvature adds less. Measured: 4e-8.
DIFFERENCES = 1e-6

# Those of test_rendering.
GRADIENTS = {FLOAT64: 1e-12, FLOAT32: 5e-5}


def kernel_gradients(case, precision, cotangents, pipeline=None) -> dict[str, np.ndarray]:
    gaussians, frame = case.render(precision, pipeline)
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)
    gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
    return {n: np.array(getattr(gradients.parameters, n)) for n in PARAMETER_NAMES}


def keep_bounds(case, monkeypatch) -> None:
    """The camera stays: what its film sees is looked for once, not for each difference."""
    bounds = case.lens.slope_bounds(case.camera)
    monkeypatch.setattr(type(case.lens), "slope_bounds", lambda *_: bounds)


@pytest.mark.parametrize("name", ["rational", "fisheye", "orthographic"])
def test_each_number_of_the_gradients_equals_a_difference_of_the_reference(name, monkeypatch):
    """One splat is on the axis, one so far beside the film that its slopes may be clamped."""
    lens = LENSES[name]
    case = clear(LensCase("tiny", 13, 11, 1, 5, lens=lens, recipe=tiny_scene, threshold_width=5e-4))
    cotangents = Cotangents.random(case)
    keep_bounds(case, monkeypatch)
    weights = [cotangents.d_image, cotangents.d_alpha, cotangents.d_depth]

    def outputs(**parameters):
        picture = case.reference_picture(reference.Gaussians(**parameters))
        return [picture.image, picture.alpha, picture.depth]

    parameters = {n: getattr(case.gaussians, n) for n in PARAMETER_NAMES}
    expected = numeric_gradients(outputs, weights, parameters)
    actual = kernel_gradients(case, FLOAT64, cotangents)
    assert_arrays_agree(actual, expected, DIFFERENCES)
    # The comparison notices one percent, in every array.
    for parameter, values in actual.items():
        with pytest.raises(AssertionError, match=rf"{parameter}\["):
            assert_arrays_agree({**actual, parameter: 1.01 * values}, expected, DIFFERENCES)


def tiny_scene(case, rng):
    camera = camera_behind(case, rng)
    size = np.array([case.width, case.height])
    film = rng.uniform(0.2, 0.8, (case.count, 2)) * size
    film[0], film[1] = (camera.cx, camera.cy), size * [1.5, 0.4]
    distances = rng.uniform(1, 3, case.count)
    points = points_at(case.lens, camera, film, distances)
    near_the_end = points_near_the_end(case.lens, camera, film, distances)
    points = np.where(np.isnan(points), near_the_end, points)
    sizes = rng.uniform(0.7, 3.0, (case.count, 3))
    sizes[1] = 0.5 * max(size)
    logits = rng.normal(0, 1, case.count)
    return gaussians_at_points(case, rng, camera, points, sizes, logits), camera


@pytest.mark.parametrize(
    ("name", "antialiased"),
    [(name, False) for name in (*FORMS, "plain fisheye")] + [("rational", True), ("fisheye", True)],
)
def test_gradients_equal_differences_of_the_reference_along_a_direction(
    name, antialiased, monkeypatch
):
    """Of each parameter; in larger scenes, without the pixels that a step may take to a jump."""
    case = clear(case_of(name, antialiased=antialiased, threshold_width=1e-3))
    cotangents = Cotangents.random(case, seed=2)
    keep_bounds(case, monkeypatch)
    gradients = kernel_gradients(case, FLOAT64, cotangents)
    step = 1e-6
    for parameter, direction in directions(case.gaussians, seed=3).items():
        forward, backward = (
            case.reference_picture(moved(case.gaussians, direction, sign * step))
            for sign in (1, -1)
        )
        expected = sum(
            np.sum(getattr(cotangents, f"d_{n}") * (getattr(forward, n) - getattr(backward, n)))
            for n in ("image", "alpha", "depth")
        ) / (2 * step)
        terms = getattr(direction, parameter) * gradients[parameter]
        # A sum of terms of both signs: relative to their size.
        assert abs(terms.sum() - expected) <= DIFFERENCES * np.abs(terms).sum(), parameter


@both_precisions
@every_form
def test_adjoint_is_the_transpose_of_the_tangent(precision, name):
    case = clear(case_of(name))
    cotangents = Cotangents.random(case, seed=4)
    gradients = kernel_gradients(case, precision, cotangents)
    gaussians, frame = case.render(precision)
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)
    weights = np.array([rows(d) for d in (d_transmittance, *d_features)])
    for parameter, direction in directions(case.gaussians, seed=5).items():
        tangents = device_gaussians(direction, precision)
        planes = frame_tangent(gaussians, frame, tangents)
        left = weights * np.array([rows(plane) for plane in planes])
        right = getattr(direction, parameter) * gradients[parameter]
        size = np.abs(left).sum() + np.abs(right).sum()
        # Sums of thousands of terms, each as accurate as the arrays are.
        assert abs(left.sum() - right.sum()) <= GRADIENTS[precision] / 5 * size, parameter


@every_form
def test_single_precision_gradients_equal_double_precision(name):
    case = clear(case_of(name))
    cotangents = Cotangents.random(case)
    expected = kernel_gradients(case, FLOAT64, cotangents)
    assert_arrays_agree(kernel_gradients(case, FLOAT32, cotangents), expected, GRADIENTS[FLOAT32])


# ----------------------------------------------------------------------------------------------
# What is seen
# ----------------------------------------------------------------------------------------------


def splats_of(gaussians, camera, lens, precision, shape=ewa, low_pass=0.3, degree=0):
    """Projected by the kernels."""
    parameter_rows = load_rows(device_gaussians(gaussians, precision), degree)
    camera = lens_camera(camera, lens, precision)
    return project(parameter_rows, camera, degree, plain_opacity, shape, low_pass=low_pass)


def covariances(splats) -> np.ndarray:
    """(N, 2, 2), px^2."""
    p, r, s = rows(splats.whitening).T
    factors = np.moveaxis(np.array([[p, r], [np.zeros_like(s), s]]), -1, 0)
    return np.linalg.inv(np.swapaxes(factors, 1, 2) @ factors)


# Of positions up to thousands of px and of covariances: J by differences, 1e-13; and float32.
SPLATS = {FLOAT64: 1e-11, FLOAT32: 1e-5}


@both_precisions
@pytest.mark.parametrize("name", ["plain fisheye", "fisheye"])
def test_a_fisheye_sees_from_the_axis_to_behind_the_camera(precision, name):
    """On the axis, at angles from 1e-12 up, where the series end (17.5 degrees), beside, behind."""
    lens, camera = LENSES[name], camera_at_origin()
    at = np.arctan(np.sqrt(fisheye.NEAR_AXIS)) + np.array([-1e-3, -1e-6, 1e-6, 1e-3])
    angles = np.concatenate(
        [[0], 10.0 ** np.arange(-12, 0), at, np.linspace(0.05, 0.99, 30) * lens.valid_angle]
    )
    azimuths = np.linspace(0, 6, len(angles))
    sines = np.sin(angles)
    points = np.stack([sines * np.cos(azimuths), sines * np.sin(azimuths), np.cos(angles)], -1)
    distances = np.random.default_rng(0).uniform(0.5, 3, len(angles))
    points = single(points * distances[:, None])
    assert (points[:, 2] < -0.5).sum() >= 3 or lens.valid_angle < 2
    quats = np.random.default_rng(1).normal(size=(len(points), 4))
    gaussians = replace(gaussians_at(points, [[0.1, 0.2, 0.05]]), quats=single(quats))
    gaussians = replace(gaussians, log_scales=single(gaussians.log_scales))
    expected = effects.project(gaussians, camera, lens)
    splats = splats_of(gaussians, camera, lens, precision)
    assert np.array(splats.visible).all() and expected.visible.all()
    tolerance = SPLATS[precision]
    np.testing.assert_allclose(rows(splats.means2d), expected.means2d, atol=tolerance * 1000)
    np.testing.assert_allclose(rows(splats.depths), expected.depths, rtol=tolerance)
    size = np.abs(expected.cov2d).max(axis=(1, 2), keepdims=True)
    errors = np.abs(covariances(splats) - expected.cov2d) / size
    assert errors.max() < tolerance, np.argmax(errors.max(axis=(1, 2)))


def folded_points(lens) -> np.ndarray:
    """Points in front of the lens that it would fold back to the middle of the picture.

    In the direction (3, -4), in which the tangential terms of "tangential" fold first.
    """
    if isinstance(lens, Fisheye):
        angles = np.linspace(1.001, 1.3, 20) * lens.valid_angle
        return 2 * np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    radii = np.linspace(1.001, 1.6, 20) * lens.valid_radius
    return 2 * np.column_stack([0.6 * radii, -0.8 * radii, np.ones(20)])


FOLDING = {
    "barrel": OpenCV(k1=-0.3125),
    "tangential": OpenCV(p1=0.25, p2=-0.1875),
    "barrel, tangential": OpenCV(k1=-0.3125, p1=0.0078125, p2=-0.015625),
    "rational": OpenCV(k4=0.25),
    "pole": OpenCV(k4=-0.25),
    "fox": LENSES["fox"],
    "fisheye": Fisheye(-0.125),
}


@both_precisions
@pytest.mark.parametrize("lens", FOLDING.values(), ids=FOLDING)
def test_what_lies_beyond_the_lens_model_does_not_fold_back(precision, lens):
    camera = camera_at_origin(fx=60.0, fy=60.0)
    points = folded_points(lens)
    film = lens.film_points(camera, points)
    inside = ((film > 0) & (film < [camera.width, camera.height])).all(axis=1)
    assert inside.sum() >= 3
    splats = splats_of(gaussians_at(points), camera, lens, precision)
    assert not np.array(splats.visible).any()
    for name in ("means2d", "whitening", "depths", "variances"):
        assert np.isfinite(rows(getattr(splats, name))).all()
    # As near as single precision can tell, what lies within is seen.
    limit = 1 - 1e-5
    within = limit * points[0] * [1 / 1.001, 1 / 1.001, 1 / limit]
    if isinstance(lens, Fisheye):
        angle = limit * lens.valid_angle
        within = np.array([np.sin(angle), 0, np.cos(angle)])
    splats = splats_of(gaussians_at(within), camera, lens, precision)
    assert np.array(splats.visible).all()


@both_precisions
@every_lens
def test_a_mean_on_the_near_plane_is_seen_and_one_before_it_is_not(precision, name):
    camera = camera_at_origin(near=0.5)
    depths = np.array([0.5, 0.5 * (1 - 1e-6), 0.0, -0.5])
    points = np.column_stack([np.zeros((4, 2)), depths])
    splats = splats_of(gaussians_at(points), camera, LENSES[name], precision)
    np.testing.assert_array_equal(np.array(splats.visible), [True, False, False, False])


@both_precisions
@every_opencv
def test_a_lens_knows_the_slopes_on_its_films_border(precision, name):
    lens, camera = LENSES[name], camera_behind(case_of(name), np.random.default_rng(0))
    expected = lens.slope_bounds(camera)
    actual = lens_camera(camera, lens, precision).lens.on_film
    if expected is None:
        expected = [[-polynomials.UNBOUNDED] * 2, [polynomials.UNBOUNDED] * 2]
    tolerance = {FLOAT64: 1e-12, FLOAT32: 1e-6}[precision]
    np.testing.assert_allclose([rows(b)[0] for b in actual], expected, rtol=tolerance)


@both_precisions
@pytest.mark.parametrize("part", [0.3, 0.6, 0.69, 0.7, 0.71, 0.81, 1.0, 1.5])
def test_slopes_are_bounded_while_the_lens_reaches_the_whole_border(precision, part):
    """Half a side is a part of the largest distorted radius; the corners are sqrt(2) as far."""
    lens = OpenCV(k1=-0.3125)
    half = part * (2 / 3) * lens.valid_radius
    camera = camera_at_origin(fx=100 / half, fy=100 / half, cx=100, cy=100, width=200, height=200)
    bounds = lens_camera(camera, lens, precision).lens.on_film
    expected = lens.slope_bounds(camera)
    assert (expected is not None) == (part < np.sqrt(0.5))
    if expected is None:
        expected = [[-polynomials.UNBOUNDED] * 2, [polynomials.UNBOUNDED] * 2]
    # Near the fold the inverse is steep: a rounding of the radius, over sqrt(1 - part^2).
    tolerance = {FLOAT64: 1e-9, FLOAT32: 1e-4}[precision]
    np.testing.assert_allclose([rows(b)[0] for b in bounds], expected, rtol=tolerance)


def test_a_crop_window_is_bounded_by_the_whole_film():
    lens, camera = LENSES["rational"], camera_at_origin()
    whole = lens_camera(camera, lens, FLOAT64)
    shift = FLOAT64.Array2f(37.0, 21.0)
    window = replace(
        whole,
        principal=whole.principal - shift,
        film_start=whole.film_start - shift,
        film_end=whole.film_end - shift,
        width=50,
        height=40,
    ).with_lens(kernel_lens(lens))
    for a, b in zip(window.lens.on_film, whole.lens.on_film, strict=True):
        np.testing.assert_allclose(rows(a), rows(b), rtol=1e-13)


# ----------------------------------------------------------------------------------------------
# Rays
# ----------------------------------------------------------------------------------------------


def rays_of(camera, lens, film, precision) -> np.ndarray:
    """Directions (N, 3), camera axes, unit, of points of the film (N, 2), px."""
    x, y = (precision.array(column) for column in np.asarray(film).T)
    device = lens_camera(camera, lens, precision)
    rays = rows(device.lens.ray(device, x, y))
    rays = np.broadcast_to(rays, (len(film), 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@both_precisions
@every_lens
def test_a_ray_is_seen_where_it_starts(precision, name):
    """By the reference, wherever the lens shows anything."""
    lens, camera = LENSES[name], camera_behind(case_of(name), np.random.default_rng(0))
    y, x = np.mgrid[: camera.height, : camera.width].reshape(2, -1) + 0.5
    film = np.column_stack([x, y])
    film = np.vstack([film, [[camera.cx, camera.cy]]])
    points = points_at(lens, camera, film, np.ones(len(film)))
    shown = ~np.isnan(points).any(axis=1)
    assert shown.all() == (name != "barrel")
    rays = rays_of(camera, lens, film, precision)
    assert np.isfinite(rays).all()
    if isinstance(lens, Orthographic):
        expected = np.tile([0, 0, 1.0], (len(film), 1))
    else:
        expected = points / np.linalg.norm(points, axis=1, keepdims=True)
    # The reciprocal of the slope of the distorted radius, next to the fold, times a rounding.
    tolerance = {FLOAT64: 1e-12, FLOAT32: 2e-5}[precision]
    np.testing.assert_allclose(rays[shown], expected[shown], rtol=0, atol=tolerance)


@both_precisions
@pytest.mark.parametrize("kind", ["opencv", "fisheye"])
def test_rays_of_any_lens_are_found_and_finite(precision, kind):
    """Coefficients as large as they come, films far beyond what some of the lenses show.

    An unguarded Newton's method from the place on the film misses some and ends in NaN.
    """
    shown = 0
    for seed in range(15):
        rng = np.random.default_rng(seed)
        if kind == "opencv":
            sizes = [0.3, 0.1, 0.03, 0.3, 0.1, 0.03, 0.01, 0.01]
            lens = OpenCV(*map(float, single(rng.normal(0, sizes))))
        else:
            lens = Fisheye(*map(float, single(rng.normal(0, [0.1, 0.05, 0.02, 0.01]))))
        focal = rng.choice([8.0, 15.0, 30.0])
        camera = camera_at_origin(fx=focal, fy=focal, cx=18.5, cy=14.5, width=37, height=29)
        film = single(rng.uniform(0, 1, (200, 2)) * [37, 29])
        rays = rays_of(camera, lens, film, precision)
        assert np.isfinite(rays).all()
        points = points_at(lens, camera, film, np.ones(200))
        found = ~np.isnan(points).any(axis=1)
        # Not those next to a fold, where a small step on the film is a large one outside.
        nearby = [points_at(lens, camera, film + step, np.ones(200)) for step in np.eye(2) / 100]
        found &= np.all([np.linalg.norm(p - points, axis=1) < 0.1 for p in nearby], axis=0)
        expected = points[found] / np.linalg.norm(points[found], axis=1, keepdims=True)
        tolerance = {FLOAT64: 1e-9, FLOAT32: 2e-5}[precision]
        np.testing.assert_allclose(rays[found], expected, rtol=0, atol=tolerance, err_msg=str(lens))
        shown += found.sum()
    assert shown > 1500


# ----------------------------------------------------------------------------------------------
# With other choices
# ----------------------------------------------------------------------------------------------


def unscented_scene(name, size) -> tuple[reference.Gaussians, reference.Camera]:
    """20 Gaussians on the film of up to ``size`` of their distance; none nearer than 0.5."""
    lens, camera = LENSES[name], camera_behind(case_of(name), np.random.default_rng(1))
    rng = np.random.default_rng(2)
    film = rng.uniform(0.2, 0.8, (20, 2)) * [camera.width, camera.height]
    points = points_at(lens, camera, film, rng.uniform(1, 3, 20))
    distances = np.linalg.norm(points, axis=1)[:, None]
    gaussians = gaussians_at(
        points @ camera.rotation + camera.center, size * distances * rng.uniform(0.3, 1, (20, 3))
    )
    return replace(gaussians, quats=rng.normal(0, 1, (20, 4))), camera


@every_lens
def test_unscented_splats_have_the_mean_and_covariance_of_projected_samples(name):
    """The affine approximation's mean is off by some percent of the splat; this one's is not."""
    gaussians, camera = unscented_scene(name, size=0.03)
    lens = LENSES[name]
    by_samples, by_unscented, by_ewa = [], [], []
    turns = reference.quat_to_rotation(gaussians.quats)
    samples = whitened_samples(4000)
    samples = np.concatenate([samples, -samples])
    for mean, turn, log_scale in zip(gaussians.means, turns, gaussians.log_scales, strict=True):
        world = mean + samples * np.exp(log_scale) @ turn.T
        film = lens.film_points(camera, (world - camera.center) @ camera.rotation.T)
        by_samples.append((film.mean(axis=0), np.cov(film.T, bias=True)))
    for shape, found in ((unscented_shape, by_unscented), (ewa, by_ewa)):
        splats = splats_of(gaussians, camera, lens, FLOAT64, shape, low_pass=0.0)
        assert np.array(splats.visible).all()
        found += zip(rows(splats.means2d), covariances(splats), strict=True)

    def errors(found) -> tuple[float, float]:
        """Of means and of covariances, relative to the splats' sizes."""
        pairs = list(zip(found, by_samples, strict=True))
        sizes = [np.sqrt(np.trace(cov)) for _, (_, cov) in pairs]
        means = [np.abs(a[0] - b[0]).max() for a, b in pairs]
        covs = [np.abs(a[1] - b[1]).max() for a, b in pairs]
        return np.max(np.array(means) / sizes), np.max(np.array(covs) / np.square(sizes))

    mean_error, covariance_error = errors(by_unscented)
    # Third powers of the size times fourth derivatives of the lens, of some 10. Measured: 3.4e-5.
    assert mean_error < 6e-5
    # Squares of the size times these. Measured: 0.0019; the affine approximation's are 0.0029.
    assert covariance_error < 0.004
    if name != "orthographic":
        # Measured: 0.01 to 0.02.
        assert errors(by_ewa)[0] > 100 * mean_error


@every_lens
def test_unscented_splats_that_are_tiny_are_the_affine_ones(name):
    gaussians, camera = unscented_scene(name, size=1e-4)
    affine, points = (
        splats_of(gaussians, camera, LENSES[name], FLOAT64, shape, low_pass=0.0)
        for shape in (ewa, unscented_shape)
    )
    # The square of the size, times second derivatives of up to 1000 px.
    np.testing.assert_allclose(rows(points.means2d), rows(affine.means2d), rtol=0, atol=1e-4)
    sizes = np.abs(covariances(affine)).max(axis=(1, 2), keepdims=True)
    errors = np.abs(covariances(points) - covariances(affine)) / sizes
    assert errors.max() < 1e-5


UNSCENTED = {"projection": "unscented"}
PIXEL_ORDER = {"order": "pixel", "order_window": 2}
PIXEL_COLORS = {"sh_direction": "pixel"}


def planes_of(frame) -> np.ndarray:
    """(4, H W): transmittance and colour."""
    return np.array([rows(plane) for plane in frame.planes()])


def direction_of_pixels(case) -> np.ndarray:
    """(H W, 3), unit, world: of the rays of pixel centres, by the reference; NaN: nothing."""
    y, x = np.mgrid[: case.height, : case.width].reshape(2, -1) + 0.5
    points = points_at(case.lens, case.camera, np.column_stack([x, y]), np.ones(x.size))
    if isinstance(case.lens, Orthographic):
        points = np.tile([0, 0, 1.0], (x.size, 1))
    world = points @ case.camera.rotation
    return world / np.linalg.norm(world, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("name", "precision"),
    [*((name, FLOAT64) for name in FORMS), ("rational", FLOAT32)],
    ids=[*FORMS, "rational, float32"],
)
def test_colours_are_seen_in_the_directions_of_the_pixels_rays(precision, name):
    """One reference picture for each pixel, of that pixel."""
    case = clear(LensCase("small", 12, 9, 1, 20, lens=LENSES[name]))
    pipeline = pipeline_of(Approximations(sh_direction="pixel"), 1)
    _, frame = case.render(precision, pipeline)
    color = planes_of(frame)[1:].T
    splats = effects.project(*case.scene, case.lens)
    expected = np.zeros((case.height * case.width, 3))
    directions_of = direction_of_pixels(case)
    for pixel, direction in enumerate(directions_of):
        colors = reference._unclamped_colors(case.gaussians, np.tile(direction, (20, 1)), 1)
        offset = np.array([pixel % case.width, pixel // case.width])
        expected[pixel] = reference.composite(
            splats.means2d - offset, splats.conics, splats.opacities, np.maximum(colors, 0),
            splats.depths, splats.visible, (0, 0, 0), 1, 1,
        ).image[0, 0]  # fmt: skip
    shown = ~np.isnan(directions_of).any(axis=1)
    assert shown.mean() > 0.7 and np.isfinite(color).all()
    tolerance = PICTURE[precision] * np.abs(expected[shown]).max()
    np.testing.assert_allclose(color[shown], expected[shown], rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    "name", [name for name, lens in LENSES.items() if not isinstance(lens, Orthographic)]
)
def test_pixels_in_their_own_order_are_those_of_layers_in_the_centers_order(name):
    """Flat splats in layers far apart, so that no pixel's order is another one."""
    camera = camera_behind(case_of(name), np.random.default_rng(0))
    rng = np.random.default_rng(1)
    film = rng.uniform(0.2, 0.8, (12, 2)) * [camera.width, camera.height]
    points = points_at(LENSES[name], camera, film, np.linspace(1, 8, 12))
    points = points[~np.isnan(points).any(axis=1)]
    case = LensCase("layers", 37, 29, 1, lens=LENSES[name])
    gaussians = gaussians_at_points(
        case, rng, camera, points, np.full((len(points), 3), 1.5), np.full(len(points), 0.5)
    )
    gaussians = replace(gaussians, log_scales=gaussians.log_scales - 0.5)
    device = device_gaussians(gaussians, FLOAT64)
    device_camera = lens_camera(camera, LENSES[name], FLOAT64)
    plain, ordered = (
        planes_of(rendering.render(device, device_camera, pipeline_of(choices, 1)))
        for choices in (Approximations(), Approximations(**PIXEL_ORDER))
    )
    assert plain[0].min() < 0.5 and len(points) > 8
    np.testing.assert_allclose(ordered, plain, rtol=0, atol=1e-13)


def composited_along_parallel_rays(case, low_pass=0.3) -> tuple[np.ndarray, int]:
    """(4, H W): transmittance and colour; each pixel's splats by the depths of their peaks. And how
    many of these would show, but are behind the camera.

    The density of a Gaussian along a line is that of another one, whose mean the precision has.
    """
    gaussians, camera = case.scene
    focal = np.array([camera.fx, camera.fy])
    axes = camera.rotation @ reference.quat_to_rotation(gaussians.quats)
    axes = axes * np.exp(gaussians.log_scales)[:, None, :]
    widened = axes @ np.swapaxes(axes, 1, 2) + low_pass * np.diag([*focal**-2.0, 0])
    precision = np.linalg.inv(widened)
    means = (gaussians.means - camera.center) @ camera.rotation.T
    colors = np.maximum(gaussians.sh0[:, 0] * reference.C_00 + 0.5, 0)
    planes, behind = [], 0
    for y, x in np.ndindex(case.height, case.width):
        point = (np.array([x, y]) + 0.5 - [camera.cx, camera.cy]) / focal
        beside = point - means[:, :2]
        along = -np.einsum("nk,nk->n", precision[:, 2, :2], beside) / precision[:, 2, 2]
        offsets = np.column_stack([beside, along])
        distances = np.einsum("ni,nij,nj->n", offsets, precision, offsets)
        alphas = np.minimum(
            reference.sigmoid(gaussians.logit_opacities) * np.exp(-distances / 2),
            reference.ALPHA_MAX,
        )
        depths = means[:, 2] + along
        shown = (alphas >= reference.ALPHA_CUT) & (depths > 0)
        behind += np.sum((alphas >= reference.ALPHA_CUT) & (depths <= 0))
        T, color = 1.0, np.zeros(3)
        for n in np.flatnonzero(shown)[np.argsort(depths[shown])]:
            color, T = color + T * alphas[n] * colors[n], T * (1 - alphas[n])
        planes.append([T, *color])
    return np.transpose(planes), behind


@pytest.mark.parametrize("projection", ["ewa", "unscented"])
def test_an_order_of_each_pixel_along_parallel_rays(projection):
    """Needles and discs in all directions that cross: some peaks are behind the camera."""
    case = LensCase("needles", 19, 14, 0, 12, lens=LENSES["orthographic"], recipe=needles)
    window = Approximations(projection=projection, order="pixel", order_window=12)
    _, frame = case.render(FLOAT64, pipeline_of(window, 0))
    expected, behind = composited_along_parallel_rays(case)
    assert behind > 20
    # A dozen products and sums in double precision.
    np.testing.assert_allclose(planes_of(frame), expected, rtol=0, atol=1e-12)
    _, plain = case.render(FLOAT64, pipeline_of(Approximations(projection=projection), 0))
    assert np.abs(planes_of(plain) - expected).max() > 0.05


def needles(case, rng):
    camera = camera_behind(case, rng)
    size = np.array([case.width, case.height])
    film = rng.uniform(0.3, 0.7, (case.count, 2)) * size
    points = points_at(case.lens, camera, film, rng.uniform(0.3, 0.6, case.count))
    sizes = rng.uniform(0.3, 4.0, (case.count, 3))
    logits = rng.uniform(-1.5, 0.5, case.count)
    return gaussians_at_points(case, rng, camera, points, sizes, logits), camera


@pytest.mark.parametrize(
    ("name", "choices"),
    [
        ("rational", UNSCENTED | PIXEL_ORDER | PIXEL_COLORS),
        ("barrel", PIXEL_COLORS),
        ("fisheye", UNSCENTED | PIXEL_COLORS),
        ("fisheye", PIXEL_ORDER),
        ("orthographic", UNSCENTED | PIXEL_COLORS),
        ("orthographic", PIXEL_ORDER),
    ],
    ids=lambda value: value if isinstance(value, str) else ", ".join(value),
)
def test_gradients_equal_their_own_central_differences(name, choices):
    """The kernels' adjoint against the kernels' picture. So small a step meets no jump, neither of
    a cut nor of the order of splats at a pixel.
    """
    case = LensCase("choices", 19, 14, 1, 20, lens=LENSES[name])
    pipeline = pipeline_of(Approximations(**choices), 1)
    weights = single(np.random.default_rng(1).normal(size=(4, case.height * case.width)))
    gaussians, frame = case.render(FLOAT64, pipeline)
    d_transmittance, *d_features = map(FLOAT64.array, weights)
    gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance).parameters
    step = 1e-7
    for parameter, direction in directions(case.gaussians, seed=2).items():
        forward, backward = (
            planes_of(
                rendering.render(
                    device_gaussians(moved(case.gaussians, direction, sign * step), FLOAT64),
                    frame.camera,
                    pipeline,
                )
            )
            for sign in (1, -1)
        )
        expected = np.sum(weights * (forward - backward)) / (2 * step)
        terms = getattr(direction, parameter) * np.array(getattr(gradients, parameter))
        # Rounding, 1e-15 / step, of each plane. Measured: 2e-8.
        assert abs(terms.sum() - expected) <= 1e-6 * np.abs(terms).sum(), parameter


# ----------------------------------------------------------------------------------------------
# What is left out
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({}, {}),
        ({"k1": 0.5}, {"k1": 0.5}),
        ({"k2": 0.5}, {"k1": 0.0, "k2": 0.5}),
        ({"k1": 0.0, "p1": 0.0}, {"k1": 0.0, "p1": 0.0, "p2": 0.0}),
        ({"k5": 0.5}, {"k4": 0.0, "k5": 0.5}),
        ({"p2": 0.5}, {"p1": 0.0, "p2": 0.5}),
        (
            dict(zip(RadialTangential.names, (1, 2, 3, 4, 5, 6, 7, 8), strict=True)),
            dict(zip(RadialTangential.names, (1, 2, 3, 4, 5, 6, 7, 8), strict=True)),
        ),
    ],
)
def test_coefficients_that_are_not_given_are_left_out(given, named):
    lens = RadialTangential.of(**given)
    assert lens.named() == named
    values = {name: -value for name, value in named.items()}
    assert lens.with_named(values).named() == values
    assert lens.with_named(values).max_squared_radius == lens.max_squared_radius


def test_a_fisheye_leaves_out_what_is_not_given():
    assert fisheye.Fisheye.of().named() == {}
    assert fisheye.Fisheye.of(k2=0.5).named() == {"k1": 0.0, "k2": 0.5}
    assert fisheye.Fisheye.of(k1=0.0).named() == {"k1": 0.0}
    lens = fisheye.Fisheye.of(k1=0.5, k2=0.25)
    assert lens.with_named({"k1": 0.25, "k2": 0.125, "fx": 1.0}).named() == {
        "k1": 0.25, "k2": 0.125
    }  # fmt: skip
    assert orthographic.Orthographic().named() == {}


@every_lens
def test_where_the_model_ends_is_where_the_reference_ends(name):
    lens = LENSES[name]
    if isinstance(lens, OpenCV):
        expected, actual = lens.valid_radius**2, kernel_lens(lens).max_squared_radius
    elif isinstance(lens, Fisheye):
        expected, actual = np.cos(lens.valid_angle), kernel_lens(lens).min_cosine
    else:
        return
    assert actual == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("lens", "ends"),
    [
        (OpenCV(p1=0.125, p2=-0.0625), True),
        # By what the radial part grows along the slope, and by what it is across it.
        (OpenCV(k1=-0.25, k2=0.03125, k4=0.0625, p1=-0.03125, p2=0.015625), True),
        (OpenCV(k1=0.0625, k4=0.03125, k5=-0.015625, p1=0.125, p2=0.125), True),
        # Nowhere; and not before the pole.
        (OpenCV(k1=0.25, k2=0.125, p1=0.0625), False),
        (OpenCV(k4=-0.25, p1=2.0**-30), False),
    ],
    ids=str,
)
def test_tangential_terms_end_the_model_where_the_reference_does(lens, ends):
    radius = math.sqrt(kernel_lens(lens).max_squared_radius)
    assert radius == pytest.approx(lens.valid_radius, rel=1e-9)
    plain = replace(lens, p1=0.0, p2=0.0).valid_radius
    assert (radius < 0.99 * plain) == ends


def kernels_of(lens, camera_seed=0) -> dict[str, list]:
    """[hash, operation count] of the kernels of a frame, its adjoint, and its tangent."""
    # Few enough entries that Dr.Jit's running maximum needs one pass.
    case = LensCase("kernels", 37, 29, 1, 20, seed=camera_seed, lens=lens)
    gaussians, camera = device_gaussians(case.gaussians, FLOAT32), case.device_camera(FLOAT32)
    # Aligned as Dr.Jit's own memory: see test_composition.
    flat = gaussians.logit_opacities + dr.opaque(FLOAT32.Float, 0)
    gaussians = replace(gaussians, logit_opacities=flat)
    ones = dr.opaque(FLOAT32.Float, 1, case.width * case.height)
    dr.eval(gaussians, ones)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        # That of the other tests, for the same kernels.
        frame = rendering.render(gaussians, camera, case.pipeline)
        dr.eval(frame.planes())
        forward = drain_kernels()
        frame_adjoint(gaussians, frame, [ones] * (len(frame.planes()) - 1), ones)
        adjoint = drain_kernels()
        dr.eval(frame_tangent(gaussians, frame, gaussians))
        tangent = drain_kernels()
    return {"forward": forward, "adjoint": adjoint, "tangent": tangent}


def operations(kernels) -> dict[str, int]:
    return {name: sum(count for _, count in entries) for name, entries in kernels.items()}


@pytest.mark.parametrize(
    ("lens", "other"),
    [
        (OpenCV(k1=-0.25), OpenCV(k1=0.125)),
        (LENSES["rational"], OpenCV(0.1, 0.02, -0.01, 0.02, 0.01, 0.003, -0.002, 0.001)),
        (LENSES["fox"], OpenCV(k1=-0.3, k2=0.1, p1=0.001, p2=0.002)),
        (LENSES["fisheye"], Fisheye(0.02, -0.001, 0.003, 0.001)),
        (Orthographic(), Orthographic()),
    ],
    ids=["k1", "rational", "fox", "fisheye", "orthographic"],
)
def test_kernels_do_not_depend_on_the_numbers_of_a_lens(lens, other):
    """Otherwise each camera, and each step of a calibration, would compile its own."""
    kernels = kernels_of(lens)
    assert kernels == kernels_of(other, camera_seed=5)
    assert all(len(entries) >= 3 for entries in kernels.values())


def test_each_coefficient_adds_operations_where_it_belongs():
    """A lens without any has those of a pinhole with a bound; compositing never changes."""
    radial, rational = LENSES["radial"], LENSES["rational"]
    lenses_of = [effects.Pinhole(), OpenCV(), LENSES["barrel"], radial]
    lenses_of += [replace(rational, p1=0.0, p2=0.0), rational]
    kernels = [kernels_of(lens) for lens in lenses_of]
    for fewer, more in pairwise(kernels):
        before, after = operations(fewer), operations(more)
        assert all(before[name] < after[name] for name in before), (before, after)
        # All but the kernel that projects, which is the first.
        assert fewer["forward"][1:] == more["forward"][1:]


def test_each_coefficient_of_a_fisheye_adds_operations():
    steps = [LENSES["plain fisheye"], Fisheye(0.01), LENSES["fisheye"]]
    for fewer, more in pairwise(kernels_of(lens) for lens in steps):
        before, after = operations(fewer), operations(more)
        assert all(before[name] < after[name] for name in before), (before, after)


# ----------------------------------------------------------------------------------------------
# Numbers that are none
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "shape", "precision"),
    [(name, ewa, precision) for name in FORMS for precision in (FLOAT32, FLOAT64)]
    + [("rational", unscented_shape, FLOAT32), ("fisheye", unscented_shape, FLOAT32)],
    ids=lambda value: value if isinstance(value, str) else getattr(value, "__name__", None),
)
def test_positions_that_are_no_numbers_poison_nothing(precision, name, shape):
    """As with them far away: the same picture and the same gradients of all others."""
    case = clear(case_of(name, count=30))
    means = case.gaussians.means.copy()
    bad = np.array([
        [np.nan, 0, 0], [0, np.nan, 0], [0, 0, np.nan], [np.inf, 0, 0], [0, -np.inf, 0],
        [0, 0, np.inf], [0, 0, -np.inf], [np.inf, np.inf, np.inf], [-np.inf, np.nan, np.inf],
        case.camera.center,
    ])  # fmt: skip
    where = np.arange(10, 10 + len(bad))
    means[where] = bad
    hidden = case.gaussians.logit_opacities.copy()
    hidden[where] = -50.0
    pipeline = replace(case.pipeline, shape=shape)
    cotangents = Cotangents.random(case)
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)

    def rendered(gaussians):
        device = device_gaussians(gaussians, precision)
        frame = rendering.render(device, case.device_camera(precision), pipeline)
        gradients = frame_adjoint(device, frame, d_features, d_transmittance).parameters
        planes = {n: rows(plane) for n, plane in enumerate(frame.planes())}
        return planes, {n: np.array(getattr(gradients, n)) for n in PARAMETER_NAMES}

    planes, gradients = rendered(replace(case.gaussians, means=means))
    expected_planes, expected = rendered(replace(case.gaussians, logit_opacities=hidden))
    for n, plane in expected_planes.items():
        np.testing.assert_array_equal(planes[n], plane)
    for n, gradient in expected.items():
        assert not gradients[n][where].any()
        np.testing.assert_array_equal(gradients[n], gradient)
        assert gradient.any()


@pytest.mark.parametrize("name", LENSES)
def test_the_exact_projection_refuses_other_lenses_than_pinholes(name):
    case = LensCase("tiny", 13, 11, 0, 5, lens=LENSES[name])
    kind = type(kernel_lens(LENSES[name])).__name__
    pipeline = pipeline_of(Approximations(projection="exact"), 0)
    gaussians = device_gaussians(case.gaussians, FLOAT32)
    with pytest.raises(
        ValueError, match=f"^splats: projection 'exact' needs a pinhole, got {kind}"
    ):
        rendering.render(gaussians, lens_camera(case.camera, case.lens, FLOAT32), pipeline)
