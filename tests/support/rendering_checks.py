"""The whole chain's gradients and tangents against the float64 reference."""

import math
from dataclasses import replace
from functools import cache

import drjit as dr
import numpy as np
import pytest

from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.film import SamplePoints
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Cotangents,
    as_images,
    assert_arrays_agree,
    clear,
    device_gaussians,
    frame_tangent,
    kernel_gradients,
    plane_cotangents,
    reference_gradients,
    render,
    rows,
    single,
    stacked_scene,
)

GRADIENTS = {FLOAT64: 1e-12, FLOAT32: 5e-5}


CASES = [
    Case("degree 3", 37, 29, 3),
    Case("degree 2, antialiased", 37, 29, 2, antialiased=True),
    Case("degree 1", 29, 53, 1),
    Case("degree 0, antialiased", 37, 29, 0, antialiased=True),
    Case("degree 1 of 3", 70, 18, 3, sh_degree=1),
    Case("one pixel", 1, 1, 3, count=12),
    Case("5x3", 5, 3, 1, count=25, antialiased=True),
    Case("whole tiles", 64, 48, 2, count=80),
    Case("many", 40, 40, 0, count=300),
    Case("one splat", 20, 20, 0, count=1, seed=5),
    Case("stacked", 37, 29, 2, count=24, recipe=stacked_scene),
    Case("stacked, antialiased", 33, 17, 1, count=40, recipe=stacked_scene, antialiased=True),
]


@cache
def expected_gradients(case) -> dict[str, np.ndarray]:
    return reference_gradients(case, Cotangents.random(case))


def check_gradients_equal_the_reference(precision, case):
    """Compare the six parameters, the background (from the plane T) and the positions on the
    film."""
    case = clear(case)
    actual = kernel_gradients(case, precision, Cotangents.random(case))
    expected = expected_gradients(case)
    assert_arrays_agree(actual, expected, GRADIENTS[precision])
    lowered = (case.rendered_degree + 1) ** 2 - 1
    assert not actual["shN"][:, lowered:].any()
    # The comparison notices one percent, in every array.
    for name, values in actual.items():
        if values.any():
            with pytest.raises(AssertionError, match=rf"{name}\["):
                assert_arrays_agree({**actual, name: 1.01 * values}, expected, GRADIENTS[precision])


def random_direction(case, seed=7) -> reference.Gaussians:
    """One number for each parameter."""
    rng = np.random.default_rng(seed)
    return reference.Gaussians(
        **{n: single(rng.normal(0, 1, getattr(case.gaussians, n).shape)) for n in PARAMETER_NAMES}
    )


def kernel_tangent(case, precision, direction) -> dict[str, np.ndarray]:
    gaussians, frame = render(case, precision)
    tangents = device_gaussians(direction, precision)
    return as_images(frame_tangent(gaussians, frame, tangents), case.camera)


def check_adjoint_is_the_transpose_of_the_tangent(precision, case):
    case = clear(case)
    direction = random_direction(case)
    images = kernel_tangent(case, precision, direction)
    cotangents = Cotangents.random(case, seed=4)
    gradients = kernel_gradients(case, precision, cotangents)
    d_transmittance = cotangents.d_image @ case.background - cotangents.d_alpha
    left = [
        cotangents.d_image * images["color"],
        cotangents.d_depth * images["depth"],
        d_transmittance * images["transmittance"],
    ]
    right = [gradients[name] * getattr(direction, name) for name in PARAMETER_NAMES]
    size = math.sqrt(sum((term**2).sum() for term in [*left, *right]))
    assert size > 0
    pixels, parameters = (sum(term.sum() for term in terms) for terms in (left, right))
    # Relative to the root of the sum of the squared terms: the sums themselves may cancel.
    tolerance = GRADIENTS[precision]
    assert abs(pixels - parameters) <= tolerance * size


