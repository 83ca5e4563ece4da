"""Laws of rendering, for tests of your own lenses, projections, falloffs and orders.

A :class:`Case` is a small random scene with a lens, approximations and effects. Each law checks one
property of its image and its derivatives, and raises AssertionError with the numbers if it does not
hold, as ``torch.autograd.gradcheck`` does::

    from drgs.testing import Case, laws_of

    CASE = Case("my lens", lens=MyLens(0.3))

    @pytest.mark.parametrize("law", laws_of(CASE))
    def test_my_lens(law):
        law(CASE)

``reference`` is an independent computation of the image in numpy. With it, images and derivatives
are compared with that computation; without it, derivatives are compared with differences of the
kernels' own images in double precision. The planes of an image are transmittance, red, green, blue
and depth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, cast

import drjit as dr
import numpy as np
from drjit.llvm import ad as llvm
from scipy.spatial.transform import Rotation

from drgs.accuracy.pipeline import pipeline_of
from drgs.cameras.camera import Aperture, Camera, Shutter, cameras_in_time
from drgs.cameras.lens import PINHOLE, Lens
from drgs.config.approximations import Approximations
from drgs.core.arrays import from_host
from drgs.core.errors import UnsupportedError, UserError, check_type, did_you_mean
from drgs.effects.compose import with_effects
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.splatting import rendering
from drgs.splatting.rendering import Frame, Pipeline, color_features, depth_feature

Values = Mapping[str, np.ndarray]  # parameters of Gaussians by name, float64

Reference = Callable[["Case", Values], tuple[np.ndarray, np.ndarray]]
"""Maps a case and its Gaussians to planes (P, H * W), the first P of the five, and to a mask
(H * W,) of pixels so near a threshold that a small step or single precision may cross it."""

SMOOTH = {"alpha_cut": 0.0, "transmittance_stop": 0.0}
"""Approximations of cases without a reference, whose images are then smooth."""

TRANSPOSE_TOLERANCE = 1e-11
"""Relative to the sum of absolute values, of thousands of terms that are accurate to 1e-12."""

NUM_POINTS, MAX_RAY_ERROR = 1000, 1e-9
"""Points around the camera, and the error of a ray's direction: shipped lenses have 1.3e-13, and a
millionth of a pixel is 4e-8."""

WHOLE = "degree", "count", "width", "height", "seed"  # numbers of a case

MAX_MARKED_SHARE = 0.02  # of pixels near a threshold, which are not compared


@dataclass(frozen=True, eq=False)
class Case:
    """A scene to check laws on. Lengths are in scene units, tolerances relative."""

    name: str
    lens: Lens = PINHOLE
    approximations: Mapping[str, Any] = field(default_factory=dict)  # see Approximations
    aperture: tuple[float, float] | None = None  # radius, focus distance
    shutter: Callable[[Camera], Shutter] | None = None  # given the camera at time 0
    smoothing: float | None = None  # standard deviation of the 3D filter
    reference: Reference | None = None
    scene: Callable[[Case], Values] | None = None  # None: random Gaussians before the camera
    degree: int = 1
    count: int = 40
    width: int = 37
    height: int = 29
    focal: float = 26.0  # px
    seed: int = 0
    # Of central differences: off by step^2 times third derivatives of up to 1e5, and by
    # 1e-16 / step, which is less than gradient_tolerance, relative to the sum of absolute terms.
    step: float = 1e-6
    gradient_tolerance: float = 1e-6
    # Relative to the largest value: hundreds of float64 operations, and a lens's Jacobian that a
    # reference computes by differences, 1e-13.
    image_tolerance: float = 1e-11
    # Relative to the largest value: a mean at 40 px carries 1e-5 px in float32, and alpha changes
    # by at most 1.1 per px; gradients add rounding in S / (1 - a), and derivatives that cancel.
    single_tolerance: float = 1e-4

    def __post_init__(self) -> None:
        """Raise :class:`UserError` for a field of another type, or out of range."""
        check_type("Case()", "lens", self.lens, Lens)
        for name, value in vars(self).items():
            if name in ("shutter", "reference", "scene") and value is not None:
                check_type("Case()", name, value, Callable)
            elif isinstance(getattr(Case, name, None), int | float):
                least, most = (0, 3) if name == "degree" else (0 if name == "seed" else 1e-300, 1e6)
                check_type("Case()", name, value, *([int] if name in WHOLE else [int, float]))
                if not least <= cast(float, value) <= most:
                    raise UserError(f"Case(): {name} must be {least} to {most:g}, got {value}")
        pair = self.aperture
        if pair is not None and (np.shape(pair) != (2,) or not pair[0] >= 0 < pair[1]):
            raise UserError(f"Case(): aperture must be (radius, focus distance) > 0, got {pair!r}")
        known = {each.name for each in fields(Approximations)}
        for name in self.approximations.keys() - known:
            raise UserError(f"Case(): approximations has no {name}{did_you_mean(name, known)}")

    @cached_property
    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3), world to camera, and centre (3,), world."""
        rng = np.random.default_rng(self.seed)
        rotation = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        return single(rotation), single(rng.normal(size=3))

    @property
    def K(self) -> np.ndarray:  # noqa: N802  as in gsplat
        """Intrinsics (3, 3), px; the principal point is not in the centre."""
        x, y = single(np.array([0.46, 0.53]) * [self.width, self.height])
        return np.array([[self.focal, 0, x], [0, self.focal, y], [0, 0, 1]])

    @cached_property
    def values(self) -> Values:
        """Parameters of the Gaussians, the same in both precisions."""
        return (self.scene or random_scene)(self)

    @cached_property
    def reference_image(self) -> tuple[np.ndarray, np.ndarray]:
        """The result of ``reference``."""
        assert self.reference is not None, f"{self.name}: has no reference"
        return self.reference(self, self.values)

    @property
    def near_threshold(self) -> np.ndarray:
        """Pixels near a threshold, (H * W,)."""
        size = self.width * self.height
        return np.zeros(size, bool) if self.reference is None else self.reference_image[1]

    def camera(self, Float: type = llvm.Float64) -> Camera:
        """Return the camera, no number of which is a literal of kernels."""
        size = (self.width, self.height, 0.25)
        camera = Camera.create(Float, *self.pose, self.K, *size, lens=self.lens)
        if self.aperture is not None:
            radius, distance = (dr.opaque(Float, number) for number in self.aperture)
            camera = replace(camera, aperture=Aperture(radius, distance))
        if self.shutter is not None:
            camera = replace(camera, shutter=self.shutter(camera))
        dr.make_opaque(camera)
        return camera

    @property
    def pipeline(self) -> Pipeline:
        """The pipeline without effects."""
        given = self.approximations if self.reference else {**SMOOTH, **self.approximations}
        return pipeline_of(Approximations(**given), self.degree, (color_features, depth_feature))

    @property
    def is_differentiable_in_camera(self) -> bool:
        """Whether the pipeline has derivatives with respect to the camera."""
        try:
            self.pipeline.model.features.check_differentiable_in_camera()
        except UnsupportedError:
            return False
        return True

    def frames(self, values: Values, Float: type = llvm.Float64) -> tuple[Gaussians, list[Frame]]:
        """Render; return the Gaussians, and a frame for each time of the shutter."""
        gaussians, camera = self._gaussians(values, Float), self.camera(Float)
        pipeline = with_effects(self.pipeline, gaussians, camera)
        times = cameras_in_time(camera)
        return gaussians, [rendering.render(gaussians, each, pipeline) for each in times]

    def _gaussians(self, values: Values, Float: type) -> Gaussians:
        TensorXf = llvm.TensorXf if Float is llvm.Float else llvm.TensorXf64
        fields: dict[str, Any] = dict(values)
        gaussians = Gaussians(**fields)
        if self.smoothing is not None:
            gaussians = replace(gaussians, smoothing=np.full(self.count, self.smoothing))
        gaussians = gaussians.to(TensorXf)
        logits = from_host(Float, np.array(gaussians.logit_opacities))
        return replace(gaussians, logit_opacities=logits)

    def planes(self, values: Values, Float: type = llvm.Float64) -> np.ndarray:
        """Return the planes (5, H * W) of the kernels' image."""
        _, frames = self.frames(values, Float)
        return np.mean([_arrays(frame.planes()) for frame in frames], axis=0)

    def gradients(
        self, values: Values, weights: np.ndarray, Float: type = llvm.Float64
    ) -> dict[str, np.ndarray]:
        """Return derivatives of sum(weights * planes), weights (5, H * W)."""
        gaussians, frames = self.frames(values, Float)
        total: dict[str, Any] = dict.fromkeys(PARAMETER_NAMES, 0.0)
        d_planes = [from_host(Float, plane / len(frames)) for plane in weights]
        for frame in frames:
            found = rendering.frames_adjoint(gaussians, [frame], [d_planes]).parameters
            for name in PARAMETER_NAMES:
                total[name] = total[name] + np.array(getattr(found, name), np.float64)
        return total

    def tangent(self, values: Values, tangents: Values) -> np.ndarray:
        """Return the directional derivative of the planes, (5, H * W)."""
        gaussians, frames = self.frames(values)
        direction = self._gaussians(tangents, llvm.Float64)
        found = [rendering.frames_tangent(gaussians, [frame], direction)[0] for frame in frames]
        return np.mean([_arrays(planes) for planes in found], axis=0)


