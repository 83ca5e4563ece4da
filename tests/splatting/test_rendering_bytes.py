"""The whole chain gives the same bytes, whatever the order of rows and the number of threads."""

from itertools import pairwise

import drjit as dr
import numpy as np
import pytest
from support.helpers import (
    Case,
    Cotangents,
    bitwise,
    both_precisions,
    device_camera,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
    plane_cotangents,
    single,
    stacked_scene,
)

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import rendering

CASES = [
    Case("degree 2, antialiased", 37, 29, 2, antialiased=True),
    Case("many", 40, 40, 0, count=300),
    Case("stacked", 37, 29, 2, count=24, recipe=stacked_scene),
]
BUSY = Case("busy", 100, 70, 1, count=400, seed=11)


def random_direction(case, seed=7) -> reference.Gaussians:
    """One number for each parameter."""
    rng = np.random.default_rng(seed)
    return reference.Gaussians(
        **{n: single(rng.normal(0, 1, getattr(case.gaussians, n).shape)) for n in PARAMETER_NAMES}
    )


def frame_and_gradients(case, precision, gaussians=None, order=None) -> dict[str, np.ndarray]:
    """Planes, and everything that the adjoint returns, as numpy arrays."""
    fields = gaussians or case.gaussians
    device = device_gaussians(fields, precision)
    frame = rendering.render(device, device_camera(case.camera, precision), case.pipeline)
    gradients = frame_adjoint(
        device, frame, *plane_cotangents(case, Cotangents.random(case), precision)
    )
    tangents = random_direction(case)
    if order is not None:
        tangents = permuted(tangents, order)
    d_planes = frame_tangent(device, frame, device_gaussians(tangents, precision))
    return {
        **{f"plane {k}": np.array(plane) for k, plane in enumerate(frame.planes())},
        **{f"tangent {k}": np.array(plane) for k, plane in enumerate(d_planes)},
        **{name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
        "means2d": np.array(gradients.means2d).T,
        "visible": np.array(gradients.visible),
    }


def permuted(gaussians, order) -> reference.Gaussians:
    return reference.Gaussians(**{n: getattr(gaussians, n)[order] for n in PARAMETER_NAMES})


@pytest.fixture
def thread_count():
    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)


@pytest.mark.slow
@both_precisions
def test_every_run_gives_the_same_bytes_on_any_number_of_threads(precision, thread_count):
    runs = []
    for threads in (1, 2, 2, 4, 1):
        thread_count(threads)
        runs.append(frame_and_gradients(BUSY, precision))
    for first, second in pairwise(runs):
        assert bitwise(first) == bitwise(second)


@both_precisions
@pytest.mark.parametrize("case", [BUSY, CASES[-1]], ids=lambda case: case.name)
def test_result_is_invariant_to_row_order(precision, case):
    """Depths are distinct, in float32 too: only the depth orders the splats."""
    depths = reference.project(case.gaussians, case.camera).depths.astype(np.float32)
    assert len(np.unique(depths)) == len(depths)
    order = np.random.default_rng(2).permutation(len(depths))
    expected = frame_and_gradients(case, precision)
    actual = frame_and_gradients(case, precision, permuted(case.gaussians, order), order)
    for name, values in expected.items():
        is_image = name.startswith(("plane", "tangent"))
        np.testing.assert_array_equal(actual[name], values if is_image else values[order], name)
