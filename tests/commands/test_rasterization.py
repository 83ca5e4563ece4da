"""``drgs.rasterization`` against the float64 reference and central differences."""

from dataclasses import dataclass, replace
from functools import cache, partial
from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import lenses
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


SIX, FOUR, TWO = (np.array([0.03, -0.02, 0.01, 0.05, 0.02, -0.01])[:n] for n in (6, 4, 2))
RADIAL, TANGENTIAL = {"radial_coeffs": SIX}, {"tangential_coeffs": TWO}
FISHEYE, ORTHO = {"camera_model": "fisheye"}, {"camera_model": "ortho"}
GSPLAT_DEFAULTS = {
    **{"packed": True, "tile_size": 16, "sparse_grad": False, "absgrad": False, "far_plane": 1e10},
    **{"channel_chunk": 32, "segmented": False, "radius_clip": 0.0, "distributed": False},
    **{"covars": None, "with_ut": False, "with_eval3d": False, "thin_prism_coeffs": None},
}
# Number of cameras, axes of the colours before and behind that of the Gaussians, channels, options.
CALLS = {
    "colours": (1, "", (3,), 3, GSPLAT_DEFAULTS),
    "depths": (2, "", (3,), 1, {"render_mode": "D"}),
    "expected depths": (2, "", (3,), 1, {"render_mode": "ED"}),
    "five channels of each camera": (2, "C", (5,), 6, {"render_mode": "RGB+D"}),
    "coefficients": (3, "", (4, 3), 4, {"sh_degree": 1, "render_mode": "RGB+ED"}),
    "constants of each camera": (2, "C", (1, 3), 3, {"sh_degree": 0}),
    "antialiased": (2, "C", (16, 3), 3, {"sh_degree": 2, "rasterize_mode": "antialiased"}),
    "opencv": (2, "", (3,), 3, RADIAL | TANGENTIAL),
    "fisheye": (2, "", (2,), 3, {**FISHEYE, "radial_coeffs": FOUR, "render_mode": "RGB+D"}),
    "ortho": (2, "", (2,), 2, {**ORTHO, "rolling_shutter": "ROLLING_LEFT_TO_RIGHT"}),
    "exact": (2, "", (3,), 3, {"projection": "exact", "rolling_shutter": "ROLLING_BOTTOM_TO_TOP"}),
}  # fmt: skip


def call_of(name, batch):
    """Arrays by name, those with a camera axis, and options."""
    count, by_camera, tail, _, options = CALLS[name]
    rng, num, lead = np.random.default_rng(7), 6, (*batch, count)
    arrays = {
        "means": rng.normal([0, 0, 3], 0.4, (*batch, num, 3)),
        "quats": rng.normal(size=(*batch, num, 4)),
        "scales": rng.uniform(0.1, 0.4, (*batch, num, 3)),
        "opacities": rng.uniform(0.2, 0.9, (*batch, num)),
        "colors": rng.uniform(size=(*batch, *(lead[-1:] if by_camera else ()), num, *tail)),
        "viewmats": np.tile(np.eye(4), (*lead, 1, 1)),
        "Ks": np.tile([[7.0, 0, 3], [0, 8, 2], [0, 0, 1]], (*lead, 1, 1)),
        "backgrounds": rng.uniform(size=(*lead, tail[-1])),
    }
    arrays["viewmats"][..., :3, 3] = rng.normal(0, 0.1, (*lead, 3))
    if "rolling_shutter" in options:
        arrays["viewmats_rs"] = arrays["viewmats"].copy()
        arrays["viewmats_rs"][..., :3, 3] += 0.05
    for key in [key for key in options if key in ("radial_coeffs", "tangential_coeffs")]:
        arrays[key] = options[key] * rng.uniform(0.5, 1, (*lead, 1))
    of_cameras = {"viewmats", "viewmats_rs", "Ks", "backgrounds", "radial_coeffs"}
    of_cameras |= {"tangential_coeffs"} | ({"colors"} if by_camera else set())
    options = {k: v for k, v in options.items() if k not in arrays}
    return {k: v.astype(np.float32) for k, v in arrays.items()}, of_cameras, options


