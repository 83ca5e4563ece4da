"""Reports of fits, made from a few blobs, and noise for photographs."""

import base64
import io
import re
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.html_page import HtmlPage
from support.small_capture import HEIGHT, WIDTH, blobs, decibels, make_dataset

from drgs.cameras.orbits import orbit_of_views
from drgs.cameras.viewpoints import field_of_view
from drgs.config.approximations import Approximations
from drgs.config.schema import FitConfig, ModelConfig
from drgs.fit import curves, report
from drgs.integrator.scene import make_scene, render_views
from drgs.results.history import DensityRow, HistoryRow
from drgs.results.html_viewer import DisplaySettings
from drgs.results.metrics import NUM_WAITING, ssim

ROUNDING = 0.5 / 255 + 1e-6
HOSTILE = "</pre><script>alert(1)</script>"


@pytest.fixture(scope="module")
def dataset():
    return replace(make_dataset(), rendered=True)


@pytest.fixture(scope="module")
def scene(dataset):
    mi.set_variant("llvm_ad_rgb")
    return make_scene(blobs(), ModelConfig(), dataset.background)


@pytest.fixture(scope="module")
def images(dataset, scene):
    return list(render_views(scene, dataset.test))


def history(count=120, changes=()):
    rows = []
    for i in range(1, count + 1):
        tested = None if i % 5 else 8 + i / 10
        row = HistoryRow(i, 1 / i, 10 + i / 10, 100 * i, 1e-3 * 0.9**i, 0.5 * i, tested)
        rows.append(row)
    return SimpleNamespace(rows=rows, density=changes)


CHANGES = [
    DensityRow(iteration=20, num_gaussians=1500, num_added=600, cloned=400, split=200, pruned=100),
    DensityRow(iteration=40, num_gaussians=1400, pruned=100, refused=3),
    DensityRow(iteration=60, num_gaussians=2400, num_added=1010, cloned=10, split=1000, pruned=10),
]
"""Changes of a fit that began with 1000 Gaussians."""


def metrics(**data):
    config = FitConfig.model_validate({"data": {"path": "photographs", **data}})
    return {
        "iterations": 1200,
        "num_gaussians": 12345,
        "wall_s": 75.2,
        "test": {"psnr": 31.234, "ssim": 0.9, "num_views": 4, "split": "test"},
        "viewers": {"psnr": 29.876, "ssim": 0.9, "num_views": 4, "split": "test"},
        "seed": 7,
        "versions": {"drgs": "1.2.3", "mitsuba": "3.9.1", "llvm": "19.1.7"},
        "variant": "llvm_ad_rgb",
        "threads": 2,
        "processor": "A <Processor>",
        "date": "2026-11-23T01:02+01:00",
        "command": "drgs fit 'my scene.yml' --data <DIR>",
        "config": config.model_dump(mode="json"),
    }


@pytest.fixture(scope="module")
def out(tmp_path_factory, dataset, scene):
    folder = tmp_path_factory.mktemp("results") / "blobs"
    folder.mkdir()
    render = partial(render_views, scene)
    scores = report.write_images(folder, dataset, render, with_renders=False, with_comparisons=True)
    fitted = report.FitImages(scene, blobs(), render, DisplaySettings(blobs(), Approximations()))
    report.write_results(folder, dataset, fitted, scores, history(changes=CHANGES), metrics())
    return folder


@pytest.fixture(scope="module")
def page(out):
    return HtmlPage((out / "report.html").read_text())


def test_few_images_are_in_memory_at_a_time(tmp_path, dataset):
    """All but the last ones are written and scored before the next one is rendered."""
    views = tuple(replace(dataset.test[0], name=f"r_{k}") for k in range(6))
    dataset, rendered = replace(dataset, test=views), []

    def render(views):
        for index in range(len(views)):
            done = [path.name for path in tmp_path.rglob("*.png")]
            assert all(done.count(f"r_{k}.png") == 2 for k in range(index - NUM_WAITING))
            rendered.append(np.full((HEIGHT, WIDTH, 3), 0.1 * index, np.float32))
            yield rendered[-1]

    scores = report.write_images(
        tmp_path, dataset, render, with_renders=True, with_comparisons=True
    )
    for score, image, view in zip(scores, rendered, dataset.test, strict=True):
        assert score.psnr == pytest.approx(decibels(image, view.image))
        assert score.ssim == ssim(image, view.image)
        written = np.asarray(Image.open(tmp_path / "renders" / "test" / f"{view.name}.png")) / 255
        assert np.abs(written - image).max() < ROUNDING


