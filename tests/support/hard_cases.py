"""Families of hard inputs, and how far rounding may take their images and gradients.

Rounding errors are modelled as in Monte Carlo arithmetic (Parker 1997, "Monte Carlo Arithmetic:
exploiting randomness in floating-point arithmetic"): the float64 reference is evaluated again and
again while every number that a float32 implementation has to round -- the inputs, the camera,
and what each stage hands to the next -- is moved by at most one rounding, 2^-24 of its size. The
root mean square change of a result is its *noise*: what the problem's conditioning turns one
rounding everywhere into. It is a property of the scene and of the reference alone; the kernels
have no part in it.

A float32 implementation makes k roundings where the model makes one. By the probabilistic error
analysis of Higham and Mary (2019, "A new approach to probabilistic rounding error analysis"),
their sum exceeds lambda sqrt(k) noise with a probability of at most 2 exp(-lambda^2 / 2).
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from unittest import mock

import numpy as np

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Cotangents,
    gaussians_before,
    points_on_film,
    reference_gradients,
    single,
)

U = 2.0**-24
"""Unit roundoff of float32."""

SAMPLES = 16

EXP2 = 4.0
"""Roundings in the exponential: the short exp2 has a relative error of 2.2e-7."""


@dataclass(frozen=True)
class Noise:
    """Root mean square change of each result under one rounding everywhere."""

    rendered: dict[str, np.ndarray]
    gradients: dict[str, np.ndarray]


def noise(case: Case, cotangents: Cotangents, samples: int = SAMPLES) -> Noise:
    """The noise of a case's image and gradients, arrays in the shapes of the results."""
    images, gradients = [], []
    base = _results(case.gaussians, case.camera, case, cotangents)
    splats = reference.project(case.gaussians, case.camera, case.antialiased)
    order = reference.depth_order(splats.depths, splats.visible)
    for sample in range(samples):
        rng = np.random.default_rng([sample, 17])
        gaussians, camera = rounded_inputs(rng, case.gaussians, case.camera)
        weights = Cotangents(
            *(rounded(rng, getattr(cotangents, name)) for name in vars(cotangents))
        )
        with _rounded_stages(rng, order):
            rendered, gradient = _results(gaussians, camera, case, weights)
        images.append(rendered)
        gradients.append(gradient)
    return Noise(rms(images, base[0]), rms(gradients, base[1]))


def _results(gaussians, camera, case, cotangents) -> tuple[dict, dict]:
    rendered = reference.render(
        gaussians, camera, case.background, case.rendered_degree, case.antialiased
    )
    gradients = reference.render_gradients(
        gaussians, camera, case.background, cotangents.d_image, cotangents.d_alpha,
        cotangents.d_depth, case.rendered_degree, case.antialiased,
    )  # fmt: skip
    planes = {n: getattr(rendered, n) for n in ("image", "alpha", "depth", "transmittance")}
    return planes, gradients


def rms(samples: list[dict], base: dict) -> dict[str, np.ndarray]:
    """Over the samples; vectors (colours, rows of a matrix) have one noise, their largest."""
    result = {}
    for name, value in base.items():
        noise = np.sqrt(np.mean([(s[name] - value) ** 2 for s in samples], axis=0))
        if noise.ndim > 1 and noise.shape[-1] in (2, 3, 4):
            noise = np.broadcast_to(noise.max(axis=-1, keepdims=True), noise.shape)
        result[name] = noise
    return result


def rounded(rng, values, roundings=1.0) -> np.ndarray:
    """Each value moved by up to ``roundings`` roundings, in either direction."""
    values = np.asarray(values, dtype=np.float64)
    return values * (1 + roundings * U * rng.uniform(-1, 1, values.shape))


