"""The cases on which the laws of rendering are checked, and their references.

A new scene, lens, effect or approximation is one line of a table.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.cameras.motion import MotionBlur, RollingShutter
from drgs.core.arrays import types_of
from drgs.reference import splatting as reference
from drgs.testing import Case, Values, adjoint_is_transpose, bytes_are_reproducible, single
from support import helpers, lenses, reference_effects
from support.helpers import NEAR_THRESHOLD
from support.lens_scenes import (
    FOCAL,
    LENSES,
    gaussians_at_points,
    kernel_lens,
    point_beyond_lens_limit,
    points_at,
    rolling_image,
    row_time,
    seen_points,
)
from support.studies import reference_rays as rays

MOTION_SAMPLES = 3
PINHOLE = lenses.Pinhole()


# ----------------------------------------------------------------------------------------------
# References
# ----------------------------------------------------------------------------------------------


def reference_camera(case) -> reference.Camera:
    (rotation, center), K = case.pose, case.K
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    return reference.Camera(rotation, center, fx, fy, cx, cy, case.width, case.height, 0.25)


def planes_of(rendered) -> tuple[np.ndarray, np.ndarray]:
    images = [rendered.transmittance, *np.moveaxis(rendered.image, -1, 0), rendered.depth]
    return np.reshape(images, (5, -1)), rendered.near_threshold.ravel()


def by_rays(case, values):
    """Approximations of a pinhole's image; the depth of other orders is the peaks'."""
    given = {k: v for k, v in case.approximations.items() if k in MODEL_FIELDS}
    model = rays.ImageModel(**given, sh_degree=case.degree)
    image = partial(rays.render, camera=reference_camera(case), model=model)
    planes, marked = planes_of(image(reference.Gaussians(**values), threshold_width=NEAR_THRESHOLD))
    return planes if model.order == "center" else planes[:4], marked


MODEL_FIELDS = set(rays.ImageModel.__dataclass_fields__)


def by_effects(case, values, lens=PINHOLE):
    """Lenses, with an aperture and a smoothing filter."""
    gaussians = reference.Gaussians(**values)
    if case.smoothing is not None:
        gaussians = smoothed_reference(gaussians, np.full(case.count, case.smoothing))
    camera, antialiased = reference_camera(case), case.approximations.get("antialiased", False)
    settings = lens, antialiased, case.degree, NEAR_THRESHOLD
    if case.aperture is not None:
        defocus = reference_effects.ThinLens(*case.aperture)
        return planes_of(reference_effects.render_defocused(gaussians, camera, defocus, *settings))
    lens, *others = settings
    return planes_of(lenses.render(gaussians, camera, lens, np.zeros(3), *others))


def rates_of(smoothing) -> np.ndarray:
    """The sampling rates that call for a filter: its variance is 0.2 / rate^2."""
    return np.sqrt(0.2) / smoothing


def smoothed_reference(gaussians: reference.Gaussians, smoothing) -> reference.Gaussians:
    """Gaussians whose parameters hold the filter."""
    scales, opacities = reference_effects.smoothing_filter(
        gaussians.log_scales, gaussians.logit_opacities, rates_of(smoothing)
    )
    logits = np.log(opacities) - np.log1p(-opacities)
    return replace(gaussians, log_scales=np.log(scales), logit_opacities=logits)


TRAVEL, TURN = np.array([0.125, -0.0625, 0.03125]), np.array([0.03125, 0.0625, -0.09375])


def close_camera(camera, travel=TRAVEL, turn=TURN) -> reference.Camera:
    """The camera when the shutter closes: moved by travel (world), turned by turn (camera axes)."""
    rotation = Rotation.from_rotvec(turn).as_matrix() @ camera.rotation
    return replace(camera, rotation=rotation, center=camera.center + travel)


def shutter(kind, *arguments, travel=TRAVEL, turn=TURN):
    """Make the shutter of a camera."""

    def make(camera):
        Array3f = types_of(type(camera.near)).Array3f
        return kind(Array3f(*map(float, travel)), Array3f(*map(float, turn)), *arguments)

    return make


def by_motion(case, values, lens=PINHOLE):
    camera = reference_camera(case)
    return planes_of(
        reference_effects.render_motion_blur(
            reference.Gaussians(**values), camera, close_camera(camera), MOTION_SAMPLES,
            np.zeros(3), lens, NEAR_THRESHOLD,
        )
    )  # fmt: skip


def by_rows(case, values, lens=PINHOLE):
    """A rolling shutter: each splat as a whole at the time when the row of its mean is read."""
    camera = reference_camera(case)
    camera_at = partial(reference_effects.camera_at, camera, close_camera(camera))
    gaussians = reference.Gaussians(**values)
    return planes_of(rolling_image(gaussians, camera_at, lens, case.degree, NEAR_THRESHOLD))


def by_lens_rays(case, values, lens=PINHOLE):
    """The peaks along each pixel's ray, at its row's time if the shutter rolls."""
    first, gaussians = reference_camera(case), reference.Gaussians(**values)
    last = first if case.shutter is None else close_camera(first)
    camera_at = partial(reference_effects.camera_at, first, last)
    y = np.arange(case.height) + 0.5
    rows = [lens_rays(lens, camera_at(each / case.height), each) for each in y]
    times = [row_time(camera_at, lens, mean)[0] for mean in gaussians.means]
    if case.shutter is None:
        times = [0.0] * case.count
    each = [splat_of(lens, camera_at(time), gaussians, k) for k, time in enumerate(times)]
    kept = np.array([splat is not None for splat in each])
    splats = [splat for splat in each if splat is not None]
    colors, widening, depths = map(np.array, zip(*splats, strict=True))
    given = {k: v for k, v in case.approximations.items() if k in MODEL_FIELDS}
    model = rays.ImageModel(**given)
    shown = reference.Gaussians(*(array[kept] for array in vars(gaussians).values()))
    by_center = model.order == "center"
    centers = depths if by_center else None
    image = rays.render_along(
        shown, *map(np.array, zip(*rows, strict=True)), colors, widening * model.low_pass, centers,
        model=model, threshold_width=NEAR_THRESHOLD,
    )  # fmt: skip
    planes, marked = planes_of(image)
    marked = marked | at_end_of_lens(lens, first)
    return planes if by_center else planes[:4], marked


def at_end_of_lens(lens, camera) -> np.ndarray:
    """Pixels (H * W,) of which the lens shows a place nearby, or not all: kernels take 0.01 px."""
    film = reference.pixel_centers(camera.width, camera.height).reshape(-1, 2)
    outward = (film - camera.principal) / np.linalg.norm(film - camera.principal, axis=1)[:, None]
    nearer, farther = (
        np.isnan(points_at(lens, camera, film + step * outward, np.ones(len(film)))).any(axis=1)
        for step in (-0.02, 0.02)
    )
    return nearer != farther


def lens_rays(lens, camera, y) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (W, 3), world, of a row of pixels; a depth of 1 along each."""
    film = np.column_stack([np.arange(camera.width) + 0.5, np.full(camera.width, y)])
    points = points_at(lens, camera, film, np.ones(len(film)))
    starts = points * [1, 1, 0] if isinstance(lens, lenses.Orthographic) else 0 * points
    # Not the transpose: a rotation rounded to single precision is orthogonal to 1e-7.
    to_world = np.linalg.inv(camera.rotation).T
    return starts @ to_world + camera.center, (points - starts) @ to_world


