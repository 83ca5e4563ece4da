"""Whatever stands in for another has what the protocol says, with the same parameters."""

import inspect

import pytest

from drgs.accuracy import exact, pixel_lists, pixel_order, ray_colors
from drgs.cameras import (
    camera,
    distortion,
    fisheye,
    lens,
    motion,
    orthographic,
    radial_tangential,
    thin_prism_fisheye,
)
from drgs.effects import defocus, occlusion
from drgs.integrator.film import LanePoints
from drgs.splatting import footprint, rendering

CLASSES = {
    footprint.GaussianFalloff: (exact.RayFalloff, defocus.DimmedFalloff),
    footprint.SamplePositions: (footprint.PixelCenters, LanePoints),
    footprint.SplatFeatures: (
        occlusion.OccludedFeatures,
        ray_colors.RayColors,
    ),
    rendering.CenterOrder: (pixel_order.PixelOrder,),
    pixel_lists.AffineDepths: (
        pixel_lists.ParallelDepths,
        pixel_lists.RayDepths,
    ),
    lens.Lens: (
        lens.Pinhole,
        radial_tangential.RadialTangential,
        fisheye.Fisheye,
        thin_prism_fisheye.ThinPrismFisheye,
        orthographic.Orthographic,
    ),
    camera.Shutter: (motion.MotionBlur, motion.RollingShutter),
    distortion.PlaneDistortion: (
        radial_tangential.RadialTangential,
        thin_prism_fisheye.ThinPrismFisheye,
    ),
}


def pairs(table):
    return [(protocol, one) for protocol, found in table.items() for one in found]


def members(protocol):
    """Its own names, and those of its annotations."""
    names = {**vars(protocol), **inspect.get_annotations(protocol)}
    return {name for name in names if not name.startswith("_")}


def parameters(function):
    return [name for name in inspect.signature(function).parameters if name != "self"]


def missing(protocol, implementation):
    """Names that it lacks, has the protocol's empty body for, or that take other parameters."""
    fields = getattr(implementation, "__dataclass_fields__", {})
    found = []
    for name in sorted(members(protocol)):
        wanted = vars(protocol).get(name)
        own = getattr(implementation, name, None)
        if own is None:
            if name not in fields:
                found.append(name)
        elif inspect.isfunction(wanted):
            body = inspect.getsource(wanted)
            empty = ("..." in body or "NotImplementedError" in body) and own is wanted
            if empty or parameters(own) != parameters(wanted):
                found.append(name)
    return found


@pytest.mark.parametrize(("protocol", "implementation"), pairs(CLASSES))
def test_class_implements_its_protocol(protocol, implementation):
    assert len(members(protocol)) >= 3
    assert missing(protocol, implementation) == []
