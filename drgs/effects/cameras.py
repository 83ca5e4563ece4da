"""Training cameras that are optimised together with the splats.

A view's camera is moved, in its own axes, by a rotation exp(turn) and a translation; all views
share factors of the focal lengths and a shift of the principal point. Both poses of a camera that
moves while it exposes are moved alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import Field
from typing_extensions import Self, override

from drgs.cameras.motion import rotation_matrix
from drgs.cameras.viewpoints import OPENCV_TO_MITSUBA
from drgs.config.extensions import EFFECTS
from drgs.config.section import Count, Section
from drgs.core.errors import UserError
from drgs.core.files import write_json
from drgs.core.types import Array3f, Float
from drgs.datasets.camera_file import cameras_json
from drgs.effects.base import (
    Finding,
    ShortFit,
    SimulatedEffect,
    entries,
    join_parts,
    trimmed_deviation,
)
from drgs.effects.optimised import OptimisedEffect

if TYPE_CHECKING:
    from drgs.config.schema import FitConfig
    from drgs.datasets.types import Dataset, View
    from drgs.training.views import FitState, TrainingView

REFINED_CAMERAS = "refined_cameras.json"  # refined cameras of the training views

INTRINSICS = ("fx", "fy", "cx", "cy")

MIN_SHIFT_PX = 0.35  # RMS, of photographs in a short fit; without wrong poses: 0.04 to 0.4
MIN_ZOOM_PX, MIN_BEND_PX, MIN_SKEW_PX = 0.25, 0.5, 0.5
"""The same, at corners: middles of all photographs, without: 0.1, 0.35, 0.05 to 0.4."""
MIN_DEVIATIONS = 1.3  # of such a middle from 0; without texture: 1.2
SHORT_FIT_RATE = 1e-3  # of poses, which a short fit moves fewer times

MAX_FOCAL_FACTOR = 1000  # up or down


CameraRate = Annotated[float, Field(le=1)]  # radians, scene extents, log focal lengths, image sizes


class CamerasConfig(Section):
    """Refinement of the training cameras; rates, for 30,000 iterations, decay as the means'.

    A pose has one step per use of its image: 70 in 7,000 iterations of 100 images.
    """

    scaled: ClassVar = ("start",)

    optimise: bool = False
    """Refine poses, focal lengths and principal points."""
    start: Count = Field(0, ge=0)
    """Last iteration before it begins."""
    rotation_lr: CameraRate = Field(3e-4, ge=0)
    """Initial rate of rotations, radians."""
    translation_lr: CameraRate = Field(3e-4, ge=0)
    """Initial rate of translations, scene extents."""
    focal_lr: CameraRate = Field(0.0, ge=0)
    """Initial relative rate of the focal lengths, shared by all views."""
    principal_lr: CameraRate = Field(0.0, ge=0)
    """Initial rate of the principal point, image sizes, shared by all views."""

    @property
    @override
    def is_off(self) -> bool:
        return not self.optimise

    @override
    def check(self, config: FitConfig) -> None:
        """Refuse colours that are not differentiated in the camera."""
        if self.optimise and config.model.sh_direction != "mean":
            raise ValueError(
                "model.sh_direction must be mean where cameras.optimise is true (colours along "
                "rays are not differentiated in the camera), got "
                f"{config.model.sh_direction}"
            )


@dataclass(frozen=True)
class LensChange:
    """A refinement of the lens shared by all cameras."""

    focal: tuple[float, float] = (1.0, 1.0)  # factors of fx and fy
    principal: tuple[float, float] = (0.0, 0.0)  # shift in image widths and heights

    def apply(self, view: View) -> View:
        """Return the view with this lens."""
        (wide, tall), (right, down) = self.focal, self.principal
        cx, cy = view.cx + right * view.width, view.cy + down * view.height
        return replace(view, fx=view.fx * wide, fy=view.fy * tall, cx=cx, cy=cy)


@dataclass(frozen=True)
class _Start:
    """A view's camera as the data has it, on the device."""

    to_world: mi.Matrix4f  # camera to world, OpenCV axes
    motion: mi.Matrix4f | None  # the second pose in the axes of the first; None: it does not move
    intrinsics: mi.Vector4f  # fx, fy, cx, cy, px
    size: mi.Vector2f  # px


