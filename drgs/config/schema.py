"""The typed configuration of a fit, :class:`FitConfig`; frozen.

The defaults were chosen by measurement (``scenes/studies/recipes.py``). ``scenes/lego_paper.yml``
has those of the paper (Kerbl et al. 2023, section 7, and its released code).
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    BaseModel,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
    WithJsonSchema,
    create_model,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo

from drgs.config.approximations import DECLARED, Approximations, Declared, Value
from drgs.config.density import REFERENCE_START, DensifyConfig
from drgs.config.extensions import EFFECTS, LOSS_TERMS, LOSSES, READERS, STRATEGIES, section_of
from drgs.config.section import (
    UNRESOLVED,
    Count,
    ExtensibleSection,
    Rate,
    Resolved,
    Section,
    Weight,
    name_of,
    subsection,
)
from drgs.core.constants import MAX_SHUTTER_SAMPLES, SHUTTER_SAMPLES

Color = str | tuple[float, float, float]

NAMED_COLORS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}

NEAR_LIMITS = (1e-9, 1e9)  # scene units, of near planes
REFERENCE_NEAR = 0.2  # scene units: the reference's near plane, of scenes that are about 4 wide

LATEST_DEGREE = 1000  # iterations between degrees of harmonics: the reference's, for 30,000
DEGREE_SHARE = 0.15  # the same, as a share of all iterations


def _color(value: object) -> Color | None:
    if value is None or (isinstance(value, str) and value in NAMED_COLORS):
        return value
    numbers = value if isinstance(value, (list, tuple)) else ()
    if len(numbers) == 3 and all(type(v) in (int, float) and 0 <= v <= 1 for v in numbers):
        r, g, b = map(float, numbers)
        return r, g, b
    raise ValueError("must be white, black or three numbers in 0..1")


ColorField = Annotated[
    Color | None,
    PlainValidator(_color),
    PlainSerializer(lambda color: list(color) if isinstance(color, tuple) else color),
    WithJsonSchema({"format": "color"}),
]
PathField = Annotated[Path, Field(strict=False)]

Decay = Annotated[float, Field(ge=0, le=0.999999)]  # float32 has few numbers between this and 1


class DataConfig(Section):
    """Photographs, cameras, and how to read them."""

    path: PathField
    """Dataset folder; relative to the configuration file."""
    source: str = ""
    """Source of the data, for the error message if the folder is missing."""
    type: Annotated[str, name_of(READERS, "auto")] = "auto"
    """Layout of the folder. auto: by transforms_train.json, transforms.json, or a COLMAP model in
    sparse/0, sparse, colmap/sparse/0, dense/0 or beside the photographs."""
    image_size: Count | None = Field(None, ge=1)
    """px. Wider images are scaled down to this width by area averaging; null: 1600 for photographs,
    as in the reference; NeRF-synthetic images keep their size."""
    downscale: Literal[1, 2, 4, 8] | None = None
    """COLMAP's layout: read images, images_2, images_4 or images_8; null: the smallest of at least
    image_size."""
    test_split: Literal["train", "val", "test"] | None = None
    """Split to evaluate on, of the NeRF-synthetic layout and of splits that the data lists; null:
    test if it exists, else val."""
    test_every: Count = Field(8, ge=2)
    """nerfstudio, colmap: images 0, n, 2n, ... by file name are the test split, unless the data
    lists splits."""
    leave_out: list[str] = Field(default_factory=list)
    """Photographs that are not used, by file name, with or without suffix and folders: 0012,
    0012.jpg, images/0012.jpg."""
    background: ColorField = None
    """white, black or [r, g, b] in display space: background of transparent images, and of the
    splats in training, evaluation and rendering. null: white if any image is transparent, else
    black."""
    random_background: bool = False
    """Use a random background in each iteration."""
    ignore_distortion: bool = False
    """Ignore lens distortion."""
    ignore_motion: bool = False
    """Ignore motion of the camera during exposure."""
    shutter_samples: int = Field(SHUTTER_SAMPLES, ge=1, le=MAX_SHUTTER_SAMPLES)
    """Number of images averaged for a moving camera with a global shutter; memory and time are
    proportional."""
    ignore_masks: bool = False
    """Do not read masks."""
    ignore_depth: bool = False
    """Do not read depth, as with a loss.depth_weight of 0."""
    ignore_points: bool = False
    """Do not use the dataset's own point cloud."""
    in_memory: bool | None = None
    """Keep photographs in memory. false: on disk, from where another thread reads them ahead; the
    fit has the same bytes. null: false if they take more than half of the available memory."""

    @property
    def background_rgb(self) -> tuple[float, float, float]:
        """The background's display-space colour, three numbers in 0..1; white if it is null."""
        background = self.background or "white"
        return NAMED_COLORS[background] if isinstance(background, str) else background


