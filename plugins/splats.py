"""The ``splats`` integrator: 3D Gaussian splatting as a Mitsuba plugin.

This file is where images (``drgs.integrator.image_render``) meet Mitsuba's parameters and
derivatives. Read ``minimal.py`` first: the same without options, on one page.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from operator import attrgetter

import drjit as dr
import mitsuba as mi
from typing_extensions import override

from drgs.core.arrays import interleave
from drgs.core.environment import check_variant
from drgs.core.errors import UnsupportedError
from drgs.core.types import Bool
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator.image_render import ImageRender
from drgs.integrator.properties import check_object, nested_integrators, read_state
from drgs.integrator.state import BackwardResult, ProjectedView, surfaces_in


def _setting(name: str, doc: str) -> property:
    """Return a property that may be set, for one of the state, which checks it."""

    def assign(self: SplatsIntegrator, value: object) -> None:
        setattr(self.state, name, value)

    return property(attrgetter(f"state.{name}"), assign, doc=doc)


class SplatsIntegrator(mi.CppADIntegrator):
    """3D Gaussian splatting, composited front to back over each pixel (Kerbl et al. 2023).

    .. pluginparameters::

     * - filename
       - |string|
       - File of the Gaussians: a PLY file in the layout of the 3DGS reference implementation,
         compressed PLY, SPZ, glTF (``.glb``) or ``.splat``. Where a format has y up, z is up in the
         scene. Without it, the tensors below are the Gaussians. Those of the scene's shapes of type
         ``ellipsoids`` and ``ellipsoidsmesh`` are rendered as well. (Default: none)
     * - means, quats, log_scales, logit_opacities, sh0, shN
       - |tensor|
       - The N Gaussians, before ``to_world``: centres (N, 3); quaternions wxyz (N, 4), of any norm;
         natural logarithms of the standard deviations (N, 3); opacities before the sigmoid (N);
         spherical harmonics coefficients of degree 0 (N, 1, 3) and above (N, K - 1, 3). (Default:
         those of ``filename``)
       - |exposed|, |differentiable|
     * - feature_...
       - |tensor|
       - Numbers of the Gaussians under a name of your own, (N, C), for ``aovs``. (Default: none)
       - |exposed|, |differentiable|
     * - smoothing
       - |tensor|
       - Standard deviation of the 3D smoothing filter of each Gaussian (N), scene units. (Default:
         the file's ``filter_3D``)
     * - to_world
       - |transform|
       - Rotation, uniform scale and translation of the Gaussians, with their harmonics. Their own
         parameters, such as ``means``, stay as they are given. Its derivatives are those of the
         nearest such transform. (Default: none)
       - |exposed|, |differentiable|
     * - shapes_to_world, shapes_to_world_...
       - |transform|
       - The ``to_world`` of the scene's ellipsoids, or of those with the id that the name ends
         with. Mitsuba applies it to centres and quaternions; this integrator then rotates the
         harmonics. (Default: none)
     * - sh_degree
       - |int|
       - Highest spherical harmonics degree that is evaluated, 0 to 3. (Default: the Gaussians')
     * - background
       - |rgb| or |texture|
       - Background of the splats: a colour in display space (sRGB-encoded), or a texture that is
         stretched over the film and, as all textures are, linear. (Default: black)
       - |exposed|, |differentiable|
     * - hide_emitters
       - |bool|
       - Show the background instead of an environment emitter of the scene. (Default: false)
     * - (Nested plugin)
       - |integrator|
       - Of type ``splats``, any number: an object with its own Gaussians and ``to_world``, rendered
         with the settings of this integrator. One of another type: renders the scene's surfaces,
         and should have the same ``hide_emitters``. (Default: ``path``; ``splatpath`` if ``light``
         is set, or something transmits light straight on)
       - |exposed|, |differentiable|
     * - nested_spp
       - |int|
       - Samples per pixel of the nested integrator. (Default: as many as of the splats)
     * - light
       - |string|
       - Light between splats and surfaces. ``none``: there is none; ``rays``: rays of the nested
         ``splatpath`` pass through the splats from the first surface on; ``probe``: rays from and
         to the objects in ``probes`` look splats up in images from the objects. (Default:
         ``none``)
     * - probes
       - |string|
       - Ids of shapes and emitters that have a probe, separated by commas. (Default: none)
     * - probe_fallback
       - |string|
       - Rays that pass behind something that is visible from a probe's centre. ``none``: they meet
         no splats; ``rays``: they are traced as with ``light`` ``rays``. (Default: ``none``)
     * - light_samples
       - |int|
       - Number of splats that a traced ray draws: 3 (also for 1 and 2) to 4096; 0: it composites
         all. (Default: 4)
     * - radiance_scale
       - |float|
       - Radiance of a splat of colour 1 in reflections and transmission. (Default: 1)
     * - shadows
       - |string|
       - Ids of shapes that cast shadows on splats, separated by commas. (Default: none)
     * - near
       - |float|
       - Depth of the near plane, scene units: Gaussians with a closer centre are culled. The larger
         of this and the sensor's ``near_clip`` applies. (Default: 0.01)
     * - srgb_primitives
       - |bool|
       - Whether the image is linear radiance, as Mitsuba's films expect, or is left in display
         space, the space of the splats' colours. (Default: true)
     * - aovs
       - |string|
       - Channels after colour, a list of ``name:type``, at most 64 besides alphas: ``depth``
         (``name.T``: z in the camera; with a fisheye lens, the distance), ``alpha`` (``name.I``),
         ``normal`` (``name.X``, ``.Y``, ``.Z``: surfaces' normals and splats' shortest axes, unit
         vectors in the world that point to the camera), or the name of a parameter ``feature_...``
         (``name.0``, ``.1``, ...). (Default: none)
     * - ignore
       - |string|
       - Effects that are not simulated: a list of ``distortion``, ``defocus``, ``motion`` and
         ``smoothing``. (Default: none)
     * - error
       - |float| or |string|
       - Largest root mean square error of an image in display space, from 0.00002 to below 1, also
         as "54 dB" or "0.5 steps" (of 8 bits). The cheapest approximations within it are found at
         the first rendering, by images of a few of the scene's sensors, and so are the samples of
         an open shutter. Filters, falloff, ``alpha_max`` and ``extent`` stay. AOVs are not
         measured. ``budget_report.stale`` names parameters that changed afterwards. (Default: none)
     * - projection, falloff, order, order_window, sh_direction, alpha_max, alpha_cut,
         transmittance_stop, extent, low_pass, antialiased
       - |string|, |int|, |float| or |bool|
       - See :class:`drgs.config.approximations.Approximations`.

    After a backward pass, ``last`` holds a :class:`drgs.integrator.state.BackwardResult`.

    Not differentiated: visibility, the order of the splats, the cut-offs of alpha and
    transmittance, depth and silhouette of surfaces. Derivatives that would be wrong are refused.
    """

    def __init__(self, props: mi.Properties) -> None:
        check_variant("splats", mi.variant())  # before the base class warns of scalar variants
        super().__init__(props)
        self._given = tuple(props.keys())
        nested = nested_integrators(props)
        self.objects = {k: v for k, v in nested.items() if isinstance(v, SplatsIntegrator)}
        for name, one in self.objects.items():
            check_object(name, one._given)
            one._is_object = True
        self._is_object = False  # nested in another
        objects = {name: one.state.own for name, one in self.objects.items()}
        others = [v for k, v in nested.items() if k not in self.objects]
        self.state = read_state(props, objects, others)
        self.last: BackwardResult | None = None
        self._lock = threading.RLock()  # of the cache and the film

    @override
    def traverse(self, cb: mi.TraversalCallback) -> None:
        state, own = self.state, self.state.own
        exposed = {
            name: value
            for name, value in own.gaussians.arrays.items()
            if name != "smoothing" and (name not in PARAMETER_NAMES or dr.width(value) > 0)
        }
        if own.has_gaussians:
            exposed["to_world"] = own.to_world
        exposed |= self.objects
        if not self._is_object:
            exposed["background"] = state.background
            if state.nested is not None:
                exposed["nested"] = state.nested
        for name, value in exposed.items():
            cb.put(name, value, mi.ParamFlags.Differentiable)

    @override
    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Check that parameters fit together; forget frames, also after writes in place."""
        if list(keys) != ["background"]:
            self.forget_frames()
        self.state.parameters_changed(keys, self._is_object)

    def forget_frames(self) -> None:
        """Drop cached frames, as if a parameter had changed."""
        self.state.cache.forget("frames")
        if self.last is not None:
            self.last = replace(self.last, frames=[])

    sh_degree = _setting("sh_degree", "Highest degree of spherical harmonics, 0 to 3.")
    nested_spp = _setting("nested_spp", "Samples per pixel of the nested integrator; 0: all.")
    smoothing = _setting("smoothing", "Smoothing filter of the own Gaussians (N,); None: off.")
    error = _setting("error", "Error budget, 0..1; None: none. The next rendering chooses for it.")
    budget_report = property(attrgetter("state.budget_report"), doc="What ``error`` has chosen.")
    gaussians = property(attrgetter("state.gaussians"), doc="All rendered Gaussians, world space.")
    pipeline = property(attrgetter("state.pipeline"), doc="Stages that the settings select.")
    srgb_primitives = property(attrgetter("state.srgb_primitives"), doc="If images are linear.")
    near = property(attrgetter("state.near"), doc="Near plane, scene units.")
    ignore = property(attrgetter("state.ignore"), doc="Effects that are not simulated.")

    @property
    def projected_view(self) -> ProjectedView | None:
        """Splats that are rendered instead of the Gaussians, by one sensor. May be set."""
        return self.state.projected_view

    @projected_view.setter
    def projected_view(self, view: ProjectedView | None) -> None:
        self.forget_frames()
        self.state.projected_view = view

    @override
    def aov_names(self) -> list[str]:
        return self.state.aov_names()

    def to_string(self) -> str:
        """Return one line a setting that is on and not at its default."""
        lines = ",\n".join(f"  {name} = {value}" for name, value in self.state.settings().items())
        return f"SplatsIntegrator[\n{lines}\n]"

    @override
    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        with self._rendering(scene, sensor, seed, spp) as render:
            image = render.image()
            if evaluate:
                dr.eval(image)
        return image if develop else mi.TensorXf()

    @override
    def render_backward(
        self,
        scene: mi.Scene,
        params: object,
        grad_in: mi.TensorXf,
        sensor: int | mi.Sensor = 0,
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
    ) -> None:
        """Accumulate derivatives into parameters; leave a ``BackwardResult`` in ``last``."""
        with self._rendering(scene, sensor, seed, spp, dr.ADMode.Backward) as render:
            if self.projected_view is not None:
                render.splats_backward(self.projected_view, grad_in)
            else:
                gradients = render.backward(params, grad_in)
                means2d, frames = gradients.means2d, self.state.cache.kept["frames 0"].value
                moved = mi.TensorXf(interleave(list(means2d)), (dr.width(means2d), 2))
                every = [frame for of_time in frames for frame in of_time]
                visible, first = gradients.visible, gradients.first_nonfinite
                self.last = BackwardResult(moved, visible, first, every)
                with dr.resume_grad():
                    self.state.accumulate(scene, gradients.parameters)

    @override
    def render_forward(
        self,
        scene: mi.Scene,
        params: object,
        sensor: int | mi.Sensor = 0,
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
    ) -> mi.TensorXf:
        """Return the directional derivative of the image along gradients set on parameters."""
        with self._rendering(scene, sensor, seed, spp, dr.ADMode.Forward) as render:
            with dr.resume_grad():
                tangents = self.state.tangents(scene)
            return render.tangent(params, tangents)

    @contextmanager
    def _rendering(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor,
        seed: int | mi.UInt32,
        spp: int,
        mode: dr.ADMode = dr.ADMode.Primal,
    ) -> Iterator[ImageRender]:
        """Yield an image to be rendered or, with another mode, differentiated."""
        if dr.flag(dr.JitFlag.FreezingScope):
            raise UnsupportedError(
                "splats: rendering cannot be recorded by dr.freeze, as it reads counts back from "
                "the device: call mi.render outside of the frozen function"
            )
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        if mode != dr.ADMode.Primal and surfaces_in(scene):
            from drgs.integrator.light.derivatives import check_derivatives

            check_derivatives(self.state, scene, sensor, mode)
        with self._lock, dr.suspend_grad():
            if mode == dr.ADMode.Primal:
                self.state.cache.sensor = sensor
            self._update(scene)
            yield ImageRender.prepare(self.state, scene, sensor, seed, spp)
            if mode != dr.ADMode.Primal:
                sensor.film().clear()  # it may hold an attached block

    @override
    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]  called by keyword
        self,
        *,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        active: Bool,
        **others: object,
    ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float], None]:
        """Render along the rays of a whole image, for ``aov``: see ``drgs.integrator.aov_rays``."""
        from drgs.integrator.aov_rays import ImageRays

        del others
        sensor = self.state.cache.sensor
        nodes = [self, *scene.shapes(), *([] if sensor is None else [sensor])]
        attached = any(dr.grad_enabled(value) for one in nodes for _, value in mi.traverse(one))
        with dr.suspend_grad():
            rays = ImageRays.from_rays(sensor, self.state.near, dr.detach(ray))
            assert sensor is not None, "refused by ImageRays.from_rays"
            if self.state.aovs and attached:
                raise UnsupportedError(
                    "splats: inside 'aov', derivatives with 'aovs' of this integrator are not "
                    "supported: leave them out, or render it alone"
                )
            self._update(scene)
            channels = rays.channels(self.state, scene, sensor, sampler, active)
            red, green, blue, alpha, *aovs = channels
            return mi.Color3f(red, green, blue), active & (alpha > 0), aovs, None

    def summary(self, scene: mi.Scene, *sensors: mi.Sensor) -> str:
        """Return one line per simulated effect with its reason, and the effects that are not."""
        from drgs.integrator.summary import summary_of_scene

        self._update(scene)
        return summary_of_scene(self.state, scene, sensors)

    def _update(self, scene: mi.Scene) -> None:
        self.state.update_gaussians(scene)
        if self.state.lighting.shadows:
            from drgs.integrator.light.shadows import shade

            shade(self.state, scene)
        if self.state.error is not None:
            from drgs.integrator.error_budget import keep_error_budget

            keep_error_budget(self.state, scene)


mi.register_integrator("splats", lambda props: SplatsIntegrator(props))
