"""Checks of scenes, before anything is allocated or compiled."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from drgs.core.errors import PluginError, UnsupportedError
from drgs.core.memory import MAX_LANES, UNCHECKED_BYTES, available_memory, too_large_reason
from drgs.gaussians.parameters import Gaussians

MAX_SAMPLES = 4096  # samples of a pixel times poses of motion blur; a frame takes 0.15 MB at least
NESTED_SAMPLE_BYTES = 64  # at least, for a path tracer's sample: its ray, sampler and radiance


def check_shapes(gaussians: Gaussians) -> None:
    """Raise PluginError unless all parameters have rows for the same Gaussians."""
    num = next(iter(gaussians.means.shape), 1)
    if num == 0:
        raise PluginError("splats: at least one Gaussian is needed, got none")
    rows = {
        "means": [(3,)],
        "quats": [(4,)],
        "log_scales": [(3,)],
        "logit_opacities": [()],
        "sh0": [(1, 3)],
        "shN": [((degree + 1) ** 2 - 1, 3) for degree in range(4)],
    }
    for name, allowed in rows.items():
        got = tuple(getattr(gaussians, name).shape)
        if got not in [(num, *row) for row in allowed]:
            expected = " or ".join(f"({', '.join(map(str, ('N', *row)))})" for row in allowed)
            raise PluginError(
                f"splats: {name} must have the shape {expected}, with N = {num} the rows of "
                f"means, got {got}"
            )
    for name, tensor in (gaussians.features or {}).items():
        if len(tensor.shape) != 2 or tensor.shape[0] != num or tensor.shape[1] == 0:
            raise PluginError(
                f"splats: {name} must have the shape (N, C), with N = {num} the rows of means and "
                f"C at least 1, got {tuple(tensor.shape)}"
            )
    if gaussians.smoothing is not None and dr.width(gaussians.smoothing) != num:
        raise PluginError(
            f"splats: smoothing must have the shape (N), with N = {num} the rows of means, got "
            f"({dr.width(gaussians.smoothing)},)"
        )


def check_degree(degree: int, gaussians: Gaussians) -> None:
    """Raise PluginError for a spherical harmonics degree that the Gaussians do not have."""
    if degree > gaussians.sh_degree:
        raise PluginError(
            f"splats: sh_degree must be an integer from 0 to {gaussians.sh_degree}, the degree of "
            f"the Gaussians, got {degree}"
        )


def ellipsoids_in(scene: mi.Scene) -> list[mi.Shape]:
    """Return the shapes of Gaussians, which are rendered as splats."""
    return [shape for shape in scene.shapes() if shape.is_ellipsoids()]


def surfaces_in(scene: mi.Scene) -> list[mi.Shape]:
    """Return the shapes that are no Gaussians."""
    return [shape for shape in scene.shapes() if not shape.is_ellipsoids()]


def check_instances(scene: mi.Scene, last: Sequence[mi.Shape]) -> list[mi.Shape]:
    """Raise UnsupportedError for instances of Gaussians; last: those already checked."""
    instances = [shape for shape in scene.shapes() if shape.class_name() == "Instance"]
    if not instances or list(map(id, instances)) == list(map(id, last)):
        return instances
    repeated, shapes = mi.traverse(scene).hierarchy, scene.shapes()
    for node, (group, _) in repeated.items():
        if isinstance(node, mi.Shape) and node.is_ellipsoids() and node not in shapes:
            raise UnsupportedError(
                f"splats: shape group '{group.id()}' holds Gaussians (shape '{node.id()}'), whose "
                "instances are not supported: use a shape of type ellipsoids for each, with a "
                "to_world, or a nested splats"
            )
    return instances


def check_image(film: mi.Film, spp: int, poses: int, num_aovs: int, nested_spp: int) -> None:
    """Raise PluginError for an image that does not fit into memory.

    spp: of the splats; poses: of the sensor; num_aovs: channels besides colour and alpha;
    nested_spp: of the nested integrator, 0 for none.
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
            "the mean of images with other seeds, or, for surfaces alone, set nested_spp"
        )
    why = too_large_reason(width, height, 3 + num_aovs, spp * poses)
    if why is not None:
        raise PluginError(f"splats: {why}")
    samples, most = width * height * nested_spp, MAX_LANES
    if samples * NESTED_SAMPLE_BYTES > UNCHECKED_BYTES:
        most = min(most, available_memory() // NESTED_SAMPLE_BYTES)
    if samples > most:
        raise PluginError(
            f"splats: on a film of {width} x {height} px, nested_spp (or spp) must be at most "
            f"{most // (width * height):,}, got {nested_spp:,}; take the mean of images "
            "with other seeds"
        )


def check_ids(parameter: str, names: Sequence[str], nodes: Sequence[mi.Object]) -> None:
    """Raise PluginError for names that are no node's id; parameter: the property, in words."""
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