@EFFECTS.register("cameras", section=CamerasConfig)
class CameraRefinement(OptimisedEffect):
    """Poses of all training views, and their lens."""

    order = 60  # places the sensor that is rendered, with derivatives
    moves_sensors = True
    files = (REFINED_CAMERAS,)

    @classmethod
    @override
    def summarize(cls, config: FitConfig, dataset: Dataset) -> list[SimulatedEffect]:
        rates = config.section("cameras", CamerasConfig)
        what = join_parts(
            "poses" if rates.rotation_lr or rates.translation_lr else None,
            "focal lengths" if rates.focal_lr else None,
            "principal point" if rates.principal_lr else None,
        )
        what = (what or "nothing: all rates are 0") if rates.optimise else None
        return [SimulatedEffect("camera refinement", what, "cameras.optimise")]

    @classmethod
    @override
    def from_config(cls, config: FitConfig, dataset: Dataset, section: CamerasConfig) -> Self:
        return cls(section, len(dataset.train), dataset.extent)

    @classmethod
    @override
    def look_for(cls, fit: ShortFit) -> list[Finding]:
        """Measure by how much photographs are moved and distorted against their renderings."""
        views = (*fit.alignments, *fit.trained)
        zoom, bend = (_middle([getattr(v, name) for v in views]) for name in ("zoom", "distortion"))
        skew, other = np.median([np.abs(v.skew) for v in views], axis=0)
        noise = max(other, _deviation([v.zoom for v in views]))  # photographs have one zoom
        shift = trimmed_deviation(np.array([np.hypot(*each.shift) for each in fit.alignments]))
        rates = {"cameras.rotation_lr": SHORT_FIT_RATE, "cameras.translation_lr": SHORT_FIT_RATE}
        poses, focal = {"cameras.optimise": True}, {"cameras.focal_lr": SHORT_FIT_RATE}
        moved = f"photographs are shifted by {shift * fit.factor:.1f} px"
        larger = f"renderings' corners are {zoom * fit.factor:.1f} px farther out"
        bent = f"corners are bent by {bend * fit.factor:.1f} px"
        sheared = f"rows are sheared by {skew * fit.factor:.1f} px"
        calibrate = "calibrate the lens" if abs(bend) > MIN_BEND_PX else ""
        is_rolling = skew > max(MIN_SKEW_PX, 1.5 * noise)
        both = "two poses and shutter: rolling, if it is a video" if is_rolling else ""
        found = [
            Finding("camera refinement", moved, shift > MIN_SHIFT_PX, poses, rates),
            Finding("focal length", larger, abs(zoom) > MIN_ZOOM_PX, poses | focal, rates),
        ]
        found = found if fit.config.model.sh_direction == "mean" else []
        found.append(Finding("distortion", bent, False, {}, advice=calibrate))
        return [*found, Finding("rolling shutter", sheared, False, {}, advice=both)]

    def __init__(self, config: CamerasConfig, num_views: int, extent: float) -> None:
        """num_views: of the training split; extent: world units."""
        self.first = config.start
        shapes = {"turns": (num_views, 3), "moves": (num_views, 3)}
        rates = {"turns": config.rotation_lr, "moves": config.translation_lr * extent}
        shared = {"log_focals": config.focal_lr, "shifts": config.principal_lr}
        # A rate of 0 disables its parameter.
        shapes |= {name: (1, 2) for name, rate in shared.items() if rate > 0}
        super().__init__({name: np.zeros(shape) for name, shape in shapes.items()}, rates | shared)
        self.numbers: dict[int, dict[str, dr.ArrayBase]] = {}  # of the step's sensors, by view

    @override
    def upload(self, view: View) -> _Start:
        motion = None
        if view.motion is not None:
            between = np.linalg.solve(view.camera_to_world, view.motion.close_to_world)
            motion = mi.Matrix4f(between.astype(np.float32))
        to_world = mi.Matrix4f(view.camera_to_world.astype(np.float32))
        intrinsics = mi.Vector4f(*(float(getattr(view, name)) for name in INTRINSICS))
        start = _Start(to_world, motion, intrinsics, mi.Vector2f(view.width, view.height))
        dr.make_opaque(start)
        return start

    @override
    def before_render(self, fit: FitState, view: TrainingView) -> None:
        # The sensor's parameters are leaves; the rest of the chain is differentiated afterwards.
        self.numbers[view.index] = numbers = dr.detach(self._camera_of(view))
        if self._has_begun(fit):
            dr.enable_grad(numbers)
        _set_sensor(view.sensor, numbers)

    def _has_begun(self, fit: FitState) -> bool:
        return fit.iterations_of_step[0] > self.first

    @override
    def place(self, view: TrainingView) -> None:
        _set_sensor(view.sensor, dr.detach(self._camera_of(view)))

    @override
    def leaves(self, view: TrainingView) -> Mapping[str, dr.ArrayBase]:
        return self.numbers[view.index]

    @override
    def after_backward(
        self, fit: FitState, view: TrainingView, derivatives: Mapping[str, dr.ArrayBase]
    ) -> None:
        """Step the view's numbers, at the means' rate: cameras are refined against these."""
        del self.numbers[view.index]
        if not self._has_begun(fit):
            return
        # Views of a step may share numbers, which the one before has moved.
        for name, value in self._camera_of(view).items():
            if dr.grad_enabled(value):
                dr.accum_grad(value, derivatives[name])
                dr.enqueue(dr.ADMode.Backward, value)
        dr.traverse(dr.ADMode.Backward)
        self.step(view, fit.rate_decay)

    def _camera_of(self, view: TrainingView) -> dict[str, dr.ArrayBase]:
        return self._camera(view.uploads[self.name], self.parameters(view))

    @staticmethod
    def _camera(start: _Start, leaves: Mapping[str, Float]) -> dict[str, dr.ArrayBase]:
        """Return the sensor's parameters, from the numbers that are optimised."""
        turn, move = (mi.Vector3f(*entries(leaves[name])) for name in ("turns", "moves"))
        rotation = rotation_matrix(cast(Array3f, turn))
        rows = [[rotation[i, j] for j in range(3)] + [move[i]] for i in range(3)]
        moved = start.to_world @ mi.Matrix4f([*rows, [0, 0, 0, 1]])
        fx, fy, cx, cy = start.intrinsics
        if "log_focals" in leaves:
            wide, tall = map(dr.exp, entries(leaves["log_focals"]))
            fx, fy = fx * wide, fy * tall
        if "shifts" in leaves:
            right, down = entries(leaves["shifts"])
            cx, cy = cx + right * start.size.x, cy + down * start.size.y
        signs = mi.Matrix4f(OPENCV_TO_MITSUBA.astype(np.float32))
        poses = {"to_world": moved @ signs}
        if start.motion is not None:
            poses["to_world_close"] = moved @ start.motion @ signs
        return poses | {"fx": fx, "fy": fy, "cx": cx, "cy": cy}

    def refined_views(self, views: Sequence[View]) -> list[View]:
        """Return the training views with their current cameras."""
        numbers, result = self.numpy(), []
        for index, view in enumerate(views):
            rows = {name: v[min(index, len(v) - 1)] for name, v in numbers.items()}
            leaves = {name: cast(Float, mi.Float(row)) for name, row in rows.items()}
            camera = self._camera(self.upload(view), leaves)
            values: dict[str, object] = {name: float(camera[name][0]) for name in INTRINSICS}
            if view.motion is not None:
                close = _pose(camera["to_world_close"])
                values["motion"] = replace(view.motion, close_to_world=close)
            result.append(replace(view, camera_to_world=_pose(camera["to_world"]), **values))
        return result

    @property
    def lens_change(self) -> LensChange:
        """The changes that all cameras share; UserError for focal lengths that no camera has."""
        shared = self.optimizers.keys() & {"log_focals", "shifts"}
        values, changes = self.numpy(), {}
        numbers = {name: values[name][0].astype(np.float64) for name in shared}
        if "log_focals" in numbers:
            if np.abs(numbers["log_focals"]).max() > np.log(MAX_FOCAL_FACTOR):
                raise UserError(
                    "cameras.focal_lr: focal lengths must be refined by factors up to "
                    f"{MAX_FOCAL_FACTOR:g}, got e to the power of "
                    f"{', '.join(f'{n:g}' for n in numbers['log_focals'])}; lower it"
                )
            changes["focal"] = tuple(np.exp(numbers["log_focals"]).tolist())
        if "shifts" in numbers:
            changes["principal"] = tuple(numbers["shifts"].tolist())
        return LensChange(**changes)

    @override
    def correct_views(self, views: tuple[View, ...]) -> tuple[View, ...]:
        """Return the views with the refined lens; their poses are known no better than before."""
        return tuple(map(self.lens_change.apply, views))

    @override
    def write(self, folder: Path, dataset: Dataset) -> None:
        """Write the refined training cameras, in the layout of ``transforms.json``."""
        cameras = cameras_json(self.refined_views(dataset.train), dataset.origin)
        write_json(folder / REFINED_CAMERAS, {"lens_change": asdict(self.lens_change), **cameras})