def rounded_inputs(rng, gaussians, camera):
    """Gaussians and camera, every number moved by up to one rounding."""
    fields = {name: rounded(rng, getattr(gaussians, name)) for name in PARAMETER_NAMES}
    # The difference of mean and camera centre is rounded, not the two: they are given exactly.
    offset = gaussians.means - camera.center
    fields["means"] = camera.center + rounded(rng, offset)
    numbers = {
        name: float(rounded(rng, getattr(camera, name))) for name in ("fx", "fy", "cx", "cy")
    }
    # Gaussians at the near plane stay in front of it.
    near = camera.near * (1 - 1e-5)
    camera = replace(camera, rotation=rounded(rng, camera.rotation), near=near, **numbers)
    return reference.Gaussians(**fields), camera


def opacity_size(opacities) -> np.ndarray:
    """Return numbers that are rounded with an opacity: alpha's exponential, and T (1 - alpha), one
    rounding of T however small alpha is.
    """
    return np.maximum(EXP2 * opacities, opacities > reference.ALPHA_CUT)


def color_share(opacities) -> np.ndarray:
    """Return the factor from a rounding of the sum of a splat's light to one of its colour."""
    return np.maximum(opacities, reference.ALPHA_CUT)


@contextmanager
def _rounded_stages(rng, order):
    """The reference, with a rounding of what each stage hands to the next.

    order: visible Gaussians by depth. A decision is not a rounding: it stays what it is.
    The same numbers are rounded the same way wherever a function is called again, as the
    gradient's functions do: noise is a function of the call's place, not of the call.
    """
    seed = int(rng.integers(2**62))
    original_affine, original_sigmoid = reference.local_affine, reference.sigmoid
    original_colors = reference.unclamped_colors

    def affine(gaussians, camera):
        result = original_affine(gaussians, camera)
        own = np.random.default_rng([seed, 1])
        scales = rounded(own, result.scales)
        return replace(result, axes2d=rounded(own, result.axes2d), scales=scales)

    def sigmoid(logits):
        own = np.random.default_rng([seed, 2])
        opacities = original_sigmoid(logits)
        return opacities + opacity_size(opacities) * U * own.uniform(-1, 1, np.shape(logits))

    def colors(gaussians, directions, degree):
        own = np.random.default_rng([seed, 3])
        result = original_colors(gaussians, directions, degree)
        share = color_share(original_sigmoid(gaussians.logit_opacities))
        return result + U / share[:, None] * own.uniform(-1, 1, result.shape)

    with (
        mock.patch.object(reference, "local_affine", affine),
        mock.patch.object(reference, "sigmoid", sigmoid),
        mock.patch.object(reference, "unclamped_colors", colors),
        mock.patch.object(reference, "depth_order", lambda depths, visible: order),
    ):
        yield


ROUNDINGS = 25

BOUND = 6 * np.sqrt(ROUNDINGS)

UNDERFLOW = 1e-15
"""Fraction of an array's largest value below which values may be lost to underflow (1e-38)."""

PLANES = ("image", "alpha", "depth", "transmittance")


def camera_for(width, height, rng=None, **changes) -> reference.Camera:
    """A camera at the origin that looks along z; with ``rng``, one that is turned and moved."""
    extent = max(width, height)
    camera = reference.Camera(
        rotation=np.eye(3),
        center=np.zeros(3),
        fx=1.25 * extent,
        fy=1.125 * extent,
        cx=0.5 * width,
        cy=0.5 * height,
        width=width,
        height=height,
        near=0.25,
    )
    if rng is not None:
        rotation = reference.quat_to_rotation(rng.normal(0, 1, (1, 4)))[0]
        camera = replace(camera, rotation=single(rotation), center=single(rng.normal(0, 1, 3)))
    return replace(camera, **changes)


def splats(
    rng, camera, film, z, scales, logits, degree, quats=None, sh_size=0.3
) -> reference.Gaussians:
    """Gaussians whose means project to ``film`` (N, 2) px at depth ``z`` (N,); world ``scales``.

    Scalars are the same for all; quats: (N, 4), None for random ones.
    """
    film = np.asarray(film, dtype=np.float64)
    n = len(film)
    z = np.broadcast_to(np.asarray(z, dtype=np.float64), n)
    scales = np.broadcast_to(np.asarray(scales, dtype=np.float64), (n, 3))
    quats = rng.normal(0, 1, (n, 4)) if quats is None else np.broadcast_to(quats, (n, 4))
    points, logits = points_on_film(camera, film, z), np.broadcast_to(logits, n)
    return gaussians_before(rng, camera, points, scales, logits, degree, quats, sh_size)