def test_all_views_are_scored_and_evenly_spaced_ones_are_pictured(tmp_path, dataset, monkeypatch):
    monkeypatch.setattr(report, "MAX_PICTURES", 3)
    image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    views = tuple(replace(dataset.test[0], name=f"r_{k}") for k in range(5))
    many, switches = replace(dataset, test=views), {"with_renders": True, "with_comparisons": True}
    assert len(report.write_images(tmp_path, many, lambda views: [image] * 5, **switches)) == 5
    for folder in ("renders", "side_by_side"):
        names = sorted(path.name for path in (tmp_path / folder / "test").iterdir())
        assert names == ["r_0.png", "r_2.png", "r_4.png"]


def test_comparison_shows_fitted_photograph_and_difference(out, dataset, images):
    """Masked pixels show no difference."""
    pixels = np.asarray(Image.open(out / "side_by_side" / "test" / "r_2.png")) / 255
    step, view = WIDTH + report.IMAGE_GAP_PX, dataset.test[2]
    assert pixels.shape == (HEIGHT, 2 * step + WIDTH, 3)
    assert (pixels[:, WIDTH:step] == 1).all()
    difference = np.clip(0.5 + 5 * (images[2] - view.image), 0, 1)
    for k, expected in enumerate((images[2], view.image, difference)):
        shown = pixels[:, k * step : k * step + WIDTH]
        assert np.abs(shown - expected).max() < ROUNDING

    half, mask = WIDTH // 2, np.ones((HEIGHT, WIDTH), np.float32)
    mask[:, :half] = 0
    masked = replace(view, mask=mask)
    shown = report.difference(images[2], masked)
    assert (shown[:, :half] == 0.5).all()
    np.testing.assert_array_equal(shown[:, half:], report.difference(images[2], view)[:, half:])
    expected = decibels(images[2][:, half:].astype(float), view.image[:, half:])
    assert report.score(images[2], masked).psnr == pytest.approx(expected)


def test_orbit_has_the_aspect_ratio_of_the_photographs_and_shows_the_scene(out, dataset, scene):
    animation = Image.open(out / "orbit.webp")
    assert (animation.n_frames, animation.size) == (report.ORBIT_FRAMES, (WIDTH, HEIGHT))
    fov = field_of_view(dataset.train)
    orbit = orbit_of_views(dataset.train, blobs())
    camera = orbit.viewpoints(report.ORBIT_FRAMES, WIDTH, HEIGHT, fov)[17]
    (expected,) = render_views(scene, [camera])
    animation.seek(17)
    difference = np.asarray(animation.convert("RGB")) / 255 - expected
    assert np.abs(difference).mean() < 0.05  # lossy, of small colourful images


def test_curves_are_drawn(out):
    pixels = np.asarray(Image.open(out / "curves.png").convert("RGB"))
    assert pixels.shape[0] > 400 and pixels.shape[1] > 800
    line = np.array([int(curves.LINE[i : i + 2], 16) for i in (1, 3, 5)])
    for row in np.array_split(pixels, 2, axis=0):
        for panel in np.array_split(row, 3, axis=1):
            assert (np.abs(panel.astype(int) - line).max(axis=2) < 8).sum() > 100


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_curves_of_unusual_histories_are_drawn(tmp_path):
    """Empty, of one row, without time between rows, and diverged."""
    still = [replace(row, wall_s=1.0) for row in history(3).rows]
    diverged = [replace(row, loss=float("nan"), psnr=float("nan")) for row in still]
    for rows in ([], history(1).rows, still, diverged):
        curves.write_curves(tmp_path / "curves.png", SimpleNamespace(rows=rows, density=()))
        with Image.open(tmp_path / "curves.png") as image:
            assert image.size[0] > 800


def test_panels_show_the_history():
    panels = {panel.title: panel for panel in curves.panels_of(history(12))}
    assert panels["Loss"].y[:5] == pytest.approx([1, 1 / 2, 1 / 3, 1 / 4, 1 / 5])
    assert panels["Gaussians"].y[:5].tolist() == [100, 200, 300, 400, 500]
    assert not panels["Gaussians"].others
    assert panels["Iterations per second"].x.tolist() == list(range(2, 13))
    assert panels["Iterations per second"].y == pytest.approx([2] * 11)
    (tested,) = (panel for title, panel in panels.items() if "test views" in title)
    assert tested.x_label == "time [min]"
    assert tested.x == pytest.approx([2.5 / 60, 5 / 60])
    assert tested.y == pytest.approx([8.5, 9])


