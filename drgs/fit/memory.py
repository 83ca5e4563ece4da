"""Peak memory of a fit, estimated before it starts; fits that need too much are refused.

The peak is that of an iteration with as many Gaussians as the configuration allows. Entries and
slots of splats (see ``drgs.splatting``) are counted at the start, where splats are largest, for
some of the views and Gaussians. The numbers of bytes below were fitted to measured peaks of
resident memory, for 10,000 to 300,000 Gaussians and images of 100 x 100 to 1000 x 1000 px.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from drgs.cameras.viewpoints import Viewpoint
from drgs.config.schema import FitConfig
from drgs.core.constants import ALPHA_CUT, LOW_PASS, TRANSMITTANCE_STOP
from drgs.core.errors import UserError
from drgs.core.memory import available_memory, format_bytes, resident_memory
from drgs.datasets.film import to_camera, to_film
from drgs.datasets.images import shift_pixels
from drgs.datasets.storage import is_on_disk
from drgs.datasets.types import Dataset, View
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.grid import MICRO, TILE
from drgs.splatting.reduction import BAND_SLOTS
from drgs.training.density.phases import density_strategy
from drgs.training.parallel.communicator import Communicator

PROCESS_BYTES = 290_000_000  # memory of interpreter, libraries, compiled kernels, and results

NUMBER_BYTES, GAUSSIAN_BYTES, GROWTH_BYTES = 28, 100, 500
"""Memory of each number of a Gaussian: itself, its gradient, two moments, and one successor at a
time. Memory of each Gaussian besides: its splat, and derivatives. And more where the population
changes: rows are copied, and arrays of sizes that will not come again are held a while."""

ENTRY_BYTES, SLOT_BYTES = 150, 36
"""Memory of each (splat, tile) entry; of each composited (entry, micro-tile) pair of a band."""

PIXEL_BYTES, MEASURED_BYTES = 155, 130
"""Memory of each pixel that is rendered; of each pixel of a test view that is measured."""

FITTED_REACH = 0.55
"""Reach of fitted Gaussians, in units of the root of (pixels per Gaussian): N Gaussians in P pixels
have about N (1 + FITTED_REACH sqrt(P / N))^2 entries. Counted in fits of the shipped scene with
23,000 and 114,000 Gaussians at 200 to 800 px: 0.42 to 0.57."""

FITTED_SLOTS = 2.7  # slots of an entry of fitted Gaussians: 2.0 to 3.7 in the same fits

COUNTED_VIEWS, COUNTED_GAUSSIANS = 8, 20_000  # estimates entries and slots to a few per cent

MAX_RADIUS_PX = 1e6  # A larger radius covers any film

AHEAD_BYTES = 120
"""Memory of each pixel of a view whose photograph is on disk: 12 of the iteration's and of each of
the two that are read ahead, and those of a photograph that is halved."""

USABLE_SHARE = 0.9  # share of the available memory that is used: estimates are about so exact

MIN_WIDTH_PX = 16  # no smaller images are advised


@dataclass(frozen=True)
class FitMemory:
    """Bytes at the peak of a fit, by use."""

    process: int
    photographs: int  # as stored
    targets: int  # that would stay on the device if there were room for all
    gaussians: int
    splats: int  # entries and slots
    pixels: int

    @property
    def required_bytes(self) -> int:
        """The sum without targets, which can be made anew."""
        return self.process + self.photographs + self.gaussians + self.splats + self.pixels


def estimate(
    config: FitConfig,
    dataset: Dataset,
    gaussians: Gaussians,
    pixel_bytes: int,
    scale: float = 1.0,
    processes: int = 1,
) -> FitMemory:
    """Estimate the peak, in one process, of a fit that starts with ``gaussians``.

    pixel_bytes: see ``steps.bytes_per_pixel``; scale: of all images' width and height, for another
    ``data.image_size``; processes: share the Gaussians, and each renders images of all of them.
    """
    train, views = dataset.train, {*dataset.train, *dataset.test}
    start = gaussians.num_gaussians
    count = max_num_gaussians(config, start)
    pixels = scale**2 * max(view.width * view.height for view in train)
    measured = scale**2 * max((view.width * view.height for view in dataset.test), default=0)
    times = max(
        view.motion.samples if view.motion is not None and view.motion.shutter == "global" else 1
        for view in train
    )

    fitted = count * (1 + FITTED_REACH * math.sqrt(pixels / count)) ** 2
    entries, slots = _bytes_at_start(train, gaussians, config.model.near_plane, scale)
    entries, slots = max(entries, fitted), max(slots, FITTED_SLOTS * fitted)
    ahead = AHEAD_BYTES * pixels if any(map(is_on_disk, train)) else 0
    numbers = 11 + 3 * (config.model.sh_degree + 1) ** 2
    of_gaussian = NUMBER_BYTES * numbers + GAUSSIAN_BYTES + (GROWTH_BYTES if count > start else 0)
    return FitMemory(
        process=PROCESS_BYTES,
        photographs=round(ahead + sum(_photograph_bytes(view, scale) for view in views)),
        targets=round(scale**2 * pixel_bytes * sum(_target_pixels(view) for view in train)),
        gaussians=round(of_gaussian * count / processes),
        splats=round(ENTRY_BYTES * entries * times + SLOT_BYTES * min(slots, BAND_SLOTS)),
        pixels=round(PIXEL_BYTES * pixels * times + MEASURED_BYTES * measured),
    )


def max_num_gaussians(config: FitConfig, start: int) -> int:
    """Return the most Gaussians of a fit that starts with ``start``."""
    return density_strategy(config).max_num_gaussians(start, config.iterations)


def _target_pixels(view: View) -> int:
    """Return the pixels of all targets that are made of a view."""
    return len(shift_pixels(view)) * view.width * view.height


def _photograph_bytes(view: View, scale: float) -> float:
    """Return the bytes of a view's images, or of the numbers of smaller ones if these take less."""
    images = [p for p in (view.image, view.alpha, view.mask, view.depth) if p is not None]
    numbers = 4 * scale**2 * sum(math.prod(rendered.shape) for rendered in images)
    return min(sum(rendered.nbytes for rendered in images), numbers)