def splat_of(lens, camera, gaussians, k) -> tuple | None:
    """Colour, the covariance (3, 3) that a low-pass of 1 px^2 adds, and depth; None: not seen.

    The low-pass widens parallel to the film: with the derivatives x, y of the place and n of the
    depth, it is B B^T, [x y n]^T B = [e_x e_y].
    """
    one = reference.Gaussians(*(array[k : k + 1] for array in vars(gaussians).values()))
    point = (one.means - camera.center) @ camera.rotation.T
    if not lens.is_seen(camera, point)[0]:
        return None
    jacobian = lenses.jacobians(lens, camera, point)[0]
    depth = lens.depths(camera, point)
    by_z = not isinstance(lens, (lenses.Fisheye, lenses.Equirectangular))
    toward = np.array([0, 0, 1 / depth[0]]) if by_z else point[0] / depth**2
    added = np.linalg.inv(np.vstack([jacobian, toward]) @ camera.rotation)[:, :2]
    colors = lenses.sh_colors(one, camera, lens, one.sh_degree)
    return colors[0], added @ added.T, depth[0]


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


def splats_at(case, rng, film, z, sizes, logits) -> Values:
    """Gaussians at places (N, 2) px of a pinhole's film and depths z (N,), of sizes (N, 3) px."""
    camera = reference_camera(case)
    return vars(helpers.gaussians_on_film(rng, camera, film, z, sizes, logits, case.degree))


