"""Crop windows and the image model, on random scenes."""

from dataclasses import replace
from itertools import pairwise, product

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.helpers import (
    FLOAT32,
    assert_arrays_agree,
    both_precisions,
    device_camera,
    rows,
    single,
)
from support.random_scenes import (
    KINDS,
    ROUNDOFF,
    Result,
    assert_agree,
    assume_decided,
    cases,
    changed,
    examples,
    image_planes,
    point_at,
    random_weights,
    result_of,
    seeds,
    sizes,
    stored,
    taken,
    undecided_pixels,
    uploaded,
    with_row,
)
from support.views import Scene, View, image_of

import drgs  # noqa: F401  (registers the plugin)
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from drgs.splatting.projection import plain_opacity


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Random scenes
# ----------------------------------------------------------------------------------------------


@st.composite
def plugin_scenes(draw) -> Scene:
    """The same for the plugin, on black."""
    degree, antialiased = draw(st.sampled_from(KINDS))
    view = View("random", draw(sizes), draw(sizes), fov=draw(st.sampled_from([30.0, 50.0, 80.0])))
    return Scene(
        view, degree, antialiased=antialiased, background=(0.0, 0.0, 0.0),
        count=draw(st.integers(4, 60)), seed=draw(seeds),
    )  # fmt: skip


# ----------------------------------------------------------------------------------------------
# Rendering
# ----------------------------------------------------------------------------------------------


def rendered(case, precision, gaussians) -> dict[str, np.ndarray]:
    """The image of other Gaussians than the case's."""
    gaussians = uploaded(gaussians, precision)
    return image_planes(
        rendering.render(gaussians, device_camera(case.camera, precision), case.pipeline)
    )


# The principal point, the sum with it, and a pixel's distance from it, twice.
CROPPED = 6 * 64


# ----------------------------------------------------------------------------------------------
# Crop windows
# ----------------------------------------------------------------------------------------------


def pieces(width, height, x, y) -> list[tuple[int, int, int, int]]:
    """The up to four (x, y, width, height) px into which a film is cut at column x and row y."""
    columns, lines = (0, min(x, width), width), (0, min(y, height), height)
    return [
        (x0, y0, x1 - x0, y1 - y0)
        for (x0, x1), (y0, y1) in product(pairwise(columns), pairwise(lines))
        if x1 > x0 and y1 > y0
    ]


def window_of(camera, piece, precision):
    """The camera of a piece of the film, on the device."""
    x, y, width, height = piece
    moved = replace(camera, cx=camera.cx - x, cy=camera.cy - y, width=width, height=height)
    film = (-x, -y, camera.width - x, camera.height - y)
    corners = [dr.opaque(precision.Float, v) for v in film]
    return replace(
        device_camera(moved, precision),
        film_start=precision.Array2f(corners[:2]),
        film_end=precision.Array2f(corners[2:]),
    )


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), sizes, sizes)
def test_crop_windows_compose_the_whole_image(precision, case, x, y):
    """And their gradients add up to those of the whole image."""
    assume_decided(case)
    undecided = undecided_pixels(case)
    weights = random_weights(case) * ~undecided
    expected = result_of(case, precision, weights)
    rendered = {name: np.full_like(values, np.nan) for name, values in expected.rendered.items()}
    gradients = {name: np.zeros_like(values) for name, values in expected.gradients.items()}
    for piece in pieces(case.width, case.height, x, y):
        x0, y0, width, height = piece
        window = slice(y0, y0 + height), slice(x0, x0 + width)
        camera = window_of(case.camera, piece, precision)
        part = result_of(case, precision, [w[window] for w in weights], camera=camera)
        for name, values in part.rendered.items():
            rendered[name][window] = values
        for name, values in part.gradients.items():
            gradients[name] = gradients[name] + values
    actual = Result(rendered, gradients)
    assert_agree(actual, expected, case.gaussians.quats, undecided, CROPPED * ROUNDOFF[precision])


@pytest.mark.slow
@examples
@given(plugin_scenes(), sizes, sizes)
def test_crop_windows_of_a_mitsuba_film_compose_the_whole_image(scene, x, y):
    undecided = undecided_pixels(scene)
    loaded = scene.load()
    whole, image = image_of(loaded), np.full((scene.view.height, scene.view.width, 4), np.nan)
    for piece in pieces(scene.view.width, scene.view.height, x, y):
        view = replace(scene.view, crop=piece)
        image[view.window] = image_of(loaded, sensor=mi.load_dict(view.sensor()))
    differs = (np.abs(image - whole) > 1.1 * CROPPED * ROUNDOFF[FLOAT32] * whole.max()).any(axis=-1)
    assert not (differs & ~undecided).any() and differs.sum() <= 1


