"""Wrong arguments of public functions: the error names the argument, what is expected, and got."""

import numpy as np
import pytest

import drgs
from drgs.cameras.lens import PINHOLE
from drgs.core.errors import UserError
from drgs.datasets.types import Dataset
from drgs.testing import Case

GOOD = {
    "means": np.zeros((4, 3)),
    "quats": np.tile([1.0, 0, 0, 0], (4, 1)),
    "scales": np.full((4, 3), 0.1),
    "opacities": np.full(4, 0.5),
    "sh": np.zeros((4, 1, 3)),
}


@pytest.mark.parametrize("name", GOOD)
@pytest.mark.parametrize("wrong", ["text", "complex", "nan", "ragged", "none", "short"])
def test_arrays_of_gaussians(name, wrong):
    value = GOOD[name].tolist()
    values = {
        "text": ("x", "must be an array of real numbers, got"),
        "complex": (GOOD[name].astype(complex), "must be an array of real numbers, got"),
        "ragged": ([*value, [[1, 2], 3]], "must be an array of real numbers, got"),
        "none": (None, "must be an array of real numbers, got None"),
        "nan": (np.full_like(GOOD[name], np.nan), "must be finite"),
        "short": (GOOD[name][..., :-1], "must be of shape"),
    }
    given, message = values[wrong]
    with pytest.raises(
        (TypeError, ValueError), match=rf"^Gaussians\.from_numpy\(\): {name} {message}"
    ):
        drgs.Gaussians.from_numpy(**{**GOOD, name: given})


def test_quaternions_of_zeros():
    with pytest.raises(ValueError, match="quats must not be all zero"):
        drgs.Gaussians.from_numpy(**{**GOOD, "quats": 0 * GOOD["quats"]})


EMPTY = Dataset(
    train=(),
    test=(),
    test_split="test",
    background=(1, 1, 1),
    description="",
    start_half_extent=None,
)
PUBLIC = {
    "train() config": lambda x: drgs.train(x),
    "train() dataset": lambda x: drgs.train({}, x),
    "train() callback": lambda x: drgs.train({}, EMPTY, x),
    "examine() dataset": lambda x: drgs.examine(x),
    "examine() config": lambda x: drgs.examine(EMPTY, x),
    "examine() seconds": lambda x: drgs.examine(EMPTY, None, None, x),
    "load_dataset() source": lambda x: drgs.load_dataset(x),
    "Gaussians.load() path": lambda x: drgs.Gaussians.load(x),
    "Gaussians.save() path": lambda x: drgs.Gaussians.from_numpy(**GOOD).save(x),
    "Case() lens": lambda x: Case("mine", lens=x),
    "Case() count": lambda x: Case("mine", count=x),
    "Case() reference": lambda x: Case("mine", reference=x),
}


@pytest.mark.parametrize("place", PUBLIC)
@pytest.mark.parametrize(
    "value", [b"x", [7], object(), 1j], ids=["bytes", "list", "object", "complex"]
)
def test_arguments_of_other_types(place, value):
    where, name = place.split()
    with pytest.raises(UserError) as error:
        PUBLIC[place](value)
    text = str(error.value)
    assert text.startswith(f"{where}: {name} must be ") and f", got {value!r}"[:50] in text


@pytest.mark.parametrize(
    "wrong",
    [{"width": 0}, {"count": -1}, {"degree": 4}, {"focal": float("nan")}, {"step": 0.0}]
    + [{"aperture": value} for value in (3, (0.1,), (0.1, 0.0))],
    ids=str,
)
def test_numbers_of_cases(wrong):
    (name,) = wrong
    with pytest.raises(UserError, match=rf"^Case\(\): {name} must be .*, got "):
        Case("mine", lens=PINHOLE, **wrong)


def test_approximations_of_cases():
    with pytest.raises(UserError, match="has no low_pas; did you mean low_pass"):
        Case("mine", approximations={"low_pas": 0.1})
