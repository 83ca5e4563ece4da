"""Initial Gaussians of a fit: on a visual hull, of a point cloud, or at random points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from drgs.config.schema import FitConfig, InitConfig
from drgs.core.constants import SH_C0
from drgs.core.environment import denormals_kept
from drgs.core.errors import UserError
from drgs.core.origin import WORLD
from drgs.datasets.film import is_projectable, shown_points
from drgs.datasets.other_programs import OPENSFM_FILE, read_opensfm_points
from drgs.datasets.types import Dataset, View
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.sky import OPACITY as SKY_OPACITY
from drgs.initialization.sky import Sky, find_sky
from drgs.initialization.start_box import (
    FARTHEST,
    MIN_FACING_SHARE,
    focus_box,
    focus_of,
    focus_text,
    format_point,
    num_views_facing,
    points_in_view,
    start_box_of,
)
from drgs.initialization.visual_hull import (
    Silhouette,
    are_masks,
    hull_points,
    num_transparent,
    silhouettes_of,
)
from drgs.io.colmap import read_points3d
from drgs.io.formats import format_to_read
from drgs.io.ply import read_points

MIN_SPACING = 2.5e-4
"""Smallest first scale, for points that coincide, as a share of the median distance of points from
their middle. The 3DGS reference has 3.2e-4 world units, for scenes of about unit size."""

NUM_NEIGHBOURS = 3

MIN_SWEPT = 1000  # points of a plane sweep, or a fit starts at random ones

MAX_COLOR_VIEWS, MIN_COLOR_VIEWS = 60, 8
"""Number of views whose images colour points: a third of them see most points."""

MAX_HEADER = 1 << 12  # bytes of a PLY file, among which Gaussians' properties are

MAX_COLOR_BYTES = 1 << 27  # memory for colours: of a million points, fewer views are read

MIN_ALPHA = 0.5  # less opaque pixels mostly show the background

POINTS_PER_SORT = 1 << 13

COLMAP_POINT_FILES = ("points3D.bin", "points3D.txt")  # have errors and observations of points


@dataclass(frozen=True, eq=False)
class Start:
    """Initial points of a fit."""

    means: np.ndarray  # (N, 3) world
    colors: np.ndarray | None  # (N, 3) display space 0..1; None: not known
    description: str  # for the user
    gaussians: Gaussians | None = None  # to start from as they are
    sky: Sky | None = None  # further Gaussians


def initial_gaussians(config: FitConfig, dataset: Dataset) -> Gaussians:
    """Return Gaussians at iteration 0: :func:`gaussians_at` the points of :func:`start_of`."""
    config = resolve_defaults(config, dataset)
    return replace(gaussians_at(start_of(config, dataset), config), origin=dataset.origin)


def gaussians_at(start: Start, config: FitConfig) -> Gaussians:
    """Return isotropic Gaussians at 4 points or more, numpy float32, as large as the gaps between.

    Gaussians that are given are returned as they are.

    The standard deviation is the root mean square distance to the 3 nearest
    other points, which is that of the 3DGS reference (``distCUDA2``). The opacity is
    ``init.opacity`` (of sky, ``sky.OPACITY``), the degree ``model.sh_degree``. Without colours:
    grey. Identity rotations; SH coefficients above degree 0 are zero.
    """
    if start.gaussians is not None:
        return start.gaussians
    means = np.ascontiguousarray(start.means, np.float32)
    colors = np.full(means.shape, 0.5) if start.colors is None else start.colors
    spacing = np.sqrt(mean_squared_neighbour_distance(means))
    from_middle = means.astype(np.float64) - np.median(means.astype(np.float64), axis=0)
    radii = np.linalg.norm(from_middle, axis=1)
    spacing = np.maximum(spacing, MIN_SPACING * float(np.median(radii) or radii.max()))
    opacities = np.full(len(means), config.init.opacity)
    if (sky := start.sky) is not None:
        means = np.concatenate([means, sky.means], dtype=np.float32)
        colors = np.concatenate([colors, sky.colors])
        spacing = np.append(spacing, np.full(len(sky.means), sky.scale))
        opacities = np.append(opacities, np.full(len(sky.means), SKY_OPACITY))
    num = len(means)
    log_scales = np.repeat(np.log(spacing)[:, None], 3, axis=1)
    logits = np.log(opacities / (1 - opacities))
    sh0 = (np.asarray(colors, np.float64) - 0.5) / SH_C0
    return Gaussians(
        means=means,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (num, 1)),
        log_scales=log_scales.astype(np.float32),
        logit_opacities=logits.astype(np.float32),
        sh0=sh0.astype(np.float32)[:, None, :],
        shN=np.zeros((num, (config.model.sh_degree + 1) ** 2 - 1, 3), np.float32),
    )


def start_of(config: FitConfig, dataset: Dataset) -> Start:
    """Return the points that a fit starts from; config: with resolved defaults.

    By default: ``init.gaussians``; else ``init.point_cloud``; else uniform in [-h, h]^3 with
    ``init.half_extent``; else on the visual hull, where nearly all images are partly transparent;
    else the point cloud that the dataset names; else uniform in a box that follows from the layout
    and the cameras. Points on the hull, and those of a cloud without colours, are coloured from the
    images. Masks that contradict each other are not used, which the description mentions.

    Raises :class:`UserError` for points that the cameras do not see, and for masks or a point cloud
    that ``init.start`` requires and that are not there.
    """
    init, note = config.init, ""
    if init.gaussians is not None:
        _check_unfiltered(init, str(init.gaussians))
        return _given_start(config, dataset, init.gaussians)
    is_open = init.start == "auto" and init.point_cloud is None and init.half_extent is None
    if init.start == "masks" or (is_open and any(v.alpha is not None for v in dataset.train)):
        silhouettes = silhouettes_of(dataset.train)
        if are_masks(silhouettes, dataset.train):
            if (start := _hull_start(config, dataset, silhouettes)) is not None:
                _check_unfiltered(init, start.description)
                return start
            note = f" (the masks of {len(silhouettes)} images have no hull to start from)"
        elif init.start == "masks":
            raise UserError(
                "init.start: masks needs nearly all training images to be transparent where "
                "there is nothing, from cameras that stand still, but only "
                f"{num_transparent(silhouettes)} are; cut out what is to be fitted, or set "
                "init.start=auto"
            )
    cloud = _cloud_file(init, dataset)
    if cloud is None or cloud.name not in COLMAP_POINT_FILES:
        _check_unfiltered(init, "other points" if cloud is None else str(cloud))
    if cloud is not None:
        start = _cloud_start(config, dataset, cloud)
    else:
        swept = _swept_start(config, dataset) if init.start in ("auto", "sweep") else None
        start = swept or _random_start(config, dataset)
        if swept is None:
            return replace(start, description=start.description + note)
    if init.sky and (sky := find_sky(dataset.train, start.means)) is not None:
        note += f", and {len(sky.means):,} Gaussians behind: {sky.share:.0%} of directions are sky"
        start = replace(start, sky=sky)
    return replace(start, description=start.description + note)


def description_of_start(config: FitConfig, start: Start) -> str:
    """Describe a start and the near plane in one line; config: with resolved defaults."""
    return f"starts from {start.description}; near plane at {config.model.near:g}"


def _cloud_file(init: InitConfig, dataset: Dataset) -> Path | None:
    """Return the file that a fit starts from; None: a plane sweep, or random points."""
    if init.start in ("sweep", "random"):
        return None
    if init.point_cloud is not None or init.half_extent is not None:
        return init.point_cloud
    if init.start == "points" and dataset.point_cloud is None:
        raise UserError(
            "init.start: points needs a point cloud, and the dataset names none that may be used "
            "(ply_file_path, data.ignore_points); give init.point_cloud, or set init.start=auto"
        )
    return dataset.point_cloud


def _check_unfiltered(init: InitConfig, start: str) -> None:
    """Raise :class:`UserError` where COLMAP's points are to be filtered, but are not used."""
    for name in ("max_point_error", "min_track_length"):
        if getattr(init, name) is not None:
            raise UserError(
                f"init.{name}: only COLMAP's points ({' or '.join(COLMAP_POINT_FILES)}) have that, "
                f"and the fit starts from {start}; leave it out"
            )


