"""An image of one sensor: frames, their planes, and the channels of its film.

A :class:`SensorRender` renders a frame (``drgs.splatting.rendering``) for each time of the shutter
and each pass of samples, or reuses those of the last image. It composites them over the background
and adds the surfaces. Derivatives of a background's texels are added atomically: runs agree only up
to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, repeat
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from drgs.cameras.camera import Camera, cameras_in_time
from drgs.core.types import Float
from drgs.effects.compose import with_effects, without_effects
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.film import Channels, num_samples, pixel_corners, sample_offsets
from drgs.integrator.sensors import SensorState, camera_from_sensor, depth_range, read_sensor
from drgs.integrator.state import Cached, SplatsState
from drgs.splatting import rendering
from drgs.splatting.footprint import SamplePositions

if TYPE_CHECKING:  # imported where a scene has surfaces
    from drgs.integrator.surfaces import Hybrid
    from drgs.integrator.visible_surfaces import SurfaceLayers


Passes = list[Channels]  # channels by pass: one sample per pixel or, on a small film, several
Planes = list[list[list[Float]]]  # planes of frames, each (samples * H * W,), by time and by pass
PASSES_PER_KERNEL = 16  # passes or times between evaluations: compile time is superlinear


@dataclass(frozen=True, eq=False)
class SensorRender:
    """The image of one sensor, alone or in a batch."""

    splats: SplatsState
    scene: mi.Scene
    index: int  # of the view, in the cache
    sensor: mi.Sensor
    positions: Sequence[SamplePositions]  # by pass
    key: object  # of the positions: see drgs.integrator.film.CenterSamples
    has_alpha: bool
    hybrid: Hybrid | None  # the part of surfaces, if there are any

    def planes(self) -> Planes:
        """Return the planes of all frames, unevaluated."""
        return [[frame.planes() for frame in of_time] for of_time in self._frames()]

    def plane_tangents(self, tangents: Gaussians) -> Planes:
        """Return tangents of planes along those of the Gaussians and of the sensor."""
        frames = self._frames()
        with dr.resume_grad():
            d_cameras = self._camera_tangents(len(frames))
        return [
            rendering.frames_tangent(self.splats.gaussians, of_time, tangents, d_camera)
            for of_time, d_camera in zip(frames, d_cameras, strict=True)
        ]

    def backward(self, d_channels: Passes) -> rendering.GaussianGradients:
        """Return derivatives with respect to the Gaussians; accumulate all others."""
        planes, constant = self.planes(), constant_background(self.splats)
        with dr.resume_grad():
            of_background = constant is not None and dr.grad_enabled(self.splats.background)
            # Colours are converted again, and differentiated by Dr.Jit.
            dr.enable_grad(planes)
            if of_background:
                dr.enable_grad(constant)
            channels = self.channels(planes, constant)
            dr.accum_grad(channels, d_channels)
            dr.enqueue(dr.ADMode.Backward, channels)
            # Keep edges: other images of the same pass differentiate computed textures again.
            dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
            d_planes = dr.grad(planes)
            d_constant = dr.grad(constant) if of_background else None
        d_passes = list(chain(*d_planes))
        for first in range(0, len(d_passes), PASSES_PER_KERNEL):
            dr.eval(d_passes[first : first + PASSES_PER_KERNEL], d_constant)
        with dr.resume_grad():
            state = self._state()
            of_camera = state.is_attached
        by_time = [
            rendering.frames_adjoint(self.splats.gaussians, *of_time, of_camera)
            for of_time in zip(self._frames(), d_planes, strict=True)
        ]
        with dr.resume_grad():
            if of_background:
                dr.accum_grad(self.splats.background, d_constant)
            of_cameras = [gradients.camera for gradients in by_time if gradients.camera]
            if of_cameras:
                accumulate_in_sensor(self._attached_cameras(state), of_cameras)
        return reduce(rendering.sum_of_gradients, by_time)

    def channels(self, planes: Planes, constant: mi.Color3f | None) -> Passes:
        """Return the mean over times of each pass's channels; constant: the background."""
        behind = self._render_behind(constant)
        seen = repeat(repeat(None))
        if self.hybrid is not None:
            seen = self._traced_surfaces(self.hybrid, self._state().detach()).value
        by_time = zip(planes, seen, behind.colors, behind.radiance, strict=False)
        channels = [
            [self._channels_of(behind, *sample) for sample in zip(*time, strict=False)]
            for time in by_time
        ]
        return channels[0] if len(channels) == 1 else _mean(channels)

    def _channels_of(
        self,
        behind: _Background,
        planes: list[Float],
        layers: SurfaceLayers | None,
        color: mi.Color3f,
        radiance: mi.Color3f | None,
    ) -> Channels:
        """Return a sample's channels; layers: visible surfaces, None in a scene without any."""
        if layers is None:
            return self._to_channels(planes, mi.Float(1), behind, color)
        from drgs.integrator.visible_surfaces import transmittance_behind

        planes, fronts = planes[: -len(layers)], planes[-len(layers) :]
        pairs = list(zip(layers, fronts, strict=True))
        whole = mi.Float(1)
        for surface, front in pairs:
            whole = whole - surface.share(front)

        def of_surfaces(kind: str) -> Channels | None:
            values = [surface.aov_values(kind, front) for surface, front in pairs]
            found = [of_surface for of_surface in values if of_surface is not None]
            return [_sum(terms) for terms in zip(*found, strict=True)] if found else None

        past = [transmittance_behind(layers) * planes[0], *planes[1:]]
        own = self._to_channels(past, whole, behind, color, of_surfaces)
        assert self.hybrid is not None, "its surfaces are the layers"
        return own + self.hybrid.insertion.values(layers, fronts, radiance)

    def _to_channels(
        self,
        planes: list[Float],
        whole: mi.Float,
        behind: _Background,
        color_behind: mi.Color3f,
        of_surfaces: Callable[[str], Channels | None] = lambda kind: None,
    ) -> Channels:
        """Turn planes of pixels into channels: red, green, blue, perhaps alpha, AOVs.

        whole: sum of the weights of splats and background, 1 less the shares of surfaces;
        of_surfaces: the surfaces' contribution to an AOV of a kind.
        """
        transmittance, red, green, blue, *others = planes
        color, alpha = mi.Color3f(red, green, blue), 1 - transmittance
        if not self.splats.srgb_primitives:
            color = dr.fma(transmittance, color_behind, color)
        elif behind.is_radiance:
            color = dr.fma(transmittance, color_behind, decode(color, whole - transmittance))
        else:  # the background is the last splat
            color = decode(dr.fma(transmittance, color_behind, color), whole)
        channels = list(color)
        if self.has_alpha:
            channels.append(dr.full(mi.Float, 1, dr.width(alpha)) if behind.is_radiance else alpha)
        for kind in self.splats.aovs.values():
            if kind == "alpha":
                channels.append(alpha)
                continue
            values = [others.pop(0) for _ in self.splats.channels_of(kind)]
            more = of_surfaces(kind)
            if more is not None:
                values = [a + b for a, b in zip(values, more, strict=True)]
            channels += values
        return channels

    def _render_behind(self, constant: mi.Color3f | None) -> _Background:
        splats = self.splats
        environment = None if splats.hide_emitters else self.scene.environment()
        if environment is None and constant is not None:
            nothing = repeat(repeat(None))
            return _Background(repeat(repeat(constant)), is_radiance=False, radiance=nothing)
        behind = splats.background if environment is None else environment
        assert isinstance(behind, (mi.Emitter, mi.Texture)), "a colour would be constant"
        state = self._state()
        cameras = [of_time[0].camera for of_time in self._frames()]
        if state.is_attached:
            cameras = self._attached_cameras(state)
        film = self.sensor.film()
        colors = radiance = background_radiance(film, behind, cameras, self._offsets)
        if environment is None or not splats.srgb_primitives:
            colors = [[mi.math.linear_to_srgb(color) for color in of_time] for of_time in colors]
        return _Background(colors, environment is not None, radiance)

    def _frames(self) -> list[list[rendering.Frame]]:
        """Return frames by time and by pass, from the cache where nothing has changed."""
        pipeline, gaussians = self.splats.pipeline, dr.detach(self.splats.gaussians)
        state = self._state().detach()
        traced = None if self.hybrid is None else self._traced_surfaces(self.hybrid, state)
        key = (pipeline, self.key, *state.settings, traced), (gaussians, state.device)

        def render() -> list[list[rendering.Frame]]:
            seen = repeat(None) if traced is None else traced.value
            return [
                _render(gaussians, camera, pipeline, self.positions, of_time)
                for camera, of_time in zip(self._cameras(state), seen, strict=False)
            ]

        return self.splats.cache.find(f"frames {self.index}", *key, render).value

    def _traced_surfaces(
        self, hybrid: Hybrid, state: SensorState
    ) -> Cached[list[list[SurfaceLayers]]]:
        from drgs.integrator.visible_surfaces import trace_surfaces

        hides, (_, far) = self.splats.hide_emitters, depth_range(self.sensor)
        settings = hybrid.surfaces, self.key, hides, far, *state.settings
        return self.splats.cache.find(
            f"surfaces {self.index}",
            settings,
            state.device,
            lambda: trace_surfaces(
                hybrid.rays,
                far,
                self.sensor.film(),
                self._cameras(state),
                self._offsets,
                with_normals="normal" in self.splats.aovs.values(),
            ),
        )

    def num_surfaces(self, hybrid: Hybrid) -> int:
        """Return the number of surfaces that are seen one through the other."""
        return len(self._traced_surfaces(hybrid, self._state().detach()).value[0][0])

    @property
    def _offsets(self) -> list[tuple[Float | float, Float | float]]:
        return [sample_offsets(positions) for positions in self.positions]

    def _state(self) -> SensorState:
        return read_sensor(self.sensor, self.splats.near)

    def _cameras(self, state: SensorState) -> list[Camera]:
        camera = without_effects(camera_from_sensor(state), self.splats.ignore)
        return cameras_in_time(camera, self.splats.shutter_samples)

    def _attached_cameras(self, state: SensorState) -> list[Camera]:
        return attached_cameras(state, self.splats.ignore, self.splats.shutter_samples)

    def _camera_tangents(self, count: int) -> Sequence[list[mi.Float] | None]:
        """Return the tangents of each time's ``Camera.numbers()`` along those of the sensor."""
        state = self._state()
        if not state.is_attached:
            return [None] * count
        numbers = [camera.numbers() for camera in self._attached_cameras(state)]
        dr.forward_to(numbers, flags=dr.ADFlag.ClearEdges)
        return dr.grad(numbers)


