"""Each approximation's alternative against scalar loops, textbook formulas and limits."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from test_reference_splatting import (
    BACKGROUND,
    PARAMETERS,
    legendre_sh_basis,
    rotation_about,
    small_camera,
    small_scene,
)

from drgs.reference import rays
from drgs.reference import splatting as reference
from drgs.reference.rays import ImageModel
from drgs.reference.splatting import Camera, Gaussians

UNCUT = ImageModel(alpha_max=1.0, alpha_cut=0.0, transmittance_stop=0.0)
"""No decisions: every splat touches every pixel."""

# The loop inverts covariances of condition 25 and takes differences of squared distances from the
# camera, up to 40^2: rho^2 is off by up to 1e-16 * 25 * 40^2 = 4e-12. Measured: 8e-14.
LOOP_ROUNDING = 1e-11

# ----------------------------------------------------------------------------------------------
# The picture by scalar loops, from inverse covariances
# ----------------------------------------------------------------------------------------------


def camera_gaussian(gaussians, camera, n) -> tuple[np.ndarray, np.ndarray]:
    """(mean (3,), factor V (3, 3)) in camera axes, the covariance being V V^T."""
    w, *axis = gaussians.quats[n]
    angle = 2 * math.atan2(np.linalg.norm(axis), w)
    turn = rotation_about(axis, angle) if np.any(axis) else np.eye(3)
    factor = camera.rotation @ turn @ np.diag(np.exp(gaussians.log_scales[n]))
    return camera.rotation @ (gaussians.means[n] - camera.center), factor


def textbook_unscented(mean, factor, function, alpha, beta, kappa):
    """(mean, covariance) of function(x): the scaled unscented transform as Julier writes it."""
    n = len(mean)
    lam = alpha**2 * (n + kappa) - n
    offsets = math.sqrt(n + lam) * factor.T
    points = [mean, *(mean + offsets), *(mean - offsets)]
    mean_weights = [lam / (n + lam)] + 2 * n * [1 / (2 * (n + lam))]
    cov_weights = [mean_weights[0] + 1 - alpha**2 + beta, *mean_weights[1:]]
    values = [function(point) for point in points]
    center = sum(w * value for w, value in zip(mean_weights, values, strict=True))
    covariance = sum(
        w * np.outer(value - center, value - center)
        for w, value in zip(cov_weights, values, strict=True)
    )
    return center, covariance


def naive_film(mean, factor, camera, model):
    """(mean2d, C without low-pass, k, w) of one Gaussian in camera axes."""
    x, y, z = mean
    focal = np.array([camera.fx, camera.fy])
    slope = np.array([x / z, y / z])
    half = np.array([camera.width, camera.height]) / focal / 2
    low = -np.array([camera.cx, camera.cy]) / focal
    clamped = np.clip(slope, low - 0.3 * half, low + 2.3 * half)

    def jacobian(slope):
        return np.column_stack([np.diag(focal), -focal * slope]) / z

    def pinhole(point):
        return focal * point[:2] / point[2] + [camera.cx, camera.cy]

    sigma = factor @ factor.T
    mean2d, linear = pinhole(mean), jacobian(slope if model.projection == "exact" else clamped)
    cov = linear @ sigma @ linear.T
    is_clamped = not np.array_equal(slope, clamped)
    if model.projection == "unscented" and is_usable(mean, factor) and not is_clamped:
        mean2d, cov = textbook_unscented(mean, factor, pinhole, alpha=1, beta=2, kappa=0)
    return mean2d, cov, linear @ sigma[:, 2] / z, sigma[2, 2] / z**2


def is_usable(mean, factor) -> bool:
    """Whether the nearest sigma point is not nearer than a third of the mean's depth."""
    return mean[2] - math.sqrt(3) * np.abs(factor[2]).max() >= mean[2] / 3


def naive_splat(gaussians, camera, n, model):
    """A function of the pixel's (x, y): (alpha, sort key, depth), or None where it does not exist.

    None itself if the splat is culled.
    """
    mean, factor = camera_gaussian(gaussians, camera, n)
    z = mean[2]
    if z < camera.near:
        return None
    mean2d, sharp, k, w = naive_film(mean, factor, camera, model)
    cov = sharp + model.low_pass * np.eye(2)
    opacity = 1 / (1 + math.exp(-gaussians.logit_opacities[n]))
    if model.antialiased:
        opacity *= math.sqrt(np.linalg.det(sharp) / np.linalg.det(cov))
    if opacity <= model.alpha_cut:
        return None
    conic = np.linalg.inv(cov)
    widening = model.low_pass * z**2 * np.diag([1 / camera.fx**2, 1 / camera.fy**2, 0])
    precision = np.linalg.inv(factor @ factor.T + widening)

    def along_ray(position):
        """(rho^2, t, entry) from rho^2(t) = A t^2 - 2 B t + C."""
        ray = np.array(
            [(position[0] - camera.cx) / camera.fx, (position[1] - camera.cy) / camera.fy, 1.0]
        )
        A, B, C = ray @ precision @ ray, ray @ precision @ mean, mean @ precision @ mean
        entry = None
        if math.isfinite(model.extent):
            roots = np.roots([A, -2 * B, C - model.extent**2])
            entry = min(roots.real)
        return C - B**2 / A, B / A, entry

    def on_film(position):
        d = position - mean2d
        rho_sq = d @ conic @ d
        a = 1 - k @ conic @ d
        h = max(0, w - k @ conic @ k)
        return rho_sq, z * a / (a**2 + h * rho_sq), None

    def at(position):
        rho_sq, t, entry = (along_ray if model.projection == "exact" else on_film)(position)
        raw = opacity * math.exp(-rho_sq / 2)
        if raw < model.alpha_cut or rho_sq > model.extent**2:
            return None
        if (model.order != "center" or model.projection == "exact") and t <= 0:
            return None
        if model.order == "entry" and entry <= 0:
            return None
        key = {"center": z, "pixel": t, "entry": entry}[model.order]
        return min(raw, model.alpha_max), key, z if model.order == "center" else t

    return at


