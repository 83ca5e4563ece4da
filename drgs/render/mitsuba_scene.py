"""Images of a Mitsuba scene file: an EXR and a PNG for each sensor."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import numpy as np

from drgs.core.errors import PluginError, UserError, reason_of_mitsuba
from drgs.core.files import shorten_stem
from drgs.integrator.state import is_splats
from drgs.io.images import write_exr
from drgs.io.scenes import load_scene_file
from drgs.results.folder import ERROR_BUDGET
from drgs.results.model import BUDGET_KEY, ImageFolder


def render_mitsuba_scene(
    path: Path, folder: ImageFolder, definitions: dict[str, str], budget: float | None = None
) -> None:
    """Render every sensor of a Mitsuba scene to EXR (all channels) and PNG (colours in sRGB).

    definitions: of the scene file's parameters ($name); budget: of the error, for the scene's own.
    """
    try:
        scene = load_scene_file(path, **definitions)
    except RuntimeError as error:
        raise UserError(f"{path}: {reason_of_mitsuba(error)}") from None
    if not isinstance(scene, mi.Scene) or scene.integrator() is None or not scene.sensors():
        raise UserError(f"{path}: the scene must hold an integrator and at least one sensor")
    integrator = scene.integrator()
    splats = integrator.state if is_splats(integrator) else None
    if budget is not None:
        if splats is None:
            raise UserError("--error: the scene's own integrator must be splats")
        splats.error, splats.budget_report = budget, None
    stem, count = shorten_stem(path.stem), len(scene.sensors())
    names = [stem] if count == 1 else [f"{stem}_{index}" for index in range(count)]
    files = [f"{name}.{suffix}" for name in names for suffix in ("exr", "png")]
    files += [ERROR_BUDGET] if splats is not None and splats.error is not None else []
    bitmaps = folder.claim(files, _render_sensors(path, scene))
    # Nested integrators, such as ``volprim_rf_basic``, may encode colours.
    nested = mi.traverse(integrator).hierarchy
    is_linear = all(getattr(each, "srgb_primitives", True) for each in nested)
    for name, bitmap in zip(names, bitmaps, strict=True):
        width, height = bitmap.size()
        if splats is not None and splats.budget_report is not None:
            folder.budget = splats.budget_report
            bitmap.metadata()[BUDGET_KEY] = json.dumps(splats.budget_report.record())
        write_exr(folder.path / f"{name}.exr", bitmap)
        # As floats: Mitsuba's own conversion to 8 bits rounds down.
        colors = bitmap.split()[0][1].convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=is_linear
        )
        # NaN in a scene's light is black in the PNG, and kept in the EXR.
        folder.write_png(f"{name}.png", np.nan_to_num(np.array(colors)))
        print(f"{name}: {width}x{height}")
    folder.write_budget()


def _render_sensors(path: Path, scene: mi.Scene) -> Iterator[mi.Bitmap]:
    """Yield the image of each sensor, with all channels."""
    integrator, sensors = scene.integrator(), scene.sensors()
    try:
        if is_splats(integrator):
            print(integrator.summary(scene, *sensors), flush=True)
            if integrator.state.budget_report is not None:
                print(integrator.state.budget_report.line(), flush=True)
        for index, sensor in enumerate(sensors):
            integrator.render(scene, sensor=index)
            yield sensor.film().bitmap()
    except PluginError as error:  # the scene's fault; anything else is not
        raise UserError(f"{path}: {reason_of_mitsuba(error)}") from None
