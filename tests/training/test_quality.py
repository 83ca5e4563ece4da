"""PSNR of test views on the way: measured where it is due, with no effect on the fit."""

import pytest
from support.small_fits import everything_of, make_trainer, steps, test_psnr, true_dataset

from drgs.fit import loop as quality
from drgs.fit.loop import History, HistoryRow
from drgs.results.history import DENSITY_COLUMNS, DensityReport, write_density, write_history


def row(iteration, test_psnr=None):
    return HistoryRow(iteration, 0.5, 10.0, 100, 1e-3, 2.0, test_psnr)


@pytest.mark.parametrize(
    ("iterations", "every", "expected"),
    [
        (7000, 10, list(range(700, 7001, 700))),
        (1000, 10, list(range(100, 1001, 100))),
        (300, 7, [105, 210]),  # where there are rows
        (60, 10, []),  # the last is measured in any case
    ],
)
def test_a_fit_is_measured_ten_times_or_every_hundred_iterations(iterations, every, expected):
    rows = []
    for iteration in [*range(every, iterations, every), iterations]:
        rows.append(row(iteration))
        if quality.measurement_is_due(rows, iterations):
            rows[-1] = row(iteration, 20.0)
    assert [r.iteration for r in rows if r.test_psnr is not None] == expected


@pytest.mark.slow
def test_measuring_does_not_change_the_fit():
    """With densification, a filter that follows the means, and random backgrounds."""
    changes = {"model__smoothing": True, "data__random_background": True}
    changes |= {"densify__start": 4, "densify__stop": 30, "densify__every": 5}
    dataset = true_dataset()
    plain = steps(make_trainer(dataset, **changes), 14)
    watched, history = make_trainer(dataset, **changes), History()
    for count in (2, 3, 4, 5):
        history.add([watched.step() for _ in range(count)][-1])
        quality.HeldOutQuality(dataset.test).measure(watched, history)
    assert everything_of(watched) == everything_of(plain)
    assert history.rows[-1].test_psnr == pytest.approx(test_psnr(plain, dataset), abs=1e-4)
    assert len({row.test_psnr for row in history.rows}) == 4


def test_measuring_does_not_count_as_training_time(monkeypatch):
    now = iter([0.0, 5.0])
    monkeypatch.setattr("drgs.fit.loop.time.perf_counter", lambda: next(now))
    history = History()
    history.leave_out(2.0)
    assert history.wall_s == 3.0


def test_history_is_kept_and_written(tmp_path):
    history = History()
    history.rows += [row(10), row(20, 21.5), row(30, float("inf"))]
    assert History.from_arrays(*history.arrays(), 1.0).rows == history.rows
    write_history(tmp_path / "history.csv", history.rows)
    lines = (tmp_path / "history.csv").read_text().splitlines()
    assert [line.split(",")[-1] for line in lines] == ["test_psnr", "", "21.5", "inf"]
    write_density(tmp_path / "density.csv", history.density)
    assert not (tmp_path / "density.csv").exists()
    assert history.arrays()[1].shape == (0, len(DENSITY_COLUMNS))
    history.add_density(20, DensityReport(7, num_added=4, split=2, pruned=3, refused=1))
    history.add_density(40, DensityReport(5, relocated=6, pruned=2))
    again = History.from_arrays(*history.arrays(), 1.0)
    assert again.density == history.density
    write_density(tmp_path / "density.csv", again.density)
    assert (tmp_path / "density.csv").read_text().splitlines() == [
        "iteration,num_gaussians,num_added,cloned,split,relocated,pruned,refused",
        "20,7,4,0,2,0,3,1",
        "40,5,0,0,0,6,2,0",
    ]
