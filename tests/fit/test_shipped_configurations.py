"""Every shipped configuration fits every kind of dataset: what depends on it follows from it.

Configurations that ask for the same fit of a dataset share one.
"""

import json
from functools import cache
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from conftest import REPOSITORY, SHARED_DATA
from scipy.spatial.transform import Rotation

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

FRAME_TOLERANCE_DB = 1.0  # of the best, in other frames of reference
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


def moved(source: Path, folder: Path, scale):
    """``folder`` with the photographs of ``source``, whose world is turned, moved and scaled.

    The origin is the mean of the cameras' positions, as in COLMAP's reconstructions; scale: the
    largest distance of a camera from there.
    """
    meta = json.loads((source / "transforms.json").read_text())
    poses = np.array([frame["transform_matrix"] for frame in meta["frames"]])
    poses[:, :3, 3] -= poses[:, :3, 3].mean(axis=0)
    poses[:, :3, 3] *= scale / np.linalg.norm(poses[:, :3, 3], axis=1).max()
    poses[:, :3] = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix() @ poses[:, :3]
    for frame, pose in zip(meta["frames"], poses, strict=True):
        frame["transform_matrix"] = pose.tolist()
    folder.mkdir()
    (folder / "images").symlink_to(source / "images")
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


KINDS = {
    "nerf_synthetic": lambda folder: SHARED_DATA / "nerf_synthetic" / "lego",
    "instant_ngp": lambda folder: SHARED_DATA / "fox",
    # As COLMAP finds cameras: the origin between them, and another unit of length.
    "in colmap's frame": lambda folder: moved(SHARED_DATA / "fox", folder / "fox", scale=5),
    "far smaller": lambda folder: moved(SHARED_DATA / "fox", folder / "fox", scale=0.05),
    "colmap_with_points": lambda folder: SHARED_DATA / "colmap_robothead",
}


@pytest.fixture(scope="module")
def psnr_of(tmp_path_factory):
    """psnr_of(name, kind): dB on the test views after a small fit."""
    folders = cache(lambda kind: KINDS[kind](tmp_path_factory.mktemp("data")))
    fitted = {}

    def measured(name, kind):
        config, dataset = configured(name, folders(kind))
        key = kind, config.model_dump_json()
        if key not in fitted:
            trainer = train(config, dataset).trainer
            renders = trainer.images(dataset.test)
            pairs = zip(renders, dataset.test, strict=True)
            fitted[key] = mean_quality((p, view.image, view.mask) for p, view in pairs).psnr
        return fitted[key]

    return measured


needs_data = pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared data is not here")


@pytest.mark.slow
@needs_data
@pytest.mark.parametrize("kind", KINDS)
def test_recipe_is_better_than_the_paper_on_every_kind_of_dataset(psnr_of, kind):
    recipe, paper = psnr_of("photos", kind), psnr_of("lego_paper", kind)
    assert recipe > paper + MIN_GAIN_DB


@pytest.mark.slow
@needs_data
def test_coordinate_system_does_not_affect_quality(psnr_of):
    """The unit of length, the origin and the directions of the axes are COLMAP's choice."""
    reached = [psnr_of("photos", kind) for kind in list(KINDS)[1:4]]
    assert min(reached) >= max(reached) - FRAME_TOLERANCE_DB, reached
