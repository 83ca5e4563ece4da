"""Which effects a scene calls for, what asked for each, and what is not simulated.

An effect is composed in when the dataset, the sensor or the configuration calls for it. What is not
called for is not imported. :func:`summary_of_fit`, :func:`summary_of_views` and
:func:`summary_of_sensors` are what commands print at their start: one line an effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from drgs.data.types import View
from drgs.effects.compose import ignoring

# ----------------------------------------------------------------------------------------------
# Plans
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Effect:
    """A line of a plan."""

    name: str
    what: str | None  # that is simulated; None: nothing is
    why: str = ""  # what asked for it
    ignored: bool = False  # whether it is asked for where it is not to be simulated


def described(effects: Sequence[Effect]) -> str:
    """The plan as text: one line for each effect that is simulated, one for all the others."""
    lines = [f"  {e.name}: {e.what} ({e.why})" for e in effects if e.what is not None]
    absent = [
        f"{e.name} (ignored)" if e.ignored else e.name
        for e in effects
        if e.what is None or e.ignored
    ]
    if absent:
        lines.append(f"  not simulated: {', '.join(absent)}")
    return "simulated:\n" + "\n".join(lines)


def summary_of_sensors(
    integrator: Any, cameras: Sequence[Any], environment: Any, num_surfaces: int = 0
) -> list[Effect]:
    """What the integrator ``splats`` simulates for sensors in front of an environment.

    cameras: as the sensors have them, so that what the integrator ignores of them can be named;
    num_surfaces: shapes of the scene that are no Gaussians.
    """
    left = [ignoring(camera, integrator.ignore) for camera in cameras]

    def effect(name: str, words: Callable[[Any], str | None]) -> Effect:
        """words: what a camera has of it, or None."""
        shown = [what for what in map(words, left) if what is not None]
        why = "the sensor" if len(left) == 1 else f"{len(shown)} of {len(left)} sensors"
        ignored = sum(words(camera) is not None for camera in cameras) > len(shown)
        return Effect(name, " and ".join(sorted(set(shown))) or None, why, ignored)

    of_cameras = [
        effect("lens", lambda camera: _lens_words(camera.lens)),
        effect("depth of field", lambda camera: None if camera.aperture is None else "a thin lens"),
        effect("motion", lambda camera: _MOTION[type(camera.shutter).__name__]),
    ]
    surfaces = Effect(
        "surfaces",
        "a nested integrator's picture, between the splats" if num_surfaces else None,
        f"{num_surfaces} of the scene's shapes",
    )
    return [*_summary_of_integrator(integrator, environment, of_cameras), surfaces]


def summary_of_views(integrator: Any, views: Sequence[Any]) -> list[Effect]:
    """The same for views or viewpoints, with nothing behind but the integrator's background."""
    count = f"{len(views)} cameras"
    of_cameras = [
        _unless_ignored(effect_of(views, count), word in integrator.ignore)
        for effect_of, word in ((lens_effect, "distortion"), (motion_effect, "motion"))
    ]
    return _summary_of_integrator(integrator, None, of_cameras)


def _summary_of_integrator(
    integrator: Any, environment: Any, of_cameras: Sequence[Effect]
) -> list[Effect]:
    background = Effect("background", "a constant colour", "the integrator's background")
    if environment is not None and not integrator.hide_emitters:
        background = Effect("background", "an environment", "the scene's emitter")
    elif hasattr(integrator.background, "eval"):
        background = Effect("background", "a picture", "the integrator's background")
    smooth = integrator.gaussians.smoothing is not None
    effects = [
        _view_dependence(integrator.sh_degree, "the Gaussians' coefficients"),
        background,
        *of_cameras,
        _antialiasing(
            "antialiased" if integrator.approximations.antialiased else None,
            "the Gaussians' filter" if smooth else None,
        ),
    ]
    if integrator.smoothing is not None and not smooth:
        effects.append(Effect("smoothing filter", None, ignored=True))
    return effects


_MOTION = {"NoneType": None, "MotionBlur": "blurred", "RollingShutter": "rolling shutter"}
"""By the name of a camera's shutter, whose module is imported where there is one."""


def _lens_words(lens: Any) -> str | None:
    if type(lens).__name__ == "Pinhole":
        return None
    names = ", ".join(lens.named())
    return type(lens).__name__ + (f" ({names})" if names else "")


def _antialiasing(opacities: str | None, smoothing: str | None) -> Effect:
    """By what asked for either."""
    what = _joined(
        "opacities compensated for the low-pass filter" if opacities else None,
        "3D smoothing filter" if smoothing else None,
    )
    return Effect("antialiasing", what, _joined(opacities, smoothing) or "")


def _view_dependence(degree: int, why: str) -> Effect:
    what = None if degree == 0 else f"spherical harmonics up to degree {degree}"
    return Effect("view dependence", what, why)


def lens_effect(views: Sequence[View], of: str = "the dataset's cameras") -> Effect:
    """Lenses that are no pinholes; of: whose."""
    bent = [view.lens for view in views if view.lens is not None]
    kinds = sorted({f"{lens.kind} ({', '.join(lens.named())})" for lens in bent})
    return Effect("lens distortion", " and ".join(kinds) or None, f"{len(bent)} of {of}")


def motion_effect(views: Sequence[View], of: str = "the dataset's cameras") -> Effect:
    """Cameras that move while a photograph is taken; of: whose."""
    moving = [view.motion.shutter for view in views if view.motion is not None]
    shutters = " and ".join(f"{kind} shutter" for kind in sorted(set(moving)))
    return Effect("motion", shutters or None, f"{len(moving)} of {of}")


def _unless_ignored(effect: Effect, is_ignored: bool) -> Effect:
    if is_ignored and effect.what is not None:
        return replace(effect, what=None, ignored=True)
    return effect


def _joined(*parts: str | None) -> str | None:
    return ", ".join(part for part in parts if part) or None
