"""The ``splats`` integrator as a user of Mitsuba meets it: loading, variants, images, films."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import clear
from support.openexr import read_exr
from support.splats_checks import (
    GRADIENTS,
    IMAGE,
    all_settings,
    assert_images_agree,
    both_color_spaces,
    fresh_image,
    write_gaussians,
)
from support.views import VIEWS, Scene, View, image_of, pose, tensors, to_linear

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.io.scenes import openexr_threads
from drgs.reference import splatting as reference

all_views = pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


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


@pytest.mark.parametrize("degree", [0, 3])
def test_a_file_and_tensors_give_the_same_image(degree, tmp_path):
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


def test_repr_lists_non_default_settings():
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
    assert integrator.sh_degree == 0 and integrator.gaussians.shN.shape == (40, 0, 3)


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
    assert np.array_equal(np.array(integrator.state.background).ravel(), [0.5, 0.5, 0.5])


def test_scene_parameters_are_copies_of_the_arguments():
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
        other = np.array(getattr(loaded[1].integrator().gaussians, name))
        assert np.array_equal(other, before[name]), name


# ----------------------------------------------------------------------------------------------
# Variants
# ----------------------------------------------------------------------------------------------


SWITCHING_PROGRAM = """
import mitsuba as mi
{order}
import sys
sys.path.insert(0, "tests")
from support.views import Scene, image_of

def refusal(plugin):
    try:
        mi.load_dict({{"type": plugin}})
    except Exception as error:
        return str(error).strip().splitlines()[-1]

scene = Scene(count=12)
loaded = scene.load()
first = image_of(loaded)
for variant in ("scalar_rgb", "llvm_ad_mono", "llvm_ad_spectral"):
    mi.set_variant(variant)
    for plugin in ("splats", "splatpath", "calibrated"):
        print(refusal(plugin))
    mi.set_variant("llvm_ad_rgb")
    assert type(scene.load().integrator()) is type(loaded.integrator())
    assert (image_of(scene.load()) == first).all() and (image_of(loaded) == first).all()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "order",
    ["import drgs; mi.set_variant('llvm_ad_rgb')", "mi.set_variant('llvm_ad_rgb'); import drgs"],
    ids=["drgs first", "variant first"],
)
def test_variants_can_be_switched_and_unsupported_ones_are_refused(order, run_python):
    result = run_python(SWITCHING_PROGRAM.format(order=order))
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == [
        f"PluginError: {plugin}: the variant '{variant}' is not supported, "
        "use mi.set_variant('llvm_ad_rgb')"
        for variant in ("scalar_rgb", "llvm_ad_mono", "llvm_ad_spectral")
        for plugin in ("splats", "splatpath", "calibrated")
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
from support.helpers import clear
from support.views import Scene, gradients_of, image_of

scene = clear(Scene())
expected = {"image": scene.image(), **scene.gradients(scene.weights())}
gradients = gradients_of(scene.load(), scene.weights())
errors = relative_errors({"image": image_of(scene.load()), **gradients}, expected)
print(max(errors[name] for name in ("image", *gradients)))
"""


@pytest.mark.slow
def test_image_and_gradients_on_a_gpu(run_python):
    result = run_python(CUDA)
    if "no CUDA" in result.stderr:
        pytest.skip("cuda_ad_rgb is not usable here")
    assert result.returncode == 0, result.stderr
    assert float(result.stdout) < GRADIENTS


# ----------------------------------------------------------------------------------------------
# The image
# ----------------------------------------------------------------------------------------------


@all_views
@both_color_spaces
def test_image_equals_the_reference_from_any_view(view, srgb_primitives):
    """The image of a crop window is compared with a part of the reference's whole image."""
    scene = clear(Scene(view, srgb_primitives=srgb_primitives))
    assert_images_agree(fresh_image(scene), scene.image())


@all_settings
def test_image_equals_the_reference_for_any_setting(scene):
    scene = clear(scene)
    assert_images_agree(fresh_image(scene), scene.image())


def test_every_setting_changes_the_image():
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


def test_only_pixels_near_a_threshold_may_differ():
    """Not a seed that avoids them: a few hundred splats on a larger film."""
    scene = Scene(View("large", 120, 90), count=300)
    marked = scene.rendered.near_threshold
    errors = np.abs(fresh_image(scene) - scene.image())
    differs = (errors > IMAGE * np.abs(scene.image()).max()).any(axis=-1)
    assert marked.any() and not (differs & ~marked).any()
    assert differs.sum() <= max(1, 1e-4 * differs.size)


@pytest.mark.parametrize("crop", [(13, 7, 29, 18), (40, 30, 13, 11), (0, 0, 5, 5)])
def test_crop_window_is_a_part_of_the_whole_image(crop):
    """Large splats reach into the window from far outside."""
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


def test_background_shows_where_there_are_no_splats():
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


def test_isolated_splats_match_volprim_rf_basic():
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


def test_film_border_does_not_change_the_image():
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


def test_film_contains_the_image(tmp_path):
    scene = Scene()
    loaded = scene.load(component_format="float16")
    image = image_of(loaded)
    film = loaded.sensors()[0].film()
    assert np.array_equal(np.array(film.develop()), image.astype(np.float32))
    with openexr_threads():
        film.write(str(tmp_path / "image.exr"))
    written = np.array(read_exr(tmp_path / "image.exr")).astype(np.float64)
    assert np.allclose(written, image, rtol=2**-11, atol=1e-6)


def test_every_way_to_call_gives_the_same_image():
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


def test_develop_false_leaves_the_image_in_the_film():
    scene = Scene()
    loaded = scene.load()
    assert dr.width(loaded.integrator().render(loaded, develop=False)) == 0
    developed = np.array(loaded.sensors()[0].film().develop())
    assert np.array_equal(developed, np.array(mi.render(loaded)))
