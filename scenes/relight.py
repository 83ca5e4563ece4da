"""Find what an image of a fitted model in a path-traced scene was made of.

    python scenes/relight.py out/lego --out out/relight
    python scenes/relight.py out/lego --case mirror --out out/mirror

A model that was fitted to photographs (``python -m drgs.fit``) stands among path-traced surfaces:
what a splat trainer cannot render, and Mitsuba alone cannot either. An image of this is taken, and
what it was made of is forgotten. From wrong values, gradient descent through the composited image
finds the true ones. The unit of length is the model's radius.

Case ``objects``: the model stands on a floor under a lamp, behind a globe and before a ball.
Unknown are

- the model's pose: a translation and a rotation
- the globe's pose: it is turned about its centre
- the ball's colour and the lamp's

Rotations are quaternions (xyzw), as Dr.Jit has them. The splats' means, quaternions and spherical
harmonics are functions of the model's pose, written in Dr.Jit below; what the ``splats`` integrator
finds for them becomes the gradient of the pose, that of the model's outline included, since splats
have soft edges. The nested integrator is Mitsuba's ``prb`` (path tracing whose backward pass
replays its paths). It finds the gradients of the globe's pose, through the texture that turns with
it, and those of paint and light.

Case ``mirror``: behind the model is a sheet of metal, larger than the image, under a sky of one
colour. Unknown are

- how the sheet is turned: its normal
- how rough it is: alpha of its microfacets
- its colour

Without the splats that the sheet reflects, its image would have one colour whatever its turn and
its roughness. So these are found through splats that rays meet behind a surface: the nested
integrator is ``splatpath``, with ``light`` set to ``rays``.

Not differentiated: whether a splat is in front of a surface, and the outlines of surfaces. So the
globe turns where it is, and the sheet has no outline in the image: to move one would need
derivatives of its silhouette. Nor is how what a ray meets of splats changes with the ray: a sheet
that turns reflects each direction with another weight, and that is differentiated, but it also
moves the points that rays start from. So the gradient of the normal is not exact; where the
images are equal, it vanishes all the same.
"""

from __future__ import annotations

import argparse
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import drgs  # noqa: F401  (registers the plugin)
import drjit as dr
import mitsuba as mi
import numpy as np
from drgs.bench.output import markdown_table
from drgs.cameras.orbits import OPAQUE, orbit_of_gaussians
from drgs.cli.ending import exit_on_user_error
from drgs.config.approximations import from_ply_header
from drgs.core.arrays import interleave
from drgs.core.errors import UserError
from drgs.core.files import atomic_path
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.gaussians.sh import sh_basis
from drgs.gaussians.similarity import Similarity
from drgs.io.figures import new_figure, write_figure
from drgs.io.images import write_animation, write_png
from drgs.reference import splatting as reference
from drgs.results.folder import own_gaussians
from scipy.spatial.transform import Rotation


class Unknowns:
    """The unknowns of a case, as a table shows them."""

    TITLES: ClassVar[dict[str, str]]
    LIMITS: ClassVar[dict[str, tuple[float, float]]]
    ROTATIONS: ClassVar[frozenset[str]] = frozenset()  # axis times angle, degrees

    def variables(self) -> dict[str, Any]:
        """For the optimizer."""
        found = {}
        for name, value in vars(self).items():
            if name in self.ROTATIONS:
                xyzw = Rotation.from_rotvec(value, degrees=True).as_quat()
                found[name] = mi.Quaternion4f(*xyzw.tolist())
            else:
                found[name] = {1: mi.Float, 3: mi.Vector3f}[len(value)](value)
        return found

    @classmethod
    def of(cls, variables: Any) -> Unknowns:
        """The inverse of :meth:`variables`."""
        values = {name: np.array(value).ravel() for name, value in variables.items()}
        for name in cls.ROTATIONS:
            values[name] = Rotation.from_quat(values[name]).as_rotvec(degrees=True)
        return cls(**{name: value.tolist() for name, value in values.items()})