def _hull_start(
    config: FitConfig, dataset: Dataset, silhouettes: Sequence[Silhouette]
) -> Start | None:
    """Return points on the visual hull of the masks; None: it is empty."""
    try:
        box = start_box_of(config.init, dataset) or focus_box(dataset.train)
    except UserError:
        if config.init.half_extent is not None:
            raise
        return None
    means = hull_points(silhouettes, box, config.init.num_points, config.seed)
    if len(means) <= NUM_NEIGHBOURS:
        return None
    what = f"{len(means):,} points on the hull of {len(silhouettes)} masks"
    return _with_colors(Start(means.astype(np.float32), None, what), dataset)


def _given_start(config: FitConfig, dataset: Dataset, file: Path) -> Start:
    """Return the Gaussians of a file, with the degree of the fit's harmonics."""
    given, count = Gaussians.load(file), (config.model.sh_degree + 1) ** 2 - 1
    moved = np.asarray(given.means, np.float64) + np.subtract(given.origin, dataset.origin)
    means, higher = moved.astype(np.float32), given.shN[:, :count]
    _check_cloud(file, means, config.densify.max_gaussians, dataset)
    more = count - higher.shape[1]
    shN = np.pad(higher, ((0, 0), (0, max(more, 0)), (0, 0)))
    degree = f", their harmonics {'with more of zero' if more > 0 else 'cut'}"
    note = degree if more or count < given.shN.shape[1] else ""
    for name, value in (given.rendered_with or {}).items():
        if getattr(config.model, name, value) != value:
            note += f"; {name} was {value}"
    note += "" if given.smoothing is None else "; their smoothing is not used"
    start = replace(given, means=means, shN=shN, origin=WORLD, smoothing=None, rendered_with=None)
    colors = np.clip(0.5 + SH_C0 * given.sh0[:, 0], 0, 1)
    return Start(means, colors, f"the {len(means):,} Gaussians of {file}{note}", start)