# ----------------------------------------------------------------------------------------------
# The image model
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@examples
@given(plugin_scenes())
def test_white_minus_black_image_is_the_transmittance(scene):
    """In Mitsuba's film: three channels and alpha."""
    loaded = scene.load()
    black, white = image_of(loaded), image_of(replace(scene, background=(1.0, 1.0, 1.0)).load())
    integrator = loaded.integrator()
    camera = camera_from_sensor(read_sensor(loaded.sensors()[0], integrator.near))
    frame = rendering.render(integrator.gaussians, camera, integrator.pipeline)
    transmittance = rows(frame.planes()[0]).reshape(camera.height, camera.width)
    for image in (black, white):
        np.testing.assert_array_equal(image[..., 3], single(1 - transmittance))
    # color + transmittance is rounded once, and color is exact.
    difference = white[..., :3] - black[..., :3]
    error = np.abs(difference - transmittance[..., None])
    assert (error <= ROUNDOFF[FLOAT32] * white[..., :3]).all()


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), seeds)
def test_images_are_linear_in_the_features_and_weights_add_up_to_alpha(precision, case, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(0, 1, (2, case.count))
    s, t = rng.normal(0, 1, 2)
    columns = [stored(c, precision) for c in (a, b, s * a + t * b, np.ones(case.count))]
    pipeline = rendering.Pipeline(case.degree, plain_opacity, (lambda *_: columns,))
    gaussians = uploaded(case.gaussians, precision)
    frame = rendering.render(gaussians, device_camera(case.camera, precision), pipeline)
    transmittance, of_a, of_b, of_sum, of_one = (rows(plane) for plane in frame.planes())
    # Each splat rounds the transmittance and the sum once, and a few roundings precede.
    tolerance = 2 * (case.count + 4) * ROUNDOFF[precision]
    largest = np.abs(s * a).max() + np.abs(t * b).max()
    assert np.abs(s * of_a + t * of_b - of_sum).max() <= tolerance * largest
    assert np.abs(of_one - (1 - transmittance)).max() <= tolerance


@pytest.mark.slow
@both_precisions
@examples
@given(cases(least=2), seeds)
def test_scene_is_its_front_composited_over_its_back(precision, case, seed):
    """C = C_front + T_front C_back and T = T_front T_back, if no pixel stops.

    60 splats of an opacity of at most sigmoid(-2) leave a transmittance of 5e-4.
    """
    assume_decided(case)
    faint = changed(case.gaussians, logit_opacities=lambda logits: np.minimum(logits - 2, -2))
    depths = (faint.means - case.camera.center) @ case.camera.rotation[2]
    order, split = np.argsort(depths), np.random.default_rng(seed).integers(1, case.count)
    whole, front, back = (
        rendered(case, precision, taken(faint, indices))
        for indices in (order, order[:split], order[split:])
    )
    T = front["transmittance"]
    composed = {
        "image": front["image"] + T[..., None] * back["image"],
        "depth": front["depth"] + T * back["depth"],
        "transmittance": T * back["transmittance"],
    }
    # Each splat rounds the transmittance and the sums once, in either computation, and no term is
    # negative.
    tolerance = 4 * (case.count + 1) * ROUNDOFF[precision]
    assert_arrays_agree(composed, {name: whole[name] for name in composed}, tolerance)


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), seeds)
def test_farthest_splat_is_weighted_by_the_transmittance(precision, case, seed):
    """Nowhere more light comes through; what is lost has the splat's colour and depth."""
    rng = np.random.default_rng(seed)
    camera = case.camera
    mean = point_at(camera, rng.uniform(0, 1, 2) * [case.width, case.height], 5.0)
    z = camera.rotation[2] @ (mean - camera.center)
    color = rng.uniform(0, 1, 3)
    added = with_row(
        case.gaussians,
        rng.integers(0, case.count + 1),
        means=mean,
        log_scales=np.log(rng.uniform(0.5, 10, 3) * z / camera.fx),
        logit_opacities=rng.normal(0, 3),
        sh0=(color - 0.5) / reference.C_00,
        shN=0,
    )
    before, after = (rendered(case, precision, g) for g in (case.gaussians, added))
    lost = before["transmittance"] - after["transmittance"]
    assert (lost >= 0).all() and (after["transmittance"] >= reference.TRANSMITTANCE_STOP).all()
    for name, value in {"image": color, "depth": z}.items():
        gained = after[name] - before[name]
        assert not gained[lost == 0].any(), name
        expected = np.multiply.outer(lost, value)
        # A depth of 5 is rounded some six times, like MOVED; weight, transmittance and sum once.
        tolerance = 12 * ROUNDOFF[precision] * max(after[name].max(), np.max(value))
        assert np.abs(gained - expected).max() <= tolerance, name
