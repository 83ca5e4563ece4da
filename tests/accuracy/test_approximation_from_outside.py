"""An approximation that another package registers is chosen by name, as a shipped one."""

import math
from dataclasses import replace
from functools import partial

import drjit.llvm.ad as llvm
import mitsuba as mi
import numpy as np
import pytest
from support.small_fits import plain_dataset
from support.viewer_rendering import VIEWER_RENDERING

from drgs.accuracy.peaks import ewa_with_depth
from drgs.accuracy.pipeline import pipeline_of
from drgs.cameras.camera import Camera
from drgs.config.approximations import FALLOFFS, ORDERS, PROJECTIONS, Approximations
from drgs.config.load import config_from
from drgs.config.schema import ModelConfig
from drgs.core.errors import UnsupportedError
from drgs.core.registry import ExtensionError, reporting_extensions, temporary_registrations
from drgs.fit.summary import summary_of_fit
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.projection import ProjectionModel, ewa
from drgs.splatting.rendering import CenterOrder, render
from drgs.testing import Case, adjoint_is_transpose, gradients_equal_differences

K = np.array([[30.0, 0, 14], [0, 33, 11], [0, 0, 1]])
WIDTH, HEIGHT = 28, 22
UNCUT = {"alpha_cut": 0.0, "transmittance_stop": 0.0, "low_pass": 0.5}
with temporary_registrations():
    from examples.compact_falloff import CompactFalloff


@pytest.fixture(autouse=True)
def registered():
    with temporary_registrations():
        FALLOFFS.register("compact")(CompactFalloff)
        yield


def values(number=12):
    rng = np.random.default_rng(3)
    means = np.column_stack([rng.uniform(-1, 1, (number, 2)), rng.uniform(2, 4, number)])
    return {
        "means": means,
        "quats": rng.normal(size=(number, 4)),
        "log_scales": rng.normal(size=(number, 3)) * 0.4 - 1.5,
        "logit_opacities": rng.normal(size=number),
        "sh0": rng.normal(size=(number, 1, 3)),
        "shN": np.zeros((number, 0, 3)),
    }


def gaussians_of(arrays):
    return Gaussians(**arrays).to(llvm.TensorXf64)


CAMERA = Camera.create(llvm.Float64, np.eye(3), np.zeros(3), K, WIDTH, HEIGHT, 0.1)


def planes_of(arrays, **approximations):
    pipeline = pipeline_of(Approximations(**UNCUT, **approximations), 0)
    return [np.array(plane) for plane in render(gaussians_of(arrays), CAMERA, pipeline).planes()]


