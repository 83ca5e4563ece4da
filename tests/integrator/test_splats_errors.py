"""Errors of the ``splats`` integrator."""

from dataclasses import replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.views import Scene, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.core.constants import MAX_FEATURES, MAX_INT
from drgs.gaussians.parameters import PARAMETER_NAMES


@cache
def valid():
    return tensors(Scene(count=8).gaussians)


def zeros(*shape):
    return mi.TensorXf(np.zeros(shape, np.float32))


NONE = dict.fromkeys(PARAMETER_NAMES)

REFUSED = {
    "one tensor given": (
        {name: None for name in PARAMETER_NAMES if name != "sh0"},
        "PluginError: splats: give 'filename', or the Gaussians as tensors means, quats, "
        "log_scales, logit_opacities, sh0, shN; missing: means, quats, log_scales, ",
    ),
    "file and tensors": (
        {"filename": "x.ply"},
        "PluginError: splats: give either 'filename' or tensors, got both (means, quats, "
        "log_scales, logit_opacities, sh0, shN)",
    ),
    "a filter besides a file": (
        {**NONE, "filename": "x.ply", "smoothing": lambda: zeros(8)},
        "splats: give either 'filename' or tensors, got both (smoothing)",
    ),
    "no such file": (
        {**NONE, "filename": "nowhere.ply"},
        "UserError: nowhere.ply: cannot read the file: No such file or directory",
    ),
    "not a tensor": ({"means": "abc"}, "PluginTypeError: splats: means must be a tensor, got str"),
    "means a number": (
        {"means": lambda: mi.TensorXf(3.0)},
        "splats: means must have the shape (N, 3), with N = 1 the rows of means, got ()",
    ),
    "means by axis": (
        {"means": lambda: mi.Point3f(np.zeros((3, 8), np.float32))},
        "splats: means must have the shape (N, 3), with N = 3 the rows of means, got (3, 8)",
    ),
    "quats": (
        {"quats": lambda: zeros(7, 4)},
        "PluginError: splats: quats must have the shape (N, 4), with N = 8 the rows of means, got ",
    ),
    "logit_opacities": (
        {"logit_opacities": lambda: zeros(9)},
        "logit_opacities must have the shape (N), with N = 8 the rows of means, got (9,)",
    ),
    "logit_opacities of two axes": (
        {"logit_opacities": lambda: zeros(2, 4)},
        "PluginError: splats: logit_opacities must have the shape (N), got (2, 4)",
    ),
    "shN": (
        {"shN": lambda: zeros(8, 4, 3)},
        "splats: shN must have the shape (N, 0, 3) or (N, 3, 3) or (N, 8, 3) or (N, 15, 3)",
    ),
    "no Gaussians": (
        {name: (lambda name=name: zeros(0, *valid()[name].shape[1:])) for name in PARAMETER_NAMES},
        "PluginError: splats: at least one Gaussian is needed, got none",
    ),
    "sh_degree": (
        {"sh_degree": 4},
        "PluginError: splats: sh_degree must be an integer from 0 to 3, got 4",
    ),
    "sh_degree a float": ({"sh_degree": 0.0}, "sh_degree must be an integer from 0 to 3, got 0.0"),
    "light_samples": (
        {"light_samples": 4097},
        "splats: light_samples must be an integer from 0 to 4096, got 4097",
    ),
    "nested_spp": ({"nested_spp": 1.5}, "splats: nested_spp must be an integer from 0 to"),
    "nested_spp beyond integers": (
        {"nested_spp": 2**32},
        f"nested_spp must be an integer from 0 to {MAX_INT}, got 4294967296",
    ),
    "light": ({"light": "beams"}, "light must be one of none, probe, rays, got 'beams'"),
    "near": ({"near": 0.0}, "PluginError: splats: near must be a positive number, got 0.0"),
    "near a string": ({"near": "far"}, "got 'far'"),
    "near a boolean": ({"near": True}, "splats: near must be a positive number, got True"),
    "near not a number": ({"near": float("nan")}, "got nan"),
    "near zero in single precision": ({"near": 1e-300}, "a positive number, got 1e-300"),
    "near infinite in single precision": ({"near": 1e300}, "a positive number, got 1e+300"),
    "background not a number": (
        {"background": [0.0, float("nan"), 0.0]},
        "PluginError: splats: background must be finite numbers, got ",
    ),
    "background a string": ({"background": "white"}, "splats: background must be an RGB colour"),
    "background a spectrum": (
        {"background": {"type": "spectrum", "value": 0.5}},
        "splats: background must be an RGB colour, such as ",
    ),
    "background an emitter": (
        {"background": {"type": "constant"}},
        "splats: background must be an RGB colour, such as ",
    ),
    "background a transform": (
        {"background": lambda: mi.ScalarTransform4f()},
        "splats: background must be an RGB colour, such as ",
    ),
    "to_world without Gaussians": (
        {**NONE, "to_world": lambda: mi.ScalarTransform4f().scale(2)},
        "splats: give 'filename', or the Gaussians as tensors",
    ),
    "to_world no similarity": (
        {"to_world": lambda: mi.ScalarTransform4f().scale([1, 2, 1])},
        "splats: to_world must be made of rotations, translations and scales",
    ),
    "to_world a string": ({"to_world": "up"}, "splats: to_world must be a transform, got str"),
    "a mirroring shapes_to_world": (
        {**NONE, "shapes_to_world_a": lambda: mi.ScalarTransform4f().scale([-1, 1, 1])},
        "splats: shapes_to_world_a must be made of rotations, translations and scales",
    ),
    "sh_degree of shapes": (
        {**NONE, "sh_degree": 4},
        "splats: sh_degree must be an integer from 0 to 3",
    ),
    "aovs of a feature that is not given": (
        {"aovs": "f:feature_other", "feature_mine": lambda: zeros(8, 2)},
        "types of depth, alpha, normal, feature_mine, got",
    ),
    **{
        f"a feature of shape {shape}": (
            {"aovs": "f:feature_mine", "feature_mine": lambda shape=shape: zeros(*shape)},
            f"with N = 8 the rows of means and C at least 1, got {shape}",
        )
        for shape in ((7, 2), (8,), (8, 2, 2))
    },
    "features of 2,000 columns": (
        {"aovs": "n:normal, f:feature_x, a:alpha", "feature_x": lambda: zeros(8, 2000)},
        "splats: aovs can have at most 64 channels together, got 2,003 (n 3, f 2,000); render them "
        "in parts, which share a kernel",
    ),
    "antialiased": (
        {"antialiased": "no"},
        "PluginTypeError: splats: antialiased must be true or false, got 'no'",
    ),
    "order_window": ({"order_window": 3.5}, "splats: order_window must be from 1 to 64, got 3.5"),
    "projection": (
        {"projection": "affine"},
        "PluginError: splats: projection must be one of ewa, unscented, exact (others come "
        "with installed packages that have an entry point of the group \"drgs\"), got 'affine'",
    ),
    "low_pass": ({"low_pass": -1}, "splats: low_pass must be finite and not negative, got -1.0"),
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
    "hide_emitters": ({"hide_emitters": 1}, '"hide_emitters" has the wrong type (expected boolean'),
    "unknown": (
        {"sh_degre": 1},
        "PluginError: splats: there is no parameter sh_degre; did you mean sh_degree?",
    ),
    "unknown, and near to nothing": (
        {"zzz": 1},
        "splats: there is no parameter zzz; there are filename, to_world, shapes_to_world, ",
    ),
    "an unknown tensor": (
        {"log_scale": lambda: zeros(8, 3)},
        "splats: there is no parameter log_scale; did you mean log_scales?",
    ),
    "a texture under an unknown name": (
        {"backgroud": {"type": "checkerboard"}},
        "PluginError: splats: backgroud must be an integrator, the only object besides the texture "
        "background, got Checkerboard; did you mean background?",
    ),
    "an object of no use": (
        {"nested": {"type": "path"}, "foo": {"type": "diffuse"}},
        "splats: foo must be an integrator, the only object besides the texture background, got "
        "SmoothDiffuse",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", REFUSED)
def test_wrong_properties_are_refused_in_one_line(case):
    changes, expected = REFUSED[case]
    changes = {key: v() if callable(v) else v for key, v in changes.items()}
    settings = {"type": "splats", **valid(), **changes}
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({key: value for key, value in settings.items() if value is not None})
    assert expected in str(caught.value).strip().splitlines()[-1]


@pytest.mark.parametrize(
    "kind", [dr.scalar.TensorXf, dr.llvm.TensorXf64, dr.llvm.TensorXi, dr.llvm.ad.TensorXf16]
)
def test_tensors_of_other_types_are_converted(kind):
    means = np.arange(24).reshape(8, 3)
    integrator = mi.load_dict({"type": "splats", **valid(), "means": kind(means)})
    assert type(integrator.gaussians.means) is mi.TensorXf
    np.testing.assert_array_equal(integrator.gaussians.means.numpy(), means)
    params = mi.traverse(integrator)
    params["means"] = means + 1.0  # numpy's are converted as well
    params.update()
    np.testing.assert_array_equal(integrator.gaussians.means.numpy(), means + 1)


def test_numpy_arrays_are_refused_with_a_remedy():
    """Before the plugin sees them."""
    with pytest.raises(RuntimeError, match=r"\[means\] could .* cast this value into a Dr.Jit arr"):
        mi.load_dict({"type": "splats", **valid(), "means": np.zeros((8, 3))})


@pytest.mark.parametrize("use", ["render", "summary"])
@pytest.mark.parametrize("given", [True, False], ids=["when loaded", "later"])
def test_degree_above_that_of_the_gaussians_is_refused(given, use):
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
    with pytest.raises(ValueError, match="integer from 0 to 3, got True"):
        integrator.sh_degree = True
    assert integrator.sh_degree == 1


@pytest.mark.parametrize(
    "name, shape, message",
    [
        ("means", (8, 2), r"means must have the shape \(N, 3\)"),
        ("means", (9, 3), r"quats must have the shape \(N, 4\), with N = 9"),
        ("shN", (8, 5, 3), r"shN must have the shape"),
        ("shN", (8, 0, 3), r"sh_degree must be an integer from 0 to 0"),
        ("feature_x", (8, 2000), "aovs can have at most 64 channels together, got 2,000"),
    ],
)
def test_parameters_that_do_not_fit_are_refused_when_updated(name, shape, message):
    feature = {"aovs": "f:feature_x", "feature_x": zeros(8, MAX_FEATURES)}
    params = mi.traverse(mi.load_dict({"type": "splats", **valid(), **feature}))
    params[name] = zeros(*shape)
    with pytest.raises(ValueError, match=rf"^splats: {message}"):
        params.update()


def test_parameters_that_were_refused_are_not_rendered():
    """Rows beyond an array's end would be read. What fits again is rendered again."""
    name = "quats"
    loaded = Scene(count=8).load()
    params, expected = mi.traverse(loaded), np.array(mi.render(loaded))
    fitting = params[f"integrator.{name}"]
    params[f"integrator.{name}"] = zeros(3, *fitting.shape[1:])
    with pytest.raises(ValueError, match="the rows of means, got"):
        params.update()
    with pytest.raises(ValueError, match="the rows of means, got"):
        loaded.integrator().render(loaded)
    params[f"integrator.{name}"] = valid()[name]
    params.update()
    np.testing.assert_array_equal(np.array(mi.render(loaded)), expected)


def test_only_nested_spp_can_be_set():
    integrator = mi.load_dict({"type": "splats", **valid()})
    integrator.nested_spp = 3
    assert integrator.nested_spp == 3 and "nested_spp = 3" in str(integrator)
    for name in ("near", "ignore", "srgb_primitives", "gaussians", "pipeline"):
        with pytest.raises(AttributeError):
            setattr(integrator, name, getattr(integrator, name))
