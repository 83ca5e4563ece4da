"""Measure the errors of single precision, and find their causes.

Four families of scenes become harder step by step. Each step compares the float32 kernels with the
float64 reference, and their error with the *noise*: the change of the reference's result when every
input is perturbed by one rounding of single precision. An error that grows faster than this
conditioning is the kernels' own. Pixels near a threshold (cut, clamp, stop), which the reference
marks, are excluded.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)
import drjit.llvm.ad as llvm
import numpy as np
from drgs.bench.output import columns_table, machine, write_rows
from drgs.bench.scenes import device_camera
from drgs.core.types import Float
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.io.figures import new_figure, write_figure
from drgs.reference import splatting as reference
from drgs.splatting import rendering

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT, FOCAL = 48, 40, 60.0  # px
NUM_GAUSSIANS = 60  # except in stacks
UNIT_ROUNDOFF = 2.0**-24
THRESHOLD_WIDTH = 3e-3  # relative distance from a threshold within which pixels are excluded

Scene = tuple[reference.Gaussians, reference.Camera]


@dataclass(frozen=True)
class Sweep:
    """A family of scenes with one parameter of difficulty."""

    name: str
    axis: str
    values: tuple[float, ...]
    scene: Callable[[float], Scene]  # float64, not rounded


@dataclass(frozen=True)
class StabilityMeasurement:
    """Errors at one step of a sweep, relative to each array's largest value."""

    sweep: str
    value: float
    image: float  # largest error of any pixel
    image_noise: float
    gradient: float  # largest error of any derivative, over the five parameters
    gradient_noise: float
    storage: float  # largest change of any pixel by storing the scene in float32
    left_out: float  # fraction of the pixels


ERRORS = [
    ("image", "{.image:.1e}"),
    ("its noise", "{.image_noise:.1e}"),
    ("gradients", "{.gradient:.1e}"),
    ("their noise", "{.gradient_noise:.1e}"),
    ("stored in float32", "{.storage:.1e}"),
]


