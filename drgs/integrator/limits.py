"""What a picture cannot ask for, refused in words before anything is allocated or compiled."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi

from drgs.core.constants import MAX_FEATURES
from drgs.core.errors import PluginError
from drgs.core.memory import MAX_LANES, UNASKED_BYTES, available_memory, why_too_large

MAX_SAMPLES = 4096
"""Most samples of a pixel, times the poses that motion blurs, whose frames take 0.15 MB each even
of the smallest film."""

NESTED_SAMPLE_BYTES = 64
"""About what Mitsuba's path tracers take at least for a sample: its ray, sampler and radiance."""


def check_picture(film: mi.Film, spp: int, poses: int, num_aovs: int, nested_spp: int) -> None:
    """Raise PluginError for a picture that would take more than there is.

    spp: of the splats; poses: of the sensor, whose pictures are averaged; num_aovs: channels
    besides colour and alpha; nested_spp: of the nested integrator, 0 where there is none.
    """
    width, height = film.crop_size()
    if min(width, height) < 1:
        raise PluginError(f"splats: the film must have 1 pixel at least, got {width} x {height}")
    if not isinstance(spp, int) or spp < 1:
        raise PluginError(
            "splats: the samples per pixel (spp, or the sampler's sample_count) must be an integer "
            f"of at least 1, got {spp!r}"
        )
    if spp * poses > MAX_SAMPLES:
        times = f" times {poses:,} poses of the shutter (shutter_samples)" if poses > 1 else ""
        raise PluginError(
            f"splats: a pixel can have at most {MAX_SAMPLES:,} samples, got {spp:,}{times}; take "
            "the mean of pictures with other seeds, or, for surfaces alone, set nested_spp"
        )
    why = why_too_large(width, height, 3 + num_aovs, spp * poses)
    if why is not None:
        raise PluginError(f"splats: {why}")
    samples, most = width * height * nested_spp, MAX_LANES
    if samples * NESTED_SAMPLE_BYTES > UNASKED_BYTES:
        most = min(most, available_memory() // NESTED_SAMPLE_BYTES)
    if samples > most:
        raise PluginError(
            f"splats: on a film of {width} x {height} px, nested_spp (or spp) must be at most "
            f"{most // (width * height):,}, got {nested_spp:,}; take the mean of pictures "
            "with other seeds"
        )


def check_columns(columns: dict[str, int]) -> None:
    """Raise PluginError where more is put out than a kernel can be compiled for.

    columns: of each AOV, by its name.
    """
    if sum(columns.values()) > MAX_FEATURES:
        counts = ", ".join(f"{name} {count:,}" for name, count in columns.items())
        raise PluginError(
            f"splats: aovs can have at most {MAX_FEATURES} channels together, got "
            f"{sum(columns.values()):,} ({counts}); render them in parts, which share a kernel"
        )


def check_ids(parameter: str, names: Sequence[str], nodes: Sequence[mi.Object]) -> None:
    """Raise PluginError for names that none of a scene's nodes has for its id.

    parameter: what has the names, and of what they must be ids.
    """
    known = [node.id() for node in nodes]
    for name in names:
        if name not in known:
            message = f"splats: {parameter}, got {name!r}; there are {', '.join(known)}"
            if any(isinstance(node, mi.Mesh) and not node.id() for node in nodes):
                message += (
                    "; Mitsuba merges meshes with equal BSDFs, which then have no id: load the "
                    "scene with optimize=False"
                )
            raise PluginError(message)
