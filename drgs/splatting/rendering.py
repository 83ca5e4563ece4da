"""The rendering pipeline: from Gaussians and a camera to planes of pixels, and its adjoint.

A :class:`Pipeline` holds the SH degree, the opacity rule, the composited features and the
approximations, as functions and objects. Dr.Jit traces only the functions of the pipeline, so an
effect that is not part of it adds no instruction to any kernel. ``drgs.accuracy.pipeline`` makes a
pipeline from names.

The chain is  Gaussians -> ``project`` -> Splats2D -> ``splat_table`` -> SplatTable
-> ``bin_splats`` -> TileBins -> ``composite`` -> CompositedTiles.  The adjoint runs backwards:
the hand-written adjoint of compositing gives the derivatives of the 2D splats, and Dr.Jit
differentiates projection and SH, which are traced again, one Gaussian per lane, so no gradient is
scattered.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import drjit as dr

from drgs.cameras.camera import Camera
from drgs.core.arrays import first_numbers, repeat_array, store_columns, types_of
from drgs.core.constants import LOW_PASS
from drgs.core.types import Array2f, Bool, Float, TensorXf, UInt32
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.splatting.footprint import DEFAULT, ImageModel
from drgs.splatting.grid import TileGrid
from drgs.splatting.order import CenterOrder, group_features
from drgs.splatting.projection import (
    FilmProjection,
    GaussianRows,
    OpacityRule,
    SplatColor,
    Splats2D,
    color_at_mean,
    ewa,
    load_rows,
    plain_opacity,
    project,
)
from drgs.splatting.rasterize import CompositedTiles, SplatGradients
from drgs.splatting.ray_derivatives import add_rays_adjoint, tangents_with_rays
from drgs.splatting.tiles import SplatTable, TileBins, bin_splats, splat_table

Feature = Callable[[Splats2D, GaussianRows, Camera], list[Float]]
"""Composited values of each splat: columns, Float (N,) each, one for each plane."""


def color_features(splats: Splats2D, rows: GaussianRows, camera: Camera) -> list[Float]:
    """Return red, green and blue in display space: three planes."""
    del rows, camera
    return list(splats.colors)


def depth_feature(splats: Splats2D, rows: GaussianRows, camera: Camera) -> list[Float]:
    """Return camera z, scene units: one plane, the alpha-weighted sum of the depths."""
    del rows, camera
    return [splats.depths]


@dataclass(frozen=True)
class Pipeline:
    """The stages and approximations of a rendering; see the module's description."""

    sh_degree: int = 3
    opacity_rule: OpacityRule = plain_opacity
    features: tuple[Feature, ...] = (color_features,)
    rows: Callable[[GaussianRows], GaussianRows] = lambda rows: rows  # applied before projection
    shape: FilmProjection = ewa  # projection of mean and covariance
    color: SplatColor = color_at_mean  # stored numbers of a splat's colour
    low_pass: float = LOW_PASS  # px^2
    model: ImageModel = DEFAULT
    order: CenterOrder = field(default_factory=CenterOrder)
    of_smoothing: bool = False  # whether the smoothing filter is differentiated

    def select_differentiable(self, rows: GaussianRows) -> GaussianRows:
        """Return the differentiated numbers."""
        return rows if self.of_smoothing else replace(rows, smoothing=None)

    def project(self, rows: GaussianRows, camera: Camera) -> Splats2D:
        """Project with this pipeline's approximations."""
        prepared, moved = self.rows(rows), camera.for_means(rows.means)
        stages = self.sh_degree, self.opacity_rule, self.shape, self.color, self.low_pass
        splats = project(prepared, moved, *stages, self.model.cutoffs.least_alpha)
        if rows.features:
            numbers = [number for columns in rows.features.values() for number in columns]
            finite = dr.isfinite(dr.detach(sum(numbers[1:], numbers[0])))
            splats = replace(splats, visible=splats.visible & finite)
        return splats

    def feature_columns(self, splats: Splats2D, rows: GaussianRows, camera: Camera) -> list[Float]:
        """Return the columns of all features, in order."""
        return [column for feature in self.features for column in feature(splats, rows, camera)]