@pytest.mark.parametrize("batch", [(), (2,), (1, 2)])
@pytest.mark.parametrize("name", CALLS)
def test_results_have_gsplats_shapes_and_equal_calls_for_each_image(name, batch):
    arrays, of_cameras, options = call_of(name, batch)
    options = {"width": 7, "height": 5, **options}
    images, alphas, meta = drgs.rasterization(**arrays, **options)
    count, _, _, channels, _ = CALLS[name]
    lead, num = (*batch, count), arrays["means"].shape[-2]
    tails = {"means2d": (2,), "conics": (3,), "radii": (2,), "depths": (), "opacities": ()}
    assert images.shape == (*lead, 5, 7, channels) and alphas.shape == (*lead, 5, 7, 1)
    assert {k: meta[k].shape for k in tails} == {k: (*lead, num, *v) for k, v in tails.items()}
    numbers = {"width": 7, "height": 5, "n_cameras": count, "n_batches": int(np.prod(batch))}
    assert numbers.items() <= meta.items() and alphas.any()
    for *entry, camera in np.ndindex(*lead):
        one = {k: v[tuple(entry)] for k, v in arrays.items()}
        one = {k: v[camera : camera + 1] if k in of_cameras else v for k, v in one.items()}
        image, alpha, values = drgs.rasterization(**one, **options)
        place = (*entry, camera)
        np.testing.assert_array_equal(images[place], image[0])
        np.testing.assert_array_equal(alphas[place], alpha[0])
        for key in tails:
            np.testing.assert_array_equal(meta[key][place], values[key][0], key)


class ForwardFisheye(lenses.Fisheye):
    """gsplat's: depths are z."""

    depths = lenses.Lens.depths

    def is_seen(self, camera, points):
        return super().is_seen(camera, points) & (points[:, 2] >= camera.near)


TURN, TRAVEL = np.array([0.012, -0.008, 0.02]), np.array([0.016, -0.024, 0.012])


def moved(rotation, center, time):
    """Poses (N, 3, 3) and (N, 3) at times (N,) from 0 to 1."""
    turn = Rotation.from_rotvec(time[:, None] * TURN).as_matrix()
    return turn @ rotation, center + time[:, None] * TRAVEL


@dataclass(frozen=True)
class Rolling(lenses.Lens):
    """Rows or columns read one after the other; times by iteration, a step takes a tenth."""

    lens: lenses.Lens
    axis: int
    step: int

    def own_points(self, camera, points):
        world, time = points @ camera.rotation + camera.center, np.full(len(points), 0.5)
        for _ in range(20):
            rotation, center = moved(camera.rotation, camera.center, time)
            own = np.einsum("nij,nj->ni", rotation, world - center)
            place = self.lens.film_points(camera, own)[:, self.axis]
            time = (place - 0.5) / (camera.size[self.axis] - 1)
            time = time if self.step == 1 else 1 - time
        return own

    def film_points(self, camera, points):
        return self.lens.film_points(camera, self.own_points(camera, points))

    def depths(self, camera, points):
        return self.own_points(camera, points)[:, 2]