def naive_basis(gaussians, camera, model, position=None, n=None) -> np.ndarray:
    """(K,) harmonics in the direction of a pixel's ray, or of the mean of Gaussian n."""
    if model.sh_direction == "mean":
        direction = gaussians.means[n] - camera.center
    else:
        ray = [(position[0] - camera.cx) / camera.fx, (position[1] - camera.cy) / camera.fy, 1]
        direction = camera.rotation.T @ ray
    degree = gaussians.sh_degree if model.sh_degree is None else model.sh_degree
    return legendre_sh_basis(direction / np.linalg.norm(direction), degree)


def naive_color(gaussians, n, basis) -> np.ndarray:
    coefficients = np.concatenate([gaussians.sh0[n], gaussians.shN[n]])[: len(basis)]
    return np.maximum(basis @ coefficients + 0.5, 0)


def naive_picture(gaussians, camera, model) -> dict[str, np.ndarray]:
    shape = camera.height, camera.width
    picture = {
        "image": np.zeros((*shape, 3)),
        "depth": np.zeros(shape),
        "transmittance": np.ones(shape),
    }
    indices = range(len(gaussians.means))
    splats = [naive_splat(gaussians, camera, n, model) for n in indices]
    if model.sh_direction == "mean":
        bases = [naive_basis(gaussians, camera, model, n=n) for n in indices]
    for row, column in np.ndindex(shape):
        position = np.array([column + 0.5, row + 0.5])
        if model.sh_direction == "pixel":
            bases = [naive_basis(gaussians, camera, model, position)] * len(indices)
        hits = [(splat(position), n) for n, splat in enumerate(splats) if splat]
        hits = sorted((hit[1], n, hit[0], hit[2]) for hit, n in hits if hit)
        transmittance, last = 1.0, -math.inf
        slope = (position - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        for key, n, alpha, depth in hits:
            if (key - last) * math.hypot(*slope, 1) < model.step:
                continue
            last = key
            behind = transmittance * (1 - alpha)
            if (behind if model.stop == "before" else transmittance) < model.transmittance_stop:
                break
            color = naive_color(gaussians, n, bases[n])
            picture["image"][row, column] += transmittance * alpha * color
            picture["depth"][row, column] += transmittance * alpha * depth
            transmittance *= 1 - alpha
        picture["image"][row, column] += transmittance * BACKGROUND
        picture["transmittance"][row, column] = transmittance
    return picture


def assert_pictures_agree(picture, expected, atol) -> None:
    for name in ("image", "depth", "transmittance"):
        wanted = expected[name] if isinstance(expected, dict) else getattr(expected, name)
        np.testing.assert_allclose(getattr(picture, name), wanted, rtol=0, atol=atol, err_msg=name)


# ----------------------------------------------------------------------------------------------
# Small scenes
# ----------------------------------------------------------------------------------------------


def straight_camera(size=9, focal=20.0, near=0.01) -> Camera:
    return Camera(np.eye(3), np.zeros(3), focal, focal, size / 2, size / 2, size, size, near)


def scene_of(means, log_scales, quats=None, opacity=0.5, colors=None) -> Gaussians:
    """Gaussians of one opacity, whose colours (N, 3) do not depend on direction."""
    n = len(means)
    opacities = np.broadcast_to(opacity, n)
    colors = np.ones((n, 3)) if colors is None else np.asarray(colors)
    return Gaussians(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (n, 1)) if quats is None else quats,
        log_scales=np.broadcast_to(log_scales, (n, 3)),
        logit_opacities=np.log(opacities / (1 - opacities)),
        sh0=((colors - 0.5) * math.sqrt(4 * math.pi))[:, None],
        shN=np.zeros((n, 0, 3)),
    )


def rotated_splats() -> Gaussians:
    """Eight, with axes up to 30 to 1, off the axis of ``straight_camera`` and near it."""
    rng = np.random.default_rng(3)
    slopes = rng.uniform(-0.25, 0.25, (8, 2))
    z = np.geomspace(0.3, 4.0, 8)
    return scene_of(
        means=np.column_stack([slopes * z[:, None], z]),
        log_scales=rng.uniform(np.log(0.01), np.log(0.3), (8, 3)),
        quats=rng.normal(0, 1, (8, 4)),
    )


def only(gaussians, kept) -> Gaussians:
    return Gaussians(**{name: getattr(gaussians, name)[kept] for name in PARAMETERS})


def joined(first, second) -> Gaussians:
    fields = {
        name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in PARAMETERS
    }
    return Gaussians(**fields)