def _sum(values: Sequence[Float]) -> Float:
    return sum(values[1:], values[0])


def _mean(passes: Sequence[Passes]) -> Passes:
    total: list[Passes] = []
    for first in range(0, len(passes), PASSES_PER_KERNEL):
        dr.eval(total)
        terms = [*total, *passes[first : first + PASSES_PER_KERNEL]]
        total = [
            [
                [_sum(values) for values in zip(*of_sample, strict=True)]
                for of_sample in zip(*terms, strict=True)
            ]
        ]
    return [[value / len(passes) for value in of_sample] for of_sample in total[0]]


@dataclass(frozen=True)
class _Background:
    """The background of an image, at each sample."""

    colors: Iterable[Iterable[mi.Color3f]]  # by time and by pass; display space, or see below
    is_radiance: bool  # an environment: covers the film; its colours are linear where channels are
    radiance: Iterable[Iterable[mi.Color3f | None]]  # linear, of an environment or a texture


def decode(color: mi.Color3f, coverage: mi.Float) -> mi.Color3f:
    """Return linear radiance A D(C / A); color: C, display space; coverage: A, sum of weights."""
    return coverage * mi.math.srgb_to_linear(color / dr.select(coverage > 0, coverage, 1))


def _render(
    gaussians: Gaussians,
    camera: Camera,
    pipeline: rendering.Pipeline,
    positions: Sequence[SamplePositions],
    surfaces: Sequence[SurfaceLayers] | None,
) -> list[rendering.Frame]:
    """Render a frame for each pass; surfaces: the visible ones, by pass."""
    pipeline = with_effects(pipeline, gaussians, camera)
    models = [replace(pipeline.model, positions=points) for points in positions]
    if surfaces is not None:
        from drgs.effects.occlusion import occlude

        models = [
            occlude(model, layers, camera) for model, layers in zip(models, surfaces, strict=True)
        ]
        pipeline = replace(pipeline, features=(*pipeline.features, rendering.depth_feature))
    first, *others = models
    frame = rendering.render(gaussians, camera, replace(pipeline, model=first))
    return [frame, *(rendering.render_again(frame, model) for model in others)]