@dataclass(frozen=True)
class ObjectUnknowns(Unknowns):
    """Unknowns of the case ``objects``."""

    shift: list[float]  # of the model, in its radii
    turn: list[float]  # of the model
    roll: list[float]  # of the globe
    paint: list[float]  # of the ball: reflectance, RGB
    lamp: list[float]  # radiance, RGB, in units of RADIANCE

    ROTATIONS = frozenset({"turn", "roll"})
    LIMITS: ClassVar = {"paint": (0, 1)}
    TITLES: ClassVar = {
        "shift": "model: shift [radii]",
        "turn": "model: turn [degrees]",
        "roll": "globe: turn [degrees]",
        "paint": "ball: reflectance",
        "lamp": "lamp: RGB",
    }


@dataclass(frozen=True)
class MirrorUnknowns(Unknowns):
    """Unknowns of the case ``mirror``."""

    normal: list[float]  # of the sheet; of any length
    roughness: list[float]  # alpha
    tint: list[float]  # reflectance, RGB

    LIMITS: ClassVar = {"roughness": (0.03, 1), "tint": (0, 1)}
    TITLES: ClassVar = {
        "normal": "sheet: normal",
        "roughness": "sheet: roughness",
        "tint": "sheet: reflectance",
    }

    @classmethod
    def of(cls, variables: Any) -> Unknowns:
        """The inverse of :meth:`variables`, but for the normal's length."""
        found = super().of(variables)
        return replace(found, normal=(found.normal / np.linalg.norm(found.normal)).tolist())


RATE, LAST_RATE = 0.02, 0.002
"""Adam's steps in the first half and in the last iteration: about what a number changes by."""

SCALES = (1, 2, 4, 10, 20)
"""px: sides of the blocks whose means are compared. Large ones see a model that is far off, small
ones place it exactly."""

TARGET_SPP = 256  # paths per pixel
FRAME_EVERY = 3  # iterations, of the animation
FIELD_OF_VIEW = 40.0  # degrees
GLOBE, GLOBE_RADIUS = [-0.25, -0.95, 0.28], 0.28  # above the floor
BALL, BALL_RADIUS = [0.55, 0.75, 0.45], 0.45
RADIANCE = 12.0
SHEET = [-0.95, 0.72, 0]  # its middle
SHEET_SIZE = 30.0  # from there to its edges


