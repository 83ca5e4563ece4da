"""The ``splats`` integrator as a user of Mitsuba meets it, against the float64 reference."""

import gc
import weakref
from dataclasses import fields, replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import NEAR_THRESHOLD, assert_arrays_agree, relative_errors
from support.views import (
    VIEWS,
    Scene,
    View,
    clear,
    gradient,
    gradients_of,
    image_of,
    pose,
    tensors,
    to_linear,
)

import drgs  # noqa: F401  (registers the plugin)
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator import film as exposure
from drgs.reference import splatting as reference
from drgs.splatting import rendering

# Relative to the largest value of an array, in single precision: test_rendering derives 2e-5 and
# 2e-4 for films up to twice this size. Converting to linear radiance multiplies relative errors by
# at most 2.4. Measured 1e-6 and 1e-5.
PICTURE = 1e-5
GRADIENTS = 1e-4

ALL_PARAMETERS = (*PARAMETER_NAMES, "background")

SETTINGS = (
    Scene(),
    Scene(degree=3),
    Scene(degree=0),
    Scene(degree=3, sh_degree=1),
    Scene(degree=2, sh_degree=0),
    Scene(antialiased=True),
    Scene(near=0.25),
    Scene(replace(VIEWS[1], near_clip=0.25)),
    Scene(srgb_primitives=True),
    Scene(srgb_primitives=True, antialiased=True, degree=2, near=0.25),
)
SETTING_NAMES = (
    "degree 1",
    "degree 3",
    "degree 0",
    "degree 1 of 3",
    "degree 0 of 2",
    "antialiased",
    "near",
    "near clip of the sensor",
    "linear radiance",
    "linear radiance, antialiased, near",
)

all_settings = pytest.mark.parametrize("scene", SETTINGS, ids=SETTING_NAMES)
all_views = pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
both_color_spaces = pytest.mark.parametrize(
    "srgb_primitives", [False, True], ids=["display space", "linear radiance"]
)


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def assert_images_agree(actual, expected, tolerance=PICTURE):
    assert_arrays_agree({"image": actual}, {"image": expected}, tolerance)


def assert_gradients_agree(actual, expected, tolerance=GRADIENTS):
    assert_arrays_agree(actual, {name: expected[name] for name in actual}, tolerance)


def fresh_image(scene, **film):
    return image_of(scene.load(**film))


# ----------------------------------------------------------------------------------------------
# Loading
# ----------------------------------------------------------------------------------------------

SENSOR_XML = """
    <sensor type="perspective">
        <float name="fov" value="{fov}"/>
        <transform name="to_world"><matrix value="{matrix}"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="{width}"/>
            <integer name="height" value="{height}"/>
            <string name="pixel_format" value="rgba"/>
            <rfilter type="box"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
    </sensor>
"""


def scene_xml(view, integrator) -> str:
    matrix = " ".join(repr(float(v)) for row in view.to_world for v in row)
    sensor = SENSOR_XML.format(fov=view.fov, matrix=matrix, width=view.width, height=view.height)
    return f'<scene version="3.0.0">{integrator}{sensor}</scene>'


def write_gaussians(path, gaussians):
    fields = {name: getattr(gaussians, name).astype(np.float32) for name in PARAMETER_NAMES}
    Gaussians(**fields).save(path)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_file_and_tensors_give_the_same_picture(degree, tmp_path):
    scene = Scene(degree=degree)
    write_gaussians(tmp_path / "model.ply", scene.gaussians)
    settings = scene.settings | {"filename": str(tmp_path / "model.ply")}
    loaded = mi.load_dict({"type": "scene", "integrator": settings, "sensor": scene.view.sensor()})
    assert np.array_equal(image_of(loaded), fresh_image(scene))


@pytest.mark.parametrize("parallel", [True, False])
def test_xml_finds_a_file_beside_itself(parallel, tmp_path, monkeypatch):
    scene = Scene(srgb_primitives=True, sh_degree=0, antialiased=True, near=0.25)
    (tmp_path / "scene" / "models").mkdir(parents=True)
    write_gaussians(tmp_path / "scene" / "models" / "model.ply", scene.gaussians)
    integrator = """
        <integrator type="splats" id="integrator">
            <string name="filename" value="models/model.ply"/>
            <rgb name="background" value="0.875, 0.375, 0.03125"/>
            <integer name="sh_degree" value="0"/>
            <boolean name="antialiased" value="true"/>
            <float name="near" value="0.25"/>
            <boolean name="srgb_primitives" value="true"/>
        </integrator>"""
    path = tmp_path / "scene" / "scene.xml"
    path.write_text(scene_xml(scene.view, integrator))
    monkeypatch.chdir(tmp_path)
    loaded = mi.load_file(str(path), parallel=parallel)
    assert "integrator.means" in mi.traverse(loaded)
    assert np.array_equal(image_of(loaded), fresh_image(scene))


def test_xml_has_the_same_defaults_as_a_dictionary(tmp_path):
    write_gaussians(tmp_path / "model.ply", Scene(degree=2).gaussians)
    path = tmp_path / "scene.xml"
    path.write_text(
        scene_xml(
            VIEWS[1],
            '<integrator type="splats"><string name="filename" value="model.ply"/></integrator>',
        )
    )
    by_xml = mi.load_file(str(path)).integrator()
    by_dict = mi.load_dict({"type": "splats", **tensors(Scene(degree=2).gaussians)})
    assert str(by_xml) == str(by_dict)
    assert str(by_xml) == (
        "SplatsIntegrator[\n"
        "  gaussians = 40,\n"
        "  sh_degree = 2,\n"
        "  background = [[0, 0, 0]],\n"
        "  near = 0.01,\n"
        "  srgb_primitives = True\n"
        "]"
    )


def test_its_text_names_what_is_not_as_usual():
    settings = {"aovs": "d:depth,a:alpha", "ignore": "motion, defocus", "hide_emitters": True}
    integrator = mi.load_dict(
        {"type": "splats", **tensors(Scene(degree=0).gaussians), **settings, "low_pass": 0.1}
    )
    lines = str(integrator).splitlines()
    assert "  aovs = d:depth, a:alpha," in lines
    assert "  ignore = motion, defocus" in lines
    assert "  hide_emitters = True," in lines
    assert "  low_pass = 0.1," in lines


def test_tensors_without_higher_coefficients_are_of_degree_zero():
    values = tensors(Scene(degree=0).gaussians)
    del values["shN"]
    integrator = mi.load_dict({"type": "splats", **values})
    assert integrator.sh_degree == 0 and integrator.shN.shape == (40, 0, 3)


@pytest.mark.parametrize("shape", [(40,), (40, 1)])
@pytest.mark.parametrize("kind", ["tensor", "array"])
def test_logit_opacities_may_be_flat_or_a_column(shape, kind):
    scene = Scene()
    values = tensors(scene.gaussians)
    logits = values["logit_opacities"].array
    values["logit_opacities"] = mi.TensorXf(logits, shape) if kind == "tensor" else logits
    integrator = mi.load_dict(scene.settings | values)
    assert np.array_equal(image_of(scene.load(), integrator=integrator), fresh_image(scene))


@pytest.mark.parametrize(
    "background",
    [
        [0.5, 0.5, 0.5],
        0.5,
        {"type": "rgb", "value": [0.5, 0.5, 0.5]},
        {"type": "rgb", "value": 0.5},
    ],
    ids=["list", "number", "rgb", "grey"],
)
def test_a_background_may_be_given_as_any_rgb(background):
    values = tensors(Scene().gaussians)
    integrator = mi.load_dict({"type": "splats", "background": background, **values})
    assert np.array_equal(np.array(integrator.background).ravel(), [0.5, 0.5, 0.5])


def test_a_scenes_parameters_are_not_the_callers_arrays():
    """Mitsuba assigns to parameters in place: two scenes of one dictionary would share them."""
    scene = Scene()
    values = tensors(scene.gaussians)
    before = {name: np.array(value) for name, value in values.items()}
    loaded = [
        mi.load_dict({"type": "scene", "integrator": scene.settings | values}) for _ in range(2)
    ]
    params = mi.traverse(loaded[0])
    for name in PARAMETER_NAMES:
        params[f"integrator.{name}"] = params[f"integrator.{name}"] * 0.5
    params.update()
    for name in PARAMETER_NAMES:
        assert np.array_equal(np.array(values[name]), before[name]), name
        other = np.array(getattr(loaded[1].integrator(), name))
        assert np.array_equal(other, before[name]), name


