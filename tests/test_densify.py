"""Adaptive density control against the rules of the 3DGS reference, written out in numpy."""

import math
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array2f, Bool, Float, TensorXf, TensorXf64

from drgs.checks import UserError
from drgs.config import DensifyConfig
from drgs.densify import (
    DensityReport,
    DensityStatistics,
    accumulate,
    densify_and_prune,
    gathers_statistics,
    prunes_large,
    reset_opacities,
    should_densify,
    should_reset,
)
from drgs.gaussians import PARAMETER_NAMES
from drgs.optimizer import make_optimizer, num_rows
from drgs.reference import *  # noqa: F403
