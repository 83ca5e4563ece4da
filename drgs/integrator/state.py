"""The state of the integrator ``splats``: its parameters, and a cache between renderings.

Dr.Jit traverses it in ``mi.render``, and evaluates the annotations of fields in the active variant:
types that are imported on demand are ``Any`` then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Generic, TypeGuard, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations, Value, parse_error
from drgs.core.arrays import tangent_of
from drgs.core.constants import MAX_FEATURES
from drgs.core.errors import PluginError, UnsupportedError
from drgs.core.private import same_variables
from drgs.core.types import Bool, Float, TensorXf, UInt32
from drgs.effects.compose import NamedFeature, normal_features
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.splatting import rendering
from drgs.splatting.rasterize import SplatGradients
from drgs.splatting.tiles import SplatTable

if TYPE_CHECKING:
    from drgs.integrator.parts import CombinedParts, Part, Placement, ShRotation
else:
    CombinedParts = ShRotation = Any

T = TypeVar("T")

AOVS = {"depth": ("T",), "alpha": ("I",), "normal": ("X", "Y", "Z")}
"""AOVs and the suffixes of their channels, as in Mitsuba's ``aov``."""


@dataclass(frozen=True)
class BackwardResult:
    """Results of a backward pass besides the derivatives of parameters; N Gaussians."""

    means2d_grad: TensorXf  # (N, 2): derivative of the loss, per px on the film
    visible: Bool  # (N,): the Gaussian's extent touches the film
    first_nonfinite: UInt32  # (1,): of all derivatives, for rendering.decode_nonfinite
    frames: list[rendering.Frame]  # of the last view; none once a parameter has changed

    def weighted_sums(self, plane: Float) -> Float:
        """Return the sum over pixels of each Gaussian's weight times ``plane``: Float (N,).

        plane: Float (H * W,). The weight is alpha times transmittance, averaged over samples and
        times. Call it before a parameter changes.
        """
        sums = [rendering.weighted_sums(frame, plane)[0] for frame in self.frames]
        return sum(sums[1:], sums[0]) / sum(frame.tiles.bins.grid.samples for frame in self.frames)


@dataclass(eq=False)
class ProjectedView:
    """The splats of one view, projected beforehand; lists are by time of the shutter.

    They come with what a backward pass returns for them: the parameters get no derivatives.
    """

    splats: Sequence[SplatTable]
    gradients: Sequence[SplatGradients] = ()
    frames: Sequence[rendering.Frame] = ()


@dataclass(frozen=True, eq=False)
class Cached(Generic[T]):
    """A value and its dependencies, held so that indices of variables are not reused."""

    value: T
    settings: tuple[object, ...]  # compared by ==
    arrays: object  # a PyTree, detached: compared by variables


@dataclass
class RenderCache:
    """Intermediate results of the last renderings."""

    kept: dict[str, Cached[Any]] = field(default_factory=dict)  # by name
    film_maps: dict[str, np.ndarray] = field(default_factory=dict)  # see drgs.integrator.film
    parts: CombinedParts | None = None  # None: the own Gaussians alone, unmoved
    has_ellipsoids: bool = False  # whether the last scene has shapes that are Gaussians
    sensor: mi.Sensor | None = None  # rendered last
    surfaces: Any = None  # drgs.integrator.light.surfaces.Surfaces of the last scene that has some
    too_close: frozenset[str] = frozenset()  # ids of objects with a logged warning
    shaded: Gaussians | None = None  # in the shadow of surfaces; None: no shadows

    def find(
        self, name: str, settings: tuple[object, ...], arrays: object, make: Callable[[], T]
    ) -> Cached[T]:
        """Return the entry of this name, made anew unless settings and arrays are the same."""
        last = self.kept.get(name)
        if last is None or last.settings != settings or not same_variables(last.arrays, arrays):
            last = self.kept[name] = Cached(make(), settings, arrays)
        return last

    def forget(self, prefix: str) -> None:
        """Drop the entries whose names begin with ``prefix``."""
        self.kept = {k: v for k, v in self.kept.items() if not k.startswith(prefix)}


