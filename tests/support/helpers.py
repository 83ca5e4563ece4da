"""Random scenes, and the same scene for the kernels and for the float64 reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
import pytest
from hypothesis import Phase, settings

from drgs.bench import scenes
from drgs.cameras.camera import Camera
from drgs.core.arrays import from_host
from drgs.effects.compose import with_effects
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import splatting as reference
from drgs.splatting import rendering, tiles
from drgs.splatting.footprint import DEFAULT
from drgs.splatting.projection import compensated_opacity, plain_opacity

NEAR_THRESHOLD = 1e-4
"""Relative distance from a threshold at which float32 may decide otherwise. A mean at p px carries
about 3 roundings of 6e-8 p; ln(alpha) changes by at most |U d| / sqrt(0.3) <= sqrt(2 ln 255 / 0.3)
= 6.1 per px: 5e-5 at p = 50 px."""


# ----------------------------------------------------------------------------------------------
# Array types
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Precision:
    """Dr.Jit types of one floating point format, used directly: no Mitsuba variant."""

    Float: type
    Array2f: type
    Array3f: type
    Array4f: type
    TensorXf: type
    dtype: type

    def array(self, values) -> object:
        """Flat array of numpy ``values``."""
        return from_host(self.Float, values)

    def vectors(self, values) -> object:
        """Array2f, Array3f or Array4f of the rows of ``values`` (N, D)."""
        values = np.asarray(values)
        vector_type = {2: self.Array2f, 3: self.Array3f, 4: self.Array4f}[values.shape[1]]
        return vector_type([self.array(column) for column in values.T])


FLOAT32 = Precision(llvm.Float, llvm.Array2f, llvm.Array3f, llvm.Array4f, llvm.TensorXf, np.float32)
FLOAT64 = Precision(
    llvm.Float64, llvm.Array2f64, llvm.Array3f64, llvm.Array4f64, llvm.TensorXf64, np.float64
)

both_precisions = pytest.mark.parametrize(
    "precision", [FLOAT64, FLOAT32], ids=["float64", "float32"]
)


examples = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=25,
    phases=[Phase.generate, Phase.shrink],
)
"""Settings of Hypothesis: the same examples in every run."""


def rows(vectors) -> np.ndarray:
    """(N, D) float64 numpy from a Dr.Jit vector, or (N,) from a flat array."""
    values = np.array(vectors)
    return (values.T if values.ndim == 2 else values).astype(np.float64)


def single(values) -> np.ndarray:
    """``values`` rounded to float32, as float64: both precisions then start from equal numbers."""
    return np.asarray(values, dtype=np.float32).astype(np.float64)


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


def _random_camera(rng, width, height) -> reference.Camera:
    """Rotated, away from the origin, fx != fy, the principal point off the film's centre."""
    rotation = reference.quat_to_rotation(rng.normal(0, 1, (1, 4)))[0]
    extent = max(width, height)
    fx, fy = extent * rng.uniform(0.7, 1.4, 2)
    return reference.Camera(
        rotation=single(rotation),
        center=single(rng.normal(0, 1, 3)),
        fx=float(single(fx)),
        fy=float(single(fy)),
        cx=float(single(width * rng.uniform(0.25, 0.75))),
        cy=float(single(height * rng.uniform(0.25, 0.75))),
        width=width,
        height=height,
        near=0.25,
    )


def gaussians_before(
    rng, camera, points, scales, logits, degree, quats=None, sh_size=0.3
) -> reference.Gaussians:
    """Gaussians at points (N, 3) in camera axes, of ``scales`` (N, 3) in scene units.

    quats: (N, 4); None: random ones, of norms from 0.2 to 5.
    """
    n = len(points)
    if quats is None:
        quats = rng.normal(0, 1, (n, 4)) * rng.uniform(0.2, 5.0, (n, 1))
    return reference.Gaussians(
        means=single(points @ camera.rotation + camera.center),
        quats=single(quats),
        log_scales=single(np.log(scales)),
        logit_opacities=single(logits),
        sh0=single(rng.normal(0, 1.0, (n, 1, 3))),
        shN=single(rng.normal(0, sh_size, (n, (degree + 1) ** 2 - 1, 3))),
    )


