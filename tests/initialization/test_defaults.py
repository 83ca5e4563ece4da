"""Settings that depend on the dataset: coarse stages, and the rate of the scales."""

from dataclasses import replace

import numpy as np
import pytest
from support.datasets import dataset_of, view_at

from drgs.config.changes import with_changes, with_decisions, with_iterations
from drgs.config.schema import FitConfig
from drgs.datasets.images import without_images
from drgs.initialization.defaults import resolve_defaults

CONFIG = FitConfig(data={"path": "unused"}, iterations=1000)
LEFT_HALF = np.arange(120) < 60


def photographs(height=100, count=10, alpha_of=None):
    """Views of 120 px; alpha_of(index): of a training view."""
    views = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        view = view_at((4 * np.cos(angle), 4 * np.sin(angle), 1), (0, 0, 0), 120, height)
        if alpha_of is not None:
            alpha = np.broadcast_to(np.float32(alpha_of(index)), (height, 120))
            view = replace(view, alpha=alpha)
        views.append(view)
    return dataset_of(views)


def stages(config, dataset):
    return [(stage.until, stage.factor) for stage in resolve_defaults(config, dataset).coarse]


@pytest.mark.parametrize(
    ("changes", "dataset", "expected"),
    [
        ({}, photographs(), [(350, 2)]),
        ({}, photographs(alpha_of=lambda index: 1), [(350, 2)]),
        # One that is cut out does not make the others so.
        ({}, photographs(alpha_of=lambda index: LEFT_HALF if index == 3 else 1), [(350, 2)]),
        ({}, photographs(alpha_of=lambda index: LEFT_HALF), []),
        # One that is not cut out does not make the others so.
        ({}, photographs(count=100, alpha_of=lambda index: index == 3 or LEFT_HALF), []),
        ({}, photographs(height=99), []),
        ({"iterations": 1}, photographs(), []),
        ({"densify.strategy": "adc"}, photographs(), []),
        ({"coarse": []}, photographs(), []),
        ({"coarse": [{"until": 9, "factor": 4}]}, photographs(), [(9, 4)]),
    ],
)
def test_large_photographs_are_fitted_at_half_their_size_first(changes, dataset, expected):
    assert stages(with_changes(CONFIG, changes), dataset) == expected


@pytest.mark.parametrize(
    ("changes", "alpha_of", "expected"),
    [
        ({}, None, 0.01),
        ({}, lambda index: 1, 0.01),
        ({}, lambda index: LEFT_HALF, 0.02),
        ({"coarse": []}, lambda index: LEFT_HALF, 0.02),
        ({"optimizer.scales_lr": 0.03}, lambda index: LEFT_HALF, 0.03),
    ],
)
def test_scales_of_what_is_cut_out_move_faster(changes, alpha_of, expected):
    config = resolve_defaults(with_changes(CONFIG, changes), photographs(alpha_of=alpha_of))
    assert config.optimizer.scales_lr == expected


def test_known_settings_need_no_images():
    dataset = photographs(alpha_of=lambda index: LEFT_HALF)
    known = resolve_defaults(CONFIG, dataset)
    on_another_rank = replace(dataset, train=tuple(map(without_images, dataset.train)))
    assert resolve_defaults(known, on_another_rank) == known


def test_stages_stay_open_until_the_dataset_is_known():
    assert with_iterations(CONFIG, 200).coarse is None
    known = resolve_defaults(CONFIG, photographs())
    assert with_decisions(CONFIG, known) == known
    assert stages(with_iterations(known, 200), photographs()) == [(70, 2)]