# ----------------------------------------------------------------------------------------------
# Variants
# ----------------------------------------------------------------------------------------------

SWITCHING = """
import mitsuba as mi
{order}
import sys
sys.path.insert(0, "tests")
from support.views import Scene, image_of

def refusal():
    try:
        mi.load_dict({{"type": "splats", "filename": "nothing.ply"}})
    except Exception as error:
        return str(error).strip().splitlines()[-1]

scene = Scene(count=12)
loaded = scene.load()
first = image_of(loaded)
for variant in ("scalar_rgb", "llvm_ad_mono", "llvm_ad_spectral"):
    mi.set_variant(variant)
    print(refusal())
    mi.set_variant("llvm_ad_rgb")
    assert type(scene.load().integrator()) is type(loaded.integrator())
    assert (image_of(scene.load()) == first).all() and (image_of(loaded) == first).all()
"""


@pytest.mark.parametrize(
    "order",
    ["import drgs; mi.set_variant('llvm_ad_rgb')", "mi.set_variant('llvm_ad_rgb'); import drgs"],
    ids=["drgs first", "variant first"],
)
def test_variants_may_be_switched_and_others_refuse_in_one_line(order, run_python):
    result = run_python(SWITCHING.format(order=order))
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == [
        f"PluginError: splats: the variant '{variant}' is not supported, "
        "use mi.set_variant('llvm_ad_rgb')"
        for variant in ("scalar_rgb", "llvm_ad_mono", "llvm_ad_spectral")
    ]


CUDA = """
import sys
import drgs, mitsuba as mi
try:
    mi.set_variant("cuda_ad_rgb")
except ImportError as error:
    sys.exit(f"no CUDA: {error}")
sys.path.insert(0, "tests")
from support.helpers import relative_errors
from support.views import Scene, clear, gradients_of, image_of

scene = clear(Scene())
expected = {"image": scene.image(), **scene.gradients(scene.weights())}
gradients = gradients_of(scene.load(), scene.weights())
errors = relative_errors({"image": image_of(scene.load()), **gradients}, expected)
print(max(errors[name] for name in ("image", *gradients)))
"""


def test_picture_and_gradients_on_a_gpu(run_python):
    result = run_python(CUDA)
    if "no CUDA" in result.stderr:
        pytest.skip("cuda_ad_rgb is not usable here")
    assert result.returncode == 0, result.stderr
    assert float(result.stdout) < GRADIENTS


# ----------------------------------------------------------------------------------------------
# The picture
# ----------------------------------------------------------------------------------------------


@all_views
@both_color_spaces
def test_picture_equals_the_reference_from_any_view(view, srgb_primitives):
    """The picture of a crop window is compared with a part of the reference's whole picture."""
    scene = clear(Scene(view, srgb_primitives=srgb_primitives))
    assert_images_agree(fresh_image(scene), scene.image())


@all_settings
def test_picture_equals_the_reference_for_any_setting(scene):
    scene = clear(scene)
    assert_images_agree(fresh_image(scene), scene.image())


def test_every_setting_changes_the_picture():
    """Or the comparison above would not show that it is heeded."""
    plain = Scene(degree=3)
    for changes in (
        {"sh_degree": 1},
        {"antialiased": True},
        {"near": 0.25},
        {"srgb_primitives": True},
        {"background": (0.5, 0.5, 0.5)},
    ):
        difference = np.abs(replace(plain, **changes).image() - plain.image()).max()
        assert difference > 0.05, changes


def test_pixels_near_a_threshold_are_all_that_may_differ():
    """Not a seed that avoids them: a few hundred splats on a larger film."""
    scene = Scene(View("large", 120, 90), count=300)
    marked = scene.picture.near_threshold
    errors = np.abs(fresh_image(scene) - scene.image())
    differs = (errors > PICTURE * np.abs(scene.image()).max()).any(axis=-1)
    assert marked.any() and not (differs & ~marked).any()
    assert differs.sum() <= max(1, 1e-4 * differs.size)


@pytest.mark.parametrize("crop", [(13, 7, 29, 18), (40, 30, 13, 11), (0, 0, 5, 5)])
def test_a_window_is_a_part_of_the_whole_picture(crop):
    """Of splats so large that they reach into the window from far outside."""
    whole = Scene(View("whole", 53, 41))
    values = tensors(whole.gaussians)
    values["log_scales"] += 1.0
    integrator = mi.load_dict(whole.settings | values)
    window = replace(whole.view, crop=crop)
    whole_image, window_image = (
        image_of(mi.load_dict({"type": "scene", "sensor": v.sensor()}), integrator=integrator)
        for v in (whole.view, window)
    )
    assert_images_agree(window_image, whole_image[window.window])


def test_background_is_seen_where_there_are_no_splats():
    scene = Scene(View("elsewhere", to_world=pose([1, 0, 0], -90, (0, 1000, 0))), count=8)
    scene = replace(scene, srgb_primitives=True)
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": scene.settings | tensors(Scene().gaussians),
            "sensor": scene.view.sensor(),
        }
    )
    image = image_of(loaded)
    assert np.allclose(image[..., :3], to_linear(scene.background), rtol=1e-5)
    assert (image[..., 3] == 0).all()


# volprim_rf_basic evaluates alpha at the ray's peak inside each ellipsoid and the colour along each
# ray, without low-pass; its samples lie anywhere in a pixel. On these splats, 3 px to 6 px wide and
# apart from each other, that makes 0.03 of the largest value. A wrong order of quaternions, a wrong
# sign of one SH coefficient or a shift by a pixel make at least 0.15.
VOLPRIM = 0.05


def test_isolated_splats_look_as_volprim_rf_basic_draws_them():
    view = View("apart", 72, 54, fov=25.0, to_world=pose([0.3, 1, 0.2], 30, (0.4, -0.7, 1.1)))
    camera = view.camera
    rng = np.random.default_rng(2)
    film = np.array([[17.0, 15.0], [54.0, 14.0], [20.0, 40.0], [52.0, 38.0]])
    points = np.column_stack([(film - [camera.cx, camera.cy]) / camera.fx * 3, np.full(4, 3.0)])
    gaussians = reference.Gaussians(
        means=points @ camera.rotation + camera.center,
        quats=rng.normal(0, 1, (4, 4)),
        log_scales=np.log(rng.uniform(3.5, 6.0, (4, 3)) * 3 / camera.fx),
        logit_opacities=np.array([0.0, 1.0, 2.0, -1.0]),
        sh0=rng.uniform(0, 2, (4, 1, 3)),
        shN=rng.normal(0, 0.4, (4, 15, 3)),
    )
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    xyzw = quats[:, [1, 2, 3, 0]]
    ellipsoids = np.concatenate([gaussians.means, np.exp(gaussians.log_scales), xyzw], axis=1)
    sh = np.concatenate([gaussians.sh0, gaussians.shN], axis=1).reshape(4, 48)
    sensor = view.sensor(samples=64, pixel_format="rgb")
    shape = {
        "type": "ellipsoids",
        "data": mi.TensorXf(ellipsoids.astype(np.float32)),
        "extent": 4.0,  # sigma; the default 3 would cut off up to 0.01
        "opacities": mi.TensorXf(
            reference.sigmoid(gaussians.logit_opacities)[:, None].astype(np.float32)
        ),
        "sh_coeffs": mi.TensorXf(sh.astype(np.float32)),
    }
    integrator = {"type": "volprim_rf_basic"}
    expected = image_of(
        mi.load_dict({"type": "scene", "integrator": integrator, "shape": shape, "s": sensor})
    )
    splats = {"type": "splats", **tensors(gaussians)}
    actual = image_of(mi.load_dict({"type": "scene", "integrator": splats, "s": sensor}))
    assert expected.max() > 0.5
    assert_images_agree(actual, expected, VOLPRIM)


# ----------------------------------------------------------------------------------------------
# Films, sensors, ways to call
# ----------------------------------------------------------------------------------------------


def test_a_border_of_the_film_does_not_change_the_picture():
    scene = Scene(VIEWS[-1])
    image = fresh_image(scene, rfilter="box", samples=1, sample_border=True)
    assert np.array_equal(image, fresh_image(scene, rfilter="box", samples=1))