def compact_image(arrays):
    """The falloff's equation in numpy, splat after splat: transmittance, red, green, blue."""
    order = np.argsort(arrays["means"][:, 2])
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    image, passed = np.zeros((3, HEIGHT, WIDTH)), np.ones((HEIGHT, WIDTH))
    for row in order:
        w, i, j, k = arrays["quats"][row] / np.linalg.norm(arrays["quats"][row])
        rotation = np.array([
            [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
            [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
            [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
        ])  # fmt: skip
        m = arrays["means"][row]
        J = np.diag([30, 33]) @ np.array([[1, 0, -m[0] / m[2]], [0, 1, -m[1] / m[2]]]) / m[2]
        half = J @ rotation * np.exp(arrays["log_scales"][row])
        conic = np.linalg.inv(half @ half.T + UNCUT["low_pass"] * np.eye(2))
        dx, dy = x - (30 * m[0] / m[2] + 14), y - (33 * m[1] / m[2] + 11)
        t = conic[0, 0] * dx**2 + 2 * conic[0, 1] * dx * dy + conic[1, 1] * dy**2
        opacity = 1 / (1 + math.exp(-arrays["logit_opacities"][row]))
        alpha = opacity * np.where(t < 9, 1 - t / 9, 0) ** 4.5
        color = np.maximum(0, 0.5 + 0.28209479177387814 * arrays["sh0"][row, 0])
        image += color[:, None, None] * alpha * passed
        passed = passed * (1 - alpha)
    return [passed.ravel(), *image.reshape(3, -1)]


def test_image_matches_the_equation():
    found, expected = planes_of(values(), falloff="compact"), compact_image(values())
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert np.abs(np.array(found) - planes_of(values())).max() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("order", ["center", "pixel"])
@pytest.mark.parametrize("law", [gradients_equal_differences, adjoint_is_transpose])
def test_laws_of_gradients_hold(law, order):
    approximations = {"falloff": "compact", "order": order, **UNCUT}
    law(Case("compact", approximations=approximations, degree=0, count=12))


def test_falloff_is_found_by_name_in_plugin_and_configuration():
    mi.set_variant("llvm_ad_rgb")
    tensors = {name: mi.TensorXf(array) for name, array in values().items()}
    found = mi.load_dict({"type": "splats", "falloff": "compact", **tensors})
    found = found.state.approximations
    assert found == Approximations(falloff="compact")
    assert ModelConfig(falloff="compact", **VIEWER_RENDERING).approximations == found
    with pytest.raises(ValueError, match=r"falloff\n.*must be one of gaussian, compact "):
        ModelConfig(falloff="compcat")


def test_projection_with_its_own_falloff_rejects_another():
    with pytest.raises(UnsupportedError, match="projection 'exact' has a falloff of its own"):
        pipeline_of(Approximations(projection="exact", falloff="compact"), 0)


def twofold(rows, camera, position, low_pass, of=ewa):
    """Splats of twice the size."""
    rows = replace(rows, log_scales=rows.log_scales + math.log(2))
    return of(rows, camera, position, low_pass)


class Twofold(ProjectionModel):
    shape = staticmethod(twofold)
    shape_with_depth = staticmethod(partial(twofold, of=ewa_with_depth))


class FarFirst(CenterOrder):
    """Back to front."""

    def sort_depths(self, splats):
        return -splats.depths


@pytest.fixture
def others():
    PROJECTIONS.register("twofold")(Twofold)
    ORDERS.register("far_first")(FarFirst)


@pytest.mark.parametrize("order", ["center", "pixel"])
def test_projection_is_found_by_name_with_both_orders(others, order):
    doubled = values()
    doubled["log_scales"] = doubled["log_scales"] + math.log(2)
    found = planes_of(values(), projection="twofold", order=order)
    np.testing.assert_allclose(found, planes_of(doubled, order=order), rtol=0, atol=1e-6)


def test_an_order_is_found_by_name(others):
    """Seen from behind, as it were: the same as with the depths the other way round."""
    found = planes_of(values(), order="far_first")
    arrays = values()
    middle = arrays["means"][:, 2:].copy()
    assert np.abs(np.array(found) - planes_of(arrays)).max() > 0.01
    scale = (6 - middle) / middle  # the same images of the splats, at 6 - z
    arrays["means"] = arrays["means"] * scale
    arrays["log_scales"] = arrays["log_scales"] + np.log(scale)
    np.testing.assert_allclose(found, planes_of(arrays), rtol=0, atol=1e-12)


def test_errors_of_an_approximation_contain_its_name():
    @PROJECTIONS.register("broken")
    class Broken(ProjectionModel):
        @staticmethod
        def shape(rows, camera, position, low_pass):
            raise ZeroDivisionError("no area")

    message = r'projection "broken" .*: ZeroDivisionError: no area'
    with pytest.raises(ExtensionError, match=message), reporting_extensions():
        planes_of(values(), projection="broken")


def test_fit_summary_lists_the_falloff():
    config = config_from({"data": {"path": "."}, "model": {"falloff": "compact"}}, "x")
    (line,) = [e for e in summary_of_fit(config, plain_dataset()) if e.name == "approximations"]
    assert (line.what, line.why) == ("compact", "model.falloff")
