"""The 3D smoothing filter: against the float64 reference, in files, in the plugin, in fits."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from plyfile import PlyData
from support import reference_effects
from support.cases import rates_of, smoothed_reference
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    host_gaussians,
    image_planes,
    render_composed,
    rows,
    single,
)
from support.views import Scene, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.core.errors import UserError
from drgs.effects.smoothing import apply_smoothing, bake_smoothing, smoothing_of
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import splatting as reference
from drgs.splatting.projection import load_rows

# Relative. The filter is a sum of squares and a logarithm: a few roundings.
FILTER = {FLOAT64: 1e-14, FLOAT32: 2e-6}


def filter_of(count, seed=0) -> np.ndarray:
    """Standard deviations (N,) from far below to far above the Gaussians' own."""
    return single(10 ** np.random.default_rng([seed, count]).uniform(-4, 0, count))


# ----------------------------------------------------------------------------------------------
# The filter
# ----------------------------------------------------------------------------------------------


@both_precisions
def test_widened_scales_and_opacities_match_the_reference(precision):
    gaussians, smoothing = Case("filter", 30, 20, 1).gaussians, filter_of(60)
    device = replace(device_gaussians(gaussians, precision), smoothing=precision.array(smoothing))
    before = load_rows(device, 1)
    after = apply_smoothing(before)
    assert after.smoothing is None and after.means is before.means
    scales, opacities = reference_effects.smoothing_filter(
        gaussians.log_scales, gaussians.logit_opacities, rates_of(smoothing)
    )
    actual = {
        "scales": np.exp(rows(after.log_scales)),
        "opacities": reference.sigmoid(rows(after.logit_opacities))
        * rows(after.opacity_compensation),
    }
    expected = {"scales": scales, "opacities": opacities}
    # Each number for itself: a small one is not to hide behind the largest.
    for name, values in expected.items():
        errors = np.abs(actual[name] / values - 1)
        assert errors.max() <= FILTER[precision], name
    own = reference.sigmoid(gaussians.logit_opacities)
    assert (opacities < 0.01 * own).any() and (opacities > 0.99 * own).any()


@both_precisions
@pytest.mark.parametrize("count", [1, 6])
def test_filter_matches_sampling_rates_of_the_reference(precision, count):
    """Means on, beside, behind and far from the films of random cameras."""
    rng = np.random.default_rng(1)
    cameras = [Case("", 40 + 7 * k, 30, 0, seed=100 + k).camera for k in range(count)]
    means = single(rng.normal(0, 1, (400, 3)) * 10 ** rng.uniform(-0.5, 1.5, (400, 1)))
    rates = reference_effects.sampling_rates(means, cameras)
    on_device = [device_camera(camera, precision) for camera in cameras]
    tensor = precision.TensorXf(precision.array(means), means.shape)
    actual = rows(smoothing_of(tensor, on_device))
    # Depths are differences of coordinates up to 30: relative to a depth of 0.25, 1e-5.
    tolerance = {FLOAT64: 1e-12, FLOAT32: 2e-5}[precision]
    np.testing.assert_allclose(actual, np.sqrt(0.2) / rates, rtol=tolerance)


def test_filter_is_zero_if_no_camera_sees_anything():
    means = FLOAT32.TensorXf(FLOAT32.array(np.full((4, 3), 1e6)), (4, 3))
    camera = Case("", 20, 20, 0).camera
    assert (rows(smoothing_of(means, [device_camera(camera, FLOAT32)])) == 0).all()


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


@both_precisions
def test_baked_gaussians_give_the_same_image(precision):
    """Rounded to float32, as files hold them: by the kernels, and by the reference."""
    case = clear(Case("baked", 37, 29, 1))
    smoothing = filter_of(case.count)
    expected = reference.render(
        smoothed_reference(case.gaussians, smoothing), case.camera, case.background
    )
    plain = bake_smoothing(
        replace(host_gaussians(case.gaussians), smoothing=smoothing.astype(np.float32))
    )
    assert plain.smoothing is None and plain.log_scales.dtype == np.float32
    again = bake_smoothing(plain)  # which has no filter
    np.testing.assert_array_equal(again.log_scales, plain.log_scales)
    camera = device_camera(case.camera, precision)
    frame = render_composed(plain.to(precision.TensorXf), camera, case.pipeline)
    by_reference = reference.Gaussians(**{n: getattr(plain, n) for n in PARAMETER_NAMES})
    for image in (
        image_planes(frame, case)["image"],
        reference.render(by_reference, case.camera, case.background).image,
    ):
        np.testing.assert_allclose(image, expected.image, rtol=0, atol=2e-5 * expected.image.max())