def pixel_rays(camera) -> np.ndarray:
    """(H, W, 3) rays through the pixels' centres, camera axes, z = 1."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    x, y = np.meshgrid(x, y)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


# ----------------------------------------------------------------------------------------------
# The whole picture
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_degree", [None, 1])
def test_default_model_is_the_reference(antialiased, sh_degree):
    gaussians, camera = small_scene()
    model = ImageModel(antialiased=antialiased, sh_degree=sh_degree)
    # Wide enough that the scene, which keeps 5e-4 clear of thresholds, has marked pixels.
    width = 0.01
    expected = reference.render(gaussians, camera, BACKGROUND, sh_degree, antialiased, width)
    picture = rays.render(gaussians, camera, BACKGROUND, model, threshold_width=width)
    # Rounding only: C is inverted in another order of operations. Measured 1e-15.
    assert_pictures_agree(picture, expected, atol=1e-13)
    np.testing.assert_array_equal(picture.alpha, 1 - picture.transmittance)
    assert expected.near_threshold.any() and not expected.near_threshold.all()
    np.testing.assert_array_equal(picture.near_threshold, expected.near_threshold)


@pytest.mark.parametrize(
    "model",
    [
        ImageModel("ewa", "pixel"),
        ImageModel("unscented", "center"),
        ImageModel("unscented", "pixel", antialiased=True),
        ImageModel("exact", "center", antialiased=True),
        ImageModel("exact", "pixel", low_pass=0.0),
        ImageModel("exact", "pixel", "pixel"),
        ImageModel("exact", "entry", "pixel", extent=3.0, low_pass=0.0),
        ImageModel("exact", "entry", extent=2.0),
        ImageModel("ewa", "center", "pixel", sh_degree=2),
    ],
    ids=lambda m: f"{m.projection}-{m.order}-{m.sh_direction}-{m.low_pass}-{m.antialiased}",
)
def test_picture_equals_a_loop_over_pixels(model):
    gaussians, camera = small_scene()
    expected = naive_picture(gaussians, camera, model)
    picture = rays.render(gaussians, camera, BACKGROUND, model)
    assert_pictures_agree(picture, expected, LOOP_ROUNDING)
    # The choice is seen: another model's picture is not this one.
    assert (
        np.abs(picture.image - reference.render(gaussians, camera, BACKGROUND).image).max() > 0.01
    )


@pytest.mark.parametrize("projection", ["ewa", "unscented", "exact"])
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"alpha_max": 0.6},
        {"alpha_cut": 0.1},
        {"transmittance_stop": 0.2},
        {"extent": 1.2},
        {"low_pass": 0.0},
        {"low_pass": 2.0},
        {"antialiased": True},
        {"sh_degree": 0},
    ],
    ids=str,
)
def test_each_choice_changes_what_it_says(projection, change):
    """And nothing else, as the loop has the same choices."""
    gaussians, camera = small_scene()
    uncut = replace(UNCUT, projection=projection)
    model = replace(uncut, **change)
    picture = rays.render(gaussians, camera, BACKGROUND, model)
    assert_pictures_agree(picture, naive_picture(gaussians, camera, model), LOOP_ROUNDING)
    difference = np.abs(picture.image - rays.render(gaussians, camera, BACKGROUND, uncut).image)
    assert (difference.max() > 1e-3) == bool(change)


@pytest.mark.parametrize("projection", ["ewa", "exact"])
def test_without_decisions_every_splat_counts(projection):
    """C = sum_i c_i alpha_i prod_{j < i} (1 - alpha_j), over all splats at all pixels."""
    gaussians, camera = small_scene()
    model = replace(UNCUT, projection=projection)
    picture = rays.render(gaussians, camera, BACKGROUND, model)
    depths = (gaussians.means - camera.center) @ camera.rotation[2]
    order = [n for n in np.argsort(depths) if depths[n] >= camera.near]
    assert len(order) == 11
    splats = [naive_splat(gaussians, camera, n, model) for n in order]
    bases = [naive_basis(gaussians, camera, model, n=n) for n in order]
    colors = np.array([naive_color(gaussians, *pair) for pair in zip(order, bases, strict=True)])
    for row, column in np.ndindex(camera.height, camera.width):
        hits = [splat(np.array([column + 0.5, row + 0.5])) for splat in splats]
        alphas = np.array([hit[0] if hit else 0.0 for hit in hits])
        weights = [alphas[i] * np.prod(1 - alphas[:i]) for i in range(len(order))]
        expected = weights @ colors + np.prod(1 - alphas) * BACKGROUND
        np.testing.assert_allclose(picture.image[row, column], expected, atol=LOOP_ROUNDING)


def test_opaque_splat_without_a_clamp_leaves_nothing():
    gaussians = replace(scene_of([[0, 0, 1]], np.log(0.1)), logit_opacities=[50.0])
    assert rays.render(gaussians, straight_camera(), model=UNCUT).transmittance[4, 4] == 0.0


# ----------------------------------------------------------------------------------------------
# Projection
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
def test_exact_response_is_the_largest_density_along_the_ray(low_pass):
    """Dense search of the 3D density on the ray's positive half, then refinement."""
    gaussians, camera = rotated_splats(), straight_camera()
    model = replace(UNCUT, projection="exact", order="pixel", low_pass=low_pass)
    directions = pixel_rays(camera)
    visible = 0
    for n in range(len(gaussians.means)):
        picture = rays.render(only(gaussians, [n]), camera, model=model)
        mean, factor = camera_gaussian(gaussians, camera, n)
        widening = low_pass * mean[2] ** 2 / camera.fx**2 * np.diag([1, 1, 0])
        precision = np.linalg.inv(factor @ factor.T + widening)
        for row, column in [(0, 0), (2, 7), (4, 4), (7, 3)]:
            ray = directions[row, column]

            def rho_sq(t, ray=ray, mean=mean, precision=precision):
                return (t * ray - mean) @ precision @ (t * ray - mean)

            grid = mean[2] * np.geomspace(1e-3, 1e3, 400)
            best = int(np.argmin([rho_sq(t) for t in grid]))
            if best in (0, len(grid) - 1):
                continue
            # Any tolerance: a minimum is found to the square root of rounding.
            found = minimize_scalar(
                rho_sq, bounds=(grid[best - 1], grid[best + 1]), options={"xatol": 1e-12}
            )
            response = picture.alpha[row, column] / 0.5
            # rho^2, of at most 1e4 here where the response is not zero, to 1e-16 times its
            # condition of 1e3; alpha is 1 - T, rounded at the size of 1.
            np.testing.assert_allclose(response, math.exp(-found.fun / 2), rtol=0, atol=1e-11)
            if response > 1e-3:
                visible += 1
                peak = picture.depth[row, column] / picture.alpha[row, column]
                # The minimiser is known to sqrt(1e-16) deviations along the ray, which are at
                # most a few times the depth; the depth carries 1e-16 / 1e-3 beside it.
                np.testing.assert_allclose(peak, found.x, rtol=1e-6)
    assert visible >= 10


