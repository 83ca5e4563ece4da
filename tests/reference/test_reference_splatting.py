"""The float64 reference against central differences, a per-pixel loop, and gsplat's picture."""

from __future__ import annotations

import math
import warnings
from functools import cache

import numpy as np
import pytest
from conftest import SHARED_DATA

from drgs.reference import splatting as reference
from drgs.reference.splatting import Camera, Gaussians

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
GSPLAT = SHARED_DATA / "gsplat_reference"

# ----------------------------------------------------------------------------------------------
# A small scene that enters every branch
# ----------------------------------------------------------------------------------------------


def rotation_about(axis, angle) -> np.ndarray:
    """(3, 3) by Rodrigues' formula: not a quaternion's."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def small_camera() -> Camera:
    """Rotated, away from the origin, with an off-centre principal point and fx != fy."""
    return Camera(
        rotation=rotation_about([0.3, -1.0, 0.5], 0.7),
        center=np.array([0.4, -0.7, 1.1]),
        fx=23.0,
        fy=19.0,
        cx=13.6,
        cy=8.3,
        width=24,
        height=20,
    )


def small_scene() -> tuple[Gaussians, Camera]:
    """12 Gaussians of degree 3 on a 24 x 20 film.

    0 to 4 anything; 5 a wall behind them, so opaque that its alpha is clamped; 6 to 8 a stack
    that stops pixels; 9 so far outside the film that both ratios in the Jacobian are clamped, and
    large enough to reach into it; 10 behind the camera; 11 too transparent to be seen.
    """
    rng = np.random.default_rng(8)
    camera = small_camera()
    points = np.column_stack(
        [rng.uniform(-0.8, 0.7, 12), rng.uniform(-0.6, 0.8, 12), rng.uniform(1.4, 3.0, 12)]
    )
    points[5] = [-0.65, 0.3, 2.9]
    points[6:9] = [[0.10, 0.05, 1.5], [0.06, 0.09, 1.8], [0.12, 0.11, 2.1]]
    points[9] = [2.1, -1.3, 2.0]
    points[10] = [0.1, 0.2, -1.0]
    log_scales = rng.normal(np.log(0.15), 0.4, (12, 3))
    log_scales[5] = np.log([1.4, 1.8, 1.6])
    log_scales[6:9] = np.log([0.4, 0.3, 0.5])
    log_scales[9] = np.log([0.7, 0.5, 0.6])
    logit_opacities = rng.normal(0.8, 0.8, 12)
    logit_opacities[5:9] = [9.0, 5.0, 5.0, 5.0]
    logit_opacities[11] = -6.0
    gaussians = Gaussians(
        means=points @ camera.rotation + camera.center,
        quats=rng.normal(0, 1, (12, 4)) * rng.uniform(0.3, 3.0, (12, 1)),
        log_scales=log_scales,
        logit_opacities=logit_opacities,
        sh0=rng.normal(0, 1.2, (12, 1, 3)),
        shN=rng.normal(0, 0.3, (12, 15, 3)),
    )
    return gaussians, camera


BACKGROUND = np.array([0.9, 0.4, 0.2])


def cotangents() -> dict[str, np.ndarray]:
    """One random weight for each number of the picture."""
    rng = np.random.default_rng(5)
    return {
        "d_image": rng.normal(0, 1, (20, 24, 3)),
        "d_alpha": rng.normal(0, 1, (20, 24)),
        "d_depth": rng.normal(0, 1, (20, 24)),
    }


# ----------------------------------------------------------------------------------------------
# Central differences
# ----------------------------------------------------------------------------------------------

# The largest change of log(alpha) for a step of a mean is |A d| f / z with |A d| below
# sqrt(2 ln 255 / 0.3) = 6.1 per px and f / z below 23 / 1.4: 100 per world unit, so 1e-4 for
# this step. For a step of a conic's number it is d^2 / 2, below 24^2 / 2 = 288 or 3e-4; the
# other parameters change it less. The scene has no pixel within 5e-4 of a threshold, which a
# test asserts: no perturbation flips a decision.
STEP = 1e-6
CLEARANCE = 5e-4

# The difference quotient is off by STEP^2 / 6 times the third derivative, which at 100 per world
# unit is 2e-9 of the derivative, and by rounding, 1e-16 / STEP = 1e-10 a pixel. Measured:
# below 1e-8 of the largest gradient of an array.
TOLERANCE = 1e-7


def numeric_gradients(outputs, weights, parameters) -> dict[str, np.ndarray]:
    """Central differences of sum(weight * output), differences taken before sums.

    outputs: a function of keyword arrays that returns a list of arrays like ``weights``.
    """
    gradients = {}
    for name, value in parameters.items():
        value = np.asarray(value, dtype=np.float64)
        gradient = np.zeros_like(value)
        for index in np.ndindex(value.shape):
            moved = value.copy()
            moved[index] = value[index] + STEP
            forward = outputs(**{**parameters, name: moved})
            moved[index] = value[index] - STEP
            backward = outputs(**{**parameters, name: moved})
            gradient[index] = sum(
                np.sum(w * (f - b)) for w, f, b in zip(weights, forward, backward, strict=True)
            ) / (2 * STEP)
        gradients[name] = gradient
    return gradients


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
        picture = reference.render(Gaussians(**fields), camera, background, sh_degree, antialiased)
        return picture.image, picture.alpha, picture.depth

    weights = cotangents()
    parameters = {name: getattr(gaussians, name) for name in PARAMETERS}
    parameters["background"] = BACKGROUND
    numeric = numeric_gradients(outputs, list(weights.values()), parameters)
    analytic = reference.render_gradients(
        gaussians, camera, BACKGROUND, **weights, sh_degree=sh_degree, antialiased=antialiased
    )
    return analytic, numeric


@pytest.mark.parametrize("antialiased", [False, True])
def test_small_scene_keeps_clear_of_thresholds(antialiased):
    gaussians, camera = small_scene()
    picture = reference.render(
        gaussians, camera, antialiased=antialiased, threshold_width=CLEARANCE
    )
    assert not picture.near_threshold.any()


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

    picture = reference.render(gaussians, camera)
    assert not np.array_equal(without(9).image, picture.image)
    for antialiased in (False, True):
        brute = brute_force_picture(gaussians, camera, BACKGROUND, 3, antialiased)
        assert brute["num_stopped"] >= 3 and brute["num_clamped"] >= 3


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_degree", [3, 1])
def test_gradients_agree_with_central_differences(antialiased, sh_degree):
    analytic, numeric = small_scene_gradients(antialiased, sh_degree)
    assert_gradients_agree(analytic, numeric)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN", "means2d"):
        assert not analytic[name][10:].any(), f"{name}: culled rows must get zero"
    assert not analytic["shN"][:, (sh_degree + 1) ** 2 - 1 :].any()


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
        picture = reference.composite(conics=conics, visible=visible, **rest, **size)
        return picture.image, picture.alpha, picture.depth

    parameters = {"abc": abc(splats["conics"]), **splats}
    del parameters["conics"]
    numeric = numeric_gradients(outputs, list(weights.values()), parameters)

    analytic = reference.composite_gradients(**splats, visible=visible, **size, **weights)
    analytic["abc"] = abc(analytic.pop("conics")) * [1, 2, 1]
    assert_gradients_agree(analytic, numeric)

    through_render = reference.render_gradients(gaussians, camera, BACKGROUND, **weights)
    np.testing.assert_array_equal(through_render["means2d"], analytic["means2d"])


# ----------------------------------------------------------------------------------------------
# The picture
# ----------------------------------------------------------------------------------------------


def brute_force_picture(gaussians, camera, background, sh_degree, antialiased) -> dict:
    """The picture by scalar loops over pixels and Gaussians: no boxes, factors or order arrays."""
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
        sharp = jacobian @ camera.rotation @ sigma @ camera.rotation.T @ jacobian.T
        blurred = sharp + 0.3 * np.eye(2)
        opacity = 1 / (1 + math.exp(-gaussians.logit_opacities[n]))
        if antialiased:
            opacity *= math.sqrt(np.linalg.det(sharp) / np.linalg.det(blurred))
        direction = gaussians.means[n] - camera.center
        basis = legendre_sh_basis(direction / np.linalg.norm(direction), sh_degree)
        coefficients = np.concatenate([gaussians.sh0[n], gaussians.shN[n]])[: len(basis)]
        color = np.maximum(basis @ coefficients + 0.5, 0)
        mean2d = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        splats.append((z, mean2d, np.linalg.inv(blurred), opacity, color))
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
def test_picture_equals_a_loop_over_pixels(antialiased, sh_degree):
    gaussians, camera = small_scene()
    expected = brute_force_picture(gaussians, camera, BACKGROUND, sh_degree, antialiased)
    picture = reference.render(gaussians, camera, BACKGROUND, sh_degree, antialiased)
    # Both are float64; the loop's determinants and inverses lose a digit or two.
    for name in ("image", "alpha", "depth"):
        np.testing.assert_allclose(getattr(picture, name), expected[name], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(picture.alpha, 1 - picture.transmittance)


def one_splat(opacities, offset=(0.0, 0.0), depths=None) -> reference.Picture:
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


def test_one_splat_is_its_gaussian_where_it_reaches_the_cut():
    picture = one_splat([0.5])
    assert picture.alpha[4, 4] == 0.5
    assert picture.alpha[4, 6] == pytest.approx(0.5 * math.exp(-2), abs=1e-15)
    assert picture.alpha[4, 7] == pytest.approx(0.5 * math.exp(-4.5), abs=1e-15)  # 1.4 / 255
    assert picture.alpha[4, 8] == 0.0  # 0.5 exp(-8) is below 1 / 255
    # z = 1; alpha is 1 - T, rounded at the size of 1.
    np.testing.assert_allclose(picture.depth, picture.alpha, rtol=0, atol=2e-16)


def test_splats_are_composited_by_depth_and_ties_by_index():
    picture = one_splat([0.25, 0.5, 0.125], depths=[2.0, 1.0, 2.0])
    weights = [0.5, 0.5 * 0.25, 0.5 * 0.75 * 0.125]
    assert picture.depth[4, 4] == weights[0] + 2 * weights[1] + 2 * weights[2]
    colors = np.eye(3)
    picture = reference.composite(
        np.full((3, 2), 0.5), np.tile(np.eye(2), (3, 1, 1)), np.array([0.25, 0.5, 0.125]), colors,
        np.array([2.0, 1.0, 2.0]), np.ones(3, dtype=bool), np.zeros(3), 1, 1,
    )  # fmt: skip
    np.testing.assert_array_equal(picture.image[0, 0], [weights[1], weights[0], weights[2]])


def test_a_hundred_ties_are_composited_by_index():
    """Enough of them that a sort which is not stable would reorder them."""
    opacities = np.linspace(0.01, 0.06, 100)
    depths = np.tile([2.0, 1.0], 50)
    order = [*range(1, 100, 2), *range(0, 100, 2)]
    transmittances = np.cumprod([1.0, *(1 - opacities[order])])[:-1]
    picture = reference.composite(
        np.full((100, 2), 0.5), np.tile(np.eye(2), (100, 1, 1)), opacities,
        np.arange(100.0)[:, None] * np.ones(3), depths, np.ones(100, dtype=bool), np.zeros(3), 1, 1,
    )  # fmt: skip
    expected = np.sum(transmittances * opacities[order] * order)
    np.testing.assert_allclose(picture.image[0, 0], expected, rtol=1e-13)


def test_second_clamped_splat_stops_the_pixel_as_in_single_precision():
    one = np.float32(1)
    behind = one * (one - np.float32(0.99)) * (one - np.float32(0.99))
    assert behind < np.float32(1e-4) and 0.01 * 0.01 >= 1e-4
    picture = one_splat([0.999, 0.999])
    assert picture.transmittance[4, 4] == 1 - float(np.float32(0.99))
    assert not picture.near_threshold[4, 4]


@pytest.mark.parametrize("threshold", [1 / 255, 0.99])
def test_pixels_near_an_alpha_threshold_are_marked(threshold):
    # At 1/255 the splat's centre is half a pixel away: the opacity itself is above the cut.
    shift, gain = ((0.5, 0.0), math.exp(0.125)) if threshold < 0.5 else ((0.0, 0.0), 1.0)
    for relative, marked in [(-2e-6, False), (-5e-7, True), (5e-7, True), (2e-6, False)]:
        picture = one_splat([threshold * (1 + relative) * gain], shift)
        assert picture.near_threshold[4, 4] == marked, relative


def test_pixels_near_the_stop_are_marked():
    for relative, marked in [(-2e-6, False), (-5e-7, True), (5e-7, True), (2e-6, False)]:
        picture = one_splat([0.95, 0.95, 1 - 1e-4 * (1 + relative) / 0.05**2])
        assert picture.near_threshold[4, 4] == marked, relative
        assert (picture.transmittance[4, 4] < 2e-4) == (relative > 0)


# ----------------------------------------------------------------------------------------------
# Stages
# ----------------------------------------------------------------------------------------------


def legendre_sh_basis(direction, degree) -> np.ndarray:
    """(K,) from associated Legendre functions, with the Condon-Shortley phase, and angles."""
    x, y, z = direction
    azimuth, sine = math.atan2(y, x), math.hypot(x, y)
    basis = []
    for ell in range(degree + 1):
        for m in range(-ell, ell + 1):
            order = abs(m)
            legendre = np.polynomial.Legendre.basis(ell)
            derivative = legendre.deriv(order) if order else legendre
            associated = (-1) ** order * sine**order * derivative(z)
            norm = (2 * ell + 1) / (4 * math.pi)
            norm *= math.factorial(ell - order) / math.factorial(ell + order)
            angular = math.cos(m * azimuth) if m >= 0 else math.sin(order * azimuth)
            basis.append(math.sqrt(norm * (2 if m else 1)) * associated * angular)
    return np.array(basis)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_basis_equals_legendre_functions(degree):
    directions = np.random.default_rng(0).normal(0, 1, (20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = [legendre_sh_basis(direction, degree) for direction in directions]
    np.testing.assert_allclose(reference.sh_basis(directions, degree), expected, atol=1e-14)


def test_sh_basis_is_orthonormal():
    """Exact quadrature: products have degree 6; 4 Gauss nodes in z and 7 azimuths suffice."""
    nodes, node_weights = np.polynomial.legendre.leggauss(4)
    azimuths = 2 * np.pi * np.arange(7) / 7
    z, azimuth = (a.ravel() for a in np.meshgrid(nodes, azimuths, indexing="ij"))
    sine = np.sqrt(1 - z**2)
    directions = np.column_stack([sine * np.cos(azimuth), sine * np.sin(azimuth), z])
    weights = np.repeat(node_weights, 7) * 2 * np.pi / 7
    basis = reference.sh_basis(directions, 3)
    np.testing.assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(16), atol=1e-14)


def test_rotation_matrices_are_rotations_whatever_the_norm():
    rng = np.random.default_rng(1)
    quats = rng.normal(0, 1, (50, 4))
    rotations = reference.quat_to_rotation(quats)
    products = rotations @ np.swapaxes(rotations, 1, 2)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (50, 1, 1)), atol=1e-15 * 4)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-14)
    scaled = quats * rng.uniform(1e-6, 1e6, (50, 1))
    np.testing.assert_allclose(reference.quat_to_rotation(scaled), rotations, atol=1e-14)
    quarter_turn_about_z = reference.quat_to_rotation(np.array([[1.0, 0, 0, 1]]))[0]
    np.testing.assert_allclose(quarter_turn_about_z @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_zero_quaternion_is_the_identity_and_has_no_gradient():
    np.testing.assert_array_equal(reference.quat_to_rotation(np.zeros((1, 4)))[0], np.eye(3))
    gaussians, camera = small_scene()
    quats = gaussians.quats.copy()
    quats[0] = 0
    changed = Gaussians(**{**vars(gaussians), "quats": quats})
    gradients = reference.render_gradients(changed, camera, BACKGROUND, **cotangents())
    assert not gradients["quats"][0].any() and gradients["quats"][1].any()
    assert all(np.isfinite(gradient).all() for gradient in gradients.values())


def test_covariance_has_the_squared_scales_as_eigenvalues():
    gaussians, _ = small_scene()
    eigenvalues = np.linalg.eigvalsh(reference.covariances(gaussians.quats, gaussians.log_scales))
    expected = np.sort(np.exp(2 * gaussians.log_scales), axis=1)
    np.testing.assert_allclose(eigenvalues, expected, rtol=1e-12)


def test_projected_covariance_is_the_sandwich_with_a_numeric_jacobian():
    gaussians, camera = small_scene()
    splats = reference.project(gaussians, camera)
    sigma = reference.covariances(gaussians.quats, gaussians.log_scales)

    def film_position(point):
        x, y, z = camera.rotation @ (point - camera.center)
        return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])

    for n in range(9):
        mean = gaussians.means[n]
        np.testing.assert_allclose(film_position(mean), splats.means2d[n], rtol=1e-14)
        jacobian = np.column_stack(
            [
                (film_position(mean + step) - film_position(mean - step)) / 2e-5
                for step in 1e-5 * np.eye(3)
            ]
        )
        expected = jacobian @ sigma[n] @ jacobian.T + 0.3 * np.eye(2)
        # Central differences with a step of 1e-5: third derivatives over 6 times 1e-10.
        np.testing.assert_allclose(splats.cov2d[n], expected, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(splats.conics[n] @ splats.cov2d[n], np.eye(2), atol=1e-13)


def needle(log_scales) -> tuple[Gaussians, Camera]:
    """One Gaussian on the axis at z = 1, its long axis at 45 degrees on the film, f = 1 px."""
    camera = Camera(np.eye(3), np.zeros(3), 1.0, 1.0, 4.0, 4.0, 8, 8)
    eighth_turn = [math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]
    return (
        Gaussians(
            means=[[0, 0, 1]],
            quats=[eighth_turn],
            log_scales=[log_scales],
            logit_opacities=[3.0],
            sh0=np.zeros((1, 1, 3)),
            shN=np.zeros((1, 0, 3)),
        ),
        camera,
    )


def test_needle_keeps_its_determinant():
    """cov2d = l^2 v v^T + 0.3 I, v at 45 degrees; entries of 1e14 would cancel to 1e-2."""
    gaussians, camera = needle(np.log([1e7, 1e-7, 1e-7]))
    conic = reference.project(gaussians, camera).conics[0]
    half, det = 0.5e14, 0.3 * (1e14 + 0.3) + 1.0
    np.testing.assert_allclose(conic, np.array([[half, -half], [-half, half]]) / det, rtol=1e-13)
    opacity = reference.project(gaussians, camera, antialiased=True).opacities[0]
    assert opacity == pytest.approx(1 / (1 + math.exp(-3)) * math.sqrt(1 / det), rel=1e-9)


def test_lone_splat_smaller_than_a_pixel_keeps_its_energy_when_antialiased():
    """Compensated, a splat's integral o 2 pi sqrt(det cov2d) is that of the sharp one."""
    gaussians, camera = needle(np.log([0.02, 0.03, 1e-3]))
    splats = reference.project(gaussians, camera, antialiased=True)
    energy = splats.opacities[0] * math.sqrt(np.linalg.det(splats.cov2d[0]))
    assert energy == pytest.approx(1 / (1 + math.exp(-3)) * 0.02 * 0.03, rel=1e-12)