def check_tangent_equals_central_differences_of_the_reference(precision, case):
    case = clear(case)
    direction = random_direction(case)
    # ln(alpha) changes by at most some 1e3 per unit of a direction with a dozen components: no
    # decision flips, see NEAR_THRESHOLD. The error is step^2 / 6 = 1e-16 times third derivatives
    # of up to 1e8, and 1e-16 / step = 4e-9 from rounding.
    step = 2.0**-25

    def moved(sign):
        fields = {
            name: getattr(case.gaussians, name) + sign * step * getattr(direction, name)
            for name in PARAMETER_NAMES
        }
        return reference.render(
            reference.Gaussians(**fields), case.camera, np.zeros(3), case.rendered_degree,
            case.antialiased,
        )  # fmt: skip

    forward, backward = moved(1), moved(-1)
    expected = {
        key: (getattr(forward, name) - getattr(backward, name)) / (2 * step)
        for key, name in [
            ("color", "image"),
            ("depth", "depth"),
            ("transmittance", "transmittance"),
        ]
    }
    actual = kernel_tangent(case, precision, direction)
    assert_arrays_agree(actual, expected, max(1e-7, GRADIENTS[precision]))


CAMERA_FIELDS = ("rotation", "center", "fx", "fy", "cx", "cy")


@cache
def camera_differences(case) -> np.ndarray:
    """(18, 5, H W): each number of a camera's, by central differences of the reference's planes.

    A matrix that is no rotation is meant, too: it maps the world to the camera as any does.
    """
    step = 2.0**-25
    found = []
    for name in CAMERA_FIELDS:
        for index in np.ndindex(np.shape(getattr(case.camera, name))):
            planes = []
            for sign in (1, -1):
                value = np.array(getattr(case.camera, name))
                value[index] += sign * step
                rendered = reference.render(
                    case.gaussians, replace(case.camera, **{name: value}), np.zeros(3),
                    case.rendered_degree, case.antialiased,
                )  # fmt: skip
                images = [
                    rendered.transmittance,
                    *np.moveaxis(rendered.image, -1, 0),
                    rendered.depth,
                ]
                planes.append(np.reshape(images, (5, -1)))
            found.append((planes[0] - planes[1]) / (2 * step))
    return np.array(found)


def two_frames(case) -> tuple[Gaussians, list[rendering.Frame]]:
    gaussians, frame = render(case, FLOAT64)
    return gaussians, [frame, frame]


def check_camera_gradients_of_two_frames_equal_differences_of_the_reference(case):
    """And those of the parameters are the reference's. Differences: as for the tangents.

    The second frame has two samples per pixel.
    """
    case = clear(case)
    gaussians, (frame, _) = two_frames(case)
    centers = dr.full(FLOAT64.Float, 0.5, 2 * case.width * case.height)
    points = SamplePoints(centers, centers, samples=2)
    model = replace(frame.pipeline.model, positions=points)
    frames = [frame, rendering.render_again(frame, model)]
    cotangents = Cotangents.random(case)
    d_features, d_transmittance = plane_cotangents(case, cotangents, FLOAT64)
    weights = [d_transmittance, *d_features]
    parts = [[0.25 * w for w in weights], [dr.tile(0.375 * w, 2) for w in weights]]
    gradients = rendering.frames_adjoint(gaussians, frames, parts, of_camera=True)
    expected = np.sum(camera_differences(case) * rows(weights).T, axis=(1, 2))
    actual = rows(gradients.camera)[0]
    assert_arrays_agree({"camera": actual}, {"camera": expected}, 1e-7)
    assert_arrays_agree(
        {name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
        {name: reference_gradients(case, cotangents)[name] for name in PARAMETER_NAMES},
        GRADIENTS[FLOAT64],
    )


def check_camera_tangents_of_two_frames_equal_differences_of_the_reference(case):
    case = clear(case)
    gaussians, frames = two_frames(case)
    direction = np.random.default_rng(3).normal(size=len(camera_differences(case)))
    still = device_gaussians(
        reference.Gaussians(
            **{n: np.zeros_like(getattr(case.gaussians, n)) for n in PARAMETER_NAMES}
        ),
        FLOAT64,
    )
    tangents = [FLOAT64.Float(number) for number in direction]
    expected = np.einsum("i,ijk->jk", direction, camera_differences(case))
    for planes in rendering.frames_tangent(gaussians, frames, still, tangents):
        assert_arrays_agree({"planes": rows(planes).T}, {"planes": expected}, 1e-7)
