"""The ``splats`` integrator: 3D Gaussian splatting as a Mitsuba plugin. Layer 5.

Executed once per Mitsuba variant (see ``drgs.plugins``). The rasterizer itself is
``drgs.rendering``; this file is where it meets sensors, films, parameters and gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, repeat
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs import rendering
from drgs.arrays import interleave
from drgs.camera import (
    Camera,
    SensorState,
    camera_from_sensor,
    cameras_in_time,
    read_sensor,
    without,
)
from drgs.constants import NEAR
from drgs.exposure import CenterExposure
from drgs.gaussians import PARAMETER_NAMES, Gaussians
from drgs.properties import (
    AOVS,
    aovs_of,
    background_of,
    boolean,
    check_degree,
    check_shapes,
    choices_of,
    ignored_effects,
    load_gaussians,
    nested_integrator,
    positive,
    turns_of_shapes,
    whole_number,
)

SUPPORTED_VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")


NESTED = -1
"""Number of the view that ``aov`` asks for."""


@dataclass(frozen=True)
class _Rendered:
    """The last frames, and everything that they depend on: reused while nothing has changed."""

    frames: list[list[rendering.Frame]]  # by time; one for each sample per pixel
    pipeline: rendering.Pipeline
    exposure: Any  # key of the points that were sampled; None: pixel centres
    sensor: SensorState
    gaussians: Gaussians  # detached: holding them keeps their variable indices from being reused
    surfaces: _Looked | None  # what was seen besides splats

    def matches(
        self,
        pipeline: rendering.Pipeline,
        exposure: Any,
        sensor: SensorState,
        gaussians: Gaussians,
        surfaces: _Looked | None,
    ) -> bool:
        """Whether rendering these would give the same frames."""
        indices = dr.detail.collect_indices
        return (
            self.pipeline == pipeline
            and self.exposure == exposure
            and self.sensor.same_as(sensor)
            and indices(self.gaussians) == indices(gaussians)
            and self.surfaces is surfaces
        )


@dataclass(frozen=True, eq=False)
class _Looked:
    """What a sensor saw of a scene's surfaces: reused while neither has changed."""

    surfaces: Any  # drgs.surfaces.SurfaceScene
    settings: Any  # of the integrator, and the key of the points that were looked at
    sensor: SensorState
    seen: list[list[Any]]  # by time and by sample: SeenSurface


@dataclass(frozen=True)
class LastBackward:
    """What a backward pass knows about the 2D splats and ``mi.render`` cannot return."""

    means2d_grad: Any  # TensorXf (N, 2): derivative of the loss with respect to the pixel position
    visible: Any  # Bool (N,): the Gaussian's extent touches the film
    first_fault: Any  # UInt32 (1,): of the gradients, for rendering.decode_fault