class InitConfig(Section):
    """The Gaussians at iteration 0."""

    removed: ClassVar = {"scale": 1.0}

    start: Literal["auto", "masks", "points", "sweep", "random"] = "auto"
    """Start of the Gaussians. masks: the surface of the visual hull of the images' alpha channels,
    coloured from the images. points: a point cloud. sweep: points on which neighbouring photographs
    agree. random: in the start box, or where the cameras look. auto: point_cloud or half_extent if
    given; else masks if nearly all training images are partly transparent; else the dataset's point
    cloud if it has one; else sweep where photographs agree; else random."""
    num_points: Resolved[Count] = Field(UNRESOLVED, ge=4, le=100_000_000)
    """Number of random points, or most points of a sweep or on the hull. null: 100,000 with the
    strategy adc, else two fifths of the final number."""
    half_extent: float | None = Field(None, gt=0, le=1e9)
    """Scene units: the start box is [-h, h]^3. null: the reference's 1.3 for cameras of
    NeRF-synthetic scenes, else a box derived from the cameras."""
    opacity: float = Field(0.1, ge=1e-6, le=0.999999)
    """Initial opacity."""
    sky: bool = True
    """Add Gaussians far behind a start at points, where photographs agree that there is sky."""
    point_cloud: PathField | None = None
    """PLY with x, y, z (and red, green, blue), or a points3D file of COLMAP. null: the dataset's
    own (ply_file_path, points3D), unless half_extent is given or masks are used."""
    gaussians: PathField | None = None
    """File of Gaussians, in any format that is read, to go on from, as they are, in place of
    points."""
    max_point_error: float | None = Field(None, ge=0, le=1e9)
    """px: drop COLMAP's points with a larger mean reprojection error, but keep points of unknown
    error (-1); null: keep all."""
    min_track_length: Count | None = Field(None, ge=0)
    """Drop COLMAP's points that fewer images observe; null: keep all."""


class _Model(Section):
    """Fields of :class:`ModelConfig` before the approximations."""

    scaled: ClassVar = ("sh_increase_every",)

    sh_degree: int = Field(3, ge=0, le=3)
    """Degree of the spherical harmonics."""
    sh_increase_every: Resolved[Count] = Field(LATEST_DEGREE, ge=1)
    """Iterations between increments of the degree in use, which starts at 0. Not given, or null:
    15 % of all iterations, at most 1000."""
    near: Resolved[float] = Field(UNRESOLVED, ge=NEAR_LIMITS[0], le=NEAR_LIMITS[1])
    """Near plane, scene units: closer means are culled. null: the reference's 0.2 for
    NeRF-synthetic scenes, else about a twenty-fifth of the cameras' distance to the point that they
    look at."""


FITTED_WITH = {"antialiased": True, "low_pass": 0.1}
"""Default approximations of fits, with the best images of test views. Files record them."""


def _as_field(name: str, declared: Declared) -> tuple[object, FieldInfo]:
    """Return the type and the field of an approximation; infinity is null, as YAML has none."""
    default, description = FITTED_WITH.get(name, declared.default), declared.description
    kind = Literal[declared.choices] if declared.choices else declared.kind
    if declared.decimal is not None:
        default = declared.decimal
    elif default == math.inf:
        kind, default = float | None, None
        description = f"{description} null: the radius at which alpha falls to alpha_cut."
    limits: dict[str, Any] = declared.limits.finite if declared.limits else {}
    return kind, Field(default, description=description, **limits)


