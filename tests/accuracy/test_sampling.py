"""Several samples per pixel: kernels against the reference, films against the definition."""

from dataclasses import dataclass, fields, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.backgrounds import CLOSE, EMITTERS, rendered, texels
from support.cases import CASES, MODEL_FIELDS, planes_of, reference_camera
from support.helpers import FLOAT64, NEAR_THRESHOLD
from support.studies import reference_rays
from support.views import VIEWS, Scene, image_of, side_by_side
from support.wall_scenes import Wall
from support.wall_scenes import load as load_wall

import drgs  # noqa: F401  (registers the plugin)
from drgs.core.arrays import from_host
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator.film import PIXELS_PER_PASS, DrawnSamples, SamplePoints
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from drgs.testing import Case, laws_of

# ----------------------------------------------------------------------------------------------
# Kernels
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Sampled(Case):
    """A case that is seen at one random point of each pixel."""

    @property
    def points(self) -> np.ndarray:
        """(H, W, 2) in [0, 1), exact in single precision."""
        return np.random.default_rng(9).integers(0, 256, (self.height, self.width, 2)) / 256

    def frames(self, values, Float=FLOAT64.Float):
        gaussians, (frame,) = super().frames(values, Float)
        points = SamplePoints(
            *(from_host(Float, p.ravel()) for p in np.moveaxis(self.points, -1, 0))
        )
        model = replace(frame.pipeline.model, positions=points)
        pipeline = replace(frame.pipeline, model=model)
        return gaussians, [rendering.render(gaussians, frame.camera, pipeline)]


def by_rays_at_points(case, values):
    corners = np.stack(np.meshgrid(np.arange(case.width), np.arange(case.height)), axis=-1)
    given = {k: v for k, v in case.approximations.items() if k in MODEL_FIELDS}
    model = reference_rays.ImageModel(**given, sh_degree=case.degree)
    rendered = reference_rays.render(
        reference.Gaussians(**values), reference_camera(case), model=model,
        positions=corners + case.points, threshold_width=NEAR_THRESHOLD,
    )  # fmt: skip
    planes, marked = planes_of(rendered)
    return planes if model.order == "center" else planes[:4], marked


def sampled(name) -> Sampled:
    case = next(case for case in CASES if case.name == name)
    given = {field.name: getattr(case, field.name) for field in fields(Case)}
    return Sampled(**{**given, "reference": by_rays_at_points})


SAMPLED = {"wide low-pass, pinhole": [], "all three, close": pytest.mark.slow}


@pytest.mark.parametrize(
    ("case", "law"),
    [
        pytest.param(case, law, id=f"{name}-{law.__name__}", marks=marks)
        for name, marks in SAMPLED.items()
        for case in [sampled(name)]
        for law in laws_of(case)
    ],
)
def test_law_holds_at_points(case, law):
    law(case)


# ----------------------------------------------------------------------------------------------
# Films
# ----------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


SCENE = Scene(count=12)


def exposure_of(loaded, samples, seed=0):
    """The points (samples, H, W, 2) in [0, 1) at which ``mi.render`` evaluates the pixels."""
    sensor = loaded.sensors()[0]
    exposure = DrawnSamples(sensor, seed, samples, {})
    width, height = sensor.film().crop_size()
    passes = [
        np.array([p.x, p.y], np.float64).T.reshape(-1, height, width, 2) for p in exposure.positions
    ]
    return np.concatenate(passes)


def images_at(points) -> np.ndarray:
    """(samples, H, W, 4): colour and alpha by the reference, at each sample's points."""
    camera, window = SCENE.camera, SCENE.view.window
    corners = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    images = []
    for inside in points:
        positions = corners + 0.5
        positions[window] = corners[window] + inside
        rendered = reference_rays.render(
            SCENE.gaussians,
            camera,
            SCENE.background,
            reference_rays.ImageModel(sh_degree=SCENE.rendered_degree),
            window,
            positions,
        )
        images.append(np.dstack([rendered.image, rendered.alpha]))
    return np.array(images)


