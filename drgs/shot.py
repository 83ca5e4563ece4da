"""One picture of the integrator ``splats``: what its sensor sees, as channels of the film.

Layer 4. A :class:`Shot` has a :class:`View` for each sensor, which are several only for a batch. A
view renders frames (``drgs.rendering``), one for each time at which its shutter is open and each
sample per pixel; puts what is behind the splats behind them; and gives the film its channels. The
film develops these (``drgs.exposure``), and a nested integrator's picture of surfaces comes in
between (``drgs.surfaces``). :meth:`Shot.backward` and :meth:`Shot.tangent` run the same way back
and along.

Frames are reused while nothing that they depend on has changed: ``mi.render`` calls ``render`` and,
later, ``render_backward`` on the same integrator, with other pictures possibly in between.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import chain, repeat
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs import rendering
from drgs.camera import (
    Camera,
    SensorState,
    camera_from_sensor,
    cameras_in_time,
    read_sensor,
    without,
)
from drgs.exposure import CenterExposure, Channels
from drgs.gaussians import Gaussians

Passes = list[Channels]
"""Channels by sample per pixel."""

Planes = list[list[list[Any]]]
"""Planes of frames, each Float (H * W,), by time and by sample."""


# ----------------------------------------------------------------------------------------------
# What is kept from one picture to the next
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rendered:
    """The last frames of a view, and everything that they depend on."""

    frames: list[list[rendering.Frame]]  # by time; one for each sample per pixel
    pipeline: rendering.Pipeline
    exposure: Any  # key of the points that were sampled; None: pixel centres
    sensor: SensorState
    gaussians: Gaussians  # detached: holding them keeps their variable indices from being reused
    look: Look | None  # what was seen besides splats

    def matches(
        self,
        pipeline: rendering.Pipeline,
        exposure: Any,
        sensor: SensorState,
        gaussians: Gaussians,
        look: Look | None,
    ) -> bool:
        """Whether rendering these would give the same frames."""
        indices = dr.detail.collect_indices
        return (
            self.pipeline == pipeline
            and self.exposure == exposure
            and self.sensor.same_as(sensor)
            and indices(self.gaussians) == indices(gaussians)
            and self.look is look
        )


@dataclass(frozen=True, eq=False)
class Look:
    """What a sensor saw of a scene's surfaces, and everything that this depends on."""

    surfaces: Any  # drgs.surfaces.Surfaces
    settings: Any  # of the integrator, and the key of the points that were looked at
    sensor: SensorState
    seen: list[list[Any]]  # by time and by sample: drgs.surfaces.SeenSurface

    def matches(self, surfaces: Any, settings: Any, sensor: SensorState) -> bool:
        """Whether looking at these would be the same."""
        same = self.surfaces is surfaces and self.settings == settings
        return same and self.sensor.same_as(sensor)


@dataclass(frozen=True)
class Memory:
    """What an integrator keeps. Views are known by their numbers."""

    rendered: dict[int, Rendered] = field(default_factory=dict)
    looks: dict[int, Look] = field(default_factory=dict)
    surfaces: dict[str, Any] = field(default_factory=dict)  # "last": drgs.surfaces.Surfaces
    film_maps: dict[str, np.ndarray] = field(default_factory=dict)  # see drgs.exposure

    def forget_view(self, index: int) -> None:
        """A view that will not be asked for again."""
        self.rendered.pop(index, None)
        self.looks.pop(index, None)