@dataclass(frozen=True)
class Frame:
    """A rendered frame: its planes, and the inputs of its adjoint and tangent."""

    pipeline: Pipeline
    camera: Camera
    order: CenterOrder  # the pipeline's, for this camera
    tiles: CompositedTiles  # of that order

    def planes(self) -> list[Float]:
        """Return transmittance, then the features: see :meth:`.CompositedTiles.planes`."""
        return self.tiles.planes()


@dataclass(frozen=True)
class GaussianGradients:
    """Derivatives of the loss, shaped like the parameters, and statistics for densification."""

    parameters: Gaussians
    means2d: Array2f  # (N,): loss per px
    visible: Bool  # (N,): the Gaussian's extent touches the film
    first_nonfinite: UInt32  # (1,): of ``parameters``, see :func:`decode_nonfinite`
    camera: list[Float] | None = None  # (1,) each: of ``camera.numbers()``, if requested


def render(gaussians: Gaussians, camera: Camera, pipeline: Pipeline) -> Frame:
    """Render ``gaussians`` through ``camera``. Attached parameters are detached.

    An aperture and a smoothing filter must be part of the pipeline: see
    :func:`drgs.effects.compose.with_effects`. The host reads one value, the number of (splat, tile)
    entries.
    """
    return render_splats(project_splats(gaussians, camera, pipeline), camera, pipeline)


def render_splats(splats: SplatTable, camera: Camera, pipeline: Pipeline) -> Frame:
    """Render splats that are projected by ``camera`` and ``pipeline``; see :func:`render`."""
    model = pipeline.model.for_camera(camera)
    bins = bin_splats(splats, TileGrid(camera.width, camera.height, model.positions.samples), model)
    order = group_features(pipeline.order.for_camera(camera), bins)
    return Frame(pipeline, camera, order, order.composite(bins, order.records(bins)))


def project_splats(gaussians: Gaussians, camera: Camera, pipeline: Pipeline) -> SplatTable:
    """Project ``gaussians`` and store the inputs of compositing; see :func:`render`."""
    rows = load_rows(gaussians, pipeline.sh_degree)
    splats = pipeline.project(rows, camera)
    columns = pipeline.feature_columns(splats, rows, camera)
    grid, model = TileGrid(camera.width, camera.height), pipeline.model.for_camera(camera)
    order = pipeline.order.for_camera(camera)
    keys, splats = order.keys(splats), replace(splats, depths=order.sort_depths(splats))
    return splat_table(splats, grid, columns, model, keys)


def render_again(frame: Frame, model: ImageModel) -> Frame:
    """Composite the same splats, in the same tiles, with another footprint model.

    model: that of the frame's pipeline, except for sample positions within the same margin, or
    features of the same stored numbers.
    """
    bins = frame.tiles.bins
    grid = replace(bins.grid, samples=model.positions.samples)
    bins = replace(bins, grid=grid, model=model.for_camera(frame.camera))
    return replace(frame, tiles=frame.order.composite(bins, frame.tiles.records))


def frames_adjoint(
    gaussians: Gaussians,
    frames: list[Frame],
    d_planes: list[list[Float]],
    with_camera: bool = False,
) -> GaussianGradients:
    """Return derivatives of a loss with respect to all parameters.

    The loss depends on several frames of the same splats and one camera.

    gaussians: the input of ``frames``; d_planes: for each frame, derivatives of the loss with
    respect to its planes (see :meth:`Frame.planes`); with_camera: also differentiate with respect
    to the camera. Samples are added in their order.

    Raises NotImplementedError if the pipeline has no derivatives with respect to the camera.

    Not differentiated: visibility, the order of the splats, the decisions of compositing.
    """
    of_splats, first = splats_adjoint(frames, d_planes), frames[0]
    total, by_row = gradients_by_row(
        gaussians, CameraGradients(first.camera, first.pipeline, of_splats), with_camera
    )
    # dr.sum adds in the same order in every run.
    camera = [dr.sum(each) for each in by_row] if with_camera else None
    camera = add_rays_adjoint(frames, d_planes, camera)
    return replace(total, visible=on_film(first.tiles.bins), camera=camera)


