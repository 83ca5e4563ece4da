"""In which space ``drgs.render`` takes the images of a scene's integrator to be."""

import mitsuba as mi
import pytest

from drgs import render

DISPLAY = {"srgb_primitives": False}


@pytest.mark.parametrize(
    ("integrator", "linear"),
    [
        ({"type": "path"}, True),
        ({"type": "splats"}, True),
        ({"type": "splats", **DISPLAY}, False),
        ({"type": "aov", "aovs": "z:depth", "colors": {"type": "splats", **DISPLAY}}, False),
        ({"type": "volprim_rf_basic"}, True),
        ({"type": "volprim_rf_basic", **DISPLAY}, False),
    ],
)
def test_primitives_in_display_space_are_not_encoded_again(integrator, linear):
    mi.set_variant("llvm_ad_rgb")
    assert render._is_linear(mi.load_dict(integrator)) == linear