def test_formats_of_the_film():
    scene = Scene()
    rgba = fresh_image(scene)
    assert np.array_equal(fresh_image(scene, pixel_format="rgb"), rgba[..., :3])
    assert np.array_equal(fresh_image(scene, component_format="float16"), rgba)
    luminance = fresh_image(scene, pixel_format="luminance")
    # Rec. 709 weights to four digits.
    expected = rgba[..., :3] @ [0.2126, 0.7152, 0.0722]
    assert np.allclose(luminance[..., 0], expected, rtol=1e-3)


def test_the_film_holds_the_picture(tmp_path):
    scene = Scene()
    loaded = scene.load(component_format="float16")
    image = image_of(loaded)
    film = loaded.sensors()[0].film()
    assert np.array_equal(np.array(film.develop()), image.astype(np.float32))
    film.write(str(tmp_path / "picture.exr"))
    written = np.array(mi.Bitmap(str(tmp_path / "picture.exr"))).astype(np.float64)
    assert np.allclose(written, image, rtol=2**-11, atol=1e-6)


def test_every_way_to_call_gives_the_same_picture():
    first, second = VIEWS[1], VIEWS[-1]
    scene = Scene(first)
    integrator = scene.settings | tensors(scene.gaussians)
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "first": first.sensor(),
            "second": second.sensor(),
        }
    )
    alone = mi.load_dict(integrator)
    sensor = mi.load_dict(second.sensor())
    one = np.array(mi.render(loaded))
    two = np.array(mi.render(loaded, sensor=1))
    assert one.shape == (23, 37, 4) and two.shape == (31, 22, 4)
    for image in (
        mi.render(loaded, sensor=0),
        mi.render(loaded, sensor=loaded.sensors()[0], seed=3),
        mi.render(loaded, integrator=alone),
        loaded.integrator().render(loaded),
        loaded.integrator().render(loaded, sensor=0, seed=1, spp=1),
        alone.render(loaded, loaded.sensors()[0], evaluate=False),
    ):
        assert np.array_equal(np.array(image), one)
    for image in (
        mi.render(loaded, sensor=sensor),
        loaded.integrator().render(loaded, sensor=1),
        loaded.integrator().render(loaded, sensor=sensor),
    ):
        assert np.array_equal(np.array(image), two)


def test_develop_false_leaves_the_picture_in_the_film():
    scene = Scene()
    loaded = scene.load()
    assert dr.width(loaded.integrator().render(loaded, develop=False)) == 0
    developed = np.array(loaded.sensors()[0].film().develop())
    assert np.array_equal(developed, np.array(mi.render(loaded)))


# ----------------------------------------------------------------------------------------------
# Gradients
# ----------------------------------------------------------------------------------------------


@all_settings
def test_gradients_equal_the_references_for_any_setting(scene):
    """Of all parameters, from random weights on colour and alpha."""
    scene = clear(scene)
    names = [n for n in ALL_PARAMETERS if n != "shN" or scene.degree > 0]
    actual = gradients_of(scene.load(), scene.weights(), names)
    assert_gradients_agree(actual, scene.gradients(scene.weights()))


@both_color_spaces
@pytest.mark.parametrize("view", [VIEWS[6], VIEWS[10], VIEWS[12]], ids=lambda view: view.name)
def test_gradients_equal_the_references_from_other_views(view, srgb_primitives):
    """A tall film, an off-centre principal point, a crop window."""
    scene = clear(Scene(view, srgb_primitives=srgb_primitives))
    actual = gradients_of(scene.load(), scene.weights())
    assert_gradients_agree(actual, scene.gradients(scene.weights()))


@both_color_spaces
def test_gradients_of_a_film_without_alpha(srgb_primitives):
    scene = clear(Scene(srgb_primitives=srgb_primitives))
    weights = scene.weights() * [1, 1, 1, 0]
    actual = gradients_of(scene.load(pixel_format="rgb"), weights[..., :3])
    assert_gradients_agree(actual, scene.gradients(weights))


# Rec. 709 primaries and white point D65 (Mitsuba's color.h).
XYZ = np.array(
    [
        [0.412453, 0.357580, 0.180423],
        [0.212671, 0.715160, 0.072169],
        [0.019334, 0.119193, 0.950227],
    ]
)


@pytest.mark.parametrize(
    ("pixel_format", "matrix"), [("luminance", XYZ[1:2]), ("xyz", XYZ)], ids=["luminance", "xyz"]
)
def test_gradients_of_a_film_that_converts_colors(pixel_format, matrix):
    scene = clear(Scene(srgb_primitives=True))
    weights = scene.weights()[..., : len(matrix)]
    actual = gradients_of(scene.load(pixel_format=pixel_format), weights)
    of_rgba = np.concatenate([weights @ matrix, np.zeros_like(weights[..., :1])], axis=-1)
    assert_gradients_agree(actual, scene.gradients(of_rgba))