class SplatsIntegrator(mi.CppADIntegrator):
    r"""
    .. _integrator-splats:

    3D Gaussian splatting (:monosp:`splats`)
    ----------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A PLY file in the layout of the 3DGS reference implementation. Without it, the
         Gaussians are given as tensors under the names below. With and without them, Gaussians of
         the scene's shapes of type ``ellipsoids`` and ``ellipsoidsmesh`` are rendered as well.

     * - to_world
       - |transform|
       - Rotates, scales (the same along all axes) and moves the Gaussians of ``filename`` or the
         tensors when they are loaded; what is seen of them from each side turns with them.
         (Default: none)

     * - shapes_to_world, shapes_to_world_...
       - |transform|
       - The ``to_world`` that the scene's ellipsoids were given, or those with the id that the
         name ends with. Mitsuba moves and turns them by it when they are loaded, but not their
         spherical harmonics, which this integrator then turns. (Default: not rotated)

     * - sh_degree
       - |int|
       - Highest spherical harmonics degree that is evaluated, 0 to 3. (Default: the highest that
         the file or a shape has)

     * - background
       - |rgb| or |texture|
       - What is behind the splats: a constant colour in display space (sRGB-encoded), or a texture
         that is stretched over the film and, as all textures are, linear. (Default: black)
       - |exposed|, |differentiable|

     * - hide_emitters
       - |bool|
       - An environment emitter of the scene is seen behind the splats, instead of the background,
         unless this is set. Through a ``thinlens`` it is the mean of what 16 points of the aperture
         see. (Default: |false|)

     * - (Nested plugin)
       - :paramtype:`integrator`
       - Renders the scene's meshes and other surfaces, if it has any, between which the splats
         are composited by depth. Its ``hide_emitters`` should be that of this integrator.
         (Default: ``path``)
       - |exposed|, |differentiable|

     * - nested_spp
       - |int|
       - Samples per pixel of the nested integrator. (Default: as many as of the splats)

     * - near
       - |float|
       - Gaussians whose centre is closer than this are culled. The sensor's ``near_clip``
         applies as well: the larger of the two wins; its ``far_clip`` does not. (Default: 0.01)

     * - srgb_primitives
       - |bool|
       - Splat colours live in display space. If true, the image is converted to linear
         radiance, which is what Mitsuba's films expect. If false, it is returned in display
         space, as splat trainers and viewers use it. (Default: |true|)

     * - aovs
       - |string|
       - What is put out besides colour, as in Mitsuba's ``aov``: a list of ``name:type``, such as
         ``d:depth, a:alpha``. ``depth`` (channel ``name.T``) is the sum of the splats' depths (z in
         the camera; with a fisheye lens, the distance from it), weighted by their share in the
         pixel and not normalised; ``alpha`` (``name.I``) is the sum
         of these weights; ``normal`` (``name.X``, ``.Y``, ``.Z``) the weighted sum of the splats'
         shortest axes, unit vectors in the world that point to the camera; a type that is the name
         of a parameter ``feature_...`` (``name.0``, ``.1``, ...) the weighted sum of its rows.
         (Default: none)

     * - ignore
       - |string|
       - What the sensor and the Gaussians call for and is not to be simulated, a list of
         ``distortion``, ``defocus``, ``motion`` and ``smoothing``. (Default: none)

     * - projection
       - |string|
       - How a Gaussian comes to the film: ``ewa``, by the affine approximation at its mean;
         ``unscented``, by the mean and covariance of projected sigma points; ``exact``, by its
         peak along each pixel's ray. (Default: ``ewa``)

     * - order
       - |string|
       - ``center``: splats are composited in the order of their means' depths; ``pixel``: in
         that of their peaks along each pixel's ray. (Default: ``center``)

     * - order_window
       - |int|
       - Splats that a pixel keeps waiting to put them in order, for ``pixel``. (Default: 4)

     * - sh_direction
       - |string|
       - ``mean``: colours are seen in the direction of the mean; ``pixel``: of each pixel's ray.
         (Default: ``mean``)

     * - alpha_max, alpha_cut, transmittance_stop
       - |float|
       - Upper clamp of a splat's alpha; the alpha below which it ends; the transmittance below
         which a pixel ends. The last two may be 0. (Default: 0.99, 1/255, 1e-4)

     * - extent
       - |float|
       - Standard deviations at which splats end. (Default: where ``alpha_cut`` ends them)

     * - low_pass
       - |float|
       - Variance that is added to each splat on the film, in square pixels. (Default: 0.3)

     * - antialiased
       - |bool|
       - Scales opacities so that the low-pass filter keeps each splat's integral, as in
         Mip-Splatting. (Default: |false|)

     * - smoothing
       - |tensor|
       - Standard deviation of the 3D smoothing filter of each Gaussian (N), in scene units: see
         ``drgs.smoothing``. (Default: the file's ``filter_3D``, if it has it)

     * - means, quats, log_scales, logit_opacities, sh0, shN
       - |tensor|
       - The N Gaussians: centres (N, 3) in world space; quaternions wxyz (N, 4), of any norm;
         natural logarithms of the standard deviations (N, 3); opacities before the sigmoid
         (N); spherical harmonics coefficients of degree 0 (N, 1, 3) and above (N, K - 1, 3).
       - |exposed|, |differentiable|

     * - feature_...
       - |tensor|
       - Numbers of the Gaussians under a name of your own, (N, C), to be put out: see ``aovs``.
       - |exposed|, |differentiable|

    This integrator composites Gaussians front to back over each pixel (Kerbl et al. 2023, "3D
    Gaussian Splatting for Real-Time Radiance Field Rendering"). Meshes and other surfaces of the
    scene are rendered by a nested integrator; each pixel composites what that shows at the depth of
    the first surface, amid the splats. Light does not pass from one to the other. A scene without
    surfaces runs no nested integrator. With one sample per pixel and a ``box`` filter it evaluates
    each pixel at its centre, and both the picture and the gradients are the same to the last bit in
    every run. With more samples or another filter, pixels are evaluated at the points that the
    sensor's sampler chooses; ``low_pass`` may then be 0. With a ``box`` filter this, too, is the
    same in every run; other filters add in an order of their own.

    Gaussians of shapes (``data``, ``opacities`` and ``sh_coeffs``, as ``volprim_rf_basic`` reads
    them) come behind the integrator's own, in the order of ``scene.shapes()``, and are
    differentiated with respect to the shapes' own parameters. Their quaternions are normalised,
    opacities are clamped to 0..1, and where a splat ends is up to this integrator, not to a shape's
    ``extent``. Of features such Gaussians have zeros, and no smoothing filter.

    As with Mitsuba's other integrators, a backward pass differentiates the scene as it is then:
    a parameter that was changed after ``mi.render()`` is differentiated at its new value. After
    the pass, the attribute ``last`` holds the derivatives with respect to the splats' positions
    on the film, which of them were visible, and the first Gaussian whose derivatives are not
    finite, if there is one. The attribute ``sh_degree`` may be changed from
    one rendering to the next.

    .. note:: Not differentiated: visibility, the order of the splats, the cut-offs of alpha and
        transmittance; the depth and the silhouette of surfaces. Derivatives with respect to a
        sensor's pose, focal lengths and principal point are computed where they are enabled, though
        Mitsuba's own sensors announce theirs as not differentiable.

    .. tabs::

        .. code-tab:: xml

            <integrator type="splats" id="integrator">
                <string name="filename" value="point_cloud.ply"/>
                <rgb name="background" value="1, 1, 1"/>
            </integrator>

        .. code-tab:: python

            'type': 'splats',
            'filename': 'point_cloud.ply',
            'background': [1, 1, 1]
    """

    def __init__(self, props: mi.Properties) -> None:
        # Before the base class, which has a warning of its own about scalar variants.
        if mi.variant() not in SUPPORTED_VARIANTS:
            raise ValueError(
                f"splats: the variant '{mi.variant()}' is not supported, "
                f"use mi.set_variant('{SUPPORTED_VARIANTS[0]}')"
            )
        super().__init__(props)
        gaussians = load_gaussians(props)
        for name in PARAMETER_NAMES:
            setattr(self, name, getattr(gaussians, name))
        self.smoothing, self.features = gaussians.smoothing, gaussians.features or {}
        self._has_own, self._turns = gaussians.num_gaussians > 0, turns_of_shapes(props)
        self._gathered: Any = None  # with those of the scene's shapes: see drgs.shapes
        self.ignore = ignored_effects(props)
        self.aovs = aovs_of(props, [*AOVS, *self.features])
        self.sh_degree = props.get("sh_degree", gaussians.sh_degree)
        self._sh_degree_is_given = "sh_degree" in props
        self.background = background_of(props)
        self.hide_emitters = boolean(props, "hide_emitters", False)
        self.choices = choices_of(props)
        self.near = positive(props, "near", NEAR)
        self.srgb_primitives = boolean(props, "srgb_primitives", True)
        self.nested = nested_integrator(props)
        self.nested_spp = whole_number(props, "nested_spp", 0)

        self.last: LastBackward | None = None
        self._rendered: dict[int, _Rendered] = {}  # by number of the view
        self._last_sensor: mi.Sensor | None = None  # that was rendered
        self._surfaces: Any = None  # SurfaceScene of the last scene that had any
        self._looked: dict[int, _Looked] = {}  # by number of the view
        self._film_maps: dict[str, np.ndarray] = {}  # by description of the film
        self._logged_plan = ""

    # ------------------------------------------------------------------------------------------
    # Parameters
    # ------------------------------------------------------------------------------------------

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the Gaussians and the background. Mitsuba assigns to these arrays in place."""
        for name in PARAMETER_NAMES:
            value = getattr(self, name)
            if dr.width(value) > 0:
                callback.put(name, value, mi.ParamFlags.Differentiable)
        for name, value in self.features.items():
            callback.put(name, value, mi.ParamFlags.Differentiable)
        callback.put("background", self.background, mi.ParamFlags.Differentiable)
        if self.nested is not None:
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        """Check that the parameters still fit together, and forget a frame of former ones.

        The frame's key does not tell that an array was written in place through a view, which
        is what ``SceneParameters.set_dirty`` announces.
        """
        if keys != ["background"]:
            self._rendered.clear()
            self._gathered = None
        if not self._has_own:
            return
        if dr.width(self.shN) == 0:  # not exposed, so that its rows could not be set
            self.shN = dr.zeros(mi.TensorXf, (next(iter(self.means.shape), 0), 0, 3))
        check_shapes(replace(self._own, features=self.features))
        check_degree(self.sh_degree, self._own)

    @property
    def sh_degree(self) -> int:
        """Highest spherical harmonics degree that is evaluated."""
        if self._gathered is not None and not self._sh_degree_is_given:
            return self._gathered.gaussians.sh_degree
        return self._sh_degree

    @sh_degree.setter
    def sh_degree(self, degree: int) -> None:
        check_degree(degree, self.gaussians)
        self._sh_degree, self._sh_degree_is_given = int(degree), True

    @property
    def gaussians(self) -> Gaussians:
        """What is rendered, as one value: the parameters, whose arrays may be attached.

        Once a scene with ellipsoids was rendered, theirs as well; then detached.
        """
        return self._own if self._gathered is None else self._gathered.gaussians

    def _gather(self, scene: mi.Scene) -> None:
        """Find the scene's ellipsoids, and convert them if they have changed."""
        shapes = _ellipsoids(scene)
        if shapes or set(self._turns) - {""}:
            from drgs.shapes import gather

            self._gathered = gather(self._own, shapes, self._turns, self._gathered)
            check_degree(self.sh_degree, self._gathered.gaussians)
        else:
            self._gathered = None
        if self.gaussians.num_gaussians == 0:
            raise ValueError(
                "splats: there are no Gaussians: give the integrator 'filename' or tensors "
                f"{', '.join(PARAMETER_NAMES)}, or the scene a shape of type ellipsoids or "
                "ellipsoidsmesh"
            )

    @property
    def _own(self) -> Gaussians:
        parameters = {name: getattr(self, name) for name in PARAMETER_NAMES}
        smoothing = None if "smoothing" in self.ignore else self.smoothing
        # What is not put out is not loaded.
        features = {k: v for k, v in self.features.items() if k in self.aovs.values()}
        return Gaussians(**parameters, smoothing=smoothing, features=features or None)

    @property
    def pipeline(self) -> rendering.Pipeline:
        """What this integrator's settings call for."""
        others = [_composited_feature(kind) for kind in self.aovs.values() if kind != "alpha"]
        return self.choices.pipeline(self.sh_degree, features=(rendering.color_features, *others))

    def aov_names(self) -> list[str]:
        """Of the channels besides colour and alpha."""
        return [f"{name}.{c}" for name, kind in self.aovs.items() for c in self._channels_of(kind)]

    def _channels_of(self, kind: str) -> Iterable[Any]:
        return AOVS[kind] if kind in AOVS else range(self.features[kind].shape[1])

    def to_string(self) -> str:
        """One line a setting; of those that are off or as usual, none."""
        settings = {
            "gaussians": self.gaussians.num_gaussians or "those of the scene's shapes",
            "sh_degree": self.sh_degree,
            "background": self.background,
            "near": self.near,
            "srgb_primitives": self.srgb_primitives,
            **self.choices.others_than_default,
        }
        if self.hide_emitters:
            settings["hide_emitters"] = True
        if self.aovs:
            settings["aovs"] = ", ".join(f"{name}:{kind}" for name, kind in self.aovs.items())
        if self.nested is not None:
            settings["nested"] = self.nested.class_name()
        if self.nested_spp:
            settings["nested_spp"] = self.nested_spp
        if self.ignore:
            settings["ignore"] = ", ".join(self.ignore)
        lines = ",\n".join(f"  {name} = {value}" for name, value in settings.items())
        return f"SplatsIntegrator[\n{lines}\n]"

    # ------------------------------------------------------------------------------------------
    # Rendering
    # ------------------------------------------------------------------------------------------

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render the Gaussians as seen by ``sensor``; see ``mi.Integrator.render``."""
        _refuse_recording()
        sensor = self._last_sensor = _resolve_sensor(scene, sensor)
        with dr.suspend_grad():
            self._gather(scene)
            self._log_plan(scene, sensor)
            shot = self._shot(scene, sensor, seed, spp)
            image = self._own_image(scene, shot)
            if shot.hybrid is not None:
                image = shot.hybrid.insertion.develop(image, shot.hybrid.picture())
            if evaluate:
                dr.eval(image)
        return image if develop else mi.TensorXf()

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: mi.TensorXf,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> None:
        """Accumulate the derivatives of the loss into the attached parameters.

        grad_in: derivative of the loss with respect to the developed image. Leaves
        :class:`LastBackward` in ``self.last``.
        """
        _refuse_recording()
        sensor = _resolve_sensor(scene, sensor)
        with dr.suspend_grad():
            self._gather(scene)
            shot = self._shot(scene, sensor, seed, spp)
            if shot.hybrid is not None:
                image = self._own_image(scene, shot)
                nested = shot.hybrid.picture()
                grad_in, d_nested = shot.hybrid.insertion.adjoint(image, nested, grad_in)
            d_pictures = shot.adjoint(grad_in)
            by_view = [
                self._view_backward(scene, view, d_channels)
                for view, d_channels in zip(shot.views, d_pictures, strict=True)
            ]
            gradients = reduce(rendering.added, by_view)
            self.last = LastBackward(
                means2d_grad=_rows(gradients.means2d),
                visible=gradients.visible,
                first_fault=gradients.first_fault,
            )
            with dr.resume_grad():
                own = gradients.parameters
                if self._gathered is not None:
                    own = self._gathered.accumulate(_ellipsoids(scene), own)
                for name in PARAMETER_NAMES:
                    _accumulate(getattr(self, name), getattr(own, name))
                for name, gradient in (own.features or {}).items():
                    _accumulate(self.features[name], gradient)
            if shot.hybrid is not None:
                shot.hybrid.backward(params, d_nested)
            sensor.film().clear()  # it may hold an attached block

    def _view_backward(
        self, scene: mi.Scene, view: _View, d_channels: list[list[mi.Float]]
    ) -> rendering.GaussianGradients:
        """Derivatives with respect to the Gaussians; all others are accumulated."""
        planes, constant = self._planes(view), self._constant()
        dr.eval(planes)
        # Colour conversion and background are a few operations per pixel, traced again and
        # differentiated by Dr.Jit.
        with dr.resume_grad():
            dr.enable_grad(planes, constant)
            channels = self._channels(view, planes, self._behind(scene, view, constant))
            dr.accum_grad(channels, d_channels)
            dr.enqueue(dr.ADMode.Backward, channels)
            dr.traverse(dr.ADMode.Backward)
            d_planes = dr.grad(planes)
            d_constant = None if constant is None else dr.grad(constant)
        dr.eval(d_planes, d_constant)
        with dr.resume_grad():
            state = self._sensor_state(view.sensor)
            of_camera = state.is_attached
        by_time = [
            rendering.frames_adjoint(self.gaussians, *of_time, of_camera)
            for of_time in zip(self._frames(view), d_planes, strict=True)
        ]
        with dr.resume_grad():
            if constant is not None:
                _accumulate(self.background, d_constant)
            if of_camera:
                numbers = [camera.numbers() for camera in self._cameras(state)]
                _accumulate_through(numbers, [gradients.camera for gradients in by_time])
        return reduce(rendering.added, by_time)

    def render_forward(
        self,
        scene: mi.Scene,
        params: Any,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> mi.TensorXf:
        """Directional derivative of the image along the gradients set on the parameters."""
        _refuse_recording()
        sensor = _resolve_sensor(scene, sensor)
        with dr.suspend_grad():
            self._gather(scene)
            shot = self._shot(scene, sensor, seed, spp)
            with dr.resume_grad():
                features = self._own.features
                tangents = Gaussians(
                    **{name: _tangent(getattr(self, name)) for name in PARAMETER_NAMES},
                    features=features and {k: _tangent(v) for k, v in features.items()},
                )
                if self._gathered is not None:
                    tangents = self._gathered.tangents(_ellipsoids(scene), tangents)
            d_planes = [self._plane_tangents(view, tangents) for view in shot.views]
            planes = [self._planes(view) for view in shot.views]
            dr.eval(planes, d_planes)
            with dr.resume_grad():
                constant = self._constant()
                dr.enable_grad(planes, constant)
                dr.set_grad(planes, d_planes)
                if constant is not None:
                    dr.set_grad(constant, dr.grad(self.background))
                image = shot.develop(
                    [
                        self._channels(view, of_view, self._behind(scene, view, constant))
                        for view, of_view in zip(shot.views, planes, strict=True)
                    ]
                )
                # The nested integrator, and other pictures of the same pass, read the gradients of
                # parameters again, also of those that are computed from others.
                dr.forward_to(image, flags=dr.ADFlag.ClearEdges)
                d_image = dr.grad(image)
            if shot.hybrid is not None:
                nested = shot.hybrid.picture()
                d_nested = shot.hybrid.tangent(params, nested)
                image = dr.detach(image)
                d_image = shot.hybrid.insertion.tangent(image, nested, d_image, d_nested)
            sensor.film().clear()  # it holds an attached block
        return d_image

    def sample(
        self, *, scene: mi.Scene, sampler: mi.Sampler, ray: Any, active: Any, **others: Any
    ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float], None]:
        """What the rays of a whole picture see: for ``aov``, all others are refused.

        See ``drgs.nesting``. Not differentiated, which ``aov`` only asks for the AOVs.
        """
        from drgs.nesting import PictureRays

        del others
        sensor = self._last_sensor
        objects = [self, *scene.shapes(), *([] if sensor is None else [sensor])]
        attached = any(dr.grad_enabled(value) for o in objects for _, value in mi.traverse(o))
        with dr.suspend_grad():
            rays = PictureRays.of(sensor, self.near, dr.detach(ray))
            if self.aovs and attached:
                raise NotImplementedError(
                    "splats: inside 'aov', derivatives with 'aovs' of this integrator are not "
                    "supported: leave them out, or render it alone"
                )
            self._gather(scene)
            hybrid = self._hybrid(scene, sensor, 0, 1)
            # With a single sample, what is seen of edges would be the mean over their pixels.
            times = 2 if rays.count == 1 and hybrid is not None else 1
            points, within = times * rays.positions, times * rays.within
            view = _View(NESTED, sensor, points, within, rays, True, hybrid)
            behind = self._behind(scene, view, self._constant())
            channels = rays.gathered(self._channels(view, self._planes(view), behind))
            self._rendered.pop(NESTED)
            self._looked.pop(NESTED, None)
            if hybrid is not None:
                channels = rays.with_surfaces(channels, hybrid, sampler, active)
            red, green, blue, alpha, *aovs = channels
            return mi.Color3f(red, green, blue), active & (alpha > 0), aovs, None

    def _shot(self, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int) -> _Shot:
        """One picture: where the sensor's pixels are evaluated, and how its film develops them."""
        hybrid = self._hybrid(scene, sensor, seed, spp)
        names = self.aov_names() + ([] if hybrid is None else hybrid.insertion.channels)
        film, spp = sensor.film(), spp or sensor.sampler().sample_count()
        if spp == 1 and film.rfilter().is_box_filter():
            exposure = CenterExposure(film, self._film_maps, names)
        else:
            from drgs.sampling import SampledExposure

            exposure = SampledExposure(sensor, seed, spp, self._film_maps, names)
        has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        whole = _View(
            0, sensor, exposure.positions, exposure.within, exposure.key, has_alpha, hybrid
        )
        if sensor.class_name() != "BatchSensor":
            return _Shot([whole], exposure, hybrid)
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
        return _Shot(views, exposure, hybrid, batch)

    def _hybrid(self, scene: mi.Scene, sensor: mi.Sensor, seed: Any, spp: int) -> Any:
        """The part that surfaces take in a picture; None where there are none."""
        if all(shape.is_ellipsoids() for shape in scene.shapes()):
            return None
        from drgs.surfaces import Hybrid, Insertion, SurfaceScene

        self._surfaces = SurfaceScene.of(scene, self._surfaces)
        nested = self.nested or mi.load_dict({"type": "path", "hide_emitters": self.hide_emitters})
        insertion = Insertion(
            sensor.film(),
            self._film_maps,
            self.aov_names(),
            shows_background=not self.hide_emitters and scene.environment() is not None,
            display_space=not self.srgb_primitives,
        )
        return Hybrid(self._surfaces, nested, sensor, seed, self.nested_spp or spp, insertion)

    def _own_image(self, scene: mi.Scene, shot: _Shot) -> mi.TensorXf:
        """The picture of the splats; for a hybrid one, with the channels that the rest needs."""
        constant = self._constant()
        return shot.develop(
            [
                self._channels(view, self._planes(view), self._behind(scene, view, constant))
                for view in shot.views
            ]
        )

    def _planes(self, view: _View) -> list[list[list[mi.Float]]]:
        """By time and by sample."""
        return [[frame.planes() for frame in of_time] for of_time in self._frames(view)]

    def _plane_tangents(self, view: _View, tangents: Gaussians) -> list[list[list[mi.Float]]]:
        frames = self._frames(view)
        with dr.resume_grad():
            d_cameras = self._camera_tangents(view.sensor, len(frames))
        return [
            rendering.frames_tangent(self.gaussians, of_time, tangents, d_camera)
            for of_time, d_camera in zip(frames, d_cameras, strict=True)
        ]

    def _frames(self, view: _View) -> list[list[rendering.Frame]]:
        """Render, or reuse the last frames if nothing that they depend on has changed.

        One list for each time at which the shutter is open, of a frame for each sample per pixel.

        ``mi.render`` calls ``render`` and, later, ``render_backward`` on the same object, with
        other renders possibly in between.
        """
        pipeline, gaussians = self.pipeline, dr.detach(self.gaussians)
        state = self._sensor_state(view.sensor).detached()
        looked = None if view.hybrid is None else self._look(view, state)
        key = pipeline, view.key, state, gaussians, looked
        last = self._rendered.get(view.index)
        if last is None or not last.matches(*key):
            seen = repeat(None) if looked is None else looked.seen
            frames = [
                _render(gaussians, camera, pipeline, view.positions, of_time)
                for camera, of_time in zip(self._cameras_of(state), seen, strict=False)
            ]
            last = self._rendered[view.index] = _Rendered(frames, *key)
        return last.frames

    def _look(self, view: _View, state: SensorState) -> _Looked:
        """At the scene's surfaces, unless the last look was the same."""
        from drgs.surfaces import look_at

        surfaces, last = view.hybrid.surfaces, self._looked.get(view.index)
        settings = view.key, self.hide_emitters
        if (
            last is not None
            and last.surfaces is surfaces
            and last.settings == settings
            and last.sensor.same_as(state)
        ):
            return last
        seen = look_at(
            surfaces.scene,
            view.sensor.film(),
            self._cameras_of(state),
            view.within,
            self.hide_emitters,
            with_normals="normal" in self.aovs.values(),
        )
        looked = self._looked[view.index] = _Looked(surfaces, settings, state, seen)
        return looked

    def _sensor_state(self, sensor: mi.Sensor) -> SensorState:
        return read_sensor(sensor, self.near)

    def _cameras_of(self, state: SensorState) -> list[Camera]:
        """What is simulated of the sensor's camera, detached; of each time."""
        return cameras_in_time(without(camera_from_sensor(state), self.ignore))

    def _camera_tangents(self, sensor: mi.Sensor, count: int) -> list[list[mi.Float] | None]:
        """Of each time's camera, derivatives of its numbers along those set on the sensor."""
        state = self._sensor_state(sensor)
        if not state.is_attached:
            return [None] * count
        numbers = [camera.numbers() for camera in self._cameras(state)]
        dr.forward_to(numbers, flags=dr.ADFlag.ClearEdges)
        return dr.grad(numbers)

    def _cameras(self, state: SensorState) -> list[Camera]:
        """Of each time, attached to the sensor's parameters."""
        dr.make_opaque(state.device)  # or each value of a literal would be a new kernel
        return cameras_in_time(without(state.make(state), self.ignore))

    def plan(self, scene: mi.Scene, *sensors: mi.Sensor) -> str:
        """What is simulated, what asked for it, and what is not simulated: one line an effect."""
        from drgs.effects import described, plan_of_sensors

        self._gather(scene)
        states = [self._sensor_state(one).detached() for s in sensors for one in _alone(s)]
        surfaces = [shape for shape in scene.shapes() if not shape.is_ellipsoids()]
        cameras = list(map(camera_from_sensor, states))
        return described(plan_of_sensors(self, cameras, scene.environment(), len(surfaces)))

    def _log_plan(self, scene: mi.Scene, sensor: mi.Sensor) -> None:
        """Once for each plan, where somebody listens."""
        if mi.logger() is None or mi.logger().log_level() > mi.LogLevel.Info:
            return
        plan = self.plan(scene, sensor)
        if plan != self._logged_plan:
            mi.Log(mi.LogLevel.Info, f"splats: {plan}")
            self._logged_plan = plan

    def _constant(self) -> mi.Color3f | None:
        """The background without gradients, if it is a colour; display space.

        No literal, or every colour would be a new kernel.
        """
        if isinstance(self.background, mi.Texture):
            return None
        constant = mi.Color3f(dr.detach(self.background))
        dr.make_opaque(constant)
        return constant

    def _behind(self, scene: mi.Scene, view: _View, constant: mi.Color3f | None) -> _Behind:
        """What is seen past the splats, in the space of the channels."""
        environment = None if self.hide_emitters else scene.environment()
        if environment is None and constant is not None:
            if self.srgb_primitives:
                constant = mi.math.srgb_to_linear(constant)
            return _Behind(repeat(repeat(constant)), opaque=False, radiance=repeat(repeat(None)))
        from drgs import backdrop

        if environment is not None:
            behind = backdrop.Environment(environment)
        else:
            behind = backdrop.Picture(self.background)
        state = self._sensor_state(view.sensor)
        cameras = [of_time[0].camera for of_time in self._frames(view)]
        if state.is_attached:
            cameras = self._cameras(state)
        colors = radiance = backdrop.seen_by(view.sensor.film(), behind, cameras, view.within)
        if not self.srgb_primitives:
            colors = [[mi.math.linear_to_srgb(color) for color in of_time] for of_time in colors]
        return _Behind(colors, behind.opaque, radiance)

    def _channels(
        self, view: _View, planes: list[list[list[mi.Float]]], behind: _Behind
    ) -> list[list[mi.Float]]:
        """What the film gets of each sample per pixel: the mean over the times."""
        looked = self._rendered[view.index].surfaces
        seen = repeat(repeat(None)) if looked is None else looked.seen

        def channels_of(planes: list[mi.Float], surface: Any, color: Any, radiance: Any) -> list:
            if surface is None:
                return self._composited(planes, color, behind.opaque, view.has_alpha)
            *planes, front = planes
            past = [(1 - surface.coverage) * planes[0], *planes[1:]]
            others = self._composited(
                past, color, behind.opaque, view.has_alpha, lambda kind: surface.added(kind, front)
            )
            return others + view.hybrid.insertion.values(surface, front, radiance)

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
        planes: list[mi.Float],
        behind: mi.Color3f,
        opaque: bool,
        has_alpha: bool,
        added: Callable[[str], list[mi.Float] | None] = lambda kind: None,
    ) -> list[mi.Float]:
        """Planes of pixels: red, green, blue, perhaps alpha, AOVs.

        added: to the channels of an AOV of this kind.
        """
        transmittance, red, green, blue, *others = planes
        color = mi.Color3f(red, green, blue)
        if self.srgb_primitives:
            color = mi.math.srgb_to_linear(color)
        channels = list(dr.fma(transmittance, behind, color))
        if has_alpha:
            alpha = 1 - transmittance
            channels.append(dr.full(mi.Float, 1, dr.width(alpha)) if opaque else alpha)
        for kind in self.aovs.values():
            if kind == "alpha":
                channels.append(1 - transmittance)
                continue
            values = [others.pop(0) for _ in self._channels_of(kind)]
            more = added(kind)
            channels += (
                values if more is None else [a + b for a, b in zip(values, more, strict=True)]
            )
        return channels


