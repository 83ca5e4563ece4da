"""How much each Gaussian was seen of in the last picture of the integrator ``splats``."""

from __future__ import annotations

from typing import Any

from drgs.integrator.settings import SplatsSettings
from drgs.splatting.rendering import weighted_sums


def weighted_sums_of_last(integrator: SplatsSettings, plane: Any) -> Any:
    """Of each Gaussian, the sum over pixels of its weight times ``plane``: Float (N,).

    plane: Float (H * W,). Of a picture of one sensor whose parameters have not been updated since;
    the mean over its samples, and the times at which its shutter was open.
    """
    frames = [frame for of_time in integrator.memory.rendered[0].frames for frame in of_time]
    sums = [weighted_sums(frame, plane) for frame in frames]
    return sum(sums[1:], sums[0]) / sum(frame.bins.grid.samples for frame in frames)