def edges(case, degree=None) -> Values:
    """Splats on and around the film, and eight that are hard."""
    rng, degree = np.random.default_rng(case.seed), case.degree if degree is None else degree
    return vars(helpers.scattered(rng, reference_camera(case), degree, case.count))


def stacked(case) -> Values:
    """Large, mostly opaque splats behind each other: pixels stop, and alphas are clamped."""
    rng = np.random.default_rng(case.seed)
    return vars(helpers.stacked(rng, reference_camera(case), case.degree, case.count))


def mixed(case) -> Values:
    """Every other one of the stacked splats is a few pixels small."""
    values = stacked(case)
    smaller = np.log(4) * (np.arange(case.count) % 2)
    return {**values, "log_scales": single(values["log_scales"] - smaller[:, None])}


def no_opacity(case) -> Values:
    """The opacity of two of the stacked splats underflows to zero."""
    values = stacked(case)
    return {**values, "logit_opacities": np.append([-np.inf, -900], values["logit_opacities"][2:])}


def in_the_middle(case) -> Values:
    """Equal splats behind each other in the middle of the film."""
    rng, n = np.random.default_rng(case.seed), case.count
    film, sizes = np.full((n, 2), case.width / 2), np.full((n, 3), 2.0)
    return splats_at(case, rng, film, np.linspace(2.0, 2.5, n), sizes, np.full(n, 2.0))


def thresholds() -> Case:
    """Alpha is the cut at one pixel, its maximum at another, and transmittance ends at the stop."""
    cases = [
        Case("thresholds", scene=in_the_middle, width=9, height=9, focal=8.0, count=n, degree=0)
        for n in (1, 2, 4)
    ]
    one, two = (case.planes(case.values)[0].reshape(9, 9) for case in cases[:2])
    cuts = {"alpha_cut": 1 - one[4, 5], "alpha_max": 1 - one[4, 4], "transmittance_stop": two[4, 5]}
    return replace(cases[2], approximations=cuts)


def close(case) -> Values:
    """Large splats that begin near the camera: the affine approximation is bad at them."""
    values, rng, (rotation, center) = stacked(case), np.random.default_rng(case.seed), case.pose
    points = (values["means"] - center) @ rotation.T
    points[:, :2] *= rng.uniform(0.3, 2.0, (case.count, 1))
    points *= rng.uniform(0.25, 1.0, (case.count, 1))
    return {
        **values,
        "means": single(points @ rotation + center),
        "log_scales": single(values["log_scales"] - rng.uniform(0.3, 2.0, (case.count, 3))),
        "logit_opacities": single(rng.normal(0.5, 1.2, case.count)),
    }


def needles(case) -> Values:
    """Needles that reach past the camera: rays meet their peaks before and behind it."""
    values, rng, (rotation, center) = close(case), np.random.default_rng(case.seed), case.pose
    tilt = Rotation.from_rotvec(rng.normal(0, 0.4, (case.count, 3)))
    quats = (Rotation.from_matrix(rotation.T) * tilt).as_quat(scalar_first=True)
    depths = (values["means"] - center) @ rotation[2]
    scales = rng.uniform([0.1, 0.1, 0.5], [0.3, 0.3, 1.5], (case.count, 3)) * depths[:, None]
    return {**values, "quats": single(quats), "log_scales": single(np.log(scales))}


