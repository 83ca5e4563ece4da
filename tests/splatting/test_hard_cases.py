"""Hard inputs stay finite and as accurate as float32 can be: a picture and gradients for each.

Every family is rendered and differentiated in float64 and in float32 and compared with the
float64 reference (whose analytic gradients are compared with central differences in
``test_reference_splatting.py``, and for these families below).

In float32, every pixel and every single derivative may be wrong by

    30 (noise + 2^-24 sqrt(1 + n / 25) |value|)

where *noise* is what the problem's conditioning turns one rounding everywhere into (see
``conditioning.py``), and n the number of Gaussians. 30 is lambda sqrt(k): between two places
where the model rounds once, a kernel makes at most some k = 25 roundings (from quaternion and
scales to M, M M^T, its determinant and the factor of its inverse; from a pixel's offset to alpha;
in the sums over the 16 pixels of a micro-tile and the micro-tiles of a splat), and lambda = 6 is
exceeded with a probability of 3e-8 a number. A sum over n layers has n more.
"""

import dataclasses
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from support.conditioning import SAMPLES, U, noise
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Cotangents,
    assert_pictures_agree,
    bitwise,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    frame_adjoint,
    kernel_gradients,
    picture_of,
    plane_cotangents,
    reference_gaussians,
    reference_gradients,
    render,
    rows,
    single,
)

from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import rendering

ROUNDINGS = 25
BOUND = 6 * np.sqrt(ROUNDINGS)
UNDERFLOW = 1e-15
"""Of an array's largest value: what is smaller may be lost to products below 1e-38."""

