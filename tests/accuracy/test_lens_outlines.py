"""Outlines of splats behind lenses of more than 180 degrees hold all that is seen of them."""

import mitsuba as mi
import numpy as np
import pytest

from drgs.core.constants import ALPHA_CUT

LENSES = {"fisheye": {"fx": 18.0}, "equirectangular": {}}
COUNT = 60


def alpha(lens, means, scales, quats, cut):
    """Return the opacity of a white splat over black."""
    splats = {
        "means": means,
        "log_scales": np.log(scales),
        "quats": quats,
        "logit_opacities": np.full(1, 2.0),
        "sh0": np.full((1, 1, 3), np.sqrt(np.pi)),
    }
    film = {"type": "hdrfilm", "width": 64, "height": 48 - 16 * (lens == "equirectangular")}
    sensor = {"type": "calibrated", "lens": lens, **LENSES[lens], "film": film}
    film |= {"rfilter": {"type": "box"}, "pixel_format": "rgb"}
    integrator = {"type": "splats", "projection": "exact", "low_pass": 0.0, "alpha_cut": cut}
    integrator |= {"srgb_primitives": False, "background": [0.0, 0.0, 0.0]}
    arrays = {k: mi.TensorXf(np.asarray(v, np.float32)) for k, v in splats.items()}
    scene = mi.load_dict({"type": "scene", "integrator": integrator | arrays, "sensor": sensor})
    return np.array(mi.render(scene, spp=1))[..., 0]


@pytest.mark.parametrize("lens", LENSES)
def test_wide_splats_are_cut_off_only_where_they_are_faint(lens):
    """From beside the camera to behind it, as large as their distance or smaller."""
    rng, seen = np.random.default_rng(0), 0
    for _ in range(COUNT):
        means = rng.normal(size=(1, 3))
        scales = np.linalg.norm(means) * rng.uniform(0.1, 0.8, (1, 3))
        values = means, scales, rng.normal(size=(1, 4))
        all_of_it, shown = (alpha(lens, *values, cut) for cut in (1e-6, ALPHA_CUT))
        expected = np.where(all_of_it >= ALPHA_CUT, all_of_it, 0)
        # Rounding may move an alpha across the cut, by less than 1 % of it; elsewhere, both images
        # evaluate one formula in float32, in kernels that may contract differently: 1e-5.
        is_clear = np.abs(all_of_it / ALPHA_CUT - 1) > 0.01
        np.testing.assert_allclose(shown[is_clear], expected[is_clear], rtol=0, atol=1e-5)
        seen += bool(shown.any())
    assert seen > COUNT / 2