def test_exact_disc_without_thickness_is_where_the_ray_meets_its_plane():
    """Thickness zero, and in-plane deviations of 0.2 and 0.1, seen at up to 60 degrees."""
    camera = straight_camera()
    for tilt in (0.0, 0.5, 1.0):
        turn = rotation_about([1, 0.4, 0], tilt)
        half = tilt / 2
        axis = np.array([1, 0.4, 0]) / np.linalg.norm([1, 0.4, 0])
        gaussians = scene_of(
            [[0.02, -0.03, 1]],
            [np.log(0.2), np.log(0.1), -np.inf],
            quats=[[math.cos(half), *(math.sin(half) * axis)]],
        )
        mean, normal = gaussians.means[0], turn[:, 2]
        directions = pixel_rays(camera)
        t = normal @ mean / (directions @ normal)
        in_plane = (t[..., None] * directions - mean) @ turn[:, :2] / [0.2, 0.1]
        response = np.exp(-np.sum(in_plane**2, axis=-1) / 2)
        model = replace(UNCUT, projection="exact", order="pixel", low_pass=0.0)
        with warnings.catch_warnings(), np.errstate(divide="raise", over="raise", invalid="raise"):
            warnings.simplefilter("error")
            picture = rays.render(gaussians, camera, model=model)
        # alpha is 1 - T, rounded at the size of 1; the rest is rounding of numbers of that size.
        np.testing.assert_allclose(picture.alpha, 0.5 * response, rtol=0, atol=1e-14)
        np.testing.assert_allclose(picture.depth, 0.5 * response * t, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("slope", "sizes", "order"),
    [
        ((0.0, 0.0), (1.0, 1.0, 1.0), 2),
        ((0.5, -0.3), (1.0, 1.0, 1.0), 1),
        ((0.0, 0.0), (1.0, 0.5, 0.25), 1),
    ],
    ids=["round on axis", "round off axis", "tilted"],
)
def test_exact_tends_to_ewa_as_splats_shrink(slope, sizes, order):
    """rho^2 = rho_ewa^2 / D with D = 1 - 2 kappa . e + O(angle^2), and kappa = O(angle).

    kappa, the covariance of depth with the place on the film, vanishes for a round splat on the
    axis. The picture stays 2 px wide while the splat's angle shrinks: a long lens.
    """

    def error(angle):
        focal, size = 2.0 / angle, 15
        center = size / 2
        camera = Camera(
            np.eye(3), np.zeros(3), focal, focal,
            center - focal * slope[0], center - focal * slope[1], size, size,
        )  # fmt: skip
        gaussians = scene_of(
            [[*slope, 1.0]], np.log(angle * np.array(sizes)), quats=[[0.9, 0.3, 0.5, 0.2]]
        )
        model = replace(UNCUT, low_pass=0.0)
        exact, ewa = (
            rays.render(gaussians, camera, model=replace(model, projection=name)).alpha
            for name in ("exact", "ewa")
        )
        return np.abs(exact - ewa).max()

    ratio = error(2e-3) / error(1e-3)
    # The next order adds about the angle times rho^2, some 1e-3 times 10.
    assert ratio == pytest.approx(2**order, rel=0.02)
    assert error(1e-3) < 1e-3


def test_sigma_points_are_the_scaled_unscented_transform():
    """Or, where a point is near the camera or the slope is clamped, the affine approximation."""
    gaussians, camera = small_scene()
    gaussians.log_scales[:3, 2] += 2.0
    splats = rays._splats(gaussians, camera, ImageModel("unscented", alpha_cut=0.0))
    affine = rays._splats(gaussians, camera, ImageModel("ewa", alpha_cut=0.0))
    focal, principal = [camera.fx, camera.fy], [camera.cx, camera.cy]
    kinds = []
    for i, n in enumerate(n for n in range(12) if n != 10):
        mean, factor = camera_gaussian(gaussians, camera, n)

        def pinhole(point):
            return focal * point[:2] / point[2] + principal

        kinds.append("near" if not is_usable(mean, factor) else "clamped" if n == 9 else "usable")
        if kinds[-1] == "usable":
            center, covariance = textbook_unscented(mean, factor, pinhole, alpha=1, beta=2, kappa=0)
            covariance = covariance + 0.3 * np.eye(2)
        else:
            center, covariance = affine.means2d[i], affine.cov2d[i]
        np.testing.assert_allclose(splats.means2d[i], center, rtol=1e-12)
        # Rounding of sums of squares of up to 1e2 px.
        np.testing.assert_allclose(splats.cov2d[i], covariance, rtol=1e-11, atol=1e-11)
    assert set(kinds) == {"near", "clamped", "usable"}


def test_textbook_transform_is_exact_for_affine_functions():
    """Whatever alpha, beta and kappa: what the test above compares with is a transform."""
    rng = np.random.default_rng(2)
    mean, factor, matrix = rng.normal(0, 1, 3), rng.normal(0, 1, (3, 3)), rng.normal(0, 1, (2, 3))
    for alpha, beta, kappa in [(1, 2, 0), (0.1, 2, 0), (0.5, 0, 1)]:
        center, covariance = textbook_unscented(
            mean, factor, lambda x: matrix @ x + [3, 4], alpha, beta, kappa
        )
        # The weights are up to 1 / alpha^2 and cancel.
        np.testing.assert_allclose(center, matrix @ mean + [3, 4], rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            covariance, matrix @ factor @ factor.T @ matrix.T, rtol=0, atol=1e-12
        )