def constant_background(splats: SplatsState) -> mi.Color3f | None:
    """Return a background colour, detached and opaque; None for a texture."""
    if isinstance(splats.background, mi.Texture):
        return None
    constant = mi.Color3f(dr.detach(splats.background))
    dr.make_opaque(constant)
    return constant


def accumulate_in_sensor(cameras: Sequence[Camera], gradients: list[list[Float]]) -> None:
    """Accumulate derivatives by ``Camera.numbers()``, by time, into the sensor of the cameras.

    cameras: from :func:`attached_cameras`.
    """
    numbers = chain(*(camera.numbers() for camera in cameras))
    pairs = zip(numbers, chain(*gradients), strict=True)
    attached = [(value, gradient) for value, gradient in pairs if dr.grad_enabled(value)]
    for value, gradient in attached:
        dr.accum_grad(value, gradient)
    dr.enqueue(dr.ADMode.Backward, [value for value, _ in attached])
    dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)


def attached_cameras(
    state: SensorState, ignored: Collection[str], samples: int | None = None
) -> list[Camera]:
    """Return the cameras of a sensor with its derivatives; samples: of an open shutter."""
    dr.make_opaque(state.device)  # or each value of a literal would be a new kernel
    return cameras_in_time(without_effects(state.make(state), ignored), samples)