def with_backdrop(rng, camera, gaussians, count=12) -> reference.Gaussians:
    """Some ordinary Gaussians before and behind: the hard ones must not spoil them."""
    degree = gaussians.sh_degree
    film = rng.uniform(0, 1, (count, 2)) * [camera.width, camera.height]
    z = rng.uniform(1, 4, count)
    sizes = rng.uniform(0.04, 0.15, (count, 3)) * max(camera.width, camera.height)
    ordinary = splats(
        rng, camera, film, z, sizes * z[:, None] / camera.fx, rng.normal(0.5, 1, count), degree
    )
    return joined(gaussians, ordinary)


def joined(first, second) -> reference.Gaussians:
    return reference.Gaussians(
        *(
            np.concatenate(pair)
            for pair in zip(vars(first).values(), vars(second).values(), strict=True)
        )
    )


def on_film(rng, camera, count, margin=0.0) -> np.ndarray:
    size = np.array([camera.width, camera.height])
    return rng.uniform(-margin, 1 + margin, (count, 2)) * size


FAMILIES = {}


def family(
    name, width=37, height=29, degree=1, count=16, turned=True, backdrop=True, principal=(),
    **settings,
):  # fmt: skip
    """Register recipe(rng, camera, degree, count) -> Gaussians as a case.

    turned: the camera is; otherwise it looks along z from the origin. backdrop: ordinary Gaussians
    are added. principal: changes of the camera.
    """

    def register(recipe):
        def scene(seed, *_):
            rng = np.random.default_rng(seed)
            camera = camera_for(width, height, rng if turned else None, **dict(principal))
            hard = recipe(rng, camera, degree, count)
            return with_backdrop(rng, camera, hard) if backdrop else hard, camera

        FAMILIES[name] = Case(name, width, height, degree, count=count, recipe=scene, **settings)
        return recipe

    return register


@family("means at, just before, just behind and far behind the near plane", turned=False)
def near_plane(rng, camera, degree, count):
    # The camera is not turned: z is the mean's own third coordinate, not rounded.
    near = np.float32(camera.near)
    above, below = np.nextafter(near, np.float32(1)), np.nextafter(near, np.float32(0))
    z = np.array([near, above, below, 0.99 * near, 0.5 * near, 1.01 * near])
    z = np.append(z, [1e-20, 0.0, -1e-20, -near, -1.0, -1e6])
    film, logits = on_film(rng, camera, len(z)), rng.normal(0, 1, len(z))
    hard = splats(rng, camera, film, z, 0.01, logits, degree)
    hard.means[6:, :2] = single(rng.normal(0, 0.1, (len(z) - 6, 2)))
    return hard


@family("means at the camera centre")
def camera_center(rng, camera, degree, count):
    scales = np.array([1e-3, 0.1, 10, 1e4])[:, None]
    hard = splats(rng, camera, on_film(rng, camera, 4), 1.0, scales, 2.0, degree)
    hard.means[:] = camera.center
    hard.means[1] += 1e-7
    return hard


@family("far outside the frustum, reaching it")
def far_outside(rng, camera, degree, count):
    size = np.array([camera.width, camera.height])
    beyond = np.array(
        [[-0.4, 0.5], [1.5, 0.4], [0.3, -1.5], [0.6, 2.5], [-2, -2], [4, 3], [9, 0.5], [-20, 8]]
    )
    distance = np.abs(beyond - np.clip(beyond, 0, 1)).max(axis=1) * max(size)
    z = rng.uniform(1, 4, len(beyond))
    sizes = distance[:, None] * rng.uniform(0.4, 0.8, (len(beyond), 3))
    return splats(rng, camera, beyond * size, z, sizes * z[:, None] / camera.fx, 1.0, degree)