PLANES = ("image", "alpha", "depth", "transmittance")


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


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
    slopes = (film - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points = np.column_stack([slopes * z[:, None], z])
    quats = rng.normal(0, 1, (n, 4)) if quats is None else np.broadcast_to(quats, (n, 4))
    return reference.Gaussians(
        means=single(points @ camera.rotation + camera.center),
        quats=single(quats),
        log_scales=single(np.log(scales)),
        logit_opacities=single(np.broadcast_to(logits, n)),
        sh0=single(rng.normal(0, 1, (n, 1, 3))),
        shN=single(rng.normal(0, sh_size, (n, (degree + 1) ** 2 - 1, 3))),
    )


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


def family(name, width=37, height=29, degree=1, count=16, **settings):
    """Register recipe(rng, width, height, degree, count) -> (Gaussians, camera) as a case."""

    def register(recipe):
        def seeded(seed, *arguments):
            return recipe(np.random.default_rng(seed), *arguments)

        FAMILIES[name] = Case(name, width, height, degree, count=count, recipe=seeded, **settings)
        return recipe

    return register


@family("means at, just before, just behind and far behind the near plane")
def near_plane(rng, width, height, degree, count):
    # An axis-aligned camera at the origin: z is the mean's own third coordinate, not rounded.
    camera = camera_for(width, height)
    near = np.float32(camera.near)
    above, below = np.nextafter(near, np.float32(1)), np.nextafter(near, np.float32(0))
    z = np.array([near, above, below, 0.99 * near, 0.5 * near, 1.01 * near])
    z = np.append(z, [1e-20, 0.0, -1e-20, -near, -1.0, -1e6])
    hard = splats(
        rng, camera, on_film(rng, camera, len(z)), z, 0.01, rng.normal(0, 1, len(z)), degree
    )
    hard.means[6:, :2] = single(rng.normal(0, 0.1, (len(z) - 6, 2)))
    return with_backdrop(rng, camera, hard), camera


@family("means at the camera centre")
def camera_center(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    hard = splats(
        rng,
        camera,
        on_film(rng, camera, 4),
        1.0,
        [[1e-3] * 3, [0.1] * 3, [10] * 3, [1e4] * 3],
        2.0,
        degree,
    )
    hard.means[:] = camera.center
    hard.means[1] += 1e-7
    return with_backdrop(rng, camera, hard), camera


@family("far outside the frustum, reaching it")
def far_outside(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    size = np.array([width, height])
    beyond = np.array(
        [[-0.4, 0.5], [1.5, 0.4], [0.3, -1.5], [0.6, 2.5], [-2, -2], [4, 3], [9, 0.5], [-20, 8]]
    )
    distance = np.abs(beyond - np.clip(beyond, 0, 1)).max(axis=1) * max(width, height)
    z = rng.uniform(1, 4, len(beyond))
    sizes = distance[:, None] * rng.uniform(0.4, 0.8, (len(beyond), 3))
    hard = splats(rng, camera, beyond * size, z, sizes * z[:, None] / camera.fx, 1.0, degree)
    return with_backdrop(rng, camera, hard), camera


@family("89 degrees off axis", threshold_width=1e-3)
def off_axis(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    angle = np.deg2rad([60, 75, 85, 89, 89, 89.9])
    turn = rng.uniform(0, 2 * np.pi, len(angle))
    slopes = np.tan(angle)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    film = slopes * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    z = np.linspace(0.5, 0.6, len(angle))
    sizes = np.linalg.norm(film, axis=1) / 2.5
    hard = splats(rng, camera, film, z, (sizes * z)[:, None] / camera.fx, 0.5, degree)
    return with_backdrop(rng, camera, hard), camera


@family("needles of ratio 1e6", count=40)
def needles(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    z = rng.uniform(1, 4, count)
    long = 10.0 ** rng.uniform(-1, 1, count)
    scales = long[:, None] * [1, 1e-6, 1e-6]
    hard = splats(
        rng, camera, on_film(rng, camera, count, 0.3), z, scales, rng.normal(1, 1, count), degree
    )
    return with_backdrop(rng, camera, hard), camera


@family("needles along the line of sight", count=10)
def needles_end_on(rng, width, height, degree, count):
    camera = camera_for(width, height)
    film = on_film(rng, camera, count)
    film[0] = [camera.cx, camera.cy]
    hard = splats(rng, camera, film, 2.0, [1e-6, 1e-6, 1.0], 1.0, degree, quats=[1, 0, 0, 0])
    return with_backdrop(rng, camera, hard), camera


@family("disks of ratio 1e6", count=20)
def disks(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    z = rng.uniform(1, 4, count)
    size = 10.0 ** rng.uniform(-2, 0, count)
    hard = splats(
        rng,
        camera,
        on_film(rng, camera, count),
        z,
        size[:, None] * [1, 1, 1e-6],
        rng.normal(1, 1, count),
        degree,
    )
    return with_backdrop(rng, camera, hard), camera


@family("disks edge-on and face-on", count=20)
def disks_aligned(rng, width, height, degree, count):
    camera = camera_for(width, height)
    film = on_film(rng, camera, count)
    quats = np.where(
        np.arange(count)[:, None] % 2, [np.sqrt(0.5), np.sqrt(0.5), 0, 0], [1, 0, 0, 0]
    )
    hard = splats(rng, camera, film, 2.0, [0.3, 0.3, 1e-6], 0.5, degree, quats=quats)
    return with_backdrop(rng, camera, hard), camera


def points_of(rng, width, height, degree, count, scale):
    camera = camera_for(width, height, rng)
    film = on_film(rng, camera, count)
    film[: count // 4] = np.floor(film[: count // 4]) + 0.5
    film[count // 4 : count // 2] = np.floor(film[count // 4 : count // 2])
    hard = splats(
        rng, camera, film, rng.uniform(1, 4, count), scale, rng.normal(1, 1, count), degree
    )
    return with_backdrop(rng, camera, hard), camera


for size, name, antialiased_name in [
    (1e-8, "points of scale 1e-8", "points of scale 1e-8, antialiased"),
    (1e-25, "scales of 1e-25, whose determinant underflows", "scales of 1e-25, antialiased"),
]:
    family(name, count=24)(partial(points_of, scale=size))
    family(antialiased_name, count=24, antialiased=True)(partial(points_of, scale=size))
family("a needle whose minor axis underflows", count=12, antialiased=True)(
    partial(points_of, scale=[1e-2, 1e-22, 1e-22])
)


@family("sub-pixel splats, antialiased", count=30, antialiased=True)
@family("sub-pixel splats", count=30)
def sub_pixel(rng, width, height, degree, count):
    return points_of(rng, width, height, degree, count, 10.0 ** rng.uniform(-3.5, -1.5, (count, 3)))


def giants_of(rng, width, height, degree, count, scale):
    camera = camera_for(width, height, rng)
    film = on_film(rng, camera, count, 0.5)
    z = 10.0 ** rng.uniform(-0.5, 1, count)
    hard = splats(rng, camera, film, z, scale, rng.normal(-2, 1, count), degree)
    return with_backdrop(rng, camera, hard), camera


for size, name, antialiased_name in [
    (1e4, "giants: scales of 1e4 around the camera", "giants, antialiased"),
    (1e10, "giants of 1e10, whose determinant overflows", "giants of 1e10, antialiased"),
]:
    family(name, count=8)(partial(giants_of, scale=size))
    family(antialiased_name, count=8, antialiased=True)(partial(giants_of, scale=size))


@family("giants that are needles, far away", count=8)
def giants_far(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    hard = splats(
        rng,
        camera,
        on_film(rng, camera, count),
        rng.uniform(1e4, 2e4, count),
        [1e4, 1e2, 1e1],
        rng.normal(-1, 1, count),
        degree,
    )
    return with_backdrop(rng, camera, hard), camera


@family("opacity logits of +-40 and more", count=24)
def logits(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    values = np.resize([40.0, -40.0, 100.0, -100.0, 20.0, -5.0, 0.0, 1e4, -1e4], count)
    z = rng.uniform(1, 4, count)
    sizes = rng.uniform(0.02, 0.1, (count, 3)) * width
    hard = splats(
        rng, camera, on_film(rng, camera, count), z, sizes * z[:, None] / camera.fx, values, degree
    )
    return with_backdrop(rng, camera, hard), camera


def stack_of(rng, width, height, degree, count, logits, spread=0.3, sizes=(0.4, 0.9)):
    camera = camera_for(width, height, rng)
    film = [0.5 * width, 0.5 * height] + rng.normal(0, spread, (count, 2)) * width
    z = np.sort(rng.uniform(1, 4, count))
    sizes = rng.uniform(*sizes, (count, 3)) * width
    return splats(rng, camera, film, z, sizes * z[:, None] / camera.fx, logits, degree), camera


@family("hundreds of near-opaque layers", 13, 11, count=300)
def opaque_stack(rng, width, height, degree, count):
    return stack_of(rng, width, height, degree, count, rng.uniform(2, 8, count))


@family("hundreds of half-transparent layers, transmittance 1e-30", 13, 11, count=400)
def transmittance_stack(rng, width, height, degree, count):
    return stack_of(rng, width, height, degree, count, rng.normal(-1.7, 0.3, count))


@family("thousands of layers just above the cut", 7, 6, degree=0, count=2500)
def above_the_cut(rng, width, height, degree, count):
    logit = np.log(1.02 / (255 - 1.02))
    return stack_of(rng, width, height, degree, count, logit, 0.05, (8, 12))


@family("thousands of layers just above and below the cut", 7, 6, degree=0, count=3000)
def around_the_cut(rng, width, height, degree, count):
    alpha = np.where(rng.random(count) < 0.5, 1.01, 0.99) / 255
    return stack_of(rng, width, height, degree, count, np.log(alpha / (1 - alpha)), 0.01, (40, 60))


@family("equal depths", count=60)
def equal_depths(rng, width, height, degree, count):
    camera = camera_for(width, height)
    hard = splats(
        rng,
        camera,
        on_film(rng, camera, count),
        2.0,
        rng.uniform(0.03, 0.15, (count, 3)),
        rng.normal(1, 1, count),
        degree,
    )
    return hard, camera


@family("depths that differ in the last bit", count=60)
def last_bit_depths(rng, width, height, degree, count):
    camera = camera_for(width, height)
    z = 2.0 + rng.permutation(count) * np.spacing(np.float32(2.0)).astype(float)
    hard = splats(
        rng,
        camera,
        on_film(rng, camera, count),
        z,
        rng.uniform(0.03, 0.15, (count, 3)),
        rng.normal(1, 1, count),
        degree,
    )
    return hard, camera


@family("quaternions of norm 0, 1e-20, 1e20 and negated", count=30)
def quaternions(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    z = rng.uniform(1, 4, count)
    sizes = rng.uniform(0.02, 0.15, (count, 3)) * width
    quats = rng.normal(0, 1, (count, 4))
    quats *= np.resize([0, 1e-20, 1e20, -1, 1e-30, 1e30], count)[:, None]
    quats[-3:] = [[1, 0, 0, 0], [0, -1, 0, 0], [1e-20, 1e20, 0, 1]]
    hard = splats(
        rng,
        camera,
        on_film(rng, camera, count),
        z,
        sizes * z[:, None] / camera.fx,
        1.0,
        degree,
        quats,
    )
    return with_backdrop(rng, camera, hard), camera


@family("SH that drive colour negative", degree=3, count=40)
def negative_colors(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    z = rng.uniform(1, 4, count)
    sizes = rng.uniform(0.03, 0.1, (count, 3)) * width
    hard = splats(
        rng,
        camera,
        on_film(rng, camera, count),
        z,
        sizes * z[:, None] / camera.fx,
        1.0,
        degree,
        sh_size=1.0,
    )
    hard.sh0[:] = single(rng.normal(-1.5, 2, hard.sh0.shape))
    return hard, camera


def ordinary(rng, width, height, degree, count, **changes):
    camera = camera_for(width, height, rng, **changes)
    none = splats(rng, camera, np.zeros((0, 2)), 1.0, 1.0, 0.0, degree)
    return with_backdrop(rng, camera, none, count), camera


for size in [(1, 1), (1, 40), (40, 1), (2, 17), (17, 33), (16, 16), (3, 5)]:
    family(f"a film of {size[0]}x{size[1]}", *size, count=30)(ordinary)


@family("a principal point on the film's corner", count=30)
def corner_principal(rng, width, height, degree, count):
    return ordinary(rng, width, height, degree, count, cx=0.0, cy=float(height))


@family("a principal point outside the film", count=30)
def outside_principal(rng, width, height, degree, count):
    return ordinary(rng, width, height, degree, count, cx=-3.0 * width, cy=2.5 * height)


@family("no visible Gaussian", count=0)
def none_visible(rng, width, height, degree, count):
    camera = camera_for(width, height, rng)
    z = np.array([-1.0, -5.0, 2.0])
    hard = splats(rng, camera, [[5, 5], [9, 9], [1e4, 1e4]], z, 0.01, 1.0, degree)
    return hard, camera


@family("one Gaussian", count=1)
def one(rng, width, height, degree, count):
    return ordinary(rng, width, height, degree, count)


def offset_by(rng, width, height, degree, count, distance):
    """The scene and the camera together; means are rounded there, then given exactly."""
    gaussians, camera = ordinary(rng, width, height, degree, count)
    shift = distance * np.array([1.0, -0.7, 0.4])
    camera = replace(camera, center=single(camera.center + shift))
    gaussians.means[:] = single(gaussians.means + shift)
    return gaussians, camera


@family("coordinates offset by 1e4", count=30)
def offset_1e4(rng, width, height, degree, count):
    return offset_by(rng, width, height, degree, count, 1e4)


@family("coordinates offset by 1e6", count=30)
def offset_1e6(rng, width, height, degree, count):
    return offset_by(rng, width, height, degree, count, 1e6)


all_families = pytest.mark.parametrize("name", FAMILIES)


# ----------------------------------------------------------------------------------------------
# Picture and gradients of every family
# ----------------------------------------------------------------------------------------------


@cache
def cotangents_of(name) -> Cotangents:
    return Cotangents.random(FAMILIES[name])


@cache
def expected(name) -> tuple[dict, dict]:
    """Picture and gradients by the reference."""
    case = FAMILIES[name]
    picture = {plane: getattr(case.picture, plane) for plane in PLANES}
    return picture, reference_gradients(case, cotangents_of(name))


@cache
def allowed(name) -> tuple[dict, dict]:
    """What float32 may be off by: see the module's description."""
    case = FAMILIES[name]
    found = noise(case, cotangents_of(name), samples=SAMPLES if case.count < 1000 else 6)

    def bounds(noises, values):
        return {key: bound_of(case, noises[key], value) for key, value in values.items()}

    pictures, gradients = expected(name)
    return bounds(found.picture, pictures), bounds(found.gradients, gradients)


def bound_of(case, noise, values) -> np.ndarray:
    """Of one result with its noise: see the module's description."""
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
"""Of an array's largest value: what the reference itself may be off by. It evaluates the textbook's
a dx^2 + 2 b dx dy + c dy^2, which loses as many digits as a needle's squared ratio of axes has."""


@both_precisions
@all_families
def test_picture_and_gradients_are_within_the_bound(precision, name):
    case = FAMILIES[name]
    picture_bounds, gradient_bounds = allowed(name)
    picture, gradients = expected(name)
    marked = case.picture.near_threshold
    assert marked.sum() <= max(2, 0.01 * marked.size)
    _, frame = render(case, precision)
    ratios = errors_over_bounds(picture_of(frame, case), picture, picture_bounds, precision, marked)
    actual = kernel_gradients(case, precision, cotangents_of(name))
    ratios |= errors_over_bounds(actual, gradients, gradient_bounds, precision)
    assert max(ratios.values()) <= 1, ratios


def test_the_bounds_are_tight():
    """A bound that allows anything proves nothing: most families have five digits or more."""
    relative = []
    for name in FAMILIES:
        bounds, values = allowed(name)[0]["image"], expected(name)[0]["image"]
        relative.append(bounds.max() / max(np.abs(values).max(), 1e-300))
    assert np.median(relative) < 2e-5 and max(relative) < 1e-2, sorted(relative)


def test_textbook_formulas_exceed_the_bound_where_the_stable_ones_do_not():
    """The conic by xx yy - xy^2 in float32 loses needles: the bound tells the two apart."""
    case = FAMILIES["needles of ratio 1e6"]
    affine = reference._local_affine(case.gaussians, case.camera)
    M = affine.axes2d.astype(np.float32)
    low_pass = np.float32(0.3) * np.eye(2, dtype=np.float32)
    cov2d = M @ np.swapaxes(M, 1, 2) + low_pass
    a, b, c = cov2d[:, 0, 0], cov2d[:, 0, 1], cov2d[:, 1, 1]
    conics = np.stack([np.stack([c, -b], -1), np.stack([-b, a], -1)], -2)
    conics = conics / (a * c - b * b)[:, None, None]
    splats2d = reference.project(case.gaussians, case.camera)
    colors = reference.sh_colors(case.gaussians, case.camera, case.degree)
    picture = reference.composite(
        splats2d.means2d, conics, splats2d.opacities, colors, splats2d.depths, splats2d.visible,
        case.background, case.width, case.height,
    )  # fmt: skip
    error = np.abs(picture.image - case.picture.image)
    assert (error > allowed(case.name)[0]["image"]).mean() > 0.05


@all_families
def test_reference_gradient_is_the_slope_of_the_reference(name):
    """Central differences along a random direction of all parameters.

    Means move parallel to the film where depths are tied or a mean is at the near plane: a
    change of order or visibility has no derivative.
    """
    case = FAMILIES[name]
    cotangents, (_, gradients) = cotangents_of(name), expected(name)
    gaussians, camera = case.gaussians, case.camera
    rng = np.random.default_rng(3)
    step = 2.0**-20
    z = (gaussians.means - camera.center) @ camera.rotation[2]
    film = rng.normal(0, 1, (len(z), 3)) * np.maximum(np.abs(z), camera.near)[:, None] / camera.fx
    gaps = np.abs(np.subtract.outer(z, z)) + np.where(np.eye(len(z)), np.inf, 0)
    tied = (gaps.min(axis=1, initial=np.inf) < 100 * step) | (np.abs(z - camera.near) < 0.02)
    film[:, 2] *= np.where(tied, 0, 1)
    norms = np.linalg.norm(gaussians.quats, axis=1)
    direction = {
        "means": film @ camera.rotation,
        "quats": rng.normal(0, 0.1, (len(z), 4)) * norms[:, None],
        "log_scales": rng.normal(0, 0.1, (len(z), 3)),
        "logit_opacities": rng.normal(0, 0.1, len(z)),
        "sh0": rng.normal(0, 0.1, gaussians.sh0.shape),
        "shN": rng.normal(0, 0.1, gaussians.shN.shape),
    }  # fmt: skip

    def moved(sign):
        return {key: getattr(gaussians, key) + sign * step * d for key, d in direction.items()}

    def loss(fields):
        picture = reference.render(
            reference.Gaussians(**fields), camera, case.background, case.rendered_degree,
            case.antialiased,
        )  # fmt: skip
        pairs = [
            (cotangents.d_image, picture.image),
            (cotangents.d_alpha, picture.alpha),
            (cotangents.d_depth, picture.depth),
        ]
        return np.concatenate([np.ravel(weights * values) for weights, values in pairs])

    fields, fields_before = moved(1), moved(-1)
    after, before = loss(fields), loss(fields_before)
    slope = np.sum(after - before) / (2 * step)
    # What the parameters did move by: far from the origin, means cannot move by any amount.
    terms = [gradients[key] * (fields[key] - fields_before[key]) / (2 * step) for key in direction]
    analytic = sum(term.sum() for term in terms)
    size = np.sqrt(sum((term**2).sum() for term in terms))
    # step^2 = 1e-12 times third derivatives of some 1e3 to 1e5, and roundings of the loss's terms,
    # one for each layer.
    rounding = 2.0**-53 * np.sqrt(len(z) * np.sum(after**2)) / step
    assert abs(slope - analytic) <= 1e-6 * size + 6 * rounding


# ----------------------------------------------------------------------------------------------
# Families that need a statement of their own
# ----------------------------------------------------------------------------------------------


def test_means_at_the_near_plane_are_drawn_and_nearer_ones_are_not():
    case = FAMILIES["means at, just before, just behind and far behind the near plane"]
    visible = [True, True, False, False, False, True] + [False] * 6
    assert (
        reference.project(case.gaussians, case.camera).visible[: len(visible)].tolist() == visible
    )
    for precision in (FLOAT64, FLOAT32):
        gradients = kernel_gradients(case, precision, cotangents_of(case.name))
        moved = np.abs(gradients["means"]).max(axis=1) > 0
        assert not (moved[: len(visible)] & ~np.array(visible)).any()
        assert moved[[0, 1]].any()


@both_precisions
def test_negated_quaternions_give_the_same_bytes(precision):
    case = FAMILIES["needles of ratio 1e6"]
    gaussians = device_gaussians(case.gaussians, precision)
    negated = replace(case.gaussians, quats=-case.gaussians.quats)
    camera = device_camera(case.camera, precision)
    frames = [
        rendering.render(g, camera, case.pipeline)
        for g in (gaussians, device_gaussians(negated, precision))
    ]
    assert bitwise(frames[0].planes()) == bitwise(frames[1].planes())


@both_precisions
def test_a_quaternion_of_norm_zero_is_the_identity_and_has_no_gradient(precision):
    case = FAMILIES["quaternions of norm 0, 1e-20, 1e20 and negated"]
    zero = ~case.gaussians.quats.any(axis=1)
    assert zero.sum() >= 4
    gradients = kernel_gradients(case, precision, cotangents_of(case.name))
    assert not gradients["quats"][zero].any() and gradients["log_scales"][zero].any()


@both_precisions
def test_an_empty_view_is_the_background_and_has_no_gradient(precision):
    case = FAMILIES["no visible Gaussian"]
    _, frame = render(case, precision)
    picture = picture_of(frame, case)
    assert (picture["transmittance"] == 1).all() and not picture["depth"].any()
    gradients = kernel_gradients(case, precision, cotangents_of(case.name))
    del gradients["background"]
    assert not any(value.any() for value in gradients.values())


@both_precisions
def test_a_million_gaussians_in_one_pixel(precision):
    """The pixel stops after some 2,130 layers of alpha 1.1 / 255: the nearest 3,000 are all.

    The others are equally visible, but the pixel is finished: their gradient is zero.
    """
    count, near = 1_000_000, 3000
    rng = np.random.default_rng(0)
    camera = camera_for(20, 18)
    alpha = 1.2 / 255
    z = single(rng.permutation(count) * 2e-6 + 1)
    logit = np.log(alpha / (1 - alpha))
    gaussians = splats(rng, camera, np.full((count, 2), [9.6, 9.3]), z, 1e-4, logit, 0)
    first = np.sort(np.argsort(gaussians.means[:, 2], kind="stable")[:near])
    nearest = reference.Gaussians(*(value[first] for value in vars(gaussians).values()))
    case = Case("a million", 20, 18, 0, count=count, recipe=lambda *_: (gaussians, camera))
    small = replace(case, name="3,000 of a million", recipe=lambda *_: (nearest, camera))
    assert not small.picture.near_threshold.any()
    assert 0.9e-4 < small.picture.transmittance.min() < 1.1e-4
    cotangents = Cotangents.random(small)
    actual_picture = picture_of(render(case, precision)[1], case)
    actual = kernel_gradients(case, precision, cotangents)
    wanted = reference_gradients(small, cotangents)
    # sqrt(2,130 layers) roundings, with lambda = 6, of sums that cancel: 1e-16 and 2e-5.
    tolerance = {FLOAT64: 1e-11, FLOAT32: 5e-5}[precision]
    for plane in PLANES:
        values = getattr(small.picture, plane)
        assert np.abs(actual_picture[plane] - values).max() <= tolerance * np.abs(values).max()
    rest = np.delete(np.arange(count), first)
    for key in ("means", "log_scales", "logit_opacities", "sh0"):
        assert not actual[key][rest].any(), key
        error = np.abs(actual[key][first] - wanted[key]).max()
        assert error <= tolerance * np.abs(wanted[key]).max(), key


@both_precisions
@pytest.mark.parametrize(
    "name",
    ["needles of ratio 1e6", "giants: scales of 1e4 around the camera", "89 degrees off axis"],
)
def test_crop_windows_are_parts_of_the_whole(precision, name):
    """Each piece, drawn by itself, is within the bound of the whole."""
    case = FAMILIES[name]
    bounds, wanted = allowed(name)[0]["image"], case.picture.image
    gaussians = device_gaussians(case.gaussians, precision)
    whole = device_camera(case.camera, precision)
    for x, y, width, height in [(0, 0, 17, 29), (17, 0, 20, 11), (17, 11, 20, 18)]:
        start = type(whole.film_start)(-x, -y)
        crop = dataclasses.replace(
            whole,
            principal=whole.principal + start,
            film_start=whole.film_start + start,
            film_end=whole.film_end + start,
            width=width,
            height=height,
        )
        frame = rendering.render(gaussians, crop, case.pipeline)
        planes = [rows(plane).reshape(height, width) for plane in frame.planes()]
        image = np.stack(planes[1:4], axis=-1) + planes[0][..., None] * case.background
        part = np.s_[y : y + height, x : x + width]
        marked = case.picture.near_threshold[part]
        ratios = errors_over_bounds(
            {"image": image}, {"image": wanted[part]}, {"image": bounds[part]}, precision, marked
        )
        assert ratios["image"] <= 1, ratios


# ----------------------------------------------------------------------------------------------
# Ordinary scenes
# ----------------------------------------------------------------------------------------------


def bench_scene(seed, width, height, degree, count):
    return reference_gaussians(bench_gaussians(count, seed)), bench_camera(width)


ORDINARY = [
    Case("bench scene", 400, 400, 3, count=10_000, recipe=bench_scene),
    Case("splats of all sizes, antialiased", 200, 150, 1, count=10_000, antialiased=True),
]


@pytest.mark.parametrize("case", ORDINARY, ids=lambda case: case.name)
def test_ten_thousand_ordinary_gaussians_in_float32(case):
    """Pictures within 2e-5 of the reference, gradients within 1e-4, cosines above 0.99999.

    A mean at 400 px carries 3 roundings of 2.4e-5 px or less, of either sign, and alpha changes by
    at most 1.1 per px: some 1e-5 in a pixel that a dozen splats share. Measured 1.9e-5 and 1.9e-5.
    Pixels near a threshold may flip, at most 1e-4 of them.
    """
    cotangents = Cotangents.random(case)
    picture = picture_of(render(case, FLOAT32)[1], case)
    assert_pictures_agree(picture, case.picture, 2e-5)
    actual = kernel_gradients(case, FLOAT32, cotangents)
    for name, wanted in reference_gradients(case, cotangents).items():
        error = np.abs(actual[name] - wanted).max()
        assert error <= 1e-4 * np.abs(wanted).max(), name
        # A background's three numbers, say: a product of norms in float64 throughout.
        found = actual[name].astype(np.float64)
        cosine = np.sum(found * wanted) / np.linalg.norm(found) / np.linalg.norm(wanted)
        assert cosine > 0.99999, name


# ----------------------------------------------------------------------------------------------
# Rows that are not finite
# ----------------------------------------------------------------------------------------------

NOT_FINITE = Case("not finite", 21, 18, 1, count=30)
INFINITE_BUT_MEANINGFUL = {
    ("log_scales", -np.inf): "a scale of 0: a point, which the low-pass makes a pixel wide",
    ("logit_opacities", np.inf): "an opacity of 1",
    ("sh0", -np.inf): "a colour of 0",
    ("shN", -np.inf): "a colour of 0, or of infinity, which is dropped",
    ("shN", np.inf): "the same, by the sign of the basis",
}


def planes_and_gradients(gaussians, case, precision):
    device = device_gaussians(gaussians, precision)
    frame = rendering.render(device, device_camera(case.camera, precision), case.pipeline)
    gradients = frame_adjoint(
        device, frame, *plane_cotangents(case, Cotangents.random(case), precision)
    )
    planes = [np.array(plane) for plane in frame.planes()]
    return planes, vars(reference_gaussians(gradients.parameters))


@both_precisions
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_a_number_that_is_not_finite_reaches_no_other_row(precision, antialiased, value, name):
    """The row is dropped: the picture and all other gradients are, bit by bit, those without it."""
    case = clear(replace(NOT_FINITE, antialiased=antialiased))
    row = most_important_row(case)
    spoiled = {key: getattr(case.gaussians, key).copy() for key in PARAMETER_NAMES}
    spoiled[name].reshape(len(spoiled[name]), -1)[row, 0] = value
    planes, gradients = planes_and_gradients(reference.Gaussians(**spoiled), case, precision)
    assert all(np.isfinite(plane).all() for plane in planes)
    assert all(np.isfinite(gradient).all() for gradient in gradients.values())
    if (name, value) in INFINITE_BUT_MEANINGFUL:
        return
    without = {key: np.delete(array, row, 0) for key, array in vars(case.gaussians).items()}
    expected_planes, expected_gradients = planes_and_gradients(
        reference.Gaussians(**without), case, precision
    )
    assert bitwise(planes) == bitwise(expected_planes)
    for key, gradient in gradients.items():
        assert not gradient[row].any(), key
        np.testing.assert_array_equal(np.delete(gradient, row, 0), expected_gradients[key], key)


@cache
def most_important_row(case) -> int:
    gradients = reference_gradients(case, Cotangents.random(case))
    return int(np.argmax(np.abs(gradients["logit_opacities"])))


@both_precisions
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("log_scales", -np.inf),
        ("logit_opacities", np.inf),
        ("sh0", -np.inf),
    ],
)
def test_infinities_that_mean_something_are_drawn_as_that(precision, name, value):
    """The limit of large numbers: the picture is that of -1e4 (or 1e4), to the last bit."""
    case = clear(NOT_FINITE)
    row = most_important_row(case)
    pictures = []
    for number in (value, np.sign(value) * 1e4):
        fields = {key: getattr(case.gaussians, key).copy() for key in PARAMETER_NAMES}
        fields[name].reshape(len(fields[name]), -1)[row, :] = number
        pictures.append(planes_and_gradients(reference.Gaussians(**fields), case, precision)[0])
    assert bitwise(pictures[0]) == bitwise(pictures[1])
    without = {key: np.delete(array, row, 0) for key, array in vars(case.gaussians).items()}
    dropped = planes_and_gradients(reference.Gaussians(**without), case, precision)[0]
    assert bitwise(pictures[0]) != bitwise(dropped)
