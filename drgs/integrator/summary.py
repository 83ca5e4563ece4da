"""Summary of simulated effects, the reason for each, and of effects that are not simulated.

Commands print one at their start, a line an effect: :func:`summary_of_sensors` for a Mitsuba scene,
:func:`summary_of_views` for images of Gaussians, ``drgs.fit.summary`` for a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import mitsuba as mi

from drgs.cameras.camera import Camera
from drgs.cameras.lens import Pinhole
from drgs.cameras.viewpoints import Viewpoint
from drgs.effects.base import SimulatedEffect, antialiasing_effect
from drgs.effects.compose import without_effects
from drgs.integrator.sensors import camera_from_sensor, read_sensor, sensors_of
from drgs.integrator.state import SplatsState, surfaces_in

FILE_HEADER_REASON = "set by the file"  # for effects that the header of the Gaussians' file sets


def format_effects(effects: Sequence[SimulatedEffect]) -> str:
    """Format the summary: a line for each simulated effect, one for all the others."""
    lines = [f"  {e.name}: {e.what} ({e.why})" for e in effects if e.what is not None]
    others = [e for e in effects if e.what is None or e.ignored]
    absent = [f"{e.name} (ignored)" if e.ignored else e.name for e in others]
    if absent:
        lines.append(f"  not simulated: {', '.join(absent)}")
    return "simulated:\n" + "\n".join(lines)


def summary_of_scene(splats: SplatsState, scene: mi.Scene, sensors: Sequence[mi.Sensor]) -> str:
    """Return the summary of the integrator ``splats``, whose Gaussians are up to date."""
    alone = [one for sensor in sensors for one in sensors_of(sensor)]
    cameras = [camera_from_sensor(read_sensor(one, splats.near)) for one in alone]
    count = len(surfaces_in(scene))
    return format_effects(summary_of_sensors(splats, cameras, scene.environment(), count))


def summary_of_sensors(
    splats: SplatsState,
    cameras: Sequence[Camera],
    environment: mi.Emitter | None,
    num_surfaces: int = 0,
) -> list[SimulatedEffect]:
    """Return the effects that ``splats`` simulates.

    cameras: of the sensors, with ignored effects; num_surfaces: shapes that are no Gaussians.
    """
    left = [without_effects(camera, splats.ignore) for camera in cameras]

    def effect(name: str, words: Callable[[Camera], str | None]) -> SimulatedEffect:
        """Summarise one effect; words: describes a camera's effect, or returns None."""
        shown = [what for what in map(words, left) if what is not None]
        why = "the sensor" if len(left) == 1 else f"{len(shown)} of {len(left)} sensors"
        ignored = sum(words(camera) is not None for camera in cameras) > len(shown)
        return SimulatedEffect(name, " and ".join(sorted(set(shown))) or None, why, ignored)

    def lens_words(camera: Camera) -> str | None:
        names = ", ".join(camera.lens.coefficients())
        described = type(camera.lens).__name__ + (f" ({names})" if names else "")
        return None if isinstance(camera.lens, Pinhole) else described

    of_cameras = [
        effect("lens", lens_words),
        effect("depth of field", lambda camera: None if camera.aperture is None else "a thin lens"),
        effect("motion", lambda camera: None if camera.shutter is None else camera.shutter.label),
    ]
    image = "a nested integrator's image, between the splats" if num_surfaces else None
    surfaces = SimulatedEffect("surfaces", image, f"{num_surfaces} of the scene's shapes")
    rays = None if splats.lighting.light == "none" else "along rays of surfaces"
    light = SimulatedEffect("light between splats and surfaces", rays, "the integrator's light")
    of_integrator = _summary_of_integrator(splats, environment, of_cameras, splats.header)
    return [*of_integrator, surfaces, *([light] if num_surfaces else [])]


def summary_of_views(
    splats: SplatsState, views: Sequence[Viewpoint], from_header: Collection[str] = ()
) -> list[SimulatedEffect]:
    """Return the effects for views; from_header: approximations that the file's header sets."""
    of_cameras = [
        effect_of(views, f"{len(views)} cameras").unless_ignored(word in splats.ignore)
        for effect_of, word in ((lens_effect, "distortion"), (motion_effect, "motion"))
    ]
    return _summary_of_integrator(splats, None, of_cameras, from_header)


def _summary_of_integrator(
    splats: SplatsState,
    environment: mi.Emitter | None,
    of_cameras: Sequence[SimulatedEffect],
    from_header: Collection[str],
) -> list[SimulatedEffect]:
    background = SimulatedEffect("background", "a constant colour", "the integrator's background")
    if environment is not None and not splats.hide_emitters:
        background = SimulatedEffect("background", "an environment", "the scene's emitter")
    elif isinstance(splats.background, mi.Texture):
        background = SimulatedEffect("background", "an image", "the integrator's background")
    smooth = splats.gaussians.smoothing is not None
    antialiased = FILE_HEADER_REASON if "antialiased" in from_header else "antialiased"
    antialiased = antialiased if splats.approximations.antialiased else None
    effects = [
        view_dependence_effect(splats.sh_degree, "the Gaussians' coefficients"),
        background,
        *of_cameras,
        antialiasing_effect(antialiased, "the Gaussians' filter" if smooth else None),
    ]
    own = [one.gaussians.smoothing for one in splats.objects.values()]
    if not smooth and any(filters is not None for filters in own):
        effects.append(SimulatedEffect("smoothing filter", None, ignored=True))
    others = splats.approximations.non_default
    values = [f"{k} = {v}" for k, v in others.items() if k in from_header and k != "antialiased"]
    if values:
        effects.append(SimulatedEffect("approximations", ", ".join(values), FILE_HEADER_REASON))
    return effects


def view_dependence_effect(degree: int, why: str) -> SimulatedEffect:
    """Summarise view-dependent colours; degree: of the spherical harmonics."""
    what = None if degree == 0 else f"spherical harmonics up to degree {degree}"
    return SimulatedEffect("view dependence", what, why)


def lens_effect(views: Sequence[Viewpoint], of: str = "the dataset's cameras") -> SimulatedEffect:
    """Summarise lenses that are no pinholes; of: all cameras, in words."""
    bent = [view.lens for view in views if view.lens is not None]
    kinds = sorted({lens.describe() for lens in bent})
    return SimulatedEffect("lens distortion", " and ".join(kinds) or None, f"{len(bent)} of {of}")


def motion_effect(views: Sequence[Viewpoint], of: str = "the dataset's cameras") -> SimulatedEffect:
    """Summarise cameras that move during an exposure; of: all cameras, in words."""
    moving = [view.motion.shutter for view in views if view.motion is not None]
    shutters = " and ".join(f"{kind} shutter" for kind in sorted(set(moving)))
    return SimulatedEffect("motion", shutters or None, f"{len(moving)} of {of}")