def all_around(case) -> Values:
    """Splats in all directions: one at each pole, two at the seam, one as wide as the film."""
    rng, (rotation, center), n = np.random.default_rng(case.seed), case.pose, case.count
    points = rng.normal(size=(n, 3))
    points[:5] = [[0.1, 3, -0.2], [-0.1, -2, 0.05], [0.01, 0.3, -3], [-0.02, -1, -2], [1, 2, 0]]
    distances = np.linalg.norm(points, axis=1)
    sizes = rng.lognormal(np.log(0.15), 0.5, (n, 3)) * distances[:, None]
    sizes[4] *= 6
    shapes = {"sh0": (n, 1, 3), "shN": (n, (case.degree + 1) ** 2 - 1, 3)}
    return {
        "means": single(points @ rotation + center),
        "quats": single(rng.normal(size=(n, 4))),
        "log_scales": single(np.log(sizes)),
        "logit_opacities": single(rng.normal(0.5, 1.5, n)),
        **{k: single(rng.normal(0, 0.5, shape)) for k, shape in shapes.items()},
    }


def edges_behind(lens, case) -> Values:
    """Splats on and around the film of a lens, and ten that are hard.

    Straight behind the camera; nearer than the near plane; too transparent; four large ones far
    beyond each side of the film; one whose parameters are those of a fresh Gaussian; one on the
    axis; one beyond what the lens model is made for.
    """
    rng, camera, n = np.random.default_rng(case.seed), reference_camera(case), case.count
    size = np.array([case.width, case.height])
    film, distances = rng.uniform(-0.15, 1.15, (n, 2)) * size, rng.uniform(1.0, 4.0, n)
    sizes = np.minimum(rng.lognormal(np.log(1.5), 0.9, (n, 3)), 0.2 * max(size) + 1)
    logits = rng.normal(0.5, 1.7, n)
    distances[1], logits[2] = 0.1, -6.0
    film[1:3] = size * np.array([[0.3, 0.4], [0.6, 0.3]])
    film[3:7] = size * np.array([[-0.6, 0.5], [1.6, 0.4], [0.3, -0.6], [0.6, 1.6]])
    sizes[3:7], logits[3:7] = 0.3 * max(size), 2.0
    film[7], sizes[7], logits[7] = 0.4 * size, 2.0, 0.0
    film[8] = camera.cx, camera.cy
    points = seen_points(lens, camera, film, distances)
    points[0] = [0, 0, -1]
    beyond = point_beyond_lens_limit(lens)
    points[9] = beyond if beyond is not None else points[9]
    gaussians = gaussians_at_points(lens, rng, camera, points, sizes, logits, case.degree)
    gaussians.quats[7], gaussians.sh0[7] = [1, 0, 0, 0], 0
    return vars(gaussians)


def large_behind(lens, case) -> Values:
    """Splats as large as the film, most with their means beside it."""
    rng, camera, n = np.random.default_rng(case.seed), reference_camera(case), case.count
    size = np.array([case.width, case.height])
    film = rng.uniform(-0.4, 1.4, (n, 2)) * size
    points = seen_points(lens, camera, film, rng.uniform(1, 3, n))
    sizes, logits = rng.uniform(0.1, 0.8, (n, 3)) * max(size), rng.normal(-1.0, 1.0, n)
    return vars(gaussians_at_points(lens, rng, camera, points, sizes, logits, case.degree))


# ----------------------------------------------------------------------------------------------
# The matrix
# ----------------------------------------------------------------------------------------------

ALL_LENSES = {"pinhole": PINHOLE, **LENSES}