# ----------------------------------------------------------------------------------------------
# Shots
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture."""

    views: list[View]
    exposure: Any
    hybrid: Any  # drgs.surfaces.Hybrid; None: there are splats alone
    batch: Any = None  # drgs.batch.SideBySide, for several views

    @staticmethod
    def of(integrator: Any, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int) -> Shot:
        """Where the sensor's pixels are evaluated, and how its film develops them."""
        hybrid = hybrid_of(integrator, scene, sensor, seed, spp)
        names = integrator.aov_names() + ([] if hybrid is None else hybrid.insertion.channels)
        film, spp = sensor.film(), spp or sensor.sampler().sample_count()
        maps = integrator.memory.film_maps
        if spp == 1 and film.rfilter().is_box_filter():
            exposure = CenterExposure(film, maps, names)
        else:
            from drgs.sampling import SampledExposure

            exposure = SampledExposure(sensor, seed, spp, maps, names)
        whole = View(
            integrator=integrator,
            scene=scene,
            index=0,
            sensor=sensor,
            positions=exposure.positions,
            within=exposure.within,
            key=exposure.key,
            has_alpha=mi.has_flag(film.flags(), mi.FilmFlags.Alpha),
            hybrid=hybrid,
        )
        if sensor.class_name() != "BatchSensor":
            return Shot([whole], exposure, hybrid)
        from drgs.batch import SideBySide

        batch = SideBySide.of(sensor)
        views = [
            replace(
                whole,
                index=index,
                sensor=one,
                positions=batch.positions(whole.positions, index),
                within=batch.within(whole.within, index),
            )
            for index, one in enumerate(batch.sensors)
        ]
        return Shot(views, exposure, hybrid, batch)

    def image(self) -> mi.TensorXf:
        """The developed picture."""
        image = self._image_of_splats()
        if self.hybrid is None:
            return image
        return self.hybrid.insertion.develop(image, self.hybrid.picture())

    def backward(self, params: Any, grad_in: mi.TensorXf) -> rendering.GaussianGradients:
        """Derivatives with respect to the Gaussians; all others are accumulated.

        params: as ``mi.render`` has them; grad_in: derivative of the loss with respect to the
        image.
        """
        if self.hybrid is not None:
            own, nested = self._image_of_splats(), self.hybrid.picture()
            grad_in, d_nested = self.hybrid.insertion.adjoint(own, nested, grad_in)
        d_passes = self.exposure.adjoint(grad_in)
        gradients = [
            view.backward(d_passes if self.batch is None else self.batch.cut(d_passes, view.index))
            for view in self.views
        ]
        if self.hybrid is not None:
            self.hybrid.backward(params, d_nested)
        return reduce(rendering.added, gradients)

    def tangent(self, params: Any, tangents: Gaussians) -> mi.TensorXf:
        """Directional derivative of the image.

        tangents: of the Gaussians; those of all other parameters are set on them.
        """
        integrator = self.views[0].integrator
        d_planes = [view.plane_tangents(tangents) for view in self.views]
        planes = [view.planes() for view in self.views]
        dr.eval(planes, d_planes)
        with dr.resume_grad():
            constant = constant_background(integrator)
            dr.enable_grad(planes, constant)
            dr.set_grad(planes, d_planes)
            if constant is not None:
                dr.set_grad(constant, dr.grad(integrator.background))
            image = self._developed(planes, constant)
            # The nested integrator, and other pictures of the same pass, read the gradients of
            # parameters again, also of those that are computed from others.
            dr.forward_to(image, flags=dr.ADFlag.ClearEdges)
            d_image = dr.grad(image)
        if self.hybrid is None:
            return d_image
        nested = self.hybrid.picture()
        d_nested = self.hybrid.tangent(params, nested)
        return self.hybrid.insertion.tangent(dr.detach(image), nested, d_image, d_nested)

    def _image_of_splats(self) -> mi.TensorXf:
        """For a hybrid picture, with the channels that the insertion needs."""
        constant = constant_background(self.views[0].integrator)
        return self._developed([view.planes() for view in self.views], constant)

    def _developed(self, planes: list[Planes], constant: mi.Color3f | None) -> mi.TensorXf:
        """planes: by view."""
        pictures = [v.channels(p, constant) for v, p in zip(self.views, planes, strict=True)]
        passes = pictures[0] if self.batch is None else self.batch.put_together(pictures)
        return self.exposure.develop(passes)


