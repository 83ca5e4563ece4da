"""The typed configuration of a fit: YAML -> :class:`FitConfig`.

Layer 0. The defaults are the reference 3DGS recipe (Kerbl et al. 2023, section 7 and its
released code) for 30,000 iterations; each field names its unit and range. A configuration is
frozen: what a run used is what :func:`dump_config` writes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationError,
    model_validator,
)

from drgs.checks import UserError, did_you_mean, one_line
from drgs.constants import SHUTTER_SAMPLES
from drgs.files import atomic_path, read_text

Color = str | tuple[float, float, float]

PATH_KEYS = ("data.path", "init.point_cloud", "output.dir")
"""Values that are made absolute when a configuration is loaded."""

MAX_BYTES = 1 << 20
"""Of a configuration file: a thousand times what every value with a comment takes."""

MAX_DEPTH = 20
"""Of nested lists and sections in YAML; a configuration has 3. Python's stack ends at about 100."""

MAX_EXPLAINED = 20
"""Wrong values that an error lists; the rest are counted."""

MAX_INT = 2**31 - 1
"""The counters of Mitsuba and Dr.Jit are of 32 bits."""

NAMED_COLORS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def _color(value: Any) -> Color:
    if isinstance(value, str) and value in NAMED_COLORS:
        return value
    if isinstance(value, (list, tuple)) and len(value) == 3:
        numbers = [v for v in value if isinstance(v, (int, float)) and not isinstance(v, bool)]
        if len(numbers) == 3 and all(0 <= v <= 1 for v in numbers):
            return tuple(float(v) for v in numbers)
    raise ValueError("must be white, black or three numbers in 0..1")


def _color_to_yaml(color: Color) -> Any:
    return color if isinstance(color, str) else list(color)


ColorField = Annotated[Color, PlainValidator(_color), PlainSerializer(_color_to_yaml)]
Count = Annotated[int, Field(le=MAX_INT)]
PathField = Annotated[Path, Field(strict=False)]


class _Section(BaseModel):
    """Frozen; unknown keys, infinities and silent conversions ("3" for 3) are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class DataConfig(_Section):
    """Where the photographs and their cameras are, and how they are read."""

    path: PathField = Field(description="Dataset folder; relative to the configuration file.")
    source: str = Field(
        "", description="Where to get the data: printed in the error if the folder is missing."
    )
    type: Literal["auto", "nerf_synthetic", "nerfstudio"] = Field(
        "auto",
        description="Layout of the folder. auto: nerf_synthetic if there is a "
        "transforms_train.json, nerfstudio if there is a transforms.json.",
    )
    image_size: Count | None = Field(
        None,
        ge=1,
        description="px. Wider images are scaled down to this width by area averaging; null: "
        "none is.",
    )
    test_split: Literal["train", "val", "test"] | None = Field(
        None,
        description="NeRF-synthetic split to measure on; null: test if it is there, else val.",
    )
    test_every: Count = Field(
        8, ge=2, description="nerfstudio: images 0, n, 2n, ... by file name are the test split."
    )
    background: ColorField = Field(
        "white",
        description="white, black or [r, g, b] in display space: behind transparent images, and "
        "behind the splats at training, evaluation and rendering.",
    )
    random_background: bool = Field(
        False,
        description="Each iteration puts another colour behind the transparent pictures and the "
        "splats, so that splats cannot pass for the background.",
    )
    ignore_distortion: bool = Field(
        False, description="Treat images with lens distortion as those of a pinhole camera."
    )
    ignore_motion: bool = Field(
        False, description="Treat cameras that move while a photograph is taken as if they did not."
    )
    shutter_samples: Count = Field(
        SHUTTER_SAMPLES,
        ge=1,
        description="Times at which a picture is rendered that a moving camera with a global "
        "shutter blurs.",
    )
    ignore_masks: bool = Field(False, description="Use the pixels that masks leave out as well.")
    ignore_depth: bool = Field(
        False, description="Do not open files of depth; nor are they where loss.depth_weight is 0."
    )

    @property
    def background_rgb(self) -> tuple[float, float, float]:
        """The background's display-space colour, three numbers in 0..1."""
        return NAMED_COLORS.get(self.background, self.background)


