"""The 3D smoothing filter: against the float64 reference, in files, in the plugin, in fits."""

from dataclasses import replace
from functools import cache

import mitsuba as mi
import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Cotangents,
    assert_arrays_agree,
    assert_images_agree,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
    image_planes,
    plane_cotangents,
    render_composed,
    rows,
    single,
)
from support.smoothing import rates_of, smoothed_reference
from support.views import Scene, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.core.errors import UserError
from drgs.effects.smoothing import apply_smoothing, bake_smoothing, smoothing_of
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import effects as reference_effects
from drgs.reference import splatting as reference
from drgs.splatting.projection import load_rows

# Relative to the largest value of an array. The filter is a sum of squares and a logarithm: a few
# roundings; images and gradients as in test_rendering.
FILTER = {FLOAT64: 1e-14, FLOAT32: 2e-6}


IMAGE = {FLOAT64: 1e-12, FLOAT32: 2e-5}


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


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


def test_a_wide_filter_makes_a_needle_round_and_keeps_its_integral():
    """Computed by hand: variances 0.01^2, 0.1^2, 1 and a filter of 1."""
    needle = reference.Gaussians(
        means=np.zeros((1, 3)), quats=np.array([[1.0, 0, 0, 0]]),
        log_scales=np.log([[0.01, 0.1, 1.0]]), logit_opacities=np.zeros(1),
        sh0=np.zeros((1, 1, 3)), shN=np.zeros((1, 0, 3)),
    )  # fmt: skip
    device = replace(device_gaussians(needle, FLOAT64), smoothing=FLOAT64.array([1.0]))
    after = apply_smoothing(load_rows(device, 0))
    widened = np.sqrt([1.0001, 1.01, 2.0])
    np.testing.assert_allclose(np.exp(rows(after.log_scales))[0], widened, rtol=1e-14)
    np.testing.assert_allclose(
        rows(after.opacity_compensation), [0.001 / widened.prod()], rtol=1e-13
    )


CAMERAS = 6


def cameras_and_means(seed):
    """Random cameras, and means on, beside, behind and far from their films."""
    rng = np.random.default_rng(seed)
    cameras = [Case("", 40 + 7 * k, 30, 0, seed=100 * seed + k).camera for k in range(CAMERAS)]
    means = rng.normal(0, 1, (400, 3)) * 10 ** rng.uniform(-0.5, 1.5, (400, 1))
    return cameras, single(means)


@both_precisions
@pytest.mark.parametrize("count", [1, 2, CAMERAS])
def test_filter_matches_sampling_rates_of_the_reference(precision, count):
    cameras, means = cameras_and_means(1)
    cameras = cameras[:count]
    rates = reference_effects.sampling_rates(means, cameras)
    on_device = [device_camera(camera, precision) for camera in cameras]
    tensor = precision.TensorXf(precision.array(means), means.shape)
    actual = rows(smoothing_of(tensor, on_device))
    # Depths are differences of coordinates up to 30: relative to a depth of 0.25, 1e-5.
    tolerance = {FLOAT64: 1e-12, FLOAT32: 2e-5}[precision]
    np.testing.assert_allclose(actual, np.sqrt(0.2) / rates, rtol=tolerance)


def visible_means(camera, means) -> np.ndarray:
    """(N,) bool, as a loop over the means says it."""
    seen = []
    for mean in means:
        x, y, z = camera.rotation @ (mean - camera.center)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        wide, tall = 0.15 * camera.width, 0.15 * camera.height
        inside = -wide <= u <= camera.width + wide and -tall <= v <= camera.height + tall
        seen.append(z >= camera.near and inside)
    return np.array(seen)


def test_unseen_means_get_the_widest_filter_of_seen_ones():
    cameras, means = cameras_and_means(1)
    seen = np.any([visible_means(camera, means) for camera in cameras], axis=0)
    assert 50 < seen.sum() < 350
    tensor = FLOAT64.TensorXf(FLOAT64.array(means), means.shape)
    actual = rows(smoothing_of(tensor, [device_camera(c, FLOAT64) for c in cameras]))
    assert (actual[~seen] == actual[seen].max()).all()
    assert len(np.unique(actual[seen])) == seen.sum()


def test_filter_is_zero_if_no_camera_sees_anything():
    means = FLOAT32.TensorXf(FLOAT32.array(np.full((4, 3), 1e6)), (4, 3))
    camera = Case("", 20, 20, 0).camera
    assert (rows(smoothing_of(means, [device_camera(camera, FLOAT32)])) == 0).all()


def test_nearest_camera_sets_the_filter():
    """Computed by hand: rates 100 / 2 and 100 / 4 px per unit."""
    camera = reference.Camera(np.eye(3), np.zeros(3), 100.0, 80.0, 50.0, 50.0, 100, 100, 0.1)
    farther = replace(camera, center=np.array([0, 0, -2.0]))
    mean = FLOAT64.TensorXf(FLOAT64.array([0.0, 0.0, 2.0]), (1, 3))
    for cameras in ([camera, farther], [farther, camera], [camera]):
        found = rows(smoothing_of(mean, [device_camera(c, FLOAT64) for c in cameras]))
        np.testing.assert_allclose(found, np.sqrt(0.2) / 50, rtol=1e-14)


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