def with_lens(name, effect="lens", reference_of=by_effects, **options) -> Case:
    """A case with a lens of the reference and of the kernels."""
    lens = ALL_LENSES[name]
    options.setdefault("focal", FOCAL.get(type(lens), 26.0))
    if isinstance(lens, lenses.Equirectangular):
        options.setdefault("scene", all_around)
    if (effect, name) == ("rolling shutter", "panorama"):
        reference_of = None  # a mean may be in several rows: which one shows it is open
    found = reference_of and partial(reference_of, lens=lens)
    return Case(f"{effect}, {name}", kernel_lens(lens), reference=found, **options)


APPROXIMATIONS = {
    "exact": {"projection": "exact"},
    "unscented": {"projection": "unscented"},
    "pixel order": {"order": "pixel", "order_window": 8},
    "unscented, pixel order": {"projection": "unscented", "order": "pixel", "order_window": 8},
    "exact, pixel order": {"projection": "exact", "order": "pixel", "order_window": 8},
    "pixel colours": {"sh_direction": "pixel"},
    "all three": {
        "projection": "exact", "order": "pixel", "order_window": 8, "sh_direction": "pixel"
    },
    "all three, other cuts": {
        "projection": "exact", "order": "pixel", "order_window": 8, "sh_direction": "pixel",
        "alpha_max": 0.7, "alpha_cut": 0.03, "transmittance_stop": 0.05
    },
    "no cuts": {"alpha_cut": 0.0, "transmittance_stop": 0.0},
    "exact, no cuts": {"projection": "exact", "alpha_cut": 0.0, "transmittance_stop": 0.0},
    "other cuts": {"alpha_max": 0.7, "alpha_cut": 0.03, "transmittance_stop": 0.05},
    "3 sigma": {"extent": 3.0},
    "exact, 2 sigma": {"projection": "exact", "extent": 2.0},
    "wide low-pass": {"low_pass": 2.0},
    "no low-pass": {"low_pass": 0.0},
    "exact, no low-pass": {"projection": "exact", "low_pass": 0.0},
    "exact, antialiased": {"projection": "exact", "antialiased": True},
    "unscented, antialiased": {"projection": "unscented", "antialiased": True},
}  # fmt: skip

OF_LENSES = ("unscented", "pixel order", "pixel colours")
"""Approximations that render with all lenses."""

STEP = {"step": 1e-7}
"""Of differences without a reference, which marks the pixels whose order changes within a step."""

EFFECTS = {
    "no effect": (by_effects, {}),
    "antialiased": (by_effects, {"approximations": {"antialiased": True}}),
    "thin lens": (by_effects, {"aperture": (0.0625, 2.0)}),
    "smoothing": (by_effects, {"smoothing": 0.0625}),
    "motion blur": (by_motion, {"shutter": shutter(MotionBlur, MOTION_SAMPLES)}),
    "rolling shutter": (by_rows, {"shutter": shutter(RollingShutter), "count": 20}),
    "along rays": (by_lens_rays, {"approximations": {"projection": "exact"}}),
    "along rays, ordered": (
        by_lens_rays,
        {"approximations": {"projection": "exact", "order": "pixel", "order_window": 12}},
    ),
    "along rays, rolling shutter": (
        by_lens_rays,
        {
            "shutter": shutter(RollingShutter),
            "count": 20,
            "approximations": {"projection": "exact"},
        },
    ),
    **{name: (None, {"approximations": APPROXIMATIONS[name], **STEP}) for name in OF_LENSES},
}

NO_SENSOR = "in focus by z in kernels, by distance in the reference; no sensor has both"
FEWER_TERMS = "rational, or fisheye, without some terms"
HOLES = {
    ("thin lens", "orthographic"): "parallel rays meet in no aperture",
    **{
        (effect, name): FEWER_TERMS
        for effect in ("along rays", "along rays, ordered", "along rays, rolling shutter")
        for name in ("radial", "tangential", "fox", "plain fisheye")
    },
    **{
        ("thin lens", name): NO_SENSOR
        for name in ("plain fisheye", "fisheye", "thin prism", "panorama")
    },
}
"""Cells of the matrix without a case, and the reason."""