class InitConfig(_Section):
    """The Gaussians at iteration 0."""

    num_points: Count = Field(100_000, ge=4, description="Random points in the start box.")
    half_extent: float | None = Field(
        None,
        gt=0,
        le=1e9,
        description="Scene units: the start box is [-h, h]^3. null: the reference's 1.3 for the "
        "NeRF-synthetic layout, otherwise a box derived from the cameras.",
    )
    opacity: float = Field(0.1, gt=0, lt=1, description="Opacity of every starting Gaussian.")
    point_cloud: PathField | None = Field(
        None, description="PLY with x, y, z (and red, green, blue) to use instead of random points."
    )


class ModelConfig(_Section):
    """What is fitted and how it is rendered."""

    sh_degree: int = Field(3, ge=0, le=3, description="Degree of the spherical harmonics.")
    sh_increase_every: Count = Field(
        1000, ge=1, description="Iterations between +1 of the degree in use, which starts at 0."
    )
    near: float = Field(0.2, gt=0, description="Near plane, scene units: closer means are culled.")
    projection: Literal["ewa", "unscented", "exact"] = Field(
        "ewa",
        description="ewa: the affine approximation at the mean; unscented: of projected sigma "
        "points; exact: the peak of the 3D Gaussian along each pixel's ray.",
    )
    order: Literal["center", "pixel"] = Field(
        "center",
        description="center: splats are ordered by the depth of their means; pixel: by that of "
        "their peaks along each pixel's ray.",
    )
    order_window: int = Field(
        4, ge=1, le=64, description="Of order pixel: splats that a pixel keeps waiting."
    )
    sh_direction: Literal["mean", "pixel"] = Field(
        "mean", description="Where colours are seen from: towards the mean, or along each ray."
    )
    alpha_max: float = Field(0.99, gt=0, lt=1, description="Upper clamp of a splat's alpha.")
    alpha_cut: float = Field(
        1 / 255, ge=0, lt=1, description="Splats end where their alpha is smaller; 0: they do not."
    )
    transmittance_stop: float = Field(
        1e-4, ge=0, lt=1, description="A pixel ends before its transmittance is smaller; 0: never."
    )
    extent: float | None = Field(
        None,
        gt=0,
        description="Standard deviations at which splats end; null: where alpha_cut ends them.",
    )
    low_pass: float = Field(
        0.3, ge=0, description="px^2 added to the variance of a splat on the film; 0: none."
    )
    antialiased: bool = Field(
        False, description="Compensate opacities for the low-pass filter (Yu et al. 2024)."
    )
    smoothing: bool = Field(
        False,
        description="Widen Gaussians to what the training cameras can tell apart, for renderings "
        "at other sizes (the 3D filter of Mip-Splatting, Yu et al. 2024).",
    )


class RateAim(_Section):
    """What a falling rate heads for after an iteration."""

    after: Count = Field(ge=0, description="The last iteration that is not affected.")
    end: Count = Field(ge=1, description="Where the rate would be the last one.")


class OptimizerConfig(_Section):
    """Adam (Kingma and Ba 2015): learning rates per step and its constants."""

    means_lr: float = Field(
        1.6e-4, gt=0, description="First rate of the means, in units of the scene extent."
    )
    means_lr_final: float = Field(
        1.6e-6, gt=0, description="Last rate of the means, which decays exponentially."
    )
    means_lr_aims: list[RateAim] = Field(
        default_factory=list,
        description="When the means' rate is to be the last one, as a plan was revised: a list of "
        "{after: iteration, end: iteration}; empty: at the last iteration.",
    )
    sh0_lr: float = Field(2.5e-3, ge=0, description="Degree-0 colour coefficients.")
    shN_lr: float = Field(1.25e-4, ge=0, description="Colour coefficients of higher degrees.")  # noqa: N815
    opacities_lr: float = Field(
        0.05, ge=0, description="Logit opacities (0.025 in newer releases of the reference)."
    )
    scales_lr: float = Field(5e-3, ge=0, description="Logarithms of the scales.")
    quats_lr: float = Field(1e-3, ge=0, description="Quaternions.")
    beta_1: float = Field(0.9, ge=0, lt=1, description="Decay of the first moment.")
    beta_2: float = Field(0.999, ge=0, lt=1, description="Decay of the second moment.")
    epsilon: float = Field(
        1e-15, gt=0, description="Added to the root of the second moment; gradients are tiny."
    )