def test_unscented_transform_tends_to_ewa_far_away():
    """The pinhole's second derivatives act on the mean, and twice or with the third on C."""
    gaussians, camera = rotated_splats(), straight_camera()

    def errors(factor):
        """Of the mean in deviations, and of C relative to it, worst over the splats."""
        far = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
        small = replace(gaussians, log_scales=gaussians.log_scales - np.log(factor))
        # A film on which no slope is clamped; no wider, or differences of places would be rounded.
        wide = replace(far, width=10**5, height=10**5, cx=far.cx + 5e4, cy=far.cy + 5e4)
        ours = rays._splats(small, wide, ImageModel("unscented", low_pass=0.0, alpha_cut=0.0))
        ewa = rays._splats(small, wide, ImageModel("ewa", low_pass=0.0, alpha_cut=0.0))
        moved = ours.means2d - ewa.means2d
        deviations = np.sqrt(np.trace(ewa.cov2d, axis1=1, axis2=2))
        mean_error = np.linalg.norm(moved, axis=1) / deviations
        cov_error = np.linalg.norm(ours.cov2d - ewa.cov2d, axis=(1, 2)) / deviations**2
        return mean_error.max(), cov_error.max()

    coarse, fine = errors(100.0), errors(200.0)
    # The next even order is smaller by the square of the angle, which is at most 1 / 100.
    assert coarse[0] / fine[0] == pytest.approx(2, rel=1e-2)
    assert coarse[1] / fine[1] == pytest.approx(4, rel=1e-2)
    assert fine[0] < 0.01 and fine[1] < 1e-3


def test_boxes_hold_every_pixel_a_splat_reaches(monkeypatch):
    """Splats of all shapes, close to the camera and across it; jittered positions."""
    rng = np.random.default_rng(1)
    camera = straight_camera(size=24, focal=15.0)
    gaussians = scene_of(
        rng.uniform([-1, -1, 0.02], [1, 1, 2.0], (300, 3)),
        rng.normal(np.log(0.05), 1.0, (300, 3)),
        quats=rng.normal(0, 1, (300, 4)),
        opacity=rng.uniform(0.005, 0.6, 300),
        colors=rng.uniform(0, 1, (300, 3)),
    )
    x, y = np.meshgrid(np.arange(24) + 0.5, np.arange(24) + 0.5)
    positions = np.stack([x, y], axis=-1) + rng.uniform(-0.5, 0.5, (24, 24, 2))
    for projection in ("ewa", "unscented", "exact"):
        for extent in (math.inf, 2.0):
            model = ImageModel(projection, extent=extent, transmittance_stop=0.0)
            args = (gaussians, camera, BACKGROUND, model, None, positions)
            boxed = rays.render(*args)
            with monkeypatch.context() as everywhere:
                everywhere.setattr(
                    rays,
                    "_film_bounds",
                    lambda splats, *_: (
                        np.full(splats.means2d.shape, -np.inf),
                        np.full(splats.means2d.shape, np.inf),
                    ),
                )
                unboxed = rays.render(*args)
            for name in ("image", "transmittance", "near_threshold"):
                np.testing.assert_array_equal(getattr(boxed, name), getattr(unboxed, name))


# ----------------------------------------------------------------------------------------------
# Order
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
def test_depth_of_the_peak_on_the_film_is_that_along_the_ray(low_pass):
    """t = m_z a / D from C, k and w of the film, against Br . Bm / |Br|^2 in three dimensions."""
    gaussians, camera = rotated_splats(), straight_camera()
    exact = ImageModel("exact", "pixel", low_pass=low_pass, alpha_cut=0.0)
    # rotated_splats lie within 1.3 times the film: EWA's slope is not clamped.
    splats = rays._splats(gaussians, camera, exact)
    assert len(splats.depths) == 8
    i, offsets = np.repeat(np.arange(8), 20), np.random.default_rng(0).normal(0, 3, (160, 2))
    in_space = rays._exact_peaks(splats, i, offsets, exact)
    on_film = rays._affine_peaks(splats, i, offsets, replace(exact, projection="ewa"))
    ahead = in_space.ahead > 0
    assert ahead.sum() > 20
    np.testing.assert_array_equal(on_film.ahead > 0, ahead)
    # h = w - |kappa|^2 cancels to the square of the splats' ratio of axes, 1e-3. Measured: 2e-15.
    np.testing.assert_allclose(on_film.depths[ahead], in_space.depths[ahead], rtol=1e-13)
    np.testing.assert_allclose(
        in_space.rho_sq[ahead],
        (on_film.rho_sq * on_film.depths / splats.depths[i] / on_film.ahead)[ahead],
        rtol=1e-13,
    )


@pytest.mark.parametrize("projection", ["ewa", "exact"])
def test_pixel_order_of_two_discs_changes_where_their_planes_cross(projection):
    """A flat disc's peak is where the ray meets its plane, for EWA too: h = 0, t = m_z / a."""
    camera = straight_camera(size=21, focal=20.0)
    turns = [(0.2, [0.3, 1, 0], 0.7), (-0.2, [0.1, 1, 0], -0.6)]
    axes = [np.array(axis) / np.linalg.norm(axis) for _, axis, _ in turns]
    quats = [
        [math.cos(angle / 2), *(math.sin(angle / 2) * axis)]
        for (_, _, angle), axis in zip(turns, axes, strict=True)
    ]
    gaussians = scene_of(
        [[0.03, 0.0, 2.0], [-0.02, 0.01, 2.1]],
        [np.log(0.4), np.log(0.5), -np.inf],
        quats=quats,
        opacity=0.8,
        colors=[[1, 0, 0], [0, 1, 0]],
    )
    model = replace(UNCUT, projection=projection, order="pixel", low_pass=0.0)
    planes = []
    for n, (_, _, angle) in enumerate(turns):
        normal = rotation_about(axes[n], angle)[:, 2]
        planes.append(normal @ gaussians.means[n] / (pixel_rays(camera) @ normal))
    first_in_front = planes[0] < planes[1]
    assert 50 < first_in_front.sum() < 21 * 21 - 50

    alphas = [rays.render(only(gaussians, [n]), camera, model=model).alpha for n in (0, 1)]
    red = np.where(first_in_front, 1.0, 1 - alphas[1]) * alphas[0]
    green = np.where(first_in_front, 1 - alphas[0], 1.0) * alphas[1]
    picture = rays.render(gaussians, camera, model=model)
    # alpha is 1 - T, rounded at the size of 1.
    np.testing.assert_allclose(picture.image[..., 0], red, rtol=0, atol=1e-14)
    np.testing.assert_allclose(picture.image[..., 1], green, rtol=0, atol=1e-14)
    by_center = rays.render(gaussians, camera, model=replace(model, order="center"))
    np.testing.assert_allclose(by_center.image[..., 0], alphas[0], rtol=0, atol=1e-14)


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
def test_entry_lies_on_the_ellipsoid(low_pass):
    gaussians, camera = rotated_splats(), straight_camera()
    model = ImageModel("exact", "entry", extent=1.7, low_pass=low_pass, alpha_cut=0.0)
    splats = rays._splats(gaussians, camera, model)
    i = np.repeat(np.arange(8), 20)
    offsets = np.random.default_rng(0).normal(0, 1, (160, 2)) * 0.5
    peaks = rays._exact_peaks(splats, i, offsets, model)
    inside = peaks.rho_sq < 1.7**2
    assert inside.sum() > 40
    for j in np.flatnonzero(inside):
        mean, factor = camera_gaussian(gaussians, camera, i[j])
        widening = low_pass * mean[2] ** 2 / camera.fx**2 * np.diag([1, 1, 0])
        precision = np.linalg.inv(factor @ factor.T + widening)
        ray = np.array([*(mean[:2] / mean[2] + offsets[j] / camera.fx), 1.0])
        offset = peaks.keys[j] * ray - mean
        # The condition of the covariance, up to 1e3, and 1e2 deviations to the camera.
        assert offset @ precision @ offset == pytest.approx(1.7**2, rel=1e-9)
        assert offset @ precision @ ray < 0, "this is where the ray leaves"


