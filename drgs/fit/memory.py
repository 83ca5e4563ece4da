"""Peak memory of a fit, estimated before it starts; fits that need too much are refused.

The peak is that of an iteration with as many Gaussians as the configuration allows. The numbers of
bytes below were fitted to measured peaks of resident memory, for 10,000 to 300,000 Gaussians and
images of 100 x 100 to 1000 x 1000 px.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.core.memory import available_memory, format_bytes, resident_memory
from drgs.datasets.images import is_on_disk
from drgs.datasets.types import Dataset, View
from drgs.splatting.grid import MICROS
from drgs.splatting.reduction import BAND_SLOTS, PAIRS_AT_ONCE
from drgs.training.density.phases import density_strategy
from drgs.training.parallel.communicator import Communicator

PROCESS_BYTES = 290_000_000  # memory of interpreter, libraries, compiled kernels, and results

NUMBER_BYTES, GAUSSIAN_BYTES, GROWTH_BYTES = 28, 100, 500
"""Memory of each number of a Gaussian: itself, its gradient, two moments, and successors. Memory of
each Gaussian besides: its splat, and derivatives. And more where the population changes: rows are
copied, and arrays of sizes that will not come again are held a while."""

ENTRY_BYTES, SLOT_BYTES = 150, 36
"""Memory of each (splat, tile) entry; of each composited (entry, micro-tile) pair of a band."""

PIXEL_BYTES, MEASURED_BYTES = 155, 130
"""Memory of each pixel that is rendered; of each pixel of a test view that is measured."""

START_REACH, FITTED_REACH = 1.3, 0.55
"""Reach of Gaussians, in units of the root of (pixels per Gaussian): N Gaussians in P pixels have
about N (1 + reach sqrt(P / N))^2 entries. At the start 0.9 to 1.6 for random points, 0.4 on a hull;
in fits of the shipped scene with 23,000 and 114,000 Gaussians at 200 to 800 px, 0.42 to 0.57."""

SLOTS = 2.7  # of an entry of fitted Gaussians: 2.0 to 3.7 in the same fits; at the start 4 to 9

AHEAD_BYTES = 120
"""Memory of each pixel of a view whose photograph is on disk: 12 of the iteration's and of each of
the two that are read ahead, and those of a photograph that is halved."""

USABLE_SHARE = 0.9  # share of the available memory that is used: estimates are about so exact

MIN_WIDTH_PX = 16  # no smaller images are advised


@dataclass(frozen=True)
class FitMemory:
    """Bytes at the peak of a fit, by use, without targets, which can be made anew."""

    photographs: int  # as stored
    gaussians: int
    image: int  # pixels, entries and slots

    @property
    def required_bytes(self) -> int:
        """The sum, with the process itself."""
        return PROCESS_BYTES + self.photographs + self.gaussians + self.image


def estimate(
    config: FitConfig, dataset: Dataset, start: int, scale: float = 1.0, processes: int = 1
) -> FitMemory:
    """Estimate the peak, in one process, of a fit that starts with ``start`` Gaussians.

    scale: of all images' width and height, for another ``data.image_size``; processes: share the
    Gaussians, and each renders images of all of them.
    """
    train, views = dataset.train, {*dataset.train, *dataset.test}
    count = max_num_gaussians(config, start)
    pixels = scale**2 * max(view.width * view.height for view in train)
    measured = scale**2 * max((view.width * view.height for view in dataset.test), default=0)
    times = max(
        view.motion.samples if view.motion is not None and view.motion.shutter == "global" else 1
        for view in train
    )
    entries = max(
        number * (1 + reach * math.sqrt(pixels / number)) ** 2
        for number, reach in ((start, START_REACH), (count, FITTED_REACH))
    )
    slots = SLOTS * entries
    if MICROS * entries > PAIRS_AT_ONCE:
        slots = min(slots, BAND_SLOTS)
    splats = ENTRY_BYTES * entries * times + SLOT_BYTES * slots
    ahead = AHEAD_BYTES * pixels if any(map(is_on_disk, train)) else 0
    numbers = 11 + 3 * (config.model.sh_degree + 1) ** 2
    of_gaussian = NUMBER_BYTES * numbers + GAUSSIAN_BYTES + (GROWTH_BYTES if count > start else 0)
    return FitMemory(
        photographs=round(ahead + sum(_photograph_bytes(view, scale) for view in views)),
        gaussians=round(of_gaussian * count / processes),
        image=round(splats + PIXEL_BYTES * pixels * times + MEASURED_BYTES * measured),
    )


def max_num_gaussians(config: FitConfig, start: int) -> int:
    """Return the most Gaussians of a fit that starts with ``start``."""
    return density_strategy(config).max_num_gaussians(start, config.iterations)


def _photograph_bytes(view: View, scale: float) -> float:
    """Return the bytes of a view's images, or of the numbers of smaller ones if these take less."""
    images = view.planes().values()
    numbers = 4 * scale**2 * sum(math.prod(image.shape) for image in images)
    return min(sum(image.nbytes for image in images), numbers)


def room_for_targets(config: FitConfig, dataset: Dataset, start: int, comm: Communicator) -> int:
    """Return the bytes of targets that may stay on the device; start: Gaussians at the start.

    Raises :class:`UserError`, on all ranks, where the fit would not fit into memory.
    """
    memory = estimate(config, dataset, start, processes=comm.size)
    usable = round(USABLE_SHARE * (available_memory() / comm.num_on_machine + resident_memory()))

    def check() -> None:
        if memory.required_bytes > usable:
            raise UserError(_refusal(config, dataset, start, memory, usable, comm.size))

    comm.collective(check)
    return max(0, usable - round(1.15 * memory.required_bytes))  # it may be wrong


def _refusal(
    config: FitConfig, dataset: Dataset, start: int, memory: FitMemory, usable: int, processes: int
) -> str:
    train = dataset.train
    count, width = max_num_gaussians(config, start), max(view.width for view in train)

    def fits(most: int, scale: float = 1.0) -> bool:
        densify = config.densify.model_copy(update={"max_gaussians": most})
        smaller = config.model_copy(update={"densify": densify})
        return estimate(smaller, dataset, start, scale, processes).required_bytes <= 0.95 * usable

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
        f"{format_bytes(memory.image)} for an image of them), and may take "
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