class LossConfig(_Section):
    """(1 - w) L1 + w (1 - SSIM), in display space."""

    dssim_weight: float = Field(0.2, ge=0, le=1, description="w; 0 leaves D-SSIM out.")
    window: int = Field(11, ge=3, le=17, description="px: width of SSIM's Gaussian window; odd.")
    sigma: float = Field(1.5, gt=0, description="px: its standard deviation.")
    depth_weight: float = Field(
        0.2,
        ge=0,
        description="Of the mean difference in depth, in scene extents, where the data has depth; "
        "0 leaves it out.",
    )


class ColorConfig(_Section):
    """A colour transform for each training photograph: exposure and white balance."""

    lr: float | None = Field(
        None,
        gt=0,
        description="First rate of the 3 x 4 numbers of each transform, such as 0.02; falls as "
        "that of the means. null: there are no transforms.",
    )
    identity_weight: float = Field(
        1.0, ge=0, description="Of the mean square by which a transform differs from the identity."
    )


class CamerasConfig(_Section):
    """Refinement of the training cameras; first rates per step, which fall as that of the means.

    A camera's pose gets a step when its picture is drawn: of 7,000 iterations with 100 pictures 70.
    Fits that short need higher rates than 30,000 iterations, which these are for.
    """

    optimise: bool = Field(False, description="Refine poses, focal lengths and principal points.")
    start: Count = Field(0, ge=0, description="Iterations before it begins.")
    rotation_lr: float = Field(3e-4, ge=0, description="Radians.")
    translation_lr: float = Field(3e-4, ge=0, description="In units of the scene extent.")
    focal_lr: float = Field(
        0.0, ge=0, description="Relative to the focal lengths, which all views share."
    )
    principal_lr: float = Field(
        0.0, ge=0, description="In parts of the picture's size; all views share it."
    )


class DensifyConfig(_Section):
    """Adaptive density control: clone, split, prune, opacity reset."""

    start: Count = Field(500, ge=0, description="The population changes only after this iteration.")
    stop: Count = Field(
        15_000, ge=1, description="It changes, and is reset, only before this iteration."
    )
    every: Count = Field(100, ge=1, description="Iterations between two changes.")
    grad_threshold: float = Field(
        2e-4,
        gt=0,
        description="A Gaussian is cloned or split if the mean norm of its 2D position gradient, "
        "in NDC units, over the views that saw it reaches this.",
    )
    clone_scale: float = Field(
        0.01,
        gt=0,
        description="Cloned if its largest scale is at most this, split if larger; x extent.",
    )
    split_count: int = Field(
        2, ge=2, le=1_000_000, description="Samples that replace a Gaussian that is split."
    )
    split_shrink: float = Field(1.6, gt=1, description="Their scales are the parent's / this.")
    prune_opacity: float = Field(0.005, ge=0, lt=1, description="Removed if less opaque.")
    prune_scale: float = Field(
        0.1,
        gt=0,
        description="Removed after the first reset if its largest scale is larger; x extent.",
    )
    reset_every: Count = Field(
        3000, ge=1, description="Iterations between opacity resets, which end with densify.stop."
    )
    reset_opacity: float = Field(0.01, gt=0, lt=1, description="A reset lowers opacities to this.")
    white_background_reset: Count | None = Field(
        500, ge=1, description="Iteration of an extra reset if the background is white; null: none."
    )
    max_gaussians: int = Field(
        1_000_000, ge=4, le=100_000_000, description="Cap that is never exceeded."
    )


