"""The numbers that define the image model, each with its source and gradient.

The source is the 3DGS paper and its reference implementation (Kerbl et al. 2023, "3D Gaussian
Splatting for Real-Time Radiance Field Rendering"), or a numerical reason. Nothing is tuned, and no
decision is differentiated.
"""

from __future__ import annotations

import math

ALPHA_MAX = 0.9900000095367432
"""Upper clamp of a splat's alpha (3DGS reference rasterizer): keeps 1 / (1 - alpha) below 100.
0.99 rounded to float32, in both precisions: the transmittance of two clamped splats, (1 - 0.99)^2,
is TRANSMITTANCE_STOP but for that rounding. Gradient: zero in a clamped alpha, not in colours."""

ALPHA_CUT = 0.003921568859368563
"""Smallest alpha with which a splat contributes to a pixel (3DGS reference rasterizer; 1/255 in
float32). Gradient: a pair that is cut has none; the jump is not differentiated."""

TRANSMITTANCE_STOP = 1e-4
"""A pixel is finished *before* the splat that would take its transmittance below this value
(3DGS reference rasterizer). Gradient: that splat and all behind it have none at this pixel."""

LOW_PASS = 0.3
"""px^2 added to the diagonal of the projected covariance (3DGS reference rasterizer): every
splat is at least about a pixel wide. It also bounds the conic by 1 / LOW_PASS."""

MIN_LOW_PASS_PX2 = 1e-18
"""px^2, where the low-pass is switched off: keeps the conic of a flat splat finite, also squared
and times a film's width."""

TAN_CLAMP = 0.3
"""In the projection's Jacobian only, x/z and y/z are clamped to the frustum widened by this
fraction of its half extents on each side (1.3 times the half extents for a centred principal
point, as in the 3DGS reference). The affine approximation diverges beyond. Gradient: a clamped
slope is a constant, so the covariance does not depend on x (or y) then, but still on z; the
position on the film is not clamped."""

NEAR = 0.01
"""Default near plane, scene units: means closer than this are culled (gsplat's default). Gradient:
a culled Gaussian has none; one at exactly this distance is drawn."""

COLOR_MIN = 0.0
"""Colours from spherical harmonics are not negative (3DGS reference). Gradient: zero where a colour
is clamped; at exactly this value it passes, so that black splats can learn."""

SHUTTER_SAMPLES = 8  # images of a moving camera, default of the sensor ``calibrated``

MAX_SHUTTER_SAMPLES = 1000  # whose images are kept for derivatives: 90 MB of the smallest film

NEGLIGIBLE_ALPHA = 2.0**-60
"""Alpha at which splats end where it is not cut: thousands of layers change no rounding, in either
precision, and the short exp2 of the kernels is exact well below it."""

CULL_MARGIN = 1e-3
"""Added to the exponent (base 2) when a splat is tested against tiles, so that rounding in the
tile test never drops a pixel that compositing would accept."""

CULL_MARGIN_PER_PX = 6e-6
"""The same, for each pixel of the film's longer side W. An offset d of up to W px is rounded four
times on its way to u = U d, with |U d| <= 3.4 at the cut and entries of U below 1.9 / px: the
exponent |U d|^2 is off by at most 2 * 3.4 * 4 * 2^-24 * 1.9 W."""

WHITENING_SCALE = math.sqrt(0.5 * math.log2(math.e))
"""exp(-|u|^2 / 2) = exp2(-|WHITENING_SCALE u|^2). The exponent needs no clamp: it is minus a sum of
squares, so never positive whatever the rounding, and where it is so small that exp2 underflows,
alpha is below the cut and discarded."""

MAX_INT = 2**31 - 1  # the counters of Mitsuba and Dr.Jit are of 32 bits

MAX_COEFFICIENT = 1e6  # A coefficient of distortion, in size: calibrations give less than 1e3

MAX_FEATURES = 64
"""Channels that an image composites, with RGB or without: see :mod:`drgs.splatting.order`.
The kernels of 64 and their derivatives compile in 8 s with AVX2, once."""

SH_C0 = 0.28209479177387814
"""The spherical harmonic of degree 0, 1 / (2 sqrt(pi)); display-space colour: 0.5 + SH_C0 sh0."""