@dataclass
class SplatObject:
    """Gaussians with one ``to_world``: the integrator's own, or a nested one's."""

    gaussians: Gaussians  # in the space of the object; Mitsuba assigns to its arrays in place
    to_world: mi.AffineTransform4f
    is_moved: bool  # whether to_world is not the identity
    file: str = ""
    header: dict[str, Value] = field(default_factory=dict)  # approximations of the file's header

    @property
    def has_gaussians(self) -> bool:
        """False for an integrator that renders only objects and shapes."""
        return self.gaussians.num_gaussians > 0

    def check_to_world(self) -> None:
        """Update ``is_moved``; PluginError for a ``to_world`` that is no similarity."""
        from drgs.integrator.parts import similarity_of

        self.is_moved = not similarity_of(self.to_world.matrix, "splats: to_world").is_identity


@dataclass(frozen=True)
class LightSettings:
    """Light between splats and surfaces, as ``docs/plugins/splats.md`` describes it."""

    light: str
    light_samples: int
    probes: Sequence[str]
    probe_fallback: str
    shadows: Sequence[str]
    radiance_scale: float


@dataclass
class SplatsState:
    """Gaussians, settings as ``docs/plugins/splats.md`` describes them, and a cache."""

    own: SplatObject
    nested_objects: dict[str, SplatObject]  # by name
    sh_rotations: dict[str, ShRotation]  # of harmonics, by shapes' ids; "": of all other shapes
    background: mi.Color3f | mi.Texture  # in display space; or linear
    nested: mi.SamplingIntegrator | None  # of surfaces
    default_degree: int  # of spherical harmonics, where the scene has no other Gaussians
    given_degree: int | None  # None: the highest that the Gaussians have
    given_approximations: Approximations
    header: dict[str, Value]  # the approximations that files' headers set
    near: float  # scene units
    aovs: dict[str, str]  # types by name
    ignore: Sequence[str]
    hide_emitters: bool
    srgb_primitives: bool
    nested_spp: int  # 0: as many as of the splats
    lighting: LightSettings
    given_error: float | None  # budget of the approximations' error; None: as they are given
    budget_report: Any = None  # drgs.accuracy.error_budget.BudgetReport, once it was met
    budget_evidence: Any = None  # drgs.integrator.error_budget.Evidence: what it was measured on
    cache: RenderCache = field(default_factory=RenderCache)
    projected_view: ProjectedView | None = None  # rendered instead of the Gaussians

    @property
    def objects(self) -> dict[str, SplatObject]:
        """Objects that have Gaussians, by the prefix of their parameters' names."""
        own = {"": self.own} if self.own.has_gaussians else {}
        return own | {f"{name}.": one for name, one in self.nested_objects.items()}

    @property
    def sh_degree(self) -> int:
        """Highest spherical harmonics degree that is evaluated."""
        if self.given_degree is not None:
            return self.given_degree
        if self.cache.parts is not None:
            return self.cache.parts.gaussians.sh_degree
        return self.default_degree

    @sh_degree.setter
    def sh_degree(self, degree: int) -> None:
        if isinstance(degree, (bool, float)) or degree not in range(4):
            raise PluginError(f"splats: sh_degree must be an integer from 0 to 3, got {degree!r}")
        self.given_degree = int(degree)

    @property
    def smoothing(self) -> Float | None:
        """Smoothing filter of the own Gaussians (N,), scene units; None: off."""
        return self.own.gaussians.smoothing

    @smoothing.setter
    def smoothing(self, filter_: Float | None) -> None:
        self.own.gaussians = replace(self.own.gaussians, smoothing=filter_)

    @property
    def error(self) -> float | None:
        """Error budget, 0..1; None: none."""
        return self.given_error

    @error.setter
    def error(self, budget: float | str | None) -> None:
        self.given_error, self.budget_report = parse_budget(budget), None

    @property
    def pipeline(self) -> rendering.Pipeline:
        """Stages that the settings select."""
        parts = self.cache.parts
        # A smoothing filter is differentiated where it scales with an object.
        of_smoothing = parts is not None and parts.gaussians.smoothing is not None
        kinds = tuple(self.aovs.values())
        settings = self.approximations, self.sh_degree, of_smoothing, kinds

        def make() -> rendering.Pipeline:
            own = {"depth": rendering.depth_feature, "normal": normal_features}
            others = [own.get(kind) or NamedFeature(kind) for kind in kinds if kind != "alpha"]
            pipeline = pipeline_of(*settings[:2], (rendering.color_features, *others))
            return replace(pipeline, of_smoothing=of_smoothing)

        return self.cache.find("pipeline", settings, (), make).value

    @property
    def approximations(self) -> Approximations:
        """The approximations that are rendered with: given ones, or those within the error."""
        report = self.budget_report
        return self.given_approximations if report is None else report.chosen.approximations

    @property
    def shutter_samples(self) -> int | None:
        """Times of open shutters within the error; None: each sensor's own."""
        report = self.budget_report
        return None if report is None else report.chosen.shutter_samples

    def aov_names(self) -> list[str]:
        """Return the names of the channels besides colour and alpha."""
        return [f"{name}.{c}" for name, kind in self.aovs.items() for c in self.channels_of(kind)]

    def settings(self) -> dict[str, object]:
        """Return settings by name, without those that are off or at their default."""
        parts = self.cache.parts
        own = [one.gaussians for one in self.objects.values()]
        rendered = own if parts is None else [parts.gaussians]
        lighting = self.lighting
        lit = {"light": lighting.light, "radiance_scale": lighting.radiance_scale}
        others = {
            "objects": ", ".join(self.nested_objects),
            "hide_emitters": self.hide_emitters,
            "aovs": ", ".join(f"{name}:{kind}" for name, kind in self.aovs.items()),
            "nested": self.nested and self.nested.class_name(),
            "nested_spp": self.nested_spp,
            **(lit if lighting.light != "none" else {}),
            "ignore": ", ".join(self.ignore),
        }
        return {
            "gaussians": sum(one.num_gaussians for one in rendered)
            or "those of the scene's shapes",
            "sh_degree": self.sh_degree,
            "background": self.background,
            "near": self.near,
            "srgb_primitives": self.srgb_primitives,
            **self.approximations.non_default,
            **{name: value for name, value in others.items() if value},
        }

    def channels_of(self, kind: str) -> Sequence[int | str]:
        """Return the suffixes of an AOV's channels."""
        return AOVS[kind] if kind in AOVS else range(feature_widths(self.objects)[kind])

    def check_columns(self) -> None:
        """Raise PluginError for AOVs with more channels than a kernel can have."""
        columns = {n: len(self.channels_of(k)) for n, k in self.aovs.items() if k != "alpha"}
        if sum(columns.values()) > MAX_FEATURES:
            counts = ", ".join(f"{name} {count:,}" for name, count in columns.items())
            raise PluginError(
                f"splats: aovs can have at most {MAX_FEATURES} channels together, got "
                f"{sum(columns.values()):,} ({counts}); render them in parts, which share a kernel"
            )

    def parameters_changed(self, keys: Sequence[str], is_object: bool) -> None:
        """Check that own parameters fit together; keys: none for all."""
        if list(keys) != ["background"]:
            self.cache.forget("frames")
            self.cache.parts = None
        if not self.own.has_gaussians:
            return
        own = self.own
        if dr.width(own.gaussians.shN) == 0:  # not exposed, so that its rows could not be set
            num = next(iter(own.gaussians.means.shape), 0)
            own.gaussians = replace(own.gaussians, shN=dr.zeros(mi.TensorXf, (num, 0, 3)))
        if not keys or "to_world" in keys:
            own.check_to_world()
        check_shapes(self.rendered_part_of(own, with_all_features=True))
        self.check_columns()
        others = self.cache.has_ellipsoids or is_object or self.nested_objects
        if self.given_degree is None and not others:
            check_degree(self.sh_degree, own.gaussians)

    def rendered_part_of(self, one: SplatObject, with_all_features: bool = False) -> Gaussians:
        """Return an object's Gaussians in its space, without unrendered filter and features."""
        gaussians, features = one.gaussians, one.gaussians.features or {}
        if "smoothing" in self.ignore:
            gaussians = replace(gaussians, smoothing=None)
        if not with_all_features:  # load only those that an AOV uses
            features = {k: v for k, v in features.items() if k in self.aovs.values()}
        return replace(gaussians, features=features or None)

    @property
    def gaussians(self) -> Gaussians:
        """Rendered Gaussians, world space; attached where they are the parameters."""
        if self.cache.shaded is not None:
            return self.cache.shaded
        if self.cache.parts is None and (self.own.is_moved or self.nested_objects):
            from drgs.integrator.parts import combine

            self.cache.parts = combine(self._placements(), None)
        parts = self.cache.parts
        return self.rendered_part_of(self.own) if parts is None else parts.gaussians

    def update_gaussians(self, scene: mi.Scene) -> None:
        """Find the scene's Gaussians, and convert them if they have changed."""
        cache, self.cache.shaded = self.cache, None
        for one in self.objects.values():  # an update that was refused may have left rows
            check_shapes(self.rendered_part_of(one))
        check_instances(scene)
        shapes = ellipsoids_in(scene)
        cache.has_ellipsoids = bool(shapes)
        with dr.resume_grad():
            is_moved = self.own.is_moved or dr.grad_enabled(self.own.to_world)
            others = shapes or set(self.sh_rotations) - {""} or self.nested_objects
            is_alone = not (others or is_moved)
            parts = [] if is_alone else self.attached_parts(scene)
        if is_alone:
            cache.parts = None
        else:
            from drgs.integrator.parts import combine

            cache.parts = combine(parts, cache.parts)
        gaussians = self.gaussians
        if gaussians.num_gaussians == 0:
            raise PluginError(
                "splats: there are no Gaussians: give the integrator 'filename' or tensors "
                f"{', '.join(PARAMETER_NAMES)}, or the scene a shape of type ellipsoids or "
                "ellipsoidsmesh"
            )
        check_degree(self.sh_degree, gaussians)

    def attached_parts(self, scene: mi.Scene) -> list[Part]:
        """Return the Gaussians of objects and shapes, attached, in the order of rendering."""
        parts: list[Part] = [*self._placements()]
        shapes = ellipsoids_in(scene)
        if shapes or self.sh_rotations:
            from drgs.integrator.parts import conversions_of

            parts += conversions_of(shapes, self.sh_rotations)
        return parts

    def _placements(self) -> list[Placement]:
        from drgs.integrator.parts import TO_WORLD, Placement

        named = {f"splats: {k}to_world": one for k, one in self.objects.items()}
        return [
            Placement({**self.rendered_part_of(one).arrays, TO_WORLD: one.to_world.matrix}, name)
            for name, one in named.items()
        ]

    def accumulate(self, scene: mi.Scene, gradients: Gaussians) -> None:
        """Add derivatives with respect to :attr:`gaussians` to those of the parameters."""
        if self.cache.parts is not None:
            self.cache.parts.accumulate(self.attached_parts(scene), gradients)
            return
        parameters = self.own.gaussians.arrays
        for name, gradient in gradients.arrays.items():
            parameter = parameters[name]
            if dr.width(parameter) > 0 and dr.grad_enabled(parameter):
                dr.accum_grad(parameter, gradient)

    def tangents(self, scene: mi.Scene) -> Gaussians:
        """Return derivatives of :attr:`gaussians` along those set on the parameters."""
        if self.cache.parts is not None:
            return self.cache.parts.tangents(self.attached_parts(scene))
        own = self.rendered_part_of(self.own)
        return Gaussians.from_arrays({name: tangent_of(v) for name, v in own.arrays.items()})


