"""An image of the integrator ``splats``: the frames of its sensors, and the channels of the film.

An :class:`ImageRender` has a :class:`SensorRender` for each sensor of a ``batch``, or one. That
renders a frame (``drgs.splatting.rendering``) for each time of the shutter and each pass of
samples, or reuses those of the last image, composites them over the background and adds the
surfaces. The film develops the channels (``drgs.integrator.film``), and a nested integrator's image
of surfaces is inserted (``drgs.integrator.light.surfaces``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import chain, repeat
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from drgs.cameras.camera import Camera, cameras_in_time
from drgs.core.errors import PluginError
from drgs.core.memory import MAX_LANES, UNCHECKED_BYTES, available_memory, too_large_reason
from drgs.core.types import Float
from drgs.effects.compose import with_effects, without_effects
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.film import (
    CenterSamples,
    Channels,
    DrawnSamples,
    SamplePoints,
    background_radiance,
    decode,
)
from drgs.integrator.sensors import (
    SensorState,
    SideBySide,
    accumulate_in_sensor,
    attached_cameras,
    camera_from_sensor,
    depth_range,
    is_batch,
    num_poses,
    read_sensor,
    sensors_of,
)
from drgs.integrator.state import Cached, ProjectedView, SplatsState, surfaces_in
from drgs.splatting import rendering
from drgs.splatting.footprint import SamplePositions
from drgs.splatting.rasterize import SplatGradients
from drgs.splatting.tiles import SplatTable

if TYPE_CHECKING:  # imported where a scene requires them
    from drgs.integrator.light.surfaces import NestedSurfaces
    from drgs.integrator.light.visible_surfaces import SurfaceLayers


Passes = list[Channels]  # channels by pass: one sample per pixel or, on a small film, several
Planes = list[list[list[Float]]]  # planes of frames, each (samples * H * W,), by time and by pass
PASSES_PER_KERNEL = 16  # passes or times between evaluations: compile time is superlinear

MAX_SAMPLES = 4096  # samples of a pixel times poses of motion blur; a frame takes 0.15 MB at least
NESTED_SAMPLE_BYTES = 64  # at least, for a path tracer's sample: its ray, sampler and radiance


@dataclass(frozen=True, eq=False)
class ImageRender:
    """An image of one sensor, or of several side by side."""

    views: list[SensorRender]
    samples: CenterSamples
    nested: NestedSurfaces | None  # the surfaces; None: the scene has none
    batch: SideBySide | None = None  # for several views

    @staticmethod
    def prepare(
        splats: SplatsState, scene: mi.Scene, sensor: mi.Sensor, seed: int | mi.UInt32, spp: int
    ) -> ImageRender:
        """Choose sample positions; spp: 0 for that of the sensor's sampler."""
        nested = nested_surfaces(splats, scene, sensor, seed, spp)
        names = splats.aov_names()
        film, spp = sensor.film(), spp or sensor.sampler().sample_count()
        poses = 1 if "motion" in splats.ignore else max(map(num_poses, sensors_of(sensor)))
        nested_spp = 0 if nested is None else nested.spp or spp
        width, height = film.crop_size()
        size = width, height, spp, poses, len(names), nested_spp
        splats.cache.find("size", size, (), lambda: check_image(*size))
        maps = splats.cache.film_maps
        if spp == 1 and film.rfilter().is_box_filter():
            samples = CenterSamples(film, maps, names)
        else:
            samples = DrawnSamples(sensor, seed, spp, maps, names)
        positions, key = samples.positions, samples.key
        has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        whole = SensorRender(splats, scene, 0, sensor, positions, key, has_alpha, nested)
        batch, views = None, [whole]
        if is_batch(sensor):
            batch = SideBySide.from_batch(sensor)
            views = [
                replace(whole, index=k, sensor=one, positions=batch.positions(whole.positions, k))
                for k, one in enumerate(batch.sensors)
            ]
        if nested is not None:
            nested = nested.with_surfaces(max(view.num_surfaces(nested) for view in views))
            samples.aovs += nested.compositor.channels
            views = [replace(view, nested=nested) for view in views]
        return ImageRender(views, samples, nested, batch)

    def image(self) -> mi.TensorXf:
        """Return the developed image."""
        image = self._image_of_splats()
        if self.nested is None:
            return image
        return self.nested.compositor.develop(image, self.nested.images())

    def backward(self, params: object, grad_in: mi.TensorXf) -> rendering.GaussianGradients:
        """Return derivatives with respect to the Gaussians; accumulate all others."""
        d_nested: list[mi.TensorXf] = []
        if self.nested is not None:
            inputs = self._image_of_splats(), self.nested.images()
            grad_in, d_nested = self.nested.compositor.adjoint(*inputs, grad_in)
        d_passes = self.samples.adjoint(grad_in)
        gradients = [
            view.backward(d_passes if self.batch is None else self.batch.cut(d_passes, view.index))
            for view in self.views
        ]
        if self.nested is not None:
            self.nested.backward(params, d_nested)
        return reduce(rendering.sum_of_gradients, gradients)

    def splats_backward(self, projected: ProjectedView, grad_in: mi.TensorXf) -> None:
        """Leave derivatives with respect to splats that were projected beforehand in these."""
        (view,) = self.views
        projected.gradients = view.splats_backward(self.samples.adjoint(grad_in))
        projected.frames = [frame for frame, *_ in view.frames]

    def tangent(self, params: object, tangents: Gaussians) -> mi.TensorXf:
        """Return the directional derivative; tangents: of the Gaussians."""
        splats = self.views[0].splats
        d_planes = [view.plane_tangents(tangents) for view in self.views]
        planes = [view.planes() for view in self.views]
        dr.eval(planes, d_planes)
        with dr.resume_grad():
            constant = constant_background(splats)
            dr.enable_grad(planes, constant)
            dr.set_grad(planes, d_planes)
            if constant is not None:
                dr.set_grad(constant, dr.grad(splats.background))
            image = self._develop(planes, constant)
            # Keep vertices: the nested integrator and other images read the gradients again.
            dr.forward_to(image, flags=dr.ADFlag.ClearEdges)
            d_image = dr.grad(image)
        if self.nested is None:
            return d_image
        images = self.nested.images()
        d_images = self.nested.tangents(params, images)
        return self.nested.compositor.tangent(dr.detach(image), images, d_image, d_images)

    def _image_of_splats(self) -> mi.TensorXf:
        constant = constant_background(self.views[0].splats)
        return self._develop([view.planes() for view in self.views], constant)

    def _develop(self, planes: list[Planes], constant: mi.Color3f | None) -> mi.TensorXf:
        images = [v.channels(p, constant) for v, p in zip(self.views, planes, strict=True)]
        passes = images[0] if self.batch is None else self.batch.concatenate(images)
        return self.samples.develop(passes)


