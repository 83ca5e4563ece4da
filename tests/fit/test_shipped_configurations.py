"""Every shipped configuration fits every kind of dataset: what depends on it follows from it."""

from operator import attrgetter

import pytest
from conftest import REPOSITORY, SHARED_DATA

from drgs.config.changes import with_changes, with_iterations
from drgs.config.load import load_config
from drgs.datasets import load_dataset
from drgs.fit.session import train
from drgs.initialization.defaults import resolve_defaults
from drgs.results.metrics import mean_quality

CONFIGURATIONS = sorted(path.stem for path in (REPOSITORY / "scenes").glob("*.yml"))

ALIKE = ("fox", "lego", "lego_mini", "photos")
"""They differ in data, size and number of iterations alone."""

NUMBER = "densify.budget.gaussians"

FASTER_OR_BETTER = {
    "lego_fast": (NUMBER,),
    "lego_800": (NUMBER,),
    "lego_best": (NUMBER, "optimizer.shN_lr"),
}
"""Further keys in which these configurations differ."""

WIDTH, ITERATIONS = 60, 600

MIN_GAIN_DB = 1.0  # in so few iterations 2.3 to 12


def configured(name, folder):
    """The configuration as a small fit of ``folder`` completes it, and the dataset."""
    file, small = REPOSITORY / "scenes" / f"{name}.yml", [f"data.image_size={WIDTH}"]
    if name != "lego_paper":
        small.append(f"iterations={ITERATIONS}")
    config = load_config(file, [f"data.path={folder}", *small])
    config = with_changes(config, {"data.source": ""})
    dataset = load_dataset(config.data_for_training)
    if name == "lego_paper":  # it says for how many iterations its schedule is
        config = with_iterations(config, ITERATIONS)
    return resolve_defaults(config, dataset), dataset


@pytest.mark.parametrize("kind", ["blender", "photographs"])
@pytest.mark.parametrize("name", ALIKE)
def test_configuration_is_derived_from_the_data_alone(request, kind, name):
    made = request.getfixturevalue(kind)
    folder = made[0] if kind == "blender" else made
    config, _ = configured(name, folder)
    assert config == configured(ALIKE[0], folder)[0]
    assert config.data.background == ("white" if kind == "blender" else "black")


@pytest.mark.parametrize("name", FASTER_OR_BETTER)
def test_faster_and_better_configurations_differ_in_few_values(blender, name):
    """Values that depend on the number of Gaussians differ with it."""
    config, _ = configured(name, blender[0])
    usual, _ = configured("lego", blender[0])
    for key in ("init.num_points", *FASTER_OR_BETTER[name]):
        value = attrgetter(key)(config)
        assert value != attrgetter(key)(usual), key
        usual = with_changes(usual, {key: value})
    assert config == usual


def test_every_shipped_configuration_is_tested():
    assert set(CONFIGURATIONS) == {*ALIKE, *FASTER_OR_BETTER, "lego_paper"}


KINDS = {
    "nerf_synthetic": SHARED_DATA / "nerf_synthetic" / "lego",
    "instant_ngp": SHARED_DATA / "fox",
    "colmap_with_points": SHARED_DATA / "colmap_robothead",
}


def psnr_of(name, kind):
    """dB on the test views after a small fit."""
    config, dataset = configured(name, KINDS[kind])
    renders = train(config, dataset).trainer.images(dataset.test)
    pairs = zip(renders, dataset.test, strict=True)
    return mean_quality((image, view.image, view.mask) for image, view in pairs).psnr


@pytest.mark.slow
@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared data is not here")
@pytest.mark.parametrize("kind", KINDS)
def test_recipe_is_better_than_the_paper_on_every_kind_of_dataset(kind):
    recipe, paper = psnr_of("photos", kind), psnr_of("lego_paper", kind)
    assert recipe > paper + MIN_GAIN_DB