SCENES = {
    "edges": Case("", scene=edges, degree=3, seed=1),
    "one pixel": Case("", scene=edges, width=1, height=1, count=12),
    "5 x 3": Case("", scene=edges, width=5, height=3, focal=5.0, count=25, degree=0, seed=1),
    "whole tiles": Case(
        "", scene=edges, width=64, height=48, focal=60.0, count=80, degree=2, seed=1
    ),
    "many": Case("", scene=edges, width=40, height=40, count=300, degree=0, seed=2),
    "one splat": Case("", width=20, height=20, count=1, degree=0),
    "degree 1 of 3": Case("", scene=partial(edges, degree=3), width=70, height=18, focal=60.0),
    "stacked": Case("", scene=stacked, degree=2),
    "close": Case("", scene=close, width=40, height=23, focal=20.0, count=20),
    "mixed": Case("", scene=mixed, width=18, height=9, focal=12.0, count=10),
    "no opacity": Case("", scene=no_opacity, width=18, height=9, focal=12.0, count=10),
    "needles": Case("", scene=needles, width=40, height=23, focal=20.0, count=8),
}
"""Scenes by name, with the size of film and the numbers of Gaussians that they have. With these
seeds no pixel crosses a threshold while a step of the camera is taken."""

OF_SCENES = {
    "default": (by_effects, {}),
    "antialiased": (by_effects, {"antialiased": True}),
    **{
        name: (by_rays, APPROXIMATIONS[name])
        for name in ("exact", "pixel order", "all three, other cuts")
    },
}
"""Approximations that render all scenes, and their references."""

WINDOW = "a pixel's window is shorter than the list of splats that are out of order there"
KINK = "the colour of a pixel crosses zero within a step"
SCENE_HOLES = {
    **{
        (order, scene): WINDOW
        for order in ("pixel order", "all three, other cuts")
        for scene in ("many", "stacked", "close")
        if (order, scene) != ("all three, other cuts", "close")
    },
    **{(name, "needles"): KINK for name in ("pixel colours", "all three")},
}
"""Scenes without a case for some approximation, and the reason."""

CASES = [
    *(
        with_lens(lens, effect, reference_of, **options)
        for effect, (reference_of, options) in EFFECTS.items()
        for lens in ALL_LENSES
        if (effect, lens) not in HOLES
    ),
    with_lens("rational", "edges", by_effects, scene=edges),
    *(
        with_lens(
            name,
            f"along rays, {scene.__name__}",
            by_lens_rays,
            scene=partial(scene, ALL_LENSES[name]),
            approximations={"projection": "exact"},
        )
        for scene in (large_behind, edges_behind)
        for name in ("rational", "fisheye", "thin prism")
    ),
    Case(
        "along rays, needles",
        reference=by_lens_rays,
        scene=needles,
        width=40,
        height=23,
        focal=20.0,
        count=8,
        shutter=shutter(RollingShutter),
        approximations={"projection": "exact"},
    ),
    *(
        Case(f"{name}, pinhole", approximations=options, reference=by_rays)
        for name, options in APPROXIMATIONS.items()
    ),
    *(
        replace(case, name=f"{effect}, {name}", approximations=options, reference=reference_of)
        for name, case in SCENES.items()
        for effect, (reference_of, options) in OF_SCENES.items()
        if (effect, name) not in SCENE_HOLES
    ),
    *(
        replace(SCENES[scene], name=f"{name}, {scene}", approximations=options, reference=by_rays)
        for name, options in APPROXIMATIONS.items()
        for scene in ("close", "needles")
        if name not in OF_SCENES and (name, scene) not in SCENE_HOLES
    ),
    *(
        Case(
            f"thin lens, {name}",
            approximations=APPROXIMATIONS[name],
            aperture=(0.0625, 2.0),
            **STEP,
        )
        for name in ("unscented", "exact, antialiased", "exact, pixel order")
    ),
]

SPECIAL_CASES = {thresholds: (adjoint_is_transpose, bytes_are_reproducible)}
"""Functions that make cases to which few laws apply, and these laws: where decisions are taken at
equality, no step is small enough for differences."""
