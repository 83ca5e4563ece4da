"""Options add operations to their stage only; no kernel adds floats atomically."""

import drjit as dr
import drjit.llvm.ad as llvm
import mitsuba as mi
import pytest
from support.helpers import (
    Case,
    Cotangents,
    both_precisions,
    clear,
    frame_adjoint,
    frame_tangent,
    plane_cotangents,
    render,
)
from support.kernels import float_reductions, kernels_of_a_frame
from support.trainers import make_trainer

from drgs.splatting import rendering
from drgs.splatting.projection import compensated_opacity


@pytest.fixture(scope="module")
def plain_kernels():
    return kernels_of_a_frame(rendering.Pipeline(1))


def compositing_loop(name, kernels) -> list:
    """The longest kernel besides projection's: the adjoint's last, the others' first."""
    others = kernels[:-1] if name == "adjoint" else kernels[1:]
    return max(others, key=lambda kernel: kernel[1])


def operations(kernels) -> dict[str, int]:
    return {name: sum(count for _, count in entries) for name, entries in kernels.items()}


@pytest.mark.parametrize(
    ("change", "in_compositing"),
    [
        ({"sh_degree": 2}, False),
        ({"sh_degree": 3}, False),
        ({"opacity_rule": compensated_opacity}, False),
        ({"features": (rendering.color_features, rendering.depth_feature)}, True),
    ],
    ids=["degree 2", "degree 3", "compensation", "depth"],
)
def test_options_add_operations_to_their_stage_only(plain_kernels, change, in_compositing):
    more = kernels_of_a_frame(rendering.Pipeline(**{"sh_degree": 1, **change}))
    before, after = operations(plain_kernels), operations(more)
    assert all(after[name] > before[name] for name in before), (before, after)
    for name in before:
        # The loop over a micro-tile's splats changes only if there is one more plane.
        loop = compositing_loop(name, plain_kernels[name])
        assert (loop in more[name]) != in_compositing, (name, loop, more[name])


def test_kernels_do_not_depend_on_the_camera_or_the_sizes(plain_kernels):
    """Otherwise each view, or each step of density control, would compile its own."""
    other = Case("other", 90, 41, 3, count=83, seed=5)
    assert kernels_of_a_frame(rendering.Pipeline(1), other) == plain_kernels


# ----------------------------------------------------------------------------------------------
# Atomics
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["Auto", "Direct", "Local", "NoConflicts", "Expand"])
def test_search_finds_every_kind_of_float_scatter_add(mode):
    def scatter_add():
        target, index = dr.zeros(llvm.Float, 100), dr.arange(llvm.UInt32, 1000) % 7
        dr.scatter_add(target, llvm.Float(index), index, mode=getattr(dr.ReduceMode, mode))
        dr.eval(target)

    found, _ = float_reductions(scatter_add)
    assert found
    atomic = any("atomicrmw fadd" in text for text in found)
    assert atomic == (mode in ("Direct", "Local"))


@both_precisions
@pytest.mark.parametrize("antialiased", [False, True])
def test_no_kernel_reduces_floats_in_memory(precision, antialiased):
    case = clear(Case("atomics", 37, 29, 2, antialiased=antialiased))
    cotangents = plane_cotangents(case, Cotangents.random(case), precision)
    results = {}

    def forward():
        results["frame"] = render(case, precision)
        dr.eval(results["frame"][1].planes())

    def adjoint():
        gradients = frame_adjoint(*results["frame"], *cotangents)
        dr.eval(gradients)

    def tangent():
        gaussians, frame = results["frame"]
        dr.eval(frame_tangent(gaussians, frame, gaussians))

    for stage in (forward, adjoint, tangent):
        found, count = float_reductions(stage)
        assert not found and count >= 3, stage.__name__


def test_no_kernel_of_a_training_iteration_reduces_floats_in_memory():
    """With film, loss, optimizer and statistics: where Dr.Jit differentiates a gather, it would."""
    mi.set_variant("llvm_ad_rgb")
    trainer = make_trainer()
    trainer.step()
    found, count = float_reductions(lambda: (trainer.step(), dr.sync_thread()))
    assert not found and count > 30