def _cloud_start(config: FitConfig, dataset: Dataset, cloud: Path) -> Start:
    means, colors, num_read = _read_cloud(config.init, cloud)
    means = (means - dataset.origin).astype(np.float32)
    if colors is not None and not np.any(colors):
        colors = None  # all black: written by programs that found none
    _check_cloud(cloud, means, config.densify.max_gaussians, dataset)
    kept = "the" if len(means) == num_read else f"{len(means):,} of {num_read:,}"
    with cloud.open("rb") as file:
        has_shapes = b"property float scale_0" in file.read(MAX_HEADER)
    note = " (their scales, rotations and opacities are not used: set init.gaussians for that)"
    start = Start(means, colors, f"{kept} points of {cloud}{note if has_shapes else ''}")
    return _with_colors(start, dataset) if colors is None else start


def _read_cloud(init: InitConfig, cloud: Path) -> tuple[np.ndarray, np.ndarray | None, int]:
    """Return positions (N, 3) float64, world, colours (N, 3) float32, 0..1, and the number read."""
    if cloud.name == OPENSFM_FILE:
        positions, colors = read_opensfm_points(cloud)
        return positions, colors, len(positions)
    if cloud.name not in COLMAP_POINT_FILES:
        if (known := format_to_read(cloud)) is not None and known.name != "ply":
            raise UserError(f"{cloud}: holds Gaussians, no points; set init.gaussians to it")
        positions, colors = read_points(cloud)
        return positions, colors, len(positions)
    points = read_points3d(cloud)
    kept = np.ones(len(points.errors), bool)
    if init.max_point_error is not None:
        kept &= points.errors <= init.max_point_error
    if init.min_track_length is not None:
        kept &= points.track_lengths >= init.min_track_length
    if len(kept) and not kept.any():
        raise UserError(
            f"{cloud}: init.max_point_error and init.min_track_length leave none of "
            f"{len(kept):,} points (their errors are {points.errors.min():.3g} to "
            f"{points.errors.max():.3g} px, and {points.track_lengths.min():,} to "
            f"{points.track_lengths.max():,} images observe them); set other ones"
        )
    positions, colors = points.positions[kept], points.colors[kept]
    return positions, colors / np.float32(255), len(kept)


