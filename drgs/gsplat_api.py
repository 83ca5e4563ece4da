""":func:`rasterization`, with gsplat's names and conventions.

Composes the stages of ``drgs.splatting``, without Mitsuba, as a custom operation of Dr.Jit.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import wraps
from numbers import Integral, Real
from typing import Any, TypeVar, cast

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.accuracy.pipeline import pipeline_of
from drgs.cameras.camera import Camera
from drgs.cameras.fisheye import Fisheye
from drgs.cameras.lens import PINHOLE, CameraParameters, Lens, Perspective, with_unseen_on_axis
from drgs.cameras.motion import RollingShutter
from drgs.cameras.orthographic import Orthographic
from drgs.cameras.radial_tangential import RadialTangential
from drgs.config.approximations import Approximations
from drgs.core.arrays import from_host, interleave, quotient, real_numbers, types_of
from drgs.core.constants import ALPHA_CUT, LOW_PASS, MAX_COEFFICIENT, MAX_FEATURES
from drgs.core.errors import did_you_mean
from drgs.core.llvm import ensure_usable_llvm
from drgs.core.memory import too_large_reason
from drgs.core.types import Array3f, Bool, Float, Matrix3f, Scalar, TensorXf
from drgs.effects.compose import NamedFeature, with_effects
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

Array = Any  # arrays of the caller: numpy arrays, or tensors of Dr.Jit or PyTorch

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")

SHUTTERS = {
    "GLOBAL": ((0, 1), 1),
    "ROLLING_TOP_TO_BOTTOM": ((0, 1), 1),
    "ROLLING_BOTTOM_TO_TOP": ((0, 1), -1),
    "ROLLING_LEFT_TO_RIGHT": ((1, 0), 1),
    "ROLLING_RIGHT_TO_LEFT": ((1, 0), -1),
}
"""Axes of the image that a camera has as x and y, and the step from its first pose to the second:
a shutter of drgs reads rows from the first to the last."""

MIN_ALPHA = 1e-10  # divisor of expected depths, as in gsplat
MIN_SCALE = 1e-18  # world units: its square is not 0 in float32
MAX_SKEW = 1e-6  # relative to the largest number in K: rounding
MAX_SHEAR = 1e-3  # of a rotation: rounding
OPAQUE_LOGIT = 100.0  # its sigmoid is 1 in float64

GSPLAT_REMEDIES: dict[str, tuple[object, str]] = {
    "far_plane": (1e10, "leave out the Gaussians beyond it"),
    "covars": (None, "give quats and scales"),
    "with_ut": (False, 'give projection="unscented"'),
    "with_eval3d": (False, 'give projection="exact"'),
    "absgrad distributed sparse_grad": (False, "leave it out"),
    "radius_clip": (0, "leave it out"),
    "thin_prism_coeffs ftheta_coeffs": (None, "give mi.render a sensor of type calibrated"),
}
"""gsplat's default, the only value allowed, and remedies for others, by the parameters of gsplat,
separated by spaces, that drgs does not have."""

MEMORY_LAYOUT = {"channel_chunk", "packed", "segmented", "tile_size"}
"""Parameters of gsplat without effect on results, which are ignored."""

SHAPES: dict[str, list[tuple[str | int, ...]]] = {
    "means": [("N", 3)],
    "viewmats": [("C", 4, 4)],
    "quats": [("N", 4)],
    "scales": [("N", 3)],
    "opacities": [("N",)],
    "Ks": [("C", 3, 3)],
    "colors": [("N", "D"), ("C", "N", "D")],
    "backgrounds": [("C", "D")],
    "viewmats_rs": [("C", 4, 4)],
    "radial_coeffs": [("C", 4), ("C", 6)],
    "tangential_coeffs": [("C", 2)],
}
"""Allowed shapes behind the batch axes; a letter is the same number everywhere."""

LENS_TERMS = {"radial_coeffs": "k", "tangential_coeffs": "p"}
"""First letters of coefficients' names, by array."""

CAMERA_ARRAYS = ("viewmats", "Ks", "viewmats_rs", *LENS_TERMS)
OPTIONAL_ARRAYS = ("backgrounds", "viewmats_rs", *LENS_TERMS)

COEFFICIENTS: list[tuple[str | int, ...]] = [("N", "K", 3), ("C", "N", "K", 3)]
"""Shapes of ``colors`` with ``sh_degree``."""