def splats_adjoint(frames: list[Frame], d_planes: list[list[Float]]) -> SplatGradients:
    """Return derivatives with respect to the 2D splats of several frames: see above."""
    total = None
    for frame, of_frame in zip(frames, d_planes, strict=True):
        bins = frame.tiles.bins
        at_once = max(1, ENTRIES_AT_ONCE // max(bins.num_entries, bins.num_splats))
        for first in range(0, bins.grid.samples, at_once):
            samples = range(first, min(first + at_once, bins.grid.samples))
            total = frame.order.adjoint(frame.tiles, of_frame, samples, total)
    assert total is not None, "there is at least one frame"
    return total


ENTRIES_AT_ONCE = 1 << 19
"""Maximum number of entries, and of splats, that the adjoint adds at once. It stores about 40 bytes
per entry, besides the slots, whose memory is bounded separately."""


@dataclass(frozen=True)
class CameraGradients:
    """The derivatives of the 2D splats of one camera."""

    camera: Camera
    pipeline: Pipeline
    gradients: SplatGradients


def gradients_by_row(
    gaussians: Gaussians, given: CameraGradients, with_camera: bool = False
) -> tuple[GaussianGradients, list[Float]]:
    """Return derivatives of the parameters, and each Gaussian's contribution to the camera's.

    Dr.Jit computes them from those of the 2D splats; ``visible`` does not include the bounds of the
    film. Contributions are evaluated: (N,) for each of ``camera.numbers()``; none without
    ``with_camera``.
    """
    if with_camera:  # an error here, and not in a branch, is not wrapped by Dr.Jit's own
        given.pipeline.model.features.check_differentiable_in_camera()
    t, widths = types_of(type(gaussians.logit_opacities)), {}
    # Not literals: Dr.Jit 1.5 takes one that a branch returns for the same one behind it.
    zero, no_fault = dr.opaque(t.Float, 0), dr.opaque(t.UInt32, NO_FAULT)

    def differentiate() -> tuple[dict[str, list[Float]], list[Float], UInt32]:
        rows = load_rows(gaussians, given.pipeline.sh_degree)
        d_rows, visible, d_numbers = _back_to_rows(rows, given, with_camera)
        by_row = [dr.select(visible, number, zero) for number in d_numbers]
        columns = _columns_of(d_rows, gaussians, visible, zero)
        widths.update({name: len(each) for name, each in columns.items()} | {"": len(by_row)})
        return columns, by_row, _nonfinite_flags(d_rows, visible)

    def skip() -> tuple[dict[str, list[Float]], list[Float], UInt32]:
        zeros = {name: [t.Float(zero) for _ in range(width)] for name, width in widths.items()}
        return zeros, zeros.pop(""), t.UInt32(no_fault)

    is_seen = given.gradients.are_nonzero()
    columns, by_row, faults = dr.if_stmt((), is_seen, differentiate, skip)
    parameters = _as_tensors(columns, gaussians, [faults])
    dr.eval(by_row)
    return GaussianGradients(parameters, given.gradients.means2d, is_seen, dr.min(faults)), by_row


def sum_of_views(
    gaussians: Gaussians, views: Sequence[Sequence[CameraGradients]]
) -> tuple[Gaussians, list[UInt32]]:
    """Sum :func:`gradients_by_row` over several views, in one kernel.

    views: the derivatives at each time of each view, added in this order. Shared values are
    computed once, and the sum stays in registers.

    Returns the derivatives, and each view's first non-finite number.
    """
    rows, faults = load_rows(gaussians, views[0][0].pipeline.sh_degree), []
    total: dict[str, list[Float]] = {}
    for view in views:
        flags = []
        for each in view:
            copy = dr.copy(rows)  # separates the derivatives of the cameras
            d_rows, visible, _ = _back_to_rows(copy, each)
            zero = type(gaussians.logit_opacities)(0)
            for name, columns in _columns_of(d_rows, gaussians, visible, zero).items():
                terms = zip(total[name], columns, strict=True) if name in total else ()
                total[name] = [a + b for a, b in terms] or columns
            flags.append(_nonfinite_flags(d_rows, visible))
        faults.append(reduce(dr.minimum, flags))
    return _as_tensors(total, gaussians, faults), [dr.min(each) for each in faults]


def _back_to_rows(
    rows: GaussianRows, given: CameraGradients, with_camera: bool = False
) -> tuple[GaussianRows, Bool, list[Float]]:
    """Return derivatives per lane, the visible lanes, and derivatives of the camera's numbers."""
    with dr.resume_grad():
        inputs, splats, outputs = _attach(rows, given.camera, given.pipeline, with_camera)
        cotangents = given.gradients.geometry + given.gradients.features
        for output, cotangent in zip(outputs, cotangents, strict=True):
            dr.accum_grad(output, cotangent)
        dr.enqueue(dr.ADMode.Backward, outputs)
        dr.traverse(dr.ADMode.Backward)
        d_rows = given.pipeline.select_differentiable(dr.grad(rows))
        return d_rows, dr.detach(splats.visible), [dr.grad(number) for number in inputs[1]]


def _attach(
    rows: GaussianRows, camera: Camera, pipeline: Pipeline, with_camera: bool
) -> tuple[tuple[GaussianRows, list[Float]], Splats2D, list[Float]]:
    """Trace the projection again with derivatives.

    Returns its inputs (rows, numbers of the camera), the splats, and the outputs of which
    :class:`SplatGradients` has the derivatives.
    """
    numbers, falloff = [], pipeline.model.for_camera(camera).falloff
    if with_camera:
        pipeline.model.features.check_differentiable_in_camera()
        camera = camera.by_lane(dr.width(rows.logit_opacities))
        numbers = camera.numbers()
    inputs = pipeline.select_differentiable(rows), numbers
    dr.enable_grad(inputs)
    splats = pipeline.project(rows, camera)
    outputs = falloff.differentiable(splats)
    return inputs, splats, outputs + pipeline.feature_columns(splats, rows, camera)


def weighted_sums(frame: Frame, *planes: Float) -> list[Float]:
    """Return, for each Gaussian, sums over pixels of its weight times each plane: (N,) each.

    planes: x, Float (H * W,), the same for all samples; at most as many as the frame has features.
    A plane of the frame is C = sum_i w_i c_i, so the adjoint's derivative with respect to c_i is
    sum w_i g over pixels: here g is x for the first features and 0 for the rest. This reuses the
    adjoint's kernel, unless colours are evaluated along each pixel's ray.
    """
    bins, samples = frame.tiles.bins, frame.tiles.bins.grid.samples
    features = bins.model.features.with_weight_derivatives()
    tiles = replace(frame.tiles, bins=replace(bins, model=replace(bins.model, features=features)))
    repeated = [repeat_array(plane, samples) for plane in planes]
    # Separate arrays of zeros: for one array several times, Dr.Jit would compile another kernel.
    of_transmittance, *of_other_planes = (
        dr.opaque(type(repeated[0]), 0, dr.width(repeated[0]))
        for _ in range(1 + tiles.count - len(planes))
    )
    d_planes = [of_transmittance, *repeated, *of_other_planes]
    gradients = frame.order.adjoint(tiles, d_planes, range(samples))
    return gradients.features[: len(planes)]


def sum_of_gradients(a: GaussianGradients, b: GaussianGradients) -> GaussianGradients:
    """Add the derivatives of a loss that depends on several cameras."""
    sums = {name: v + b.parameters.arrays[name] for name, v in a.parameters.arrays.items()}
    means2d, visible = a.means2d + b.means2d, a.visible | b.visible
    first, other = a.first_nonfinite, b.first_nonfinite
    least = dr.select(first < other, first, other)
    # Derivatives of the cameras are separate.
    total = GaussianGradients(Gaussians.from_arrays(sums), means2d, visible, least)
    dr.eval(total)
    return total


def decode_nonfinite(fault: int) -> tuple[int, str] | None:
    """Return row and parameter of :attr:`GaussianGradients.first_nonfinite`, or None.

    A row's gradient of a parameter is at fault if its squared norm is not finite: it is NaN or
    infinite, or Adam's second moment, which holds squares, would be.
    """
    if fault == NO_FAULT:
        return None
    row, parameter = divmod(fault, len(PARAMETER_NAMES))
    return row, PARAMETER_NAMES[parameter]


NO_FAULT = 2**32 - 1  # no row is at fault


def frames_tangent(
    gaussians: Gaussians,
    frames: list[Frame],
    tangents: Gaussians,
    camera_tangents: list[Float] | None = None,
) -> list[list[Float]]:
    """Return directional derivatives of each frame's planes along ``tangents`` of the parameters.

    gaussians: the input of ``frames``, which have one camera; camera_tangents: of
    ``camera.numbers()``; None: zero.

    Raises NotImplementedError for the camera's tangents if the pipeline has none.

    Not differentiated: visibility, the order of the splats, the decisions of compositing.
    """
    frame, with_camera = frames[0], camera_tangents is not None
    pipeline = frame.pipeline
    rows = load_rows(gaussians, pipeline.sh_degree)
    d_rows = load_rows(tangents, pipeline.sh_degree)
    with dr.resume_grad():
        inputs, _, outputs = _attach(rows, frame.camera, pipeline, with_camera)
        dr.set_grad(inputs, (pipeline.select_differentiable(d_rows), camera_tangents or []))
        # Some outputs (depths, p of the conic factor) are inputs of others: the default would clear
        # the derivatives of such interior variables on the way.
        dr.forward_to(outputs, flags=dr.ADFlag.ClearEdges)
        columns = [dr.grad(output) for output in outputs]
    dr.eval(columns)
    count = frame.tiles.bins.model.falloff.num_geometry
    direction = SplatGradients(geometry=columns[:count], features=columns[count:])
    return tangents_with_rays(frames, direction, camera_tangents)


def _columns_of(
    d_rows: GaussianRows, like: Gaussians, visible: Bool, zero: Float
) -> dict[str, list[Float]]:
    """Return per-lane derivatives by parameter, column by column.

    The gradient of invisible rows is zero, also if their values are not finite; so is that of SH
    coefficients above the pipeline's degree.
    """
    t = types_of(type(d_rows.logit_opacities))
    columns = _parameter_columns(d_rows)
    missing = 3 * like.shN.shape[1] - len(columns["shN"])
    columns["shN"] += [t.Float(0)] * missing if columns["shN"] else []
    columns["smoothing"] = [] if d_rows.smoothing is None else [d_rows.smoothing]
    columns |= d_rows.features or {}
    return {
        name: [dr.select(visible, component, zero) for component in components]
        for name, components in columns.items()
        if len(components)
    }


def _parameter_columns(rows: GaussianRows) -> dict[str, list[Float]]:
    """Return the loaded columns of ``PARAMETER_NAMES``."""
    return {
        "means": [*rows.means],
        "quats": [*rows.quats],
        "log_scales": [*rows.log_scales],
        "logit_opacities": [rows.logit_opacities],
        "sh0": [*rows.sh[0]],
        "shN": [component for vector in rows.sh[1:] for component in vector],
    }


def _as_tensors(
    columns: dict[str, list[Float]], gaussians: Gaussians, others: list[UInt32]
) -> Gaussians:
    """Return columns as tensors shaped like the parameters, evaluated together with ``others``."""
    t = types_of(type(gaussians.logit_opacities))
    stored = {name: store_columns(c) for name, c in columns.items()}
    dr.eval(stored, others)

    def gradient(name: str, like: TensorXf | Float) -> TensorXf | Float:
        if name not in stored:
            return dr.zeros(t.TensorXf, like.shape)
        flat = first_numbers(stored[name], dr.width(like))
        return t.TensorXf(flat, like.shape) if dr.is_tensor_v(like) else flat

    likes = gaussians.arrays
    if "smoothing" not in stored:  # it is not differentiated
        likes.pop("smoothing", None)
    return Gaussians.from_arrays({name: gradient(name, like) for name, like in likes.items()})


def _nonfinite_flags(d_rows: GaussianRows, visible: Bool) -> UInt32:
    """Return UInt32 (N,): row * 6 + number of its first non-finite parameter, or ``NO_FAULT``."""
    UInt32 = types_of(type(d_rows.logit_opacities)).UInt32
    row = dr.arange(UInt32, dr.width(d_rows.logit_opacities))
    columns = _parameter_columns(d_rows)
    faults = UInt32(NO_FAULT)
    for number, name in reversed(list(enumerate(PARAMETER_NAMES))):
        squared_norm = sum(dr.square(component) for component in columns[name])
        # Written such that NaN is a fault.
        faults = dr.select(squared_norm < dr.inf, faults, row * len(PARAMETER_NAMES) + number)
    return dr.select(visible, faults, NO_FAULT)


def on_film(bins: TileBins) -> Bool:
    """Return the Gaussians that have entries."""
    splat = dr.arange(type(bins.first_entry), bins.num_splats)
    first, end = (dr.gather(type(splat), bins.first_entry, splat + k) for k in (0, 1))
    return first < end
