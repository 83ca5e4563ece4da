"""Pictures of Gaussians as one function of arrays, with gsplat's names and conventions.

No Mitsuba: :func:`rasterization` composes the stages of ``drgs.splatting`` for cameras given as
matrices, and hands their adjoint and tangent to Dr.Jit as a custom operation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import numpy as np

from drgs.accuracy.pipeline import pipeline_of
from drgs.cameras.camera import Camera
from drgs.config.approximations import Approximations
from drgs.core.arrays import from_host, interleave, types_of
from drgs.core.constants import ALPHA_CUT, LOW_PASS, MAX_FEATURES
from drgs.core.errors import did_you_mean
from drgs.core.llvm import ensure_usable_llvm
from drgs.core.memory import why_too_large
from drgs.effects.features import NamedFeature
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.projection import GaussianRows, load_rows
from drgs.splatting.rendering import (
    Feature,
    Frame,
    Pipeline,
    color_features,
    depth_feature,
    frames_adjoint,
    frames_tangent,
    render,
)

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")

LEAST_ALPHA = 1e-10
"""What expected depths are divided by at least, as in gsplat."""

MAX_SKEW = 1e-6
"""Rounding, relative to the largest number in K, where a pinhole without skew has 0."""

LEAST_SCALE = 1e-18
"""World units: a smaller standard deviation is taken as this one, whose square float32 holds."""

OPAQUE_LOGIT = 100.0
"""Its sigmoid is 1 in float64: the opacity is then what it is multiplied by."""

ELSEWHERE = {
    "far_plane": "leave out the Gaussians beyond it",
    "radius_clip": "leave it out: small splats cost little",
    "packed": "leave it out: results have a row for each Gaussian",
    "tile_size": "leave it out: a tile has 16 x 16 px",
    "channel_chunk": "leave it out: all channels are composited at once",
    "sparse_grad": "leave it out: gradients have a row for each Gaussian",
    "absgrad": "leave it out: gradients are summed with their signs",
    "distributed": "leave it out: there is one device",
    "segmented": "leave it out: Gaussians are sorted once for all tiles",
    "covars": "give quats and scales",
    "with_ut": 'give projection="unscented"',
    "with_eval3d": 'give projection="exact"',
    **dict.fromkeys(
        (
            "camera_model",
            "radial_coeffs",
            "tangential_coeffs",
            "thin_prism_coeffs",
            "ftheta_coeffs",
            "rolling_shutter",
            "viewmats_rs",
        ),
        "leave it out for pinholes at rest; other cameras are Mitsuba's sensors, which mi.render "
        "takes with the integrator splats",
    ),
}
"""Parameters of gsplat that there are not, and what to do instead."""


def rasterization(
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    colors: Any,
    viewmats: Any,
    Ks: Any,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    eps2d: float = LOW_PASS,
    sh_degree: int | None = None,
    backgrounds: Any = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    **approximations: str | float,
) -> tuple[Any, Any, dict[str, Any]]:
    """Pictures of N Gaussians as C pinhole cameras see them: (colors, alphas, meta).

    Names, defaults, conventions and the order of results are those of gsplat 1.x. Arrays are numpy
    arrays (results then are) or Dr.Jit tensors; all is computed in the type of ``means``, float32
    or float64.

    means: (N, 3) world; quats: (N, 4) wxyz, of any norm; scales: (N, 3) standard deviations, world
    units; opacities: (N,) in 0..1; colors: (N, D) or, for each camera, (C, N, D), D up to 64; with
    ``sh_degree`` coefficients (N, K, 3) or (C, N, K, 3), K at least (sh_degree + 1)^2, whose colour
    is max(0, SH + 0.5); viewmats: (C, 4, 4) world to camera, x right, y down, z forward; Ks:
    (C, 3, 3), px, pixel centres at (i + 0.5, j + 0.5), no skew; width, height: px.

    near_plane: z in the camera, scene units, below which means are not seen; eps2d: px^2 added to
    the projected covariance; backgrounds: (C, D) behind the splats, None: 0; render_mode: ``RGB``,
    ``D`` (the sum of alpha-weighted depths), ``ED`` (that divided by alpha), ``RGB+D``, ``RGB+ED``;
    rasterize_mode: ``classic`` or ``antialiased`` (opacities are scaled such that the low-pass
    keeps a splat's integral); approximations: other values of
    :class:`drgs.config.approximations.Approximations`, such as ``projection="exact"`` or
    ``order="pixel"``.

    Returns pictures (C, H, W, X), X = D, 1 or D + 1 with the depth last; alphas (C, H, W, 1); and a
    dictionary with ``means2d`` (C, N, 2) px, ``depths`` (C, N), ``conics`` (C, N, 3), the numbers
    a, b, c of exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2), ``opacities`` (C, N), ``radii`` (C, N, 2)
    px, integers, 0 where a splat is not seen, ``width``, ``height`` and ``n_cameras``.

    Differentiable by Dr.Jit, forward and in reverse, in means, quats, scales, opacities, colors,
    viewmats, Ks and backgrounds, to the same bytes in every run. Not differentiated: the
    dictionary, visibility, the order of the splats, the decisions of compositing; and
    ``sh_direction="pixel"`` in viewmats and Ks.

    In PyTorch, through ``dr.wrap`` (which converts positional arguments)::

        @dr.wrap(source="torch", target="drjit")
        def rasterize(means, quats, scales, opacities, colors, viewmats, Ks):
            pictures, alphas, _ = drgs.rasterization(
                means, quats, scales, opacities, colors, viewmats, Ks, width=640, height=480
            )
            return pictures, alphas

        pictures, alphas = rasterize(means, quats, scales, opacities, colors, viewmats, Ks)
        torch.nn.functional.l1_loss(pictures, photographs).backward()

    Raises TypeError and ValueError, naming the parameter, what was expected and what was got.
    """
    selected = _approximations(approximations, eps2d, rasterize_mode, sh_degree)
    _require(render_mode in RENDER_MODES, "render_mode", f"one of {RENDER_MODES}", render_mode)
    _require(width >= 1 and height >= 1, "width and height", "1 px or more", (width, height))
    why = why_too_large(int(width), int(height))
    _require(why is None, "width and height", f"smaller: {why}", (width, height))
    given = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "Ks": Ks,
        "backgrounds": backgrounds,
    }
    tensor_type = _tensor_type(means)
    if "llvm" in tensor_type.__module__:
        ensure_usable_llvm()
    inputs = {
        name: _tensor(name, value, tensor_type)
        for name, value in given.items()
        if value is not None
    }
    _check_shapes(inputs, sh_degree)
    features = () if render_mode in ("D", "ED") else (_color_feature(sh_degree),)
    features += () if render_mode == "RGB" else (depth_feature,)
    pictures = _Pictures(
        dr.detach(inputs),
        replace(pipeline_of(selected, sh_degree or 0, features), rows=activated),
        _Film(int(width), int(height), float(near_plane), sh_degree, render_mode),
        of_camera=any(dr.grad_enabled(inputs[name]) for name in ("viewmats", "Ks")),
    )
    images, alphas = dr.custom(_Rasterization, pictures, inputs)
    meta = pictures.meta()
    if dr.is_array_v(means):
        return images, alphas, meta
    meta = {k: v.numpy() if dr.is_array_v(v) else v for k, v in meta.items()}
    return images.numpy(), alphas.numpy(), meta


# ----------------------------------------------------------------------------------------------
# What is given
# ----------------------------------------------------------------------------------------------


def _require(holds: bool, name: str, expected: str, got: object) -> None:
    if not holds:
        raise ValueError(f"rasterization(): {name} must be {expected}, got {got!r}")


def _approximations(
    others: Mapping[str, str | float], eps2d: float, rasterize_mode: str, sh_degree: int | None
) -> Approximations:
    _require(
        rasterize_mode in RASTERIZE_MODES,
        "rasterize_mode",
        f"one of {RASTERIZE_MODES}",
        rasterize_mode,
    )
    _require(sh_degree in (None, 0, 1, 2, 3), "sh_degree", "None or 0 to 3", sh_degree)
    known = {f.name for f in fields(Approximations)} - {"low_pass", "antialiased"}
    for name in others:
        if name in ELSEWHERE:
            raise TypeError(
                f"rasterization(): {name} is a parameter of gsplat's that drgs does not have; "
                f"{ELSEWHERE[name]}"
            )
        if name not in known:
            raise TypeError(
                f"rasterization(): there is no parameter {name}{did_you_mean(name, known)}"
            )
    if others.get("sh_direction", "mean") != "mean" and sh_degree is None:
        raise ValueError(
            "rasterization(): sh_direction is of spherical harmonics; give sh_degree, and colors "
            "of shape (N, K, 3)"
        )
    antialiased = rasterize_mode == "antialiased"
    try:
        return Approximations(low_pass=eps2d, antialiased=antialiased, **others)
    except ValueError as error:
        reason = str(error).replace("low_pass", "eps2d")
        raise ValueError(f"rasterization(): {reason}") from None


def _tensor_type(means: Any) -> type:
    """The type of all tensors: that of ``means``."""
    if dr.is_tensor_v(means) and dr.is_float_v(means):
        return type(means)
    if dr.is_array_v(means):
        raise TypeError(
            f"rasterization(): means must be a tensor (N, 3) of floats, got {type(means).__name__}"
        )
    from drjit import llvm

    return llvm.ad.TensorXf64 if np.asarray(means).dtype == np.float64 else llvm.ad.TensorXf


def _tensor(name: str, value: Any, tensor_type: type) -> Any:
    """``value`` as a tensor, still attached."""
    if type(value) is tensor_type:
        return value
    flat_type = dr.array_t(tensor_type)
    if not dr.is_array_v(value):
        values = np.asarray(value)
        return tensor_type(from_host(flat_type, values), values.shape)
    if dr.is_tensor_v(value):
        return tensor_type(flat_type(value.array), value.shape)
    if dr.depth_v(value) == 1:
        return tensor_type(flat_type(value), (dr.width(value),))
    raise TypeError(f"rasterization(): {name} must be a tensor, got {type(value).__name__}")


def _check_shapes(inputs: Mapping[str, Any], sh_degree: int | None) -> None:
    """Raise ValueError for a shape that does not fit."""
    for name, rest, letters, what in (
        ("means", (3,), "(N, 3)", "Gaussian"),
        ("viewmats", (4, 4), "(C, 4, 4)", "camera"),
    ):
        got = inputs[name].shape
        _require(len(got) > 0 and got[1:] == rest, name, f"of shape {letters}", got)
        _require(got[0] >= 1, name, f"of one {what} at least", got)
    num, views = inputs["means"].shape[0], inputs["viewmats"].shape[0]
    shape = inputs["colors"].shape
    expected = {
        "quats": (num, 4),
        "scales": (num, 3),
        "opacities": (num,),
        "Ks": (views, 3, 3),
    }
    for name, wanted in expected.items():
        _require(inputs[name].shape == wanted, name, f"of shape {wanted}", inputs[name].shape)
    if sh_degree is None:
        fits, wanted = shape[:-1] in ((num,), (views, num)), f"({num}, D) or ({views}, {num}, D)"
    else:
        least = (sh_degree + 1) ** 2
        fits = shape[:-2] in ((num,), (views, num)) and shape[-1] == 3 and shape[-2] >= least
        wanted = f"({num}, K, 3) or ({views}, {num}, K, 3), K >= {least}, for sh_degree {sh_degree}"
    _require(fits, "colors", f"of shape {wanted}", shape)
    width = shape[-1]
    _require(width <= MAX_FEATURES, "colors", f"of at most {MAX_FEATURES} channels", width)
    if "backgrounds" in inputs:
        wanted, got = (views, shape[-1]), inputs["backgrounds"].shape
        _require(got == wanted, "backgrounds", f"of shape {wanted}", got)


def _check_pinhole(name: str, K: np.ndarray) -> None:
    """Raise ValueError for a matrix with numbers that a pinhole has not."""
    pinhole = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    fits = np.abs(K - pinhole).max() <= MAX_SKEW * np.abs(K).max() or np.isnan(K).any()
    _require(fits, name, "((fx, 0, cx), (0, fy, cy), (0, 0, 1)), without skew", K.tolist())


def activated(rows: GaussianRows) -> GaussianRows:
    """Gaussians whose scales and opacities are given as they are, among their features."""
    t = types_of(type(rows.logit_opacities))
    sizes = [dr.abs(scale) for scale in rows.features["scales"]]
    logs = [dr.log(dr.select(size > LEAST_SCALE, size, LEAST_SCALE)) for size in sizes]
    return replace(rows, log_scales=t.Array3f(logs), dimming=rows.features["opacities"][0])


def _color_feature(sh_degree: int | None) -> Feature:
    return NamedFeature("colors") if sh_degree is None else color_features


# ----------------------------------------------------------------------------------------------
# Pictures and their derivatives
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Film:
    """What the pictures are, apart from what they show."""

    width: int
    height: int
    near: float
    sh_degree: int | None  # None: colours are given
    mode: str

    @property
    def num_depths(self) -> int:
        """How many of the channels, the last ones, are depths."""
        return 0 if self.mode == "RGB" else 1

    @property
    def is_expected(self) -> bool:
        """Whether depths are divided by alpha."""
        return self.mode.endswith("ED")


class _Pictures:
    """What the cameras see. Inputs and results are detached tensors by name."""

    def __init__(
        self, inputs: Mapping[str, Any], pipeline: Pipeline, film: _Film, of_camera: bool
    ) -> None:
        self.inputs, self.film, self.pipeline, self.of_camera = inputs, film, pipeline, of_camera
        self.types = types_of(type(inputs["means"].array))
        # The few numbers of cameras are read to the host: their centre is found in float64 there.
        self.viewmats = np.array(inputs["viewmats"], np.float64)
        self.Ks = np.array(inputs["Ks"], np.float64)
        for index, K in enumerate(self.Ks):
            _check_pinhole(f"Ks[{index}]", K)
        self.count = len(self.viewmats)
        self.gaussians = [self._gaussians(inputs, index) for index in range(self.count)]
        self.frames = [self._frame(index) for index in range(self.count)]

    # What the kernels see -------------------------------------------------------------------

    def _gaussians(self, values: Mapping[str, Any], index: int) -> Gaussians:
        """Values, or tangents, of the Gaussians as a camera sees them."""
        num, t = values["means"].shape[0], self.types
        colors = values["colors"]
        if len(colors.shape) == (3 if self.film.sh_degree is None else 4):
            colors = colors[index]
        features = {
            "scales": values["scales"],
            "opacities": t.TensorXf(values["opacities"].array, (num, 1)),
        }
        if self.film.sh_degree is None:
            features["colors"] = colors
            sh0, higher = dr.zeros(t.TensorXf, (num, 1, 3)), dr.zeros(t.TensorXf, (num, 0, 3))
        else:
            sh0, higher = colors[:, :1], colors[:, 1:]
        return Gaussians(
            means=values["means"],
            quats=values["quats"],
            log_scales=dr.zeros(t.TensorXf, (num, 3)),
            logit_opacities=dr.full(t.Float, OPAQUE_LOGIT, num),
            sh0=sh0,
            shN=higher,
            features=features,
        )

    def _frame(self, index: int) -> Frame:
        viewmat, film = self.viewmats[index], self.film
        try:
            center = -np.linalg.solve(viewmat[:3, :3], viewmat[:3, 3])
        except np.linalg.LinAlgError:
            center = np.full(3, np.nan)
        expected = "matrices of a rotation and a translation, of finite numbers"
        _require(np.isfinite(center).all(), f"viewmats[{index}]", expected, viewmat.tolist())
        Float, K = self.types.Float, self.Ks[index]
        rotation = viewmat[:3, :3]
        camera = Camera.create(Float, rotation, center, K, film.width, film.height, film.near)
        return render(self.gaussians[index], camera, self.pipeline)

    def _planes(self) -> list[list[Any]]:
        planes = [frame.planes() for frame in self.frames]
        dr.eval(planes)  # or storing them would run the kernels once for each
        return planes

    def _background(self, values: Mapping[str, Any], index: int, channel: int) -> Any:
        """Float of one entry."""
        backgrounds = values["backgrounds"]
        # Opaque, or each camera would have kernels of its own.
        place = dr.opaque(self.types.UInt32, index * backgrounds.shape[1] + channel)
        return dr.gather(self.types.Float, backgrounds.array, place)

    def _images(self, planes: list[list[Any]]) -> Any:
        """A tensor (C, H, W, channels) of each camera's channels."""
        shape = (self.count, self.film.height, self.film.width, len(planes[0]))
        flat = [interleave(of_camera) for of_camera in planes]
        dr.eval(flat)
        return self.types.TensorXf(flat[0] if len(flat) == 1 else dr.concat(flat), shape)

    def _channels(self, images: Any, index: int) -> list[Any]:
        """Of one camera's picture in (C, H, W, channels), each Float (H * W,)."""
        _, height, width, count = images.shape
        first = dr.opaque(self.types.UInt32, index * height * width)
        pixel = first + dr.arange(self.types.UInt32, height * width)
        return [dr.gather(self.types.Float, images.array, pixel * count + k) for k in range(count)]

    def _split(self, channels: list[Any]) -> tuple[list[Any], list[Any]]:
        """Colours and depths."""
        count = len(channels) - self.film.num_depths
        return channels[:count], channels[count:]

    # Pictures -------------------------------------------------------------------------------

    def images(self) -> tuple[Any, Any]:
        """Pictures and alphas."""
        pictures, alphas = [], []
        for index, (transmittance, *features) in enumerate(self._planes()):
            colors, depths = self._split(features)
            if "backgrounds" in self.inputs:
                colors = [
                    dr.fma(transmittance, self._background(self.inputs, index, k), color)
                    for k, color in enumerate(colors)
                ]
            if self.film.is_expected:
                depths = [depth / _divisor(transmittance) for depth in depths]
            pictures.append([*colors, *depths])
            alphas.append([1 - transmittance])
        return self._images(pictures), self._images(alphas)

    def tangents(self, directions: Mapping[str, Any]) -> tuple[Any, Any]:
        """Directional derivatives of :meth:`images` along tangents of the inputs."""
        d_pictures, d_alphas = [], []
        for index, (transmittance, *features) in enumerate(self._planes()):
            d_camera = self._camera_tangents(directions, index) if self.of_camera else None
            (d_planes,) = frames_tangent(
                self.gaussians[index],
                [self.frames[index]],
                self._gaussians(directions, index),
                d_camera,
            )
            dr.eval(d_planes)
            d_transmittance, *d_features = d_planes
            _, depths = self._split(features)
            d_colors, d_depths = self._split(d_features)
            if "backgrounds" in self.inputs:
                d_colors = [
                    color
                    + d_transmittance * self._background(self.inputs, index, k)
                    + transmittance * self._background(directions, index, k)
                    for k, color in enumerate(d_colors)
                ]
            if self.film.is_expected:
                divisor = _divisor(transmittance)
                d_divisor = dr.select(divisor > LEAST_ALPHA, -d_transmittance, 0)
                d_depths = [
                    (d_depth - depth / divisor * d_divisor) / divisor
                    for d_depth, depth in zip(d_depths, depths, strict=True)
                ]
            d_pictures.append([*d_colors, *d_depths])
            d_alphas.append([-d_transmittance])
        return self._images(d_pictures), self._images(d_alphas)

    def gradients(self, d_pictures: Any, d_alphas: Any) -> dict[str, Any]:
        """Derivatives of a loss with respect to the inputs, from those with respect to images."""
        total: dict[str, Any] = {}
        by_camera: dict[str, list[Any]] = {"colors": [], "backgrounds": []}
        d_viewmats, d_Ks = np.zeros_like(self.viewmats), np.zeros_like(self.Ks)
        for index, planes in enumerate(self._planes()):
            cotangents = self._channels(d_pictures, index), self._channels(d_alphas, index)
            d_planes, d_backgrounds = self._plane_gradients(index, planes, *cotangents)
            dr.eval(d_planes, d_backgrounds)
            found = frames_adjoint(
                self.gaussians[index], [self.frames[index]], [d_planes], self.of_camera
            )
            by_camera["backgrounds"] += d_backgrounds
            d_gaussians = self._by_name(found.parameters)
            by_camera["colors"].append(d_gaussians.pop("colors"))
            total = {k: total[k] + v if k in total else v for k, v in d_gaussians.items()}
            dr.eval(total)
            if self.of_camera:
                numbers = np.array([number[0] for number in found.camera])
                d_viewmats[index], d_Ks[index] = self._matrix_gradients(numbers, index)
        return {**total, **self._joined(by_camera), **self._uploaded(viewmats=d_viewmats, Ks=d_Ks)}

    def _plane_gradients(
        self, index: int, planes: list[Any], d_channels: list[Any], d_alphas: list[Any]
    ) -> tuple[list[Any], list[Any]]:
        """Derivatives with respect to a frame's planes, and to its background's numbers."""
        transmittance, *features = planes
        _, depths = self._split(features)
        d_colors, d_depths = self._split(d_channels)
        d_transmittance, d_background = -d_alphas[0], []
        if "backgrounds" in self.inputs:
            for k, d_color in enumerate(d_colors):
                background = self._background(self.inputs, index, k)
                d_transmittance = dr.fma(d_color, background, d_transmittance)
                d_background.append(dr.sum(d_color * transmittance))
        if self.film.is_expected:
            divisor = _divisor(transmittance)
            d_depths = [d_depth / divisor for d_depth in d_depths]
            for d_depth, depth in zip(d_depths, depths, strict=True):
                share = d_depth * depth / divisor
                d_transmittance += dr.select(divisor > LEAST_ALPHA, share, 0)
        return [d_transmittance, *d_colors, *d_depths], d_background

    # Names and shapes of the inputs ---------------------------------------------------------

    def _by_name(self, gradients: Gaussians) -> dict[str, Any]:
        named = {
            "means": gradients.means,
            "quats": gradients.quats,
            "scales": gradients.features["scales"],
            "opacities": self.types.TensorXf(
                gradients.features["opacities"].array, self.inputs["opacities"].shape
            ),
        }
        if self.film.sh_degree is None:
            return {**named, "colors": gradients.features["colors"]}
        if gradients.shN.shape[1] == 0:
            return {**named, "colors": gradients.sh0}
        return {**named, "colors": dr.concat([gradients.sh0, gradients.shN], axis=1)}

    def _joined(self, by_camera: Mapping[str, list[Any]]) -> dict[str, Any]:
        """Gradients of what may be given for each camera."""
        colors, like = by_camera["colors"], self.inputs["colors"]
        if len(colors[0].shape) == len(like.shape):
            joined = {"colors": sum(colors[1:], colors[0])}
        else:
            flat = [color.array for color in colors]
            flat = flat[0] if len(flat) == 1 else dr.concat(flat)
            joined = {"colors": self.types.TensorXf(flat, like.shape)}
        if by_camera["backgrounds"]:
            flat = dr.concat(by_camera["backgrounds"])
            joined["backgrounds"] = self.types.TensorXf(flat, self.inputs["backgrounds"].shape)
        return joined

    def _uploaded(self, **arrays: np.ndarray) -> dict[str, Any]:
        types = self.types
        return {
            name: types.TensorXf(from_host(types.Float, values), values.shape)
            for name, values in arrays.items()
        }

    def _matrix_gradients(self, numbers: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray]:
        """From derivatives of a camera's numbers to those of its matrices.

        The centre is c = -R^-1 t, hence dc = -R^-1 (dt + dR c).
        """
        rotation, d_center, focal, principal = np.split(numbers, [9, 12, 14])
        viewmat = self.viewmats[index]
        center = -np.linalg.solve(viewmat[:3, :3], viewmat[:3, 3])
        d_translation = -np.linalg.solve(viewmat[:3, :3].T, d_center)
        d_viewmat, d_K = np.zeros((4, 4)), np.zeros((3, 3))
        d_viewmat[:3, :3] = rotation.reshape(3, 3) + np.outer(d_translation, center)
        d_viewmat[:3, 3] = d_translation
        d_K[[0, 1], [0, 1]], d_K[[0, 1], [2, 2]] = focal, principal
        return d_viewmat, d_K

    def _camera_tangents(self, directions: Mapping[str, Any], index: int) -> list[Any]:
        """Tangents of a camera's numbers."""
        viewmat = self.viewmats[index]
        d_viewmat = np.array(directions["viewmats"], np.float64)[index]
        d_K = np.array(directions["Ks"], np.float64)[index]
        center = -np.linalg.solve(viewmat[:3, :3], viewmat[:3, 3])
        moved = d_viewmat[:3, 3] + d_viewmat[:3, :3] @ center
        d_center = -np.linalg.solve(viewmat[:3, :3], moved)
        film = [d_K[0, 0], d_K[1, 1], d_K[0, 2], d_K[1, 2]]
        # Opaque: each value of a literal would be a new kernel.
        Float = self.types.Float
        numbers = (*d_viewmat[:3, :3].ravel(), *d_center, *film)
        return [dr.opaque(Float, float(x)) for x in numbers]

    def meta(self) -> dict[str, Any]:
        """What is known of each splat on its way."""
        t, columns = self.types, {}
        for gaussians, frame in zip(self.gaussians, self.frames, strict=True):
            rows = load_rows(gaussians, self.pipeline.sh_degree)
            splats = self.pipeline.project(rows, frame.camera)
            brightness = dr.log(splats.opacities / ALPHA_CUT)
            radii = dr.ceil(dr.sqrt(2 * brightness * splats.variances))
            found = {
                "means2d": list(splats.means2d),
                "depths": [splats.depths],
                "conics": list(splats.conics),
                "opacities": [splats.opacities],
                "radii": [dr.select(splats.visible, r, 0) for r in radii],
            }
            for name, values in found.items():
                columns.setdefault(name, []).append(interleave(values))
        dr.eval(columns)
        num = self.inputs["means"].shape[0]
        meta = {}
        for name, flat in columns.items():
            flat = flat[0] if len(flat) == 1 else dr.concat(flat)
            shape = (self.count, num)
            width = dr.width(flat) // (self.count * num)
            if name in ("means2d", "conics", "radii"):
                shape = (*shape, width)
            meta[name] = t.TensorXf(flat, shape)
        meta["radii"] = dr.int32_array_t(t.TensorXf)(meta["radii"])
        film = self.film
        return {**meta, "width": film.width, "height": film.height, "n_cameras": self.count}


def _divisor(transmittance: Any) -> Any:
    """What a sum of depths is divided by: alpha, or hardly anything."""
    alpha = 1 - transmittance
    return dr.select(alpha > LEAST_ALPHA, alpha, LEAST_ALPHA)


class _Rasterization(dr.CustomOp):
    """The pictures as an operation that Dr.Jit differentiates."""

    def eval(self, pictures: _Pictures, inputs: dict[str, Any]) -> tuple[Any, Any]:
        """Pictures and alphas; inputs: what they were rendered from, attached."""
        self.pictures, self.names = pictures, list(inputs)
        return pictures.images()

    def forward(self) -> None:
        """Hand on tangents of the inputs."""
        self.set_grad_out(self.pictures.tangents(self.grad_in("inputs")))

    def backward(self) -> None:
        """Hand back derivatives with respect to the inputs."""
        gradients = self.pictures.gradients(*self.grad_out())
        self.set_grad_in("inputs", {name: gradients[name] for name in self.names})

    def name(self) -> str:
        """What Dr.Jit calls it."""
        return "rasterization"