class SmoothCase(Case):
    """A case whose Gaussians come with a filter; its image is that of the widened ones."""

    @property
    def smoothing(self) -> np.ndarray:
        return filter_of(self.count)

    @property
    def rendered(self) -> reference.RenderedImage:
        return _image(self)

    def reference_image(self, gaussians=None, threshold_width=0.0) -> reference.RenderedImage:
        return reference.render(
            smoothed_reference(gaussians or self.gaussians, self.smoothing), self.camera,
            self.background, self.rendered_degree, self.antialiased, threshold_width,
        )  # fmt: skip

    def device_gaussians(self, precision) -> Gaussians:
        gaussians = device_gaussians(self.gaussians, precision)
        return replace(gaussians, smoothing=precision.array(self.smoothing))

    def render(self, precision, gaussians=None):
        gaussians = gaussians or self.device_gaussians(precision)
        frame = render_composed(gaussians, device_camera(self.camera, precision), self.pipeline)
        return gaussians, frame


@cache
def _image(case):
    return case.reference_image(threshold_width=case.threshold_width)


@both_precisions
@pytest.mark.parametrize("antialiased", [False, True])
def test_image_matches_the_reference_with_widened_gaussians(precision, antialiased):
    case = clear(SmoothCase("smooth", 37, 29, 1, antialiased=antialiased))
    _, frame = case.render(precision)
    assert_images_agree(image_planes(frame, case), case.rendered, IMAGE[precision])
    unfiltered = reference.render(*case.scene, case.background, antialiased=antialiased)
    assert np.abs(unfiltered.image - case.rendered.image).max() > 0.1


@both_precisions
def test_baked_gaussians_give_the_same_image(precision):
    """Rounded to float32, as files hold them: by the kernels, and by the reference."""
    case = clear(SmoothCase("baked", 37, 29, 1))
    host = replace(as_numpy(case.gaussians), smoothing=case.smoothing.astype(np.float32))
    plain = bake_smoothing(host)
    assert plain.smoothing is None and plain.log_scales.dtype == np.float32
    uploaded = plain.to(precision.TensorXf)
    _, frame = case.render(precision, uploaded)
    tolerance = IMAGE[FLOAT32]
    assert_images_agree(image_planes(frame, case), case.rendered, tolerance)
    by_reference = reference.Gaussians(
        **{name: getattr(plain, name).astype(np.float64) for name in PARAMETER_NAMES}
    )
    image = reference.render(by_reference, case.camera, case.background).image
    assert (
        np.abs(image - case.rendered.image).max() <= tolerance * np.abs(case.rendered.image).max()
    )


def test_baking_without_a_filter_changes_nothing():
    host = as_numpy(Case("", 20, 20, 1).gaussians)
    plain = bake_smoothing(host)
    for name in PARAMETER_NAMES:
        assert np.array_equal(getattr(plain, name), getattr(host, name)), name


@pytest.mark.parametrize(("logit", "smoothing"), [(40.0, 1e-6), (-80.0, 10.0)])
def test_baked_opacities_stay_finite_where_they_round_to_0_or_1(logit, smoothing):
    host = as_numpy(Case("", 20, 20, 0, count=2).gaussians)
    host = replace(
        host,
        logit_opacities=np.full(2, logit, np.float32),
        smoothing=np.full(2, smoothing, np.float32),
    )
    plain = bake_smoothing(host)
    assert np.isfinite(plain.logit_opacities).all()
    assert ((plain.logit_opacities > 10) == (logit > 0)).all()


def as_numpy(gaussians: reference.Gaussians) -> Gaussians:
    """In single precision, as files hold them."""
    return Gaussians(**{n: getattr(gaussians, n).astype(np.float32) for n in PARAMETER_NAMES})


# ----------------------------------------------------------------------------------------------
# Gradients
# ----------------------------------------------------------------------------------------------


# Central differences of the reference with a step of 1e-6: rounding 1e-16 / 1e-6, and a sixth of
# the third derivative times the step squared. Measured 1e-8.
STEP, DIFFERENCES = 1e-6, 1e-6


GRADIENTS = {FLOAT64: DIFFERENCES, FLOAT32: 2e-4}  # the latter as in test_rendering


def kernel_gradients(case, precision, cotangents):
    gaussians, frame = case.render(precision)
    gradients = frame_adjoint(gaussians, frame, *plane_cotangents(case, cotangents, precision))
    assert gradients.parameters.smoothing is None
    return {n: np.array(getattr(gradients.parameters, n)) for n in PARAMETER_NAMES}