def test_a_derivative_that_is_not_a_number_reaches_the_parameters():
    """Dr.Jit's derivative of a gather, such as of the film's pixels, would drop it."""
    scene = Scene()
    weights = scene.weights()
    weights[tuple(np.array(weights.shape[:2]) // 2)] = np.nan
    loaded = scene.load()
    actual = gradients_of(loaded, weights)
    assert not np.isfinite(actual["means"]).all()
    fault = rendering.decode_fault(int(loaded.integrator().last.first_fault[0]))
    assert fault is not None and fault[1] in PARAMETER_NAMES


def test_a_film_that_is_not_linear_refuses_gradients(monkeypatch):
    scene = Scene()
    loaded = scene.load()
    develop = exposure.develop_pixels
    monkeypatch.setattr(exposure, "develop_pixels", lambda *args: dr.square(develop(*args)))
    with pytest.raises(Exception, match="does not map each pixel's channels linearly"):
        gradients_of(loaded, scene.weights())


def test_the_gradient_tests_would_notice_one_percent():
    scene = clear(Scene())
    expected = scene.gradients(scene.weights())
    scaled = {name: 1.01 * expected[name] for name in ALL_PARAMETERS}
    errors = relative_errors(scaled, {name: expected[name] for name in ALL_PARAMETERS})
    assert min(errors.values()) > 10 * GRADIENTS


@pytest.mark.parametrize(
    "names", [("means",), ("background",), ("logit_opacities", "sh0"), ("shN", "quats")]
)
def test_only_enabled_parameters_receive_gradients(names):
    scene = Scene(srgb_primitives=True)
    loaded = scene.load()
    actual = gradients_of(loaded, scene.weights(), names)
    everything = gradients_of(scene.load(), scene.weights())
    for name in names:
        assert np.array_equal(actual[name], everything[name]), name
        assert np.abs(actual[name]).max() > 0
    params = mi.traverse(loaded)
    others = set(ALL_PARAMETERS) - set(names)
    assert not any(dr.grad_enabled(params[f"integrator.{name}"]) for name in others)


def test_an_image_of_no_enabled_parameter_is_detached():
    loaded = Scene().load()
    assert not dr.grad_enabled(mi.render(loaded, mi.traverse(loaded)))
    dr.enable_grad(mi.traverse(loaded)["integrator.means"])
    assert not dr.grad_enabled(mi.render(loaded))


def test_gradients_reach_what_parameters_were_computed_from():
    """A shift of all means: its gradient is the sum of theirs."""
    scene = clear(Scene())
    loaded = scene.load()
    params = mi.traverse(loaded)
    shift = mi.Float(0.0)
    dr.enable_grad(shift)
    params["integrator.means"] = params["integrator.means"] + shift
    params.update()
    image = mi.render(loaded, params)
    dr.backward(dr.sum(image * mi.TensorXf(scene.weights().astype(np.float32)), axis=None))
    expected = scene.gradients(scene.weights())["means"]
    assert dr.grad(shift)[0] == pytest.approx(
        expected.sum(), abs=GRADIENTS * np.abs(expected).max()
    )


def test_gradients_accumulate():
    scene = Scene()
    loaded = scene.load()
    once = gradients_of(loaded, scene.weights())
    twice = gradients_of(loaded, scene.weights())
    for name in ALL_PARAMETERS:
        assert np.array_equal(twice[name], 2 * once[name]), name


@pytest.mark.parametrize("suspended", [False, True], ids=["as it is", "gradients suspended"])
def test_render_backward_may_be_called_directly(suspended):
    scene = Scene()
    expected = gradients_of(scene.load(), scene.weights())
    loaded = scene.load()
    params = mi.traverse(loaded)
    for name in ALL_PARAMETERS:
        dr.enable_grad(params[f"integrator.{name}"])
    weights = mi.TensorXf(scene.weights().astype(np.float32))
    with dr.suspend_grad(when=suspended):
        loaded.integrator().render_backward(loaded, params, weights, sensor=0)
    for name in ALL_PARAMETERS:
        assert np.array_equal(gradient(params[f"integrator.{name}"]), expected[name]), name


ASIDE = View("aside", 31, 27, to_world=pose([0.3, -1.0, 0.5], 16, (0.6, -0.9, 0.9)))
"""Sees 26 of the 40 Gaussians before ``VIEWS[1]``."""


def reference_gradients_from(view, scene, weights) -> dict[str, np.ndarray]:
    """Gradients for the Gaussians of ``scene``, seen from ``view``."""
    background = np.array(scene.background)
    picture = reference.render(
        scene.gaussians, view.camera, background, threshold_width=NEAR_THRESHOLD
    )
    assert not picture.near_threshold.any(), "choose another view"
    return reference.render_gradients(
        scene.gaussians, view.camera, background, weights[..., :3], weights[..., 3]
    )


def test_two_views_before_one_backward_pass():
    """The second replaces the first's frame, which the backward pass has to render again."""
    scene, aside = clear(Scene()), mi.load_dict(ASIDE.sensor())
    loaded = scene.load()
    params = mi.traverse(loaded)
    for name in ALL_PARAMETERS:
        dr.enable_grad(params[f"integrator.{name}"])
    first, third = scene.weights(1), scene.weights(3)
    second = np.random.default_rng(2).normal(0, 1, (27, 31, 4))
    loss = mi.Float(0)
    for weights, sensor in ((first, 0), (second, aside), (third, 0)):
        image = mi.render(loaded, params, sensor=sensor)
        loss += dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None).array
    dr.backward(loss)
    from_first = scene.gradients(first + third)
    from_aside = reference_gradients_from(ASIDE, scene, second)
    actual = {name: gradient(params[f"integrator.{name}"]) for name in ALL_PARAMETERS}
    assert_gradients_agree(actual, {name: from_first[name] + from_aside[name] for name in actual})


def test_a_backward_pass_differentiates_the_parameters_of_its_time():
    """As Mitsuba's other integrators do: the scene is all that they know. Documented."""
    before, after = clear(Scene()), clear(Scene(seed=100))
    loaded = before.load()
    params = mi.traverse(loaded)
    dr.enable_grad(params["integrator.means"])
    image = mi.render(loaded, params)
    for name, value in tensors(after.gaussians).items():
        params[f"integrator.{name}"] = value
    dr.enable_grad(params["integrator.means"])
    params.update()
    dr.backward(dr.sum(image * mi.TensorXf(before.weights().astype(np.float32)), axis=None))
    actual = {"means": gradient(params["integrator.means"])}
    assert_gradients_agree(actual, after.gradients(before.weights()))


def test_last_holds_what_density_control_needs():
    scene = clear(Scene())
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": scene.settings | tensors(scene.gaussians),
            "sensor": ASIDE.sensor(),
        }
    )
    assert loaded.integrator().last is None
    weights = np.random.default_rng(2).normal(0, 1, (27, 31, 4))
    gradients_of(loaded, weights, ["means"])
    last = loaded.integrator().last
    actual = {"means2d": np.array(last.means2d_grad).astype(np.float64)}
    assert_gradients_agree(actual, reference_gradients_from(ASIDE, scene, weights))

    # Visible: the box around the ellipse alpha = 1/255 holds a pixel's centre.
    splats = reference.project(scene.gaussians, ASIDE.camera)
    k = 2 * np.log(np.maximum(splats.opacities / reference.ALPHA_CUT, 1))
    radius = np.sqrt(k[:, None] * np.diagonal(splats.cov2d, axis1=1, axis2=2))
    first = np.maximum(np.ceil(splats.means2d - radius - 0.5), 0)
    last_pixel = np.minimum(np.floor(splats.means2d + radius - 0.5), [30, 26])
    expected = splats.visible & (first <= last_pixel).all(axis=1)
    assert np.array_equal(np.array(last.visible), expected)
    assert expected.sum() == 26 and splats.visible.sum() == 38


def test_adam_reduces_the_loss():
    """Every parameter starts somewhat off; the picture it had is the target."""
    scene = Scene(srgb_primitives=True)
    target = mi.TensorXf(fresh_image(scene).astype(np.float32))
    rng = np.random.default_rng(4)
    loaded = scene.load()
    params = mi.traverse(loaded)
    optimizer = mi.ad.Adam(lr=0.02)
    for name in ALL_PARAMETERS:
        key = f"integrator.{name}"
        noise = rng.normal(0, 0.1, np.array(params[key]).shape).astype(np.float32)
        optimizer[key] = params[key] + type(params[key])(noise)
    losses = []
    for _ in range(25):
        params.update(optimizer)
        loss = dr.mean(dr.square(mi.render(loaded, params) - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < 0.3 * losses[0]


@pytest.mark.parametrize("count", [80, 20, 1], ids=["more", "fewer", "one"])
def test_parameters_may_be_resized(count):
    """The picture and the gradients are those of a scene that was loaded with the new ones."""
    loaded = Scene().load()
    mi.render(loaded)
    resized = clear(Scene(count=count) if count >= 4 else Scene(count=4, seed=1))
    values = {name: value[-count:] for name, value in vars(resized.gaussians).items()}
    params = mi.traverse(loaded)
    for name, value in tensors(reference.Gaussians(**values)).items():
        params[f"integrator.{name}"] = value
    params.update()
    actual = {"image": image_of(loaded), **gradients_of(loaded, resized.weights())}

    fresh = mi.load_dict(
        {
            "type": "scene",
            "integrator": resized.settings | tensors(reference.Gaussians(**values)),
            "sensor": resized.view.sensor(),
        }
    )
    expected = {"image": image_of(fresh), **gradients_of(fresh, resized.weights())}
    assert all(np.array_equal(actual[name], expected[name]) for name in expected)
    assert actual["means"].shape == (count, 3)
    if count >= 4:
        assert_images_agree(actual["image"], resized.image())


# ----------------------------------------------------------------------------------------------
# Depth and alpha
# ----------------------------------------------------------------------------------------------


def with_channels(scene, aovs="z:depth, a:alpha", sensor=None, **settings):
    """The scene with an integrator that puts out more than colours."""
    integrator = scene.settings | tensors(scene.gaussians) | {"aovs": aovs} | settings
    sensor = sensor or scene.view.sensor()
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})


def channels_of(scene, kinds) -> np.ndarray:
    """The window's channels besides colour, by the reference."""
    planes = {"depth": scene.picture.depth, "alpha": scene.picture.alpha}
    return np.stack([planes[kind] for kind in kinds], axis=-1)[scene.view.window]


@both_color_spaces
@pytest.mark.parametrize(("pixel_format", "count"), [("rgb", 3), ("rgba", 4)])
@pytest.mark.parametrize("view", [VIEWS[1], VIEWS[13]], ids=lambda view: view.name)
def test_depth_and_alpha_are_put_out_behind_the_colors(view, pixel_format, count, srgb_primitives):
    """In the order in which they are asked for, as linear numbers."""
    scene = clear(Scene(view, srgb_primitives=srgb_primitives))
    sensor = view.sensor(pixel_format=pixel_format)
    for kinds in (["depth", "alpha"], ["alpha", "depth"], ["depth"], ["alpha"]):
        aovs = ", ".join(f"{kind[0]}:{kind}" for kind in kinds)
        loaded = with_channels(scene, aovs, sensor)
        image = image_of(loaded)
        assert image.shape[-1] == count + len(kinds)
        plain = image_of(
            mi.load_dict({"type": "scene", "sensor": sensor}), integrator=fresh_integrator(scene)
        )
        np.testing.assert_array_equal(image[..., :count], plain)
        for k, expected in enumerate(np.moveaxis(channels_of(scene, kinds), -1, 0)):
            assert_images_agree(image[..., count + k], expected)
        film = loaded.sensors()[0].film()
        channel = {"depth": "d.T", "alpha": "a.I"}
        names = [c.name for c in film.bitmap().struct_()]
        assert names == [*pixel_format.upper(), *(channel[kind] for kind in kinds)]
        assert loaded.integrator().aov_names() == names[count:]