class OutputConfig(_Section):
    """What a fit leaves behind."""

    dir: PathField | None = Field(
        None,
        description="Folder, relative to the configuration file; null: out/NAME under the current "
        "folder, NAME being that of the configuration file.",
    )
    bake_smoothing: bool = Field(
        False,
        description="Write point_cloud.ply with the smoothing of model.smoothing in its scales and "
        "opacities, for viewers that know nothing of it.",
    )
    save_renders: bool = Field(True, description="Write renders/<split>/*.png.")
    history_every: Count = Field(10, ge=1, description="Iterations between rows of history.csv.")
    checkpoint_every: Count | None = Field(
        500, ge=1, description="Iterations between checkpoints, for --resume; null: none."
    )


class CoarseStage(_Section):
    """Iterations that see smaller pictures."""

    until: Count = Field(ge=1, description="The stage's last iteration.")
    factor: int = Field(ge=2, le=64, description="Width and height are divided by this.")


class FitConfig(_Section):
    """Everything that decides a fit."""

    data: DataConfig
    init: InitConfig = Field(default_factory=InitConfig)
    model: ModelConfig = Field(default_factory=ModelConfig)
    optimizer: OptimizerConfig = Field(default_factory=OptimizerConfig)
    loss: LossConfig = Field(default_factory=LossConfig)
    colors: ColorConfig = Field(default_factory=ColorConfig)
    cameras: CamerasConfig = Field(default_factory=CamerasConfig)
    densify: DensifyConfig = Field(default_factory=DensifyConfig)
    output: OutputConfig = Field(default_factory=OutputConfig)
    iterations: Count = Field(30_000, ge=1, description="Optimizer steps; one view each.")
    coarse: list[CoarseStage] = Field(
        default_factory=list,
        description="Stages of smaller training pictures, before those of full size: a list of "
        "{until: iteration, factor: 4}.",
    )
    seed: Count = Field(0, ge=0, description="Seed of everything random.")

    @property
    def data_for_training(self) -> DataConfig:
        """``data``, without the depths that a loss of weight 0 would not look at."""
        if self.loss.depth_weight > 0:
            return self.data
        return self.data.model_copy(update={"ignore_depth": True})

    @property
    def data_for_rendering(self) -> DataConfig:
        """``data``, without what only a loss looks at."""
        return self.data.model_copy(update={"ignore_depth": True})

    @model_validator(mode="after")
    def _check_relations(self) -> FitConfig:
        densify, optimizer = self.densify, self.optimizer
        if densify.start >= densify.stop:
            raise ValueError(
                f"densify.start must be < densify.stop ({densify.stop}), got {densify.start}"
            )
        if optimizer.means_lr_final > optimizer.means_lr:
            raise ValueError(
                f"optimizer.means_lr_final must be <= optimizer.means_lr ({optimizer.means_lr}), "
                f"got {optimizer.means_lr_final}"
            )
        if densify.prune_opacity >= densify.reset_opacity:
            raise ValueError(
                "densify.prune_opacity must be < densify.reset_opacity "
                f"({densify.reset_opacity}), or a reset removes everything; "
                f"got {densify.prune_opacity}"
            )
        if self.cameras.optimise and self.model.sh_direction != "mean":
            raise ValueError(
                "model.sh_direction must be mean where cameras.optimise is true (colours along "
                f"rays are not differentiated in the camera), got {self.model.sh_direction}"
            )
        if self.init.point_cloud is None and self.init.num_points > densify.max_gaussians:
            raise ValueError(
                f"init.num_points must be <= densify.max_gaussians ({densify.max_gaussians}), "
                f"got {self.init.num_points}"
            )
        for before, after in pairwise(self.coarse):
            if not (before.until < after.until and before.factor > after.factor):
                raise ValueError(
                    "coarse must be stages with growing until and falling factor, got "
                    f"{{until: {before.until}, factor: {before.factor}}} before "
                    f"{{until: {after.until}, factor: {after.factor}}}"
                )
        aims = optimizer.means_lr_aims
        starts = [aim.after for aim in aims]
        if (
            starts != sorted(set(starts))
            or starts[:1] not in ([], [0])
            or any(aim.end <= aim.after for aim in aims)
        ):
            raise ValueError(
                "optimizer.means_lr_aims must begin after iteration 0, with growing after < end, "
                f"got {', '.join(f'{{after: {aim.after}, end: {aim.end}}}' for aim in aims)}"
            )
        if self.loss.window % 2 == 0:
            raise ValueError(f"loss.window must be odd, got {self.loss.window}")
        return self