OPENCV = lenses.OpenCV(*SIX, *TWO)
CAMERAS = {
    "opencv": (RADIAL | TANGENTIAL, OPENCV),
    "four coefficients": ({"radial_coeffs": FOUR}, lenses.OpenCV(*FOUR)),
    "tangential": (TANGENTIAL, lenses.OpenCV(p1=TWO[0], p2=TWO[1])),
    "ortho": (ORTHO, lenses.Orthographic()),
    "fisheye": (FISHEYE, ForwardFisheye()),
    "fisheye with coefficients": ({**FISHEYE, "radial_coeffs": FOUR}, ForwardFisheye(*FOUR)),
    "ROLLING_TOP_TO_BOTTOM": ({}, Rolling(lenses.Pinhole(), 1, 1)),
    "ROLLING_BOTTOM_TO_TOP": (FISHEYE, Rolling(ForwardFisheye(), 1, -1)),
    "ROLLING_LEFT_TO_RIGHT": (ORTHO, Rolling(lenses.Orthographic(), 0, 1)),
    "ROLLING_RIGHT_TO_LEFT": (RADIAL | TANGENTIAL, Rolling(OPENCV, 0, -1)),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_cameras_project_as_their_equations(name):
    """The low-pass filter is negligible, as a rolling shutter shears it with the splats."""
    options, lens = CAMERAS[name]
    rotation = Rotation.from_matrix(clear(CASE).camera.rotation).as_matrix()  # not of 32 bits
    camera = replace(clear(CASE).camera, rotation=rotation)
    if options is ORTHO:
        camera = replace(camera, fx=0.4 * camera.fx, fy=0.4 * camera.fy)
    # Without those that are behind the camera or far beside the film.
    gaussians = reference.Gaussians(**{k: v[8:] for k, v in vars(clear(CASE).gaussians).items()})
    options = {k: v[None] if isinstance(v, np.ndarray) else v for k, v in options.items()}
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    for viewmat, time in zip(viewmats, (0.0, 1.0), strict=True):
        (viewmat[:3, :3],), (center,) = moved(rotation, camera.center, np.array([time]))
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
    if name.startswith("ROLLING"):
        options |= {"rolling_shutter": name, "viewmats_rs": viewmats[1:]}
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    colors = np.random.default_rng(5).uniform(size=(len(gaussians.means), 3))
    images, alphas, meta = drgs.rasterization(
        gaussians.means, gaussians.quats, np.exp(gaussians.log_scales),
        reference.sigmoid(gaussians.logit_opacities), colors, viewmats[:1], K[None], **FILM,
        eps2d=1e-8, render_mode="RGB+D", **options,
    )  # fmt: skip
    splats = lenses.project(gaussians, camera, lens, low_pass=1e-8)
    expected = reference.composite(splats, colors, np.zeros(3), CASE.width, CASE.height)
    assert splats.visible.sum() > 10 and expected.alpha.mean() > 0.2
    assert not expected.near_threshold.any()
    found = images[0, ..., :3], images[0, ..., 3], alphas[0, ..., 0]
    for a, b in zip(found, (expected.image, expected.depth, expected.alpha), strict=True):
        # Differences of order 8, and a rolling shutter's three steps of Newton's method.
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-8)
    means2d, conics = meta["means2d"][0], meta["conics"][0]
    np.testing.assert_allclose(means2d[splats.visible], splats.means2d[splats.visible], rtol=1e-8)
    conics = conics[splats.visible] / splats.conics[splats.visible][:, [0, 0, 1], [0, 1, 1]]
    np.testing.assert_allclose(conics, 1, rtol=0, atol=1e-5)  # cancels in the reference


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
    "opencv": {"rolling_shutter": "ROLLING_RIGHT_TO_LEFT", "render_mode": "RGB+D"},
    "fisheye": {"camera_model": "fisheye", "rolling_shutter": "ROLLING_TOP_TO_BOTTOM"},
    "ortho": {"camera_model": "ortho", "projection": "unscented"},
    "batch of constants": {"sh_degree": 0},
}


def arguments(name):
    arrays = dict(scene())
    if name in ("opencv", "fisheye"):
        arrays["radial_coeffs"] = np.tile(SIX if name == "opencv" else FOUR, (2, 1))
        turns, centers = moved(arrays["viewmats"][:, :3, :3], np.zeros(3), np.ones(2))
        arrays["viewmats_rs"] = arrays["viewmats"].copy()
        arrays["viewmats_rs"][:, :3, :3] = turns
        arrays["viewmats_rs"][:, :3, 3] += centers
    if name == "opencv":
        arrays["tangential_coeffs"] = np.tile(TWO, (2, 1))
    if name == "ortho":
        arrays["Ks"] = arrays["Ks"] * [0.4, 0.4, 1]
    if name == "batch of constants":
        arrays["colors"] = arrays["colors"][:, :1]
        arrays = {k: np.stack([v, 0.5 * v if k == "colors" else v]) for k, v in arrays.items()}
    elif name in ("colors", "depths", "opencv", "fisheye", "ortho"):
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


@pytest.mark.parametrize("name", ["coefficients", "opencv"])
def test_torch_computes_gradients(name):
    """They equal those of Dr.Jit, also for parameters of a module and in a batch."""
    torch = pytest.importorskip("torch")
    arrays = {k: np.asarray(v, np.float32) for k, v in arguments(name).items()}
    leaves = {k: torch.nn.Parameter(torch.tensor(v[None])) for k, v in arrays.items()}
    images, alphas, meta = drgs.rasterization(**leaves, **FILM, **SETTINGS[name])
    weights = np.random.default_rng(9).normal(0, 1, images.shape).astype(np.float32)
    ((images * torch.tensor(weights)).sum() + alphas.square().sum()).backward()

    inputs = tensors(arrays, llvm.TensorXf)
    dr.enable_grad(inputs)
    own, own_alphas, values = drgs.rasterization(**inputs, **FILM, **SETTINGS[name])
    loss = dr.sum(own.array * llvm.Float(weights.ravel())) + dr.sum(dr.square(own_alphas.array))
    dr.backward(loss)
    np.testing.assert_array_equal(images.detach().numpy()[0], own.numpy())
    assert meta["radii"].dtype == torch.int32
    np.testing.assert_array_equal(meta["radii"].numpy()[0], values["radii"].numpy())
    for key, value in inputs.items():
        expected = dr.grad(value).numpy()
        # The two sum alphas' squares in orders of their own; the rest is the same computation.
        limit = 1e-5 * np.abs(expected).max()
        found = leaves[key].grad.numpy()[0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=limit, err_msg=key)