def test_a_kind_may_be_put_out_twice_under_two_names():
    scene = Scene()
    image = image_of(with_channels(scene, " first:depth,second:depth ,a:alpha,"))
    np.testing.assert_array_equal(image[..., 4], image[..., 5])
    np.testing.assert_array_equal(image[..., 6], image[..., 3])


@both_color_spaces
def test_gradients_of_depth_and_alpha_equal_the_references(srgb_primitives):
    """With those of the colours, from random weights on all channels."""
    scene = clear(Scene(srgb_primitives=srgb_primitives))
    weights = scene.weights()
    rng = np.random.default_rng(9)
    of_depth, of_alpha = (rng.normal(0, 1, weights.shape[:2]) for _ in range(2))
    actual = gradients_of(
        with_channels(scene),
        np.concatenate([weights, of_depth[..., None], of_alpha[..., None]], -1),
    )
    expected = scene.gradients(weights)
    others = reference.render_gradients(
        scene.gaussians, scene.camera, np.zeros(3), np.zeros((*of_depth.shape, 3)), of_alpha,
        of_depth, scene.rendered_degree, scene.antialiased,
    )  # fmt: skip
    total = {n: expected[n] + others.get(n, 0) for n in PARAMETER_NAMES}
    assert_gradients_agree(actual, total | {"background": expected["background"]})
    assert all(
        np.abs(others[n]).max() > 0.1 * np.abs(expected[n]).max() for n in ("means", "quats")
    )


def test_gradients_of_the_channels_are_those_of_a_film_without_alpha():
    scene = clear(Scene())
    weights = np.random.default_rng(9).normal(0, 1, (*scene.weights().shape[:2], 5))
    of_rgb = gradients_of(
        with_channels(scene, sensor=scene.view.sensor(pixel_format="rgb")), weights
    )
    padded = np.insert(weights, 3, 0, axis=-1)
    assert_gradients_agree(of_rgb, gradients_of(with_channels(scene), padded))


def test_several_samples_average_the_channels():
    """Depth and alpha of each sample; the alpha of the film is the same number."""
    scene = Scene()
    sensor = scene.view.sensor(samples=4)
    image = image_of(with_channels(scene, sensor=sensor), spp=4, seed=2)
    # The mean of the samples' transmittances, subtracted from one before or after.
    np.testing.assert_allclose(image[..., 5], image[..., 3], atol=1e-6)
    single_sample = image_of(with_channels(scene), spp=1)
    assert np.abs(image[..., 4] - single_sample[..., 4]).max() > 0.01


def test_forward_mode_of_the_channels_equals_central_differences():
    scene = clear(Scene())
    directions = random_directions(scene, ["means", "log_scales", "logit_opacities"])
    loaded = with_channels(scene)
    tangent = np.array(dr.forward_to(mi.render(loaded, with_tangents(loaded, directions))))

    def at(step):
        values = dict(vars(scene.gaussians))
        for name, direction in directions.items():
            values[name] = values[name] + step * direction
        picture = reference.render(reference.Gaussians(**values), scene.camera, np.zeros(3), 1)
        return np.stack([picture.depth, picture.alpha], axis=-1)

    expected = (at(STEP) - at(-STEP)) / (2 * STEP)
    assert_images_agree(tangent[..., 4:], expected, GRADIENTS)


def test_channels_that_are_not_asked_for_cost_nothing():
    """The planes of the frame are those of the features."""
    scene = Scene()
    for aovs, count in (("", 4), ("a:alpha", 4), ("z:depth", 5)):
        loaded = with_channels(scene, aovs)
        mi.render(loaded)
        frames = loaded.integrator().memory.rendered[0].frames
        assert len(frames[0][0].planes()) == count


# ----------------------------------------------------------------------------------------------
# Forward mode
# ----------------------------------------------------------------------------------------------

# The reference's difference quotient is off by STEP^2 / 6 times the third derivative and by
# 1e-16 / STEP: 1e-8 of the largest value. What is left is the kernels' single precision.
STEP = 1e-7


def with_tangents(loaded, directions):
    """Parameters of a scene with gradients enabled and set to ``directions``."""
    params = mi.traverse(loaded)
    for name, direction in directions.items():
        parameter = params[f"integrator.{name}"]
        dr.enable_grad(parameter)
        dr.set_grad(parameter, type(parameter)(direction.astype(np.float32)))
    return params


def random_directions(scene, names):
    rng = np.random.default_rng(7)
    values = vars(scene.gaussians) | {"background": np.array(scene.background)}
    return {
        name: rng.normal(0, 1, values[name].shape).astype(np.float32).astype(np.float64)
        for name in names
    }


def moved(scene, directions, step) -> np.ndarray:
    """The reference's image (H, W, 4) of the scene, moved along the directions."""
    values = dict(vars(scene.gaussians))
    background = np.array(scene.background)
    for name, direction in directions.items():
        if name == "background":
            background = background + step * direction
        else:
            values[name] = values[name] + step * direction
    picture = reference.render(
        reference.Gaussians(**values), scene.camera, np.zeros(3), scene.rendered_degree,
        scene.antialiased,
    )  # fmt: skip
    return replace(scene, background=tuple(background)).image(picture)


@pytest.mark.parametrize(
    "names", [*((name,) for name in ALL_PARAMETERS), ALL_PARAMETERS], ids=lambda n: "+".join(n)
)
@both_color_spaces
def test_forward_mode_equals_central_differences(names, srgb_primitives):
    scene = clear(Scene(VIEWS[12], srgb_primitives=srgb_primitives))
    directions = random_directions(scene, names)
    loaded = scene.load()
    params = with_tangents(loaded, directions)
    image = mi.render(loaded, params)
    actual = np.array(dr.forward_to(image)).astype(np.float64)
    expected = (moved(scene, directions, STEP) - moved(scene, directions, -STEP)) / (2 * STEP)
    assert_images_agree(actual, expected, GRADIENTS)


def test_forward_mode_without_higher_coefficients():
    scene = clear(Scene(degree=0, antialiased=True))
    names = [name for name in ALL_PARAMETERS if name != "shN"]
    directions = random_directions(scene, names)
    loaded = scene.load()
    image = mi.render(loaded, with_tangents(loaded, directions))
    expected = (moved(scene, directions, STEP) - moved(scene, directions, -STEP)) / (2 * STEP)
    assert_images_agree(np.array(dr.forward_to(image)), expected, GRADIENTS)


@both_color_spaces
def test_forward_and_backward_mode_are_transposed(srgb_primitives):
    """<J v, w> = <v, J^T w>."""
    scene = clear(Scene(srgb_primitives=srgb_primitives, degree=2, antialiased=True))
    directions = random_directions(scene, ALL_PARAMETERS)
    loaded = scene.load()
    image = mi.render(loaded, with_tangents(loaded, directions))
    forward = np.sum(np.array(dr.forward_to(image)).astype(np.float64) * scene.weights())
    gradients = gradients_of(scene.load(), scene.weights())
    terms = [np.sum(directions[name] * gradients[name]) for name in ALL_PARAMETERS]
    assert forward == pytest.approx(sum(terms), abs=1e-5 * np.abs(terms).max())


# ----------------------------------------------------------------------------------------------
# The same bytes in every run
# ----------------------------------------------------------------------------------------------

DIGEST = """
import hashlib
import drgs, drjit as dr, mitsuba as mi
dr.set_thread_count({threads})
mi.set_variant("llvm_ad_rgb")
import sys
sys.path.insert(0, "tests")
from support.views import Scene, View, gradients_of, image_of

scene = Scene(View("large", 150, 110), count=2000, srgb_primitives=True)
loaded = scene.load()
digest = hashlib.sha256(image_of(loaded).tobytes())
for name, value in gradients_of(loaded, scene.weights()).items():
    digest.update(value.tobytes())
print(digest.hexdigest())
"""


def test_picture_and_gradients_have_the_same_bytes_in_every_process(run_python):
    """Whatever the number of threads."""
    results = [run_python(DIGEST.format(threads=threads)) for threads in (1, 2, 3)]
    assert all(result.returncode == 0 for result in results), results[0].stderr
    assert len({result.stdout for result in results}) == 1