# ----------------------------------------------------------------------------------------------
# Degenerate input
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("antialiased", [False, True])
def test_culled_and_degenerate_gaussians_raise_no_warning_and_change_nothing(antialiased):
    """At and behind the camera's centre, on its plane, flat, huge, tiny and transparent ones."""
    gaussians, camera = small_scene()
    strange_points = np.array(
        [[0, 0, 0], [0, 0, -1], [1e3, 0, 0], [0, 1e30, -1e30], [0, 0, 0.0099], [0.1, 0, 2]]
    )
    m = len(strange_points)
    log_scales = np.tile(np.log([0.1, 0.1, 0.1]), (m, 1))
    log_scales[1] = 80.0
    log_scales[2] = -np.inf
    logit_opacities = np.full(m, 1e3)
    logit_opacities[5] = -1e3
    strange = {
        "means": strange_points @ camera.rotation + camera.center,
        "quats": np.zeros((m, 4)),
        "log_scales": log_scales,
        "logit_opacities": logit_opacities,
        "sh0": np.ones((m, 1, 3)),
        "shN": np.ones((m, 15, 3)),
    }
    both = Gaussians(
        **{name: np.concatenate([getattr(gaussians, name), strange[name]]) for name in PARAMETERS}
    )
    with warnings.catch_warnings(), np.errstate(divide="raise", over="raise", invalid="raise"):
        warnings.simplefilter("error")
        picture = reference.render(both, camera, BACKGROUND, antialiased=antialiased)
        gradients = reference.render_gradients(
            both, camera, BACKGROUND, **cotangents(), antialiased=antialiased
        )
    alone = reference.render(gaussians, camera, BACKGROUND, antialiased=antialiased)
    np.testing.assert_array_equal(picture.image, alone.image)
    alone = reference.render_gradients(
        gaussians, camera, BACKGROUND, **cotangents(), antialiased=antialiased
    )
    for name in (*PARAMETERS, "means2d"):
        # Batched matrix products may round differently in batches of another size.
        np.testing.assert_allclose(gradients[name][:12], alone[name], rtol=1e-12, atol=1e-12)
        assert not gradients[name][12:].any(), name