def parse_budget(value: object) -> float | None:
    """Return an error budget given as a number, or as text with a unit; None: none."""
    if value is None:
        return None
    try:
        return parse_error(value)
    except ValueError as error:
        raise PluginError(f"splats: error {error}") from None


def check_shapes(gaussians: Gaussians) -> None:
    """Raise PluginError unless all parameters have rows for the same Gaussians."""
    num = next(iter(gaussians.means.shape), 1)
    if num == 0:
        raise PluginError("splats: at least one Gaussian is needed, got none")
    harmonics = {"sh0": [(1, 3)], "shN": [((degree + 1) ** 2 - 1, 3) for degree in range(4)]}
    rows = {"means": [(3,)], "quats": [(4,)], "log_scales": [(3,)], "logit_opacities": [()]}
    rows |= harmonics | ({} if gaussians.smoothing is None else {"smoothing": [()]})
    for name, allowed in rows.items():
        got = tuple(getattr(gaussians, name).shape)
        if got not in [(num, *row) for row in allowed]:
            expected = " or ".join(f"({', '.join(map(str, ('N', *row)))})" for row in allowed)
            raise PluginError(
                f"splats: {name} must have the shape {expected}, with N = {num} the rows of "
                f"means, got {got}"
            )
    for name, tensor in (gaussians.features or {}).items():
        if len(tensor.shape) != 2 or tensor.shape[0] != num or tensor.shape[1] == 0:
            raise PluginError(
                f"splats: {name} must have the shape (N, C), with N = {num} the rows of means and "
                f"C at least 1, got {tuple(tensor.shape)}"
            )