@dataclass(frozen=True)
class ForwardFisheye(Fisheye):
    """A fisheye as in gsplat: it sees points in front of it, whose depth is z."""

    depth_direction = Perspective.depth_direction
    ray_range = Perspective.ray_range

    @override
    def shows(self, position: Array3f) -> Bool:
        return super().shows(position) & (position.z > 0)

    @override
    def visibility(
        self, camera: CameraParameters, position: Array3f
    ) -> tuple[Bool, Array3f, Float]:
        return with_unseen_on_axis(position, self.shows(position) & (position.z >= camera.near))


LENS_TYPES = {"pinhole": RadialTangential, "ortho": Orthographic, "fisheye": ForwardFisheye}
"""Lenses with coefficients, by ``camera_model``."""

Function = TypeVar("Function", bound=Callable[..., Any])


def accept_torch(function: Function) -> Function:
    """Return :func:`rasterization` for tensors of PyTorch too, which it gets as Dr.Jit's."""
    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: object, **kwargs: object) -> tuple[Array, Array, dict[str, Any]]:
        bound = signature.bind(*args, **kwargs)
        given = {n: v for n, v in bound.arguments.items() if type(v).__module__[:5] == "torch"}
        if not given:
            return function(*args, **kwargs)
        kind, meta = getattr(given.get("means"), "dtype", None), {}
        if str(kind) not in ("torch.float32", "torch.float64"):
            expected = f"a tensor of PyTorch, as {next(iter(given))} is, of 32 or 64 bits"
            raise TypeError(f"rasterization(): means must be {expected}, got {kind}")

        @dr.wrap(source="torch", target="drjit")
        def differentiable(tensors: dict[str, TensorXf]) -> tuple[TensorXf, TensorXf]:
            bound.arguments.update(tensors)
            images, alphas, values = function(*bound.args, **bound.kwargs)
            meta.update({k: v.torch() if dr.is_array_v(v) else v for k, v in values.items()})
            return images, alphas

        # Views, as dr.wrap leaves out parameters of modules, which are of a subclass.
        images, alphas = differentiable({n: v.to(kind).view_as(v) for n, v in given.items()})
        return images, alphas, meta

    return cast(Function, call)