# ----------------------------------------------------------------------------------------------
# Parameters
# ----------------------------------------------------------------------------------------------


def test_traverse_lists_the_documented_parameters_as_differentiable():
    params = mi.traverse(mi.load_dict({"type": "splats", **tensors(Scene().gaussians)}))
    assert list(params.keys()) == list(ALL_PARAMETERS)
    shapes = {name: tuple(params[name].shape) for name in PARAMETER_NAMES}
    assert shapes == {
        "means": (40, 3),
        "quats": (40, 4),
        "log_scales": (40, 3),
        "logit_opacities": (40,),
        "sh0": (40, 1, 3),
        "shN": (40, 3, 3),
    }
    assert {type(params[name]) for name in PARAMETER_NAMES} == {mi.TensorXf, mi.Float}
    for name in ALL_PARAMETERS:
        assert params.flags(name) == mi.ParamFlags.Differentiable.value, name


def test_a_model_of_degree_zero_has_no_empty_parameter():
    """An empty parameter could not be optimized."""
    params = mi.traverse(Scene(degree=0).load())
    ours = [key for key in params.keys() if key.startswith("integrator.")]  # noqa: SIM118
    assert ours == [f"integrator.{name}" for name in ALL_PARAMETERS if name != "shN"]


def test_the_class_documents_every_parameter():
    integrator = mi.load_dict({"type": "splats", **tensors(Scene().gaussians)})
    documentation = type(integrator).__doc__
    settings = ("filename", "to_world", "shapes_to_world", "sh_degree", "near", "srgb_primitives")
    choices = [field.name for field in fields(Approximations)]
    for name in (*settings, *choices, *ALL_PARAMETERS):
        assert name in documentation, name


# ----------------------------------------------------------------------------------------------
# The frame that is kept from render() to render_backward()
# ----------------------------------------------------------------------------------------------


@pytest.fixture
def renderings(monkeypatch):
    """A list that grows with each frame that is rendered and not reused."""
    calls = []
    original = rendering.render

    def counting(*arguments):
        calls.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(rendering, "render", counting)
    return calls


def kernels_of(action) -> int:
    """Kernels that Dr.Jit launches during ``action``."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        action()
        history = dr.kernel_history()
    return sum(kernel["type"] == dr.KernelType.JIT for kernel in history)


def test_an_unchanged_scene_is_not_rendered_again():
    """All that is launched reads the pixels and lays out the image."""
    loaded = Scene().load()
    dr.eval(mi.render(loaded))
    assert kernels_of(lambda: dr.eval(mi.render(loaded))) <= 2
    loaded.integrator().memory.rendered.clear()
    assert kernels_of(lambda: dr.eval(mi.render(loaded))) > 10


def test_a_backward_pass_reuses_the_frame(renderings):
    scene = Scene()
    gradients_of(scene.load(), scene.weights())
    assert len(renderings) == 1


def change_pose(params):
    params["sensor.to_world"] = mi.ScalarTransform4f(np.array(VIEWS[2].to_world))


def change(key, value):
    def apply(params):
        params[key] = value() if callable(value) else value

    return apply


SENSOR_CHANGES = {
    "to_world": (change_pose, {"to_world": VIEWS[2].to_world}),
    "field of view": (change("sensor.x_fov", 60.0), {"fov": 60.0}),
    "principal point": (
        change("sensor.principal_point_offset_x", 0.125),
        {"offset": (0.125, 0.0)},
    ),
    "near clip": (change("sensor.near_clip", 0.25), {"near_clip": 0.25}),
    "film size": (change("sensor.film.size", [29, 19]), {"width": 29, "height": 19}),
}


@pytest.mark.parametrize("name", SENSOR_CHANGES)
def test_a_changed_sensor_is_rendered_again(name, renderings):
    apply, changes = SENSOR_CHANGES[name]
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    apply(params)
    params.update()
    assert len(renderings) == 1
    after = image_of(loaded)
    assert len(renderings) == 2
    view = replace(scene.view, **changes)
    sensor = mi.load_dict(view.sensor())
    expected = image_of(loaded, sensor=sensor, integrator=fresh_integrator(scene))
    assert_images_agree(after, expected)
    assert after.shape != before.shape or np.abs(after - before).max() > 0.05


def fresh_integrator(scene, **settings):
    return mi.load_dict(scene.settings | tensors(scene.gaussians) | settings)


def test_a_moved_window_is_rendered_again():
    scene = Scene(replace(VIEWS[12], crop=(13, 7, 29, 18)))
    loaded = scene.load()
    mi.render(loaded)
    params = mi.traverse(loaded)
    params["sensor.film.crop_offset"] = [15, 9]
    params.update()
    expected = replace(scene.view, crop=(15, 9, 29, 18))
    sensor = mi.load_dict(expected.sensor())
    image = image_of(loaded, sensor=sensor, integrator=fresh_integrator(scene))
    assert np.array_equal(image_of(loaded), image)


@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_a_changed_parameter_is_rendered_again(name, renderings):
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    params[f"integrator.{name}"] = params[f"integrator.{name}"] + 0.25
    params.update()
    after = image_of(loaded)
    assert len(renderings) == 2 and np.abs(after - before).max() > 0.01
    value = type(params[f"integrator.{name}"])(params[f"integrator.{name}"])
    expected = fresh_integrator(scene, **{name: value})
    assert np.array_equal(after, image_of(loaded, integrator=expected))


def test_a_parameter_written_in_place_is_rendered_again():
    """Through a view of its memory, announced as Mitsuba asks for: no variable's index changes."""
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    memory = params["integrator.logit_opacities"].numpy()
    memory += 1
    params.set_dirty("integrator.logit_opacities")
    params.update()
    after = image_of(loaded)
    value = mi.TensorXf(scene.gaussians.logit_opacities.astype(np.float32) + 1)
    expected = image_of(loaded, integrator=fresh_integrator(scene, logit_opacities=value))
    assert np.abs(after - before).max() > 0.01 and np.array_equal(after, expected)


@pytest.mark.parametrize(
    "name, value, equivalent",
    [
        ("sh_degree", 0, {"sh_degree": 0}),
        ("near", 0.25, {"near": 0.25}),
        ("approximations", Approximations(antialiased=True), {"antialiased": True}),
    ],
)
def test_a_changed_setting_is_rendered_again(name, value, equivalent, renderings):
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    setattr(loaded.integrator(), name, value)
    after = image_of(loaded)
    assert len(renderings) == 2 and np.abs(after - before).max() > 0.01
    assert np.array_equal(after, fresh_image(replace(scene, **equivalent)))


@pytest.mark.parametrize(
    "choices",
    [
        {"projection": "exact", "order": "pixel", "sh_direction": "pixel"},
        {"projection": "unscented", "extent": 2.5, "low_pass": 0},
        {"alpha_max": 0.5, "alpha_cut": 0.05, "transmittance_stop": 0.1, "order_window": 2},
    ],
    ids=["rays", "unscented", "cuts"],
)
def test_choices_of_accuracy_are_parameters(choices):
    """The picture and its gradients are those of the pipeline that these choices name."""
    scene = Scene()
    integrator = mi.load_dict({"type": "splats", **tensors(scene.gaussians), **choices})
    values = {k: float(v) if k == "low_pass" else v for k, v in choices.items()}
    assert integrator.approximations == Approximations(**values)
    for name, value in values.items():
        if value != getattr(Approximations(), name):
            assert f"  {name} = {value}" in str(integrator)
    loaded = scene.load()
    image = image_of(loaded, integrator=integrator)
    expected = mi.load_dict({"type": "splats", **tensors(scene.gaussians)})
    assert np.abs(image - image_of(loaded, integrator=expected)).max() > 1e-3
    expected.approximations = Approximations(**values)
    assert np.array_equal(image, image_of(loaded, integrator=expected))


def test_a_changed_background_needs_no_new_frame_and_no_new_kernel(renderings):
    scene = Scene(srgb_primitives=True)
    loaded = scene.load()
    params = mi.traverse(loaded)
    for color in ([0.25, 0.5, 0.75], [0.125, 0.375, 0.625]):
        params["integrator.background"] = color
        params.update()
        dr.eval(mi.render(loaded))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        params["integrator.background"] = [0.375, 0.875, 0.0625]
        params.update()
        after = image_of(loaded)
        history = dr.kernel_history()
    assert all(kernel["cache_hit"] for kernel in history if kernel["type"] == dr.KernelType.JIT)
    assert len(renderings) == 1
    changed = replace(scene, background=(0.375, 0.875, 0.0625))
    assert np.array_equal(after, fresh_image(changed))