def check_degree(degree: int, gaussians: Gaussians) -> None:
    """Raise PluginError for a spherical harmonics degree that the Gaussians do not have."""
    if degree > gaussians.sh_degree:
        raise PluginError(
            f"splats: sh_degree must be an integer from 0 to {gaussians.sh_degree}, the degree of "
            f"the Gaussians, got {degree}"
        )


def ellipsoids_in(scene: mi.Scene) -> list[mi.Shape]:
    """Return the shapes of Gaussians, which are rendered as splats."""
    return [shape for shape in scene.shapes() if shape.is_ellipsoids()]


def surfaces_in(scene: mi.Scene) -> list[mi.Shape]:
    """Return the shapes that are no Gaussians."""
    return [shape for shape in scene.shapes() if not shape.is_ellipsoids()]


def check_instances(scene: mi.Scene) -> None:
    """Raise UnsupportedError for instances of Gaussians."""
    shapes = scene.shapes()
    if all(shape.class_name() != "Instance" for shape in shapes):
        return
    for node, (group, _) in mi.traverse(scene).hierarchy.items():
        if isinstance(node, mi.Shape) and node.is_ellipsoids() and node not in shapes:
            raise UnsupportedError(
                f"splats: shape group '{group.id()}' holds Gaussians (shape '{node.id()}'), whose "
                "instances are not supported: use a shape of type ellipsoids for each, with a "
                "to_world, or a nested splats"
            )


