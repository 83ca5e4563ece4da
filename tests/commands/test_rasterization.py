"""``drgs.rasterization`` against the float64 reference and central differences."""

from dataclasses import replace
from functools import cache, partial

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
import pytest
from support.helpers import Case, bitwise, clear
from support.kernels import float_reductions, kernels_of

import drgs
from drgs.reference import splatting as reference
from drgs.splatting.order import FEATURES_AT_ONCE

CASE = Case("front door", width=21, height=18, degree=3, count=24)


@cache
def cameras():
    """Return the case's camera, and one that is moved, turned and zoomed."""
    camera = clear(CASE).camera
    turn = reference.quat_to_rotation(np.array([[1.0, 0.05, -0.04, 0.08]]))[0]
    center = camera.center + np.array([0.03, -0.05, 0.04])
    other = replace(camera, rotation=turn @ camera.rotation, center=center, fx=1.1 * camera.fx)
    return camera, other


@cache
def scene():
    """Arguments by name: float64 arrays of the case's Gaussians, with SH, and two cameras."""
    gaussians = clear(CASE).gaussians
    viewmats, intrinsics = (np.tile(np.eye(n), (2, 1, 1)) for n in (4, 3))
    for viewmat, matrix, camera in zip(viewmats, intrinsics, cameras(), strict=True):
        viewmat[:3, :3] = camera.rotation
        viewmat[:3, 3] = -camera.rotation @ camera.center
        matrix[[0, 1], [0, 1]] = camera.fx, camera.fy
        matrix[:2, 2] = camera.cx, camera.cy
    return {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": np.exp(gaussians.log_scales),
        "opacities": reference.sigmoid(gaussians.logit_opacities),
        "colors": np.concatenate([gaussians.sh0, gaussians.shN], axis=1),
        "viewmats": viewmats,
        "Ks": intrinsics,
        "backgrounds": np.array([[0.875, 0.375, 0.1875], [0.25, 0.5, 0.75]]),
    }


FILM = {"width": CASE.width, "height": CASE.height, "near_plane": 0.25}


def tensors(arrays, tensor_type=llvm.TensorXf64):
    dtype = np.float64 if tensor_type is llvm.TensorXf64 else np.float32
    return {name: tensor_type(np.asarray(value, dtype)) for name, value in arrays.items()}


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_images_equal_the_reference(mode):
    images, alphas, meta = drgs.rasterization(
        **scene(), **FILM, sh_degree=3, render_mode="RGB+D", rasterize_mode=mode
    )
    assert isinstance(images, np.ndarray) and images.dtype == np.float64
    assert images.shape == (2, CASE.height, CASE.width, 4) and alphas.shape[-1] == 1
    gaussians, antialiased = clear(CASE).gaussians, mode == "antialiased"
    for index, camera in enumerate(cameras()):
        background = scene()["backgrounds"][index]
        expected = reference.render(gaussians, camera, background, 3, antialiased)
        # Both are float64; scales and opacities went through logarithms in one of them.
        found = images[index, ..., :3], images[index, ..., 3], alphas[index, ..., 0]
        for a, b in zip(found, (expected.image, expected.depth, expected.alpha), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)

        splats = reference.project(gaussians, camera, antialiased)
        seen = splats.visible
        expected = {
            "means2d": splats.means2d,
            "depths": splats.depths,
            "conics": splats.conics[:, [0, 0, 1], [0, 1, 1]],
            "opacities": splats.opacities,
        }
        for name, values in expected.items():
            found = meta[name][index][seen]
            np.testing.assert_allclose(found, values[seen], rtol=1e-9, atol=1e-12, err_msg=name)
        sigmas = np.sqrt(2 * np.log(255 * splats.opacities[seen]))
        spread = np.sqrt(splats.cov2d[seen][:, [0, 1], [0, 1]])
        np.testing.assert_array_equal(meta["radii"][index][seen], np.ceil(sigmas[:, None] * spread))
        assert not meta["radii"][index][~seen].any()
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (CASE.width, CASE.height, 2)


