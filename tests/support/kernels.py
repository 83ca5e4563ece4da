"""Kernels that were launched: their hashes, their sizes, and whether they add floats atomically."""

import re
from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as llvm
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


def drain_kernels() -> list[list]:
    """[hash, operation count] of each compiled kernel since the last call."""
    return [
        [kernel["hash"], kernel["operation_count"]]
        for kernel in dr.kernel_history()
        if kernel["type"] == dr.KernelType.JIT
    ]


def kernels_of_a_frame(pipeline, case=None) -> dict[str, list]:
    """Kernels of the forward pass, the adjoint and the tangent of one scene of degree 3."""
    case = case or Case("composition", 37, 29, 3)
    gaussians = device_gaussians(case.gaussians, FLOAT32)
    camera = device_camera(case.camera, FLOAT32)
    # A flat array made of a numpy array shares its memory, and whether that is aligned to 64
    # bytes is up to chance and part of a kernel: let Dr.Jit store it.
    flat = gaussians.logit_opacities + dr.opaque(llvm.Float, 0)
    gaussians = replace(gaussians, logit_opacities=flat)
    ones = FLOAT32.array(np.ones(case.width * case.height))
    dr.eval(gaussians, camera, ones)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        frame = rendering.render(gaussians, camera, pipeline)
        planes = frame.planes()
        dr.eval(planes)
        forward = drain_kernels()
        frame_adjoint(gaussians, frame, [ones] * (len(planes) - 1), ones)
        adjoint = drain_kernels()
        dr.eval(frame_tangent(gaussians, frame, gaussians))
        tangent = drain_kernels()
    return {"forward": forward, "adjoint": adjoint, "tangent": tangent}


FLOAT_REDUCTION = re.compile(r"atomicrmw f\w+|@reduce_\w+_f(?:16|32|64)\w*")
"""An atomic float instruction, or any of Dr.Jit's functions that reduce floats into memory: those
without atomics serve scatter_add's Expand mode, whose result depends on the threads as well."""


def float_reductions(function) -> tuple[list[str], int]:
    """(what FLOAT_REDUCTION finds in the kernels that ``function`` runs, number of kernels)."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        function()
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    texts = [kernel["ir"].read() for kernel in kernels]
    assert all("define void @drjit_" in text for text in texts)
    return [found for text in texts for found in FLOAT_REDUCTION.findall(text)], len(texts)