def nested_surfaces(
    splats: SplatsState, scene: mi.Scene, sensor: mi.Sensor, seed: int | mi.UInt32, spp: int
) -> NestedSurfaces | None:
    """Return the surfaces in an image; None where the scene has none."""
    if not surfaces_in(scene):
        return None
    from drgs.integrator.light.surfaces import NestedSurfaces

    return NestedSurfaces.from_scene(splats, scene, sensor, seed, spp)


def check_image(width: int, height: int, spp: int, poses: int, aovs: int, nested_spp: int) -> None:
    """Raise PluginError for an image that does not fit into memory.

    width, height: px; spp: of the splats; poses: of the sensor; aovs: channels besides colour and
    alpha; nested_spp: of the nested integrator, 0 for none.
    """
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
    why = too_large_reason(width, height, 3 + aovs, spp * poses)
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
    nested: NestedSurfaces | None  # the part of surfaces, if there are any
    window: mi.Film | None = None  # a film whose size and crop window hold instead of the sensor's

    def planes(self) -> Planes:
        """Return the planes of all frames, unevaluated."""
        return [[frame.planes() for frame in of_time] for of_time in self.frames]

    def plane_tangents(self, tangents: Gaussians) -> Planes:
        """Return tangents of planes along those of the Gaussians and of the sensor."""
        frames = self.frames
        with dr.resume_grad():
            d_cameras = self._camera_tangents(len(frames))
        return [
            rendering.frames_tangent(self.splats.gaussians, of_time, tangents, d_camera)
            for of_time, d_camera in zip(frames, d_cameras, strict=True)
        ]

    def backward(self, d_channels: Passes) -> rendering.GaussianGradients:
        """Return derivatives with respect to the Gaussians; accumulate all others."""
        d_planes = self._planes_backward(d_channels)
        with dr.resume_grad():
            state = self._state()
            is_attached = state.is_attached
        gaussians, times = self.splats.gaussians, zip(self.frames, d_planes, strict=True)
        by_time = [rendering.frames_adjoint(gaussians, *of_time, is_attached) for of_time in times]
        of_cameras = [gradients.camera for gradients in by_time if gradients.camera]
        if of_cameras:
            with dr.resume_grad():
                accumulate_in_sensor(self._attached_cameras(state), of_cameras)
        return reduce(rendering.sum_of_gradients, by_time)

    def splats_backward(self, d_channels: Passes) -> list[SplatGradients]:
        """Return derivatives with respect to the 2D splats, by time; add the background's."""
        d_planes = self._planes_backward(d_channels)
        times = zip(self.frames, d_planes, strict=True)
        return [rendering.splats_adjoint(*of_time) for of_time in times]

    def _planes_backward(self, d_channels: Passes) -> Planes:
        """Return derivatives with respect to the planes; accumulate the background's."""
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
        if of_background:
            with dr.resume_grad():
                dr.accum_grad(self.splats.background, d_constant)
        return d_planes

    def channels(self, planes: Planes, constant: mi.Color3f | None) -> Passes:
        """Return the mean over times of each pass's channels; constant: the background."""
        behind = self._render_behind(constant)
        layers = repeat(repeat(None))
        if self.nested is not None:
            layers = self._traced_surfaces(self.nested).value
        channels = [
            [self._channels_of(behind, *sample) for sample in zip(*time, strict=False)]
            for time in zip(planes, layers, behind.colors, behind.radiance, strict=False)
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
        from drgs.integrator.light.visible_surfaces import transmittance_behind

        planes, fronts = planes[: -len(layers)], planes[-len(layers) :]
        pairs = list(zip(layers, fronts, strict=True))
        whole = mi.Float(1)
        for surface, front in pairs:
            whole = whole - surface.share(front)

        def of_surfaces(kind: str) -> Channels | None:
            values = [surface.aov_values(kind, front) for surface, front in pairs]
            terms = [value for value in values if value is not None]
            return [_sum(columns) for columns in zip(*terms, strict=True)] if terms else None

        past = [transmittance_behind(layers) * planes[0], *planes[1:]]
        channels = self._to_channels(past, whole, behind, color, of_surfaces)
        assert self.nested is not None, "its surfaces are the layers"
        return channels + self.nested.compositor.values(layers, fronts, radiance)

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
        cameras = [of_time[0].camera for of_time in self.frames]
        if state.is_attached:
            cameras = self._attached_cameras(state)
        colors = radiance = background_radiance(self._film, behind, cameras, self._offsets)
        if environment is None or not splats.srgb_primitives:
            colors = [[mi.math.linear_to_srgb(color) for color in of_time] for of_time in colors]
        return _Background(colors, environment is not None, radiance)

    @cached_property
    def frames(self) -> list[list[rendering.Frame]]:
        """Frames by time and by pass, from the cache where nothing has changed."""
        pipeline, gaussians = self.splats.pipeline, dr.detach(self.splats.gaussians)
        state = self._camera_state
        traced = None if self.nested is None else self._traced_surfaces(self.nested)
        key = (pipeline, self.key, *state.settings, traced), (gaussians, state.device)

        def render_all() -> list[list[rendering.Frame]]:
            surfaces = repeat(None) if traced is None else traced.value
            projected = self.splats.projected_view
            splats = repeat(None) if projected is None else projected.splats
            by_time = zip(self._cameras(state), surfaces, splats, strict=False)
            return [
                self._render_time(gaussians, camera, pipeline, in_passes, of_time)
                for camera, in_passes, of_time in by_time
            ]

        return self.splats.cache.find(f"frames {self.index}", *key, render_all).value

    def _render_time(
        self,
        gaussians: Gaussians,
        camera: Camera,
        pipeline: rendering.Pipeline,
        surfaces: Sequence[SurfaceLayers] | None,
        splats: SplatTable | None,
    ) -> list[rendering.Frame]:
        """Render a frame for each pass; surfaces: by pass; splats: if projected beforehand."""
        pipeline = with_effects(pipeline, gaussians, camera)
        models = [replace(pipeline.model, positions=points) for points in self.positions]
        if surfaces is not None:
            from drgs.effects.occlusion import occlude

            pairs = zip(models, surfaces, strict=True)
            models = [occlude(model, layers, camera) for model, layers in pairs]
            pipeline = replace(pipeline, features=(*pipeline.features, rendering.depth_feature))
        first, *others = models
        pipeline = replace(pipeline, model=first)
        if splats is None:
            frame = rendering.render(gaussians, camera, pipeline)
        else:
            frame = rendering.render_splats(splats, camera, pipeline)
        return [frame, *(rendering.render_again(frame, model) for model in others)]

    def _traced_surfaces(self, nested: NestedSurfaces) -> Cached[list[list[SurfaceLayers]]]:
        from drgs.integrator.light.visible_surfaces import trace_surfaces

        state, with_normals = self._camera_state, "normal" in self.splats.aovs.values()
        hides, (_, far) = self.splats.hide_emitters, depth_range(self.sensor)
        settings = nested.surfaces, self.key, hides, far, *state.settings

        def trace() -> list[list[SurfaceLayers]]:
            view = self._film, self._cameras(state), self._offsets
            return trace_surfaces(nested.rays, far, *view, with_normals)

        return self.splats.cache.find(f"surfaces {self.index}", settings, state.device, trace)

    def num_surfaces(self, nested: NestedSurfaces) -> int:
        """Return the number of surfaces that are seen one through the other."""
        return len(self._traced_surfaces(nested).value[0][0])

    @property
    def _offsets(self) -> list[tuple[Float | float, Float | float]]:
        """Return x and y of each pass's samples from their pixels' upper left corners, px."""
        return [(p.x, p.y) if isinstance(p, SamplePoints) else (0.5, 0.5) for p in self.positions]

    def _state(self) -> SensorState:
        state, film = read_sensor(self.sensor, self.splats.near), self._film
        place = *film.size(), *film.crop_offset(), *film.crop_size()
        return replace(state, host=(*place, state.host[-1]))

    @property
    def _film(self) -> mi.Film:
        return self.window or self.sensor.film()

    @cached_property
    def _camera_state(self) -> SensorState:
        return self._state().detach()

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
        by_sample = zip(*terms, strict=True)
        total = [[[_sum(values) for values in zip(*one, strict=True)] for one in by_sample]]
    return [[value / len(passes) for value in of_sample] for of_sample in total[0]]


@dataclass(frozen=True)
class _Background:
    """The background of an image, at each sample."""

    colors: Iterable[Iterable[mi.Color3f]]  # by time and by pass; display space, or see below
    is_radiance: bool  # an environment: covers the film; its colours are linear where channels are
    radiance: Iterable[Iterable[mi.Color3f | None]]  # linear, of an environment or a texture


def constant_background(splats: SplatsState) -> mi.Color3f | None:
    """Return a background colour, detached and opaque; None for a texture."""
    if isinstance(splats.background, mi.Texture):
        return None
    constant = mi.Color3f(dr.detach(splats.background))
    dr.make_opaque(constant)
    return constant
