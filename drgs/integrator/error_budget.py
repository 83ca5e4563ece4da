"""Error budgets of the integrator ``splats``: images for the search, and what its choice rests on.

Images are the integrator's own: with an environment, a texture or surfaces behind the splats, and
with light between them. Surfaces have the radiance of a few paths per pixel, the same in all images
unless it depends on the splats: its noise adds to errors, and hides none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

import drgs
from drgs.accuracy.error_budget import SAMPLES, BudgetReport, Choice, Renderer, Search, Window, crop
from drgs.accuracy.pipeline import pipeline_of
from drgs.cameras.camera import Camera, cameras_in_time
from drgs.config.approximations import Approximations
from drgs.core.arrays import types_of
from drgs.core.errors import PluginError, format_names
from drgs.core.private import same_variables
from drgs.effects.compose import with_effects, without_effects
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.film import pixel_corners
from drgs.integrator.image_render import SensorRender, constant_background, nested_surfaces
from drgs.integrator.light.derivatives import parameter_value
from drgs.integrator.sensors import camera_from_sensor, read_sensor, sensors_of
from drgs.integrator.state import SplatsState
from drgs.light.walk import RaySplats, Segment
from drgs.splatting import rendering
from drgs.splatting.footprint import PixelCenters
from drgs.splatting.projection import load_rows

PATHS = 16  # per pixel, of the radiance of surfaces
APERTURE_POINTS, APERTURE_WINDOW = 32, 4
RESIDUAL_PX = 48  # side of the part of a window in which rays are traced
FILM_NUMBERS = ("width", "height", "crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
LARGE = 0.25  # standard deviation of a splat relative to its depth, whose order is hard to find


def renderer_of(
    gaussians: Gaussians,
    given: Approximations,
    sh_degree: int,
    background: tuple[float, float, float],
) -> Renderer:
    """Return the renderer of Gaussians on the device, over a background in display space."""

    def draw(
        camera: Camera, window: Window | None, approximations: Approximations, samples: int
    ) -> np.ndarray:
        images, color = [], np.array(background, np.float32)
        camera = camera if window is None else crop(camera, *window)
        for one in cameras_in_time(camera, samples):
            with dr.suspend_grad():
                pipeline = with_effects(pipeline_of(approximations, sh_degree), gaussians, one)
                planes = rendering.render(gaussians, one, pipeline).planes()
                dr.eval(planes)
            transmittance, *colors = (np.array(plane) for plane in planes)
            images.append(np.stack(colors, axis=-1) + transmittance[:, None] * color)
        return np.mean(images, axis=0).reshape(camera.height, camera.width, 3)

    return Renderer(draw, given, partial(ray_residual, gaussians, sh_degree, {}))


def ray_residual(
    gaussians: Gaussians,
    sh_degree: int,
    kept: dict[tuple, np.ndarray],
    camera: Camera,
    window: Window,
    approximations: Approximations,
) -> float:
    """Return the mean square difference between an image and exact colours along its rays.

    Rays composite all Gaussians in the order of their peaks (:mod:`drgs.light.walk`), over black or
    white, without the low-pass filter, which rays do not have. Filtered images differ less: as much
    as those of half the window of splats do, with it and without. 0 where no visible Gaussian is
    :data:`LARGE`, and for cameras that move. With an aperture, see :func:`aperture_residual`.
    kept: colours along rays, for other orders.
    """
    key, (x, y, *sides) = (id(camera), window), window
    left, top = (max(side - RESIDUAL_PX, 0) // 2 for side in sides)
    width, height = (min(side, RESIDUAL_PX) for side in sides)
    whole, camera = camera, crop(camera, x + left, y + top, width, height)
    if camera.aperture is not None:
        return aperture_residual(gaussians, sh_degree, camera, approximations)
    rows, t = load_rows(gaussians, sh_degree), types_of(type(camera.near))
    position = camera.rotation @ (rows.means - camera.center)
    visible, _, depth = camera.lens.visibility(whole, position)
    is_large = dr.exp(dr.max(rows.log_scales)) > LARGE * depth
    if camera.shutter is not None or not dr.any(visible & is_large):
        return 0.0

    def planes(low_pass: float, window: int) -> np.ndarray:
        how = replace(approximations, low_pass=low_pass, order_window=window)
        pipeline = with_effects(pipeline_of(how, sh_degree), gaussians, camera)
        frame = rendering.render(gaussians, camera, pipeline)
        return np.array([np.array(plane) for plane in frame.planes()], np.float64)

    if key not in kept:
        pipeline = with_effects(pipeline_of(approximations, sh_degree), gaussians, camera)
        rows = replace(rows, logit_opacities=dr.select(visible, rows.logit_opacities, -dr.inf))
        splats = RaySplats.from_gaussians(pipeline.rows(rows), sh_degree, pipeline.model.cutoffs)
        row, column = (each.ravel() + 0.5 for each in np.indices((height, width)))
        origin, towards, seen = camera.look_through(t.Float(column), t.Float(row))
        origin = camera.center + camera.rotation.T @ origin + dr.zeros(t.Array3f, len(row))
        towards, far = dr.normalize(camera.rotation.T @ towards), dr.full(t.Float, dr.inf, len(row))
        color, rest = splats.composite_segment(Segment(origin, towards, far, (far > 0) & seen))
        kept[key] = np.array([np.array(plane) for plane in (rest, *color)], np.float64)
    count, low_pass = approximations.order_window, approximations.low_pass
    sharp, filtered = planes(0.0, count), planes(low_pass, count)
    changes = [
        np.square(planes(size, max(count // 2, 1)) - one).sum()
        for size, one in ((low_pass, filtered), (0.0, sharp))
    ]
    rest, *color = sharp - kept[key]
    square = max(float(np.mean(np.square(color + white * rest))) for white in (0, 1))
    return square * float(min(changes[0] / max(changes[1], 1e-20), 1.0) if low_pass else 1.0)


def aperture_residual(
    gaussians: Gaussians, sh_degree: int, camera: Camera, approximations: Approximations
) -> float:
    """Return the mean square difference from the mean of pinholes' images, all over an aperture.

    Over black or white, with a small window of splats: orders differ over the aperture.
    """
    pipeline = pipeline_of(replace(approximations, order_window=APERTURE_WINDOW), sh_degree)

    def planes(one: Camera) -> np.ndarray:
        frame = rendering.render(gaussians, one, with_effects(pipeline, gaussians, one))
        return np.array([np.array(plane) for plane in frame.planes()], np.float64)

    assert camera.aperture is not None, "that of the camera"
    pinholes = camera.aperture.cameras(camera, APERTURE_POINTS)
    rest, *color = planes(camera) - np.mean([planes(one) for one in pinholes], axis=0)
    return max(float(np.mean(np.square(color + white * rest))) for white in (0, 1))


@dataclass(frozen=True, eq=False)
class SceneRenderer:
    """Renders views of a scene in display space; see :attr:`.Renderer.draw`."""

    splats: SplatsState  # a copy with a cache of its own
    scene: mi.Scene
    views: list[tuple[Camera, mi.Sensor]]

    def draw(
        self, camera: Camera, window: Window | None, approximations: Approximations, samples: int
    ) -> np.ndarray:
        """Render a view or its window."""
        sensor = next(sensor for one, sensor in self.views if one is camera)
        splats, cache = self.splats, self.splats.cache
        choice = Choice(approximations, {SAMPLES: samples}, 0.0, 0.0)
        splats.budget_report = BudgetReport(0.0, choice, (), None, None)
        x, y, *size = window or (0, 0, camera.width, camera.height)
        film, place = sensor.film(), f"{id(camera)} {window}"
        left, top = film.crop_offset()
        numbers = map(int, (*film.size(), left + x, top + y, *size))
        part = {"type": "hdrfilm", **dict(zip(FILM_NUMBERS, numbers, strict=True))}
        index = cache.find(f"number of {place}", (), (), lambda: len(cache.kept)).value
        nested = nested_surfaces(splats, self.scene, sensor, 0, 0)
        positions, part = (PixelCenters(),), mi.load_dict(part)
        # The positions never change, and there is no alpha.
        view = SensorRender(splats, self.scene, index, sensor, positions, None, False, nested, part)
        if nested is not None:
            view = replace(view, nested=nested.with_surfaces(view.num_surfaces(nested)))
        (channels,) = view.channels(view.planes(), constant_background(splats))
        cache.forget("frames")
        color, own = mi.Color3f(channels[:3]), channels[3:]
        if view.nested is not None:
            compositor = view.nested.compositor
            behind = own[2 * compositor.num_surfaces :] or [mi.Float(0)] * 3
            images = [*self._nested_images(view, place), behind]
            color += mi.Color3f(compositor.visible_radiance(own, images))
        if splats.srgb_primitives:
            color = mi.math.linear_to_srgb(color)
        return np.array(color).T.reshape(*size[::-1], 3)

    def _nested_images(self, view: SensorRender, place: str) -> list[list[mi.Float]]:
        """Return the nested images N_0, N_1, ... of a view, linear."""
        sensor, nested, part = view.sensor, view.nested, view.window
        assert nested is not None and part is not None, "rendered where there are surfaces"
        is_lit = self.splats.lighting.light != "none"

        def trace() -> list[list[mi.Float]]:
            sampler, film = mi.load_dict({"type": "independent"}), sensor.film()
            sampler.seed(0, int(dr.prod(part.crop_size())) * PATHS)
            corner = mi.Vector2f(part.crop_offset()) - mi.Vector2f(film.crop_offset())
            corner += dr.repeat(pixel_corners(part), PATHS)
            point = mi.Point2f(corner + sampler.next_2d()) / mi.Vector2f(film.crop_size())
            time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
            ray, weight = sensor.sample_ray_differential(
                time, sampler.next_1d(), point, sampler.next_2d()
            )
            images = nested.radiances(ray, sampler, mi.Bool(True))
            images = [[dr.block_sum(c, PATHS) / PATHS for c in weight * one] for one in images]
            dr.eval(images)
            return images

        settings = is_lit and self.splats.approximations, nested.surfaces
        return self.splats.cache.find(f"nested {place}", settings, (), trace).value


def meet_error_budget(
    splats: SplatsState, scene: mi.Scene, sensors: Sequence[mi.Sensor], budget: float
) -> BudgetReport:
    """Set the cheapest approximations whose images are within ``budget``; return what was found.

    sensors: those that are to be rendered. Films' filters and AOVs are left out of what is
    measured. Raises :class:`PluginError` if the budget cannot be met.
    """
    alone = [one for sensor in sensors for one in sensors_of(sensor)]
    copy = replace(splats, aovs={}, cache=replace(splats.cache, kept={}), projected_view=None)
    try:
        with dr.suspend_grad():
            cameras = [
                without_effects(camera_from_sensor(read_sensor(one, splats.near)), splats.ignore)
                for one in alone
            ]
            drawer = SceneRenderer(copy, scene, list(zip(cameras, alone, strict=True)))
            residual = partial(ray_residual, dr.detach(copy.gaussians), copy.sh_degree, {})
            renderer = Renderer(drawer.draw, splats.given_approximations, residual)
            report = splats.budget_report = Search(renderer, cameras, budget).choose(budget)
    except ValueError as error:
        raise PluginError(f"splats: error {error}") from None
    return report


def keep_error_budget(splats: SplatsState, scene: mi.Scene) -> None:
    """Choose approximations for the error budget once; then mark the choice where it is stale.

    A choice is kept when Gaussians, sensors or anything else change, as they do in each step of an
    optimisation; the first change is logged, and recorded in ``budget_report``.
    """
    rendered, report = splats.cache.sensor, splats.budget_report
    sensors = scene.sensors() or ([] if rendered is None else [rendered])
    if not sensors or (report is not None and report.stale):
        return
    now, near = parameters_of(scene), splats.near
    if report is None:
        report = meet_error_budget(splats, scene, sensors, splats.given_error or 0.0)
        splats.budget_evidence = now, sensors, [camera_values(one, near) for one in sensors]
        mi.Log(mi.LogLevel.Info, report.line())  # pyright: ignore[reportCallIssue]  no type
        return
    then, measured, cameras = splats.budget_evidence
    names = [k for k in now | then if not _is_same(now.get(k), then.get(k))]
    if rendered is not None and all(rendered is not one for one in measured):
        names += ["the sensor"] * (camera_values(rendered, near) not in cameras)
    if names:
        report = splats.budget_report = replace(report, stale=format_names(names))
        message = (
            f"splats: error {report.budget:.2g}: approximations stay as measured before a change "
            f"of {report.stale}; set 'error' again to measure anew"
        )
        mi.Log(mi.LogLevel.Warn, message)  # pyright: ignore[reportCallIssue]  no type


def _is_same(one: object, other: object) -> bool:
    if dr.is_jit_v(one) and dr.is_jit_v(other):
        return same_variables(one, other)
    return type(one) is type(other) and bool(np.all(one == other))


def parameters_of(scene: mi.Scene) -> dict[str, object]:
    """Return all parameters of a scene, detached: held, so that equal indices mean equal values."""
    params = mi.traverse(scene)
    return dr.detach({name: parameter_value(params, name) for name in params.properties})


def camera_values(sensor: mi.Sensor, near: float) -> list[object]:
    """Return what the cameras of a sensor depend on, on the host."""
    states = [read_sensor(one, near).detach() for one in sensors_of(sensor)]
    return [[s.host, {k: np.array(v).tolist() for k, v in s.device.items()}] for s in states]


def digest_of(splats: SplatsState, scene: mi.Scene, sensors: Sequence[mi.Sensor]) -> str:
    """Return a digest of all that a choice for these sensors depends on, but for the budget."""
    cameras = [(str(one), camera_values(one, splats.near)) for one in sensors]
    settings = splats.given_approximations, splats.settings(), mi.variant(), drgs.__version__
    found = hashlib.sha256(repr((settings, cameras)).encode())
    parameters = parameters_of(scene) | {"smoothing": splats.smoothing}
    for name, value in sorted(parameters.items()):
        array = np.array(value)
        found.update(repr((name, array.shape, str(array.dtype))).encode())
        found.update(repr(value).encode() if array.dtype == object else array.tobytes())
    return found.hexdigest()