def test_entry_order_puts_a_large_splat_before_a_small_nearer_one():
    camera = straight_camera()
    gaussians = scene_of(
        [[0, 0, 2.0], [0, 0, 3.0]],
        np.log([[0.1, 0.1, 0.1], [0.6, 0.6, 0.6]]),
        colors=[[1, 0, 0], [0, 1, 0]],
    )
    orders = {"center": [0.5, 0.25, 0], "pixel": [0.5, 0.25, 0], "entry": [0.25, 0.5, 0]}
    for order, color in orders.items():
        # Enters at 2 - 0.3 = 1.7 and 3 - 1.8 = 1.2.
        model = ImageModel("exact", order, extent=3.0, low_pass=0.0)
        picture = rays.render(gaussians, camera, model=model)
        np.testing.assert_allclose(picture.image[4, 4], color, rtol=0, atol=1e-15)
        # The depths are of the peaks, whatever the order is by.
        expected = color[0] * 2 + color[1] * 3
        np.testing.assert_allclose(picture.depth[4, 4], expected, rtol=1e-14)


@pytest.mark.parametrize("step", [0.0, 0.3])
@pytest.mark.parametrize("stop", ["before", "after"])
def test_a_ray_passes_over_what_it_enters_within_a_step(step, stop):
    """And a pixel may end behind the splat that is too much. Against the loop over pixels."""
    gaussians, camera = small_scene()
    model = ImageModel(
        "exact", "entry", stop=stop, transmittance_stop=0.2, extent=2.0, step=step, low_pass=0.0
    )
    picture = rays.render(gaussians, camera, BACKGROUND, model)
    assert_pictures_agree(picture, naive_picture(gaussians, camera, model), atol=1e-12)
    plain = replace(model, stop="before", step=0.0)
    same = np.array_equal(rays.render(gaussians, camera, BACKGROUND, plain).image, picture.image)
    assert same == (step == 0 and stop == "before")


def test_splat_around_the_camera_does_not_exist_in_entry_order():
    gaussians, camera = scene_of([[0, 0, 1.0]], np.log(0.4)), straight_camera()
    for extent, exists in [(2.4, True), (2.6, False)]:
        model = ImageModel("exact", "entry", extent=extent, low_pass=0.0)
        picture = rays.render(gaussians, camera, model=model)
        assert picture.alpha[4, 4] == (0.5 if exists else 0.0)
        assert (
            rays.render(gaussians, camera, model=replace(model, order="pixel")).alpha[4, 4] == 0.5
        )


def test_splats_whose_peak_is_behind_the_camera_do_not_exist():
    """A needle whose line passes the camera: rays to one side meet it in front, others behind."""
    camera = straight_camera(size=9, focal=4.0)
    angle = math.radians(80)
    gaussians = scene_of(
        [[0.0, 0.0, 0.5]],
        np.log([2.0, 0.05, 0.05]),
        quats=[[math.cos(angle / 2), 0, math.sin(angle / 2), 0]],
    )
    mean, factor = camera_gaussian(gaussians, camera, 0)
    precision = np.linalg.inv(factor @ factor.T)
    behind = pixel_rays(camera)[4] @ precision @ mean <= 0
    assert 1 <= behind.sum() <= 5
    for projection, order in [("exact", "center"), ("exact", "pixel"), ("ewa", "pixel")]:
        model = replace(UNCUT, projection=projection, order=order, low_pass=0.0)
        alpha = rays.render(gaussians, camera, model=model).alpha[4]
        assert not alpha[behind].any() and alpha[~behind].all(), (projection, order)
    # By its center, EWA does not ask for depths.
    model = replace(UNCUT, low_pass=0.0)
    assert rays.render(gaussians, camera, model=model).alpha[4].all()


def test_ties_are_composited_by_index():
    colors = np.eye(3)
    gaussians = scene_of(np.tile([0, 0, 2.0], (3, 1)), np.log(0.1), colors=colors)
    for model in (
        ImageModel("ewa", "pixel"),
        ImageModel("exact", "pixel"),
        ImageModel("exact", "entry", extent=3.0),
    ):
        picture = rays.render(gaussians, straight_camera(), model=model)
        # The middle of the film is the middle of a pixel: G = 1.
        np.testing.assert_allclose(picture.image[4, 4], [0.5, 0.25, 0.125], rtol=0, atol=1e-15)


