"""Settings that depend on the dataset: coarse stages."""

from dataclasses import replace

import numpy as np
import pytest
from support.datasets import dataset_of, view_at

from drgs.config.changes import with_changes, with_decisions, with_iterations
from drgs.config.schema import FitConfig
from drgs.initialization.defaults import resolve_defaults

CONFIG = FitConfig(data={"path": "unused"}, iterations=1000)


def photographs_of(width, height, count=10):
    angles = 2 * np.pi * np.arange(count) / count
    centers = np.stack([4 * np.cos(angles), 4 * np.sin(angles), np.ones(count)], axis=1)
    return dataset_of([view_at(center, (0, 0, 0), width, height) for center in centers])


@pytest.fixture(scope="module")
def photographs():
    return photographs_of(120, 100)


def with_alpha(dataset, alpha_of):
    """alpha_of(index): of a training view."""
    train = [
        replace(view, alpha=np.broadcast_to(np.float32(alpha_of(i)), view.image.shape[:2]))
        for i, view in enumerate(dataset.train)
    ]
    return replace(dataset, train=tuple(train))


def left_of(size):
    return np.arange(120) < size


def stages(config, dataset):
    return [(stage.until, stage.factor) for stage in resolve_defaults(config, dataset).coarse]


def test_photographs_are_fitted_at_half_their_size_first(photographs):
    assert stages(CONFIG, photographs) == [(350, 2)]
    opaque = with_alpha(photographs, lambda index: 1)
    assert stages(CONFIG, opaque) == [(350, 2)]
    for index in range(10):  # one that is cut out does not make the others so
        one = with_alpha(photographs, lambda i, chosen=index: left_of(60) if i == chosen else 1)
        assert stages(CONFIG, one) == [(350, 2)]


def test_cut_out_objects_have_no_coarse_stages(photographs):
    assert stages(CONFIG, with_alpha(photographs, lambda index: left_of(60 + index))) == []
    many = photographs_of(120, 100, 100)
    for opaque in range(12):  # one that is not cut out does not make the others so
        assert stages(CONFIG, with_alpha(many, lambda i, k=opaque: i == k or left_of(60))) == []


def test_small_images_and_adc_have_no_coarse_stage(photographs):
    assert stages(CONFIG, photographs_of(120, 99)) == []
    assert stages(with_changes(CONFIG, {"iterations": 1}), photographs) == []
    assert stages(with_changes(CONFIG, {"densify.strategy": "adc"}), photographs) == []


def test_given_values_stay(photographs):
    none = with_changes(CONFIG, {"coarse": []})
    assert stages(none, photographs) == []
    quarter = with_changes(CONFIG, {"coarse": [{"until": 9, "factor": 4}]})
    assert stages(quarter, photographs) == [(9, 4)]


def test_stages_stay_open_until_the_dataset_is_known(photographs):
    assert with_iterations(CONFIG, 200).coarse is None
    known = resolve_defaults(CONFIG, photographs)
    assert with_decisions(CONFIG, known) == known
    assert stages(with_iterations(known, 200), photographs) == [(70, 2)]
