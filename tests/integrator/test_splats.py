"""The ``splats`` integrator as a user of Mitsuba meets it: loading, variants, images, films."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from conftest import CHOSEN_LLVM, REPOSITORY
from support.helpers import clear
from support.splats_checks import GRADIENTS, assert_images_agree, fresh_image, write_gaussians
from support.views import VIEWS, Scene, View, gradients_of, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES


@pytest.mark.parametrize("degree", [0, 3])
def test_a_file_and_tensors_give_the_same_image(degree, tmp_path):
    scene = Scene(degree=degree)
    write_gaussians(tmp_path / "model.ply", scene.gaussians)
    integrator = mi.load_dict(scene.settings | {"filename": str(tmp_path / "model.ply")})
    assert np.array_equal(image_of(scene.load(), integrator=integrator), fresh_image(scene))


SCENE_XML = """
<scene version="3.0.0">
    <integrator type="splats" id="integrator">
        <string name="filename" value="models/model.ply"/>
        <rgb name="background" value="0.875, 0.375, 0.03125"/>
        <integer name="sh_degree" value="0"/>
        <boolean name="antialiased" value="true"/>
        <float name="near" value="0.25"/>
        <boolean name="srgb_primitives" value="true"/>
    </integrator>
</scene>
"""


@pytest.mark.parametrize("parallel", [True, False])
def test_xml_finds_a_file_beside_itself(parallel, tmp_path, monkeypatch):
    scene = Scene(srgb_primitives=True, sh_degree=0, antialiased=True, near=0.25)
    (tmp_path / "scene" / "models").mkdir(parents=True)
    write_gaussians(tmp_path / "scene" / "models" / "model.ply", scene.gaussians)
    path = tmp_path / "scene" / "scene.xml"
    path.write_text(SCENE_XML)
    monkeypatch.chdir(tmp_path)
    loaded = mi.load_file(str(path), parallel=parallel)
    assert "integrator.means" in mi.traverse(loaded)
    sensor = mi.load_dict(scene.view.sensor())
    assert np.array_equal(image_of(loaded, sensor=sensor), fresh_image(scene))


def test_repr_lists_non_default_settings():
    settings = {"aovs": "d:depth,a:alpha", "ignore": "motion", "hide_emitters": True}
    lit = {"light": "rays", "exposure": 2.0}  # a former name of radiance_scale
    given = tensors(Scene(degree=0).gaussians) | settings | lit | {"low_pass": 0.1}
    del given["shN"]
    assert str(mi.load_dict({"type": "splats", **given})).splitlines() == [
        "SplatsIntegrator[",
        "  gaussians = 40,",
        "  sh_degree = 0,",
        "  background = [[0, 0, 0]],",
        "  near = 0.01,",
        "  srgb_primitives = True,",
        "  low_pass = 0.1,",
        "  hide_emitters = True,",
        "  aovs = d:depth, a:alpha,",
        "  light = rays,",
        "  radiance_scale = 2.0,",
        "  ignore = motion",
        "]",
    ]


@pytest.mark.parametrize("kind", ["column", "array"])
def test_logit_opacities_may_be_a_column_or_no_tensor(kind):
    scene = Scene()
    logits = tensors(scene.gaussians)["logit_opacities"].array
    logits = mi.TensorXf(logits, (40, 1)) if kind == "column" else logits
    assert np.array_equal(image_of(scene.load_with(logit_opacities=logits)), fresh_image(scene))


@pytest.mark.parametrize(
    "background", [[0.5, 0.5, 0.5], 0.5, {"type": "rgb", "value": [0.5, 0.5, 0.5]}]
)
def test_a_background_may_be_given_as_any_rgb(background):
    values = tensors(Scene().gaussians)
    integrator = mi.load_dict({"type": "splats", "background": background, **values})
    assert np.array_equal(np.array(integrator.state.background).ravel(), [0.5, 0.5, 0.5])


def test_scene_parameters_are_copies_of_the_arguments():
    """Mitsuba assigns to parameters in place: two scenes of one dictionary would share them."""
    values = tensors(Scene().gaussians)
    before = {name: np.array(value) for name, value in values.items()}
    changed, other = (mi.load_dict({"type": "splats", **values}) for _ in range(2))
    params = mi.traverse(changed)
    for name in PARAMETER_NAMES:
        params[name] = params[name] * 0.5
    params.update()
    for name, expected in before.items():
        np.testing.assert_array_equal(values[name], expected, err_msg=name)
        np.testing.assert_array_equal(getattr(other.gaussians, name), expected, err_msg=name)


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
    result = run_python(SWITCHING_PROGRAM.format(order=order), **CHOSEN_LLVM)
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


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
def test_image_equals_the_reference_from_any_view(view):
    """The image of a crop window is compared with a part of the reference's whole image."""
    scene = clear(Scene(view))
    assert_images_agree(fresh_image(scene), scene.image())


@pytest.mark.parametrize("crop", [(13, 7, 29, 18), (40, 30, 13, 11), (0, 0, 5, 5)])
def test_crop_window_is_a_part_of_the_whole_image(crop):
    """Large splats reach into the window from far outside."""
    whole = Scene(View("whole", 53, 41))
    values = tensors(whole.gaussians)
    values["log_scales"] += 1.0
    window = replace(whole.view, crop=crop)
    whole_image, window_image = (
        image_of(whole.load_with(view.sensor(), **values)) for view in (whole.view, window)
    )
    assert_images_agree(window_image, whole_image[window.window])


def test_every_way_to_call_gives_the_same_image():
    views = VIEWS[1], VIEWS[-1]
    scene = Scene(views[0])
    integrator = scene.settings | tensors(scene.gaussians)
    sensors = {f"sensor_{k}": view.sensor() for k, view in enumerate(views)}
    loaded = mi.load_dict({"type": "scene", "integrator": integrator, **sensors})
    alone, own = mi.load_dict(integrator), loaded.integrator()
    for k, sensor in enumerate(loaded.sensors()):
        expected = image_of(loaded, sensor=k)
        for image in (
            mi.render(loaded, sensor=sensor, seed=3),
            mi.render(loaded, sensor=mi.load_dict(views[k].sensor()), integrator=alone),
            own.render(loaded, sensor=k, seed=1, spp=1),
            alone.render(loaded, sensor, evaluate=False),
        ):
            np.testing.assert_array_equal(image, expected)
    np.testing.assert_array_equal(own.render(loaded), image_of(loaded))


@pytest.mark.parametrize("pixel_format", ["rgb", "rgba"])
def test_the_minimal_integrator_gives_the_same_bytes(pixel_format, tmp_path):
    """The readable twin has the images and gradients of ``splats`` with its defaults."""
    path = write_gaussians(tmp_path / "splats.ply", Scene(degree=3).gaussians)
    results = []
    for kind in ("splats", "splats_minimal"):
        sensor, integrator = VIEWS[1].sensor(pixel_format), {"type": kind, "filename": path}
        scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})
        image = image_of(scene)
        gradients = gradients_of(scene, 2 * (image - 0.3), PARAMETER_NAMES)
        assert all(gradient.any() for gradient in gradients.values())
        results.append([image.tobytes(), *(gradient.tobytes() for gradient in gradients.values())])
    assert results[0] == results[1]


def test_the_minimal_integrator_fits_one_page():
    assert len((REPOSITORY / "plugins" / "minimal.py").read_text().splitlines()) <= 120