@family("89 degrees off axis", threshold_width=1e-3)
def off_axis(rng, camera, degree, count):
    angle = np.deg2rad([60, 75, 85, 89, 89, 89.9])
    turn = rng.uniform(0, 2 * np.pi, len(angle))
    slopes = np.tan(angle)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    film = slopes * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    z = np.linspace(0.5, 0.6, len(angle))
    sizes = np.linalg.norm(film, axis=1) / 2.5
    return splats(rng, camera, film, z, (sizes * z)[:, None] / camera.fx, 0.5, degree)


@family("needles of ratio 1e6", count=40)
def needles(rng, camera, degree, count):
    z, length = rng.uniform(1, 4, count), 10.0 ** rng.uniform(-1, 1, count)
    film, logits = on_film(rng, camera, count, 0.3), rng.normal(1, 1, count)
    return splats(rng, camera, film, z, length[:, None] * [1, 1e-6, 1e-6], logits, degree)


@family("needles along the line of sight", count=10, turned=False)
def needles_end_on(rng, camera, degree, count):
    film = on_film(rng, camera, count)
    film[0] = [camera.cx, camera.cy]
    return splats(rng, camera, film, 2.0, [1e-6, 1e-6, 1.0], 1.0, degree, quats=[1, 0, 0, 0])


@family("disks of ratio 1e6", count=20)
def disks(rng, camera, degree, count):
    z, size = rng.uniform(1, 4, count), 10.0 ** rng.uniform(-2, 0, count)
    film, logits = on_film(rng, camera, count), rng.normal(1, 1, count)
    return splats(rng, camera, film, z, size[:, None] * [1, 1, 1e-6], logits, degree)


@family("disks edge-on and face-on", count=20, turned=False)
def disks_aligned(rng, camera, degree, count):
    film = on_film(rng, camera, count)
    edge_on = np.arange(count)[:, None] % 2
    quats = np.where(edge_on, [np.sqrt(0.5), np.sqrt(0.5), 0, 0], [1, 0, 0, 0])
    return splats(rng, camera, film, 2.0, [0.3, 0.3, 1e-6], 0.5, degree, quats=quats)


