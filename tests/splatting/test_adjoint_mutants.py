"""Mutation check: which tests notice a mistake in a hand-written derivative.

Every partial derivative in the source of the adjoints and tangents is scaled by 1.01 and, on its
own, changes its sign; every decision that they replay is dropped, or taken the other way where
two numbers are equal. ``mutants`` makes the mutants. The detectors are checks of the suite, run on
small scenes in double precision: each mutant must be noticed by one of them. Those for hard cases
are asked about the mutants that the others do not notice.

Where Dr.Jit differentiates (projection, spherical harmonics), mutants are what it is given and
what it returns.

``pytest -m slow -n 0 -s`` shows who noticed what.
"""

from __future__ import annotations

import textwrap
from dataclasses import replace
from functools import cache, partial

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float64
from support import compositing_checks, helpers, loss_checks, rendering_checks
from support.detectors import MutationChecks, detectors, find_noticed
from support.helpers import (
    FLOAT64,
    Case,
    Cotangents,
    bitwise,
    clear,
    device_camera,
    device_gaussians,
    kernel_gradients,
    plane_cotangents,
    rows,
    single,
    stacked_scene,
)
from support.instrumented import Instrumented
from support.mutants import ALWAYS, AT_EQUALITY, NEGATED, NEVER, SCALED, Switchboard

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import footprint, rasterize, reduction, rendering
from drgs.splatting.cutoffs import Cutoffs
from drgs.training import losses

CHAIN = ("frames_adjoint", "frames_tangent")

STAGES = ("composite_adjoint", "composite_tangent")

RESPONSE_DERIVATIVES = ("moments", "derivatives", "pack_tangents", "tangent")

SUMS = ("CompositedPairs", "split_bands", "assign_slots", "sum_entries", "sum_runs")


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


def _mixed_scene(seed, width, height, degree, count):
    """Opaque splats behind each other, every other one a few pixels small: alphas are clamped and
    cut, and pixels stop. That it does all of this is what the mutants of these decisions prove.
    """
    gaussians, camera = stacked_scene(seed, width, height, degree, count)
    smaller = np.log(4) * (np.arange(count) % 2)
    return replace(gaussians, log_scales=single(gaussians.log_scales - smaller[:, None])), camera


# Two tiles, so that the sums over a splat's slots have several terms.
CASE = Case("mutants", 18, 9, 1, count=10, recipe=_mixed_scene)


class _EqualsThresholds(compositing_checks.FlatScene):
    """Splats whose opacity is the cut itself are not culled."""

    @property
    def visible(self) -> np.ndarray:
        return np.ones(len(self.opacities), dtype=bool)


def _scene_at_thresholds() -> _EqualsThresholds:
    """In the middle pixel alpha equals the cut, then the clamp, and T the stop: 3/4 3/8 3/4."""
    scene = compositing_checks.stack([0.25, 0.5, 0.25, 0.25], 3, 1, 2.0)
    cutoffs = Cutoffs(**{name.lower(): value for name, value in THRESHOLDS.items()})
    return _EqualsThresholds(**{**vars(scene), "cutoffs": cutoffs})


THRESHOLDS = {"ALPHA_CUT": 0.25, "ALPHA_MAX": 0.5, "TRANSMITTANCE_STOP": 0.75 * 0.5 * 0.75}


def _flat_scene() -> compositing_checks.FlatScene:
    """One splat's opacity is zero."""
    scene = compositing_checks.random_flat_scene(13, 11, 12, 4, opaque=True)
    return replace(scene, opacities=scene.opacities * (np.arange(12) != 5))