def single(values: Any) -> np.ndarray:
    """Return values rounded to float32, as float64."""
    return np.asarray(values, np.float32).astype(np.float64)


def _arrays(planes: list) -> np.ndarray:
    return np.array([np.array(plane, np.float64) for plane in planes])


def _rays(case: Case, film: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origins and directions (N, 3), camera axes, at places (N, 2) px, and validity (N,)."""
    x, y = (cast("Any", llvm.Float64(column)) for column in film.T)
    origin, ray, is_seen = case.camera().look_through(x, y)
    shape = len(film), 3
    starts = np.broadcast_to(np.array(origin, np.float64).T, shape)
    directions = np.broadcast_to(np.array(ray, np.float64).T, shape)
    return starts, directions, np.broadcast_to(np.array(is_seen), len(film))


def random_scene(case: Case) -> Values:
    """Return Gaussians of a fraction of a pixel to a fifth of the film, on and around the film."""
    rng, n = np.random.default_rng(case.seed + 1), case.count
    origin, ray, is_seen = _rays(case, rng.uniform(-0.1, 1.1, (n, 2)) * [case.width, case.height])
    _, axis, _ = _rays(case, case.K[None, :2, 2])  # instead of rays beyond the lens model
    ray = np.where(is_seen[:, None], ray, axis)
    distance = rng.uniform(1.0, 4.0, n)[:, None]
    points = origin + ray / np.linalg.norm(ray, axis=1, keepdims=True) * distance
    sizes = np.minimum(rng.lognormal(np.log(1.5), 0.9, (n, 3)), 0.2 * case.width)
    rotation, center = case.pose
    return {
        "means": single(points @ rotation + center),
        "quats": single(rng.normal(size=(n, 4)) * rng.uniform(0.2, 5.0, (n, 1))),
        "log_scales": single(np.log(sizes * distance / case.focal)),
        "logit_opacities": single(rng.normal(0.5, 1.2, n)),
        "sh0": single(rng.normal(0, 1, (n, 1, 3))),
        "shN": single(rng.normal(0, 0.3, (n, (case.degree + 1) ** 2 - 1, 3))),
    }


def _weights(case: Case) -> np.ndarray:
    """Return random weights (P, H * W) of a loss; zero near thresholds and without a reference."""
    planes = 5 if case.reference is None else len(case.reference_image[0])
    shape = max(5, planes), case.width * case.height
    weights = single(np.random.default_rng(2).normal(size=shape))
    weights[planes:] = 0
    return weights * ~case.near_threshold


def _direction(case: Case) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    return {name: single(rng.normal(size=value.shape)) for name, value in case.values.items()}


def image_equals_reference(case: Case) -> None:
    """The kernels' image in double precision equals the reference's."""
    expected, marked = case.reference_image
    assert marked.mean() < MAX_MARKED_SHARE, f"{case.name}: {marked.mean():.1%} near a threshold"
    actual = case.planes(case.values)
    for k, plane in enumerate(expected):
        error = np.abs(actual[k] - plane)[~marked].max() / np.abs(plane).max()
        assert error <= case.image_tolerance, f"{case.name}: plane {k} is off by {error:.1e}"


def gradients_equal_differences(case: Case) -> None:
    """Derivatives along a direction of each parameter are differences of the reference."""
    weights, direction = _weights(case), _direction(case)
    gradients = case.gradients(case.values, weights)

    def loss(name: str, step: float) -> float:
        moved = {**case.values, name: case.values[name] + step * direction[name]}
        planes = case.planes(moved) if case.reference is None else case.reference(case, moved)[0]
        return float(np.sum(weights[: len(planes)] * planes))

    for name in PARAMETER_NAMES:
        terms = direction[name] * gradients[name]
        expected = (loss(name, case.step) - loss(name, -case.step)) / (2 * case.step)
        error = abs(terms.sum() - expected) / (np.abs(terms).sum() or 1)
        assert error <= case.gradient_tolerance, f"{case.name}: {name} is off by {error:.1e}"


def camera_gradients_equal_differences(case: Case) -> None:
    """Derivatives along a direction of pose, focal lengths, lens, aperture and shutter.

    They equal differences of the kernels' own images, whose values another law checks.
    """
    weights = _weights(case)
    gaussians, frames = case.frames(case.values)
    for frame in frames:
        d_planes = [cast("Any", llvm.Float64(plane)) for plane in weights]
        found = rendering.frames_adjoint(gaussians, [frame], [d_planes], with_camera=True).camera
        gradient = _arrays(found or []).ravel()
        direction = single(np.random.default_rng(3).normal(size=len(gradient)))

        def loss(step: float, frame: Frame = frame, direction: np.ndarray = direction) -> float:
            steps = iter(step * direction)
            camera = frame.camera.map_numbers(lambda number: number + next(steps))
            dr.make_opaque(camera)
            planes = rendering.render(gaussians, camera, frame.pipeline).planes()
            return float(np.sum(weights * _arrays(planes)))

        expected = (loss(case.step) - loss(-case.step)) / (2 * case.step)
        terms = direction * gradient
        error = abs(terms.sum() - expected) / np.abs(terms).sum()
        assert error <= case.gradient_tolerance, f"{case.name}: camera is off by {error:.1e}"
        tangents = [cast("Any", llvm.Float64(each)) for each in direction]
        still = case._gaussians({n: 0 * v for n, v in case.values.items()}, llvm.Float64)
        planes = rendering.frames_tangent(gaussians, [frame], still, tangents)[0]
        forward = np.sum(weights * _arrays(planes))
        error = abs(terms.sum() - forward) / np.abs(terms).sum()
        assert error <= TRANSPOSE_TOLERANCE, f"{case.name}: modes differ in the camera: {error:.1e}"


def adjoint_is_transpose(case: Case) -> None:
    """Forward and reverse mode agree: <J v, w> = <v, J^T w>."""
    weights, direction = _weights(case), _direction(case)
    left = weights * case.tangent(case.values, direction)
    gradients = case.gradients(case.values, weights)
    right = [direction[name] * gradients[name] for name in PARAMETER_NAMES]
    size = np.abs(left).sum() + sum(np.abs(terms).sum() for terms in right)
    error = abs(left.sum() - sum(terms.sum() for terms in right)) / size
    assert error <= TRANSPOSE_TOLERANCE, f"{case.name}: <J v, w> and <v, J^T w> differ: {error:.1e}"


def bytes_are_reproducible(case: Case) -> None:
    """Image and gradients in single precision have the same bytes again, on one thread and two."""
    weights, threads, found = _weights(case), dr.thread_count(), set()
    try:
        for count in (1, 2, 2):
            dr.set_thread_count(count)
            gradients = case.gradients(case.values, weights, llvm.Float)
            planes = case.planes(case.values, llvm.Float)
            found.add((planes.tobytes(), *(gradients[n].tobytes() for n in PARAMETER_NAMES)))
    finally:
        dr.set_thread_count(threads)
    assert len(found) == 1, f"{case.name}: bytes differ between runs or numbers of threads"


def single_precision_is_accurate(case: Case) -> None:
    """Image and gradients in single precision are within ``single_tolerance`` of double."""
    weights, kept = _weights(case), ~case.near_threshold
    planes = case.planes(case.values, llvm.Float), case.planes(case.values)
    pairs = {"image": (planes[0][:, kept], planes[1][:, kept])}
    precise = case.gradients(case.values, weights)
    rounded = case.gradients(case.values, weights, llvm.Float)
    pairs |= {name: (rounded[name], precise[name]) for name in PARAMETER_NAMES}
    for name, (actual, expected) in pairs.items():
        largest = max(np.abs(expected).max(initial=0), 1e-300)
        error = np.abs(actual - expected).max(initial=0) / largest
        assert error <= case.single_tolerance, f"{case.name}: {name} is off by {error:.1e}"


def jacobian_equals_differences(case: Case) -> None:
    """The derivatives of places on the film are differences of ``project_point``."""
    camera, points = _shown_points(case)
    rows = camera.lens.projection_jacobian(camera, points)
    step = case.step * dr.norm(points)
    differences, error = [], np.zeros(1)
    for axis, world in enumerate(camera.rotation):
        moved = type(points)(*(step if k == axis else 0 for k in range(3)))
        ends = [camera.lens.project_point(camera, points + sign * moved) for sign in (-1, 1)]
        found = np.array(camera.lens.offset(camera, *ends) / (2 * step))
        differences.append(found)
        error = np.maximum(error, np.abs(found - [np.array(dr.dot(row, world)) for row in rows]))
    worst = (error.max(0) / np.abs(differences).max((0, 1))).max()
    words = f"{case.name}: projection_jacobian is off by {worst:.1e}"
    assert worst <= case.gradient_tolerance, words


def rays_meet_their_points(case: Case) -> None:
    """The ray through a point's place on the film meets the point, and the lens shows its rays."""
    camera, points = _shown_points(case)
    lens = camera.lens
    place = lens.project_point(camera, points)
    direction = dr.normalize(lens.ray(camera, place.x, place.y))
    way = points - lens.origin(camera, place.x, place.y)
    worst = np.max(np.array(dr.norm(way / dr.norm(way) - direction)))
    words = f"{case.name}: ray misses points by {worst:.1e} of their distance"
    assert worst <= MAX_RAY_ERROR, words
    y, x = np.mgrid[: case.height, : case.width].reshape(2, -1) + 0.5
    place: Any = llvm.Array2f64(x, y)
    ray = lens.ray(camera, place.x, place.y)
    missed = lens.place_of_ray(camera, lens.origin(camera, *place), ray) - place
    meets = dr.norm(missed) < 1e-6  # px
    shown, _, _ = lens.visibility(replace(camera, near=llvm.Float64(0)), ray)
    assert dr.all(~meets | shown), f"{case.name}: shows is false for rays of the film"


def _shown_points(case: Case) -> tuple[Camera, Any]:
    """Return the camera, and points (camera axes) that it shows on its film."""
    rng, camera = np.random.default_rng(4), case.camera()
    spread = np.geomspace(0.03, 3, NUM_POINTS)
    points: Any = llvm.Array3f64(rng.normal(size=(3, NUM_POINTS)) * spread + [[0.0], [0.0], [1.0]])
    place = camera.lens.project_point(camera, points)
    on_film = dr.all((place > camera.film_start) & (place < camera.film_end))
    seen, _, _ = camera.lens.visibility(camera, points)
    (kept,) = np.nonzero(np.array(seen & on_film))
    assert len(kept), f"{case.name}: shows no point on the film"
    return camera, dr.gather(llvm.Array3f64, points, llvm.UInt32(kept))


LAWS = (
    jacobian_equals_differences,
    rays_meet_their_points,
    image_equals_reference,
    gradients_equal_differences,
    camera_gradients_equal_differences,
    adjoint_is_transpose,
    bytes_are_reproducible,
    single_precision_is_accurate,
)


def laws_of(case: Case) -> list[Callable[[Case], None]]:
    """Return the laws that apply to a case.

    Without a reference, these are all but that of its image; colours along each pixel's ray have no
    derivatives with respect to the camera.
    """
    applies = {
        image_equals_reference: case.reference is not None,
        camera_gradients_equal_differences: case.is_differentiable_in_camera,
    }
    return [law for law in LAWS if applies.get(law, True)]