def _swept_start(config: FitConfig, dataset: Dataset) -> Start | None:
    """Return points of a plane sweep; None: there are few, or the layout has a box of its own."""
    if start_box_of(config.init, dataset) is not None and config.init.start == "auto":
        return None
    from drgs.initialization.plane_sweep import swept_points

    means, colors = swept_points(dataset.train)
    if len(means) >= MIN_SWEPT:
        chosen = np.random.default_rng(config.seed).permutation(len(means))
        chosen = np.sort(chosen[: config.init.num_points])
        what = f"{len(chosen):,} of {len(means):,} points of a plane sweep between photographs"
        return Start(means[chosen].astype(np.float32), colors[chosen], what)
    if config.init.start == "sweep":
        raise UserError(
            f"init.start: a plane sweep needs photographs that overlap, and found {len(means):,} "
            "points; give init.point_cloud, or set init.start=random"
        )
    return None


def _random_start(config: FitConfig, dataset: Dataset) -> Start:
    num_points, rng = config.init.num_points, np.random.default_rng(config.seed)
    what, box = f"{num_points:,} random points", start_box_of(config.init, dataset)
    if box is not None:
        return Start(box.points(num_points, rng), None, f"{what} in {box}")
    means = points_in_view(dataset.train, num_points, rng)
    focus, distance = focus_of(dataset.train)
    near = f"about within {distance:.3g} of {format_point(focus, distance)}"
    far = f"the others up to {FARTHEST:g} times as far"
    return Start(means, None, f"{what} that the cameras see, part of them {near}, {far}")


def _with_colors(start: Start, dataset: Dataset) -> Start:
    """Return the start with colours from the images, if they show any of the points."""
    spacing = np.sqrt(mean_squared_neighbour_distance(start.means))
    colors = colors_from_images(start.means, spacing, dataset.train, dataset.background)
    if colors is None:
        return start
    return replace(start, colors=colors, description=f"{start.description}, coloured")


def mean_squared_neighbour_distance(points: np.ndarray) -> np.ndarray:
    """Return mean squared distances (N,) float64 of (N, 3) points to the 3 nearest others."""
    # SciPy splits points at the number next to the least: without end if that is taken for zero.
    with denormals_kept():
        distances, _ = KDTree(points).query(points, k=NUM_NEIGHBOURS + 1)
    # The nearest is the point itself, or one at the same place: at distance 0 either way.
    return np.mean(distances[:, 1:] ** 2, axis=1)


def _check_cloud(file: Path, points: np.ndarray, max_gaussians: int, dataset: Dataset) -> None:
    """Raise UserError for too few or too many points (N, 3), or points of another scene."""
    num, views = len(points), dataset.train
    if num <= NUM_NEIGHBOURS:
        raise UserError(f"{file}: at least {NUM_NEIGHBOURS + 1} points, got {num}")
    if (points == points[0]).all():
        raise UserError(f"{file}: its {num:,} points must not all be the same")
    if num > max_gaussians:
        raise UserError(
            f"{file}: must hold at most densify.max_gaussians ({max_gaussians}) points, got {num}"
        )
    looking = num_views_facing(points, views)
    if looking < MIN_FACING_SHARE * len(views):
        raise UserError(
            f"{file}: must hold what the cameras look at{focus_text(dataset)}, in their frame "
            f"of reference, but only {looking} of {len(views)} have any of its {num:,} points in "
            "the middle of their images; give another init.point_cloud, or start from random "
            "points (init.point_cloud=null, data.ignore_points=true)"
        )