@dataclass(frozen=True, eq=False)
class _View:
    """What one sensor sees of a picture: mostly all of it."""

    index: int
    sensor: mi.Sensor
    positions: Sequence[Any]  # in the pixels, by sample: see drgs.samples
    within: Sequence[tuple[Any, Any]]  # the same, px from their upper left corners
    key: Any  # of these; None: pixel centres
    has_alpha: bool
    hybrid: Any  # drgs.surfaces.Hybrid, or None


@dataclass(frozen=True, eq=False)
class _Shot:
    """One picture."""

    views: list[_View]
    exposure: Any
    hybrid: Any  # drgs.surfaces.Hybrid, or None
    batch: Any = None  # drgs.batch.SideBySide, for several views

    def develop(self, pictures: list[list[list[mi.Float]]]) -> mi.TensorXf:
        """pictures: channels by view and by sample."""
        passes = pictures[0] if self.batch is None else self.batch.put_together(pictures)
        return self.exposure.develop(passes)

    def adjoint(self, grad_in: mi.TensorXf) -> list[list[list[mi.Float]]]:
        """Derivatives with respect to the channels, by view and by sample."""
        passes = self.exposure.adjoint(grad_in)
        if self.batch is None:
            return [passes]
        return [self.batch.cut(passes, view.index) for view in self.views]