def feature_widths(objects: dict[str, SplatObject]) -> dict[str, int]:
    """Return the columns of features by name; PluginError where objects differ."""
    widths: dict[str, int] = {}
    for prefix, one in objects.items():
        for name, value in (one.gaussians.features or {}).items():
            if widths.setdefault(name, value.shape[1]) != value.shape[1]:
                raise PluginError(
                    f"splats: {prefix}{name} must have the {widths[name]} columns of the other "
                    f"objects' {name}, got {value.shape[1]}"
                )
    return widths


if TYPE_CHECKING:

    class SplatsPlugin(mi.Integrator):
        """Members of the plugin ``splats``, whose class exists once for each variant."""

        state: SplatsState
        gaussians: Gaussians
        sh_degree: int
        smoothing: Float | None
        near: float
        ignore: Sequence[str]
        pipeline: rendering.Pipeline
        last: BackwardResult  # after a backward pass
        projected_view: ProjectedView | None

        def summary(self, scene: mi.Scene, *sensors: mi.Sensor) -> str:
            """Return a summary of the simulated effects."""
            ...

else:
    SplatsPlugin = Any


def is_splats(node: object) -> TypeGuard[SplatsPlugin]:
    """Return whether a Mitsuba object is the integrator ``splats``."""
    return isinstance(getattr(node, "state", None), SplatsState)