@pytest.mark.parametrize(("logit", "smoothing"), [(40.0, 1e-6), (-80.0, 10.0)])
def test_baked_opacities_stay_finite_where_they_round_to_0_or_1(logit, smoothing):
    host = host_gaussians(Case("", 20, 20, 0, count=2).gaussians)
    host = replace(
        host,
        logit_opacities=np.full(2, logit, np.float32),
        smoothing=np.full(2, smoothing, np.float32),
    )
    plain = bake_smoothing(host)
    assert np.isfinite(plain.logit_opacities).all()
    assert ((plain.logit_opacities > 10) == (logit > 0)).all()


# ----------------------------------------------------------------------------------------------
# Files
# ----------------------------------------------------------------------------------------------


def with_filter(count=12, degree=1) -> Gaussians:
    host = host_gaussians(Case("", 20, 20, degree, count=count).gaussians)
    return replace(host, smoothing=filter_of(count).astype(np.float32))


def test_ply_stores_the_filter_as_last_property_if_there_is_one(tmp_path):
    gaussians = with_filter()
    gaussians.save(tmp_path / "a.ply")
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert [p.name for p in vertex.properties][-2:] == ["rot_3", "filter_3D"]
    np.testing.assert_array_equal(vertex["filter_3D"], gaussians.smoothing)
    actual = Gaussians.load(tmp_path / "a.ply")
    for name in (*PARAMETER_NAMES, "smoothing"):
        np.testing.assert_array_equal(getattr(actual, name), getattr(gaussians, name), name)

    replace(gaussians, smoothing=None).save(tmp_path / "b.ply")
    assert b"filter" not in (tmp_path / "b.ply").read_bytes().partition(b"end_header")[0]
    assert Gaussians.load(tmp_path / "b.ply").smoothing is None


def test_nonfinite_filter_is_refused(tmp_path):
    gaussians = with_filter()
    gaussians.smoothing[3] = np.nan
    gaussians.save(tmp_path / "a.ply")
    message = "smoothing of Gaussian 3 must be finite, got nan"
    with pytest.raises(UserError, match=message):
        Gaussians.load(tmp_path / "a.ply")


# ----------------------------------------------------------------------------------------------
# The plugin
# ----------------------------------------------------------------------------------------------


def scene_filter(scene) -> np.ndarray:
    return filter_of(scene.count).astype(np.float32)


def loaded_with(scene, **settings):
    integrator = scene.settings | settings
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": scene.view.sensor()})


def test_the_plugin_uses_the_filter_of_a_file_unless_it_is_ignored(tmp_path):
    scene = Scene()
    plain = host_gaussians(scene.gaussians)
    plain.save(tmp_path / "plain.ply")
    filtered = replace(plain, smoothing=scene_filter(scene))
    filtered.save(tmp_path / "filtered.ply")
    bake_smoothing(filtered).save(tmp_path / "baked.ply")

    def image(name, **settings):
        return image_of(loaded_with(scene, filename=str(tmp_path / name), **settings))

    unfiltered, smooth = image("plain.ply"), image("filtered.ply")
    assert np.abs(unfiltered - smooth).max() > 0.1
    # Rounded opacities and scales: as in single precision above.
    np.testing.assert_allclose(image("baked.ply"), smooth, atol=2e-5 * smooth.max())
    assert np.array_equal(image("filtered.ply", ignore="smoothing"), unfiltered)
    by_tensors = tensors(scene.gaussians) | {"smoothing": mi.TensorXf(scene_filter(scene))}
    assert np.array_equal(image_of(loaded_with(scene, **by_tensors)), smooth)


def test_filter_is_not_exposed_as_scene_parameter():
    values = tensors(Scene().gaussians) | {"smoothing": mi.Float(scene_filter(Scene()))}
    params = mi.traverse(mi.load_dict({"type": "splats", **values}))
    assert "smoothing" not in params and "means" in params


def test_changed_filter_triggers_a_new_rendering():
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    loaded.integrator().smoothing = mi.Float(scene_filter(scene))
    after = image_of(loaded)
    assert np.abs(after - before).max() > 0.1
    loaded.integrator().smoothing = None
    assert np.array_equal(image_of(loaded), before)


def test_filter_of_wrong_length_is_refused():
    message = r"splats: smoothing must have the shape \(N\), with N = 40 .*, got \(39,\)"
    values = tensors(Scene().gaussians)
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "splats", **values, "smoothing": mi.TensorXf(np.ones(39))})
    params = mi.traverse(
        mi.load_dict({"type": "splats", **values, "smoothing": mi.Float(np.ones(40))})
    )
    for name, value in tensors(Scene(count=20).gaussians).items():
        params[name] = value
    with pytest.raises(ValueError, match=r"smoothing must have the shape \(N\), with N = 20"):
        params.update()