# Single precision; a pixel that is near a decision may flip: the image is bounded in the mean.
MEAN_ERROR = 1e-5


@pytest.mark.parametrize(
    "sampler", ["independent", "stratified", "multijitter", "orthogonal", "ldsampler"]
)
def test_a_box_filter_averages_the_samples(sampler):
    loaded = SCENE.load(samples=4, sampler=sampler)
    image = image_of(loaded, seed=3)
    points = exposure_of(loaded, 4, seed=3)
    assert np.abs(image - images_at(points).mean(axis=0)).mean() < MEAN_ERROR
    assert np.abs(image - image_of(SCENE.load())).max() > 0.01


def test_sample_points_come_from_the_sampler():
    points = exposure_of(SCENE.load(samples=16, sampler="stratified"), 16)
    cells = np.floor(points * 4).astype(int)
    number = cells[..., 1] * 4 + cells[..., 0]
    np.testing.assert_array_equal(
        np.sort(number, axis=0), np.broadcast_to(np.arange(16)[:, None, None], number.shape)
    )
    first, again, other = (exposure_of(SCENE.load(samples=4), 4, seed=s) for s in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_seed_changed_in_place_gives_other_points():
    loaded = SCENE.load(samples=4)
    integrator, sensor = loaded.integrator(), loaded.sensors()[0]
    seed = mi.UInt32(0)

    def rendered(seed):
        return np.array(integrator.render(loaded, sensor, seed=seed))

    before = rendered(seed)
    frames = integrator.state.cache.kept["frames 0"]
    np.testing.assert_array_equal(rendered(seed), before)
    assert integrator.state.cache.kept["frames 0"] is frames
    seed += 1
    np.testing.assert_array_equal(rendered(seed), rendered(1))
    assert np.abs(rendered(1) - before).max() > 1e-3
    dr.make_opaque(seed)
    seed += 1
    np.testing.assert_array_equal(rendered(seed), rendered(2))


def test_spp_of_a_call_overrides_the_sampler():
    few, many = SCENE.load(samples=1), SCENE.load(samples=4)
    assert np.array_equal(image_of(few, spp=4), image_of(many))
    assert np.array_equal(image_of(many, spp=1), image_of(few))


@pytest.mark.parametrize("name", ["gaussian", "tent", "mitchell", "lanczos"])
@pytest.mark.parametrize("samples", [1, 3])
def test_reconstruction_filter_weights_samples_around_a_pixel(name, samples):
    """image = sum f(x - center) value / sum f, over the samples within the filter's radius."""
    loaded = SCENE.load(samples=samples, rfilter=name)
    image = image_of(loaded)
    points = exposure_of(loaded, samples)
    values = images_at(points)
    rfilter = mi.load_dict({"type": name})
    radius, (_, height, width, _) = rfilter.radius(), values.shape
    reach = int(np.ceil(radius))

    def weigh(x):
        inside = np.abs(x) < radius
        return np.where(inside, np.array(rfilter.eval(mi.Float(x.ravel()))).reshape(x.shape), 0)

    total, weights = np.zeros((height, width, 4)), np.zeros((height, width, 1))
    rows, columns = np.mgrid[:height, :width]
    for y in range(-reach, reach + 1):
        for x in range(-reach, reach + 1):
            target = rows + y, columns + x
            inside = (
                (target[0] >= 0) & (target[0] < height) & (target[1] >= 0) & (target[1] < width)
            )
            for s in range(samples):
                weight = weigh(points[s, ..., 0] - x - 0.5) * weigh(points[s, ..., 1] - y - 0.5)
                target_inside = target[0][inside], target[1][inside]
                np.add.at(weights, target_inside, weight[inside][:, None])
                np.add.at(total, target_inside, (weight[..., None] * values[s])[inside])
    # Mitsuba reads its filters from tables of 32 entries a radius, linearly: 1e-3 of a weight.
    # Negative lobes may leave little weight: a pixel is then a quotient of small numbers.
    expected = total / weights
    kept = weights[..., 0] > 0.2 * weights.max()
    assert kept.mean() > 0.8
    assert np.abs(image - expected)[kept].mean() < 3e-3


@pytest.mark.parametrize(("samples", "rfilter"), [(3, "box"), (2, "gaussian")])
def test_gradients_are_the_transpose_of_the_tangents(samples, rfilter):
    """With the same seed, through film, samples, colour and background."""
    loaded = SCENE.load(samples=samples, rfilter=rfilter)
    integrator, sensor = loaded.integrator(), loaded.sensors()[0]
    params = mi.traverse(loaded)
    rng = np.random.default_rng(0)
    weights = SCENE.weights()
    for name in (*PARAMETER_NAMES, "background"):
        key = f"integrator.{name}"
        value = params[key]
        dr.enable_grad(value)
        d = type(value)(rng.normal(size=np.array(value).shape).astype(np.float32))
        dr.set_grad(value, d)
        tangent = np.array(integrator.render_forward(loaded, params, sensor, 5, samples))
        dr.clear_grad(value)
        integrator.render_backward(loaded, params, mi.TensorXf(weights), sensor, 5, samples)
        terms = np.array(d, np.float64) * np.array(dr.grad(value), np.float64)
        dr.disable_grad(value)
        left, right = np.sum(weights * np.float64(tangent)), terms.sum()
        size = np.abs(weights * tangent).sum() + np.abs(terms).sum()
        assert size > 0 and abs(left - right) < 1e-5 * size, name


def test_no_samples_outside_the_film():
    """Whether or not it has a border for them."""
    loaded = SCENE.load(samples=2)
    images = [
        image_of(loaded, sensor=mi.load_dict(sensor))
        for border in (False, True)
        for sensor in [SCENE.view.sensor(rfilter="gaussian", samples=2, sample_border=border)]
    ]
    # Atomic additions round in an order of their own.
    np.testing.assert_allclose(*images, rtol=0, atol=1e-5)


# ----------------------------------------------------------------------------------------------
# Several samples a pass
# ----------------------------------------------------------------------------------------------

SMALL_SCENE = Scene(count=12, degree=1)


scene_with = SMALL_SCENE.load_with


def batch_of_two():
    return side_by_side(SMALL_SCENE.view, VIEWS[2])


def thin_lens():
    lens = {"fov": 50.0, "aperture_radius": 0.05, "focus_distance": 2.3}
    return SMALL_SCENE.view.with_sensor("thinlens", **lens).sensor()


def moving():
    lens = {"fx": 30.0, "fy": 27.0, "cx": 17.0, "cy": 12.5, "shutter": "global"}
    moves = {"to_world_close": mi.ScalarTransform4f(CLOSE), "shutter_samples": 2}
    return SMALL_SCENE.view.with_sensor("calibrated", **lens, **moves).sensor()


def feature_tensor(channels):
    rng = np.random.default_rng(3)
    return mi.TensorXf(rng.normal(0, 1, (SMALL_SCENE.count, channels)).astype(np.float32))


SCENES = {
    "plain": scene_with,
    "linear, antialiased": lambda: scene_with(srgb_primitives=True, antialiased=True),
    "exact, order of each pixel": lambda: scene_with(projection="exact", order="pixel"),
    "unscented, colours of each pixel": lambda: scene_with(
        projection="unscented", sh_direction="pixel", low_pass=0.0
    ),
    "features in groups": lambda: scene_with(
        aovs="z:depth, n:normal, f:feature_f", feature_f=feature_tensor(4)
    ),
    "texture": lambda: scene_with(background=rendered(texels())),
    "environment, thin lens": lambda: scene_with(thin_lens(), {"sky": EMITTERS["envmap"]()}),
    "surface, environment": lambda: load_wall(
        SMALL_SCENE, sky=True, wall=Wall(half=0.5), aovs="z:depth"
    ),
    "batch": lambda: scene_with(batch_of_two(), aovs="z:depth"),
    "motion": lambda: scene_with(moving()),
}


def outcome(name, samples=3) -> tuple[dict[str, np.ndarray], int]:
    """Image, tangent, and gradients of the Gaussians, of a new scene; and the number of passes."""
    loaded = SCENES[name]()
    integrator, sensor, params = loaded.integrator(), loaded.sensors()[0], mi.traverse(loaded)
    values = {key: params[f"integrator.{key}"] for key in PARAMETER_NAMES}
    rng = np.random.default_rng(0)
    image = integrator.render(loaded, sensor, seed=5, spp=samples)
    for value in values.values():
        dr.enable_grad(value)
        d = rng.normal(size=np.array(value).shape).astype(np.float32)
        dr.set_grad(value, type(value)(d))
    tangent = integrator.render_forward(loaded, params, sensor, 5, samples)
    dr.clear_grad(list(values.values()))
    weights = mi.TensorXf(rng.normal(size=image.shape).astype(np.float32))
    integrator.render_backward(loaded, params, weights, sensor, 5, samples)
    gradients = {key: np.array(dr.grad(value)) for key, value in values.items()}
    assert all(np.abs(gradient).max() > 0 for gradient in gradients.values())
    (frames, *_) = integrator.state.cache.kept["frames 0"].value
    return {"image": np.array(image), "tangent": np.array(tangent), **gradients}, len(frames)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_passes_of_several_samples_equal_single_sample_passes(name, monkeypatch):
    monkeypatch.setattr("drgs.splatting.order.FEATURES_AT_ONCE", {4: 4, 8: 4})
    monkeypatch.setattr("drgs.integrator.film.PIXELS_PER_PASS", 1)
    expected, passes = outcome(name)
    assert passes == 3

    def check():
        found, passes = outcome(name)
        for key, value in expected.items():
            assert found[key].tobytes() == value.tobytes(), key
        return passes

    monkeypatch.undo()
    monkeypatch.setattr("drgs.splatting.order.FEATURES_AT_ONCE", {4: 4, 8: 4})
    assert check() == 1
    with monkeypatch.context() as patch:
        patch.setattr("drgs.splatting.rendering.ENTRIES_AT_ONCE", 1)
        assert check() == 1
    width, height = SCENES[name]().sensors()[0].film().crop_size()
    monkeypatch.setattr("drgs.integrator.film.PIXELS_PER_PASS", 2 * width * height)
    monkeypatch.setattr("drgs.splatting.reduction.BAND_SLOTS", 16)
    monkeypatch.setattr("drgs.splatting.reduction.PAIRS_AT_ONCE", 0)
    assert check() == 2


def test_a_pass_of_a_large_film_has_one_sample():
    film = {"width": 512, "height": PIXELS_PER_PASS // 512 + 1}
    large = scene_with(SMALL_SCENE.view.sensor(**film)).sensors()[0]
    assert [p.samples for p in DrawnSamples(large, 0, 3, {}).positions] == [1, 1, 1]
    small = scene_with().sensors()[0]
    at_once = PIXELS_PER_PASS // (SMALL_SCENE.view.width * SMALL_SCENE.view.height)
    passes = DrawnSamples(small, 0, 2 * at_once + 1, {}).positions
    assert [p.samples for p in passes] == [at_once, at_once, 1]


def test_weights_are_means_over_the_samples_of_all_passes(monkeypatch):
    def weights() -> np.ndarray:
        loaded = scene_with()
        params = mi.traverse(loaded)
        dr.enable_grad(params["integrator.sh0"])
        params.update()
        dr.backward(dr.sum(mi.render(loaded, params, spp=3).array))
        plane = dr.arange(mi.Float, SMALL_SCENE.view.width * SMALL_SCENE.view.height)
        return np.array(loaded.integrator().last.weighted_sums(plane))

    found = weights()
    monkeypatch.setattr("drgs.integrator.film.PIXELS_PER_PASS", 1)
    assert found.max() > 0
    np.testing.assert_allclose(found, weights(), rtol=1e-6)
