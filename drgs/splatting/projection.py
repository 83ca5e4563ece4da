"""Projection of 3D Gaussians to 2D splats: culling, EWA projection, opacity and colour.

The first stage: ``Gaussians`` + ``Camera`` -> ``Splats2D``. One lane is one Gaussian; Dr.Jit
differentiates the arithmetic. The equations are from Zwicker et al. 2002 ("EWA splatting") as used
in section 4 of the 3DGS paper, in a form without cancellation in single precision.

A :data:`FilmProjection` projects mean and covariance: :func:`ewa`, or one of another module
(``drgs.accuracy.unscented``, ``drgs.accuracy.exact``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar

import drjit as dr

from drgs.cameras.camera import Camera
from drgs.config.approximations import PROJECTIONS
from drgs.core.arrays import load_columns, types_of
from drgs.core.constants import ALPHA_CUT, LOW_PASS, MIN_LOW_PASS_PX2, NEGLIGIBLE_ALPHA
from drgs.core.types import Array2f, Array3f, Array4f, Bool, Float, TensorXf
from drgs.gaussians import sh
from drgs.gaussians.parameters import Gaussians, normalize, quat_to_rotation


@dataclass(frozen=True)
class RayTerms:
    """Parameters of the peak along a pixel's ray: see ``drgs.accuracy.exact``."""

    tilt_x: Float  # change of the peak's depth across the film: kappa or g / |a_c|
    tilt_y: Float
    spread: Float  # h, variance of the depth given the film position
    scale: Float | None = None  # 1 / |a_c|, factor of the conic factor; None: 1

    def numbers(self) -> list[Float]:
        """Return the numbers that are set."""
        numbers = [self.tilt_x, self.tilt_y, self.spread]
        return numbers if self.scale is None else [*numbers, self.scale]


@dataclass(frozen=True)
class Splats2D:
    """N projected Gaussians, one per lane, in the order of the Gaussians.

    The conic (the inverse of the projected covariance) is kept as its upper triangular factor U =
    [[p, r], [0, s]] with conic = U^T U: U maps a pixel offset d to standard normal coordinates u =
    U d, and the splat's exponent is -u^T u / 2. A sum of squares is never negative, whatever the
    rounding, and stays accurate for needles, where a dx^2 + 2 b dx dy + c dy^2 cancels.
    """

    means2d: Array2f  # px
    conic_factor: Array3f  # (p, r, s), 1 / px
    depths: Float  # z in the camera, scene units
    opacities: Float  # in (0, 1)
    colors: Array3f | Sequence[Float]  # display space; or results of another :data:`SplatColor`
    variances: Array2f  # px^2: diagonal of the projected covariance, low-pass included
    visible: Bool  # in front of the near plane, above the alpha cut, finite
    ray: RayTerms | None = None  # only if a falloff or an order needs them
    opacity_compensation: Float | None = None  # factor of the opacity, out of focus

    @property
    def conics(self) -> Array3f:
        """Array3f (a, b, c) of the exponent -(a dx^2 + 2 b dx dy + c dy^2) / 2, px^-2."""
        p, r, s = self.conic_factor
        return type(self.conic_factor)(p * p, p * r, r * r + s * s)


@dataclass(frozen=True)
class FilmShape:
    """The mean and covariance of a Gaussian on the film."""

    means2d: Array2f  # px
    conic_factor: Array3f  # (p, r, s), 1 / px
    variances: Array2f  # px^2, low-pass included
    determinant: Float  # px^2: of the covariance without low-pass, divided by the variance in y
    added_determinant: Float  # px^2: increase of it by the low-pass
    ray: RayTerms | None = None
    opacity_compensation: Float | None = None  # factor of the opacity; None: 1

    def root_determinant(self) -> Float:
        """Return the square root of det(conic) at the mean, 1 / px^2."""
        p, _, s = self.conic_factor
        if self.ray is not None and self.ray.scale is not None:
            p, s = p / self.ray.scale, s / self.ray.scale
        return dr.abs(p * s)


FilmProjection = Callable[["GaussianRows", Camera, Array3f, Float | float], FilmShape]
"""Maps rows, camera, means (Array3f, camera axes) and low-pass (px^2) to projected shapes."""


class ProjectionModel:
    """A named projection, for ``model.projection`` of a configuration.

    A subclass defines ``shape`` and is registered in ``PROJECTIONS``.
    """

    falloff: ClassVar[type | None] = None  # its own falloff; None: the configured one
    shape_with_depth: ClassVar[FilmProjection | None] = None  # returns shapes with RayTerms

    @staticmethod
    def shape(
        rows: GaussianRows, camera: Camera, position: Array3f, low_pass: Float | float
    ) -> FilmShape:
        """Project; see :data:`FilmProjection`."""
        raise NotImplementedError


