"""Shapes of a scene: those that hold Gaussians, and surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi

from drgs.core.errors import UnsupportedError


def ellipsoids_in(scene: mi.Scene) -> list[mi.Shape]:
    """Shapes whose Gaussians are rendered as splats."""
    return [shape for shape in scene.shapes() if shape.is_ellipsoids()]


def surfaces_in(scene: mi.Scene) -> list[mi.Shape]:
    """All other shapes."""
    return [shape for shape in scene.shapes() if not shape.is_ellipsoids()]


def check_instances(scene: mi.Scene, last: Sequence[mi.Shape]) -> list[mi.Shape]:
    """Raise UnsupportedError where a scene has instances, and Gaussians in a shape group.

    Surfaces would show these as dark solids. last: the result of the last call, which holds what
    has been checked: a shape group stays as it was loaded.
    """
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