def test_torch_tensors_of_other_types():
    """Numbers of 8 bits are converted; Gaussians have 32 or 64 bits, in PyTorch if others do."""
    torch = pytest.importorskip("torch")
    arrays, _, options = call_of("colours", ())
    arrays["colors"] = np.full_like(arrays["colors"], 2)
    arrays = {k: torch.tensor(v) for k, v in arrays.items()}
    options |= {"width": 7, "height": 5}
    images, _, _ = drgs.rasterization(**arrays, **options)
    converted = {**arrays, "colors": arrays["colors"].to(torch.uint8), "Ks": arrays["Ks"].numpy()}
    found, _, _ = drgs.rasterization(**converted, **options)
    assert torch.equal(found, images) and not found.requires_grad
    for means in (arrays["means"].half(), arrays["means"].numpy()):
        with pytest.raises(TypeError, match=r"means must be a tensor of PyTorch, .* 32 or 64 bits"):
            drgs.rasterization(**{**arrays, "means": means}, **options)


SKEWED = np.tile(np.array([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]), (2, 1, 1))
SKEWED[1, 0, 1] = 0.5


UPWARDS = SimpleNamespace(name="ROLLING_BOTTOM_TO_TOP")  # a member of gsplat's enumeration

FLAT = {"sh_degree": None, "colors": np.zeros((24, 3))}
REFUSED = [
    ({"means": np.zeros((24, 2))}, r"means must be of shape \(N, 3\), got \(24"),
    ({"means": np.zeros((0, 3))}, "means must be of one row at least"),
    ({"opacities": np.zeros((24, 1))}, r"opacities must be of shape \(24,\)"),
    ({"Ks": np.eye(3)}, r"Ks must be of shape \(2, 3, 3\), got \(3, 3\)"),
    ({"Ks": SKEWED}, r"Ks\[1\] must be \(\(fx, 0, cx\), .*, without skew, got"),
    ({"Ks": np.diag([0.0, 9, 1])[None].repeat(2, 0)}, r"Ks\[0\] must be .* not 0, without skew"),
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
    ({"camera_model": "ftheta"}, "camera_model must be one of .*, got 'ftheta'"),
    ({"rolling_shutter": "UP"}, "rolling_shutter must be one of .*, got 'UP'"),
    ({"rolling_shutter": UPWARDS}, "viewmats_rs must be given if .* ROLLING_BOTTOM_TO_TOP, got N"),
    ({"viewmats_rs": np.zeros((2, 4, 4))}, "viewmats_rs must be None if rolling_shutter is GLOBAL"),
    (
        {"rolling_shutter": UPWARDS, "viewmats_rs": np.zeros((2, 4, 4))},
        r"viewmats_rs\[0\] must be rotated by less than half a turn from viewmats\[0\], without",
    ),
    ({"radial_coeffs": np.zeros((2, 5))}, r"radial_coeffs must be of shape \(2, 4\) or \(2, 6\)"),
    ({**FISHEYE, "radial_coeffs": np.zeros((2, 6))}, "radial_coeffs must be k1 to k4 if camera_m"),
    ({**ORTHO, "tangential_coeffs": np.zeros((2, 2))}, "tangential_coeffs must be None if camera"),
    ({"radial_coeffs": np.full((2, 4), np.nan)}, "radial_coeffs must be numbers of at most"),
    ({"means": np.zeros((1, 24, 3))}, r"viewmats must be of shape \(1, C, 4, 4\), got \(2"),
    ({"means": llvm.TensorXf16(np.zeros((24, 3)))}, "means must be .* of 32 or 64 bits, got Tens"),
    ({"radius_clip": 2.0}, "radius_clip is a parameter of gsplat's .*; leave it out"),
    ({"with_ut": True}, 'with_ut is .*; give projection="unscented"'),
    ({"projektion": "ewa"}, "no parameter projektion; did you mean projection"),
    ({"camera_modell": "ortho"}, "no parameter camera_modell; did you mean camera_model"),
    ({**FLAT, "sh_direction": "pixel"}, "sh_direction is of spherical harmonics; give sh_degree"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_mismatched_arguments_are_refused_by_name(changes, message):
    names = {"radius_clip", "with_ut", "projektion", "camera_modell"} & set(changes)
    error = TypeError if names or "32 or 64" in message else ValueError
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