# Colours of points from the images that show them


def colors_from_images(
    points: np.ndarray,
    spacing: np.ndarray,
    views: Sequence[View],
    background: tuple[float, float, float],
) -> np.ndarray | None:
    """Return colours (N, 3) float32, display space 0..1; None: no image shows any of the points.

    An image shows a point if no other point is clearly nearer to its camera in a z-buffer whose
    pixels are as wide as the points are apart. On a surface that turns away from the camera, points
    hide each other, so that images count that look onto it. The middle half of a point's colours is
    averaged: the rest may be highlights or occluders.

    points: (N, 3) world; spacing: (N,) scene units, of each to its neighbours; background: of the
    composited images, display space. Unshown points get the colour of the nearest shown one.
    """
    views = [view for view in views if is_projectable(view)]
    most = max(MIN_COLOR_VIEWS, min(MAX_COLOR_VIEWS, MAX_COLOR_BYTES // (12 * len(points))))
    views = views[:: -(-len(views) // most) or 1]
    samples = np.full((len(views), len(points), 3), np.inf, np.float32)
    columns = [np.ascontiguousarray(c, np.float64) for c in np.asarray(points).T]
    for view, sample in zip(views, samples, strict=True):
        rows, colors = _find_shown_points(view, columns, spacing, background)
        sample[rows] = colors
    colors = np.concatenate(
        [
            _middle_mean(samples[:, k : k + POINTS_PER_SORT])
            for k in range(0, len(points), POINTS_PER_SORT)
        ]
    )
    unseen = np.isnan(colors[:, 0])
    if unseen.all():
        return None
    if unseen.any():
        with denormals_kept():
            _, nearest = KDTree(points[~unseen]).query(points[unseen])
        colors[unseen] = colors[~unseen][nearest]
    return colors


def _find_shown_points(
    view: View,
    columns: Sequence[np.ndarray],
    spacing: np.ndarray,
    background: tuple[float, float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Return indices of points that the image shows, and their colours (M, 3) float32, 0..1."""
    rows, at, _ = shown_points(view, columns, spacing)
    if not len(rows):
        return rows, np.empty((0, 3), np.float32)
    colors, opaque = np.asarray(view.image)[at], np.ones(len(rows), bool)
    if view.alpha is not None:
        alpha = np.asarray(view.alpha)[at][:, None]
        opaque = alpha[:, 0] >= MIN_ALPHA
        behind = (1 - alpha) * np.asarray(background, np.float32)
        colors = (colors - behind) / np.maximum(alpha, MIN_ALPHA)
    if view.mask is not None:
        opaque &= np.asarray(view.mask)[at] > 0
    return rows[opaque], np.clip(colors[opaque], 0, 1)


def _middle_mean(samples: np.ndarray) -> np.ndarray:
    """Return means (N, 3) of the middle half of (V, N, 3), channel by channel; NaN: there are none.

    inf: not a sample. Of n, floor(n / 4) are left out at either end.
    """
    ordered, count = np.sort(samples, axis=0), np.isfinite(samples[:, :, 0]).sum(axis=0)
    rank, left_out = np.arange(len(samples))[:, None], count // 4
    kept = (rank >= left_out) & (rank < count - left_out)
    total = np.where(kept[:, :, None], ordered, 0).sum(axis=0, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return (total / kept.sum(axis=0)[:, None]).astype(np.float32)