def _middle(values: Sequence[float]) -> float:
    """Return the median; 0 unless it is far from 0 for the normal deviation of a single value."""
    middle = float(np.median(values))
    return middle if abs(middle) > MIN_DEVIATIONS * _deviation(values) else 0.0


def _deviation(values: Sequence[float]) -> float:
    """Return the normal deviation of single values, by the median absolute one."""
    return 1.4826 * float(np.median(np.abs(np.array(values) - np.median(values))))


def _set_sensor(sensor: mi.Sensor, numbers: Mapping[str, dr.ArrayBase]) -> None:
    params = mi.traverse(sensor)
    params["to_world"] = _transform(numbers["to_world"])
    for name in INTRINSICS:
        params[name] = numbers[name]
    params.update()
    if "to_world_close" in numbers:
        # By name it is announced as not differentiable: each iteration would warn.
        pose = _transform(numbers["to_world_close"])
        sensor.to_world_close = pose  # pyright: ignore[reportAttributeAccessIssue]  # a plugin's


def _transform(to_world: dr.ArrayBase) -> mi.AffineTransform4f:
    return mi.AffineTransform4f(cast("mi.Matrix4f", to_world))


def _pose(to_world: dr.ArrayBase) -> np.ndarray:
    """Return a pose (4, 4) float64, OpenCV axes."""
    return np.array(to_world)[..., 0].astype(np.float64) @ OPENCV_TO_MITSUBA