def test_no_gaussians_show_the_background():
    camera = small_camera()
    empty = Gaussians(
        np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 1, 3)),
        np.zeros((0, 15, 3)),
    )  # fmt: skip
    picture = reference.render(empty, camera, BACKGROUND)
    np.testing.assert_array_equal(picture.image, np.broadcast_to(BACKGROUND, (20, 24, 3)))
    gradients = reference.render_gradients(empty, camera, BACKGROUND, **cotangents())
    assert gradients["shN"].shape == (0, 15, 3)
    np.testing.assert_allclose(
        gradients["background"], cotangents()["d_image"].sum(axis=(0, 1)), rtol=1e-12
    )


def test_wrong_shapes_and_degrees_are_refused_by_name():
    gaussians, camera = small_scene()
    with pytest.raises(ValueError, match="quats must have shape"):
        Gaussians(**{**vars(gaussians), "quats": gaussians.quats[:5]})
    with pytest.raises(ValueError, match="shN must have shape"):
        Gaussians(**{**vars(gaussians), "shN": gaussians.shN[:, :7]})
    with pytest.raises(ValueError, match="center must have shape"):
        Camera(**{**vars(camera), "center": np.zeros(4)})
    with pytest.raises(ValueError, match="near must be > 0"):
        Camera(**{**vars(camera), "near": 0.0})
    with pytest.raises(ValueError, match="degree must be 0 to 3, got 4"):
        reference.render(gaussians, camera, sh_degree=4)