_approximations: dict[str, Any] = {name: _as_field(name, each) for name, each in DECLARED.items()}
_ModelWithApproximations: Any = create_model(
    "_ModelWithApproximations", __base__=_Model, **_approximations
)


class ModelConfig(_ModelWithApproximations):
    """Model of a fit and how it is rendered; with the fields of :class:`Approximations`."""

    smoothing: bool = False
    """Widen Gaussians to the resolution of the training cameras, for renderings at other sizes (the
    3D filter of Mip-Splatting, Yu et al. 2024)."""

    @field_validator(*(name for name, d in DECLARED.items() if d.limits or d.registry))
    @classmethod
    def _check(cls, value: Value | None, field: ValidationInfo) -> Value | None:
        assert field.field_name is not None, "validators of fields have one"
        declared = DECLARED[field.field_name]
        if value is not None and not declared.allows(value):
            raise ValueError(f"must be {declared.expected_values}")
        return value

    @property
    def near_plane(self) -> float:
        """The near plane, scene units; the reference's if it is null."""
        return REFERENCE_NEAR if self.near is None else self.near

    def with_3dgs_defaults(self) -> ModelConfig:
        """Return the model for files that record none: 3DGS's where a value is not given."""
        usual = {name: DECLARED[name].default for name in FITTED_WITH}
        given = self.model_fields_set
        return self.model_copy(update={k: v for k, v in usual.items() if k not in given})

    @property
    def approximations(self) -> Approximations:
        """The configured approximations."""
        return Approximations.from_values(vars(self))


class OptimizerConfig(Section):
    """Adam with Nesterov's momentum (Dozat 2016): learning rates per step and its constants."""

    removed: ClassVar = {"epsilon": 1e-15, "means_lr_aims": []}

    means_lr: Rate = Field(3.2e-4, gt=0)
    """Initial rate of the means, in scene extents."""
    means_lr_final: Rate = Field(3.2e-6, gt=0)
    """Final rate of the means; the decay is exponential."""
    sh0_lr: Rate = Field(5e-3, ge=0)
    """Rate of the degree-0 colour coefficients."""
    shN_lr: Rate = Field(1e-3, ge=0)  # noqa: N815
    """Rate of the higher degrees."""
    opacities_lr: Rate = Field(0.05, ge=0)
    """Rate of the logit opacities (0.025 in newer references)."""
    scales_lr: Resolved[Rate] = Field(UNRESOLVED, ge=0)
    """Rate of the log scales. null: 0.02 for objects that are cut out, 0.01 for other
    photographs."""
    quats_lr: Rate = Field(2e-3, ge=0)
    """Rate of the quaternions."""
    decay: Resolved[float] = Field(UNRESOLVED, ge=1e-6, le=1)
    """Ratio of final to initial rates, except for the means. null: 0.03 with the strategy budget,
    0.1 with mcmc; 1 with adc, as in the paper."""
    decay_from: float = Field(0.75, ge=0, lt=1)
    """Start of their decay, as a fraction of the iterations after coarse stages."""
    views_per_step: int = Field(1, ge=1, le=1000)
    """Batch size B: number of views, one iteration each, whose mean gradient makes a step. Rates
    are multiplied by sqrt(B), and beta_1 and beta_2 raised to the power of B."""
    views: int = Field(1, ge=1, le=1000)
    """Batch size late in the fit, with unchanged rates; at most views_per_step, or a multiple of
    it."""
    views_from: float = Field(0.75, ge=0, lt=1)
    """Start of that, as decay_from, but not before the population is final."""
    beta_1: Decay = 0.9
    """Decay of the first moment."""
    beta_2: Decay = 0.999
    """Decay of the second moment."""


