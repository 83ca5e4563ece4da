"""Returns of extensions are checked where they are taken; objects and classes are told apart."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits

import drgs
from drgs.cameras.lens import LENSES, Pinhole
from drgs.config.extensions import LOSSES
from drgs.config.load import config_from
from drgs.core.errors import UserError
from drgs.core.registry import temporary_registrations
from drgs.effects.base import TrainingEffect
from drgs.effects.optimised import OptimisedEffect
from drgs.io.formats import FORMATS, FileFormat
from drgs.training.density.strategy import DensityReport, DensityStrategy, absolute_errors
from drgs.training.losses import Loss, LossTerm


def part_of(base, **members):
    return type("Mine", (base,), {"name": "mine", **members})()


def square(self, image, target):
    return dr.mean(dr.square(image.array - target.image.array))


def edit_by_numpy(self, population, iteration):
    population.edit(np.arange(10))


def refine_to(number):
    return {"is_due": lambda self, i: i == 2, "refine": lambda self, p, i: number}


def loss(call):
    return {"loss": part_of(Loss, __call__=call)}


def effect(**members):
    return {"effects": [part_of(TrainingEffect, **members)]}


def term(**members):
    return {"terms": [part_of(LossTerm, **members)]}


def strategy(**members):
    return {"strategy": part_of(DensityStrategy, **members)}


def half_plane(image, photograph):
    return absolute_errors(image, photograph)[:7]


WRONG = {
    "loss: None": (loss(lambda *a: None), "__call__() must return a Float of one value, got None"),
    "loss: a map": (loss(lambda self, x, t: x), "must return a Float of one value, got TensorXf"),
    "loss: a number": (loss(lambda *a: 1.0), "__call__() must return"),
    "loss: detached": (loss(lambda self, *a: dr.detach(square(self, *a))), "not a detached one"),
    "loss: no method": ({"loss": Loss()}, "loss: Loss must define __call__"),
    "loss: a class": ({"loss": Loss}, "loss must be an object"),
    "loss: a list": ({"loss": [Loss]}, "loss must be one object, got list"),
    "effects: no list": ({"effects": TrainingEffect}, "effects must be a list of objects"),
    "effects: a name": ({"effects": ["colors"]}, "effects must be an object, got colors"),
    "adjust": (effect(adjust=lambda s, x, v: x.array), "adjust() must return an image of shape"),
    "adjust: size": (effect(adjust=lambda s, x, v: x[:5]), "adjust() must return an image of"),
    "target": (effect(target_image=lambda s, v, x: x[:5]), "target_image() must return an image"),
    "penalty": (effect(penalties=lambda s, v: [np.ones(2)]), "penalties() must return a Float"),
    "term": (term(of_image=lambda s, x, t: x), "of_image() must return a Float of one value"),
    "term 2": (term(of_gaussians=lambda s, p, n: p["means"]), "of_gaussians() must return a Float"),
    "report": (strategy(**refine_to(7)), "refine() must return None or a DensityReport"),
    "report: rows": (
        strategy(**refine_to(DensityReport(3))),
        "refine() must return None or a DensityReport of 40 Gaussians, not of 3",
    ),
    "planes": (
        strategy(needs_statistics=lambda s, i: True, pixel_weights=lambda s, i: {"e": half_plane}),
        "pixel_weights() must return planes of the image's size",
    ),
}


def small_config():
    values = fits.config_of().model_dump()
    values |= {"iterations": 3, "init": {"num_points": 40}}
    values["densify"] = {**values["densify"], "remove_floaters": False}
    return config_from(values, "x.yml")


@pytest.mark.parametrize("name", WRONG)
def test_wrong_parts_and_returns_are_named(name):
    parts, message = WRONG[name]
    with pytest.raises(UserError) as error:
        drgs.train(small_config(), fits.plain_dataset(), **parts)
    assert message in str(error.value)
    assert "Mine" in message or "Mine" in str(error.value) or name.split(":")[0] in message


def test_rows_must_be_numbers_of_the_device():
    keep = strategy(is_due=lambda s, i: i == 2, refine=edit_by_numpy)
    with pytest.raises(TypeError, match=r"Population.edit\(\): keep must be .*got ndarray"):
        drgs.train(small_config(), fits.plain_dataset(), **keep)


def test_appended_rows_may_be_numpy_arrays():
    """Rows of ``Population.host`` are such arrays."""

    def refine(self, population, iteration):
        names = population.optimizer.state
        rows = {name: population.host(name)[:5] for name in names}
        population.edit(population.to_device_indices(np.arange(30)), rows)
        for name, values in rows.items():
            np.testing.assert_array_equal(population.host(name)[30:], np.float32(values))
        return DensityReport(population.num_rows)

    growing = strategy(is_due=lambda s, i: i == 2, refine=refine)
    result = drgs.train(small_config(), fits.plain_dataset(), **growing)
    assert result.gaussians.num_gaussians == 35


def test_terms_are_added_to_the_loss():
    """Before the first step, constant terms shift the loss by their sum."""

    def first_loss(**parts):
        seen = []
        drgs.train(
            small_config(), fits.plain_dataset(), lambda r: seen.append(r.loss) or True, **parts
        )
        return seen[0]

    two = [
        part_of(LossTerm, of_image=lambda s, x, t: dr.mean(x.array) * 0 + 0.25),
        part_of(LossTerm, of_gaussians=lambda s, p, n: dr.sum(p["means"].array) * 0 + 0.5),
    ]
    assert first_loss(terms=two) == pytest.approx(first_loss() + 0.75, rel=1e-5)


def test_an_effect_without_a_step_of_its_own_is_optimised():
    class Gain(OptimisedEffect):
        name = "gain"

        def __init__(self):
            super().__init__({"gain": np.zeros((1, 1))}, {"gain": 0.1})

        def adjust(self, image, view):
            return mi.TensorXf(image.array * dr.exp(self.parameters(view)["gain"]), image.shape)

    gain = Gain()
    drgs.train(small_config(), fits.plain_dataset(), effects=[gain])
    assert abs(gain.numpy()["gain"].item()) > 0.01


def test_missing_methods_are_named_when_a_class_is_registered():
    with temporary_registrations(), pytest.raises(TypeError, match='"mine" must define __call__'):
        LOSSES.register("mine")(type("Mine", (Loss,), {}))


@pytest.mark.parametrize("count", [2, 0])
def test_rows_are_one_or_one_for_each_view(count):
    rows = OptimisedEffect({"gain": np.zeros((count, 1))}, {"gain": 0.1})
    rows.name = "gain"
    with pytest.raises(UserError, match=rf"gain must have 1 row, or \d+ for the .*, got {count}$"):
        drgs.train(small_config(), fits.plain_dataset(), effects=[rows])


def test_a_second_format_of_a_suffix_is_refused():
    """An installed one of a shipped suffix would never be read; one module may register again."""

    def declare(suffix):
        return type("Mine", (FileFormat,), {"suffix": suffix, "description": "mine"})

    with temporary_registrations():
        FORMATS.register("first")(declare(".mine"))
        FORMATS.register("first")(declare(".mine"))
        for suffix, owner in ((".mine", "first"), (".spz", "spz")):
            with pytest.raises(ValueError, match=f"suffix {suffix} is that of {owner} already"):
                FORMATS.register("second")(declare(suffix))


def test_coefficients_with_names_of_other_properties_are_refused():
    with temporary_registrations():
        LENSES.register("odd")(dataclass(frozen=True)(type("Odd", (Pinhole,), ODD)))
        with pytest.raises(RuntimeError, match=r"has coefficients with the names of other .*, cx"):
            mi.load_dict({"type": "calibrated", "lens": "odd"})


ODD = {"__annotations__": {"cx": float, "bend": float}, "cx": 0.0, "bend": 0.0}