# ----------------------------------------------------------------------------------------------
# gsplat
# ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gsplat_scene():
    """10,000 Gaussians, their camera, and gsplat's single-precision picture and gradients."""
    if not GSPLAT.is_dir():
        pytest.skip("needs the gsplat reference data beside the repository")
    data, pose = np.load(GSPLAT / "gauss_10k.npz"), np.load(GSPLAT / "cam.npz")
    scales, opacities = data["scales"].astype(float), data["opacities"].astype(float)
    gaussians = Gaussians(
        means=data["means"],
        quats=data["quats"],
        log_scales=np.log(scales),
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        sh0=data["sh"][:, :1],
        shN=data["sh"][:, 1:],
    )
    viewmat, intrinsics = pose["viewmat"].astype(float), pose["K"].astype(float)
    camera = Camera(
        rotation=viewmat[:3, :3],
        center=-np.linalg.solve(viewmat[:3, :3], viewmat[:3, 3]),
        fx=intrinsics[0, 0],
        fy=intrinsics[1, 1],
        cx=intrinsics[0, 2],
        cy=intrinsics[1, 2],
        width=int(pose["width"]),
        height=int(pose["height"]),
    )
    return gaussians, camera, np.load(GSPLAT / "ref_10k.npy"), np.load(GSPLAT / "refgrad_10k.npz")


