"""World-to-camera matrices of views."""

import numpy as np
from support.small_capture import make_dataset


def test_a_viewmat_is_the_inverse_of_camera_to_world():
    for view in make_dataset().train:
        # Entries are below 10: some ten roundings of float64.
        assert np.allclose(view.viewmat @ view.camera_to_world, np.eye(4), atol=1e-14)
