"""The image of each approximation by scalar loops and textbook formulas."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np

from drgs.reference.rays import ImageModel
from support.reference_scenes import BACKGROUND, legendre_sh_basis, rotation_about

UNCUT = ImageModel(alpha_max=1.0, alpha_cut=0.0, transmittance_stop=0.0)
"""No decisions: every splat touches every pixel."""

MARKED_DISTANCES = [(-2e-6, False), (-5e-7, True), (5e-7, True), (2e-6, False)]
"""(relative distance from a threshold, whether a width of 1e-6 marks the pixel)"""


def camera_gaussian(gaussians, camera, n) -> tuple[np.ndarray, np.ndarray]:
    """(mean (3,), factor V (3, 3)) in camera axes, the covariance being V V^T."""
    w, *axis = gaussians.quats[n]
    angle = 2 * math.atan2(np.linalg.norm(axis), w)
    turn = rotation_about(axis, angle) if np.any(axis) else np.eye(3)
    factor = camera.rotation @ turn @ np.diag(np.exp(gaussians.log_scales[n]))
    return camera.rotation @ (gaussians.means[n] - camera.center), factor


def unscented(mean, factor, function):
    """(mean, covariance) of function(x): Julier's scaled transform, alpha = 1, beta = 2, kappa = 0.

    Of 3 dimensions: lambda = 0, so the mean itself has the weights 0 and 1 - alpha^2 + beta.
    """
    offsets = math.sqrt(3) * factor.T
    values = np.array([function(point) for point in (mean, *(mean + offsets), *(mean - offsets))])
    center = values[1:].mean(axis=0)
    apart = values - center
    return center, 2 * np.outer(apart[0], apart[0]) + apart[1:].T @ apart[1:] / 6


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
        mean2d, cov = unscented(mean, factor, pinhole)
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
    mean2d, projected, k, w = naive_film(mean, factor, camera, model)
    cov = projected + model.low_pass * np.eye(2)
    opacity = 1 / (1 + math.exp(-gaussians.logit_opacities[n]))
    if model.antialiased:
        opacity *= math.sqrt(np.linalg.det(projected) / np.linalg.det(cov))
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


def naive_color(gaussians, camera, model, n, position) -> np.ndarray:
    """(3,) the colour of Gaussian n in the direction of its mean, or of a pixel's ray."""
    direction = gaussians.means[n] - camera.center
    if model.sh_direction == "pixel":
        ray = [(position[0] - camera.cx) / camera.fx, (position[1] - camera.cy) / camera.fy, 1]
        direction = camera.rotation.T @ ray
    degree = gaussians.sh_degree if model.sh_degree is None else model.sh_degree
    basis = legendre_sh_basis(tuple(direction / np.linalg.norm(direction)), degree)
    coefficients = np.concatenate([gaussians.sh0[n], gaussians.shN[n]])[: len(basis)]
    return np.maximum(basis @ coefficients + 0.5, 0)


def naive_image(gaussians, camera, model) -> SimpleNamespace:
    shape = camera.height, camera.width
    image, depth, transmittance = np.zeros((*shape, 3)), np.zeros(shape), np.ones(shape)
    splats = [naive_splat(gaussians, camera, n, model) for n in range(len(gaussians.means))]
    for pixel in np.ndindex(shape):
        position = np.array([pixel[1] + 0.5, pixel[0] + 0.5])
        hits = [(splat(position), n) for n, splat in enumerate(splats) if splat]
        hits = sorted((hit[1], n, hit[0], hit[2]) for hit, n in hits if hit)
        left, last = 1.0, -math.inf
        slope = (position - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        for key, n, alpha, z in hits:
            if (key - last) * math.hypot(*slope, 1) < model.step:
                continue
            last = key
            behind = left * (1 - alpha)
            if (behind if model.stop == "before" else left) < model.transmittance_stop:
                break
            image[pixel] += left * alpha * naive_color(gaussians, camera, model, n, position)
            depth[pixel] += left * alpha * z
            left = behind
        image[pixel] += left * BACKGROUND
        transmittance[pixel] = left
    return SimpleNamespace(image=image, depth=depth, transmittance=transmittance)


def assert_images_agree(rendered, expected, atol) -> None:
    for name in ("image", "depth", "transmittance"):
        found, wanted = getattr(rendered, name), getattr(expected, name)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=atol, err_msg=name)