def points_on_film(camera, film, z) -> np.ndarray:
    """Points (N, 3) in camera axes that a pinhole shows at ``film`` (N, 2) px, at depths z (N,)."""
    slopes = (film - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.column_stack([slopes * z[:, None], z])


def gaussians_on_film(rng, camera, film, z, sizes, logits, degree) -> reference.Gaussians:
    """Gaussians at film positions (N, 2) px and depths z (N,), of ``sizes`` (N, 3) px."""
    scales = sizes * np.abs(z)[:, None] / camera.fx
    return gaussians_before(rng, camera, points_on_film(camera, film, z), scales, logits, degree)


def scattered(rng, camera, degree, count) -> reference.Gaussians:
    """Splats of a fraction of a pixel to a fifth of the film, on and around the film.

    The first eight: behind the camera; nearer than the near plane; too transparent; four large
    ones so far beyond each side of the film that the Jacobian's slope is clamped; and one whose
    parameters are those of a fresh Gaussian: a logit and colours of exactly zero, unrotated, round.
    """
    size = np.array([camera.width, camera.height])
    film = rng.uniform(-0.15, 1.15, (count, 2)) * size
    z = rng.uniform(1.0, 4.0, count)
    sizes = np.minimum(rng.lognormal(np.log(1.5), 0.9, (count, 3)), 0.2 * max(size) + 1)
    logits = rng.normal(0.5, 1.7, count)
    if count >= 8:
        z[:2] = [-1.0, 0.1]
        film[3:7] = size * np.array([[-0.6, 0.5], [1.6, 0.4], [0.3, -0.6], [0.6, 1.6]])
        film[7], sizes[3:7], sizes[7] = 0.4 * size, 0.3 * max(size), 2.0
        logits[2:8] = -6, 2, 2, 2, 2, 0
    gaussians = gaussians_on_film(rng, camera, film, z, sizes, logits, degree)
    if count >= 8:
        gaussians.quats[7], gaussians.sh0[7] = [1, 0, 0, 0], 0
    return gaussians


def stacked(rng, camera, degree, count) -> reference.Gaussians:
    """Large, mostly opaque splats behind each other: pixels stop, and alphas are clamped."""
    size = np.array([camera.width, camera.height])
    film, z = rng.uniform(0.2, 0.8, (count, 2)) * size, rng.uniform(1.0, 4.0, count)
    sizes, logits = rng.uniform(0.15, 0.5, (count, 3)), rng.uniform(0.0, 4.0, count)
    logits[::4] = 7.0
    return gaussians_on_film(rng, camera, film, z, sizes * max(size), logits, degree)


def scene_of(make, seed, width, height, degree, count):
    """The Gaussians that a function of the above makes, and a random camera before them."""
    rng = np.random.default_rng(seed)
    camera = _random_camera(rng, width, height)
    return make(rng, camera, degree, count), camera


random_scene, stacked_scene = partial(scene_of, scattered), partial(scene_of, stacked)


@dataclass(frozen=True)
class Case:
    """A scene to render, by its recipe; everything else follows from it."""

    name: str
    width: int
    height: int
    degree: int  # stored
    count: int = 60
    antialiased: bool = False
    sh_degree: int | None = None  # rendered; None for all that is stored
    recipe: object = random_scene
    seed: int = 0
    threshold_width: float = NEAR_THRESHOLD  # within which a pixel is marked

    @property
    def scene(self) -> tuple[reference.Gaussians, reference.Camera]:
        """Gaussians and camera, the same numbers in both precisions."""
        return _scene(self)

    @property
    def gaussians(self) -> reference.Gaussians:
        return self.scene[0]

    @property
    def camera(self) -> reference.Camera:
        return self.scene[1]

    @property
    def background(self) -> np.ndarray:
        return np.array([0.875, 0.375, 0.1875])

    @property
    def rendered_degree(self) -> int:
        return self.degree if self.sh_degree is None else self.sh_degree

    @property
    def rendered(self) -> reference.RenderedImage:
        """Render by the reference; marked pixels are those within ``threshold_width``."""
        return _image(self)

    @property
    def pipeline(self) -> rendering.Pipeline:
        """Colour and depth."""
        return rendering.Pipeline(
            self.rendered_degree,
            compensated_opacity if self.antialiased else plain_opacity,
            (rendering.color_features, rendering.depth_feature),
        )


@cache
def _scene(case):
    return case.recipe(case.seed, case.width, case.height, case.degree, case.count)


@cache
def _image(case):
    return reference.render(
        case.gaussians, case.camera, case.background, case.rendered_degree, case.antialiased,
        threshold_width=case.threshold_width,
    )  # fmt: skip


@cache
def clear(case):
    """The case with the first seed that leaves no pixel near a threshold: nothing may differ.

    case: a :class:`Case`, or another dataclass with a ``seed`` and a ``rendered``.
    """
    for seed in range(case.seed, case.seed + 200):
        candidate = replace(case, seed=seed)
        if not candidate.rendered.near_threshold.any():
            return candidate
    raise AssertionError(f"{case}: no clear seed among 200")


# ----------------------------------------------------------------------------------------------
# The kernels' side
# ----------------------------------------------------------------------------------------------


def render_composed(gaussians, camera, pipeline):
    """A frame with what the Gaussians and the camera call for."""
    return rendering.render(gaussians, camera, with_effects(pipeline, gaussians, camera))


def device_gaussians(gaussians: reference.Gaussians, precision: Precision) -> Gaussians:
    """The same Gaussians as Dr.Jit arrays, in its own memory: how numpy's is aligned is a part of
    kernels."""
    fields = {name: getattr(gaussians, name) for name in PARAMETER_NAMES}
    device = Gaussians(**fields).to(precision.TensorXf)
    return replace(device, logit_opacities=precision.array(gaussians.logit_opacities))


def host_gaussians(gaussians: reference.Gaussians) -> Gaussians:
    """In single precision, as files hold them."""
    return Gaussians(**{n: getattr(gaussians, n).astype(np.float32) for n in PARAMETER_NAMES})


def reference_gaussians(gaussians: Gaussians) -> reference.Gaussians:
    """The other way round."""
    return reference.Gaussians(**{n: np.array(getattr(gaussians, n)) for n in PARAMETER_NAMES})


def device_camera(camera: reference.Camera, precision: Precision) -> Camera:
    """The same camera as Dr.Jit scalars."""
    return scenes.device_camera(camera, precision.Float)


def render(case: Case, precision: Precision, pipeline=None) -> tuple[Gaussians, rendering.Frame]:
    """The case's Gaussians on the device, and their frame."""
    gaussians = device_gaussians(case.gaussians, precision)
    camera = device_camera(case.camera, precision)
    return gaussians, rendering.render(gaussians, camera, pipeline or case.pipeline)


def frame_adjoint(gaussians, frame, d_features, d_transmittance) -> rendering.GaussianGradients:
    """Differentiate a loss with these derivatives with respect to the frame's planes."""
    return rendering.frames_adjoint(gaussians, [frame], [[d_transmittance, *d_features]])


def frame_tangent(gaussians, frame, tangents) -> list:
    """Directional derivatives of the frame's planes."""
    return rendering.frames_tangent(gaussians, [frame], tangents)[0]


def as_images(planes, camera) -> dict[str, np.ndarray]:
    """Planes (transmittance, color, depth) as transmittance (H, W), color (H, W, 3), depth."""
    planes = [rows(plane).reshape(camera.height, camera.width) for plane in planes]
    return {"transmittance": planes[0], "color": np.stack(planes[1:4], axis=-1), "depth": planes[4]}


def image_planes(frame, case=None) -> dict[str, np.ndarray]:
    """Return a frame with colour and depth as the fields of ``reference.RenderedImage``.

    case: on its background; None: on black.
    """
    images = as_images(frame.planes(), frame.camera)
    transmittance = images["transmittance"]
    background = np.zeros(3) if case is None else case.background
    return {
        "image": images["color"] + transmittance[..., None] * background,
        "alpha": 1 - transmittance,
        "depth": images["depth"],
        "transmittance": transmittance,
    }


@dataclass(frozen=True)
class Cotangents:
    """Derivatives of a loss with respect to the image."""

    d_image: np.ndarray  # (H, W, 3)
    d_alpha: np.ndarray  # (H, W)
    d_depth: np.ndarray  # (H, W)

    @staticmethod
    def random(case: Case, seed: int = 1) -> Cotangents:
        """Normal weights; zero at the pixels that the reference marks."""
        rng = np.random.default_rng(seed)
        shape = case.height, case.width
        kept = ~case.rendered.near_threshold
        image, alpha, depth = (rng.normal(0, 1, s) for s in ((*shape, 3), shape, shape))
        return Cotangents(
            single(image) * kept[..., None], single(alpha) * kept, single(depth) * kept
        )


def reference_gradients(case: Case, cotangents: Cotangents) -> dict[str, np.ndarray]:
    """All gradients by the reference."""
    return reference.render_gradients(
        case.gaussians, case.camera, case.background, cotangents.d_image, cotangents.d_alpha,
        cotangents.d_depth, case.rendered_degree, case.antialiased,
    )  # fmt: skip


def plane_cotangents(case, cotangents, precision) -> tuple[list, object]:
    """(d_features, d_transmittance): image = color + T background, alpha = 1 - T."""
    planes = [*np.moveaxis(cotangents.d_image, -1, 0), cotangents.d_depth]
    d_transmittance = cotangents.d_image @ case.background - cotangents.d_alpha
    return [precision.array(plane) for plane in planes], precision.array(d_transmittance)


def kernel_gradients(case, precision, cotangents) -> dict[str, np.ndarray]:
    """All gradients by the kernels, under the names and in the shapes of the reference."""
    gaussians, frame = render(case, precision)
    gradients = frame_adjoint(gaussians, frame, *plane_cotangents(case, cotangents, precision))
    transmittance = as_images(frame.planes(), case.camera)["transmittance"]
    return {
        **{name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
        "background": np.einsum("hw,hwc->c", transmittance, cotangents.d_image),
        "means2d": rows(gradients.means2d),
    }


# ----------------------------------------------------------------------------------------------
# Comparison
# ----------------------------------------------------------------------------------------------


def central_difference(function, values, index, step) -> float:
    """Return the derivative of a function of an array with respect to one of its numbers."""
    change = np.zeros_like(values)
    change[index] = step
    return (function(values + change) - function(values - change)) / (2 * step)


def relative_errors(actual, expected) -> dict[str, float]:
    """For each array of two dictionaries: largest difference over largest expected value."""
    return {
        name: float(
            np.abs(actual[name] - values).max(initial=0)
            / max(np.abs(values).max(initial=0), np.finfo(np.float64).tiny)
        )
        for name, values in expected.items()
    }


def assert_arrays_agree(actual, expected, tolerance) -> None:
    """Compare dictionaries of arrays, relative to each array's maximum; list the worst elements.

    An array of zeros must be matched exactly. NaN never agrees.
    """
    lines = []
    for name, values in expected.items():
        values = np.asarray(values)
        assert actual[name].shape == values.shape, f"{name}: {actual[name].shape}, {values.shape}"
        allowed = tolerance * np.abs(values).max(initial=0)
        errors = np.abs(actual[name] - values)
        bad = np.argwhere(~(errors <= allowed))
        worst = sorted(map(tuple, bad), key=lambda index: -np.nan_to_num(errors[index], nan=1e300))
        lines += [
            f"{name}{[int(i) for i in index]}: kernels {actual[name][index]:.9g}, reference "
            f"{values[index]:.9g}, allowed {allowed:.2g} ({len(bad)} elements)"
            for index in worst[:3]
        ]
    assert not lines, "\n".join(lines)


def assert_images_agree(actual, rendered: reference.RenderedImage, tolerance) -> None:
    """Compare planes, leaving out only marked pixels that do differ, at most 1e-4 of all (or 1)."""
    differs = np.zeros(rendered.near_threshold.shape, dtype=bool)
    expected = {
        name: getattr(rendered, name) for name in ("image", "alpha", "depth", "transmittance")
    }
    for name, values in expected.items():
        errors = np.abs(actual[name] - values)
        bad = ~(errors <= tolerance * np.abs(values).max())
        differs |= bad.any(axis=-1) if bad.ndim == 3 else bad
    flipped = differs & rendered.near_threshold
    assert flipped.sum() <= max(1, 1e-4 * flipped.size), f"{flipped.sum()} pixels flipped"
    assert_arrays_agree(
        {n: np.where(_like(flipped, v), v, actual[n]) for n, v in expected.items()},
        expected,
        tolerance,
    )


def _like(mask, values) -> np.ndarray:
    return mask[..., None] if values.ndim == 3 else mask


def bitwise(tree) -> list[bytes]:
    """The bytes of every array in a tuple, list or dictionary of Dr.Jit or numpy arrays."""
    values = tree.values() if isinstance(tree, dict) else tree
    dr.eval(*[v for v in values if dr.is_array_v(v)])
    return [np.array(value).tobytes() for value in values]


def bin_splats(splats, grid, features=(), model=DEFAULT):
    """From projected splats to tiles, without keys."""
    return tiles.bin_splats(tiles.splat_table(splats, grid, features, model), grid, model)
