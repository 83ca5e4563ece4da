"""Gaussians from activated numpy arrays, and to and from files."""

import numpy as np
import pytest

import drgs

COUNT = 7


def arrays(degree=2):
    rng = np.random.default_rng(2)
    return {
        "means": rng.normal(0, 1, (COUNT, 3)),
        "quats": rng.normal(0, 1, (COUNT, 4)),
        "scales": rng.uniform(0.01, 3, (COUNT, 3)),
        "opacities": rng.uniform(0.01, 0.99, COUNT),
        "sh": rng.normal(0, 1, (COUNT, (degree + 1) ** 2, 3)),
    }


@pytest.mark.parametrize("degree", range(4))
def test_activated_values_survive_from_numpy(degree):
    given = arrays(degree)
    gaussians = drgs.Gaussians.from_numpy(**given)
    assert (gaussians.num_gaussians, gaussians.sh_degree) == (COUNT, degree)
    # float32; a logarithm of 5 is rounded by 2.4e-7, which is the relative error of its exponential
    np.testing.assert_allclose(gaussians.scales, given["scales"], rtol=1e-6)
    np.testing.assert_allclose(gaussians.opacities, given["opacities"], rtol=1e-6)
    coefficients = np.concatenate([gaussians.sh0, gaussians.shN], axis=1)
    np.testing.assert_array_equal(coefficients, given["sh"].astype(np.float32))
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN"):
        assert getattr(gaussians, name).dtype == np.float32


def test_saved_gaussians_are_loaded_unchanged(tmp_path):
    expected = drgs.Gaussians.from_numpy(**arrays())
    expected.save(tmp_path / "a.ply")
    found = drgs.Gaussians.load(str(tmp_path / "a.ply"))
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    found.save(tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": np.zeros((COUNT, 2))}, r"means must be of shape \(7, 3\), got \(7, 2\)"),
        ({"means": np.zeros((3, COUNT))}, r"means must be of shape \(3, 3\), got \(3, 7\)"),
        ({"opacities": np.zeros((COUNT, 1))}, r"opacities must be of shape \(7,\)"),
        (
            {"sh": np.zeros((COUNT, 5, 3))},
            r"sh must be of shape \(7, 1, 3\) or .*, got \(7, 5",
        ),
        ({"scales": np.zeros((COUNT, 3))}, "scales must be above 0 and below inf, got 0.0"),
        ({"opacities": np.full(COUNT, 1.5)}, "opacities must be above 0 and below 1, got 1.5"),
    ],
)
def test_invalid_gaussians_are_refused(changes, message):
    with pytest.raises(ValueError, match=rf"Gaussians.from_numpy\(\): {message}"):
        drgs.Gaussians.from_numpy(**{**arrays(), **changes})
