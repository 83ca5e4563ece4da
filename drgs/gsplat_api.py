""":func:`rasterization`, with gsplat's names and conventions.

Composes the stages of ``drgs.splatting``, without Mitsuba, as a custom operation of Dr.Jit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from typing import Any, cast

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.accuracy.pipeline import pipeline_of
from drgs.cameras.camera import Camera
from drgs.config.approximations import Approximations
from drgs.core.arrays import from_host, interleave, real_numbers, types_of
from drgs.core.constants import ALPHA_CUT, LOW_PASS, MAX_FEATURES
from drgs.core.errors import did_you_mean
from drgs.core.llvm import ensure_usable_llvm
from drgs.core.memory import too_large_reason
from drgs.core.types import Float, TensorXf
from drgs.effects.compose import NamedFeature
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.projection import GaussianRows, load_rows
from drgs.splatting.rendering import (
    Pipeline,
    color_features,
    depth_feature,
    frames_adjoint,
    frames_tangent,
    render,
)

Array = np.ndarray | TensorXf  # arrays of the caller: numpy arrays, or tensors of Dr.Jit

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")

MIN_ALPHA = 1e-10  # divisor of expected depths, as in gsplat
MIN_SCALE = 1e-18  # world units: its square is not 0 in float32
MAX_SKEW = 1e-6  # relative to the largest number in K: rounding
OPAQUE_LOGIT = 100.0  # its sigmoid is 1 in float64

GSPLAT_REMEDIES = {
    "far_plane": "leave out the Gaussians beyond it",
    "covars": "give quats and scales",
    "with_ut": 'give projection="unscented"',
    "with_eval3d": 'give projection="exact"',
    "absgrad channel_chunk distributed packed radius_clip segmented sparse_grad tile_size": (
        "leave it out"
    ),
    "camera_model radial_coeffs tangential_coeffs thin_prism_coeffs ftheta_coeffs rolling_shutter "
    "viewmats_rs": "leave it out for pinholes at rest; other cameras are Mitsuba's sensors, which "
    "mi.render takes with the integrator splats",
}
"""Remedies by the parameters of gsplat, separated by spaces, that drgs does not have."""

SHAPES: dict[str, list[tuple[str | int, ...]]] = {
    "means": [("N", 3)],
    "viewmats": [("C", 4, 4)],
    "quats": [("N", 4)],
    "scales": [("N", 3)],
    "opacities": [("N",)],
    "Ks": [("C", 3, 3)],
    "colors": [("N", "D"), ("C", "N", "D")],
    "backgrounds": [("C", "D")],
}
"""Allowed shapes; a letter is the same number everywhere."""

COEFFICIENTS: list[tuple[str | int, ...]] = [("N", "K", 3), ("C", "N", "K", 3)]
"""Shapes of ``colors`` with ``sh_degree``."""


def rasterization(
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    colors: Array,
    viewmats: Array,
    Ks: Array,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    eps2d: float = LOW_PASS,
    sh_degree: int | None = None,
    backgrounds: Array | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    **approximations: str | float,
) -> tuple[Array, Array, dict[str, Any]]:
    """Render N Gaussians through C pinhole cameras: (colors, alphas, meta).

    Names, defaults, conventions and the order of results are those of gsplat 1.x. Arrays and
    results are numpy arrays or Dr.Jit tensors, in the type of ``means``, float32 or float64.

    means: (N, 3) world; quats: (N, 4) wxyz, of any norm; scales: (N, 3) standard deviations, world
    units; opacities: (N,) in 0..1; colors: (N, D) or, for each camera, (C, N, D), D up to 64; with
    ``sh_degree`` coefficients (N, K, 3) or (C, N, K, 3), K at least (sh_degree + 1)^2, whose colour
    is max(0, SH + 0.5); viewmats: (C, 4, 4) world to camera, x right, y down, z forward; Ks:
    (C, 3, 3), px, pixel centres at (i + 0.5, j + 0.5), no skew; width, height: px.

    near_plane: z in the camera, scene units, below which means are not seen; eps2d: px^2 added to
    the projected covariance; backgrounds: (C, D) behind the splats, None: 0; render_mode: ``RGB``,
    ``D`` (the sum of alpha-weighted depths), ``ED`` (that divided by alpha), ``RGB+D``, ``RGB+ED``;
    rasterize_mode: ``classic`` or ``antialiased`` (opacities are scaled to keep splats' integrals);
    approximations: other values of :class:`drgs.config.approximations.Approximations`, such as
    ``projection="exact"`` or ``order="pixel"``.

    Returns images (C, H, W, X), X = D, 1 or D + 1 with the depth last; alphas (C, H, W, 1); and a
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
            images, alphas, _ = drgs.rasterization(
                means, quats, scales, opacities, colors, viewmats, Ks, width=640, height=480
            )
            return images, alphas

        images, alphas = rasterize(means, quats, scales, opacities, colors, viewmats, Ks)
        torch.nn.functional.l1_loss(images, photographs).backward()

    Raises TypeError and ValueError, naming the parameter, what was expected and what was got.
    """
    selected = _approximations(approximations, eps2d, rasterize_mode, sh_degree)
    _require(render_mode in RENDER_MODES, "render_mode", f"one of {RENDER_MODES}", render_mode)
    for name, value in (("width", width), ("height", height)):
        is_size = isinstance(value, Integral) and value >= 1
        _require(is_size, name, "a whole number, 1 px or more", value)
    is_distance = isinstance(near_plane, Real) and 0 <= near_plane < math.inf
    _require(is_distance, "near_plane", "a distance, 0 or more", near_plane)
    why = too_large_reason(int(width), int(height))
    _require(why is None, "width and height", f"smaller: {why}", (width, height))
    tensor_type = _tensor_type(means)
    if "llvm" in tensor_type.__module__:
        ensure_usable_llvm()
    given = (means, viewmats, quats, scales, opacities, Ks, colors, backgrounds)
    inputs = {
        name: _tensor(name, value, tensor_type)
        for name, value in zip(SHAPES, given, strict=True)
        if not (name == "backgrounds" and value is None)
    }
    _check_shapes(inputs, sh_degree)
    for name, largest in (("scales", 1e37), ("opacities", 1.0)):
        value = dr.detach(inputs[name].array)
        is_within = dr.all((value >= 0) & (value <= largest))
        _require(bool(is_within), name, f"numbers from 0 to {largest:g}", "others")
    _check_cameras(*(np.array(inputs[name], np.float64) for name in ("viewmats", "Ks")))
    color = NamedFeature("colors") if sh_degree is None else color_features
    features = () if render_mode in ("D", "ED") else (color,)
    features += () if render_mode == "RGB" else (depth_feature,)
    pipeline = replace(pipeline_of(selected, sh_degree or 0, features), rows=use_activated)
    is_camera_attached = any(dr.grad_enabled(inputs[name]) for name in ("viewmats", "Ks"))
    film = _Film(int(width), int(height), float(near_plane), sh_degree, is_camera_attached)
    detached = dr.detach(inputs)
    views = [_View(film, pipeline, detached, k) for k in range(inputs["viewmats"].shape[0])]
    images, alphas = _images(views, inputs, render_mode)
    meta = _meta(views)
    if dr.is_array_v(means):
        return images, alphas, meta
    meta = {k: v.numpy() if dr.is_array_v(v) else v for k, v in meta.items()}
    return images.numpy(), alphas.numpy(), meta


def _require(holds: bool, name: str, expected: str, got: object) -> None:
    if not holds:
        raise ValueError(f"rasterization(): {name} must be {expected}, got {got!r}")


def _approximations(
    others: Mapping[str, Any], eps2d: float, rasterize_mode: str, sh_degree: int | None
) -> Approximations:
    expected = f"one of {RASTERIZE_MODES}"
    _require(rasterize_mode in RASTERIZE_MODES, "rasterize_mode", expected, rasterize_mode)
    _require(sh_degree in (None, 0, 1, 2, 3), "sh_degree", "None or 0 to 3", sh_degree)
    known = {f.name for f in fields(Approximations)} - {"low_pass", "antialiased"}
    for name in others.keys() - known:
        reason = f"there is no parameter {name}{did_you_mean(name, known)}"
        for theirs, remedy in GSPLAT_REMEDIES.items():
            if name in theirs.split():
                reason = f"{name} is a parameter of gsplat's that drgs does not have; {remedy}"
        raise TypeError(f"rasterization(): {reason}")
    if others.get("sh_direction", "mean") != "mean" and sh_degree is None:
        raise ValueError(
            "rasterization(): sh_direction is of spherical harmonics; give sh_degree, and colors "
            "of shape (N, K, 3)"
        )
    try:
        return Approximations(low_pass=eps2d, antialiased=rasterize_mode == "antialiased", **others)
    except ValueError as error:
        reason = str(error).replace("low_pass", "eps2d")
        raise ValueError(f"rasterization(): {reason}") from None


def _tensor_type(means: Array) -> type[TensorXf]:
    """Return the type of all tensors: that of ``means``."""
    if dr.is_array_v(means) and dr.is_tensor_v(means) and dr.is_float_v(means):
        return cast(type[TensorXf], type(means))
    if dr.is_array_v(means):
        raise TypeError(
            f"rasterization(): means must be a tensor (N, 3) of floats, got {type(means).__name__}"
        )
    from drjit import llvm

    is_double = real_numbers("rasterization()", "means", means).dtype == np.float64
    return cast(type[TensorXf], llvm.ad.TensorXf64 if is_double else llvm.ad.TensorXf)


def _tensor(name: str, value: Any, tensor_type: type[TensorXf]) -> TensorXf:
    """Return an array of any kind as a tensor, still attached."""
    if type(value) is tensor_type:
        return value
    flat_type = dr.array_t(tensor_type)
    if not dr.is_array_v(value):
        values = real_numbers("rasterization()", name, value)
        return tensor_type(from_host(flat_type, values), values.shape)
    if dr.is_tensor_v(value):
        return tensor_type(flat_type(value.array), value.shape)
    if dr.depth_v(value) == 1:
        return tensor_type(flat_type(value), (dr.width(value),))
    raise TypeError(f"rasterization(): {name} must be a tensor, got {type(value).__name__}")


def _check_shapes(inputs: Mapping[str, TensorXf], sh_degree: int | None) -> None:
    sizes: dict[str | int, int] = {}  # by letter
    for name, value in inputs.items():
        is_sh = name == "colors" and sh_degree is not None
        allowed = COEFFICIENTS if is_sh else SHAPES[name]
        shapes = [tuple(sizes.get(each, each) for each in letters) for letters in allowed]
        fitting = [
            k
            for k, shape in enumerate(shapes)
            if len(value.shape) == len(shape)
            and all(isinstance(n, str) or n == m for n, m in zip(shape, value.shape, strict=True))
        ]
        expected = " or ".join(str(shape).replace("'", "") for shape in shapes)
        _require(bool(fitting), name, f"of shape {expected}", value.shape)
        _require(value.shape[0] >= 1, name, "of one row at least", value.shape)
        sizes |= zip(allowed[fitting[0]], value.shape, strict=True)
        if is_sh and sh_degree is not None:
            least, sizes["D"] = (sh_degree + 1) ** 2, 3
            expected = f"of K >= {least} coefficients for sh_degree {sh_degree}"
            _require(sizes["K"] >= least, name, expected, sizes["K"])
    expected = f"of at most {MAX_FEATURES} channels"
    _require(sizes["D"] <= MAX_FEATURES, "colors", expected, sizes["D"])


def _check_cameras(viewmats: np.ndarray, Ks: np.ndarray) -> None:
    """Raise ValueError for a K that is no pinhole's, or a singular viewmat."""
    for index, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        pinhole = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
        fits = np.abs(K - pinhole).max() <= MAX_SKEW * np.abs(K).max() < math.inf
        expected = "((fx, 0, cx), (0, fy, cy), (0, 0, 1)), of finite numbers, without skew"
        _require(fits, f"Ks[{index}]", expected, K.tolist())
        is_regular = np.isfinite(viewmat).all() and np.linalg.matrix_rank(viewmat[:3, :3]) == 3
        expected = "matrices of a rotation and a translation, of finite numbers"
        _require(is_regular, f"viewmats[{index}]", expected, viewmat.tolist())


def use_activated(rows: GaussianRows) -> GaussianRows:
    """Use the activated scales and opacities in the features."""
    assert rows.features is not None, "see _View._gaussians"
    t = types_of(type(rows.logit_opacities))
    sizes = [dr.abs(scale) for scale in rows.features["scales"]]
    logs = [dr.log(dr.select(size > MIN_SCALE, size, MIN_SCALE)) for size in sizes]
    compensation = rows.features["opacities"][0]
    return replace(rows, log_scales=t.Array3f(logs), opacity_compensation=compensation)


@dataclass(frozen=True)
class _Film:
    width: int
    height: int
    near: float
    sh_degree: int | None  # None: colours are given
    is_camera_attached: bool  # whether derivatives with respect to cameras are needed


def _images(
    views: list[_View], inputs: dict[str, TensorXf], mode: str
) -> tuple[TensorXf, TensorXf]:
    """Return images (C, H, W, X) and alphas (C, H, W, 1), attached to ``inputs``."""
    images, alphas = [], []
    all_planes, backgrounds = dr.custom(_Planes, views, inputs)
    for transmittance, *features in all_planes:
        count = len(features) - (mode != "RGB")
        channels, depths = features[:count], features[count:]
        if backgrounds:
            behind, backgrounds = backgrounds[:count], backgrounds[count:]
            channels = [dr.fma(transmittance, b, c) for b, c in zip(behind, channels, strict=True)]
        alpha = 1 - transmittance
        if mode.endswith("ED"):
            depths = [depth / dr.select(alpha > MIN_ALPHA, alpha, MIN_ALPHA) for depth in depths]
        channels += depths
        images.append(channels[0] if len(channels) == 1 else interleave(channels))
        alphas.append(alpha)
    dr.eval(images, alphas)
    shape = (len(views), views[0].film.height, views[0].film.width)
    return _stack_cameras(images, shape), _stack_cameras(alphas, shape)


def _stack_cameras(parts: list[Float], shape: tuple[int, ...]) -> TensorXf:
    """Concatenate one flat array per camera to a tensor of this shape and one more axis."""
    flat = parts[0] if len(parts) == 1 else dr.concat(parts)
    return types_of(type(flat)).TensorXf(flat, (*shape, dr.width(flat) // math.prod(shape)))


class _Planes(dr.CustomOp):
    """Custom operation: planes of all cameras (transmittance, features), and background numbers."""

    @override
    def eval(
        self, views: list[_View], inputs: dict[str, TensorXf]
    ) -> tuple[list[list[Float]], list[Float]]:
        self.views, self.inputs = views, inputs
        planes = [view.frame.planes() for view in views]
        dr.eval(planes)  # or storing them would run the kernels once for each
        return planes, self._entries(inputs)

    @override
    def forward(self) -> None:
        directions = cast(dict[str, TensorXf], self.grad_in("inputs"))
        tangents = [view.tangents(directions) for view in self.views]
        self.set_grad_out((tangents, self._entries(directions)))

    @override
    def backward(self) -> None:
        grad_out: Any = self.grad_out()  # as of :meth:`eval`
        all_d_planes, d_backgrounds = grad_out
        parts_by_name: dict[str, list] = {name: [] for name in self.inputs}
        for view, d_planes in zip(self.views, all_d_planes, strict=True):
            for name, gradient in view.gradients(d_planes).items():
                parts_by_name[name].append(gradient)
            dr.eval(parts_by_name)
        if d_backgrounds:
            parts_by_name["backgrounds"] = d_backgrounds
        gradients = {}
        for name, parts in parts_by_name.items():
            shape, flat = self.inputs[name].shape, [cast(Float, dr.ravel(part)) for part in parts]
            is_shared = dr.width(flat[0]) == math.prod(shape)
            total = sum(flat[1:], flat[0]) if is_shared else dr.concat(flat)
            gradients[name] = type(self.inputs[name])(total, shape)
        self.set_grad_in("inputs", gradients)

    def _entries(self, values: Mapping[str, TensorXf]) -> list[Float]:
        """Return each number of the backgrounds, (1,)."""
        if "backgrounds" not in values:
            return []
        flat = values["backgrounds"].array
        # Opaque, or each would be in a kernel of its own.
        places = [dr.opaque(types_of(type(flat)).UInt32, k) for k in range(dr.width(flat))]
        return [dr.gather(type(flat), flat, place) for place in places]

    @override
    def name(self) -> str:
        return "rasterization"


class _View:
    """Planes of one camera, and their derivatives."""

    def __init__(
        self, film: _Film, pipeline: Pipeline, inputs: Mapping[str, TensorXf], index: int
    ) -> None:
        """Render; inputs: detached; index: of the camera among them."""
        self.film, self.pipeline, self.inputs, self.index = film, pipeline, inputs, index
        self.types = types_of(type(inputs["means"].array))
        # On the host, to compute the centre in float64.
        self.viewmat = np.array(inputs["viewmats"], np.float64)[index]
        self.center = -np.linalg.solve(self.viewmat[:3, :3], self.viewmat[:3, 3])
        rotation, K = self.viewmat[:3, :3], np.array(inputs["Ks"], np.float64)[index]
        size = film.width, film.height
        camera = Camera.create(self.types.Float, rotation, self.center, K, *size, film.near)
        self.gaussians = self._gaussians(inputs)
        self.frame = render(self.gaussians, camera, pipeline)

    def tangents(self, directions: Mapping[str, TensorXf]) -> list[Float]:
        """Return tangents of the planes from those of the inputs."""
        d_gaussians = self._gaussians(directions)
        d_camera = self._camera_tangents(directions) if self.film.is_camera_attached else None
        (d_planes,) = frames_tangent(self.gaussians, [self.frame], d_gaussians, d_camera)
        dr.eval(d_planes)
        return d_planes

    def gradients(self, d_planes: list[Float]) -> dict[str, TensorXf | Float]:
        """Return gradients of the inputs from those of the planes."""
        dr.eval(d_planes)
        with_camera = self.film.is_camera_attached
        adjoint = frames_adjoint(self.gaussians, [self.frame], [d_planes], with_camera)
        d, t = adjoint.parameters, self.types
        assert d is not None and d.features is not None, "of self.gaussians, projected here"
        gradients: dict[str, TensorXf | Float] = {
            "means": d.means,
            "quats": d.quats,
            "scales": d.features["scales"],
            "opacities": d.features["opacities"],
            "colors": d.features["colors"] if self.film.sh_degree is None else d.sh,
            "viewmats": dr.zeros(t.Float, 16),
            "Ks": dr.zeros(t.Float, 9),
        }
        if adjoint.camera is not None:
            gradients |= self._camera_gradients(np.array([number[0] for number in adjoint.camera]))
        return gradients

    def _gaussians(self, values: Mapping[str, TensorXf]) -> Gaussians:
        """Return values, or tangents, of the Gaussians."""
        num, t, colors = values["means"].shape[0], self.types, values["colors"]
        if len(colors.shape) == (3 if self.film.sh_degree is None else 4):
            colors = colors[self.index]
        features = {
            "scales": values["scales"],
            "opacities": t.TensorXf(values["opacities"].array, (num, 1)),
        }
        if self.film.sh_degree is None:
            features["colors"], colors = colors, dr.zeros(t.TensorXf, (num, 1, 3))
        return Gaussians(
            means=values["means"],
            quats=values["quats"],
            log_scales=dr.zeros(t.TensorXf, (num, 3)),
            logit_opacities=dr.full(t.Float, OPAQUE_LOGIT, num),
            sh0=colors[:, :1],
            shN=colors[:, 1:],
            features=features,
        )

    def _camera_gradients(self, numbers: np.ndarray) -> dict[str, Float]:
        """Return gradients of the matrices; c = -R^-1 t, hence dc = -R^-1 (dt + dR c)."""
        rotation, d_center, focal, principal = np.split(numbers, [9, 12, 14])
        d_translation = -np.linalg.solve(self.viewmat[:3, :3].T, d_center)
        d_viewmat, d_K = np.zeros((4, 4)), np.zeros((3, 3))
        d_viewmat[:3, :3] = rotation.reshape(3, 3) + np.outer(d_translation, self.center)
        d_viewmat[:3, 3] = d_translation
        d_K[[0, 1], [0, 1]], d_K[[0, 1], [2, 2]] = focal, principal
        Float = self.types.Float
        return {"viewmats": from_host(Float, d_viewmat), "Ks": from_host(Float, d_K)}

    def _camera_tangents(self, directions: Mapping[str, TensorXf]) -> list[Float]:
        d_viewmat = np.array(directions["viewmats"], np.float64)[self.index]
        d_K = np.array(directions["Ks"], np.float64)[self.index]
        moved = d_viewmat[:3, 3] + d_viewmat[:3, :3] @ self.center
        d_center = -np.linalg.solve(self.viewmat[:3, :3], moved)
        film = [d_K[0, 0], d_K[1, 1], d_K[0, 2], d_K[1, 2]]
        # Opaque: each value of a literal would be a new kernel.
        numbers = (*d_viewmat[:3, :3].ravel(), *d_center, *film)
        return [dr.opaque(self.types.Float, float(x)) for x in numbers]


def _meta(views: list[_View]) -> dict[str, Any]:
    """Return the intermediate values of each splat, by gsplat's names."""
    columns: dict[str, list[Float]] = {}
    for view in views:
        rows = load_rows(view.gaussians, view.pipeline.sh_degree)
        splats = view.pipeline.project(rows, view.frame.camera)
        radii = dr.ceil(dr.sqrt(2 * dr.log(splats.opacities / ALPHA_CUT) * splats.variances))
        values_by_name = {
            "means2d": list(splats.means2d),
            "depths": [splats.depths],
            "conics": list(splats.conics),
            "opacities": [splats.opacities],
            "radii": [dr.select(splats.visible, r, 0) for r in radii],
        }
        for name, values in values_by_name.items():
            columns.setdefault(name, []).append(interleave(values))
    dr.eval(columns)
    film, num = views[0].film, views[0].gaussians.num_gaussians
    meta: dict[str, Any] = {
        name: _stack_cameras(flat, (len(views), num)) for name, flat in columns.items()
    }
    meta |= {name: meta[name][:, :, 0] for name in ("depths", "opacities")}
    meta["radii"] = dr.int32_array_t(type(meta["radii"]))(meta["radii"])
    return {**meta, "width": film.width, "height": film.height, "n_cameras": len(views)}
