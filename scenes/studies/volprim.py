"""Compare the approximations of Mitsuba's ``volprim_rf_basic`` with those of 3DGS, one by one.

The float64 numpy reference makes that integrator's choices: splats are evaluated along each pixel's
ray, end at 3 standard deviations, are ordered by where the ray enters them, and those that are
entered within 1e-4 behind an entry are passed over; there is no low-pass and no smallest alpha; a
pixel ends behind the splat that takes its transmittance below 0.01. Then one choice at a time is
replaced by that of 3DGS.

How closely the two can agree depends on the scene's unit of length: where lengths are small or
large against that step, the integrator enters some splats twice. So the same scene is also measured
with all its lengths multiplied (by powers of two, so that all else is rounded alike).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drgs  # noqa: F401  (registers the integrator)
import mitsuba as mi
import numpy as np
import reference_rays
from accuracy import Subject, add_scene, load_subject
from drgs.bench.output import markdown_table
from drgs.bench.scenes import mitsuba_sensor
from drgs.bench.speed import SHELL_STDS, volprim_scene
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import splatting as reference
from drgs.results import metrics

VOLPRIM = reference_rays.ImageModel(
    projection="exact",
    order="entry",
    sh_direction="pixel",
    stop="after",
    alpha_max=0.9999,
    alpha_cut=0.0,
    transmittance_stop=0.01,
    extent=SHELL_STDS,
    step=1e-4,
    low_pass=0.0,
)

CHANGES: dict[str, dict[str, object]] = {
    "all of its choices": {},
    "no step behind an entry": {"step": 0.0},
    "a pixel ends at 1e-4, before the splat": {"stop": "before", "transmittance_stop": 1e-4},
    "alpha at most 0.99": {"alpha_max": reference.ALPHA_MAX},
    "alpha at least 1/255": {"alpha_cut": reference.ALPHA_CUT},
    "colours in the direction of the means": {"sh_direction": "mean"},
    "ordered by the peaks": {"order": "pixel", "step": 0.0},
    "ordered by the means": {"order": "center", "step": 0.0},
    "a low-pass of 0.3 px^2": {"low_pass": reference.LOW_PASS},
}

FACTORS = (1, 16, 64)
"""Factors of all lengths."""


@dataclass(frozen=True)
class Row:
    """The difference of two images."""

    factor: int  # by which all lengths are multiplied
    what: str
    psnr: float  # dB
    largest_error: float


def enlarge(subject: Subject, factor: int) -> Subject:
    """Multiply all lengths of the scene by ``factor``."""
    gaussians = subject.gaussians
    return replace(
        subject,
        gaussians=replace(
            gaussians,
            means=gaussians.means * np.float32(factor),
            log_scales=gaussians.log_scales + np.float32(np.log(factor)),
        ),
        cameras=[
            replace(c, center=c.center * factor, near=c.near * factor) for c in subject.cameras
        ],
    )


def compare(subject: Subject, factor: int) -> list[Row]:
    """Compare all changes of the reference with Mitsuba's image of the first view."""
    camera = subject.cameras[0]
    image = volprim_image(subject.gaussians, camera)
    gaussians = reference.Gaussians(
        **{name: getattr(subject.gaussians, name) for name in PARAMETER_NAMES}
    )
    rows = []
    for what, change in CHANGES.items():
        model = replace(VOLPRIM, **change)
        rendered = reference_rays.render(gaussians, camera, (0, 0, 0), model)
        rows.append(_row(factor, what, rendered.image, image))
    return rows


def _row(factor: int, what: str, image: np.ndarray, other: np.ndarray) -> Row:
    return Row(factor, what, metrics.psnr(image, other), float(np.abs(image - other).max()))


def volprim_image(gaussians: Gaussians, camera: reference.Camera) -> np.ndarray:
    """Render (H, W, 3), display space, on black, one sample at pixel centres; requires fx = fy."""
    sensor = mitsuba_sensor(camera) | {
        "near_clip": camera.near,
        "sampler": {"type": "stratified", "jitter": False, "sample_count": 1},
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
    }
    scene = mi.load_dict({**volprim_scene(gaussians, "ellipsoids", 4096), "sensor": sensor})
    return np.array(mi.render(scene, spp=1), np.float64)


def table(rows: Sequence[Row]) -> str:
    """Format the PSNR of each change, a column per factor."""
    factors = list(dict.fromkeys(row.factor for row in rows))
    header = ["PSNR against volprim_rf_basic", *(f"lengths x {factor}" for factor in factors)]
    lines = []
    for what in dict.fromkeys(row.what for row in rows):
        found = {row.factor: row.psnr for row in rows if row.what == what}
        lines.append([what, *(f"{found[factor]:.1f} dB" for factor in factors)])
    return markdown_table(header, lines)


def main() -> None:
    """Measure all changes at all scales."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_scene(parser)
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    subject = load_subject(Path(args.scene), 1)
    rows = [row for f in FACTORS for row in compare(enlarge(subject, f), f)]
    print(table(rows))


if __name__ == "__main__":
    main()