def points(rng, camera, degree, count, scale):
    film = on_film(rng, camera, count)
    film[: count // 4] = np.floor(film[: count // 4]) + 0.5
    film[count // 4 : count // 2] = np.floor(film[count // 4 : count // 2])
    z, logits = rng.uniform(1, 4, count), rng.normal(1, 1, count)
    return splats(rng, camera, film, z, scale, logits, degree)


for size, name, antialiased_name in [
    (1e-8, "points of scale 1e-8", "points of scale 1e-8, antialiased"),
    (1e-25, "scales of 1e-25, whose determinant underflows", "scales of 1e-25, antialiased"),
]:
    family(name, count=24)(partial(points, scale=size))
    family(antialiased_name, count=24, antialiased=True)(partial(points, scale=size))


family("a needle whose minor axis underflows", count=12, antialiased=True)(
    partial(points, scale=[1e-2, 1e-22, 1e-22])
)


@family("sub-pixel splats, antialiased", count=30, antialiased=True)
@family("sub-pixel splats", count=30)
def sub_pixel(rng, camera, degree, count):
    return points(rng, camera, degree, count, 10.0 ** rng.uniform(-3.5, -1.5, (count, 3)))


def giants(rng, camera, degree, count, scale):
    film, z = on_film(rng, camera, count, 0.5), 10.0 ** rng.uniform(-0.5, 1, count)
    return splats(rng, camera, film, z, scale, rng.normal(-2, 1, count), degree)


for size, name, antialiased_name in [
    (1e4, "giants: scales of 1e4 around the camera", "giants, antialiased"),
    (1e10, "giants of 1e10, whose determinant overflows", "giants of 1e10, antialiased"),
]:
    family(name, count=8)(partial(giants, scale=size))
    family(antialiased_name, count=8, antialiased=True)(partial(giants, scale=size))


@family("giants that are needles, far away", count=8)
def giants_far(rng, camera, degree, count):
    film, z = on_film(rng, camera, count), rng.uniform(1e4, 2e4, count)
    return splats(rng, camera, film, z, [1e4, 1e2, 1e1], rng.normal(-1, 1, count), degree)


@family("opacity logits of +-40 and more", count=24)
def logits(rng, camera, degree, count):
    values = np.resize([40.0, -40.0, 100.0, -100.0, 20.0, -5.0, 0.0, 1e4, -1e4], count)
    z, sizes = rng.uniform(1, 4, count), rng.uniform(0.02, 0.1, (count, 3)) * camera.width
    film = on_film(rng, camera, count)
    return splats(rng, camera, film, z, sizes * z[:, None] / camera.fx, values, degree)


def stack(rng, camera, degree, count, logits, spread=0.3, sizes=(0.4, 0.9)):
    size = np.array([camera.width, camera.height])
    film = 0.5 * size + rng.normal(0, spread, (count, 2)) * camera.width
    z = np.sort(rng.uniform(1, 4, count))
    sizes = rng.uniform(*sizes, (count, 3)) * camera.width
    return splats(rng, camera, film, z, sizes * z[:, None] / camera.fx, logits, degree)


@family("hundreds of near-opaque layers", 13, 11, count=300, backdrop=False)
def opaque_stack(rng, camera, degree, count):
    return stack(rng, camera, degree, count, rng.uniform(2, 8, count))


@family(
    *("hundreds of half-transparent layers, transmittance 1e-30", 13, 11), count=400, backdrop=False
)
def transmittance_stack(rng, camera, degree, count):
    return stack(rng, camera, degree, count, rng.normal(-1.7, 0.3, count))


@family("thousands of layers just above the cut", 7, 6, 0, count=2500, backdrop=False)
def above_the_cut(rng, camera, degree, count):
    logit = np.log(1.02 / (255 - 1.02))
    return stack(rng, camera, degree, count, logit, 0.05, (8, 12))


@family("thousands of layers just above and below the cut", 7, 6, 0, count=3000, backdrop=False)
def around_the_cut(rng, camera, degree, count):
    alpha = np.where(rng.random(count) < 0.5, 1.01, 0.99) / 255
    logits = np.log(alpha / (1 - alpha))
    return stack(rng, camera, degree, count, logits, 0.01, (40, 60))


def at_depths(rng, camera, degree, z, count):
    film, sizes = on_film(rng, camera, count), rng.uniform(0.03, 0.15, (count, 3))
    return splats(rng, camera, film, z, sizes, rng.normal(1, 1, count), degree)


@family("equal depths", count=60, turned=False, backdrop=False)
def equal_depths(rng, camera, degree, count):
    return at_depths(rng, camera, degree, 2.0, count)


@family("depths that differ in the last bit", count=60, turned=False, backdrop=False)
def last_bit_depths(rng, camera, degree, count):
    z = 2.0 + rng.permutation(count) * np.spacing(np.float32(2.0)).astype(float)
    return at_depths(rng, camera, degree, z, count)


@family("quaternions of norm 0, 1e-20, 1e20 and negated", count=30)
def quaternions(rng, camera, degree, count):
    z, sizes = rng.uniform(1, 4, count), rng.uniform(0.02, 0.15, (count, 3)) * camera.width
    quats = rng.normal(0, 1, (count, 4))
    quats *= np.resize([0, 1e-20, 1e20, -1, 1e-30, 1e30], count)[:, None]
    quats[-3:] = [[1, 0, 0, 0], [0, -1, 0, 0], [1e-20, 1e20, 0, 1]]
    film = on_film(rng, camera, count)
    return splats(rng, camera, film, z, sizes * z[:, None] / camera.fx, 1.0, degree, quats)


@family("SH that drive colour negative", degree=3, count=40, backdrop=False)
def negative_colors(rng, camera, degree, count):
    z, sizes = rng.uniform(1, 4, count), rng.uniform(0.03, 0.1, (count, 3)) * camera.width
    scales, film = sizes * z[:, None] / camera.fx, on_film(rng, camera, count)
    hard = splats(rng, camera, film, z, scales, 1.0, degree, sh_size=1.0)
    hard.sh0[:] = single(rng.normal(-1.5, 2, hard.sh0.shape))
    return hard


def ordinary(rng, camera, degree, count):
    none = splats(rng, camera, np.zeros((0, 2)), 1.0, 1.0, 0.0, degree)
    return with_backdrop(rng, camera, none, count)


for name, options in {
    **{
        f"a film of {width}x{height}": {"width": width, "height": height, "count": 30}
        for width, height in [(1, 1), (1, 40), (40, 1), (2, 17), (17, 33), (16, 16), (3, 5)]
    },
    "a principal point on the film's corner": {"count": 30, "principal": {"cx": 0.0, "cy": 29.0}},
    "a principal point outside the film": {"count": 30, "principal": {"cx": -111.0, "cy": 72.5}},
    "one Gaussian": {"count": 1},
}.items():
    family(name, backdrop=False, **options)(ordinary)


@family("no visible Gaussian", count=0, backdrop=False)
def none_visible(rng, camera, degree, count):
    film, z = [[5, 5], [9, 9], [1e4, 1e4]], np.array([-1.0, -5.0, 2.0])
    return splats(rng, camera, film, z, 0.01, 1.0, degree)


def offset_by(seed, width, height, degree, count, distance):
    """The scene and the camera together; means are rounded there, then given exactly."""
    rng = np.random.default_rng(seed)
    camera = camera_for(width, height, rng)
    gaussians = ordinary(rng, camera, degree, count)
    shift = distance * np.array([1.0, -0.7, 0.4])
    gaussians.means[:] = single(gaussians.means + shift)
    return gaussians, replace(camera, center=single(camera.center + shift))


for distance in ("1e4", "1e6"):
    name, recipe = f"coordinates offset by {distance}", partial(offset_by, distance=float(distance))
    FAMILIES[name] = Case(name, 37, 29, 1, count=30, recipe=recipe)


@cache
def cotangents_of(name) -> Cotangents:
    return Cotangents.random(FAMILIES[name])


@cache
def expected(name) -> tuple[dict, dict]:
    """Image and gradients by the reference."""
    case = FAMILIES[name]
    rendered = {plane: getattr(case.rendered, plane) for plane in PLANES}
    return rendered, reference_gradients(case, cotangents_of(name))


@cache
def allowed(name) -> tuple[dict, dict]:
    """Return the allowed error of float32: see the module's description."""
    case = FAMILIES[name]
    found = noise(case, cotangents_of(name), samples=SAMPLES if case.count < 1000 else 6)

    def bounds(noises, values):
        return {key: bound_of(case, noises[key], value) for key, value in values.items()}

    images, gradients = expected(name)
    return bounds(found.rendered, images), bounds(found.gradients, gradients)


def bound_of(case, noise, values) -> np.ndarray:
    """Return the bound of one result with its noise: see the module's description."""
    size = np.abs(values)
    rounding = noise + U * np.sqrt(1 + len(case.gaussians.means) / ROUNDINGS) * size
    return BOUND * rounding + UNDERFLOW * size.max(initial=0)


def errors_over_bounds(actual, wanted, bounds, precision, left_out=None) -> dict[str, float]:
    """The largest error over its bound, for each result; everything must be finite."""
    result = {}
    for key, value in wanted.items():
        assert np.isfinite(actual[key]).all() and np.isfinite(value).all(), key
        error = np.abs(actual[key] - value)
        if left_out is not None:
            error = np.where(left_out[..., None] if error.ndim == 3 else left_out, 0, error)
        bound = SCALES[precision] * bounds[key]
        if precision is FLOAT64:
            bound += EXACT * np.abs(value).max(initial=0)
        ratio = np.divide(error, bound, out=np.zeros_like(error), where=error > 0)
        result[key] = float(ratio.max(initial=0))
    return result


SCALES = {FLOAT32: 1.0, FLOAT64: 2 * 2.0**-29}
"""float64 has 2^-29 times the noise; the reference, which is as inexact, doubles it."""

EXACT = 1e-11
"""Error of the reference itself, relative to an array's largest value. It evaluates the textbook's
a dx^2 + 2 b dx dy + c dy^2, which loses as many digits as a needle's squared ratio of axes has."""