def main() -> None:
    """Measure all sweeps; print tables, write CSV and plot."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer steps and samples")
    parser.add_argument("--out", type=Path, default=Path("out/studies/stability"), metavar="DIR")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    samples = 4 if args.quick else 12
    results = []
    print(f"float32 kernels against the float64 reference; {machine()}")
    for sweep in sweeps():
        values = sweep.values[:: 3 if args.quick else 1]
        steps = [measure(sweep, value, samples) for value in values]
        columns = [(sweep.axis, "{.value:g}"), *ERRORS]
        print(f"\n{sweep.name}\n{columns_table(columns, steps)}", flush=True)
        results += steps
    write_rows(args.out / "stability.csv", StabilityMeasurement, results)
    write_figure(args.out / "stability.png", plot(results))


def sweeps() -> list[Sweep]:
    """Return the four families."""
    return [
        Sweep("Stack depth", "layers", (1, 3, 10, 30, 100, 300, 1000), _stack),
        Sweep("Anisotropy", "times longer than wide", (2, *_decades(1, 8)), _needles),
        Sweep("Distance", "times as far as the scene is deep", _decades(0, 6), _distant),
        Sweep("Coordinate offset", "scene units from the origin", _decades(0, 6), _offset),
    ]


def _decades(first: int, last: int) -> tuple[float, ...]:
    return tuple(10.0**k for k in range(first, last + 1))


def _camera(center: np.ndarray) -> reference.Camera:
    """Return a camera rotated about all axes, so that no coordinate is exact by chance."""
    rotation = reference.quat_to_rotation(np.array([[0.9, 0.2, -0.3, 0.1]]))[0]
    intrinsics = FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT
    return reference.Camera(rotation, center, *intrinsics)


def _gaussians(
    camera: reference.Camera,
    film: np.ndarray,
    z: np.ndarray,
    sizes: np.ndarray,
    logit_opacities: np.ndarray,
) -> reference.Gaussians:
    """Return Gaussians at film positions (N, 2) px and depths z (N,); sizes: (N, 3), px."""
    rng = np.random.default_rng(1)
    count = len(z)
    slopes = (film - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points = np.column_stack([slopes * z[:, None], z])
    return reference.Gaussians(
        means=points @ camera.rotation + camera.center,
        quats=rng.normal(size=(count, 4)),
        log_scales=np.log(sizes * z[:, None] / camera.fx),
        logit_opacities=logit_opacities,
        sh0=rng.normal(0, 1, (count, 1, 3)),
        shN=rng.normal(0, 0.2, (count, 3, 3)),
    )


def _ordinary(camera: reference.Camera, near: float, far: float) -> reference.Gaussians:
    rng = np.random.default_rng(2)
    return _gaussians(
        camera,
        rng.uniform(0, 1, (NUM_GAUSSIANS, 2)) * [WIDTH, HEIGHT],
        rng.uniform(near, far, NUM_GAUSSIANS),
        rng.uniform(1, 6, (NUM_GAUSSIANS, 3)),
        rng.normal(0, 1, NUM_GAUSSIANS),
    )


def _stack(layers: float) -> Scene:
    """Large splats behind each other, faint enough that all of them are seen."""
    rng = np.random.default_rng(3)
    camera, count = _camera(np.zeros(3)), int(layers)
    alpha = np.clip(4.0 / count, 1.2 / 255, 0.6)
    gaussians = _gaussians(
        camera,
        rng.normal([WIDTH / 2, HEIGHT / 2], 4, (count, 2)),
        np.sort(rng.uniform(1, 4, count)),
        rng.uniform(100, 200, (count, 3)),
        np.full(count, np.log(alpha / (1 - alpha))),
    )
    return gaussians, camera


def _needles(ratio: float) -> Scene:
    """Needles: the longest axis has 8 px, the others are ``ratio`` times shorter."""
    rng = np.random.default_rng(4)
    camera = _camera(np.zeros(3))
    gaussians = _gaussians(
        camera,
        rng.uniform(0, 1, (NUM_GAUSSIANS, 2)) * [WIDTH, HEIGHT],
        rng.uniform(1, 4, NUM_GAUSSIANS),
        8 * np.array([[1, 1 / ratio, 1 / ratio]] * NUM_GAUSSIANS),
        rng.normal(1, 1, NUM_GAUSSIANS),
    )
    return gaussians, camera


def _distant(distance: float) -> Scene:
    """Return a scene one unit deep, with a focal length that keeps its projected size."""
    camera = replace(_camera(np.zeros(3)), fx=FOCAL * distance, fy=FOCAL * distance)
    return _ordinary(camera, distance, distance + 1), camera


def _offset(offset: float) -> Scene:
    """Return scene and camera, translated together."""
    camera = _camera(offset * np.array([1.0, -0.7, 0.4]))
    return _ordinary(camera, 1, 4), camera


def measure(sweep: Sweep, value: float, samples: int) -> StabilityMeasurement:
    """Measure errors and noise of one scene; kernels and reference have the same rounded input."""
    exact = sweep.scene(value)
    gaussians, camera = _round_to_single(*exact)
    rendered = reference.render(gaussians, camera, threshold_width=THRESHOLD_WIDTH)
    kept = ~rendered.near_threshold
    cotangent = np.random.default_rng(5).normal(size=rendered.image.shape) * kept[..., None]
    image, gradients = _by_reference(gaussians, camera, cotangent)
    image32, gradients32 = _by_kernels(gaussians, camera, cotangent)

    def image_error(other: np.ndarray) -> float:
        return np.abs(other - image)[kept].max(initial=0) / np.abs(image).max()

    def gradient_error(other: dict[str, np.ndarray]) -> float:
        return max(
            np.abs(other[name] - exact_one).max() / np.abs(exact_one).max()
            for name, exact_one in gradients.items()
        )

    errors = []
    for sample in range(samples):
        perturbed = _by_reference(*_perturb(gaussians, camera, sample), cotangent)
        errors.append([image_error(perturbed[0]), gradient_error(perturbed[1])])
    image_noise, gradient_noise = np.sqrt(np.mean(np.square(errors), axis=0)).tolist()
    return StabilityMeasurement(
        sweep=sweep.name,
        value=value,
        image=image_error(image32),
        image_noise=image_noise,
        gradient=gradient_error(gradients32),
        gradient_noise=gradient_noise,
        storage=image_error(_by_reference(*exact, cotangent)[0]),
        left_out=float(np.mean(~kept)),
    )


def _round_to_single(gaussians: reference.Gaussians, camera: reference.Camera) -> Scene:
    """Round a scene to single precision."""

    def single(values: np.ndarray) -> np.ndarray:
        return np.asarray(values, dtype=np.float32).astype(np.float64)

    fields = {name: single(getattr(gaussians, name)) for name in PARAMETER_NAMES}
    camera = replace(camera, rotation=single(camera.rotation), center=single(camera.center))
    return reference.Gaussians(**fields), camera


def _perturb(gaussians: reference.Gaussians, camera: reference.Camera, seed: int) -> Scene:
    """Perturb every number by up to one rounding; means relative to the camera."""
    rng = np.random.default_rng([6, seed])

    def perturb(values: np.ndarray) -> np.ndarray:
        values = np.asarray(values)
        return values * (1 + UNIT_ROUNDOFF * rng.uniform(-1, 1, values.shape))

    fields = {name: perturb(getattr(gaussians, name)) for name in PARAMETER_NAMES}
    fields["means"] = camera.center + perturb(gaussians.means - camera.center)
    numbers = {name: float(perturb(getattr(camera, name))) for name in ("fx", "fy", "cx", "cy")}
    camera = replace(camera, rotation=perturb(camera.rotation), **numbers)
    return reference.Gaussians(**fields), camera


def _by_reference(
    gaussians: reference.Gaussians, camera: reference.Camera, cotangent: np.ndarray
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    image = reference.render(gaussians, camera).image
    gradients = reference.render_gradients(gaussians, camera, np.zeros(3), cotangent)
    return image, {name: gradients[name] for name in PARAMETER_NAMES}


def _by_kernels(
    gaussians: reference.Gaussians, camera: reference.Camera, cotangent: np.ndarray
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    fields = {name: getattr(gaussians, name) for name in PARAMETER_NAMES}
    device = Gaussians(**fields).to(llvm.TensorXf)
    pipeline = rendering.Pipeline(gaussians.sh_degree)
    frame = rendering.render(device, device_camera(camera, llvm.Float), pipeline)
    _, *color = frame.planes()
    image = np.stack([np.array(plane).reshape(HEIGHT, WIDTH) for plane in color], axis=-1)
    float_type = cast("type[Float]", llvm.Float)
    planes = [float_type(np.ascontiguousarray(w, np.float32)) for w in cotangent.reshape(-1, 3).T]
    nothing = float_type(np.zeros(HEIGHT * WIDTH, np.float32))
    gradients = rendering.frames_adjoint(device, [frame], [[nothing, *planes]]).parameters
    return image, {name: np.array(getattr(gradients, name)) for name in PARAMETER_NAMES}


def plot(results: Sequence[StabilityMeasurement]) -> Figure:
    """Plot a panel per sweep: errors as lines, their noise dashed in the same colour."""
    figure = new_figure(11, 6)
    axes = figure.subplots(2, 2, sharey=True).ravel()
    for panel, sweep in zip(axes, sweeps(), strict=True):
        steps = [m for m in results if m.sweep == sweep.name]
        x = [m.value for m in steps]
        for color, what, label in (
            ("tab:blue", "image", "image"),
            ("tab:orange", "gradient", "gradients"),
        ):
            panel.loglog(x, [getattr(m, what) for m in steps], "o-", color=color, label=label)
            noise = [getattr(m, f"{what}_noise") for m in steps]
            panel.loglog(x, noise, "--", color=color, label=f"{label}: one rounding of the inputs")
        storage = [m.storage for m in steps]
        panel.loglog(x, storage, ":", color="0.4", label="image: scene stored in float32")
        panel.set(title=sweep.name, xlabel=sweep.axis)
        panel.grid(alpha=0.3)
    for panel in axes[::2]:
        panel.set_ylabel("error / largest value")
    axes[0].legend(fontsize=8)
    figure.suptitle("float32 kernels against the float64 reference")
    return figure


if __name__ == "__main__":
    main()