def load_config(path: str | Path, overrides: Iterable[str] = ()) -> FitConfig:
    """Read a YAML configuration; ``overrides`` are ``section.key=VALUE`` with VALUE in YAML.

    Relative paths in the file are relative to the file's folder; in ``overrides``, which are
    typed in a shell and need not be YAML, to the current folder. The result holds absolute paths.

    Raises :class:`UserError` with one line for each wrong key.
    """
    path = Path(path)
    values = _read_yaml(path)
    _resolve_paths(values, path)
    overridden = set()
    for override in overrides:
        key, value = _parse_override(override)
        _insert(values, key, value)
        overridden.add(key)
    try:
        return FitConfig.model_validate(values)
    except ValidationError as error:
        errors = error.errors()
        lines = [_explain(str(path), item, overridden) for item in errors[:MAX_EXPLAINED]]
        if len(errors) > MAX_EXPLAINED:
            lines.append(f"{path}: {len(errors) - MAX_EXPLAINED} more values are wrong")
        raise UserError("\n".join(lines)) from None


def dump_config(config: FitConfig, path: str | Path) -> None:
    """Write every value of ``config`` as YAML; :func:`load_config` reads an equal one back."""
    text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def known_keys() -> list[str]:
    """Dotted names of every section and every value, such as ``densify.every``."""
    return [key for key, _ in _fields(FitConfig)]


def _fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, field in model.model_fields.items():
        yield prefix + name, field.annotation
        section = _section(field.annotation)
        if section is not None:
            yield from _fields(section, f"{prefix}{name}.")


def _section(annotation: Any) -> type[BaseModel] | None:
    """The section that a value is, or that the elements of a list are."""
    for candidate in (annotation, *get_args(annotation)):
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


class _Loader(yaml.SafeLoader):
    """YAML with the changes that a configuration needs.

    1e-15 is a number (YAML 1.1 wants 1.0e-15 and would read text). A key that is given twice in
    one section is an error (the first would be dropped silently), and so are aliases and deep
    nesting: a few lines of either could take all memory or Python's whole stack.
    """

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            raise yaml.MarkedYAMLError(
                problem=f"aliases such as *{event.anchor} are not supported; write the value out",
                problem_mark=event.start_mark,
            )
        if self.depth >= MAX_DEPTH:
            raise yaml.MarkedYAMLError(
                problem=f"more than {MAX_DEPTH} levels of nesting", problem_mark=event.start_mark
            )
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str) and key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key} is given twice", problem_mark=key_node.start_mark
                )
            seen.add(str(key))
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def _read_yaml(path: Path) -> dict:
    text = read_text(path, "configuration", MAX_BYTES)
    try:
        values = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise UserError(f"{path}: {line}not valid YAML: {one_line(error.problem)}") from None
    except Exception as error:  # a date or number that YAML's syntax allows: PyYAML raises anything
        reason = one_line(error) or type(error).__name__
        raise UserError(f"{path}: not valid YAML: {reason}") from None
    if not isinstance(values, dict):
        raise UserError(f"{path}: must hold sections such as 'data:', got {_show(values)}")
    return values


