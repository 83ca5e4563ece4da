"""Kernels that were launched: their hashes, their sizes, and whether they add floats atomically."""

import re
from collections.abc import Callable

import drjit as dr
import numpy as np

from drgs.splatting import rendering
from support.helpers import (
    FLOAT32,
    Case,
    device_camera,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
)


def launched(act: Callable[[], object]) -> list[dict]:
    """Run a function; return the entries of Dr.Jit's history for the compiled kernels it runs."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        act()
        return dr.kernel_history([dr.KernelType.JIT])


def kernel_hashes(act: Callable[[], object]) -> set:
    """Return hashes of the kernels that ``act`` launches."""
    return {kernel["hash"] for kernel in launched(act)}


def kernels_of(act: Callable[[], object]) -> list[list]:
    """[hash, operation count] of each compiled kernel that ``act`` launches."""
    return [[kernel["hash"], kernel["operation_count"]] for kernel in launched(act)]


def kernels_of_a_frame(pipeline, case=None, camera=None) -> dict[str, list]:
    """Kernels of the forward pass, the adjoint and the tangent of one scene of degree 3."""
    case = case or Case("composition", 37, 29, 3)
    gaussians = device_gaussians(case.gaussians, FLOAT32)
    camera = camera or device_camera(case.camera, FLOAT32)
    ones = FLOAT32.array(np.ones(case.width * case.height))
    dr.eval(gaussians, camera, ones)
    frames = []

    def forward():
        frames.append(rendering.render(gaussians, camera, pipeline))
        dr.eval(frames[0].planes())

    def adjoint():
        frame_adjoint(gaussians, frames[0], [ones] * (len(frames[0].planes()) - 1), ones)

    def tangent():
        dr.eval(frame_tangent(gaussians, frames[0], gaussians))

    return {act.__name__: kernels_of(act) for act in (forward, adjoint, tangent)}


FLOAT_REDUCTION = re.compile(r"atomicrmw f\w+|@reduce_\w+_f(?:16|32|64)\w*")
"""An atomic float instruction, or any of Dr.Jit's functions that reduce floats into memory: those
without atomics serve scatter_add's Expand mode, whose result depends on the threads as well."""


def float_reductions(function) -> tuple[list[str], int]:
    """(what FLOAT_REDUCTION finds in the kernels that ``function`` runs, number of kernels)."""
    texts = [kernel["ir"].read() for kernel in launched(function)]
    assert all("define void @drjit_" in text for text in texts)
    return [found for text in texts for found in FLOAT_REDUCTION.findall(text)], len(texts)