def test_page_has_no_external_references_and_its_images_are_complete(page, out, dataset):
    embedded = [reference for reference in page.references if reference.startswith("data:")]
    # The icon, the orbit and its first frame, comparisons, curves, the worst photographs.
    assert len(embedded) == 1 + 2 + 3 * 3 + 6 + min(6, len(dataset.train))
    # To be downloaded, and to walk around in.
    links = {"point_cloud.ply", "point_cloud_drgs.ply", "viewer.html"}
    assert set(page.references) - set(embedded) == links
    for outside in ("http:", "https:", "file:/", "//", "@import", "url(", "<script"):
        assert outside not in re.sub(r"base64,[A-Za-z0-9+/=]*", "", page.source), outside
    assert set(page.tags).isdisjoint({"script", "iframe", "object", "embed"})
    contents = []
    for reference in embedded:
        if kind := re.match(r"data:image/(\w+);base64,", reference):
            contents.append(base64.b64decode(reference[kind.end() :], validate=True))
            with Image.open(io.BytesIO(contents[-1])) as image:
                image.load()
                assert image.format.lower() == kind[1]
        elif reference.startswith("data:image/svg+xml;base64,"):
            curve = base64.b64decode(reference.partition(",")[2], validate=True).decode()
            texts = ElementTree.fromstring(curve).iter("{http://www.w3.org/2000/svg}text")
            assert any(text.text == "iteration" or text.text == "time [min]" for text in texts)
    assert (out / "orbit.webp").read_bytes() in contents
    assert '<input type="checkbox" id="orbit">' in page.source  # pauses it
    reduced = page.source.partition("prefers-reduced-motion: reduce")[2].partition("\n}\n")[0]
    assert ".orbit .moving, .orbit .pause" in reduced.partition("display: none")[0]


def test_page_contains_the_metrics_and_the_best_median_and_worst_view(page, dataset, images):
    for stated in (
        "blobs", "noise <small>", "31.23 dB", "mean of 4 test views", "0.9000", "12,345",
        "1 min 15 s", "1,200 iterations", "A <Processor>, 2 threads", "2026-11-23 01:02 (UTC+0100)",
        "drgs fit 'my scene.yml' --data <DIR>", "Seed 7", "drgs 1.2.3, Mitsuba 3.9.1",
        "16.0", "LLVM 19.1.7", "sh_increase_every: 1000", "path: photographs",
        "Population budget: 1,000 \u2192 2,400 Gaussians", "viewers show 4 test views at 29.88 dB",
    ):  # fmt: skip
        assert stated in page.text, stated
    pairs = zip(dataset.test, images, strict=True)
    scores = {view.name: decibels(image, view.image) for view, image in pairs}
    ranked = sorted(scores, key=scores.get, reverse=True)
    for label, name in (("Best", ranked[0]), ("Median", ranked[2]), ("Worst", ranked[3])):
        assert f"{label}: {name} PSNR {scores[name]:.2f} dB" in page.text
    for name, score in scores.items():
        assert f"{name} {score:.2f}" in page.text
    for seconds, expected in ((59.4, "59 s"), (59.6, "1 min 0 s"), (7260, "2 h 1 min")):
        assert report.duration(seconds) == expected


@pytest.mark.slow
def test_photographs_with_hostile_names_are_shown_as_text(tmp_path, dataset, out):
    """The first image equals its photograph."""
    test = tuple(replace(view, name=f"<b>{view.name}") for view in dataset.test)
    dataset = replace(dataset, test=test, description=HOSTILE, test_split=HOSTILE, rendered=False)
    views = (*test, *dataset.train)
    images = {view.name: np.asarray(view.image) * (0.5 if k else 1) for k, view in enumerate(views)}
    scores = [report.score(images[view.name], view) for view in test]
    path, orbit = tmp_path / "report.html", (out / "orbit.webp").read_bytes()
    facts = (lambda views: [images[view.name] for view in views]), scores, history()
    shown = metrics(source=HOSTILE)
    del shown["viewers"]
    report.write_report(path, HOSTILE, dataset, *facts, shown, orbit)
    page = HtmlPage(path.read_text())
    assert "script" not in page.tags and "splat viewers read it" in page.text
    assert "<b>r_0 PSNR infinite" in page.text
    assert "fitted \u2212 photograph" in page.text and "Reference" not in page.text
