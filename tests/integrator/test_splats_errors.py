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

REFUSED = [
    (
        {name: None for name in PARAMETER_NAMES if name != "sh0"},
        "give 'filename', or the Gaussians as tensors means, quats, log_scales, "
        "logit_opacities, sh0, shN; missing: means, quats, log_scales, ",
    ),
    (
        {"filename": "x.ply"},
        "give either 'filename' or tensors, got both (means, quats, log_scales, "
        "logit_opacities, sh0, shN)",
    ),
    (
        {**NONE, "filename": "x.ply", "smoothing": lambda: zeros(8)},
        "give either 'filename' or tensors, got both (smoothing)",
    ),
    (
        {**NONE, "filename": "nowhere.ply"},
        "UserError: nowhere.ply: cannot read the file: No such file or directory",
    ),
    ({"means": "abc"}, "PluginTypeError: splats: means must be a tensor, got str"),
    (
        {"means": lambda: mi.TensorXf(3.0)},
        "means must have the shape (N, 3), with N = 1 the rows of means, got ()",
    ),
    (
        {"means": lambda: mi.Point3f(np.zeros((3, 8), np.float32))},
        "means must have the shape (N, 3), with N = 3 the rows of means, got (3, 8)",
    ),
    (
        {"quats": lambda: zeros(7, 4)},
        "quats must have the shape (N, 4), with N = 8 the rows of means, got ",
    ),
    (
        {"logit_opacities": lambda: zeros(9)},
        "logit_opacities must have the shape (N), with N = 8 the rows of means, got (9,)",
    ),
    (
        {"logit_opacities": lambda: zeros(2, 4)},
        "logit_opacities must have the shape (N), got (2, 4)",
    ),
    (
        {"shN": lambda: zeros(8, 4, 3)},
        "shN must have the shape (N, 0, 3) or (N, 3, 3) or (N, 8, 3) or (N, 15, 3)",
    ),
    (
        {name: (lambda name=name: zeros(0, *valid()[name].shape[1:])) for name in PARAMETER_NAMES},
        "at least one Gaussian is needed, got none",
    ),
    ({"sh_degree": 4}, "sh_degree must be an integer from 0 to 3, got 4"),
    ({"sh_degree": 0.0}, "sh_degree must be an integer from 0 to 3, got 0.0"),
    ({"light_samples": 4097}, "light_samples must be an integer from 0 to 4096, got 4097"),
    ({"nested_spp": 1.5}, "nested_spp must be an integer from 0 to"),
    ({"nested_spp": 2**32}, f"nested_spp must be an integer from 0 to {MAX_INT}, got 4294967296"),
    ({"light": "beams"}, "light must be one of none, probe, rays, got 'beams'"),
    ({"near": 0.0}, "PluginError: splats: near must be a positive number, got 0.0"),
    ({"near": "far"}, "got 'far'"),
    ({"near": True}, "near must be a positive number, got True"),
    ({"near": 1e-300}, "a positive number, got 1e-300"),
    ({"near": 1e300}, "a positive number, got 1e+300"),
    ({"background": [0.0, float("nan"), 0.0]}, "background must be finite numbers, got "),
    (
        {"background": "white"},
        "background must be an RGB colour, such as [1, 1, 1] or <rgb value='1, 1, 1'/>, or a "
        "texture, got str",
    ),
    (
        {"background": {"type": "spectrum", "value": 0.5}},
        "background must be an RGB colour, such as ",
    ),
    ({"background": {"type": "constant"}}, "background must be an RGB colour, such as "),
    ({"background": lambda: mi.ScalarTransform4f()}, "background must be an RGB colour, such as "),
    (
        {**NONE, "to_world": lambda: mi.ScalarTransform4f().scale(2)},
        "give 'filename', or the Gaussians as tensors",
    ),
    (
        {"to_world": lambda: mi.ScalarTransform4f().scale([1, 2, 1])},
        "to_world must be made of rotations, translations and scales",
    ),
    ({"to_world": "up"}, "to_world must be a transform, got str"),
    (
        {**NONE, "shapes_to_world_a": lambda: mi.ScalarTransform4f().scale([-1, 1, 1])},
        "shapes_to_world_a must be made of rotations, translations and scales",
    ),
    ({**NONE, "sh_degree": 4}, "sh_degree must be an integer from 0 to 3"),
    (
        {"aovs": "f:feature_other", "feature_mine": lambda: zeros(8, 2)},
        "types of depth, alpha, normal, feature_mine, got",
    ),
    *(
        (
            {"aovs": "f:feature_mine", "feature_mine": lambda shape=shape: zeros(*shape)},
            f"with N = 8 the rows of means and C at least 1, got {shape}",
        )
        for shape in ((7, 2), (8,), (8, 2, 2))
    ),
    (
        {"aovs": "n:normal, f:feature_x, a:alpha", "feature_x": lambda: zeros(8, 2000)},
        "aovs can have at most 64 channels together, got 2,003 (n 3, f 2,000); render "
        "them in parts, which share a kernel",
    ),
    ({"antialiased": "no"}, "PluginTypeError: splats: antialiased must be true or false, got 'no'"),
    ({"low_pass": -1}, "low_pass must be finite and not negative, got -1.0"),
    (
        {"aovs": "depth"},
        "aovs must be a list of name:type with names of their own and types of depth, "
        "alpha, normal, got 'depth'",
    ),
    ({"aovs": "a:alpha, n:sh_normal"}, "got 'n:sh_normal'"),
    ({"aovs": ":depth"}, "got ':depth'"),
    ({"aovs": "a:alpha, a:depth"}, "got 'a:depth'"),
    (
        {"ignore": "motion, background"},
        "ignore must be a list of distortion, defocus, motion, smoothing, got 'background'",
    ),
    ({"hide_emitters": 1}, '"hide_emitters" has the wrong type (expected boolean'),
    ({"sh_degre": 1}, "there is no parameter sh_degre; did you mean sh_degree?"),
    ({"zzz": 1}, "there is no parameter zzz; there are filename, to_world, shapes_to_world, "),
    (
        {"log_scale": lambda: zeros(8, 3)},
        "there is no parameter log_scale; did you mean log_scales?",
    ),
    (
        {"backgroud": {"type": "checkerboard"}},
        "backgroud must be an integrator, the only object besides the texture background,"
        " got Checkerboard; did you mean background?",
    ),
    (
        {"nested": {"type": "path"}, "foo": {"type": "diffuse"}},
        "foo must be an integrator, the only object besides the texture background, got "
        "SmoothDiffuse",
    ),
]

NOT_BY_SPLATS = ("UserError: ", '"hide_emitters"')


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "message"), REFUSED, ids=[str([*c]) for c, _ in REFUSED])
def test_wrong_properties_are_refused_in_one_line(changes, message):
    changes = {key: v() if callable(v) else v for key, v in changes.items()}
    settings = {"type": "splats", **valid(), **changes}
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({key: value for key, value in settings.items() if value is not None})
    line = str(caught.value).strip().splitlines()[-1]
    assert message in line
    by_splats = line.startswith(("PluginError: splats: ", "PluginTypeError: splats: "))
    assert by_splats != message.startswith(NOT_BY_SPLATS)


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