def test_picture_agrees_with_gsplat(gsplat_scene):
    gaussians, camera, expected, _ = gsplat_scene
    picture = reference.render(gaussians, camera, np.ones(3))
    errors = np.abs(picture.image - expected)
    # Single precision: positions of 200 px carry 1e-5 px; measured 6.7e-7 on average.
    assert errors.mean() <= 2e-6
    # That is 5e-5 relative in an alpha near the cut, which then flips; measured 4 pixels, at
    # all of which the reference itself is as near to the cut.
    far = errors.max(axis=-1) > 1e-4
    assert far.mean() <= 1e-4
    marked = reference.render(gaussians, camera, np.ones(3), threshold_width=1e-4).near_threshold
    assert marked[far].all()


def test_gradients_agree_with_gsplat(gsplat_scene):
    gaussians, camera, _, expected = gsplat_scene
    gradients = reference.render_gradients(gaussians, camera, np.ones(3), expected["w"])
    # gsplat's are with respect to activated values: ds = s dlog(s), do = o (1 - o) dlogit(o).
    opacities = reference.sigmoid(gaussians.logit_opacities)
    activated = {
        "means": gradients["means"],
        "quats": gradients["quats"],
        "scales": gradients["log_scales"] / np.exp(gaussians.log_scales),
        "opacities": gradients["logit_opacities"] / (opacities * (1 - opacities)),
        "sh": np.concatenate([gradients["sh0"], gradients["shN"]], axis=1),
    }
    for name, ours in activated.items():
        theirs = expected[name].astype(float)
        cosine = np.sum(ours * theirs) / np.linalg.norm(ours) / np.linalg.norm(theirs)
        assert cosine >= 0.9999, name
        # Measured at most 4e-4, nearly all of it in the Gaussians of the four flipped pixels.
        assert np.linalg.norm(ours - theirs) <= 1e-3 * np.linalg.norm(theirs), name