LENS_POINTS = 16  # fixed points of an aperture; a small, bright light is seen as this many


def environment_radiance(emitter: mi.Emitter, camera: Camera, place: mi.Point2f) -> mi.Color3f:
    """Return an environment at places of the crop window, px; black where the lens ends."""
    ray, seen, count = camera.view_directions(place.x, place.y, LENS_POINTS)
    interaction = dr.zeros(mi.SurfaceInteraction3f, count * dr.width(place))
    interaction.wi = -mi.Vector3f(dr.normalize(ray))  # the environment is infinitely far
    radiance = mi.Color3f(emitter.eval(interaction))
    if seen is not True:
        radiance = dr.select(seen, radiance, 0)
    if count == 1 or dr.width(radiance) == 1:  # the latter: a constant environment
        return radiance
    return mi.Color3f([dr.block_sum(color, count) for color in radiance]) / count


def stretched_radiance(texture: mi.Texture, film: mi.Film, place: mi.Point2f) -> mi.Color3f:
    """Return a texture that is stretched over the film; place: on the crop window, px."""
    interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(place))
    interaction.uv = (place + mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.size())
    return mi.Color3f(texture.eval(interaction))


def background_radiance(
    film: mi.Film,
    background: mi.Emitter | mi.Texture,
    cameras: Sequence[Camera],
    offsets: Sequence[tuple[mi.Float | float, mi.Float | float]],
) -> list[list[mi.Color3f]]:
    """Return the background at all pixels, by time and by pass.

    cameras: by time; offsets: by pass, x and y from the pixel's upper left corner, px.
    """
    places = [pixel_corners(film, num_samples(film, x)) + mi.Vector2f(x, y) for x, y in offsets]
    if isinstance(background, mi.Texture):
        found = [stretched_radiance(background, film, place) for place in places]
        return [found] * len(cameras)
    return [[environment_radiance(background, camera, p) for p in places] for camera in cameras]