def main() -> None:
    """Entry point of the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("model", type=Path, metavar="MODEL.ply|OUT_DIR", help="a fitted model")
    parser.add_argument("--case", choices=list(CASES), default="objects", help="(default: objects)")
    parser.add_argument("--out", type=Path, default=Path("out/relight"), metavar="DIR")
    parser.add_argument("--iterations", type=int, default=200, metavar="N", help="(default: 200)")
    parser.add_argument("--size", type=int, default=200, metavar="N", help="px (default: 200)")
    args = parser.parse_args()
    with exit_on_user_error():
        if args.iterations < 1:
            raise UserError(f"--iterations must be >= 1, got {args.iterations}")
        if args.size < 1 or args.size % SCALES[-1]:
            raise UserError(f"--size must be a multiple of {SCALES[-1]} px, got {args.size}")
        mi.set_variant("llvm_ad_rgb")
        relight(CASES[args.case], load(args.model), args.size, args.iterations, args.out)


def relight(case: Case, model: Gaussians, size: int, iterations: int, out: Path) -> None:
    """Forget what an image was made of, find it again, and write what happened."""
    stage = case.stage.of(model, size)
    stage.show(case.true.variables())
    target = stage.rendered(seed=0, spp=TARGET_SPP)
    optimizer = mi.ad.Adam(lr=RATE, params=case.start.variables())
    losses, frames, start = [], [], time.perf_counter()
    for iteration in range(iterations):
        cooling = max(0, 2 * iteration / iterations - 1)  # in the second half
        optimizer.set_learning_rate(RATE * (LAST_RATE / RATE) ** cooling)
        stage.show(optimizer)
        image = stage.rendered(seed=1 + iteration, spp=case.spp)
        loss = distance(image, target)
        dr.backward(loss)
        optimizer.step()
        for name, limits in case.start.LIMITS.items():
            optimizer[name] = dr.clip(optimizer[name], *limits)
        losses.append(loss.array[0])
        if iteration % FRAME_EVERY == 0:
            frames.append(encoded(image))
        if iteration % 10 == 0 or iteration == iterations - 1:
            seconds = time.perf_counter() - start
            print(f"iteration {iteration}: loss {losses[-1]:.2e}, {seconds:.0f} s", flush=True)
    images = {"target": encoded(target)}
    for name, variables in {"start": case.start.variables(), "end": optimizer}.items():
        stage.show(variables)
        images[name] = encoded(stage.rendered(seed=0, spp=TARGET_SPP))
    write(out, images, frames, losses, [case.true, case.start, case.start.of(optimizer)])


def distance(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Return the mean square difference of two images (H, W, 3) at each of :data:`SCALES`.

    The sum weights them by s, since noise and detail that remain in a block shrink with it.
    """
    difference = image - target
    height, width, _ = difference.shape
    total = 0
    for s in SCALES:
        blocks = dr.reshape(difference, (height // s, s, width // s, s, 3))
        total += s * dr.mean(dr.square(dr.mean(blocks, axis=(1, 3))), axis=None)
    return total


# ----------------------------------------------------------------------------------------------
# Scenes, as functions of the unknowns
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Stage(ABC):
    """Splats and surfaces in one Mitsuba scene."""

    scene: mi.Scene
    params: Any  # mi.SceneParameters
    model: Gaussians  # Dr.Jit, as it was fitted

    NESTED: ClassVar[dict[str, Any]]
    """Properties of ``splats`` that render surfaces."""

    @classmethod
    def of(cls, model: Gaussians, size: int) -> Stage:
        """Set it up; model: as :func:`load` gives it; size: px, of the image's sides."""
        names = [*PARAMETER_NAMES, *(["smoothing"] if model.smoothing is not None else [])]
        tensors = {name: mi.TensorXf(getattr(model, name)) for name in names}
        said = from_ply_header("the model's file", model.rendered_with or {})
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "splats", **cls.NESTED, **said, **tensors},
                "sensor": camera(size),
                "sky": {"type": "constant", "radiance": rgb([0.4, 0.45, 0.5])},
                **cls.surfaces(model),
            }
        )
        return cls(scene, mi.traverse(scene), model.to(mi.TensorXf))

    @staticmethod
    @abstractmethod
    def surfaces(model: Gaussians) -> dict[str, Any]:
        """The surfaces around a model, and their lamps, for ``mi.load_dict``."""

    @abstractmethod
    def show(self, unknowns: Any) -> None:
        """Make the scene's parameters functions of these variables."""

    def rendered(self, seed: int, spp: int) -> mi.TensorXf:
        """The composited one, linear; spp: paths per pixel. Splats need one sample."""
        self.scene.integrator().nested_spp = spp
        return mi.render(self.scene, self.params, seed=seed)


