"""The ``splats`` integrator: 3D Gaussian splatting as a Mitsuba plugin.

Executed once per Mitsuba variant (see ``drgs.plugins``). The rasterizer itself is
``drgs.splatting.rendering``; this file is where it meets sensors, films, parameters and gradients.
Read ``minimal.py`` first: the same without options, on one page.
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
from drgs.core.variants import check_variant
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
    agreed,
    aovs_of,
    approximations_of,
    background_of,
    boolean,
    check_degree,
    check_object,
    check_shapes,
    degree_of,
    ids_of,
    ignored_effects,
    integer,
    light_of,
    load_gaussians,
    nested_integrators,
    one_of,
    only_one,
    positive,
    probes_of,
    refuse_unknown,
    said_by_file,
    to_world_of,
    turns_of_shapes,
)
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.integrator.shapes import check_instances, ellipsoids_in, surfaces_in
from drgs.integrator.view import accumulate, feature_of
from drgs.splatting import rendering

if TYPE_CHECKING:  # imported where a scene has other Gaussians than the integrator's, unmoved
    from drgs.integrator.gathering import Gathered, Part

PLACE = "splats: to_world"
"""Begins messages about a transform."""


@dataclass(frozen=True)
class BackwardResult:
    """Results of a backward pass that ``mi.render`` cannot return; N Gaussians.

    Dr.Jit traverses it with the integrator and resolves annotations, whatever variant is active.
    """

    means2d_grad: Any  # TensorXf (N, 2): derivative of the loss, per px on the film
    visible: Any  # Bool (N,): the Gaussian's extent touches the film
    first_fault: Any  # UInt32 (1,): of the gradients, for rendering.decode_fault
    frames: list[rendering.Frame]  # of the last view; none once a parameter has changed

    def weighted_sums(self, plane: Any) -> Any:
        """Return the sum over pixels of each Gaussian's weight times ``plane``: Float (N,).

        plane: Float (H * W,). The weight is alpha times transmittance, as composited; its mean over
        samples, and over the times at which the shutter was open. To be called before a parameter
        changes.
        """
        sums = [rendering.weighted_sums(frame, plane) for frame in self.frames]
        return sum(sums[1:], sums[0]) / sum(frame.bins.grid.samples for frame in self.frames)


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
    if there is one, and how much each was seen of. The attribute ``sh_degree`` may be changed from
    one rendering to the next.

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
        gaussians = load_gaussians(props)
        for name in PARAMETER_NAMES:
            setattr(self, name, getattr(gaussians, name))
        self.smoothing, self.features = gaussians.smoothing, gaussians.features or {}
        self._has_own, self._turns = gaussians.num_gaussians > 0, turns_of_shapes(props)
        self.to_world, self._is_moved = to_world_of(props), "to_world" in props
        self._check_place()
        self._gathered: Gathered | None = None  # with the Gaussians of the scene's shapes
        self._scene_has_shapes = False  # that are Gaussians: the scene that was rendered last
        self._instances: list[mi.Shape] = []  # of that scene, checked
        self.ignore = ignored_effects(props)
        self._read_nested(props)
        self.aovs = aovs_of(props, [*AOVS, *self._feature_widths])
        degrees = [one.sh_degree for one in self.objects.values()]
        self.sh_degree = props.get("sh_degree", max(gaussians.sh_degree, *degrees, 0))
        self._sh_degree_is_given = "sh_degree" in props
        self.background = background_of(props)
        self.hide_emitters = boolean(props, "hide_emitters", False)
        said = said_by_file(props, gaussians)
        self.file = str(props.get("filename", ""))
        files = {self.file: said, **{v.file: v.header for v in self.objects.values()}}
        self.header = agreed(props, {file: said for file, said in files.items() if file})
        self.approximations = approximations_of(props, self.header)
        self.said_by_file = tuple(self.header)
        self.near = positive(props, "near", NEAR)
        self.srgb_primitives = boolean(props, "srgb_primitives", True)
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

        self.last: BackwardResult | None = None
        self._projection: rendering.ProjectionStage = rendering.Projected()
        self.memory = Memory()
        self._lock = threading.RLock()  # of the memory, and of what a picture leaves in the film
        self._last_sensor: mi.Sensor | None = None  # that was rendered
        self._logged_summary = ""

    def _read_nested(self, props: mi.Properties) -> None:
        """Tell splat objects from the integrator of surfaces."""
        nested = nested_integrators(props)
        self.objects = {k: v for k, v in nested.items() if isinstance(v, SplatsIntegrator)}
        self.nested = only_one([v for k, v in nested.items() if k not in self.objects])
        self._is_object = False  # nested in another
        for name, one in self.objects.items():
            one.become_object(name)

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
        if self._has_own:
            callback.put("to_world", self.to_world, mi.ParamFlags.Differentiable)
        for name, one in self.objects.items():
            callback.put(name, one, mi.ParamFlags.Differentiable)
        if self._is_object:
            return
        callback.put("background", self.background, mi.ParamFlags.Differentiable)
        if self.nested is not None:
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        """Check that the parameters still fit together, and forget a frame of former ones.

        The frame's key does not tell that an array was written in place through a view, which
        is what ``SceneParameters.set_dirty`` announces.
        """
        if keys != ["background"]:
            self.forget_frames()
            self._gathered = None
        if not self._has_own:
            return
        if dr.width(self.shN) == 0:  # not exposed, so that its rows could not be set
            self.shN = dr.zeros(mi.TensorXf, (next(iter(self.means.shape), 0), 0, 3))
        if not keys or "to_world" in keys:
            self._is_moved = True
            self._check_place()
        check_shapes(replace(self._own, features=self.features))
        self._check_columns()
        others = self._scene_has_shapes or self._is_object or self.objects
        if not (self._sh_degree_is_given or others):
            check_degree(self.sh_degree, self._own)

    def forget_frames(self) -> None:
        """Render the next image anew, also if no parameter has changed."""
        self.memory.rendered.clear()
        if self.last is not None:
            self.last = replace(self.last, frames=[])

    def become_object(self, name: str) -> None:
        """Leave rendering to the integrator that this one is nested in.

        Raises PluginError for settings of rendering.
        """
        check_object(name, self._given)
        self._is_object = True

    @property
    def _all_objects(self) -> dict[str, SplatsIntegrator]:
        """Objects that have Gaussians, by the prefix of their parameters' names."""
        own = {"": self} if self._has_own else {}
        return own | {f"{name}.": one for name, one in self.objects.items()}

    @property
    def _feature_widths(self) -> dict[str, int]:
        """Columns of features, by name."""
        found: dict[str, int] = {}
        for prefix, one in self._all_objects.items():
            for name, value in one.features.items():
                if found.setdefault(name, value.shape[1]) != value.shape[1]:
                    raise PluginError(
                        f"splats: {prefix}{name} must have the {found[name]} columns of the other "
                        f"objects' {name}, got {value.shape[1]}"
                    )
        return found

    @property
    def has_smoothing(self) -> bool:
        """True where Gaussians have a smoothing filter, be it ignored."""
        return any(one.smoothing is not None for one in self._all_objects.values())

    def _check_place(self) -> None:
        """Refuse a ``to_world`` that is no similarity; one that moves nothing costs nothing."""
        if self._is_moved:
            from drgs.integrator.placement import similarity_of

            self._is_moved = not similarity_of(self.to_world.matrix, PLACE).is_identity

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

        Where they are moved, in world space. Once a scene with ellipsoids was rendered, theirs as
        well; both are detached.
        """
        if self.memory.shadows is not None:
            return self.memory.shadows.gaussians
        if self._gathered is None and (self._is_moved or self.objects):
            self._gathered = _gather_parts(self._placements(), None)
        return self._own if self._gathered is None else self._gathered.gaussians

    def _gather(self, scene: mi.Scene) -> None:
        """Find the scene's ellipsoids, and convert them if they have changed.

        Rows that do not fit, of an update that was refused, would be read beyond their end.
        """
        for one in self._all_objects.values():
            check_shapes(self._gaussians_of(one))
        self._instances = check_instances(scene, self._instances)
        shapes = ellipsoids_in(scene)
        self._scene_has_shapes = bool(shapes)
        with dr.resume_grad():
            is_alone = not shapes and not set(self._turns) - {""} and not self._is_placed
            parts = [] if is_alone else self._parts(shapes)
        self._gathered = None if is_alone else _gather_parts(parts, self._gathered)
        if self.gaussians.num_gaussians == 0:
            raise PluginError(
                "splats: there are no Gaussians: give the integrator 'filename' or tensors "
                f"{', '.join(PARAMETER_NAMES)}, or the scene a shape of type ellipsoids or "
                "ellipsoidsmesh"
            )
        check_degree(self.sh_degree, self.gaussians)
        self._shade(scene)

    @property
    def _is_placed(self) -> bool:
        """True where Gaussians are moved, or are to be differentiated along a move."""
        return bool(self.objects) or self._is_moved or dr.grad_enabled(self.to_world)

    def _parts(self, shapes: Sequence[mi.Shape]) -> list[Part]:
        """Gaussians of objects and shapes, attached, in the order in which they are rendered."""
        parts = self._placements()
        if shapes or self._turns:
            from drgs.integrator.ellipsoids import conversions_of

            parts += conversions_of(shapes, self._turns)
        return parts

    def _placements(self) -> list[Part]:
        """Gaussians of objects, attached."""
        from drgs.integrator.placement import PlacedGaussians, Placement

        return [
            Placement(
                PlacedGaussians(self._gaussians_of(one), one.to_world.matrix),
                f"splats: {prefix}to_world",
            )
            for prefix, one in self._all_objects.items()
        ]

    def _shade(self, scene: mi.Scene) -> None:
        """Darken what lies in the shadow of surfaces."""
        last, self.memory.shadows = self.memory.shadows, None
        if self.shadows:
            from drgs.integrator.shadows import Shadows

            self.memory.shadows = Shadows.of(self, self.gaussians, scene, last)

    @property
    def _own(self) -> Gaussians:
        return self._gaussians_of(self)

    def _gaussians_of(self, one: SplatsIntegrator) -> Gaussians:
        """Gaussians of this integrator or of an object in it, in the object's own space."""
        parameters = {name: getattr(one, name) for name in PARAMETER_NAMES}
        smoothing = None if "smoothing" in self.ignore else one.smoothing
        # What is not put out is not loaded.
        features = {k: v for k, v in one.features.items() if k in self.aovs.values()}
        return Gaussians(**parameters, smoothing=smoothing, features=features or None)

    @property
    def pipeline(self) -> rendering.Pipeline:
        """What this integrator's settings call for."""
        others = [feature_of(kind) for kind in self.aovs.values() if kind != "alpha"]
        features = (rendering.color_features, *others)
        pipeline = pipeline_of(self.approximations, self.sh_degree, features=features)
        if self._gathered is not None and self._gathered.gaussians.smoothing is not None:
            pipeline = replace(pipeline, of_smoothing=True)  # which grows with an object
        return replace(pipeline, source=self._projection)

    def use_projection(self, stage: rendering.ProjectionStage) -> None:
        """Project the Gaussians by another stage, such as one that several processes share."""
        self._projection = stage

    def aov_names(self) -> list[str]:
        """Of the channels besides colour and alpha."""
        return [f"{name}.{c}" for name, kind in self.aovs.items() for c in self.channels_of(kind)]

    def channels_of(self, kind: str) -> Sequence[int | str]:
        """What comes behind the dot in the names of an AOV's channels."""
        return AOVS[kind] if kind in AOVS else range(self._feature_widths[kind])

    def to_string(self) -> str:
        """One line a setting; of those that are off or as usual, none."""
        if self._gathered is None:
            count = sum(one.means.shape[0] for one in self._all_objects.values())
        else:
            count = self._gathered.gaussians.num_gaussians
        settings = {
            "gaussians": count or "those of the scene's shapes",
            "sh_degree": self.sh_degree,
            "background": self.background,
            "near": self.near,
            "srgb_primitives": self.srgb_primitives,
            **self.approximations.others_than_default,
        }
        if self.objects:
            settings["objects"] = ", ".join(self.objects)
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
        :class:`BackwardResult` in ``self.last``.
        """
        _refuse_recording()
        sensor = _resolve_sensor(scene, sensor)
        self._check_derivatives(scene, sensor, dr.ADMode.Backward)
        with self._lock, dr.suspend_grad():
            self._gather(scene)
            gradients = Picture.of(self, scene, sensor, seed, spp).backward(params, grad_in)
            self.last = BackwardResult(
                means2d_grad=_rows(gradients.means2d),
                visible=gradients.visible,
                first_fault=gradients.first_fault,
                frames=[f for of_time in self.memory.rendered[0].frames for f in of_time],
            )
            if gradients.parameters is not None:
                with dr.resume_grad():
                    self.accumulate(scene, gradients.parameters)
            sensor.film().clear()  # it may hold an attached block

    def accumulate(self, scene: mi.Scene, own: Gaussians) -> None:
        """Add derivatives with respect to the Gaussians to those of the attached parameters."""
        if self._gathered is not None:
            self._gathered.accumulate(self._parts(ellipsoids_in(scene)), own)
            return
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
        sensor = _resolve_sensor(scene, sensor)
        self._check_derivatives(scene, sensor, dr.ADMode.Forward)
        with self._lock, dr.suspend_grad():
            self._gather(scene)
            with dr.resume_grad():
                tangents = self._tangents(scene)
            d_image = Picture.of(self, scene, sensor, seed, spp).tangent(params, tangents)
            sensor.film().clear()  # it holds an attached block
        return d_image

    def _tangents(self, scene: mi.Scene) -> Gaussians:
        """Derivatives of the Gaussians along those set on what they are made of."""
        if self._gathered is not None:
            return self._gathered.tangents(self._parts(ellipsoids_in(scene)))
        features = self._own.features
        return Gaussians(
            **{name: _tangent(getattr(self, name)) for name in PARAMETER_NAMES},
            features=features and {k: _tangent(v) for k, v in features.items()},
        )

    def _check_derivatives(self, scene: mi.Scene, sensor: mi.Sensor, mode: dr.ADMode) -> None:
        """Refuse those that would be wrong."""
        if not surfaces_in(scene):
            return
        from drgs.integrator.derivatives import check_derivatives

        attached = False
        if self.light != "none" or self.shadows:
            values = [part.values.parameters() for part in self._parts(ellipsoids_in(scene))]
            attached = any(dr.grad_enabled(value) for of in values for value in of.values())
        check_derivatives(self, scene, sensor, mode, attached)

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
        surfaces = surfaces_in(scene)
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


def _gather_parts(parts: Sequence[Part], last: Gathered | None) -> Gathered:
    from drgs.integrator.gathering import gather

    return gather(parts, last)


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
