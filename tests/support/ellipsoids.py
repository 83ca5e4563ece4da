"""Mitsuba's ellipsoids, and the Gaussians that they hold."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from support.helpers import assert_arrays_agree, single
from support.splats_checks import GRADIENTS
from support.views import Scene, gradients_of, tensors

SHAPE_ATTRIBUTES = ("data", "opacities", "sh_coeffs")


def float32_attributes(gaussians) -> dict[str, np.ndarray]:
    """Attributes of a shape, (N, ...), float32 values."""
    held = {
        "data": np.concatenate(
            [gaussians.means, np.exp(gaussians.log_scales), gaussians.quats[:, [1, 2, 3, 0]]], 1
        ),
        "opacities": reference.sigmoid(gaussians.logit_opacities)[:, None],
        "sh_coeffs": np.concatenate([gaussians.sh0, gaussians.shN], 1).reshape(
            len(gaussians.means), -1
        ),
    }
    return {name: single(values) for name, values in held.items()}


def gaussians_of(held) -> reference.Gaussians:
    """The conversion, in double precision."""
    data, opacities = held["data"], held["opacities"][:, 0]
    sh = held["sh_coeffs"].reshape(len(data), -1, 3)
    return reference.Gaussians(
        means=data[:, :3],
        quats=data[:, [9, 6, 7, 8]],
        log_scales=np.log(data[:, 3:6]),
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        sh0=sh[:, :1],
        shN=sh[:, 1:],
    )


def shape_of(held, kind="ellipsoids", **others) -> dict:
    """The dictionary for ``mi.load_dict``."""
    attributes = {name: mi.TensorXf(values.astype(np.float32)) for name, values in held.items()}
    return {"type": kind, **attributes, **others}


@dataclass(frozen=True)
class EllipsoidsCase(Scene):
    """A scene whose Gaussians a shape holds; their numbers are what float32 makes of them there."""

    kind: str = "ellipsoids"

    @property
    def held(self) -> dict[str, np.ndarray]:
        return float32_attributes(super().gaussians)

    @property
    def gaussians(self) -> reference.Gaussians:
        return gaussians_of(self.held)

    @property
    def shape(self) -> dict:
        return shape_of(self.held, self.kind)

    @property
    def own_tensors(self) -> dict:
        return {}

    @property
    def objects(self) -> dict:
        return {"shape": self.shape}


def held_gradients(held, of_gaussians) -> dict[str, np.ndarray]:
    """Derivatives with respect to attributes, from those of the Gaussians.

    Each Gaussian is converted by itself, so that a column's central difference serves all rows.
    The conversion's third derivatives are at most 2 / x^3 at steps of 1e-6 x: errors of 1e-12.
    """
    gradients = {name: np.zeros_like(values) for name, values in held.items()}
    for name, values in held.items():
        for k in range(values.shape[1]):
            step = 1e-6 * np.abs(values[:, k])
            if name == "opacities":
                step = step * (1 - values[:, k])
            step[step == 0] = 1e-6
            moved = []
            for sign in (1, -1):
                changed = values.copy()
                changed[:, k] += sign * step
                moved.append(vars(gaussians_of(held | {name: changed})))
            for parameter in PARAMETER_NAMES:
                slope = (moved[0][parameter] - moved[1][parameter]).reshape(len(step), -1)
                weighted = slope * of_gaussians[parameter].reshape(len(step), -1)
                gradients[name][:, k] += weighted.sum(axis=1) / (2 * step)
    return gradients


def gradients_held(loaded, weights, prefix="shape") -> dict[str, np.ndarray]:
    """Gradients of sum(weights * image) for what a shape holds, flat."""
    return gradients_of(loaded, weights, SHAPE_ATTRIBUTES, f"{prefix}.")


def apart(arrays) -> dict[str, np.ndarray]:
    """With ``data`` in its parts, which differ in size: each has a largest value of its own."""
    data = arrays["data"].reshape(-1, 10)
    parts = {"means": data[:, :3], "scales": data[:, 3:6], "quats": data[:, 6:]}
    return parts | {name: arrays[name].ravel() for name in SHAPE_ATTRIBUTES if name != "data"}


def assert_held_agree(actual, expected):
    assert_arrays_agree(apart(actual), apart(expected), GRADIENTS)


def joined(*parts) -> reference.Gaussians:
    """All rows, coefficients padded with zeros."""
    width = max(part.shN.shape[1] for part in parts)
    fields = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in PARAMETER_NAMES
        if name != "shN"
    }
    padded = [np.pad(p.shN, [(0, 0), (0, width - p.shN.shape[1]), (0, 0)]) for p in parts]
    return reference.Gaussians(**fields, shN=np.concatenate(padded))


@dataclass(frozen=True)
class Merged(Scene):
    """Gaussians of the integrator and of two shapes, of other degrees."""

    own_degree: int = 1
    degrees: tuple[int, int] = (2, 0)

    @property
    def own(self) -> reference.Gaussians:
        return Scene(self.view, self.own_degree, count=self.count, seed=self.seed).gaussians

    @property
    def shapes(self) -> list[EllipsoidsCase]:
        return [
            EllipsoidsCase(self.view, degree=degree, count=count, seed=self.seed + 1000 * (i + 1))
            for i, (degree, count) in enumerate(zip(self.degrees, (12, 23), strict=True))
        ]

    @property
    def gaussians(self) -> reference.Gaussians:
        return joined(self.own, *(shape.gaussians for shape in self.shapes))

    @property
    def rendered_degree(self) -> int:
        highest = max(self.own_degree, *self.degrees)
        return highest if self.sh_degree is None else self.sh_degree

    @property
    def own_tensors(self) -> dict:
        return tensors(self.own)

    @property
    def objects(self) -> dict:
        """One shape of each kind, in the order in which Mitsuba lists them."""
        first, second = self.shapes
        return {"first": first.shape, "second": shape_of(second.held, "ellipsoidsmesh")}


MERGED = (
    Merged(),
    Merged(own_degree=3),
    Merged(own_degree=0, degrees=(0, 3)),
    Merged(own_degree=0, degrees=(0, 0)),
)

ROTATION = Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()
SCALE, TRANSLATION = 1.5, np.array([0.5, -0.25, 1.0])


def transform() -> mi.ScalarTransform4f:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = SCALE * ROTATION, TRANSLATION
    return mi.ScalarTransform4f(matrix)


def scene_with(integrator, view, **others) -> mi.Scene:
    """A scene on black, of shapes or of Gaussians of the integrator."""
    scene = EllipsoidsCase(view, background=(0.0, 0.0, 0.0))
    return scene.load_with(objects=others, **integrator)
