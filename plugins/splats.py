"""The ``splats`` integrator: 3D Gaussian splatting as a Mitsuba plugin.

Executed once per Mitsuba variant (see ``drgs.plugins``). The rasterizer itself is
``drgs.splatting.rendering``; this file is where it meets sensors, films, parameters and gradients.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from drgs.accuracy.pipeline import pipeline_of
from drgs.core.arrays import interleave
from drgs.core.constants import NEAR
from drgs.core.errors import PluginError, UnsupportedError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.cache import Memory
from drgs.integrator.limits import check_columns
from drgs.integrator.picture import Picture, sensors_of
from drgs.integrator.properties import (
    AOVS,
    KNOWN,
    LIGHT_SAMPLES,
    MAX_LIGHT_SAMPLES,
    UNSEEN,
    aovs_of,
    approximations_of,
    background_of,
    boolean,
    check_degree,
    check_shapes,
    degree_of,
    ids_of,
    ignored_effects,
    integer,
    light_of,
    load_gaussians,
    nested_integrator,
    one_of,
    positive,
    probes_of,
    refuse_unknown,
    said_by_file,
    turns_of_shapes,
)
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.integrator.view import accumulate, feature_of
from drgs.splatting import rendering

if TYPE_CHECKING:  # imported where a scene has shapes of Gaussians
    from drgs.integrator.ellipsoids import Gathered

SUPPORTED_VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")


@dataclass(frozen=True)
class LastBackward:
    """What a backward pass knows of the splats on the film and ``mi.render`` cannot return.

    Dr.Jit traverses it with the integrator and resolves annotations, whatever variant is active.
    """

    means2d_grad: Any  # TensorXf (N, 2): derivative of the loss, per px on the film
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
         (Default: ``path``; where ``light`` is not ``none``, ``splatpath``)
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
         of the splats from the middle of the object. (Default: ``none``)

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
       - Splat colours live in display space. If true, the image is converted to linear
         radiance, which is what Mitsuba's films expect. If false, it is returned in display
         space, as splat trainers and viewers use it. (Default: |true|)

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
       - The N Gaussians: centres (N, 3) in world space; quaternions wxyz (N, 4), of any norm;
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
    scene are rendered by a nested integrator; each pixel composites what that shows at the depth of
    the first surface, between the splats. Light passes from one to the other where ``light`` says
    so, and surfaces shade splats where ``shadows`` does. A scene without surfaces runs no nested
    integrator.

    With one sample per pixel and a ``box`` filter, each pixel is evaluated at its centre, and both
    the picture and the gradients are the same to the last bit in every run. With more samples or
    another filter, pixels are evaluated at the points that the sensor's sampler chooses;
    ``low_pass`` may then be 0. With a ``box`` filter this, too, is the same in every run; other
    filters add in an order of their own. No samples are taken beyond the film: its
    ``sample_border`` makes no difference.

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
        transmittance; the depth and the silhouette of surfaces. Among surfaces that show splats
        (see ``light``), derivatives with respect to Gaussians are refused. Those with respect to a
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
            raise PluginError(
                f"splats: the variant '{mi.variant()}' is not supported, "
                f"use mi.set_variant('{SUPPORTED_VARIANTS[0]}')"
            )
        super().__init__(props)
        gaussians = load_gaussians(props)
        for name in PARAMETER_NAMES:
            setattr(self, name, getattr(gaussians, name))
        self.smoothing, self.features = gaussians.smoothing, gaussians.features or {}
        self._has_own, self._turns = gaussians.num_gaussians > 0, turns_of_shapes(props)
        self._gathered: Gathered | None = None  # with the Gaussians of the scene's shapes
        self._scene_has_shapes = False  # that are Gaussians: the scene that was rendered last
        self.ignore = ignored_effects(props)
        self.aovs = aovs_of(props, [*AOVS, *self.features])
        self.sh_degree = props.get("sh_degree", gaussians.sh_degree)
        self._sh_degree_is_given = "sh_degree" in props
        self.background = background_of(props)
        self.hide_emitters = boolean(props, "hide_emitters", False)
        said = said_by_file(props, gaussians)
        self.approximations, self.said_by_file = approximations_of(props, said), tuple(said)
        self.near = positive(props, "near", NEAR)
        self.srgb_primitives = boolean(props, "srgb_primitives", True)
        self.nested = nested_integrator(props)
        self.nested_spp = integer(props, "nested_spp", 0, least=0)
        self.light = light_of(props, self.nested)
        self.exposure = positive(props, "exposure", 1.0)
        self.probes = probes_of(props, self.light)
        self.unseen = one_of(props, "unseen", UNSEEN)
        self.shadows = ids_of(props, "shadows")
        self.light_samples = integer(
            props, "light_samples", LIGHT_SAMPLES, least=0, most=MAX_LIGHT_SAMPLES
        )
        refuse_unknown(props, KNOWN)
        self._check_columns()

        self.last: LastBackward | None = None
        self.source: rendering.Source | None = None  # of the splats; None: they are projected here
        self.memory = Memory()
        self._lock = threading.RLock()  # of the memory, and of what a picture leaves in the film
        self._last_sensor: mi.Sensor | None = None  # that was rendered
        self._logged_summary = ""

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
            self.memory.rendered.clear()
            self._gathered = None
        if not self._has_own:
            return
        if dr.width(self.shN) == 0:  # not exposed, so that its rows could not be set
            self.shN = dr.zeros(mi.TensorXf, (next(iter(self.means.shape), 0), 0, 3))
        check_shapes(replace(self._own, features=self.features))
        self._check_columns()
        if not (self._sh_degree_is_given or self._scene_has_shapes):
            check_degree(self.sh_degree, self._own)

    def _check_columns(self) -> None:
        check_columns({n: len(self.channels_of(k)) for n, k in self.aovs.items() if k != "alpha"})

    @property
    def sh_degree(self) -> int:
        """Highest spherical harmonics degree that is evaluated; 0 to 3.

        A scene is refused whose Gaussians, those of its shapes included, do not have it.
        """
        if self._gathered is not None and not self._sh_degree_is_given:
            return self._gathered.gaussians.sh_degree
        return self._sh_degree

    @sh_degree.setter
    def sh_degree(self, degree: int) -> None:
        self._sh_degree, self._sh_degree_is_given = degree_of(degree), True

    @property
    def gaussians(self) -> Gaussians:
        """What is rendered, as one value: the parameters, whose arrays may be attached.

        Once a scene with ellipsoids was rendered, theirs as well; then detached.
        """
        if self.memory.shadows is not None:
            return self.memory.shadows.gaussians
        return self._own if self._gathered is None else self._gathered.gaussians

    def _gather(self, scene: mi.Scene) -> None:
        """Find the scene's ellipsoids, and convert them if they have changed.

        Rows that do not fit, of an update that was refused, would be read beyond their end.
        """
        if self._has_own:
            check_shapes(self._own)
        shapes = _ellipsoids(scene)
        self._scene_has_shapes = bool(shapes)
        if shapes or set(self._turns) - {""}:
            from drgs.integrator.ellipsoids import gather

            self._gathered = gather(self._own, shapes, self._turns, self._gathered)
        else:
            self._gathered = None
        if self.gaussians.num_gaussians == 0:
            raise PluginError(
                "splats: there are no Gaussians: give the integrator 'filename' or tensors "
                f"{', '.join(PARAMETER_NAMES)}, or the scene a shape of type ellipsoids or "
                "ellipsoidsmesh"
            )
        check_degree(self.sh_degree, self.gaussians)
        self._shade(scene)

    def _shade(self, scene: mi.Scene) -> None:
        """Darken what lies in the shadow of surfaces."""
        last, self.memory.shadows = self.memory.shadows, None
        if self.shadows:
            from drgs.integrator.shadows import Shadows

            self.memory.shadows = Shadows.of(self, self.gaussians, scene, last)

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
        others = [feature_of(kind) for kind in self.aovs.values() if kind != "alpha"]
        features = (rendering.color_features, *others)
        pipeline = pipeline_of(self.approximations, self.sh_degree, features=features)
        return pipeline if self.source is None else replace(pipeline, source=self.source)

    def aov_names(self) -> list[str]:
        """Of the channels besides colour and alpha."""
        return [f"{name}.{c}" for name, kind in self.aovs.items() for c in self.channels_of(kind)]

    def channels_of(self, kind: str) -> Sequence[int | str]:
        """What comes behind the dot in the names of an AOV's channels."""
        return AOVS[kind] if kind in AOVS else range(self.features[kind].shape[1])

    def to_string(self) -> str:
        """One line a setting; of those that are off or as usual, none."""
        settings = {
            "gaussians": self.gaussians.num_gaussians or "those of the scene's shapes",
            "sh_degree": self.sh_degree,
            "background": self.background,
            "near": self.near,
            "srgb_primitives": self.srgb_primitives,
            **self.approximations.others_than_default,
        }
        if self.hide_emitters:
            settings["hide_emitters"] = True
        if self.aovs:
            settings["aovs"] = ", ".join(f"{name}:{kind}" for name, kind in self.aovs.items())
        if self.nested is not None:
            settings["nested"] = self.nested.class_name()
        if self.nested_spp:
            settings["nested_spp"] = self.nested_spp
        if self.light != "none":
            settings["light"], settings["exposure"] = self.light, self.exposure
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
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render the Gaussians as seen by ``sensor``; see ``mi.Integrator.render``."""
        _refuse_recording()
        sensor = _resolve_sensor(scene, sensor)
        with self._lock, dr.suspend_grad():
            self._last_sensor = sensor
            self._gather(scene)
            self._log_summary(scene, sensor)
            image = Picture.of(self, scene, sensor, seed, spp).image()
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
        :class:`LastBackward` in ``self.last``.
        """
        _refuse_recording()
        self._refuse_reflected(scene)
        sensor = _resolve_sensor(scene, sensor)
        with self._lock, dr.suspend_grad():
            self._gather(scene)
            gradients = Picture.of(self, scene, sensor, seed, spp).backward(params, grad_in)
            self.last = LastBackward(
                means2d_grad=_rows(gradients.means2d),
                visible=gradients.visible,
                first_fault=gradients.first_fault,
            )
            if gradients.parameters is not None:
                with dr.resume_grad():
                    self.accumulate(scene, gradients.parameters)
            sensor.film().clear()  # it may hold an attached block

    def accumulate(self, scene: mi.Scene, own: Gaussians) -> None:
        """Add derivatives with respect to the Gaussians to those of the attached parameters."""
        if self._gathered is not None:
            own = self._gathered.accumulate(_ellipsoids(scene), own)
        for name in PARAMETER_NAMES:
            accumulate(getattr(self, name), getattr(own, name))
        for name, gradient in (own.features or {}).items():
            accumulate(self.features[name], gradient)

    def render_forward(
        self,
        scene: mi.Scene,
        params: object,
        sensor: int | mi.Sensor = 0,
        seed: int | mi.UInt32 = 0,
        spp: int = 0,
    ) -> mi.TensorXf:
        """Directional derivative of the image along the gradients set on the parameters."""
        _refuse_recording()
        self._refuse_reflected(scene)
        sensor = _resolve_sensor(scene, sensor)
        with self._lock, dr.suspend_grad():
            self._gather(scene)
            with dr.resume_grad():
                features = self._own.features
                tangents = Gaussians(
                    **{name: _tangent(getattr(self, name)) for name in PARAMETER_NAMES},
                    features=features and {k: _tangent(v) for k, v in features.items()},
                )
                if self._gathered is not None:
                    tangents = self._gathered.tangents(_ellipsoids(scene), tangents)
            d_image = Picture.of(self, scene, sensor, seed, spp).tangent(params, tangents)
            sensor.film().clear()  # it holds an attached block
        return d_image

    def _refuse_reflected(self, scene: mi.Scene) -> None:
        """Derivatives of Gaussians that surfaces show: the nested integrator leaves them out."""
        shapes = scene.shapes()
        surfaces = [shape for shape in shapes if not shape.is_ellipsoids()]
        if not surfaces or (self.light == "none" and not self.shadows):
            return
        gaussians = [vars(self._own), *(mi.traverse(s) for s in shapes if s.is_ellipsoids())]
        if any(dr.grad_enabled(value) for of in gaussians for _, value in of.items()):
            raise UnsupportedError(
                f"splats: with light '{self.light}' and shadows '{', '.join(self.shadows)}', the "
                "Gaussians are not differentiated, as surfaces show and shade them; detach their "
                "parameters, or set light to 'none' and leave out shadows"
            )

    def sample(
        self, *, scene: mi.Scene, sampler: mi.Sampler, ray: Any, active: Any, **others: Any
    ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float], None]:
        """What the rays of a whole picture see: for ``aov``, all others are refused.

        See ``drgs.integrator.aov_rays``. Not differentiated, which ``aov`` only asks for the AOVs.
        """
        from drgs.integrator.aov_rays import PictureRays

        del others
        sensor = self._last_sensor
        objects = [self, *scene.shapes(), *([] if sensor is None else [sensor])]
        attached = any(dr.grad_enabled(value) for o in objects for _, value in mi.traverse(o))
        with dr.suspend_grad():
            rays = PictureRays.of(sensor, self.near, dr.detach(ray))
            if self.aovs and attached:
                raise UnsupportedError(
                    "splats: inside 'aov', derivatives with 'aovs' of this integrator are not "
                    "supported: leave them out, or render it alone"
                )
            self._gather(scene)
            channels = rays.channels(self, scene, sensor, sampler, active)
            red, green, blue, alpha, *aovs = channels
            return mi.Color3f(red, green, blue), active & (alpha > 0), aovs, None

    def summary(self, scene: mi.Scene, *sensors: mi.Sensor) -> str:
        """What is simulated, what asked for it, and what is not simulated: one line an effect."""
        from drgs.integrator.summary import described, summary_of_sensors

        self._gather(scene)
        alone = [one for sensor in sensors for one in sensors_of(sensor)]
        states = [read_sensor(one, self.near).detached() for one in alone]
        surfaces = [shape for shape in scene.shapes() if not shape.is_ellipsoids()]
        cameras = list(map(camera_from_sensor, states))
        return described(summary_of_sensors(self, cameras, scene.environment(), len(surfaces)))

    def _log_summary(self, scene: mi.Scene, sensor: mi.Sensor) -> None:
        """Once for each summary, where somebody listens."""
        if mi.logger() is None or mi.logger().log_level() > mi.LogLevel.Info:
            return
        summary = self.summary(scene, sensor)
        if summary != self._logged_summary:
            mi.Log(mi.LogLevel.Info, f"splats: {summary}")
            self._logged_summary = summary


def _ellipsoids(scene: mi.Scene) -> list[mi.Shape]:
    return [shape for shape in scene.shapes() if shape.is_ellipsoids()]


def _refuse_recording() -> None:
    """What is launched depends on what is seen, which a recording could not know."""
    if dr.flag(dr.JitFlag.FreezingScope):
        raise UnsupportedError(
            "splats: rendering cannot be recorded by dr.freeze, as it reads counts back from the "
            "device: call mi.render outside of the frozen function"
        )


def _resolve_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    return scene.sensors()[sensor] if isinstance(sensor, int) else sensor


def _rows(vector: Any) -> mi.TensorXf:
    return mi.TensorXf(interleave(list(vector)), (dr.width(vector), len(vector)))


def _tangent(parameter: Any) -> Any:
    """The gradient set on a parameter; an empty one is its own, as dr.grad drops its shape."""
    return dr.grad(parameter) if dr.width(parameter) > 0 else parameter


mi.register_integrator("splats", lambda props: SplatsIntegrator(props))