def _check_row_that_is_not_finite(case):
    """Its gradient is zero and the others' are the same: as in test_rendering, in double
    precision and with the features of the other detectors, whose kernels this uses.
    """
    names = PARAMETER_NAMES
    values = {name: getattr(case.gaussians, name) for name in names}
    values = {name: np.concatenate([v, np.full_like(v[:1], np.nan)]) for name, v in values.items()}
    gaussians = device_gaussians(reference.Gaussians(**values), FLOAT64)
    frame = rendering.render(gaussians, device_camera(case.camera, FLOAT64), case.pipeline)
    cotangents = Cotangents.random(case)
    d_features, d_transmittance = plane_cotangents(case, cotangents, FLOAT64)
    found = rendering.frames_adjoint(
        gaussians, [frame], [[d_transmittance, *d_features]], of_camera=True
    )
    assert np.isfinite(rows(found.camera)).all()
    gradients = found.parameters.numpy()
    expected = kernel_gradients(case, FLOAT64, cotangents)
    for name in names:
        np.testing.assert_array_equal(getattr(gradients, name)[:-1], expected[name], name)
        assert np.all(getattr(gradients, name)[-1] == 0), name


@cache
def _loss_and_gradient(height, width, weight):
    """Return two images, the loss and its gradient by central differences of the naive formula."""
    x, y = loss_checks.images(height, width, seed=1)
    gradient, step = np.empty_like(x), 1e-5
    assert np.abs(x - y).min() > step  # |x - y| has a kink
    for index in np.ndindex(x.shape):
        moved = np.zeros_like(x)
        moved[index] = step
        ends = [loss_checks.reference(x + sign * moved, y, weight) for sign in (1, -1)]
        gradient[index] = (ends[0] - ends[1]) / (2 * step)
    return x, y, loss_checks.reference(x, y, weight), gradient


def _check_loss_and_gradient():
    x, y, expected_loss, expected_gradient = _loss_and_gradient(9, 3, 0.2)
    loss, gradient = loss_checks.value_and_gradient(x, y, 0.2)
    # Tolerances of test_losses.
    assert loss == pytest.approx(expected_loss, rel=1e-12)
    np.testing.assert_allclose(gradient, expected_gradient, rtol=1e-5, atol=2e-11)


# ----------------------------------------------------------------------------------------------
# Detectors
# ----------------------------------------------------------------------------------------------


def _detectors(at_thresholds):
    """Return the detectors of all partials, and those of hard cases for mutants that these miss."""
    case, flat, equal = clear(CASE), _flat_scene(), _scene_at_thresholds()
    chain, stage, loss = rendering_checks, compositing_checks, loss_checks

    general = {
        "gradients": partial(chain.check_gradients_equal_the_reference, FLOAT64, case),
        "transpose": partial(chain.check_adjoint_is_the_transpose_of_the_tangent, FLOAT64, case),
        "tangents": partial(
            chain.check_tangent_equals_central_differences_of_the_reference, FLOAT64, case
        ),
        "camera gradients": partial(
            chain.check_camera_gradients_of_two_frames_equal_differences_of_the_reference, case
        ),
        "camera tangents": partial(
            chain.check_camera_tangents_of_two_frames_equal_differences_of_the_reference, case
        ),
        "loss": _check_loss_and_gradient,
    }
    special = {
        "not finite": partial(_check_row_that_is_not_finite, case),
        "zero opacity": partial(stage.check_gradients_equal_the_reference, FLOAT64, flat),
        "thresholds": at_thresholds(
            partial(stage.check_gradients_equal_the_reference, FLOAT64, equal)
        ),
        "thresholds transpose": at_thresholds(
            partial(stage.check_adjoint_is_the_transpose_of_the_tangent, FLOAT64, equal)
        ),
        "loss transpose": loss.check_gradient_is_the_transpose_of_the_tangent,
        "loss at equality": loss.check_l1_gradient_is_the_sign_and_zero_at_equality,
        "squared error": partial(
            loss.check_squared_error_is_the_mean_over_pixels_and_channels, 0.2
        ),
        "squared error of L1": partial(
            loss.check_squared_error_is_the_mean_over_pixels_and_channels, 0
        ),
        "loss overexposed": loss.check_overexposed_images_do_not_blow_up_the_gradient,
    }
    return detectors(general), detectors(special)