def test_a_new_view_needs_no_new_kernel():
    loaded = Scene(VIEWS[1]).load()
    sensors = [mi.load_dict(View("", to_world=pose([1, 2, i], 20 + i)).sensor()) for i in range(3)]
    for sensor in sensors[:2]:
        dr.eval(mi.render(loaded, sensor=sensor))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(mi.render(loaded, sensor=sensors[2]))
        history = dr.kernel_history()
    kernels = [kernel for kernel in history if kernel["type"] == dr.KernelType.JIT]
    assert len(kernels) > 10 and all(kernel["cache_hit"] for kernel in kernels)


def test_a_stale_frame_is_not_kept():
    loaded = Scene().load()
    mi.render(loaded)
    frame = weakref.ref(loaded.integrator().memory.rendered[0].frames[0][0])
    params = mi.traverse(loaded)
    params["integrator.means"] = params["integrator.means"] + 1
    params.update()
    gc.collect()
    assert frame() is None


def test_no_graph_stays_behind_after_a_backward_pass():
    """The film would hold it until the next rendering."""
    scene = Scene()
    loaded = scene.load()
    gradients_of(loaded, scene.weights())
    assert not dr.grad_enabled(loaded.sensors()[0].film().develop())
    params = with_tangents(loaded, random_directions(scene, ["means"]))
    dr.forward_to(mi.render(loaded, params))
    assert not dr.grad_enabled(loaded.sensors()[0].film().develop())


# ----------------------------------------------------------------------------------------------
# What is not to be simulated, and what is said about it
# ----------------------------------------------------------------------------------------------

CLOSE = pose([0.3, -1.0, 0.5], 48, (0.5, -0.6, 1.0))


def sensor_like(view, kind="calibrated", **changes) -> dict:
    """The view with a pinhole, by another sensor."""
    sensor = view.sensor()
    kept = {key: sensor[key] for key in ("to_world", "film", "sampler", "near_clip")}
    if kind == "calibrated":
        camera = view.camera
        kept |= {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return kept | {"type": kind, **changes}


BENT = {"lens": "opencv", "k1": -0.25, "p1": 0.01}
BLURRED = {"aperture_radius": 0.1, "focus_distance": 2.0, "fov": VIEWS[1].fov}


def moving(**changes):
    return {"to_world_close": mi.ScalarTransform4f(np.array(CLOSE)), **changes}


IGNORED = {
    "distortion": ("distortion", lambda: sensor_like(VIEWS[1], **BENT)),
    "fisheye": ("distortion", lambda: sensor_like(VIEWS[1], lens="fisheye", k1=0.02)),
    "defocus": ("defocus", lambda: sensor_like(VIEWS[1], "thinlens", **BLURRED)),
    "motion blur": ("motion", lambda: sensor_like(VIEWS[1], **moving(shutter_samples=2))),
    "rolling shutter": ("motion", lambda: sensor_like(VIEWS[1], **moving(shutter="rolling"))),
    "both": ("motion, distortion", lambda: sensor_like(VIEWS[1], **BENT, **moving())),
}


@pytest.mark.parametrize("case", IGNORED)
def test_what_is_ignored_leaves_a_pinhole_that_stands_still(case):
    """And what is not asked to be ignored is seen."""
    ignored, sensor = IGNORED[case]
    scene = Scene()

    def image(**settings):
        integrator = scene.settings | tensors(scene.gaussians) | settings
        return image_of(
            mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor()})
        )

    expected = fresh_image(scene)
    assert_images_agree(image(ignore=ignored), expected)
    assert np.abs(image() - expected).max() > 0.05
    others = [word for word in ("distortion", "defocus", "motion") if word not in ignored]
    assert np.array_equal(image(ignore=", ".join([*others, "smoothing"])), image())


def test_an_orthographic_lens_is_no_distortion():
    """No pinhole could take its place."""
    scene = Scene()
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": fresh_integrator(scene, ignore="distortion"),
            "sensor": sensor_like(VIEWS[1], "orthographic"),
        }
    )
    plain = image_of(loaded, integrator=fresh_integrator(scene))
    assert np.array_equal(image_of(loaded), plain)


def plan_of(sensor, **settings) -> str:
    scene = Scene(degree=settings.pop("degree", 1))
    emitter = {"sky": {"type": "constant"}} if settings.pop("sky", False) else {}
    integrator = fresh_integrator(scene, **settings)
    loaded = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **emitter})
    return loaded.integrator().summary(loaded, loaded.sensors()[0])


def test_a_plan_of_a_plain_scene():
    assert plan_of(VIEWS[1].sensor()) == (
        "simulated:\n"
        "  view dependence: spherical harmonics up to degree 1 (the Gaussians' coefficients)\n"
        "  background: a constant colour (the integrator's background)\n"
        "  not simulated: lens, depth of field, motion, antialiasing, surfaces"
    )


def test_a_plan_names_what_asked_for_each_effect():
    sensor = sensor_like(VIEWS[1], **BENT, **moving(shutter="rolling"))
    smoothing = mi.Float(np.full(40, 0.01, np.float32))
    settings = {"sky": True, "degree": 0, "antialiased": True, "smoothing": smoothing}
    assert plan_of(sensor, **settings) == (
        "simulated:\n"
        "  background: an environment (the scene's emitter)\n"
        "  lens: RadialTangential (k1, p1, p2) (the sensor)\n"
        "  motion: rolling shutter (the sensor)\n"
        "  antialiasing: opacities compensated for the low-pass filter, 3D smoothing filter "
        "(antialiased, the Gaussians' filter)\n"
        "  not simulated: view dependence, depth of field, surfaces"
    )
    ignored = plan_of(sensor, **settings, ignore="distortion, motion, smoothing")
    absent = "view dependence, lens (ignored), depth of field, motion (ignored)"
    assert f"  not simulated: {absent}, smoothing filter (ignored), surfaces" in ignored
    assert "3D smoothing" not in ignored
    defocused = plan_of(sensor_like(VIEWS[1], "thinlens", **BLURRED), sky=True, hide_emitters=True)
    assert "  depth of field: a thin lens (the sensor)\n" in defocused
    assert "  background: a constant colour (the integrator's background)\n" in defocused
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32))}
    blurred = plan_of(sensor_like(VIEWS[1], **moving()), background=picture)
    assert "  background: a picture (the integrator's background)\n" in blurred
    assert "  motion: blurred (the sensor)\n" in blurred


@pytest.fixture
def logged(monkeypatch):
    """What this integrator says at the level of information; other messages are dropped."""
    lines = []
    monkeypatch.setattr(mi, "Log", lambda level, text: lines.append((level, text)))
    before = mi.log_level()
    yield lines
    mi.set_log_level(before)


def test_a_plan_is_logged_once_where_somebody_listens(logged):
    """Again when it is another."""
    scene = Scene()
    loaded = scene.load()
    mi.render(loaded)
    assert logged == []
    mi.set_log_level(mi.LogLevel.Info)
    for _ in range(3):
        mi.render(loaded)
    sensor = loaded.sensors()[0]
    assert logged == [(mi.LogLevel.Info, f"splats: {loaded.integrator().summary(loaded, sensor)}")]
    gradients_of(loaded, scene.weights(), ["means"])
    assert len(logged) == 1
    mi.render(loaded, sensor=mi.load_dict(sensor_like(VIEWS[1], "thinlens", **BLURRED)))
    assert len(logged) == 2 and "depth of field: a thin lens" in logged[1][1]


# ----------------------------------------------------------------------------------------------
# Errors
# ----------------------------------------------------------------------------------------------


@cache
def valid():
    return tensors(Scene(count=8).gaussians)


def zeros(*shape):
    return mi.TensorXf(np.zeros(shape, np.float32))


def message_of(error) -> str:
    """The message of the exception that a chain of exceptions started with."""
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__
    return str(error)