OpacityRule = Callable[[Float, Float, Float], Float]
"""Maps an opacity and the two determinants of :class:`FilmShape` to an opacity, Float each."""

SplatColor = Callable[["GaussianRows", Array3f, int], Array3f | Sequence[Float]]
"""Maps rows, directions from the camera to the means (Array3f, world, of any length) and SH degree
to the stored numbers of a splat's colour, Float each."""


@dataclass(frozen=True)
class GaussianRows:
    """The parameters of Gaussians as one value per lane and component."""

    means: Array3f
    quats: Array4f  # wxyz
    log_scales: Array3f
    logit_opacities: Float
    sh: list[Array3f]  # (degree + 1)^2
    smoothing: Float | None = None  # see drgs.effects.smoothing
    opacity_compensation: Float | None = None  # factor of the opacity; None: 1
    features: Mapping[str, list[Float]] | None = None  # by name


def load_rows(gaussians: Gaussians, sh_degree: int) -> GaussianRows:
    """Load every Gaussian's parameters, detached; SH coefficients up to ``sh_degree``."""
    flat = dr.detach(gaussians.logit_opacities)
    t = types_of(type(flat))
    row, num_rows = dr.arange(t.UInt32, dr.width(flat)), dr.opaque(t.UInt32, dr.width(flat))

    def load(tensor: TensorXf, stride: int, width: int) -> list[Float]:
        return load_columns(dr.detach(tensor).array, row, num_rows, stride, width)

    count = 3 * (sh.num_coefficients(sh_degree) - 1)
    higher = load(gaussians.shN, 3 * gaussians.shN.shape[1], count) if count else []
    return GaussianRows(
        means=t.Array3f(load(gaussians.means, 3, 3)),
        quats=t.Array4f(load(gaussians.quats, 4, 4)),
        log_scales=t.Array3f(load(gaussians.log_scales, 3, 3)),
        logit_opacities=flat,
        sh=[t.Array3f(load(gaussians.sh0, 3, 3))]
        + [t.Array3f(higher[k : k + 3]) for k in range(0, count, 3)],
        smoothing=None if gaussians.smoothing is None else dr.detach(gaussians.smoothing),
        features=gaussians.features
        and {k: load(v, v.shape[1], v.shape[1]) for k, v in gaussians.features.items()},
    )


def project(
    rows: GaussianRows,
    camera: Camera,
    sh_degree: int,
    opacity_rule: OpacityRule,
    shape: FilmProjection | None = None,
    color: SplatColor | None = None,
    low_pass: float = LOW_PASS,
    least_alpha: float = ALPHA_CUT,
) -> Splats2D:
    """Project Gaussians onto the image plane of ``camera``.

    opacity_rule: effect of the low-pass on opacity: :func:`plain_opacity` or
    :func:`compensated_opacity`; shape: projection of mean and covariance, by default :func:`ewa`;
    color: stored numbers of a splat's colour, by default :func:`color_at_mean`; low_pass: px^2
    added to the covariance; least_alpha: Gaussians of a smaller opacity, before the shape's opacity
    compensation, are not visible.

    Differentiable in ``rows`` and in the camera's numbers. Not differentiated: visibility.
    """
    offset = rows.means - camera.center
    seen, position, depth = camera.lens.visibility(camera, camera.rotation @ offset)
    low_pass = max(low_pass, MIN_LOW_PASS_PX2)
    film = (shape or ewa)(rows, camera, position, low_pass)
    opacity = _sigmoid(rows.logit_opacities)
    opacities = opacity_rule(opacity, film.determinant, film.added_determinant)
    if rows.opacity_compensation is not None:
        opacities = opacities * rows.opacity_compensation
    above_cut = opacities > least_alpha
    if film.opacity_compensation is not None:
        opacities = opacities * film.opacity_compensation
        above_cut = above_cut & (opacities > NEGLIGIBLE_ALPHA)
    colors = (color or color_at_mean)(rows, camera.lens.view_direction(camera, offset), sh_degree)
    numbers = [*film.means2d, *film.conic_factor, *colors]
    numbers += [] if film.ray is None else film.ray.numbers()
    finite = dr.isfinite(dr.detach(sum(numbers[1:], numbers[0])))
    return Splats2D(
        means2d=film.means2d,
        conic_factor=film.conic_factor,
        depths=depth,
        opacities=opacities,
        colors=colors,
        variances=film.variances,
        visible=seen & above_cut & finite & dr.isfinite(dr.sum(film.variances)),
        ray=film.ray,
        opacity_compensation=film.opacity_compensation,
    )


def ewa(
    rows: GaussianRows, camera: Camera, position: Array3f, low_pass: Float | float
) -> FilmShape:
    """Project by the affine approximation at the mean (Zwicker et al. 2002, section 4).

    position: Array3f, camera axes, the mean. With M = J R_camera R(q) diag(s), 2 x 3, the
    projected covariance is M M^T + low_pass I.
    """
    lens = camera.lens
    m0, m1, _ = film_axes(rows, camera, position, lens.clamped_slopes(camera, position))
    return factor_conic(lens.project_point(camera, position), [*m0], [*m1], low_pass)


