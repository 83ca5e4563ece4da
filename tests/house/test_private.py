"""Undocumented functions of Dr.Jit and Mitsuba are called in one module."""

import ast
import re
import sys
from contextlib import nullcontext

import drjit as dr
import numpy as np
from conftest import REPOSITORY, run_program
from drjit.llvm.ad import Float, UInt32
from support.kernels import launched

from drgs.core import private

FILES = [path for f in ("drgs", "plugins") for path in sorted((REPOSITORY / f).rglob("*.py"))]


def undocumented(source):
    """Attributes of anything that is called ``detail``."""
    return [
        ast.unparse(node)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Attribute) and node.attr == "detail"
    ]


def test_undocumented_functions_are_used_in_one_module_only():
    found = {str(p.relative_to(REPOSITORY)): undocumented(p.read_text()) for p in FILES}
    assert {name for name, uses in found.items() if uses} == {"drgs/core/private.py"}


def test_bucket_order_is_stable_within_blocks():
    keys = np.random.default_rng(0).integers(0, 8, 100)
    order = private.bucket_order(UInt32(keys), 64, 8)
    expected = [np.argsort(keys[b : b + 64], kind="stable") + b for b in (0, 64)]
    np.testing.assert_array_equal(order, np.concatenate(expected))


def test_same_variables_compares_identity():
    a, b = Float(1, 2), Float(1, 2)
    assert private.same_variables([a, {"b": b}], (a, b))
    assert not private.same_variables(a, b)


def increment_in_a_loop(context):
    """Add 1 to a variable in each trip of a loop, of which lane i takes part in i."""
    trips = dr.arange(UInt32, 4)

    def body(trip, variable):
        with context:
            variable[0] = variable[0] + 1
        return trip + 1, variable

    variable = dr.alloc_local(Float, 1)
    variable[0] = dr.zeros(Float, 4)
    _, variable = dr.while_loop(
        (dr.zeros(UInt32, 4), variable), lambda trip, variable: trip < trips, body
    )
    return list(variable[0])


def test_accesses_reach_all_lanes_or_those_of_the_loop():
    assert increment_in_a_loop(nullcontext()) == [0, 1, 2, 3]
    assert increment_in_a_loop(private.access_all_lanes(Float)) == [3, 3, 3, 3]
    assert increment_in_a_loop(nullcontext()) == [0, 1, 2, 3]


def test_accesses_reach_lanes_that_fill_up_a_vector():
    index, memory = dr.arange(UInt32, 5), dr.zeros(UInt32, 64)
    with private.access_all_lanes(UInt32):
        dr.scatter(memory, UInt32(1), index)
    width = private.llvm_vector_width()
    assert list(memory) == [int(k < -(-5 // width) * width) for k in range(64)]


def test_llvm_version_is_known():
    assert private.llvm_version()[0] > 10


def vector_width() -> int:
    """Read the number of 32-bit numbers in a vector from the code that Dr.Jit generates."""
    (kernel,) = launched(lambda: dr.eval(dr.arange(Float, 64) * dr.opaque(Float, 2)))
    return int(re.search(r"<(\d+) x float>", kernel["ir"].getvalue())[1])


PROGRAM = """
import drgs, drjit as dr
from drjit.llvm.ad import Float
from drgs.core import private
from drgs.core.errors import UserError
try:
    private.disable_avx512()
except UserError as error:
    print(error)
dr.set_flag(dr.JitFlag.KernelHistory, True)
dr.eval(dr.rsqrt(dr.arange(Float, 100) + 1))
ir = dr.kernel_history()[-1]["ir"].getvalue()
print("<8 x float>" in ir, "+avx512" in ir, "+avx2" in ir)
"""


def test_avx512_can_be_disabled():
    """In a process of its own, since there is no way back."""
    result = run_program(sys.executable, "-c", PROGRAM)
    if vector_width() == 16:
        assert result.split() == ["True", "False", "True"]
    else:
        assert "cannot leave out AVX-512" in result and "omit it" in result
