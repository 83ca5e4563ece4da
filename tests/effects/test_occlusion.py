"""Splats before and behind a surface: the laws, with planes of the float64 reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from drjit.llvm import ad as llvm
from support.cases import edges, reference_camera, stacked
from support.helpers import NEAR_THRESHOLD, single
from support.reference_effects import render_with_surfaces

from drgs.core.arrays import from_host
from drgs.effects.occlusion import OccludedFeatures, Surface
from drgs.reference import splatting as reference
from drgs.splatting import order, rendering
from drgs.splatting.grid import TileGrid
from drgs.testing import LAWS, Case, image_equals_reference


def occluded_planes(case, values) -> tuple[np.ndarray, np.ndarray]:
    """(7, H W): the splats' own transmittance, color, depth, weights in front of each surface."""
    gaussians, camera = reference.Gaussians(**values), reference_camera(case)
    rendered = render_with_surfaces(gaussians, camera, case.surfaces)
    plain = reference.render(gaussians, camera, threshold_width=NEAR_THRESHOLD)
    planes = [plain.transmittance, *np.moveaxis(rendered.color, -1, 0), rendered.depth]
    planes = np.reshape([*planes, *(1 - rendered.before)], (len(planes) + len(case.surfaces), -1))
    return planes, plain.near_threshold.ravel()


@dataclass(frozen=True, eq=False)
class OccludedCase(Case):
    """A case with surfaces amid its splats."""

    given: tuple | None = None  # depths (H, W) and alphas of the surfaces; None: two

    @property
    def surfaces(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        """Two surfaces' depths (H, W) amid the splats, no one's, and alphas: 0, 1 and between."""
        if self.given is not None:
            return self.given
        rng, shape = np.random.default_rng(2), (self.height, self.width)
        splats = reference.project(reference.Gaussians(**self.values), reference_camera(self))
        depths = np.sort(splats.depths[splats.visible])
        gaps, near, surfaces = (depths[1:] + depths[:-1]) / 2, 0.0, []
        for first in (len(gaps) // 8, len(gaps) // 2):
            near = np.maximum(single(rng.choice(gaps[first:], shape)), near)
            surfaces.append((near, rng.choice([0.0, 0.25, 0.625, 1.0], shape)))
        return tuple(surfaces)

    def frames(self, values, Float=llvm.Float64):
        """With the part of all light that each surface stops, in place of its alpha."""
        gaussians, (frame,) = super().frames(values, Float)
        surfaces, rest = [], 1.0
        for z, alpha in self.surfaces:
            stopped = (from_host(Float, plane.ravel()) for plane in (z, rest * alpha))
            surfaces.append(Surface(*stopped))
            rest = rest * (1 - alpha)
        pipeline, grid = frame.pipeline, TileGrid(self.width, self.height)
        features = OccludedFeatures(pipeline.model.features, tuple(surfaces), grid)
        pipeline = replace(
            pipeline,
            model=replace(pipeline.model, features=features),
            features=(*pipeline.features, rendering.depth_feature),
        )
        return gaussians, [rendering.render(gaussians, frame.camera, pipeline)]


occluded = partial(OccludedCase, reference=occluded_planes, image_tolerance=1e-12)
CASES = [
    occluded("scattered", scene=edges, degree=2, count=60, single_tolerance=2e-5),
    occluded("stacked", scene=stacked, count=24),
    occluded("one pixel", scene=edges, width=1, height=1, count=12),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.parametrize(
    "law",
    [
        pytest.param(law, marks=[] if law is image_equals_reference else pytest.mark.slow)
        for law in LAWS
    ],
    ids=lambda law: law.__name__,
)
def test_law_holds(case, law):
    law(case)


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
def test_surface_occludes_each_group_of_features(monkeypatch, law):
    """Two planes at a time, and the weights in front with each."""
    monkeypatch.setitem(order.FEATURES_AT_ONCE, 8, 2)
    law(replace(CASES[0]))


@pytest.mark.parametrize("approximations", [{"sh_direction": "pixel"}, {"order": "pixel"}], ids=str)
def test_approximated_planes_are_linear_in_coverage(approximations):
    """Linear in the coverage: of nothing and of all; the sum in front does not depend on it."""
    case = replace(CASES[0], approximations=approximations)
    z, coverage = case.surfaces[0]
    nothing, everything, part = (
        replace(case, given=((z, amount),)).planes(case.values)
        for amount in (0 * coverage, 0 * coverage + 1, coverage)
    )
    c = coverage.ravel()
    np.testing.assert_allclose(part, (1 - c) * nothing + c * everything, atol=1e-12)
    without = Case("plain", scene=edges, degree=2, count=60, approximations=approximations)
    without = replace(without, reference=occluded_planes).planes(case.values)
    np.testing.assert_allclose(nothing[:-1], without, atol=1e-12)
    assert np.abs(everything[1:4] - nothing[1:4]).max() > 0.1
    np.testing.assert_array_equal(part[-1], nothing[-1])
