"""Unused effects are in no kernel; no kernel adds floats atomically.

Kernels are compared between fresh processes of one test run: nothing is stored.
"""

import json

import drjit as dr
import drjit.llvm.ad as llvm
import mitsuba as mi
import pytest
from conftest import TESTS
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

from drgs.bench import scenes
from drgs.splatting import rendering
from drgs.splatting.projection import compensated_opacity

# ----------------------------------------------------------------------------------------------
# Kernel history
# ----------------------------------------------------------------------------------------------


PROGRAM = """
import json, sys
import drjit as dr
sys.path.insert(0, {tests!r})
from drgs.gaussians import sh
from drgs.splatting import projection, rendering
from support.kernels import kernels_of_a_frame

{before}
pipeline = rendering.Pipeline({degree}, {rule}, {features})
print(json.dumps(kernels_of_a_frame(pipeline)))
"""


FORBIDDEN = """
class Forbidden:
    def __init__(self, name):
        self.__dict__["name"] = name

    def refuse(self, *args):
        raise AssertionError(self.__dict__["name"] + " was used")

    __call__ = __getattr__ = __getitem__ = __iter__ = __len__ = __neg__ = refuse
    __add__ = __radd__ = __mul__ = __rmul__ = __sub__ = __rsub__ = __float__ = refuse

for module, name in [{names}]:
    setattr(module, name, Forbidden(name))
"""


UNUSED_AT_DEGREE_1 = """
    (projection, "compensated_opacity"), (rendering, "depth_feature"), (sh, "C2"), (sh, "C3"),
"""


UNUSED_AT_DEGREE_0 = UNUSED_AT_DEGREE_1 + '(sh, "C1"),'


def kernels_in_a_new_process(run_python, degree, rule, features, forbidden=None):
    """Raises RuntimeError with the process's last line of error."""
    program = PROGRAM.format(
        tests=TESTS,
        before=FORBIDDEN.replace("{names}", forbidden) if forbidden else "",
        degree=degree,
        rule=rule,
        features=features,
    )
    result = run_python(program)
    if result.returncode != 0:
        raise RuntimeError(result.stderr.strip().splitlines()[-1])
    return json.loads(result.stdout)


PLAIN = {"rule": "projection.plain_opacity", "features": "(rendering.color_features,)"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degree", "forbidden"),
    [(0, UNUSED_AT_DEGREE_0), (1, UNUSED_AT_DEGREE_1)],
    ids=["degree 0", "degree 1"],
)
def test_kernels_are_the_same_without_unused_modules(run_python, degree, forbidden):
    whole = kernels_in_a_new_process(run_python, degree, **PLAIN)
    reduced = kernels_in_a_new_process(run_python, degree, **PLAIN, forbidden=forbidden)
    assert whole == reduced
    assert all(len(kernels) >= 3 for kernels in whole.values())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degree", "change", "used"),
    [
        (2, {}, "C2 was used"),
        (1, {"rule": "projection.compensated_opacity"}, "compensated_opacity was used"),
        (1, {"features": "(rendering.color_features, rendering.depth_feature)"}, "depth_feature"),
    ],
    ids=["degree 2", "compensation", "depth"],
)
def test_missing_module_fails_only_when_its_feature_is_used(run_python, degree, change, used):
    with pytest.raises(RuntimeError, match=used):
        kernels_in_a_new_process(
            run_python, degree, **{**PLAIN, **change}, forbidden=UNUSED_AT_DEGREE_1
        )


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


def test_degree_0_needs_fewer_operations(plain_kernels):
    fewer = operations(kernels_of_a_frame(rendering.Pipeline(0)))
    more = operations(plain_kernels)
    assert all(fewer[name] < more[name] for name in more)


def test_kernels_do_not_depend_on_the_camera_or_the_sizes(plain_kernels):
    """Otherwise each view, or each step of density control, would compile its own."""
    other = Case("other", 90, 41, 3, count=83, seed=5)
    assert kernels_of_a_frame(rendering.Pipeline(1), other) == plain_kernels


# ----------------------------------------------------------------------------------------------
# Atomics
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("float_type", [llvm.Float, llvm.Float64], ids=["float32", "float64"])
@pytest.mark.parametrize("mode", ["Auto", "Direct", "Local", "NoConflicts", "Expand"])
def test_search_finds_every_kind_of_float_scatter_add(float_type, mode):
    def scatter_add():
        target, index = dr.zeros(float_type, 100), dr.arange(llvm.UInt32, 1000) % 7
        dr.scatter_add(target, float_type(index), index, mode=getattr(dr.ReduceMode, mode))
        dr.eval(target)

    found, _ = float_reductions(scatter_add)
    assert found
    atomic = any("atomicrmw fadd" in text for text in found)
    assert atomic == (mode in ("Direct", "Local"))


def test_search_finds_gather_derivatives_but_no_integer_scatter():
    def differentiated_gather():
        source = dr.opaque(llvm.Float, 1.0, 100)
        dr.enable_grad(source)
        dr.backward(dr.gather(llvm.Float, source, dr.arange(llvm.UInt32, 1000) % 7))
        dr.eval(dr.grad(source))

    def integers():
        target = dr.zeros(llvm.UInt32, 100)
        dr.scatter_add(target, dr.arange(llvm.UInt32, 1000), dr.arange(llvm.UInt32, 1000) % 7)
        dr.eval(target)

    assert float_reductions(differentiated_gather)[0]
    found, count = float_reductions(integers)
    assert not found and count > 0


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
    scene = scenes.Scene("small", scenes.bench_gaussians(300), scenes.bench_camera(48))
    trainer = scenes.trainer_of(scene)
    trainer.step()
    found, count = float_reductions(lambda: (trainer.step(), dr.sync_thread()))
    assert not found and count > 30