class Objects(Stage):
    """A model on a floor, behind a globe and before a ball."""

    NESTED: ClassVar = {"nested": {"type": "prb", "max_depth": 3}}

    @staticmethod
    def surfaces(model: Gaussians) -> dict[str, Any]:
        """See :meth:`Stage.surfaces`."""
        heights = model.means[model.opacities >= OPAQUE, 2]
        floor = float(np.quantile(heights, 0.01)) if len(heights) else -0.5
        T, above = mi.ScalarTransform4f, np.array([0, 0, floor])
        lamp = T().look_at(origin=[-2.2, -2.6, 3.4], target=[0, 0, 0], up=[0, 0, 1]).scale(0.7)
        painted = {"type": "bitmap", "data": waves(), "raw": True}
        plastic = {"type": "roughplastic", "diffuse_reflectance": rgb([0.5] * 3)}

        def shape(kind: str, to_world: mi.ScalarTransform4f, **others: Any) -> dict[str, Any]:
            return {"type": kind, "to_world": to_world, **others}

        def sphere(center: list[float], radius: float, bsdf: dict[str, Any]) -> dict[str, Any]:
            return shape("sphere", T().translate(center + above).scale(radius), bsdf=bsdf)

        return {
            "lamp": shape("rectangle", lamp, emitter={"type": "area", "radiance": rgb([1] * 3)}),
            "floor": shape("disk", T().translate(above).scale(20)),
            "globe": sphere(GLOBE, GLOBE_RADIUS, {"type": "diffuse", "reflectance": painted}),
            "ball": sphere(BALL, BALL_RADIUS, plastic),
        }

    @cached_property
    def globe(self) -> Any:
        """Its place at first: AffineTransform4f; a copy, as Mitsuba writes in place."""
        return mi.AffineTransform4f(self.params["globe.to_world"])

    def show(self, unknowns: Any) -> None:
        """See :meth:`Stage.show`."""
        turn, roll = (dr.normalize(unknowns[name]) for name in ("turn", "roll"))
        globe = self.globe @ mi.AffineTransform4f(dr.quat_to_matrix(mi.Matrix4f, roll))
        rotation = dr.quat_to_matrix(mi.Matrix3f, turn)
        means = rotation @ dr.unravel(mi.Point3f, self.model.means.array) + unknowns["shift"]
        w, x, y, z = dr.unravel(mi.Vector4f, self.model.quats.array)
        quats = turn * mi.Quaternion4f(x, y, z, w)
        changed = {
            "integrator.means": rows(means),
            "integrator.quats": rows([quats.w, quats.x, quats.y, quats.z]),
            "globe.to_world": globe,
            "ball.bsdf.diffuse_reflectance.value": mi.Color3f(unknowns["paint"]),
            "lamp.emitter.radiance.value": mi.Color3f(RADIANCE * unknowns["lamp"]),
        }
        degree = self.model.sh_degree
        if degree > 0:
            changed["integrator.shN"] = sh_rotation(rotation, degree) @ self.model.shN
        self.params.update(changed)


class Mirror(Stage):
    """A model before a sheet of metal."""

    NESTED: ClassVar = {"nested": {"type": "splatpath", "max_depth": 2}, "light": "rays"}

    @staticmethod
    def surfaces(model: Gaussians) -> dict[str, Any]:
        """See :meth:`Stage.surfaces`."""
        del model
        metal = {"type": "roughconductor", "material": "none", "alpha": 0.1}
        return {
            "sheet": {"type": "rectangle", "bsdf": metal | {"specular_reflectance": rgb([1] * 3)}}
        }

    def show(self, unknowns: Any) -> None:
        """See :meth:`Stage.show`."""
        normal = dr.normalize(unknowns["normal"])
        side = dr.normalize(dr.cross(mi.Vector3f(0, 0, 1), normal))
        axes = SHEET_SIZE * side, SHEET_SIZE * dr.cross(normal, side), normal, mi.Vector3f(SHEET)
        lines = [[axis[i] for axis in axes] for i in range(3)]
        changed = {
            "sheet.to_world": mi.AffineTransform4f(mi.Matrix4f(*lines, [0, 0, 0, 1])),
            "sheet.bsdf.alpha.value": unknowns["roughness"],
            "sheet.bsdf.specular_reflectance.value": mi.Color3f(unknowns["tint"]),
        }
        self.params.update(changed)


@dataclass(frozen=True)
class Case:
    """A scene and its unknowns."""

    stage: type[Stage]
    true: Unknowns
    start: Unknowns
    spp: int  # paths per pixel, of an iteration


CASES = {
    "objects": Case(
        Objects,
        ObjectUnknowns(
            [0.05, 0.05, 0], [0, 0, -12], [10, -20, 30], [0.75, 0.2, 0.1], [1, 0.9, 0.7]
        ),
        ObjectUnknowns([-0.15, 0.2, 0.1], [5, -8, 3], [-10, 5, 0], [0.4] * 3, [0.6] * 3),
        spp=8,
    ),
    "mirror": Case(
        Mirror,
        MirrorUnknowns([0.8, -0.5916, 0.1], [0.06], [0.95, 0.8, 0.5]),
        MirrorUnknowns([0.7, -0.7, -0.05], [0.3], [0.6] * 3),
        spp=2,
    ),
}