def hybrid_of(integrator: Any, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int) -> Any:
    """The part that surfaces take in a picture; None where there are none."""
    if all(shape.is_ellipsoids() for shape in scene.shapes()):
        return None
    from drgs.surfaces import Hybrid, Insertion, Surfaces

    memory, hide_emitters = integrator.memory, integrator.hide_emitters
    surfaces = Surfaces.of(scene, memory.surfaces.get("last"))
    memory.surfaces["last"] = surfaces
    nested = integrator.nested or mi.load_dict({"type": "path", "hide_emitters": hide_emitters})
    insertion = Insertion(
        sensor.film(),
        memory.film_maps,
        integrator.aov_names(),
        shows_background=not hide_emitters and scene.environment() is not None,
        display_space=not integrator.srgb_primitives,
    )
    traced = surfaces.traced(scene)
    return Hybrid(traced, surfaces, nested, sensor, seed, integrator.nested_spp or spp, insertion)


def sensors_of(sensor: mi.Sensor) -> list[mi.Sensor]:
    """Those of a batch, or the one."""
    if sensor.class_name() != "BatchSensor":
        return [sensor]
    from drgs.batch import SideBySide

    return SideBySide.of(sensor).sensors


# ----------------------------------------------------------------------------------------------
# Views
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class View:
    """What one sensor sees of a picture: mostly all of it."""

    integrator: Any  # whose settings, Gaussians and memory it has
    scene: mi.Scene
    index: int
    sensor: mi.Sensor
    positions: Sequence[Any]  # in the pixels, by sample: see drgs.samples
    within: Sequence[tuple[Any, Any]]  # the same, px from their upper left corners
    key: Any  # of these; None: pixel centres
    has_alpha: bool
    hybrid: Any  # drgs.surfaces.Hybrid, or None

    def planes(self) -> Planes:
        """Of all frames, unevaluated."""
        return [[frame.planes() for frame in of_time] for of_time in self._frames()]

    def plane_tangents(self, tangents: Gaussians) -> Planes:
        """Along tangents of the Gaussians, and those set on the sensor."""
        frames = self._frames()
        with dr.resume_grad():
            d_cameras = self._camera_tangents(len(frames))
        return [
            rendering.frames_tangent(self.integrator.gaussians, of_time, tangents, d_camera)
            for of_time, d_camera in zip(frames, d_cameras, strict=True)
        ]

    def backward(self, d_channels: Passes) -> rendering.GaussianGradients:
        """Derivatives with respect to the Gaussians; all others are accumulated."""
        planes, constant = self.planes(), constant_background(self.integrator)
        dr.eval(planes)
        # Colour conversion and background are a few operations per pixel, traced again and
        # differentiated by Dr.Jit.
        with dr.resume_grad():
            dr.enable_grad(planes, constant)
            channels = self.channels(planes, constant)
            dr.accum_grad(channels, d_channels)
            dr.enqueue(dr.ADMode.Backward, channels)
            # Other views, the nested integrator, and other pictures of the same pass go back along
            # what textures were computed from again.
            dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
            d_planes = dr.grad(planes)
            d_constant = None if constant is None else dr.grad(constant)
        dr.eval(d_planes, d_constant)
        with dr.resume_grad():
            state = self._state()
            of_camera = state.is_attached
        by_time = [
            rendering.frames_adjoint(self.integrator.gaussians, *of_time, of_camera)
            for of_time in zip(self._frames(), d_planes, strict=True)
        ]
        with dr.resume_grad():
            if constant is not None:
                accumulate(self.integrator.background, d_constant)
            if of_camera:
                numbers = [camera.numbers() for camera in self._attached_cameras(state)]
                _accumulate_through(numbers, [gradients.camera for gradients in by_time])
        return reduce(rendering.added, by_time)

    def channels(self, planes: Planes, constant: mi.Color3f | None) -> Passes:
        """What the film gets of each sample per pixel: the mean over the times.

        constant: the background, where it is a colour; display space.
        """
        behind = self._behind(constant)
        look = self.integrator.memory.rendered[self.index].look
        seen = repeat(repeat(None)) if look is None else look.seen

        def channels_of(planes: list[Any], surface: Any, color: Any, radiance: Any) -> Channels:
            if surface is None:
                return self._composited(planes, color, behind.opaque)
            *planes, front = planes
            past = [(1 - surface.coverage) * planes[0], *planes[1:]]
            own = self._composited(
                past, color, behind.opaque, lambda kind: surface.added(kind, front)
            )
            return own + self.hybrid.insertion.values(surface, front, radiance)

        by_time = zip(planes, seen, behind.colors, behind.radiance, strict=False)
        channels = [
            [channels_of(*sample) for sample in zip(*time, strict=False)] for time in by_time
        ]
        if len(channels) == 1:
            return channels[0]
        return [
            [sum(values[1:], values[0]) / len(values) for values in zip(*of_sample, strict=True)]
            for of_sample in zip(*channels, strict=True)
        ]

    def _composited(
        self,
        planes: list[Any],
        behind: mi.Color3f,
        opaque: bool,
        added: Callable[[str], Channels | None] = lambda kind: None,
    ) -> Channels:
        """Planes of pixels: red, green, blue, perhaps alpha, AOVs.

        added: to the channels of an AOV of this kind.
        """
        transmittance, red, green, blue, *others = planes
        color = mi.Color3f(red, green, blue)
        if self.integrator.srgb_primitives:
            color = mi.math.srgb_to_linear(color)
        channels = list(dr.fma(transmittance, behind, color))
        if self.has_alpha:
            alpha = 1 - transmittance
            channels.append(dr.full(mi.Float, 1, dr.width(alpha)) if opaque else alpha)
        for kind in self.integrator.aovs.values():
            if kind == "alpha":
                channels.append(1 - transmittance)
                continue
            values = [others.pop(0) for _ in self.integrator.channels_of(kind)]
            more = added(kind)
            if more is not None:
                values = [a + b for a, b in zip(values, more, strict=True)]
            channels += values
        return channels

    def _behind(self, constant: mi.Color3f | None) -> _Behind:
        """What is seen past the splats, in the space of the channels."""
        integrator = self.integrator
        environment = None if integrator.hide_emitters else self.scene.environment()
        if environment is None and constant is not None:
            if integrator.srgb_primitives:
                constant = mi.math.srgb_to_linear(constant)
            return _Behind(repeat(repeat(constant)), opaque=False, radiance=repeat(repeat(None)))
        from drgs import backdrop

        if environment is not None:
            behind = backdrop.Environment(environment)
        else:
            behind = backdrop.Picture(integrator.background)
        state = self._state()
        cameras = [of_time[0].camera for of_time in self._frames()]
        if state.is_attached:
            cameras = self._attached_cameras(state)
        colors = radiance = backdrop.seen_by(self.sensor.film(), behind, cameras, self.within)
        if not integrator.srgb_primitives:
            colors = [[mi.math.linear_to_srgb(color) for color in of_time] for of_time in colors]
        return _Behind(colors, behind.opaque, radiance)

    # ------------------------------------------------------------------------------------------
    # Frames
    # ------------------------------------------------------------------------------------------

    def _frames(self) -> list[list[rendering.Frame]]:
        """Render, or reuse the last frames if nothing that they depend on has changed.

        One list for each time at which the shutter is open, of a frame for each sample per pixel.
        """
        pipeline, gaussians = self.integrator.pipeline, dr.detach(self.integrator.gaussians)
        state = self._state().detached()
        look = None if self.hybrid is None else self._look(state)
        key = pipeline, self.key, state, gaussians, look
        rendered = self.integrator.memory.rendered
        last = rendered.get(self.index)
        if last is None or not last.matches(*key):
            seen = repeat(None) if look is None else look.seen
            frames = [
                _render(gaussians, camera, pipeline, self.positions, of_time)
                for camera, of_time in zip(self._cameras(state), seen, strict=False)
            ]
            last = rendered[self.index] = Rendered(frames, *key)
        return last.frames

    def _look(self, state: SensorState) -> Look:
        """At the scene's surfaces, unless the last look was the same."""
        from drgs.surfaces import look_at

        surfaces, looks = self.hybrid.surfaces, self.integrator.memory.looks
        settings = self.key, self.integrator.hide_emitters, self.sensor.far_clip()
        key = surfaces, settings, state
        last = looks.get(self.index)
        if last is None or not last.matches(*key):
            seen = look_at(
                self.hybrid.scene,
                self.sensor,
                self._cameras(state),
                self.within,
                self.integrator.hide_emitters,
                with_normals="normal" in self.integrator.aovs.values(),
            )
            last = looks[self.index] = Look(*key, seen)
        return last

    def _state(self) -> SensorState:
        return read_sensor(self.sensor, self.integrator.near)

    def _cameras(self, state: SensorState) -> list[Camera]:
        """What is simulated of the sensor's camera, detached; of each time."""
        return cameras_in_time(without(camera_from_sensor(state), self.integrator.ignore))

    def _attached_cameras(self, state: SensorState) -> list[Camera]:
        """The same, attached to the sensor's parameters."""
        dr.make_opaque(state.device)  # or each value of a literal would be a new kernel
        return cameras_in_time(without(state.make(state), self.integrator.ignore))

    def _camera_tangents(self, count: int) -> list[list[mi.Float] | None]:
        """Of each time's camera, derivatives of its numbers along those set on the sensor."""
        state = self._state()
        if not state.is_attached:
            return [None] * count
        numbers = [camera.numbers() for camera in self._attached_cameras(state)]
        dr.forward_to(numbers, flags=dr.ADFlag.ClearEdges)
        return dr.grad(numbers)