# ----------------------------------------------------------------------------------------------
# Near a threshold
# ----------------------------------------------------------------------------------------------

ON_BOTH_SIDES = [(-2e-6, False), (-5e-7, True), (5e-7, True), (2e-6, False)]
"""(relative distance, whether a width of 1e-6 marks it)"""


def test_pixels_near_the_extent_are_marked():
    """At (1, 0) px from the mean of a splat of 1 px^2: rho = 1."""
    gaussians, camera = scene_of([[0, 0, 1.0]], np.log(0.1)), straight_camera(focal=10.0)
    for relative, marked in ON_BOTH_SIDES:
        model = ImageModel(extent=math.sqrt(1 / (1 + relative)), low_pass=0.0)
        picture = rays.render(gaussians, camera, model=model)
        assert picture.near_threshold[4, 5] == marked, relative
        assert (picture.alpha[4, 5] > 0) == (relative < 0)
        assert not picture.near_threshold[4, 4]


def test_pixels_where_splats_may_change_order_are_marked():
    camera = straight_camera()
    for relative, marked in ON_BOTH_SIDES:
        gaussians = scene_of([[0, 0, 2.0], [0, 0, 2.0 * (1 + relative)]], np.log(0.1))
        for order in ("center", "pixel"):
            model = ImageModel("exact", order)
            near = rays.render(gaussians, camera, model=model).near_threshold[4, 4]
            assert near == (marked and order == "pixel"), (relative, order)


def test_splats_that_may_change_order_need_not_be_neighbours_by_index():
    gaussians = scene_of([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 2.0 + 1e-7]], np.log(0.1))
    camera, model = straight_camera(), ImageModel("exact", "pixel")
    assert rays.render(gaussians, camera, model=model).near_threshold[4, 4]
    apart = replace(gaussians, means=[[0, 0, 2.0], [0, 0, 2.5], [0, 0, 3.0]])
    assert not rays.render(apart, camera, model=model).near_threshold[4, 4]


def test_splats_behind_the_stop_mark_nothing():
    """Two clamped splats finish the pixel; a third, of alpha 0.99, is before or behind them."""
    for third, marked in [(1.0, True), (4.0, False)]:
        gaussians = scene_of(
            [[0, 0, 2.0], [0, 0, 3.0], [0, 0, third]],
            np.log(0.1),
            opacity=np.array([0.9999, 0.9999, reference.ALPHA_MAX]),
        )
        picture = rays.render(gaussians, straight_camera(), model=ImageModel("exact", "pixel"))
        assert picture.transmittance[4, 4] == 1 - reference.ALPHA_MAX
        assert picture.near_threshold[4, 4] == marked, third


def test_pixels_whose_ray_enters_a_splat_near_the_camera_are_marked():
    camera = straight_camera()
    for relative, marked in ON_BOTH_SIDES:
        gaussians = scene_of([[0, 0, 1.0]], np.log(0.5 * (1 + relative)))
        model = ImageModel("exact", "entry", extent=2.0, low_pass=0.0)
        picture = rays.render(gaussians, camera, model=model)
        assert picture.near_threshold[4, 4] == marked, relative
        assert (picture.alpha[4, 4] > 0) == (relative < 0)


def test_nothing_is_near_a_decision_that_is_not_taken():
    """An alpha that underflows to 0 is not near a cut of 0, nor T = 0 near a stop of 0."""
    gaussians = replace(scene_of([[0, 0, 1]], np.log(1e-3)), logit_opacities=[2.0])
    picture = rays.render(gaussians, straight_camera(), model=replace(UNCUT, low_pass=0.0))
    assert picture.alpha[0, 0] == 0 and not picture.near_threshold.any()


# ----------------------------------------------------------------------------------------------
# Colour
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_color_of_a_pixel_is_that_in_its_rays_direction(degree):
    """One splat over a wide film; some of its colours are clamped to zero."""
    gaussians, camera = small_scene()
    gaussians = replace(only(gaussians, [5]), shN=only(gaussians, [5]).shN * 4)
    model = replace(UNCUT, sh_direction="pixel", sh_degree=degree)
    picture = rays.render(gaussians, camera, model=model)
    colors = np.zeros((20, 24, 3))
    for row, column in np.ndindex(20, 24):
        position = (column + 0.5, row + 0.5)
        basis = naive_basis(gaussians, camera, model, position)
        colors[row, column] = naive_color(gaussians, 0, basis)
    np.testing.assert_allclose(
        picture.image, picture.alpha[..., None] * colors, rtol=0, atol=1e-14
    )  # rounding
    if degree == 3:
        assert (colors == 0).any() and (colors > 0).any()


# ----------------------------------------------------------------------------------------------
# Regions and positions
# ----------------------------------------------------------------------------------------------

MODELS = [
    ImageModel(),
    ImageModel("unscented", "pixel", extent=3.0),
    ImageModel("exact", "entry", "pixel", extent=3.0),
]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.projection)
def test_region_is_the_crop_of_the_whole(model):
    gaussians, camera = small_scene()
    positions = rays._checked_positions(None, camera) + 0.2
    whole = rays.render(gaussians, camera, BACKGROUND, model, positions=positions)
    regions = [
        (slice(3, 17), slice(5, 9)),
        (slice(None), slice(-4, None)),
        (slice(7, 8), slice(0, 1)),
        (slice(5, 5), slice(None)),
    ]
    for region in regions:
        part = rays.render(gaussians, camera, BACKGROUND, model, region, positions)
        for name in ("image", "alpha", "depth", "transmittance", "near_threshold"):
            # Products of other batches of rows may be rounded differently.
            np.testing.assert_allclose(
                getattr(part, name), getattr(whole, name)[region], rtol=0, atol=1e-14
            )


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.projection)
def test_picture_does_not_depend_on_how_it_is_divided(model, monkeypatch):
    gaussians, camera = small_scene()
    expected = rays.render(gaussians, camera, BACKGROUND, model)
    monkeypatch.setattr(rays, "MAX_PAIRS", 7)
    divided = rays.render(gaussians, camera, BACKGROUND, model)
    # Products of other batches of rows may be rounded differently.
    assert_pictures_agree(divided, expected, atol=1e-14)
    np.testing.assert_array_equal(divided.near_threshold, expected.near_threshold)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.projection)