@np.errstate(over="ignore")  # of scales beyond all images
def _bytes_at_start(
    views: Sequence[Viewpoint], gaussians: Gaussians, near: float, scale: float
) -> tuple[float, float]:
    """Count entries and slots of the view that has most, of some: splats taken as round."""
    g = gaussians.numpy()
    step = -(-g.num_gaussians // COUNTED_GAUSSIANS)
    means, scales = g.means[::step].astype(np.float64), np.exp(g.log_scales[::step].mean(axis=1))
    opacities = np.maximum(g.opacities[::step], 1.01 * ALPHA_CUT)
    reach = np.sqrt(2 * np.log(opacities / ALPHA_CUT))
    counts = []
    for view in views[:: -(-len(views) // COUNTED_VIEWS)]:
        u, v, z = to_film(view, to_camera(view, list(means.T)))
        seen = z > near
        z = np.where(seen, z, 1)
        focal, size = scale * math.sqrt(view.fx * view.fy), np.array([view.width, view.height])
        radius = np.minimum(reach * np.sqrt((focal * scales / z) ** 2 + LOW_PASS), MAX_RADIUS_PX)
        tiles, boxes = seen.astype(np.float64), np.ones(len(z))
        for center, length in zip((scale * u, scale * v), scale * size, strict=True):
            inside = np.minimum(center + radius, length) - np.maximum(center - radius, 0)
            tiles *= np.where(inside > 0, np.maximum(inside, 0) / TILE + 1, 0)
            boxes *= np.maximum(inside, 0) / (2 * radius)
        # Cells of a grid that a disc touches on average, and what of it is on the film.
        micros = boxes * (np.pi * radius**2 + 4 * radius * MICRO + MICRO**2) / MICRO**2
        alpha = (opacities - ALPHA_CUT) / np.log(opacities / ALPHA_CUT)  # mean over the disc
        weights = np.where(seen, micros, 0)
        total = float(weights.sum())
        layers = -math.log(TRANSMITTANCE_STOP) * total / max(float((weights * alpha).sum()), 1e-9)
        composited = layers * scale**2 * view.width * view.height / MICRO**2
        counts.append((step * float(tiles.sum()), min(step * total, composited)))
    return max(entries for entries, _ in counts), max(slots for _, slots in counts)


def room_for_targets(
    config: FitConfig,
    dataset: Dataset,
    gaussians: Gaussians,
    comm: Communicator,
    pixel_bytes: int,
) -> int:
    """Return the bytes of targets that may stay on the device; pixel_bytes: see :func:`estimate`.

    Raises :class:`UserError` where the fit would not fit into memory.
    """
    memory = estimate(config, dataset, gaussians, pixel_bytes, processes=comm.size)
    usable = round(USABLE_SHARE * (available_memory() / comm.num_on_machine + resident_memory()))
    if memory.required_bytes > usable:
        raise UserError(_refusal(config, dataset, gaussians, memory, usable, comm.size))
    left = usable - round(1.15 * memory.required_bytes)  # an estimate may be wrong
    return max(0, min(memory.targets, left))


def _refusal(
    config: FitConfig,
    dataset: Dataset,
    gaussians: Gaussians,
    memory: FitMemory,
    usable: int,
    processes: int,
) -> str:
    train, start = dataset.train, gaussians.num_gaussians
    count, width = max_num_gaussians(config, start), max(view.width for view in train)

    def fits(most: int, scale: float = 1.0) -> bool:
        densify = config.densify.model_copy(update={"max_gaussians": most})
        smaller = config.model_copy(update={"densify": densify})
        needed = estimate(smaller, dataset, gaussians, 0, scale, processes).required_bytes
        return needed <= 0.95 * usable

    most = next(filter(fits, _smaller(count, start)), None)
    size = next((s for s in _smaller(width, MIN_WIDTH_PX) if fits(count, s / width)), None)
    remedies = ["data.in_memory=false"] if _fits_from_disk(dataset, memory, usable) else []
    remedies += [f"densify.max_gaussians={most}"] if most else []
    remedies += [f"data.image_size={size}"] if size else []
    advice = f"set {' or '.join(remedies)}" if remedies else "use fewer views and Gaussians"
    who, part = "the fit", ""
    if processes > 1:
        who, part = "a process of the fit", f"1/{processes} of "
    return (
        f"memory: {who} needs about {format_bytes(memory.required_bytes)} "
        f"({format_bytes(memory.photographs)} for {len({*train, *dataset.test}):,} photographs, "
        f"{format_bytes(memory.gaussians)} for {part}{count:,} Gaussians, "
        f"{format_bytes(memory.splats + memory.pixels)} for an image of them), and may take "
        f"{format_bytes(usable)}, nine tenths of the available memory; {advice}"
    )


def _fits_from_disk(dataset: Dataset, memory: FitMemory, usable: int) -> bool:
    """Return whether a fit with photographs in memory would fit without these."""
    ahead = AHEAD_BYTES * max(view.width * view.height for view in dataset.train)
    can_move = all(view.files for view in dataset.train) and not any(map(is_on_disk, dataset.train))
    return can_move and memory.required_bytes - memory.photographs + ahead <= usable


def _smaller(number: int, least: int) -> Iterator[int]:
    """Yield numbers of two digits and zeros, from ``number`` down to ``least``."""
    smaller = 0.95 * number
    while smaller >= least:
        digits = 10 ** max(0, len(str(int(smaller))) - 2)
        yield int(smaller) // digits * digits
        smaller *= 0.95