@dataclass(frozen=True)
class _Behind:
    """What is seen past the splats."""

    colors: Iterable[Iterable[Any]]  # by time and by sample: Color3f, in the channels' space
    opaque: bool  # whether it covers the film
    radiance: Iterable[Iterable[Any]]  # by time and by sample: linear; None: of a constant


def _render(
    gaussians: Gaussians,
    camera: Camera,
    pipeline: rendering.Pipeline,
    positions: Sequence[Any],
    surfaces: Sequence[Any] | None,
) -> list[rendering.Frame]:
    """A frame for each sample per pixel; surfaces: what is seen of them at each."""
    models = [replace(pipeline.model, positions=points) for points in positions]
    if surfaces is not None:
        from drgs.occlusion import amid

        models = [
            amid(model, surface, camera) for model, surface in zip(models, surfaces, strict=True)
        ]
        pipeline = replace(pipeline, features=(*pipeline.features, rendering.depth_feature))
    first, *others = models
    frame = rendering.render(gaussians, camera, replace(pipeline, model=first))
    return [frame, *(rendering.render_again(frame, model) for model in others)]


# ----------------------------------------------------------------------------------------------
# Settings and gradients
# ----------------------------------------------------------------------------------------------


def constant_background(integrator: Any) -> mi.Color3f | None:
    """The background without gradients, if it is a colour; display space.

    No literal, or every colour would be a new kernel.
    """
    if isinstance(integrator.background, mi.Texture):
        return None
    constant = mi.Color3f(dr.detach(integrator.background))
    dr.make_opaque(constant)
    return constant


def feature_of(kind: str) -> rendering.Feature:
    """What is composited for an AOV of this kind, other than alpha."""
    if kind == "depth":
        return rendering.depth_feature
    from drgs.extra_features import NamedFeature, normal_features

    return normal_features if kind == "normal" else NamedFeature(kind)


def accumulate(parameter: Any, gradient: Any) -> None:
    """Add to a parameter's gradient, if it has one."""
    if dr.width(parameter) > 0 and dr.grad_enabled(parameter):
        dr.accum_grad(parameter, gradient)


def _accumulate_through(values: list[list[Any]], gradients: list[list[mi.Float]]) -> None:
    """Accumulate into what the values were computed from."""
    pairs = zip(chain(*values), chain(*gradients), strict=True)
    attached = [(value, gradient) for value, gradient in pairs if dr.grad_enabled(value)]
    for value, gradient in attached:
        dr.accum_grad(value, gradient)
    dr.enqueue(dr.ADMode.Backward, [value for value, _ in attached])
    dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