@pytest.fixture(scope="module")
def outcome():
    board = Switchboard()
    sums = Instrumented(
        board, reduction, derivatives=["CompositedPairs.find", *SUMS[1:]], forward=[]
    )
    kernels = Instrumented(
        board,
        rasterize,
        derivatives=["composite_adjoint", "composite_tangent"],
        forward=["composite", "Records.from_ranks", "Layers.planes"],
        **{name: sums[name] for name in SUMS},
    )
    chain = Instrumented(
        board,
        rendering,
        derivatives=[*CHAIN, "Projected.gradients"],
        forward=["render", "Frame.planes", "Projected.footprints"],
    )
    model = Instrumented(
        board,
        footprint,
        derivatives=[
            "FootprintModel.footprint",
            "FootprintModel.alphas",
            *(f"GaussianFalloff.{name}" for name in RESPONSE_DERIVATIVES),
            *(f"PixelCenters.{name}" for name in ("sum", "sum_dx", "sum_dy", "sum_dy_dy")),
            *(f"SplatFeatures.{name}" for name in ("add_derivatives", "tangents")),
        ],
        forward=["FootprintModel.footprint", "FootprintModel.alphas"],
    )

    def on_instrumented_model(name):
        def run(bins, *arguments):
            copy = model["FootprintModel"](cutoffs=bins.model.cutoffs)
            return kernels[name](replace(bins, model=copy), *arguments)

        return run

    stages = {name: on_instrumented_model(name) for name in STAGES}
    # All of the loss: its forward pass evaluates the partial derivatives, too.
    loss = Instrumented(
        board,
        losses,
        derivatives=["PhotometricLoss.__call__", "l1_loss"],
        forward=["prepare_target", "Target.image"],
    )

    def at_thresholds(check):
        def run():
            with pytest.MonkeyPatch.context() as patch:
                for name, value in THRESHOLDS.items():
                    patch.setattr(reference, name, value)
                check()

        return run

    with pytest.MonkeyPatch.context() as patch:
        for module, names, copy in (
            (rendering, CHAIN, chain),
            (compositing_checks, STAGES, stages),
            (rendering, STAGES, stages),
            (loss_checks, ("PhotometricLoss", "l1_loss"), loss),
        ):
            for name in names:
                patch.setattr(module, name, copy[name])
        # Frames of the forward pass, which is not the copy's, go back through this.
        patch.setattr(rendering.Projected, "gradients", chain["Projected"].gradients)
        # The forward pass is the same for all mutants.
        for module in (helpers, rendering_checks):
            patch.setattr(module, "render", cache(helpers.render))
        for name in ("kernel_gradients", "kernel_tangent"):
            function = getattr(rendering_checks, name)
            patch.setattr(rendering_checks, name, _memoized(board, function))
        general, special = _detectors(at_thresholds)
        result = find_noticed(board, general, special)
    return result


def _memoized(board, function):
    """``function(case, precision, weights)``, whose results without a mutant are remembered for
    the mutants that it does not read.
    """
    results = {}

    def call(case, precision, weights):
        key = case, *bitwise(vars(weights))
        if board.applied is None:
            results[key] = board.record(partial(function, case, precision, weights))
        result, reached = results[key]
        if board.applied is not None and board.applied.switch in reached:
            return function(case, precision, weights)
        return result

    return call