def outputs_of(case, gaussians) -> list[np.ndarray]:
    rendered = case.reference_image(gaussians)
    return [rendered.image, rendered.alpha, rendered.depth]


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize("antialiased", [False, True])
def test_each_gradient_entry_equals_a_difference_of_the_reference(precision, antialiased):
    """Gradients of colours, alpha and depth through the filter; a scaled one is noticed."""
    case = SmoothCase("tiny", 13, 11, 1, 6, antialiased, threshold_width=5e-4)
    case = clear(case)
    cotangents = Cotangents.random(case)
    weights = [cotangents.d_image, cotangents.d_alpha, cotangents.d_depth]
    expected = {}
    for name in PARAMETER_NAMES:
        values = getattr(case.gaussians, name)
        expected[name] = np.zeros_like(values)
        for index in np.ndindex(values.shape):
            both = []
            for sign in (1, -1):
                moved = values.copy()
                moved[index] += sign * STEP
                both.append(outputs_of(case, replace(case.gaussians, **{name: moved})))
            difference = [np.sum(w * (a - b)) for w, a, b in zip(weights, *both, strict=True)]
            expected[name][index] = sum(difference) / (2 * STEP)
    actual = kernel_gradients(case, precision, cotangents)
    assert_arrays_agree(actual, expected, GRADIENTS[precision])
    for name in PARAMETER_NAMES:
        with pytest.raises(AssertionError, match=rf"{name}\["):
            scaled = {**actual, name: 1.01 * actual[name]}
            assert_arrays_agree(scaled, expected, GRADIENTS[precision])


@both_precisions
def test_tangent_and_adjoint_are_transposed(precision):
    case = clear(SmoothCase("transposed", 37, 29, 1))
    cotangents = Cotangents.random(case)
    gradients = kernel_gradients(case, precision, cotangents)
    rng = np.random.default_rng(3)
    direction = {n: single(rng.normal(size=g.shape)) for n, g in gradients.items()}
    gaussians, frame = case.render(precision)
    tangents = Gaussians(**direction).to(precision.TensorXf)
    planes = frame_tangent(gaussians, frame, tangents)
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)
    left = sum(
        np.sum(rows(d) * rows(p))
        for d, p in zip([d_transmittance, *d_features], planes, strict=True)
    )
    terms = [np.sum(direction[n] * g) for n, g in gradients.items()]
    assert left == pytest.approx(sum(terms), abs=GRADIENTS[precision] / 10 * np.abs(terms).sum())


# ----------------------------------------------------------------------------------------------
# Files
# ----------------------------------------------------------------------------------------------


def with_filter(count=12, degree=1) -> Gaussians:
    host = as_numpy(Case("", 20, 20, degree, count=count).gaussians)
    return replace(host, smoothing=filter_of(count).astype(np.float32))


def test_ply_stores_the_filter_as_last_property(tmp_path):
    gaussians = with_filter()
    gaussians.save(tmp_path / "a.ply")
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert [p.name for p in vertex.properties][-2:] == ["rot_3", "filter_3D"]
    np.testing.assert_array_equal(vertex["filter_3D"], gaussians.smoothing)
    actual = Gaussians.load(tmp_path / "a.ply")
    for name in (*PARAMETER_NAMES, "smoothing"):
        np.testing.assert_array_equal(getattr(actual, name), getattr(gaussians, name), name)


def test_ply_without_a_filter_has_no_filter_property(tmp_path):
    plain = replace(with_filter(), smoothing=None)
    plain.save(tmp_path / "a.ply")
    assert b"filter" not in (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0]
    assert Gaussians.load(tmp_path / "a.ply").smoothing is None


def test_nonfinite_filter_is_refused(tmp_path):
    gaussians = with_filter()
    gaussians.smoothing[3] = np.nan
    gaussians.save(tmp_path / "a.ply")
    message = "numbers must be finite: smoothing of Gaussian 3 is nan"
    with pytest.raises(UserError, match=message):
        Gaussians.load(tmp_path / "a.ply")


def test_filter_of_another_type_is_read(tmp_path):
    """Tools that compute in double precision write such files."""
    gaussians = with_filter()
    gaussians.save(tmp_path / "a.ply")
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    kinds = [(n, "f8" if n == "filter_3D" else "f4") for n in reversed(vertex.dtype.names)]
    other = np.empty(len(vertex), kinds)
    for name, _ in kinds:
        other[name] = vertex[name]
    PlyData([PlyElement.describe(other, "vertex")]).write(str(tmp_path / "b.ply"))
    np.testing.assert_array_equal(Gaussians.load(tmp_path / "b.ply").smoothing, gaussians.smoothing)


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
    plain = as_numpy(scene.gaussians)
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


@pytest.mark.parametrize("count", [1, 39, 41])
def test_filter_of_wrong_length_is_refused(count):
    values = tensors(Scene().gaussians) | {"smoothing": mi.TensorXf(np.ones(count, np.float32))}
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": "splats", **values})
    assert str(caught.value).strip().splitlines()[-1] == (
        "PluginError: splats: smoothing must have the shape (N), with N = 40 the rows of means, "
        f"got ({count},)"
    )


def test_filter_of_wrong_length_is_refused_on_parameter_update():
    values = tensors(Scene().gaussians) | {"smoothing": mi.Float(scene_filter(Scene()))}
    params = mi.traverse(mi.load_dict({"type": "splats", **values}))
    for name, value in tensors(Scene(count=20).gaussians).items():
        params[name] = value
    with pytest.raises(ValueError, match=r"smoothing must have the shape \(N\), with N = 20"):
        params.update()
