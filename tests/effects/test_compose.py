"""One place puts effects into a pipeline; whoever renders does not ask for them."""

from dataclasses import replace

import drjit.llvm.ad as llvm
import pytest
from support.helpers import FLOAT32, Case, device_camera, device_gaussians

from drgs.accuracy.exact import RayFalloff, exact_shape
from drgs.cameras.camera import Aperture
from drgs.effects.compose import with_effects, without_effects
from drgs.effects.defocus import Defocused, DimmedFalloff
from drgs.effects.smoothing import apply_smoothing
from drgs.splatting import rendering
from drgs.splatting.footprint import ImageModel

CASE = Case("compose", 16, 12, 0, count=12)
APERTURE = Aperture(llvm.Float(0.1), llvm.Float(2.0))


@pytest.fixture(scope="module")
def scene():
    return device_gaussians(CASE.gaussians, FLOAT32), device_camera(CASE.camera, FLOAT32)


def test_unused_effect_leaves_pipeline_unchanged(scene):
    gaussians, camera = scene
    pipeline = rendering.Pipeline(0)
    assert with_effects(pipeline, gaussians, camera) is pipeline


def test_aperture_wraps_projection_and_falloff(scene):
    gaussians, camera = scene
    pipeline = rendering.Pipeline(0, shape=exact_shape, model=ImageModel(falloff=RayFalloff()))
    found = with_effects(pipeline, gaussians, replace(camera, aperture=APERTURE))
    assert found.shape == Defocused(exact_shape)
    assert found.model.falloff == DimmedFalloff(RayFalloff())
    assert replace(found, shape=exact_shape, model=pipeline.model) == pipeline


def test_filter_changes_the_gaussians_before_projection(scene):
    gaussians, camera = scene
    filtered = replace(gaussians, smoothing=llvm.Float(0.1) + 0 * gaussians.logit_opacities)
    pipeline = rendering.Pipeline(0)
    assert with_effects(pipeline, filtered, camera) == replace(pipeline, rows=apply_smoothing)


def test_ignored_effect_is_not_composed(scene):
    gaussians, camera = scene
    pipeline = rendering.Pipeline(0)
    blurred = replace(camera, aperture=APERTURE)
    assert with_effects(pipeline, gaussians, without_effects(blurred, ["motion"])) != pipeline
    assert with_effects(pipeline, gaussians, without_effects(blurred, ["defocus"])) is pipeline