@dataclass(frozen=True)
class _Behind:
    """What is seen past the splats."""

    colors: Any  # by time and by sample: Color3f, in the space of the channels
    opaque: bool  # whether it covers the film
    radiance: Any  # by time and by sample: the same, linear; None: of a constant


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


def _ellipsoids(scene: mi.Scene) -> list[mi.Shape]:
    return [shape for shape in scene.shapes() if shape.is_ellipsoids()]


def _composited_feature(kind: str) -> rendering.Feature:
    if kind == "depth":
        return rendering.depth_feature
    from drgs.extra_features import NamedFeature, normal_features

    return normal_features if kind == "normal" else NamedFeature(kind)


def _refuse_recording() -> None:
    """What is launched depends on what is seen, which a recording could not know."""
    if dr.flag(dr.JitFlag.FreezingScope):
        raise RuntimeError(
            "splats: rendering cannot be recorded by dr.freeze, as it reads counts back from the "
            "device: call mi.render outside of the frozen function"
        )


def _resolve_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    return scene.sensors()[sensor] if isinstance(sensor, int) else sensor


def _alone(sensor: mi.Sensor) -> list[mi.Sensor]:
    """The sensors of a batch, or the one."""
    if sensor.class_name() != "BatchSensor":
        return [sensor]
    from drgs.batch import SideBySide

    return SideBySide.of(sensor).sensors


def _rows(vector: Any) -> mi.TensorXf:
    return mi.TensorXf(interleave(list(vector)), (dr.width(vector), len(vector)))


def _tangent(parameter: Any) -> Any:
    """The gradient set on a parameter; an empty one is its own, as dr.grad drops its shape."""
    return dr.grad(parameter) if dr.width(parameter) > 0 else parameter


def _accumulate(parameter: Any, gradient: Any) -> None:
    if dr.width(parameter) > 0 and dr.grad_enabled(parameter):
        dr.accum_grad(parameter, gradient)


def _accumulate_through(values: list[list[Any]], gradients: list[list[mi.Float]]) -> None:
    """Accumulate into what the values were computed from."""
    pairs = zip(chain(*values), chain(*gradients), strict=True)
    attached = [(value, gradient) for value, gradient in pairs if dr.grad_enabled(value)]
    for value, gradient in attached:
        dr.accum_grad(value, gradient)
    dr.enqueue(dr.ADMode.Backward, [value for value, _ in attached])
    dr.traverse(dr.ADMode.Backward)


mi.register_integrator("splats", lambda props: SplatsIntegrator(props))