class LossConfig(Section):
    """(1 - w) L1 + w (1 - SSIM), in display space."""

    removed: ClassVar = {"window": 11, "sigma": 1.5}

    type: Annotated[str, name_of(LOSSES)] = "photometric"
    """photometric, or the name of an extension."""
    dssim_weight: float = Field(0.2, ge=0, le=1)
    """w; 0 disables D-SSIM."""
    depth_weight: Weight = 0.2
    """Weight of the mean absolute error of depth, in scene extents, if the data has depth."""


class OutputConfig(Section):
    """Output files of a fit."""

    dir: PathField | None = None
    """Output folder, relative to the configuration file; null: out/NAME in the current folder, with
    the NAME of the configuration file."""
    bake_smoothing: bool = False
    """Bake model.smoothing into the fit's own Gaussians as well."""
    save_renders: bool = True
    """Write renders/<split>/*.png."""
    report: bool = True
    """Write report.html, viewer.html, side_by_side/, curves.png and the orbit."""
    small_file: str | None = None
    """Format of a further file, sog: point_cloud.sog has Gaussians that were fitted 250 iterations
    further as its viewers render, with its rounding (by one process). null: none."""
    history_every: Count = Field(10, ge=1)
    """Iterations between rows of history.csv."""
    checkpoint_every: Count | None = Field(500, ge=1)
    """Iterations between checkpoints, for --resume; null: none."""


class CoarseStage(Section):
    """Iterations with smaller images."""

    until: Count = Field(ge=1)
    """Last iteration of the stage."""
    factor: int = Field(ge=2, le=64)
    """Width and height are divided by this."""


def _is_open(section: BaseModel, name: str) -> bool:
    return name not in section.model_fields_set or getattr(section, name) is None


def _require(holds: bool, expected: str, got: object) -> None:
    if not holds:
        raise ValueError(f"{expected}, got {got}")


def _format_section(section: BaseModel) -> str:
    return f"{{{', '.join(f'{name}: {value}' for name, value in section)}}}"