def test_shifted_positions_are_a_shifted_principal_point(model):
    gaussians, camera = small_scene()
    gaussians = only(gaussians, np.arange(9))  # splat 9's slope is clamped, relative to the film
    shift = np.array([0.3, -5.7])
    positions = rays._checked_positions(None, camera) + shift
    moved = replace(camera, cx=camera.cx - shift[0], cy=camera.cy - shift[1])
    shifted = rays.render(gaussians, camera, BACKGROUND, model, positions=positions)
    expected = rays.render(gaussians, moved, BACKGROUND, model)
    assert_pictures_agree(shifted, expected, atol=1e-12)  # rounding of positions of 20 px
    unmoved = rays.render(gaussians, camera, BACKGROUND, model)
    assert np.abs(unmoved.image - shifted.image).max() > 0.1


# ----------------------------------------------------------------------------------------------
# Degenerate and wrong input
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("low_pass", [0.0, 0.3])
@pytest.mark.parametrize("projection", ["ewa", "unscented", "exact"])
def test_culled_and_degenerate_gaussians_raise_no_warning_and_change_nothing(projection, low_pass):
    """Behind the camera, on its plane, transparent; and in front: points without extent."""
    gaussians, camera = small_scene()
    points = np.array([[0, 0, -1], [1e3, 0, 0], [0, 0, 0], [0.1, 0, 2], [0.1, 0, 2]])
    strange = Gaussians(
        means=points @ camera.rotation + camera.center,
        quats=np.zeros((5, 4)),
        log_scales=np.repeat([80.0, 1.0, -np.inf, 0.0, -np.inf], 3).reshape(5, 3),
        logit_opacities=[9.0, 9.0, 9.0, -1e3, 9.0 if low_pass == 0 else -1e3],
        sh0=np.ones((5, 1, 3)),
        shN=np.ones((5, 15, 3)),
    )
    model = ImageModel(projection, "pixel", low_pass=low_pass)
    with warnings.catch_warnings(), np.errstate(divide="raise", over="raise", invalid="raise"):
        warnings.simplefilter("error")
        picture = rays.render(joined(gaussians, strange), camera, BACKGROUND, model)
    alone = rays.render(gaussians, camera, BACKGROUND, model)
    # Batched matrix products may round differently in batches of another size.
    assert_pictures_agree(picture, alone, atol=1e-13)


def test_point_without_extent_is_the_low_pass():
    """In every projection: a round splat of 0.3 px^2."""
    gaussians, camera = scene_of([[0, 0, 1.0]], -np.inf), straight_camera()
    squares = (np.arange(9) - 4.0) ** 2
    expected = 0.5 * np.exp(-(squares[:, None] + squares) / 0.6)
    for projection in ("ewa", "unscented", "exact"):
        picture = rays.render(gaussians, camera, model=replace(UNCUT, projection=projection))
        np.testing.assert_allclose(picture.alpha, expected, rtol=0, atol=1e-15)


def test_no_gaussians_show_the_background():
    camera = small_camera()
    empty = only(small_scene()[0], [])
    for model in MODELS:
        picture = rays.render(empty, camera, BACKGROUND, model)
        np.testing.assert_array_equal(picture.image, np.broadcast_to(BACKGROUND, (20, 24, 3)))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"projection": "affine"}, "projection must be one of ewa, unscented, exact, got 'affine'"),
        ({"order": "depth"}, "order must be one of center, pixel, entry, got 'depth'"),
        ({"sh_direction": "ray"}, "sh_direction must be one of mean, pixel, got 'ray'"),
        ({"order": "entry", "extent": 3.0}, "got projection 'ewa' and extent 3.0"),
        ({"order": "entry", "projection": "exact"}, "got projection 'exact' and extent inf"),
        ({"alpha_max": 1.5}, r"alpha_max must be in \(0, 1\], got 1.5"),
        ({"alpha_cut": -0.1}, r"alpha_cut must be in \[0, 1\), got -0.1"),
        ({"transmittance_stop": 1.0}, r"transmittance_stop must be in \[0, 1\), got 1.0"),
        ({"stop": "never"}, "stop must be one of before, after, got 'never'"),
        ({"step": 1e-4}, "a step needs order 'entry', got 'center'"),
        ({"step": -1.0}, "step must be >= 0 and finite, got -1.0"),
        ({"extent": 0.0}, "extent must be > 0, got 0.0"),
        ({"low_pass": math.nan}, "low_pass must be >= 0 and finite, got nan"),
    ],
)
def test_unknown_choices_are_refused_by_name(fields, message):
    with pytest.raises(ValueError, match=message):
        ImageModel(**fields)


def test_wrong_shapes_regions_and_degrees_are_refused_by_name():
    gaussians, camera = small_scene()
    with pytest.raises(ValueError, match=r"background must have shape \(3,\), got \(4,\)"):
        rays.render(gaussians, camera, np.zeros(4))
    with pytest.raises(ValueError, match=r"positions must have shape \(20, 24, 2\).*\(24, 20, 2\)"):
        rays.render(gaussians, camera, positions=np.zeros((24, 20, 2)))
    with pytest.raises(ValueError, match=r"region must be a slice of rows .* got \(3, 4\)"):
        rays.render(gaussians, camera, region=(3, 4))
    with pytest.raises(ValueError, match=r"slices of step 1 .* got slice\(0, 9, 2\)"):
        rays.render(gaussians, camera, region=(slice(0, 9, 2), slice(None)))
    with pytest.raises(ValueError, match="degree must be 0 to 3, got 4"):
        rays.render(gaussians, camera, model=ImageModel(sh_degree=4))
