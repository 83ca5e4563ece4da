"""The ``splats`` integrator: 3D Gaussian splatting as a Mitsuba plugin.

Executed once per Mitsuba variant (see ``drgs.plugins``). The rasterizer is in
``drgs.splatting.rendering``, an image of all that a scene has in ``drgs.integrator.image_render``;
this file is where both meet Mitsuba's parameters and derivatives. Read ``minimal.py`` first: the
same without options, on one page.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from drgs.core.arrays import interleave
from drgs.core.environment import check_variant
from drgs.core.errors import UnsupportedError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.checks import degree_of, surfaces_in
from drgs.integrator.image_render import ImageRender
from drgs.integrator.properties import check_object, nested_integrators, only_one, read_state
from drgs.integrator.state import BackwardResult
from drgs.splatting.rendering import Pipeline, ProjectionStage


class SplatsIntegrator(mi.CppADIntegrator):
    r"""
    .. _integrator-splats:

    3D Gaussian splatting (:monosp:`splats`)
    ----------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A PLY file in the layout of the 3DGS reference implementation, or a file in one of the
         formats compressed PLY, SPZ, glTF (``.glb``) and ``.splat``; where a format has y up, z is
         up in the scene. Without it, the Gaussians are given as tensors under the names below.
         With and without them, Gaussians of the scene's shapes of type ``ellipsoids`` and
         ``ellipsoidsmesh`` are rendered as well.
         What its header says of ``projection`` to ``antialiased`` below holds where these are not
         given; shapes have no such header.

     * - to_world
       - |transform|
       - Rotates, scales (the same along all axes) and moves the Gaussians of ``filename`` or the
         tensors, with what is seen of them from each side. Their own parameters, such as ``means``,
         stay as they are given. Its derivatives are those of the nearest such transform.
         (Default: none)
       - |exposed|, |differentiable|

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
         (Default: ``path``; where ``light`` is not ``none``, or anything lets light pass
         straight on, ``splatpath``)
         Those of type ``splats``, any number, are splat objects instead: each takes ``filename`` or
         tensors, ``to_world``, ``smoothing`` and ``feature_...``, and is rendered by this
         integrator, with its settings, together with its own Gaussians.
       - |exposed|, |differentiable|

     * - nested_spp
       - |int|
       - Samples per pixel of the nested integrator. (Default: as many as of the splats)

     * - light
       - |string|
       - How light passes between splats and surfaces. ``none``: not at all. ``rays``: the rays of
         the nested integrator, which must be ``splatpath``, pass the splats from the first surface
         on: surfaces reflect them, show them bent, take on their colours, and lie in their shadow.
         ``probe``: the same for objects that are named by ``probes``, whose rays look at pictures
         of the splats from the middle of the object, or, for a flat mirror, from where the camera
         is in it. (Default: ``none``)

     * - probes
       - |string|
       - Ids of shapes and emitters, separated by commas, that have a probe where ``light`` is
         ``probe``. Rays that leave such a shape meet splats; rays to such an emitter are weakened
         by them. (Default: none)

     * - unseen
       - |string|
       - What rays meet where a probe cannot tell, as it lies behind what the middle of the object
         sees. ``none``: nothing. ``rays``: what they do where ``light`` is ``rays``, which takes
         longer, but is needed where splats are close to the object. (Default: ``none``)

     * - light_samples
       - |int|
       - Splats that a ray draws, of those that it passes, where ``light`` or ``unseen`` is
         ``rays``, at least 3 (1 and 2 are as 3) and at most 4096; 0: it composites all. (Default:
         4)

     * - exposure
       - |float|
       - Radiance of a splat whose colour is 1, where surfaces see it: what scales splats against
         lamps. (Default: 1)

     * - shadows
       - |string|
       - Ids of shapes that were put among the splats, separated by commas. The colour of a splat
         that they shade is darkened by how much less light of the scene's emitters arrives there,
         estimated once for each splat. (Default: none)

     * - near
       - |float|
       - Near plane, in scene units: Gaussians whose centre is closer are culled. The sensor's
         ``near_clip`` applies as well: the larger of the two wins. Its ``far_clip`` holds for
         surfaces alone. (Default: 0.01)

     * - srgb_primitives
       - |bool|
       - Splat colours live in display space. If true, the image is linear radiance, which is
         what Mitsuba's films expect. If false, it is returned in display space, as splat
         trainers and viewers use it. (Default: |true|)

     * - aovs
       - |string|
       - What is put out besides colour, as in Mitsuba's ``aov``: a list of ``name:type``, such as
         ``d:depth, a:alpha``. ``depth`` (channel ``name.T``) is the sum of the depths (z in the
         camera, not the distance as in Mitsuba's ``aov``; with a fisheye lens, the distance) of
         splats and surfaces, weighted by their share in the pixel and not normalised; ``alpha``
         (``name.I``) the sum of these weights; ``normal`` (``name.X``, ``.Y``, ``.Z``) the
         weighted sum of surfaces' normals and of splats' shortest axes, unit vectors in the world
         that point to the camera. A type that is the name of a parameter ``feature_...``
         (``name.0``, ``.1``, ...) is the weighted sum of its rows: of splats alone, 0 on surfaces.
         There may be 64 channels besides alphas. (Default: none)

     * - ignore
       - |string|
       - Effects that the sensor or the Gaussians call for and that are not simulated: a list of
         ``distortion``, ``defocus``, ``motion`` and ``smoothing``. (Default: none)

     * - projection
       - |string|
       - How a Gaussian comes to the film. ``ewa``: by the affine approximation at its mean;
         ``unscented``: by the mean and covariance of projected sigma points; ``exact``: by its peak
         along each pixel's ray. (Default: ``ewa``)

     * - falloff
       - |string|
       - How alpha falls off around a splat. ``gaussian``: as the projected Gaussian does.
         (Default: ``gaussian``)

     * - order
       - |string|
       - In which splats are composited. ``center``: by the depth of their means; ``pixel``: by that
         of their peaks along each pixel's ray. (Default: ``center``)

     * - order_window
       - |int|
       - Splats that a pixel keeps waiting to put them in order, where ``order`` is ``pixel``.
         (Default: 4)

     * - sh_direction
       - |string|
       - In which colours are seen. ``mean``: towards the mean of a Gaussian; ``pixel``: along each
         pixel's ray. (Default: ``mean``)

     * - alpha_max
       - |float|
       - Upper clamp of a splat's alpha. (Default: 0.99)

     * - alpha_cut
       - |float|
       - Splats end where their alpha is smaller; 0: they do not. (Default: 1/255)

     * - transmittance_stop
       - |float|
       - A pixel ends before its transmittance is smaller; 0: never. (Default: 1e-4)

     * - extent
       - |float|
       - Standard deviations at which splats end. (Default: where ``alpha_cut`` ends them)

     * - low_pass
       - |float|
       - Variance that is added to each splat on the film, in square pixels; 0: none. (Default: 0.3)

     * - antialiased
       - |bool|
       - Compensate opacities for the low-pass filter, so that it keeps each splat's integral
         (Mip-Splatting, Yu et al. 2024). (Default: |false|)

     * - smoothing
       - |tensor|
       - Standard deviation of the 3D smoothing filter of each Gaussian (N), in scene units: see
         ``drgs.effects.smoothing``. (Default: the file's ``filter_3D``, if it has it)

     * - means, quats, log_scales, logit_opacities, sh0, shN
       - |tensor|
       - The N Gaussians, before ``to_world``: centres (N, 3); quaternions wxyz (N, 4), of any norm;
         natural logarithms of the standard deviations (N, 3); opacities before the sigmoid
         (N); spherical harmonics coefficients of degree 0 (N, 1, 3) and above (N, K - 1, 3).
         From numpy: ``mi.TensorXf(array)``.
       - |exposed|, |differentiable|

     * - feature_...
       - |tensor|
       - Numbers of the Gaussians under a name of your own, (N, C), to be put out: see ``aovs``.
       - |exposed|, |differentiable|

    This integrator composites Gaussians front to back over each pixel (Kerbl et al. 2023, "3D
    Gaussian Splatting for Real-Time Radiance Field Rendering"). Meshes and other surfaces of the
    scene are rendered by a nested integrator; each pixel composites what that shows at the depths
    of the surfaces that its ray meets, between the splats. Light passes from one to the other where
    ``light`` says so, and surfaces shade splats where ``shadows`` does. A scene without surfaces
    runs no nested integrator.

    Splats of colours c_i (display space) and weights w_i on a ray, with A = sum w_i and decoding D,
    are seen before a radiance L as A D(sum w_i c_i / A) + (1 - A) L, on the film, in mirrors and
    through glass. The own ``background`` is the last splat of the film's rays.

    With one sample per pixel and a ``box`` filter, each pixel is evaluated at its centre, and both
    the picture and the gradients are the same to the last bit in every run. With more samples or
    another filter, pixels are evaluated at the points that the sensor's sampler chooses;
    ``low_pass`` may then be 0. With a ``box`` filter this, too, is the same in every run; other
    filters add in an order of their own. No samples are taken beyond the film: its
    ``sample_border`` makes no difference.

    Gaussians of nested objects come behind the integrator's own, in the order in which they are
    given, and are sorted with them by depth. Degrees of spherical harmonics may differ. Where the
    headers of files specify different approximations, the integrator must be given one.

    Gaussians of shapes (``data``, ``opacities`` and ``sh_coeffs``, as ``volprim_rf_basic`` reads
    them) come behind all of these, in the order of ``scene.shapes()``, and are
    differentiated with respect to the shapes' own parameters. Their quaternions are normalised,
    opacities are clamped to 0..1, and where a splat ends is up to this integrator, not to a shape's
    ``extent``. Of features such Gaussians have zeros, and no smoothing filter.

    As with Mitsuba's other integrators, a backward pass differentiates the scene as it is then:
    a parameter that was changed after ``mi.render()`` is differentiated at its new value. After
    the pass, the attribute ``last`` holds the derivatives with respect to the splats' positions
    on the film, which of them were visible, the first Gaussian whose derivatives are not finite,
    if there is one, and how much each was seen of. The attributes ``sh_degree``, ``nested_spp`` and
    ``smoothing`` may be set from one rendering to the next.

    .. note:: Not differentiated: visibility, the order of the splats, the cut-offs of alpha and
        transmittance; the depth and the silhouette of surfaces. Among surfaces that show splats
        (see ``light``), derivatives with respect to Gaussians and their ``to_world`` are refused,
        and among any surfaces those with respect to a sensor. Without surfaces, those with respect
        to its pose, focal lengths and principal point are computed where they are enabled, though
        Mitsuba's own sensors announce theirs as not differentiable. Parameters of surfaces and
        emitters whose derivative would be wrong are refused by their names.

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
        check_variant("splats", mi.variant())
        super().__init__(props)
        self._given = tuple(props.keys())
        nested = nested_integrators(props)
        self.objects = {k: v for k, v in nested.items() if isinstance(v, SplatsIntegrator)}
        for name, one in self.objects.items():
            one.become_object(name)
        self._is_object = False  # nested in another
        self.state = read_state(
            props,
            {name: one.state.own for name, one in self.objects.items()},
            only_one([v for k, v in nested.items() if k not in self.objects]),
        )
        self.last: BackwardResult | None = None
        self._lock = threading.RLock()  # of the cache, and of what a rendering leaves in the film

    # ------------------------------------------------------------------------------------------
    # Parameters
    # ------------------------------------------------------------------------------------------

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the Gaussians and the background. Mitsuba assigns to these arrays in place."""
        state, own = self.state, self.state.own
        found = {name: getattr(own.gaussians, name) for name in PARAMETER_NAMES}
        found = {name: value for name, value in found.items() if dr.width(value) > 0}
        found |= own.gaussians.features or {}
        if state.has_own:
            found["to_world"] = own.to_world
        found |= self.objects
        if not self._is_object:
            found["background"] = state.background
            if state.nested is not None:
                found["nested"] = state.nested
        for name, value in found.items():
            callback.put(name, value, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        """Check that the parameters still fit together, and forget a frame of former ones.

        The frame's key does not tell that an array was written in place through a view, which
        is what ``SceneParameters.set_dirty`` announces.
        """
        if keys != ["background"]:
            self.forget_frames()
        self.state.parameters_changed(keys, self._is_object)

    def forget_frames(self) -> None:
        """Render the next image anew, also if no parameter has changed."""
        self.state.cache.frames.clear()
        if self.last is not None:
            self.last = replace(self.last, frames=[])

    def become_object(self, name: str) -> None:
        """Leave rendering to the integrator that this one is nested in.

        Raises PluginError for settings of rendering.
        """
        check_object(name, self._given)
        self._is_object = True

    @property
    def sh_degree(self) -> int:
        """Highest spherical harmonics degree that is evaluated; 0 to 3. May be set.

        A scene is refused whose Gaussians, those of its shapes included, do not have it.
        """
        return self.state.sh_degree

    @sh_degree.setter
    def sh_degree(self, degree: int) -> None:
        self.state.given_degree = degree_of(degree)

    @property
    def nested_spp(self) -> int:
        """Samples per pixel of the nested integrator; 0: as many as of the splats. May be set."""
        return self.state.nested_spp

    @nested_spp.setter
    def nested_spp(self, count: int) -> None:
        self.state.nested_spp = count

    @property
    def smoothing(self) -> mi.Float | None:
        """Smoothing filter of the own Gaussians (N,), scene units; not differentiated. May be set.

        None: there is no filter.
        """
        return self.state.own.gaussians.smoothing

    @smoothing.setter
    def smoothing(self, filter_: mi.Float | None) -> None:
        own = self.state.own
        own.gaussians = replace(own.gaussians, smoothing=filter_)

    @property
    def gaussians(self) -> Gaussians:
        """All rendered Gaussians: see :attr:`drgs.integrator.state.SplatsState.gaussians`."""
        return self.state.gaussians

    @property
    def pipeline(self) -> Pipeline:
        """Stages that the settings select."""
        return self.state.pipeline

    @property
    def srgb_primitives(self) -> bool:
        """True if the image is linear radiance; ``volprim_rf_basic`` has the same attribute."""
        return self.state.srgb_primitives

    @property
    def near(self) -> float:
        """Near plane, scene units."""
        return self.state.near

    @property
    def ignore(self) -> Sequence[str]:
        """Effects that are not simulated."""
        return self.state.ignore

    def use_projection(self, stage: ProjectionStage) -> None:
        """Project the Gaussians by another stage, such as one that several processes share."""
        self.state.projection = stage

    def aov_names(self) -> list[str]:
        """Return the names of the channels besides colour and alpha."""
        return self.state.aov_names()

    def to_string(self) -> str:
        """Return one line a setting, without those that are off or at their default."""
        state = self.state
        gathered = state.cache.gathered
        if gathered is None:
            count = sum(one.gaussians.num_gaussians for one in state.objects.values())
        else:
            count = gathered.gaussians.num_gaussians
        settings = {
            "gaussians": count or "those of the scene's shapes",
            "sh_degree": state.sh_degree,
            "background": state.background,
            "near": state.near,
            "srgb_primitives": state.srgb_primitives,
            **state.approximations.others_than_default,
        }
        others = {
            "objects": ", ".join(self.objects),
            "hide_emitters": state.hide_emitters,
            "aovs": ", ".join(f"{name}:{kind}" for name, kind in state.aovs.items()),
            "nested": state.nested and state.nested.class_name(),
            "nested_spp": state.nested_spp,
        }
        if state.light != "none":
            others |= {"light": state.light, "exposure": state.exposure}
        others["ignore"] = ", ".join(state.ignore)
        settings |= {name: value for name, value in others.items() if value}
        lines = ",\n".join(f"  {name} = {value}" for name, value in settings.items())
        return f"SplatsIntegrator[\n{lines}\n]"

    # ------------------------------------------------------------------------------------------
    # Rendering
    # ------------------------------------------------------------------------------------------

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render the Gaussians as seen by ``sensor``; see ``mi.Integrator.render``."""
        sensor = _resolve_sensor(scene, sensor)
        with self._lock, dr.suspend_grad():
            self.state.cache.sensor = sensor
            self._gather(scene)
            self._log_summary(scene, sensor)
            image = ImageRender.of(self.state, scene, sensor, seed, spp).image()
            if evaluate:
                dr.eval(image)
        return image if develop else mi.TensorXf()

    def render_backward(
        self,
        scene: mi.Scene,
        params: object,
        grad_in: mi.TensorXf,
        sensor: int | mi.Sensor = 0,
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
    ) -> None:
        """Accumulate the derivatives of the loss into the attached parameters.

        grad_in: derivative of the loss with respect to the developed image. Leaves
        :class:`drgs.integrator.state.BackwardResult` in ``self.last``.
        """
        sensor = _resolve_sensor(scene, sensor)
        self._check_derivatives(scene, sensor, dr.ADMode.Backward)
        with self._lock, dr.suspend_grad():
            self._gather(scene)
            render = ImageRender.of(self.state, scene, sensor, seed, spp)
            gradients = render.backward(params, grad_in)
            means2d, frames = gradients.means2d, self.state.cache.frames[0].value
            self.last = BackwardResult(
                mi.TensorXf(interleave(list(means2d)), (dr.width(means2d), 2)),
                gradients.visible,
                gradients.first_fault,
                [frame for of_time in frames for frame in of_time],
            )
            if gradients.parameters is not None:
                with dr.resume_grad():
                    self.state.accumulate(scene, gradients.parameters)
            sensor.film().clear()  # it may hold an attached block

    def render_forward(
        self,
        scene: mi.Scene,
        params: object,
        sensor: int | mi.Sensor = 0,
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
    ) -> mi.TensorXf:
        """Return the directional derivative of the image along gradients set on parameters."""
        sensor = _resolve_sensor(scene, sensor)
        self._check_derivatives(scene, sensor, dr.ADMode.Forward)
        with self._lock, dr.suspend_grad():
            self._gather(scene)
            with dr.resume_grad():
                tangents = self.state.tangents(scene)
            d_image = ImageRender.of(self.state, scene, sensor, seed, spp).tangent(params, tangents)
            sensor.film().clear()  # it holds an attached block
        return d_image

    def sample(
        self, *, scene: mi.Scene, sampler: mi.Sampler, ray: Any, active: Any, **others: Any
    ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float], None]:
        """Render along the rays of a whole image, for ``aov``; all others are refused.

        See ``drgs.integrator.aov_rays``. Not differentiated: ``aov`` needs it for AOVs alone.
        """
        from drgs.integrator.aov_rays import ImageRays

        del others
        sensor = self.state.cache.sensor
        nodes = [self, *scene.shapes(), *([] if sensor is None else [sensor])]
        attached = any(dr.grad_enabled(value) for one in nodes for _, value in mi.traverse(one))
        with dr.suspend_grad():
            rays = ImageRays.of(sensor, self.state.near, dr.detach(ray))
            if self.state.aovs and attached:
                raise UnsupportedError(
                    "splats: inside 'aov', derivatives with 'aovs' of this integrator are not "
                    "supported: leave them out, or render it alone"
                )
            self._gather(scene)
            channels = rays.channels(self.state, scene, sensor, sampler, active)
            red, green, blue, alpha, *aovs = channels
            return mi.Color3f(red, green, blue), active & (alpha > 0), aovs, None

    def summary(self, scene: mi.Scene, *sensors: mi.Sensor) -> str:
        """Return one line an effect: what is simulated, what asked for it, and what is not."""
        from drgs.integrator.summary import summary_of_scene

        self._gather(scene)
        return summary_of_scene(self.state, scene, sensors)

    def _gather(self, scene: mi.Scene) -> None:
        """Find the scene's Gaussians, and shade them."""
        self.state.gather(scene)
        if self.state.shadows:
            from drgs.integrator.shadows import shade

            shade(self.state, scene)

    def _check_derivatives(self, scene: mi.Scene, sensor: mi.Sensor, mode: dr.ADMode) -> None:
        """Refuse those that would be wrong."""
        if surfaces_in(scene):
            from drgs.integrator.derivatives import check_derivatives

            check_derivatives(self.state, scene, sensor, mode)

    def _log_summary(self, scene: mi.Scene, sensor: mi.Sensor) -> None:
        """Log each summary once, if the logger shows it."""
        if mi.logger() is None or mi.logger().log_level() > mi.LogLevel.Info:
            return
        summary = self.summary(scene, sensor)
        if summary != self.state.cache.summary:
            mi.Log(mi.LogLevel.Info, f"splats: {summary}")
            self.state.cache.summary = summary


def _resolve_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """Return the sensor itself.

    Raises UnsupportedError while Dr.Jit records: what is launched depends on what is seen.
    """
    if dr.flag(dr.JitFlag.FreezingScope):
        raise UnsupportedError(
            "splats: rendering cannot be recorded by dr.freeze, as it reads counts back from the "
            "device: call mi.render outside of the frozen function"
        )
    return scene.sensors()[sensor] if isinstance(sensor, int) else sensor


mi.register_integrator("splats", lambda props: SplatsIntegrator(props))
