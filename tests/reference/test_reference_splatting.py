"""The float64 reference against central differences, a per-pixel loop, and gsplat's image."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from support.reference_scenes import (
    BACKGROUND,
    PARAMETERS,
    cotangents,
    legendre_sh_basis,
    numeric_gradients,
    rotation_about,
    small_scene,
)

from drgs.reference import splatting as reference
from drgs.reference.splatting import Gaussians

# ----------------------------------------------------------------------------------------------
# Central differences
# ----------------------------------------------------------------------------------------------


CLEARANCE = 5e-4


# The difference quotient is off by STEP^2 / 6 times the third derivative, which at 100 per world
# unit is 2e-9 of the derivative, and by rounding, 1e-16 / STEP = 1e-10 a pixel. Measured:
# below 1e-8 of the largest gradient of an array.
TOLERANCE = 1e-7


def assert_gradients_agree(analytic, numeric) -> None:
    """Compare dictionaries of arrays; the message lists the worst elements of each array."""
    lines = []
    for name, expected in numeric.items():
        assert analytic[name].shape == expected.shape, name
        tolerance = TOLERANCE * np.abs(expected).max()
        assert tolerance > 0, f"{name}: the gradient is zero everywhere, nothing is checked"
        errors = np.abs(analytic[name] - expected)
        bad = [index for index in np.ndindex(errors.shape) if not errors[index] <= tolerance]
        lines += [
            f"{name}{list(index)}: numeric {expected[index]:.9g}, analytic "
            f"{analytic[name][index]:.9g}, tolerance {tolerance:.2g}"
            for index in sorted(bad, key=lambda index: -errors[index])[:5]
        ]
    assert not lines, "\n".join(lines)


@cache
def small_scene_gradients(antialiased: bool, sh_degree: int) -> tuple[dict, dict]:
    """(analytic, numeric) for the small scene and random weights on every output."""
    gaussians, camera = small_scene()

    def outputs(background, **fields):
        rendered = reference.render(Gaussians(**fields), camera, background, sh_degree, antialiased)
        return rendered.image, rendered.alpha, rendered.depth

    weights = cotangents()
    parameters = {name: getattr(gaussians, name) for name in PARAMETERS}
    parameters["background"] = BACKGROUND
    numeric = numeric_gradients(outputs, list(weights.values()), parameters)
    analytic = reference.render_gradients(
        gaussians, camera, BACKGROUND, **weights, sh_degree=sh_degree, antialiased=antialiased
    )
    return analytic, numeric


@pytest.mark.parametrize("antialiased", [False, True])
def test_small_scene_is_clear_of_thresholds(antialiased):
    gaussians, camera = small_scene()
    rendered = reference.render(
        gaussians, camera, antialiased=antialiased, threshold_width=CLEARANCE
    )
    assert not rendered.near_threshold.any()


def test_small_scene_enters_every_branch():
    gaussians, camera = small_scene()
    splats = reference.project(gaussians, camera)
    assert list(np.flatnonzero(~splats.visible)) == [10, 11]
    assert splats.depths[10] < 0 and splats.opacities[11] < 1 / 255
    x, y, z = camera.rotation @ (gaussians.means[9] - camera.center)
    assert camera.fx * x / z + camera.cx > camera.width + 0.15 * camera.width
    assert camera.fy * y / z + camera.cy < -0.15 * camera.height

    colors = reference.sh_colors(gaussians, camera, 3)
    assert (colors[:9] == 0).any() and (colors[:9] > 0).any()

    def without(i):
        kept = np.arange(12) != i
        fields = {name: getattr(gaussians, name)[kept] for name in PARAMETERS}
        return reference.render(Gaussians(**fields), camera)

    rendered = reference.render(gaussians, camera)
    assert not np.array_equal(without(9).image, rendered.image)
    for antialiased in (False, True):
        brute = brute_force_image(gaussians, camera, BACKGROUND, 3, antialiased)
        assert brute["num_stopped"] >= 3 and brute["num_clamped"] >= 3


@pytest.mark.slow
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_degree", [3, 1])
def test_gradients_agree_with_central_differences(antialiased, sh_degree):
    analytic, numeric = small_scene_gradients(antialiased, sh_degree)
    assert_gradients_agree(analytic, numeric)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN", "means2d"):
        assert not analytic[name][10:].any(), f"{name}: culled rows must get zero"
    assert not analytic["shN"][:, (sh_degree + 1) ** 2 - 1 :].any()


@pytest.mark.slow
@pytest.mark.parametrize("name", [*PARAMETERS, "background"])
def test_gradient_check_fails_when_a_gradient_is_one_percent_too_large(name):
    analytic, numeric = small_scene_gradients(True, 3)
    with pytest.raises(AssertionError, match=rf"{name}\[.*numeric .*analytic .*tolerance"):
        assert_gradients_agree({**analytic, name: 1.01 * analytic[name]}, numeric)


def test_each_output_alone_has_the_right_gradients():
    """The three cotangents act linearly, and one that is None counts as zero."""
    gaussians, camera = small_scene()
    weights = cotangents()
    zero_image = np.zeros_like(weights["d_image"])
    together = reference.render_gradients(gaussians, camera, BACKGROUND, **weights)
    parts = [
        reference.render_gradients(gaussians, camera, BACKGROUND, weights["d_image"]),
        reference.render_gradients(
            gaussians, camera, BACKGROUND, zero_image, d_alpha=weights["d_alpha"]
        ),
        reference.render_gradients(
            gaussians, camera, BACKGROUND, zero_image, d_depth=weights["d_depth"]
        ),
    ]
    for name, expected in together.items():
        # Rounding only: a few hundred terms of the gradient's own size.
        np.testing.assert_allclose(
            sum(part[name] for part in parts), expected, rtol=0, atol=1e-12 * abs(expected).max()
        )
        assert all(part[name].any() for part in parts if name not in ("sh0", "shN", "background"))


def splats_2d(gaussians, camera) -> dict[str, np.ndarray]:
    splats = reference.project(gaussians, camera)
    return {
        "means2d": splats.means2d,
        "conics": splats.conics,
        "opacities": splats.opacities,
        "colors": reference.sh_colors(gaussians, camera, 3),
        "depths": splats.depths,
        "background": BACKGROUND,
    }


def test_composite_gradients_agree_with_central_differences():
    gaussians, camera = small_scene()
    visible = reference.project(gaussians, camera).visible
    splats = splats_2d(gaussians, camera)
    weights = cotangents()
    size = {"width": camera.width, "height": camera.height}

    # The three numbers of a dx^2 + 2 b dx dy + c dy^2 keep the perturbed matrix symmetric.
    def abc(matrices):
        return np.stack([matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]], axis=-1)

    def outputs(abc, **rest):
        a, b, c = abc.T
        conics = np.moveaxis(np.array([[a, b], [b, c]]), -1, 0)
        # A perturbed depth keeps its place: no two are within STEP of each other.
        rendered = reference.composite(conics=conics, visible=visible, **rest, **size)
        return rendered.image, rendered.alpha, rendered.depth

    parameters = {"abc": abc(splats["conics"]), **splats}
    del parameters["conics"]
    numeric = numeric_gradients(outputs, list(weights.values()), parameters)

    analytic = reference.composite_gradients(**splats, visible=visible, **size, **weights)
    analytic["abc"] = abc(analytic.pop("conics")) * [1, 2, 1]
    assert_gradients_agree(analytic, numeric)

    through_render = reference.render_gradients(gaussians, camera, BACKGROUND, **weights)
    np.testing.assert_array_equal(through_render["means2d"], analytic["means2d"])


# ----------------------------------------------------------------------------------------------
# The image
# ----------------------------------------------------------------------------------------------


def brute_force_image(gaussians, camera, background, sh_degree, antialiased) -> dict:
    """The image by scalar loops over pixels and Gaussians: no boxes, factors or order arrays."""
    splats = []
    for n in range(len(gaussians.means)):
        x, y, z = camera.rotation @ (gaussians.means[n] - camera.center)
        if z < camera.near:
            continue
        half = np.array([0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy])
        low = np.array([-camera.cx / camera.fx, -camera.cy / camera.fy])
        rx, ry = np.clip([x / z, y / z], low - 0.3 * half, low + 2.3 * half)
        jacobian = np.array(
            [
                [camera.fx / z, 0, -camera.fx * rx / z],
                [0, camera.fy / z, -camera.fy * ry / z],
            ]
        )
        w, *axis = gaussians.quats[n]
        turn = rotation_about(axis, 2 * math.atan2(np.linalg.norm(axis), w))
        sigma = turn @ np.diag(np.exp(2 * gaussians.log_scales[n])) @ turn.T
        projected = jacobian @ camera.rotation @ sigma @ camera.rotation.T @ jacobian.T
        filtered = projected + 0.3 * np.eye(2)
        opacity = 1 / (1 + math.exp(-gaussians.logit_opacities[n]))
        if antialiased:
            opacity *= math.sqrt(np.linalg.det(projected) / np.linalg.det(filtered))
        direction = gaussians.means[n] - camera.center
        basis = legendre_sh_basis(direction / np.linalg.norm(direction), sh_degree)
        coefficients = np.concatenate([gaussians.sh0[n], gaussians.shN[n]])[: len(basis)]
        color = np.maximum(basis @ coefficients + 0.5, 0)
        mean2d = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        splats.append((z, mean2d, np.linalg.inv(filtered), opacity, color))
    splats.sort(key=lambda splat: splat[0])

    image = np.zeros((camera.height, camera.width, 3))
    alpha_image = np.zeros((camera.height, camera.width))
    depth_image = np.zeros((camera.height, camera.width))
    num_stopped = num_clamped = 0
    for row in range(camera.height):
        for column in range(camera.width):
            transmittance = 1.0
            for z, mean2d, conic, opacity, color in splats:
                offset = np.array([column + 0.5, row + 0.5]) - mean2d
                alpha = opacity * math.exp(-0.5 * offset @ conic @ offset)
                num_clamped += alpha > 0.99
                alpha = min(float(np.float32(0.99)), alpha)
                if alpha < 1 / 255:
                    continue
                if transmittance * (1 - alpha) < 1e-4:
                    num_stopped += 1
                    break
                image[row, column] += transmittance * alpha * color
                depth_image[row, column] += transmittance * alpha * z
                transmittance *= 1 - alpha
            image[row, column] += transmittance * background
            alpha_image[row, column] = 1 - transmittance
    return {
        "image": image,
        "alpha": alpha_image,
        "depth": depth_image,
        "num_stopped": num_stopped,
        "num_clamped": num_clamped,
    }


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_image_equals_a_loop_over_pixels(antialiased, sh_degree):
    gaussians, camera = small_scene()
    expected = brute_force_image(gaussians, camera, BACKGROUND, sh_degree, antialiased)
    rendered = reference.render(gaussians, camera, BACKGROUND, sh_degree, antialiased)
    # Both are float64; the loop's determinants and inverses lose a digit or two.
    for name in ("image", "alpha", "depth"):
        np.testing.assert_allclose(getattr(rendered, name), expected[name], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rendered.alpha, 1 - rendered.transmittance)


def one_splat(opacities, offset=(0.0, 0.0), depths=None) -> reference.RenderedImage:
    """White splats of 1 px^2, stacked on the centre of the middle pixel of a 9 x 9 film."""
    n = len(opacities)
    return reference.composite(
        means2d=np.tile([4.5 - offset[0], 4.5 - offset[1]], (n, 1)),
        conics=np.tile(np.eye(2), (n, 1, 1)),
        opacities=np.array(opacities),
        colors=np.ones((n, 3)),
        depths=np.arange(1.0, n + 1) if depths is None else np.array(depths),
        visible=np.ones(n, dtype=bool),
        background=np.zeros(3),
        width=9,
        height=9,
    )


def test_single_splat_is_its_gaussian_above_the_cut():
    rendered = one_splat([0.5])
    assert rendered.alpha[4, 4] == 0.5
    assert rendered.alpha[4, 6] == pytest.approx(0.5 * math.exp(-2), abs=1e-15)
    assert rendered.alpha[4, 7] == pytest.approx(0.5 * math.exp(-4.5), abs=1e-15)  # 1.4 / 255
    assert rendered.alpha[4, 8] == 0.0  # 0.5 exp(-8) is below 1 / 255
    # z = 1; alpha is 1 - T, rounded at the size of 1.
    np.testing.assert_allclose(rendered.depth, rendered.alpha, rtol=0, atol=2e-16)


def test_splats_are_composited_by_depth_and_ties_by_index():
    rendered = one_splat([0.25, 0.5, 0.125], depths=[2.0, 1.0, 2.0])
    weights = [0.5, 0.5 * 0.25, 0.5 * 0.75 * 0.125]
    assert rendered.depth[4, 4] == weights[0] + 2 * weights[1] + 2 * weights[2]
    colors = np.eye(3)
    rendered = reference.composite(
        np.full((3, 2), 0.5), np.tile(np.eye(2), (3, 1, 1)), np.array([0.25, 0.5, 0.125]), colors,
        np.array([2.0, 1.0, 2.0]), np.ones(3, dtype=bool), np.zeros(3), 1, 1,
    )  # fmt: skip
    np.testing.assert_array_equal(rendered.image[0, 0], [weights[1], weights[0], weights[2]])


def test_a_hundred_ties_are_composited_by_index():
    """Enough of them that a sort which is not stable would reorder them."""
    opacities = np.linspace(0.01, 0.06, 100)
    depths = np.tile([2.0, 1.0], 50)
    order = [*range(1, 100, 2), *range(0, 100, 2)]
    transmittances = np.cumprod([1.0, *(1 - opacities[order])])[:-1]
    rendered = reference.composite(
        np.full((100, 2), 0.5), np.tile(np.eye(2), (100, 1, 1)), opacities,
        np.arange(100.0)[:, None] * np.ones(3), depths, np.ones(100, dtype=bool), np.zeros(3), 1, 1,
    )  # fmt: skip
    expected = np.sum(transmittances * opacities[order] * order)
    np.testing.assert_allclose(rendered.image[0, 0], expected, rtol=1e-13)


def test_second_clamped_splat_stops_the_pixel_as_in_single_precision():
    one = np.float32(1)
    behind = one * (one - np.float32(0.99)) * (one - np.float32(0.99))
    assert behind < np.float32(1e-4) and 0.01 * 0.01 >= 1e-4
    rendered = one_splat([0.999, 0.999])
    assert rendered.transmittance[4, 4] == 1 - float(np.float32(0.99))
    assert not rendered.near_threshold[4, 4]


@pytest.mark.parametrize("threshold", [1 / 255, 0.99])
def test_pixels_near_an_alpha_threshold_are_marked(threshold):
    # At 1/255 the splat's centre is half a pixel away: the opacity itself is above the cut.
    shift, gain = ((0.5, 0.0), math.exp(0.125)) if threshold < 0.5 else ((0.0, 0.0), 1.0)
    for relative, marked in [(-2e-6, False), (-5e-7, True), (5e-7, True), (2e-6, False)]:
        rendered = one_splat([threshold * (1 + relative) * gain], shift)
        assert rendered.near_threshold[4, 4] == marked, relative


def test_pixels_near_the_stop_are_marked():
    for relative, marked in [(-2e-6, False), (-5e-7, True), (5e-7, True), (2e-6, False)]:
        rendered = one_splat([0.95, 0.95, 1 - 1e-4 * (1 + relative) / 0.05**2])
        assert rendered.near_threshold[4, 4] == marked, relative
        assert (rendered.transmittance[4, 4] < 2e-4) == (relative > 0)