def _parse_override(override: str) -> tuple[str, Any]:
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise UserError(f"--set {override}: must be KEY=VALUE, as in densify.every=200")
    if key not in known_keys():
        raise UserError(f"--set {key}: unknown key {key}{did_you_mean(key, known_keys())}")
    if key in PATH_KEYS:
        return key, None if text == "null" else _absolute(Path(), text, f"--set {key}")
    try:
        return key, yaml.load(text, Loader=_Loader)
    except Exception:  # as in _read_yaml
        raise UserError(f"--set {key}: not a YAML value: {one_line(text)}") from None


def _insert(values: dict, key: str, value: Any) -> None:
    *sections, leaf = key.split(".")
    for section in sections:
        if not isinstance(values.get(section), dict):
            values[section] = {}
        values = values[section]
    values[leaf] = value


def _resolve_paths(values: dict, file: Path) -> None:
    folder = file.resolve().parent
    for key in PATH_KEYS:
        section, leaf = key.split(".")
        entries = values.get(section)
        if isinstance(entries, dict) and isinstance(entries.get(leaf), str):
            entries[leaf] = _absolute(folder, entries[leaf], f"{file}: {key}")


def _absolute(folder: Path, text: str, where: str) -> str:
    try:
        path = str((folder / Path(text).expanduser()).resolve())
        path.encode()  # what UTF-8 cannot express could not be written to config.yml
    except (OSError, ValueError, RuntimeError) as error:  # of these, RuntimeError: no such user
        raise UserError(
            f"{where} must be a path, got {_show(text)} ({one_line(error, 100)})"
        ) from None
    return path


def _explain(file: str, item: Any, overridden: set[str]) -> str:
    """One line for one of pydantic's errors: where, name, expected, got, remedy."""
    key = one_line(".".join(str(part) for part in item["loc"]), limit=60)
    given = [k for k in overridden if key == k or key.startswith(f"{k}.")]
    where = f"--set {given[0]}" if given else file
    kind, limits = item["type"], item.get("ctx", {})
    if kind in ("extra_forbidden", "invalid_key"):
        return f"{where}: unknown key {key}{did_you_mean(key, known_keys())}"
    if kind == "missing":
        return f"{where}: {key} is missing: {_description(key)}"
    got = f", got {_show(item['input'])}"
    if kind == "value_error" and not key:
        # A relation between values that may come from the file and from the command line.
        origin = f"{file} with --set {' '.join(sorted(overridden))}" if overridden else file
        return f"{origin}: {limits['error']}"
    if kind == "value_error":
        return f"{where}: {key} {limits['error']}{got}"
    for relation, sign in _RELATIONS.items():
        if relation in limits:
            return f"{where}: {key} must be {sign} {limits[relation]:.10g}{got}"
    if kind == "literal_error":
        return f"{where}: {key} must be one of {limits['expected']}{got}"
    return f"{where}: {key} must be {_EXPECTED.get(kind.split('_')[0], item['msg'])}{got}"


_RELATIONS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}

_EXPECTED = {
    "int": "an integer",
    "float": "a number",
    "finite": "a finite number",
    "bool": "true or false",
    "string": "text",
    "path": "a path",
    "list": "a list",
    "model": "a section of keys",
}


def _description(key: str) -> str:
    model: Any = FitConfig
    *sections, leaf = (part for part in key.split(".") if not part.isdigit())
    for section in sections:
        model = _section(model.model_fields[section].annotation)
    field = model.model_fields[leaf]
    return field.description or field.annotation.__doc__


def _show(value: Any) -> str:
    """The value as YAML writes it, on one line and shortened."""
    if isinstance(value, str):
        return one_line(repr(value), limit=60)
    try:
        text = yaml.safe_dump(value, default_flow_style=True, width=math.inf)
    except ValueError:  # Python writes no integer of more than 4300 digits
        return "a number of thousands of digits"
    return one_line(text.removesuffix("\n").removesuffix("\n..."), limit=60)