@accept_torch
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
    camera_model: str = "pinhole",
    radial_coeffs: Array | None = None,
    tangential_coeffs: Array | None = None,
    rolling_shutter: object = "GLOBAL",
    viewmats_rs: Array | None = None,
    **approximations: Any,
) -> tuple[Array, Array, dict[str, Any]]:
    """Render N Gaussians through C cameras: (colors, alphas, meta).

    Names, defaults, conventions and the order of results are those of gsplat 1.x. Arrays and
    results are numpy arrays, or tensors of Dr.Jit or PyTorch, in the type of ``means``, float32 or
    float64. All arrays may begin with the same batch axes, which results have as well.

    means: (N, 3) world; quats: (N, 4) wxyz, of any norm; scales: (N, 3) standard deviations, world
    units; opacities: (N,) in 0..1; colors: (N, D) or, for each camera, (C, N, D), D up to 64; with
    ``sh_degree`` coefficients (N, K, 3) or (C, N, K, 3), K at least (sh_degree + 1)^2, whose colour
    is max(0, SH + 0.5); viewmats: (C, 4, 4) world to camera, x right, y down, z forward; Ks:
    (C, 3, 3), px, pixel centres at (i + 0.5, j + 0.5), no skew; width, height: px.

    near_plane: z in the camera, scene units, below which means are not seen; eps2d: px^2 added to
    the projected covariance; backgrounds: (C, D) behind the splats, None: 0; render_mode: ``RGB``,
    ``D`` (the sum of alpha-weighted depths), ``ED`` (that divided by alpha), ``RGB+D``, ``RGB+ED``;
    rasterize_mode: ``classic`` or ``antialiased`` (opacities are scaled to keep splats' integrals).

    camera_model: ``pinhole``, ``ortho`` (fx, fy in px per scene unit; colours are seen along the
    axis) or ``fisheye``; radial_coeffs, tangential_coeffs: OpenCV's k1 to k4 or k6 and p1, p2 of a
    pinhole, (C, 4 or 6) and (C, 2), k1 to k4 of a fisheye; rolling_shutter: gsplat's
    ``RollingShutterType`` or its name, such as ``ROLLING_TOP_TO_BOTTOM``: the first row is read at
    ``viewmats``, the last at ``viewmats_rs``, (C, 4, 4). Between them the camera turns evenly, and
    its centre (not the matrix's translation, as in gsplat) moves on a line.

    approximations: other values of :class:`drgs.config.approximations.Approximations`, such as
    ``projection="exact"`` or ``order="pixel"``. gsplat's ``packed``, ``tile_size``, ``segmented``
    and ``channel_chunk`` change nothing; its other parameters may have their defaults.

    Returns images (C, H, W, X), X = D, 1 or D + 1 with the depth last; alphas (C, H, W, 1); and a
    dictionary with ``means2d`` (C, N, 2) px, ``depths`` (C, N), ``conics`` (C, N, 3), the numbers
    a, b, c of exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2), ``opacities`` (C, N), ``radii`` (C, N, 2)
    px, integers, 0 where a splat is not seen, ``width``, ``height``, ``n_cameras``, ``n_batches``.

    Differentiable by Dr.Jit, forward and in reverse, and by PyTorch, in all arrays, to the same
    bytes in every run. Not differentiated: the dictionary, visibility, the order of the splats, the
    decisions of compositing, where the lens model ends; and ``sh_direction="pixel"`` in cameras.

    Raises TypeError and ValueError, naming the parameter, what was expected and what was got.
    """
    selected = _approximations(approximations, eps2d, rasterize_mode, sh_degree)
    shutter = str(getattr(rolling_shutter, "name", rolling_shutter))
    for name, value, choices in (
        ("render_mode", render_mode, RENDER_MODES),
        ("camera_model", camera_model, tuple(LENS_TYPES)),
        ("rolling_shutter", shutter, tuple(SHUTTERS)),
    ):
        _require(value in choices, name, f"one of {choices}", value)
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
    required = (means, viewmats, quats, scales, opacities, Ks, colors)
    values = (*required, backgrounds, viewmats_rs, radial_coeffs, tangential_coeffs)
    inputs = {
        name: _tensor(name, value, tensor_type)
        for name, value in zip(SHAPES, values, strict=True)
        if not (value is None and name in OPTIONAL_ARRAYS)
    }
    by_camera = _check_shapes(inputs, sh_degree)
    for name, largest in (("scales", 1e37), ("opacities", 1.0)):
        value = dr.detach(inputs[name].array)
        is_within = dr.all((value >= 0) & (value <= largest))
        _require(is_within, name, f"numbers from 0 to {largest:g}", "others")
    film = _Film(int(width), int(height), float(near_plane), sh_degree, camera_model, shutter)
    _check_cameras(film, {k: np.array(inputs[k], np.float64) for k in CAMERA_ARRAYS if k in inputs})
    color = NamedFeature("colors") if sh_degree is None else color_features
    features = () if render_mode in ("D", "ED") else (color,)
    features += () if render_mode == "RGB" else (depth_feature,)
    pipeline = replace(pipeline_of(selected, sh_degree or 0, features), rows=use_activated)
    views, pixels = [], []
    for values in _inputs_of_views(inputs, by_camera):
        background = values.pop("backgrounds", None)
        arrays = {name: values.pop(name) for name in CAMERA_ARRAYS if name in values}
        camera = film.camera({name: _numbers(array) for name, array in arrays.items()})
        dr.eval(camera)
        views.append(_View(film, pipeline, camera, dr.detach(values)))
        planes = dr.custom(_Planes, views[-1], values, camera.numbers())
        pixels.append(_image(film.in_rows(planes), background, render_mode))
    dr.eval(pixels)
    shape = inputs["viewmats"].shape[:-2]
    size = (*shape, film.height, film.width)
    images, alphas = (_stack_views(list(parts), size) for parts in zip(*pixels, strict=True))
    meta = _meta(views, shape)
    if dr.is_array_v(means):
        return images, alphas, meta
    meta = {k: v.numpy() if dr.is_array_v(v) else v for k, v in meta.items()}
    return images.numpy(), alphas.numpy(), meta


def _require(holds: Any, name: str, expected: str, got: object) -> None:
    if not holds:
        raise ValueError(f"rasterization(): {name} must be {expected}, got {got!r}")


