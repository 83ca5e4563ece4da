"""The whole chain against gsplat's images and gradients."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support.helpers import (
    NEAR_THRESHOLD,
    Case,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    frame_adjoint,
    rows,
)

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.reference import splatting as reference
from drgs.splatting import rendering


def gsplat_frame(scene, precision):
    gaussians, camera = (device_gaussians(scene[0], precision), device_camera(scene[1], precision))
    frame = rendering.render(gaussians, camera, rendering.Pipeline(3))
    height, width = scene[1].height, scene[1].width
    planes = np.stack([rows(plane).reshape(height, width) for plane in frame.planes()], axis=-1)
    return gaussians, frame, planes[..., 1:] + planes[..., :1]


@pytest.fixture(scope="module")
def gsplat_marked(gsplat):
    """The reference's image, with marks."""
    return reference.render(*gsplat[:2], np.ones(3), threshold_width=NEAR_THRESHOLD)


@both_precisions
def test_image_agrees_with_gsplat(precision, gsplat, gsplat_marked):
    _, _, image = gsplat_frame(gsplat, precision)
    errors = np.abs(image - gsplat[2])
    # gsplat's positions of 200 px carry 1e-5 px: measured 7e-7 on average, and 4 flipped pixels.
    assert errors.mean() <= 2e-6
    far = errors.max(axis=-1) > 1e-4
    assert far.mean() <= 1e-4 and gsplat_marked.near_threshold[far].all()


@both_precisions
def test_gradients_agree_with_gsplat(precision, gsplat):
    scene, _, _, expected = gsplat
    gaussians, frame, _ = gsplat_frame(gsplat, precision)
    w = expected["w"].astype(float)
    gradients = frame_adjoint(
        gaussians,
        frame,
        [precision.array(w[..., k]) for k in range(3)],
        precision.array(w.sum(axis=-1)),
    ).parameters.numpy()
    # gsplat's are with respect to activated values: ds = s dlog(s), do = o (1 - o) dlogit(o).
    opacities = reference.sigmoid(scene.logit_opacities)
    activated = {
        "means": gradients.means,
        "quats": gradients.quats,
        "scales": gradients.log_scales / np.exp(scene.log_scales),
        "opacities": gradients.logit_opacities / (opacities * (1 - opacities)),
        "sh": np.concatenate([gradients.sh0, gradients.shN], axis=1),
    }
    for name, ours in activated.items():
        theirs = expected[name].astype(float)
        cosine = np.sum(ours * theirs) / np.linalg.norm(ours) / np.linalg.norm(theirs)
        assert cosine >= 0.9999, name
        # Nearly all of it in the Gaussians of the flipped pixels. Measured at most 5e-4.
        assert np.linalg.norm(ours - theirs) <= 1e-3 * np.linalg.norm(theirs), name


@both_precisions
@pytest.mark.parametrize("order", ["center", "pixel"])
def test_transmittance_alone_is_rendered_and_differentiated(precision, order):
    """A pipeline without features: what an alpha mask needs."""
    pipeline = pipeline_of(Approximations(order=order), 1)
    case = clear(Case("alpha only", 21, 18, 1))
    gaussians = device_gaussians(case.gaussians, precision)
    camera = device_camera(case.camera, precision)
    rng = np.random.default_rng(5)
    cotangent = precision.Float(rng.normal(size=21 * 18))
    with_color = rendering.render(gaussians, camera, pipeline)
    alone = rendering.render(gaussians, camera, replace(pipeline, features=()))
    assert len(alone.planes()) == 1
    assert dr.all(alone.planes()[0] == with_color.planes()[0])
    zero = dr.zeros(precision.Float, 21 * 18)
    expected = frame_adjoint(gaussians, with_color, [zero] * 3, cotangent)
    got = frame_adjoint(gaussians, alone, [], cotangent)
    for name in ("means", "quats", "log_scales"):
        expected_array = np.array(getattr(expected.parameters, name))
        got_array = np.array(getattr(got.parameters, name))
        # The same sums with zeros added: equal but for the sign of zero.
        assert np.array_equal(got_array, expected_array), name