def test_colors_of_any_number_of_channels_are_composited():
    """They equal spherical harmonics of degree 0 with these colours."""
    arrays = scene()
    flat = arrays["colors"][:, 0] * 0.28209479177387814 + 0.5
    flat = np.maximum(flat, 0)
    expected, expected_alphas, _ = drgs.rasterization(**arrays, **FILM, sh_degree=0)
    many = np.concatenate([flat, flat[:, ::-1]], axis=1)
    backgrounds = np.concatenate([arrays["backgrounds"], arrays["backgrounds"][:, ::-1]], axis=1)
    arrays = {**arrays, "colors": many, "backgrounds": backgrounds}
    images, alphas, _ = drgs.rasterization(**arrays, **FILM)
    np.testing.assert_allclose(images[..., :3], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(images[..., :2:-1], expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(alphas, expected_alphas)

    for_each = np.stack([many, 2 * many])
    twice, _, _ = drgs.rasterization(**{**arrays, "colors": for_each}, **FILM)
    np.testing.assert_array_equal(twice[0], images[0])
    missing = (1 - alphas[1]) * backgrounds[1]
    np.testing.assert_allclose(twice[1] - missing, 2 * (images[1] - missing), atol=1e-12)


def many_channels(kind, channels):
    """One camera, and random colours."""
    arrays = {k: v[:1] if k in ("viewmats", "Ks") else v for k, v in scene().items()}
    del arrays["backgrounds"]
    arrays["colors"] = np.random.default_rng(4).uniform(size=(CASE.count, channels))
    return {name: value.astype(kind) for name, value in arrays.items()}


@pytest.mark.parametrize("size", FEATURES_AT_ONCE)
def test_grouped_channels_equal_channels_rendered_alone(size):
    """Two whole groups, and a part of one."""
    kind, most = {4: np.float32, 8: np.float64}[size], FEATURES_AT_ONCE[size]
    given = many_channels(kind, 2 * most + 3 if size == 8 else most + 3)
    many, alphas, _ = drgs.rasterization(**given, **FILM)
    for start in range(0, many.shape[-1], most):
        few = {**given, "colors": given["colors"][:, start : start + most]}
        expected, expected_alphas, _ = drgs.rasterization(**few, **FILM)
        np.testing.assert_array_equal(many[..., start : start + most], expected)
        np.testing.assert_array_equal(alphas, expected_alphas)


def test_groups_share_their_kernels():
    """The largest, which composites, is that of a whole group, however many there are."""
    found = []
    for groups in (2, 3):
        given = many_channels(np.float64, groups * FEATURES_AT_ONCE[8])
        kernels = kernels_of(partial(drgs.rasterization, **given, **FILM))
        found.append(max(kernels, key=lambda kernel: kernel[1]))
    assert found[0] == found[1]


def test_depths_are_sums_or_expectations_in_the_last_channel():
    arrays = {**scene(), "colors": scene()["colors"][:, 0]}
    for name in ("means", "quats", "scales", "opacities", "colors"):
        arrays[name] = arrays[name][8:11]  # few, so that there are pixels without any
    modes = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
    results = [drgs.rasterization(**arrays, **FILM, render_mode=mode) for mode in modes]
    color, depth, expected_depth, both, both_expected = (image for image, *_ in results)
    alphas = results[1][1]
    np.testing.assert_array_equal(both, np.concatenate([color, depth], axis=-1))
    np.testing.assert_array_equal(both_expected, np.concatenate([color, expected_depth], axis=-1))
    np.testing.assert_allclose(expected_depth, depth / np.maximum(alphas, 1e-10), rtol=1e-12)
    assert (alphas == 0).any() and (alphas > 0).any()


def test_approximations_are_options():
    arrays = {name: value for name, value in scene().items() if name != "backgrounds"}

    def rendered(**options):
        return drgs.rasterization(**arrays, **FILM, sh_degree=3, **options)[0]

    plain = rendered()
    for options in ({"projection": "exact"}, {"order": "pixel"}, {"sh_direction": "pixel"}):
        assert np.isfinite(rendered(**options)).all()
        assert not np.array_equal(rendered(**options), plain), options
    assert np.abs(rendered(eps2d=1.0) - plain).max() > 1e-3


SETTINGS = {
    "coefficients": {"sh_degree": 3, "rasterize_mode": "antialiased", "render_mode": "RGB+ED"},
    "colors": {"render_mode": "RGB+D"},
    "colors of each camera": {},
    "depths": {"render_mode": "D"},
}


def arguments(name):
    arrays = dict(scene())
    if name in ("colors", "depths"):
        arrays["colors"] = arrays["colors"][:, 0]
    elif name == "colors of each camera":
        arrays["colors"] = np.moveaxis(arrays["colors"][:, :2], 1, 0)
    if name == "depths":
        del arrays["backgrounds"]
    return arrays


def results(arrays, name):
    images, alphas, _ = drgs.rasterization(**arrays, **FILM, **SETTINGS[name])
    return images, alphas


STEP = 1e-7
"""Changes an alpha by 1e-5 at most: no pixel of a clear scene is so near to a threshold. Rounding,
1e-16 / 1e-7, and the third derivative, 1e-14 of the first, matter less than 1e-7."""


def tangents_of(arrays, tangents, name):
    """Tangents of images and alphas, numpy."""
    inputs, directions = tensors(arrays), tensors(tangents)
    dr.enable_grad(inputs)
    dr.set_grad(inputs, directions)
    found = results(inputs, name)
    dr.forward_to(found)
    return [dr.grad(output).numpy() for output in found]


def gradients_of(arrays, weights, name):
    """Gradients of the sum of weighted images and alphas, numpy, by input."""
    inputs = tensors(arrays)
    dr.enable_grad(inputs)
    found = results(inputs, name)
    dr.set_grad(found, tuple(map(llvm.TensorXf64, weights)))
    dr.enqueue(dr.ADMode.Backward, found)
    dr.traverse(dr.ADMode.Backward)
    return {key: dr.grad(value).numpy() for key, value in inputs.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS)
def test_tangents_equal_differences_and_gradients_match_tangents(name):
    """Forward against differences, and <J v, w> = <v, J^T w>, input by input: each has gradients of
    its own. One test, as they share kernels."""
    arrays, rng = arguments(name), np.random.default_rng(3)
    tangents = {name: rng.normal(0, 1, value.shape) for name, value in arrays.items()}
    ahead, behind = (
        results({k: v + step * tangents[k] for k, v in arrays.items()}, name)
        for step in (STEP, -STEP)
    )
    found = tangents_of(arrays, tangents, name)
    for analytic, a, b in zip(found, ahead, behind, strict=True):
        numeric = (a - b) / (2 * STEP)
        assert np.abs(numeric).max() > 0.1
        np.testing.assert_allclose(analytic, numeric, rtol=0, atol=1e-6 * np.abs(numeric).max())

    weights = [rng.normal(0, 1, output.shape) for output in found]
    gradients = gradients_of(arrays, weights, name)
    still = {key: np.zeros_like(value) for key, value in arrays.items()}
    for key, tangent in tangents.items():
        found = tangents_of(arrays, {**still, key: tangent}, name)
        forward = sum(np.sum(a * b) for a, b in zip(found, weights, strict=True))
        terms = tangent * gradients[key]
        assert (key, name) == ("colors", "depths") or np.abs(terms).sum() > 0, key
        # A few hundred roundings of 1e-16 on either way, of terms of both signs.
        assert abs(forward - terms.sum()) <= 1e-11 * max(np.abs(terms).sum(), 1e-10), key


def test_gradients_are_the_same_in_every_run_and_use_no_atomics():
    def gradients():
        inputs = tensors(scene(), llvm.TensorXf)
        dr.enable_grad(inputs)
        images, alphas, _ = drgs.rasterization(**inputs, **FILM, sh_degree=3)
        weights = llvm.TensorXf(np.random.default_rng(6).normal(0, 1, images.shape))
        dr.set_grad(images, weights)
        dr.enqueue(dr.ADMode.Backward, images, alphas)
        dr.traverse(dr.ADMode.Backward)
        return {name: dr.grad(value).numpy() for name, value in inputs.items()}

    found, count = float_reductions(gradients)
    assert found == [] and count > 5
    first, second = gradients(), gradients()
    assert bitwise(list(first.values())) == bitwise(list(second.values()))


def test_extreme_values_have_finite_gradients():
    """Opacities of 0 and 1 and scales of 0, which no logarithm has."""
    arrays = {name: value.copy() for name, value in scene().items()}
    arrays["opacities"][:12:2], arrays["opacities"][1:12:2] = 0, 1
    arrays["scales"][12:16] = 0
    inputs = tensors(arrays, llvm.TensorXf)
    dr.enable_grad(inputs)
    images, _, _ = drgs.rasterization(**inputs, **FILM, sh_degree=3)
    dr.backward(dr.sum(images.array))
    assert np.isfinite(images.numpy()).all()
    for name, value in inputs.items():
        assert np.isfinite(dr.grad(value).numpy()).all(), name
    assert dr.grad(inputs["opacities"]).numpy()[1:12:2].any()


def test_torch_computes_gradients():
    """The example of the docstring, against Dr.Jit's own gradients."""
    torch = pytest.importorskip("torch")

    @dr.wrap(source="torch", target="drjit")
    def rasterize(*arrays):
        images, alphas, _ = drgs.rasterization(*arrays, **FILM, sh_degree=3)
        return images, alphas

    names = list(scene())[:-1]  # without backgrounds
    arrays = [np.asarray(scene()[name], np.float32) for name in names]
    leaves = [torch.tensor(array, requires_grad=True) for array in arrays]
    images, alphas = rasterize(*leaves)
    weights = np.random.default_rng(9).normal(0, 1, images.shape).astype(np.float32)
    ((images * torch.tensor(weights)).sum() + alphas.square().sum()).backward()

    inputs = [llvm.TensorXf(array) for array in arrays]
    dr.enable_grad(inputs)
    own, own_alphas, _ = drgs.rasterization(*inputs, **FILM, sh_degree=3)
    loss = dr.sum(own.array * llvm.Float(weights.ravel())) + dr.sum(dr.square(own_alphas.array))
    dr.backward(loss)
    np.testing.assert_array_equal(images.detach().numpy(), own.numpy())
    for name, leaf, value in zip(names, leaves, inputs, strict=True):
        expected = dr.grad(value).numpy()
        # The two sum alphas' squares in orders of their own; the rest is the same computation.
        limit = 1e-5 * np.abs(expected).max()
        np.testing.assert_allclose(leaf.grad.numpy(), expected, rtol=0, atol=limit, err_msg=name)


SKEWED = np.tile(np.array([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]), (2, 1, 1))
SKEWED[1, 0, 1] = 0.5


FLAT = {"sh_degree": None, "colors": np.zeros((24, 3))}
REFUSED = [
    ({"means": np.zeros((24, 2))}, r"means must be of shape \(N, 3\), got \(24"),
    ({"means": np.zeros((0, 3))}, "means must be of one row at least"),
    ({"opacities": np.zeros((24, 1))}, r"opacities must be of shape \(24,\)"),
    ({"Ks": np.eye(3)}, r"Ks must be of shape \(2, 3, 3\), got \(3, 3\)"),
    ({"Ks": SKEWED}, r"Ks\[1\] must be \(\(fx, 0, cx\), .*, without skew, got"),
    ({"viewmats": np.zeros((2, 4, 4))}, r"viewmats\[0\] must be matrices of a rot"),
    ({"backgrounds": np.zeros(3)}, r"backgrounds must be of shape \(2, 3\)"),
    ({"sh_degree": None}, r"colors must be of shape \(24, D\) or \(2, 24, D\)"),
    ({"sh_degree": 4}, "sh_degree must be None or 0 to 3, got 4"),
    ({"render_mode": "depth"}, "render_mode must be one of .*, got 'depth'"),
    ({"width": 0}, "width must be a whole number, 1 px or more, got 0"),
    ({"height": 24.0}, "height must be a whole number, 1 px or more, got 24.0"),
    ({"width": None}, "width must be a whole number, 1 px or more, got None"),
    ({"near_plane": np.nan}, "near_plane must be a distance, 0 or more, got nan"),
    ({"near_plane": "x"}, "near_plane must be a distance, 0 or more, got 'x'"),
    ({"Ks": np.full((2, 3, 3), np.nan)}, r"Ks\[0\] must be .* of finite numbers"),
    ({"scales": np.full((24, 3), -0.1)}, "scales must be numbers from 0 to 1e"),
    ({"opacities": np.full(24, 2.0)}, "opacities must be numbers from 0 to 1, "),
    ({"opacities": np.full(24, np.nan)}, "opacities must be numbers from 0 to 1, "),
    ({"width": 10**6, "height": 10**6}, r"width and height must be smaller: .* too many"),
    (
        {**FLAT, "colors": np.ones((24, 2000)), "backgrounds": None},
        "colors must be of at most 64 channels, got 2000",
    ),
    ({"eps2d": -1.0}, "eps2d must be finite and not negative, got -1.0"),
    ({"projection": "affine"}, "projection must be one of ewa, exact, unscented"),
    ({"packed": False}, "packed is a parameter of gsplat's .*; leave it out"),
    ({"with_ut": True}, 'with_ut is .*; give projection="unscented"'),
    ({"projektion": "ewa"}, "no parameter projektion; did you mean projection"),
    ({**FLAT, "sh_direction": "pixel"}, "sh_direction is of spherical harmonics; give sh_degree"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_mismatched_arguments_are_refused_by_name(changes, message):
    names = {"packed", "with_ut", "projektion"} & set(changes)
    error = TypeError if names else ValueError
    with pytest.raises(error, match=rf"rasterization\(\): .*{message}"):
        drgs.rasterization(**{**scene(), **FILM, "sh_degree": 3, **changes})


ARRAYS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize(
    "value", [None, "abc", np.array([{}]), np.ones(2) * 1j, [[1.0], [1.0, 2.0]]]
)
def test_what_is_no_array_of_numbers_is_refused_by_name(name, value):
    with pytest.raises(TypeError, match=rf"rasterization\(\): {name} must be an array of real"):
        drgs.rasterization(**{**scene(), **FILM, "sh_degree": 3, name: value})