def _approximations(
    others: Mapping[str, Any], eps2d: float, rasterize_mode: str, sh_degree: int | None
) -> Approximations:
    expected = f"one of {RASTERIZE_MODES}"
    _require(rasterize_mode in RASTERIZE_MODES, "rasterize_mode", expected, rasterize_mode)
    _require(sh_degree in (None, 0, 1, 2, 3), "sh_degree", "None or 0 to 3", sh_degree)
    known = {f.name for f in fields(Approximations)} - {"low_pass", "antialiased"}
    remedies = {n: each for names, each in GSPLAT_REMEDIES.items() for n in names.split()}
    names = {*known, *inspect.signature(rasterization).parameters}
    for name in others.keys() - known - MEMORY_LAYOUT:
        reason = f"there is no parameter {name}{did_you_mean(name, names)}"
        if name in remedies:
            default, remedy = remedies[name]
            if others[name] is default or (isinstance(default, Real) and others[name] == default):
                continue
            reason = f"{name} is a parameter of gsplat's that drgs does not have; {remedy}"
        raise TypeError(f"rasterization(): {reason}")
    others = {name: value for name, value in others.items() if name in known}
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
    if dr.is_array_v(means):
        if dr.is_tensor_v(means) and dr.type_v(means) in (dr.VarType.Float32, dr.VarType.Float64):
            return cast(type[TensorXf], type(means))
        expected, kind = "a tensor (N, 3) of floats of 32 or 64 bits", type(means).__name__
        raise TypeError(f"rasterization(): means must be {expected}, got {kind}")
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


def _check_shapes(inputs: Mapping[str, TensorXf], sh_degree: int | None) -> set[str]:
    """Return the names of inputs with one entry for each camera."""
    sizes: dict[str | int, int] = {}  # by letter
    batch, by_camera = inputs["means"].shape[:-2], set()
    for name, value in inputs.items():
        is_sh = name == "colors" and sh_degree is not None
        allowed = COEFFICIENTS if is_sh else SHAPES[name]
        shapes = [(*batch, *(sizes.get(each, each) for each in letters)) for letters in allowed]
        fitting = [
            k
            for k, shape in enumerate(shapes)
            if len(value.shape) == len(shape)
            and all(isinstance(n, str) or n == m for n, m in zip(shape, value.shape, strict=True))
        ]
        expected = " or ".join(str(shape).replace("'", "") for shape in shapes)
        _require(fitting, name, f"of shape {expected}", value.shape)
        _require(0 not in value.shape, name, "of one row at least", value.shape)
        letters = allowed[fitting[0]]
        sizes |= zip(letters, value.shape[len(batch) :], strict=True)
        by_camera |= {name} if letters[0] == "C" else set()
        if is_sh and sh_degree is not None:
            least, sizes["D"] = (sh_degree + 1) ** 2, 3
            expected = f"of K >= {least} coefficients for sh_degree {sh_degree}"
            _require(sizes["K"] >= least, name, expected, sizes["K"])
    expected = f"of at most {MAX_FEATURES} channels"
    _require(sizes["D"] <= MAX_FEATURES, "colors", expected, sizes["D"])
    return by_camera