def refusal_of_dictionary(**changes) -> str:
    """The last line of what Mitsuba says when the plugin cannot be loaded."""
    settings = {"type": "splats", **valid(), **changes}
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({key: value for key, value in settings.items() if value is not None})
    return str(caught.value).strip().splitlines()[-1]


NONE = dict.fromkeys(PARAMETER_NAMES)

REFUSED = {
    "one tensor given": (
        {name: None for name in PARAMETER_NAMES if name != "sh0"},
        "PluginError: splats: give 'filename', or the Gaussians as tensors means, quats, "
        "log_scales, logit_opacities, sh0, shN; missing: means, quats, log_scales, "
        "logit_opacities",
    ),
    "a tensor missing": ({"quats": None}, "missing: quats"),
    "file and tensors": (
        {"filename": "x.ply"},
        "PluginError: splats: give either 'filename' or tensors, got both (means, quats, "
        "log_scales, logit_opacities, sh0, shN)",
    ),
    "no such file": (
        {**NONE, "filename": "nowhere.ply"},
        "UserError: nowhere.ply: cannot read the file: No such file or directory",
    ),
    "not a tensor": ({"means": "abc"}, "PluginTypeError: splats: means must be a tensor, got str"),
    "means": (
        {"means": lambda: zeros(8, 2)},
        "PluginError: splats: means must have the shape (N, 3), with N = 8 the rows of means, got "
        "(8, 2)",
    ),
    "quats": (
        {"quats": lambda: zeros(7, 4)},
        "PluginError: splats: quats must have the shape (N, 4), with N = 8 the rows of means, got "
        "(7, 4)",
    ),
    "logit_opacities": (
        {"logit_opacities": lambda: zeros(9)},
        "PluginError: splats: logit_opacities must have the shape (N), with N = 8 the rows of "
        "means, got (9,)",
    ),
    "sh0": ({"sh0": lambda: zeros(8, 3)}, "splats: sh0 must have the shape (N, 1, 3)"),
    "shN": (
        {"shN": lambda: zeros(8, 4, 3)},
        "splats: shN must have the shape (N, 0, 3) or (N, 3, 3) or (N, 8, 3) or (N, 15, 3)",
    ),
    "no Gaussians": (
        {name: (lambda name=name: zeros(0, *valid()[name].shape[1:])) for name in PARAMETER_NAMES},
        "PluginError: splats: at least one Gaussian is needed, got none",
    ),
    "sh_degree above any": (
        {"sh_degree": 4},
        "PluginError: splats: sh_degree must be an integer from 0 to 3, got 4",
    ),
    "sh_degree negative": ({"sh_degree": -1}, "got -1"),
    "sh_degree not an integer": ({"sh_degree": 0.5}, "got 0.5"),
    "sh_degree a float": ({"sh_degree": 0.0}, "sh_degree must be an integer from 0 to 3, got 0.0"),
    "sh_degree a boolean": ({"sh_degree": True}, "got True"),
    "sh_degree a string": ({"sh_degree": "1"}, "got '1'"),
    "near zero": ({"near": 0.0}, "PluginError: splats: near must be a positive number, got 0.0"),
    "near negative": ({"near": -1}, "got -1"),
    "near a boolean": ({"near": True}, "splats: near must be a positive number, got True"),
    "near infinite": ({"near": float("inf")}, "near must be a positive number, got inf"),
    "near a string": ({"near": "far"}, "got 'far'"),
    "near not a number": ({"near": float("nan")}, "got nan"),
    "antialiased a string": (
        {"antialiased": "no"},
        "PluginTypeError: splats: antialiased must be true or false, got 'no'",
    ),
    "order_window a float": (
        {"order_window": 3.5},
        "PluginTypeError: splats: order_window must be an integer, got 3.5",
    ),
    "an unknown projection": (
        {"projection": "affine"},
        "PluginError: splats: projection must be one of ewa, unscented, exact, got 'affine'",
    ),
    "a low-pass below zero": (
        {"low_pass": -1},
        "PluginError: splats: low_pass must be finite and not negative, got -1.0",
    ),
    "srgb_primitives a number": ({"srgb_primitives": 1}, "must be true or false, got 1"),
    "background a string": ({"background": "white"}, "splats: background must be an RGB colour"),
    "background a spectrum": (
        {"background": {"type": "spectrum", "value": 0.5}},
        "splats: background must be an RGB colour",
    ),
    "aovs without a type": (
        {"aovs": "depth"},
        "PluginError: splats: aovs must be a list of name:type with names of their own and types "
        "of depth, alpha, normal, got 'depth'",
    ),
    "aovs of an unknown type": ({"aovs": "a:alpha, n:sh_normal"}, "got 'n:sh_normal'"),
    "aovs without a name": ({"aovs": ":depth"}, "got ':depth'"),
    "aovs of one name": ({"aovs": "a:alpha, a:depth"}, "got 'a:depth'"),
    "ignore": (
        {"ignore": "motion, background"},
        "PluginError: splats: ignore must be a list of distortion, defocus, motion, smoothing, got "
        "'background'",
    ),
    "hide_emitters a number": (
        {"hide_emitters": 1},
        'The property "hide_emitters" has the wrong type (expected boolean, got integer)',
    ),
    "unknown": ({"sh_degre": 1}, '- integer "sh_degre": 1'),
    "a texture under an unknown name": (
        {"backgroud": {"type": "checkerboard"}},
        "PluginError: splats: backgroud must be an integrator, the only object besides the texture "
        "background, got Checkerboard; did you mean background?",
    ),
    "an object of no use": (
        {"foo": {"type": "diffuse"}},
        "splats: foo must be an integrator, the only object besides the texture background, got "
        "SmoothDiffuse",
    ),
    "an object of no use besides an integrator": (
        {"nested": {"type": "path"}, "foo": {"type": "diffuse"}},
        "splats: foo must be an integrator",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_properties_are_refused_in_one_line(case):
    changes, expected = REFUSED[case]
    changes = {key: v() if callable(v) else v for key, v in changes.items()}
    assert expected in refusal_of_dictionary(**changes)


def test_an_unknown_property_is_mitsubas_own_error():
    with pytest.raises(RuntimeError, match="unreferenced property"):
        mi.load_dict({"type": "splats", **valid(), "sh_degre": 1})


@pytest.mark.parametrize("degree", [4, -1, 0.0, True])
def test_the_degree_in_use_is_checked(degree):
    integrator = mi.load_dict({"type": "splats", **valid()})
    with pytest.raises(ValueError, match=rf"integer from 0 to 3, got {degree}"):
        integrator.sh_degree = degree
    assert integrator.sh_degree == 1


@pytest.mark.parametrize("use", ["render", "summary"])
@pytest.mark.parametrize("given", [True, False], ids=["when loaded", "later"])
def test_a_degree_above_that_of_the_scenes_gaussians_is_refused(given, use):
    """Before that, shapes of the scene might have it."""
    loaded = replace(Scene(), sh_degree=2 if given else None).load()
    integrator = loaded.integrator()
    if not given:
        mi.render(loaded)
        integrator.sh_degree = 2
    with pytest.raises(ValueError, match=r"integer from 0 to 1, the degree of the Gau.* got 2"):
        getattr(integrator, use)(loaded, loaded.sensors()[0])
    integrator.sh_degree = np.int64(1)
    mi.render(loaded)


@pytest.mark.parametrize(
    "name, shape, message",
    [
        ("means", (8, 2), r"means must have the shape \(N, 3\)"),
        ("means", (9, 3), r"quats must have the shape \(N, 4\), with N = 9"),
        ("shN", (8, 5, 3), r"shN must have the shape"),
        ("shN", (8, 0, 3), r"sh_degree must be an integer from 0 to 0"),
    ],
)
def test_parameters_that_do_not_fit_are_refused_when_updated(name, shape, message):
    params = mi.traverse(mi.load_dict({"type": "splats", **valid()}))
    params[name] = zeros(*shape)
    with pytest.raises(ValueError, match=rf"^splats: {message}"):
        params.update()


def test_other_sensors_are_refused():
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "splats", **valid()},
            "s": {"type": "radiancemeter", "film": {"type": "hdrfilm", "width": 1, "height": 1}},
        }
    )
    with pytest.raises(RuntimeError) as caught:
        mi.render(loaded)
    assert message_of(caught.value).startswith(
        "splats: the sensor must be of type perspective, thinlens, orthographic or calibrated, got "
    )