def load(path: Path) -> Gaussians:
    """A fitted model (numpy), moved and scaled to stand around the origin with radius 1."""
    gaussians = Gaussians.load(own_gaussians(path) if path.is_dir() else path)
    orbit = orbit_of_gaussians(gaussians, np.array([0.0, 0.0, 1.0]), FIELD_OF_VIEW)
    radius = orbit.radius * np.sin(np.radians(FIELD_OF_VIEW / 2))
    return Similarity(1 / radius, np.eye(3), -orbit.focus / radius).of_gaussians(gaussians)


def rows(columns: Any) -> mi.TensorXf:
    """A tensor (N, number of columns)."""
    return mi.TensorXf(interleave(list(columns)), (dr.width(columns), len(columns)))


def sh_rotation(rotation: mi.Matrix3f, degree: int) -> mi.TensorXf:
    """(K - 1, K - 1): D with c' = D c, the coefficients above degree 0 of a model that is turned.

    What was seen in R^T d is then seen in d. Enough directions d determine D: Y(d) D = Y(R^T d).
    ``drgs.gaussians.rotation`` does the same on the host; here it is differentiated.
    """
    directions = np.random.default_rng(0).normal(0, 1, (64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    inverse = np.linalg.pinv(reference.sh_basis(directions, degree)[:, 1:])
    before = sh_basis(rotation.T @ mi.Vector3f(directions.T), degree)[1:]
    return mi.TensorXf(inverse.astype(np.float32)) @ rows(before)


def camera(size: int) -> dict[str, Any]:
    """For ``mi.load_dict``; size: px, of the image's sides."""
    to_world = mi.ScalarTransform4f().look_at([1.1, -2.7, 1.3], [0, 0, -0.05], [0, 0, 1])
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb"}
    film["rfilter"] = {"type": "box"}
    sampler = {"type": "independent", "sample_count": 1}
    sensor = {"type": "perspective", "fov": FIELD_OF_VIEW, "to_world": to_world}
    return sensor | {"film": film, "sampler": sampler}


def rgb(value: list[float]) -> dict[str, Any]:
    """A colour, as scene descriptions have it."""
    return {"type": "rgb", "value": value}


def waves() -> mi.TensorXf:
    """A texture (H, W, 3) for a sphere: smooth and without seams, so that turning it is smooth."""
    theta, phi = np.mgrid[0.5:64, 0.5:128] * np.pi / 64
    axes = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    basis = reference.sh_basis(np.stack(axes, axis=-1).reshape(-1, 3), 2)
    values = basis @ np.random.default_rng(1).normal(0, 1, (9, 3))
    return mi.TensorXf((0.5 + 0.4 * np.sin(2 * values)).reshape(64, 128, 3).astype(np.float32))


# ----------------------------------------------------------------------------------------------
# What is written
# ----------------------------------------------------------------------------------------------


def encoded(image: mi.TensorXf) -> np.ndarray:
    """(H, W, 3) in display space."""
    return np.array(mi.math.linear_to_srgb(dr.detach(image.array))).reshape(image.shape)


def write(
    out: Path,
    images: dict[str, np.ndarray],
    frames: list[np.ndarray],
    losses: list[float],
    values: list[Unknowns],
) -> None:
    """Images, an animation, the losses, and a table of the true, first and found values."""
    target = images["target"]
    images["difference"] = 0.5 + 5 * (images["end"] - target)
    for name, rendered in images.items():
        write_png(out / f"{name}.png", rendered)
    write_animation(out / "relight.webp", [np.hstack([frame, target]) for frame in frames])
    figure = new_figure(5, 3)
    axes = figure.add_subplot()
    axes.semilogy(losses)
    axes.set(xlabel="iteration", ylabel="loss")
    write_figure(out / "loss.png", figure)
    lines = [
        [title, *(", ".join(f"{x:.3f}" for x in getattr(u, name)) for u in values)]
        for name, title in values[0].TITLES.items()
    ]
    table = markdown_table(["", "true", "start", "found"], lines)
    with atomic_path(out / "parameters.md") as temporary:
        temporary.write_text(table + "\n")
    print(f"{table}\nwritten: {out}")


if __name__ == "__main__":
    main()