class FitConfig(ExtensibleSection):
    """The configuration of a fit; with sections of extensions, under their names."""

    registries: ClassVar = (EFFECTS, LOSSES, LOSS_TERMS, READERS)
    removed: ClassVar = {"extensions": {}}

    data: DataConfig
    init: InitConfig = subsection(InitConfig)
    model: ModelConfig = subsection(ModelConfig)
    optimizer: OptimizerConfig = subsection(OptimizerConfig)
    loss: LossConfig = subsection(LossConfig)
    densify: DensifyConfig = subsection(DensifyConfig)
    output: OutputConfig = subsection(OutputConfig)
    iterations: Count = Field(30_000, ge=1)
    """Number of rendered views; each is a step unless optimizer.views_per_step is set."""
    stop_after: Count | None = Field(None, ge=1)
    """Last iteration, where a clock or a viewer has ended a fit that was planned for another number
    of iterations. null: iterations."""
    coarse: Resolved[list[CoarseStage]] = UNRESOLVED
    """Stages of smaller training images, before those of full size: a list of {until: iteration,
    factor: 4}. null: half the size for the first 35 % of a fit to opaque photographs of at least
    100 px, else none; none with the strategy adc, as in the paper."""
    seed: Count = Field(0, ge=0)
    """Seed of all random numbers."""

    @property
    def last_iteration(self) -> int:
        """The last iteration that is run; rates and changes are planned for ``iterations``."""
        return self.iterations if self.stop_after is None else self.stop_after

    @property
    def data_for_training(self) -> DataConfig:
        """``data``, without depth if its loss has no weight."""
        return self.data if self.loss.depth_weight > 0 else self.data_for_rendering

    @property
    def data_for_rendering(self) -> DataConfig:
        """``data``, without depth."""
        return self.data.model_copy(update={"ignore_depth": True})

    @model_validator(mode="after")
    def _follow_from_iterations(self) -> FitConfig:
        """Resolve the part of the schedule that is not given, and the strategy's section."""
        model, densify, n = self.model, self.densify, self.iterations
        if _is_open(model, "sh_increase_every"):
            every = 1 if self.init.gaussians else round(DEGREE_SHARE * n)
            every = max(1, min(LATEST_DEGREE, every))
            self._complete("model", {"sh_increase_every": every})
        extension = STRATEGIES.get(densify.strategy)
        strategy = extension.value
        if self.optimizer.decay is None:
            self._complete("optimizer", {"decay": strategy.rate_decay})
        changes, first = {}, densify.start
        if (section := section_of(extension, densify.sections)) is not None:
            changes[densify.strategy] = section
        if _is_open(densify, "stop"):
            least = 1 if _is_open(densify, "start") else first + 1
            suitable = min(strategy.latest_stop, round(strategy.stop_share * n))
            changes["stop"] = max(least, suitable)
        if _is_open(densify, "start"):
            first = max(1, round(strategy.start_share * n))
            changes["start"] = min(REFERENCE_START, first, changes.get("stop", densify.stop) // 2)
        self._complete("densify", changes)
        return self

    def _complete(self, section: str, changes: dict[str, Any]) -> None:
        """Set values of a section, which is frozen once it is validated."""
        object.__setattr__(self, section, getattr(self, section).model_copy(update=changes))

    @model_validator(mode="after")
    def _check_relations(self) -> FitConfig:
        init, densify, optimizer = self.init, self.densify, self.optimizer
        if init.gaussians is not None:
            others = {"start": "auto", "point_cloud": None, "half_extent": None}
            for name, value in others.items():
                expected = f"init.{name} must be {value or 'null'} with init.gaussians"
                _require(getattr(init, name) == value, expected, getattr(init, name))
        if init.start in ("masks", "sweep", "random"):
            expected = f"init.point_cloud must be null where init.start is {init.start}"
            _require(init.point_cloud is None, expected, init.point_cloud)
        if init.start == "points":
            expected = "init.half_extent must be null where init.start is points"
            _require(init.half_extent is None, expected, init.half_extent)
        expected = f"densify.start must be < densify.stop ({densify.stop})"
        _require(densify.start < densify.stop, expected, densify.start)
        views, at_once = optimizer.views, optimizer.views_per_step
        expected = f"optimizer.views must be a multiple of optimizer.views_per_step ({at_once}), "
        _require(views <= at_once or views % at_once == 0, expected + "or not larger", views)
        last = optimizer.means_lr_final
        expected = f"optimizer.means_lr_final must be <= optimizer.means_lr ({optimizer.means_lr})"
        _require(last <= optimizer.means_lr, expected, last)
        for section in (*densify.sections.values(), *self.sections.values()):
            section.check(self)
        if densify.prune.to is not None:
            self._check_last_phase()
        self.require_room("densify.max_gaussians", densify.max_gaussians)
        for before, after in pairwise(self.coarse or ()):
            is_in_order = before.until < after.until and before.factor > after.factor
            got = f"{_format_section(before)} before {_format_section(after)}"
            expected = "coarse must be stages with growing until and falling factor"
            _require(is_in_order, expected, got)
        return self

    def require_room(self, key: str, cap: int | None) -> None:
        """Raise ValueError if more points than ``cap``, the value of a key, are given."""
        num_points = self.init.num_points if self.init.point_cloud is None else None
        fits = num_points is None or cap is None or num_points <= cap
        _require(fits, f"init.num_points must be <= {key} ({cap})", num_points)

    def _check_last_phase(self) -> None:
        prune, n = self.densify.prune, self.iterations
        start = self.densify.prune_window(n)[0]
        expected = f"densify.prune.stop must be > densify.stop and densify.prune.start ({start})"
        _require(prune.stop is None or prune.stop > start, expected, prune.stop)
        last = {"densify.stop": self.densify.stop, "densify.prune.start": prune.start or 0}
        for name, iteration in last.items():
            expected = f"{name} must be < iterations ({n}), or there is none left for "
            _require(iteration < n, f"{expected}densify.prune.to", iteration)
        expected = f"densify.prune.stop must be <= iterations ({n})"
        _require(prune.stop is None or prune.stop <= n, expected, prune.stop)