@PROJECTIONS.register("ewa")
class Ewa(ProjectionModel):
    """The affine approximation at the mean."""

    shape = staticmethod(ewa)


def factor_conic(
    means2d: Array2f, m0: Sequence[Float], m1: Sequence[Float], low_pass: Float | float
) -> FilmShape:
    """Return the shape of a Gaussian of the projected covariance M M^T + low_pass I.

    m0, m1: the rows of M, of the same length, px.
    """
    xx, xy, yy = dot(m0, m0), dot(m0, m1), dot(m1, m1) + low_pass
    # U needs det / yy, the variance of x where y is given. det(M M^T) is the sum of the squared
    # 2x2 minors of M (Cauchy-Binet): never negative and free of the cancellation of
    # xx yy - xy^2. Its minors are divided by sqrt(yy) first, or the square of a giant's overflows.
    s = dr.rsqrt(yy)
    m1 = [component * s for component in m1]
    minors = [dr.fma(m0[i], m1[j], -(m0[j] * m1[i])) for i, j in combinations(range(len(m0)), 2)]
    determinant, added_determinant = dot(minors, minors), low_pass * (xx / yy + 1)
    p = dr.rsqrt(determinant + added_determinant)
    t = types_of(type(s))
    conic_factor, variances = t.Array3f(p, -p * (xy / yy), s), t.Array2f(xx + low_pass, yy)
    return FilmShape(means2d, conic_factor, variances, determinant, added_determinant)


def dot(a: Sequence[Float], b: Sequence[Float]) -> Float:
    """Return the inner product of two vectors of the same length."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = dr.fma(x, y, total)
    return total


def color_at_mean(rows: GaussianRows, direction: Array3f, sh_degree: int) -> Array3f:
    """Return the colour in the ``direction`` (of any length) from the camera to the mean."""
    return sh.sh_color(rows.sh, normalize(direction), sh_degree)


def plain_opacity(opacity: Float, determinant: Float, added_determinant: Float) -> Float:
    """Return the opacity unchanged: the low-pass makes small splats larger and thus brighter."""
    del determinant, added_determinant
    return opacity


def compensated_opacity(opacity: Float, determinant: Float, added_determinant: Float) -> Float:
    """Scale the opacity by sqrt(det without / det with low-pass), which keeps the splat's integral.

    determinant, added_determinant: Float, of the projected covariance without low-pass, and its
    increase by the low-pass; only their ratio matters.

    Mip-Splatting (Yu et al. 2024), section 5; gsplat's "antialiased" mode. The derivative of
    the square root at 0 (a splat of no area) is taken as 0.
    """
    thin = determinant < 1e-12 * added_determinant
    # With a = determinant and b = added_determinant, not a / (a + b), whose derivative is a
    # difference that cancels for giants.
    ratio = added_determinant / dr.select(thin, 1, determinant)
    return dr.select(thin, 0, opacity * dr.rsqrt(1 + ratio))


def film_axes(
    rows: GaussianRows, camera: Camera, position: Array3f, slopes: list[Float] | None
) -> tuple[Array3f, Array3f, Array3f]:
    """Return the projected semi-axes of a Gaussian, as three rows: film x and y, and depth.

    The first two are M = J R_camera R(q) diag(s), px; the third is the same for the depth divided
    by the mean's. slopes: see :meth:`drgs.cameras.lens.Lens.projection_jacobian`.
    """
    world_from_splat, scales = quat_to_rotation(rows.quats), dr.exp(rows.log_scales)

    def direction_derivative(direction: Array3f) -> Array3f:
        return (world_from_splat.T @ direction) * scales

    m0, m1 = map(direction_derivative, camera.lens.projection_jacobian(camera, position, slopes))
    return m0, m1, direction_derivative(camera.lens.depth_direction(camera, position))


def world_axes(rows: GaussianRows) -> list[Array3f]:
    """Return the three semi-axes of a Gaussian, Array3f, world."""
    world_from_splat, scales = quat_to_rotation(rows.quats), dr.exp(rows.log_scales)
    Array3f = types_of(type(rows.logit_opacities)).Array3f
    return [
        Array3f([world_from_splat[row, column] for row in range(3)]) * scales[column]
        for column in range(3)
    ]


def _sigmoid(x: Float) -> Float:
    """Return 1 / (1 + e^-x) without overflow for large |x|."""
    # Not dr.abs: its derivative at 0 is 0, and a logit of exactly 0 would never move.
    decayed = dr.exp(dr.select(x >= 0, -x, x))
    return dr.select(x >= 0, 1, decayed) / (1 + decayed)