# ----------------------------------------------------------------------------------------------
# Tests
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
class TestDefault(MutationChecks):
    derivatives = """
        rasterize._partials rasterize._adjoint_step reduction.sum_entries reduction.sum_runs
        rasterize.composite_tangent rasterize.pack_tangents footprint.GaussianFalloff.moments
        footprint.GaussianFalloff.derivatives footprint.GaussianFalloff.tangent
        footprint.GaussianFalloff.pack_tangents footprint.SplatFeatures.add_derivatives
        footprint.PixelCenters.sum_dx rendering._splat_tangents
        rendering.gradients_of rendering._back_to_rows
        rendering.gradients_by_row rendering._as_tensors
        losses._ssim_and_partials losses._assemble_gradient losses._PhotometricOp.backward
        losses._PhotometricOp.forward losses.l1_loss
    """
    elsewhere = {
        f"losses.Loss.with_squared_error{site}": "test_extensions: a loss from outside"
        for site in (
            "error = dr.mean(dr.square(dr.detach(image).array - target.image.array))",
            "term dr.detach(image).array of dr.detach(image).array - target.image.array",
            "term target.image.array of dr.detach(image).array - target.image.array",
            "self(image, target)",
        )
    } | {
        site: "test_placement: a smoothing filter that grows with an object"
        for site in (
            "rendering.Pipeline.select_differentiable"
            "return rows if self.of_smoothing else replace(rows, smoothing=None)",
            "rendering._columns_ofd_rows.smoothing",
        )
    }


# ----------------------------------------------------------------------------------------------
# The mutants themselves
# ----------------------------------------------------------------------------------------------

SAMPLE = """
import drjit as dr

def forward(x, y):
    return dr.select(x < y, x * y, 0)

def adjoint(x, y, g):
    below = x < y
    zero = type(x)(0)
    d_x = dr.select(below, g * y, zero)
    partials = [d_x, 1 - g * x]
    return partials
"""


def sample_mutants(source):
    """{(source, change): what the adjoint then returns} at x = 2, y = 3, g = 5."""
    board = Switchboard()
    adjoint = Instrumented(board, source, ["adjoint"], ["forward"])["adjoint"]
    arguments = Float64(2), Float64(3), Float64(5)

    def result():
        return [value[0] for value in adjoint(*arguments)]

    assert result() == [15, -9]
    results = {}
    for mutant in board.mutants:
        board.apply(mutant)
        results[mutant.site.text, mutant.change] = result()
    board.apply(None)
    assert result() == [15, -9]
    return results


def test_mutants_compute_their_described_change():
    expected = {
        ("x < y", AT_EQUALITY): [15, -9],
        ("x < y", ALWAYS): [15, -9],
        ("x < y", NEVER): [0, -9],
        ("d_x = dr.select(below, g * y, zero)", SCALED): [15.15, -9],
        ("d_x = dr.select(below, g * y, zero)", NEGATED): [-15, -9],
        ("dr.select(below, g * y, zero)", ALWAYS): [15, -9],
        ("dr.select(below, g * y, zero)", NEVER): [0, -9],
        ("d_x", SCALED): [15.15, -9],
        ("d_x", NEGATED): [-15, -9],
        ("term 1 of 1 - g * x", SCALED): [15, -8.99],
        ("term 1 of 1 - g * x", NEGATED): [15, -11],
        ("term g * x of 1 - g * x", SCALED): [15, -9.1],
        ("term g * x of 1 - g * x", NEGATED): [15, 11],
    }
    assert sample_mutants(SAMPLE) == {key: pytest.approx(value) for key, value in expected.items()}


def test_added_partial_has_mutants():
    added = SAMPLE.replace("1 - g * x]", "dr.fma(g, -x, 2 - x / x)]")
    texts = {text for text, _ in set(sample_mutants(added)) - set(sample_mutants(SAMPLE))}
    assert texts == {
        "term g of dr.fma(g, -x, 2 - x / x)",
        "term 2 of 2 - x / x",
        "term x / x of 2 - x / x",
    }


def test_mutants_compile_no_kernel():
    board = Switchboard()
    adjoint = Instrumented(board, SAMPLE, ["adjoint"], ["forward"])["adjoint"]
    arguments = [dr.opaque(Float64, value, 4) for value in (2, 3, 5)]

    def kernels():
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(adjoint(*arguments))
            return [kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])]

    first = kernels()
    assert first
    for mutant in board.mutants:
        board.apply(mutant)
        assert kernels() == first, textwrap.shorten(str(mutant), 80)