def _check_cameras(film: _Film, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError for arrays that are none of the film's camera."""
    viewmats, ends = arrays["viewmats"], arrays.get("viewmats_rs")
    for name, values in ((name, arrays[name]) for name in LENS_TERMS if name in arrays):
        terms = film.lens_terms(name)
        expected = f"{terms[0]} to {terms[-1]}" if terms else "None"
        expected = f"{expected} if camera_model is {film.model}"
        _require(values.shape[-1] <= len(terms), name, expected, values.shape)
        expected = f"numbers of at most {MAX_COEFFICIENT:g} in size"
        _require(np.abs(values).max() <= MAX_COEFFICIENT, name, expected, "others")
    is_rolling = film.shutter != "GLOBAL"
    expected = f"{'given' if is_rolling else 'None'} if rolling_shutter is {film.shutter}"
    _require(
        is_rolling == (ends is not None),
        "viewmats_rs",
        expected,
        ends if ends is None else ends.shape,
    )
    for index in np.ndindex(viewmats.shape[:-2]):
        place, viewmat, K = f"[{', '.join(map(str, index))}]", viewmats[index], arrays["Ks"][index]
        pinhole = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
        fits = np.abs(K - pinhole).max() <= MAX_SKEW * np.abs(K).max() < math.inf
        fits &= K[0, 0] != 0 and K[1, 1] != 0
        expected = "((fx, 0, cx), (0, fy, cy), (0, 0, 1)) of finite numbers, not 0, without skew"
        _require(fits, f"Ks{place}", expected, K.tolist())
        is_regular = np.isfinite(viewmat).all() and np.linalg.matrix_rank(viewmat[:3, :3]) == 3
        expected = "matrices of a rotation and a translation, of finite numbers"
        _require(is_regular, f"viewmats{place}", expected, viewmat.tolist())
        if ends is not None:
            start, end = viewmat[:3, :3], ends[index][:3, :3]
            shear = np.abs([each @ each.T - np.eye(3) for each in (start, end)]).max()
            turn = end @ start.T
            is_turned = np.linalg.det(turn) > 0 and np.trace(turn) > MAX_SHEAR - 1
            expected = f"rotated by less than half a turn from viewmats{place}, without scale"
            fits = shear < MAX_SHEAR and is_turned and np.isfinite(ends[index]).all()
            _require(fits, f"viewmats_rs{place}", expected, ends[index].tolist())


def _inputs_of_views(
    inputs: Mapping[str, TensorXf], by_camera: set[str]
) -> list[dict[str, TensorXf]]:
    """Return the inputs of each view, attached, without batch and camera axes."""
    *batch, num_cameras, _, _ = inputs["viewmats"].shape
    parts = {k: _split(v, len(batch) + (k in by_camera)) for k, v in inputs.items()}
    dr.eval(parts)
    return [
        {k: v[view if k in by_camera else view // num_cameras] for k, v in parts.items()}
        for view in range(len(parts["viewmats"]))
    ]


def _split(value: TensorXf, num_axes: int) -> list[TensorXf]:
    """Return the entries of the first axes, attached."""
    flat, shape = value.array, value.shape[num_axes:]
    count, size, t = math.prod(value.shape[:num_axes]), math.prod(shape), types_of(type(flat))
    if count == 1:
        return [t.TensorXf(flat, shape)]
    entry = dr.arange(t.UInt32, size)
    # Each number is read once, so that derivatives are written, not added.
    parts = (
        dr.gather(t.Float, flat, entry + dr.opaque(t.UInt32, k * size), mode=dr.ReduceMode.Permute)
        for k in range(count)
    )
    return [t.TensorXf(part, shape) for part in parts]


def use_activated(rows: GaussianRows) -> GaussianRows:
    """Use the activated scales and opacities in the features."""
    assert rows.features is not None, "see _View.gaussians_of"
    t = types_of(type(rows.logit_opacities))
    sizes = [dr.abs(scale) for scale in rows.features["scales"]]
    logs = [dr.log(dr.select(size > MIN_SCALE, size, MIN_SCALE)) for size in sizes]
    compensation = rows.features["opacities"][0]
    return replace(rows, log_scales=t.Array3f(logs), opacity_compensation=compensation)


@dataclass(frozen=True)
class _Film:
    """Settings that all views share, and cameras with them."""

    width: int
    height: int
    near: float
    sh_degree: int | None  # None: colours are given
    model: str  # camera_model
    shutter: str  # a key of SHUTTERS

    @property
    def axes(self) -> tuple[int, int]:
        """Axes of the image that the camera has as x and y."""
        return SHUTTERS[self.shutter][0]

    def lens_terms(self, array: str) -> list[str]:
        """Return the names of an array's coefficients."""
        names, first = LENS_TYPES[self.model].coefficient_names(), LENS_TERMS[array]
        return [name for name in names if name.startswith(first)]

    def in_rows(self, planes: list[Float]) -> list[Float]:
        """Return planes of the camera in the order of the image's pixels."""
        if self.axes == (0, 1):
            return planes
        t = types_of(type(planes[0]))
        pixel, size = dr.arange(t.UInt32, self.width * self.height), dr.opaque(t.UInt32, self.width)
        row = quotient(pixel, self.width)
        place = (pixel - row * size) * dr.opaque(t.UInt32, self.height) + row
        return [dr.gather(t.Float, p, place, mode=dr.ReduceMode.Permute) for p in planes]

    def camera(self, values: Mapping[str, list[Float]]) -> Camera:
        """Return the camera of arrays, given number by number, attached to them."""
        t, K = types_of(type(values["Ks"][0])), values["Ks"]
        axes, step = SHUTTERS[self.shutter]
        names = [name for name in ("viewmats", "viewmats_rs")[::step] if name in values]
        (rotation, center), *end = [self._pose(values[name]) for name in names]
        width, height = ((self.width, self.height)[axis] for axis in axes)
        camera = Camera(
            rotation=rotation,
            center=center,
            focal=t.Array2f([K[4 * axis] for axis in axes]),
            principal=t.Array2f([K[3 * axis + 2] for axis in axes]),
            # Opaque, or each value would be a new kernel.
            film_start=t.Array2f(dr.opaque(t.Float, 0)),
            film_end=t.Array2f([dr.opaque(t.Float, side) for side in (width, height)]),
            near=dr.opaque(t.Float, self.near),
            width=width,
            height=height,
        )
        if end:
            camera = _read_rows(camera, *end[0])
        return camera.with_lens(self._lens(values))

    def _pose(self, viewmat: Sequence[Float]) -> tuple[Matrix3f, Array3f]:
        """Return rotation and centre, -R^-1 t in double precision."""
        t = types_of(type(viewmat[0]))
        t64 = types_of(cast(type, dr.float64_array_t(t.Float)))
        rows = [viewmat[4 * axis : 4 * axis + 4] for axis in (*self.axes, 2)]
        rotation = t64.Matrix3f([row[:3] for row in rows])
        center = -(dr.rcp(rotation) @ t64.Array3f([row[3] for row in rows]))
        return t.Matrix3f(rotation), t.Array3f(center)

    def _lens(self, values: Mapping[str, list[Float]]) -> Lens:
        terms: dict[str, Scalar] = {}
        for array in LENS_TERMS:
            terms |= zip(self.lens_terms(array), values.get(array, ()), strict=False)
        dr.eval(terms)
        if self.model == "pinhole" and not terms:
            return PINHOLE
        if self.axes == (1, 0) and "p1" in terms:
            terms |= {"p1": terms["p2"], "p2": terms["p1"]}
        host = {name: cast(Float, dr.detach(value))[0] for name, value in terms.items()}
        return LENS_TYPES[self.model].from_coefficients(**host).with_coefficients(terms)


def _numbers(array: TensorXf) -> list[Float]:
    """Return each number of an array, (1,), attached."""
    t = types_of(type(array.array))
    # Opaque, or each would be in a kernel of its own.
    places = [dr.opaque(t.UInt32, k) for k in range(math.prod(array.shape))]
    return [dr.gather(t.Float, array.array, k, mode=dr.ReduceMode.Permute) for k in places]


def _read_rows(camera: Camera, rotation: Matrix3f, center: Array3f) -> Camera:
    """Return the camera with a shutter that reads the last row at the given pose.

    Row i, whose middle is at i + 1/2, is read at i / (height - 1): the film begins half a row
    before the first pose, and ends half a row after the second.
    """
    motion = RollingShutter(*RollingShutter.relative_motion(camera, rotation, center))
    per_row = 1 / max(camera.height - 1, 1)
    numbers = (-0.5 * per_row, camera.height * per_row)
    start, scale = (dr.opaque(type(camera.near), number) for number in numbers)
    shutter = RollingShutter(motion.travel * scale, motion.turn * scale)
    return replace(motion.pose(camera, start), shutter=shutter)


def _image(planes: Sequence[Float], background: TensorXf | None, mode: str) -> tuple[Float, Float]:
    """Return the image of a view, pixel by pixel, and alpha; planes: see :class:`_Planes`."""
    transmittance, *features = planes
    count = len(features) - (mode != "RGB")
    channels, depths = features[:count], features[count:]
    if background is not None:
        pairs = zip(_numbers(background)[:count], channels, strict=True)
        channels = [dr.fma(transmittance, behind, channel) for behind, channel in pairs]
    alpha = 1 - transmittance
    if mode.endswith("ED"):
        depths = [depth / dr.select(alpha > MIN_ALPHA, alpha, MIN_ALPHA) for depth in depths]
    channels += depths
    return channels[0] if len(channels) == 1 else interleave(channels), alpha


def _stack_views(parts: list[Float], shape: tuple[int, ...]) -> TensorXf:
    """Concatenate one flat array per view to a tensor of this shape and one more axis."""
    flat = parts[0] if len(parts) == 1 else dr.concat(parts)
    return types_of(type(flat)).TensorXf(flat, (*shape, dr.width(flat) // math.prod(shape)))


class _Planes(dr.CustomOp):
    """Custom operation: planes of a view (transmittance, features), from arrays and camera."""

    @override
    def eval(self, view: _View, arrays: dict[str, TensorXf], numbers: list[Float]) -> list[Float]:
        self.view, self.arrays = view, arrays
        planes = view.frame.planes()
        dr.eval(planes)  # or storing them would run the kernels once for each
        return planes

    @override
    def forward(self) -> None:
        view, d_camera = self.view, None
        d_arrays, d_numbers = (cast(Any, self.grad_in(name)) for name in ("arrays", "numbers"))
        if view.is_camera_attached:
            dr.make_opaque(d_numbers)  # or each value of a literal would be a new kernel
            d_camera = d_numbers
        d_gaussians = view.gaussians_of(d_arrays)
        (d_planes,) = frames_tangent(view.gaussians, [view.frame], d_gaussians, d_camera)
        dr.eval(d_planes)
        self.set_grad_out(d_planes)

    @override
    def backward(self) -> None:
        view, d_planes = self.view, cast(list[Float], self.grad_out())
        dr.eval(d_planes)
        with_camera = view.is_camera_attached
        adjoint = frames_adjoint(view.gaussians, [view.frame], [d_planes], with_camera)
        d = adjoint.parameters
        assert d.features is not None, "of view.gaussians, projected here"
        colors = {} if "colors" in d.features else {"colors": d.sh}
        flat = {"means": d.means, "quats": d.quats, **d.features, **colors}
        pairs = self.arrays.items()
        self.set_grad_in("arrays", {k: dr.reshape(type(v), flat[k], v.shape) for k, v in pairs})
        if adjoint.camera is not None:
            self.set_grad_in("numbers", adjoint.camera)

    @override
    def name(self) -> str:
        return "rasterization"


class _View:
    """A rendering by one camera."""

    def __init__(
        self, film: _Film, pipeline: Pipeline, camera: Camera, arrays: Mapping[str, TensorXf]
    ) -> None:
        """Render; arrays: detached."""
        self.film = film
        self.gaussians = self.gaussians_of(arrays)
        self.is_camera_attached, camera = dr.grad_enabled(camera.numbers()), dr.detach(camera)
        self.pipeline = with_effects(pipeline, self.gaussians, camera)
        self.frame = render(self.gaussians, camera, self.pipeline)

    def gaussians_of(self, values: Mapping[str, TensorXf]) -> Gaussians:
        """Return values, or tangents, of the Gaussians."""
        num, t = values["means"].shape[0], types_of(type(values["opacities"].array))
        colors = values["colors"]
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


def _meta(views: list[_View], shape: tuple[int, ...]) -> dict[str, Any]:
    """Return the intermediate values of each splat, by gsplat's names."""
    columns: dict[str, list[Float]] = {}
    for view in views:
        rows = load_rows(view.gaussians, view.pipeline.sh_degree)
        splats = view.pipeline.project(rows, view.frame.camera)
        axes = view.film.axes
        radii = dr.ceil(dr.sqrt(2 * dr.log(splats.opacities / ALPHA_CUT) * splats.variances))
        values_by_name = {
            "means2d": [splats.means2d[axis] for axis in axes],
            "depths": [splats.depths],
            "conics": [splats.conics[k] for k in (2 * axes[0], 1, 2 * axes[1])],
            "opacities": [splats.opacities],
            "radii": [dr.select(splats.visible, radii[axis], 0) for axis in axes],
        }
        for name, values in values_by_name.items():
            columns.setdefault(name, []).append(interleave(values))
    dr.eval(columns)
    film, num = views[0].film, views[0].gaussians.num_gaussians
    meta: dict[str, Any] = {n: _stack_views(flat, (*shape, num)) for n, flat in columns.items()}
    meta |= {name: meta[name][..., 0] for name in ("depths", "opacities")}
    meta["radii"] = dr.int32_array_t(type(meta["radii"]))(meta["radii"])
    counts = {"n_cameras": shape[-1], "n_batches": math.prod(shape[:-1])}
    return {**meta, "width": film.width, "height": film.height, **counts}
