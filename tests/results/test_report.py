"""Reports of fits, made from a few blobs, and noise for photographs."""

import base64
import io
import json
import re
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.small_capture import HEIGHT, WIDTH, blobs, decibels, make_dataset

from drgs.config.approximations import Approximations
from drgs.config.schema import FitConfig, ModelConfig
from drgs.datasets.orbits import orbit_of_views
from drgs.datasets.viewpoints import field_of_view
from drgs.integrator.scene import make_scene, render_views
from drgs.results import curves, report
from drgs.results.history import DensityRow, HistoryRow, summarize_density
from drgs.results.metrics import ssim
from drgs.results.viewer import DisplaySettings

KINDS = ("still", "moving")
VOID = {"meta", "link", "img", "source", "br", "input"}


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


def scored(images, dataset):
    """Return an object that renders the test views as ``images``, and their scores."""
    by_name = {view.name: image for view, image in zip(dataset.test, images, strict=True)}
    scores = [report.score(by_name[view.name], view) for view in dataset.test]
    return lambda views: [by_name[view.name] for view in views], scores


def history(count=120, changes=()):
    rows = [
        HistoryRow(
            i, 1 / i, 10 + i / 10, 100 * i, 1e-3 * 0.9**i, 0.5 * i, None if i % 5 else 8 + i / 10
        )
        for i in range(1, count + 1)
    ]
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
def out(tmp_path_factory, dataset, scene, images):
    folder = tmp_path_factory.mktemp("results") / "blobs"
    folder.mkdir()
    render = partial(render_views, scene)
    scores = report.write_images(folder, dataset, render, with_renders=False, with_comparisons=True)
    fitted = report.FitImages(scene, blobs(), render, DisplaySettings(blobs(), Approximations()))
    report.write_results(folder, dataset, fitted, scores, history(changes=CHANGES), metrics())
    return folder


def test_page_names_the_file_for_viewers():
    assert report._viewers(metrics()) == "splat viewers read it"
    measured = {"psnr": 29.876, "ssim": 0.9, "num_views": 4, "split": "test"}
    text = report._viewers({**metrics(), "viewers": measured})
    assert '<a href="point_cloud_viewers.ply" download>point_cloud_viewers.ply</a>' in text
    assert text.endswith(": they show the test views at 29.88 dB")


def test_all_files_are_written_and_none_temporary(out):
    names = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    comparisons = {f"side_by_side/test/r_{i}.png" for i in range(4)}
    pages = {"report.html", "viewer.html"}
    assert names == {"curves.png", "orbit.webp", "orbit.gif", *pages, *comparisons}


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


def test_one_image_is_in_memory_at_a_time(tmp_path, dataset):
    """Each is written and scored before the next one is rendered; renders only if asked for."""
    rendered = []

    def render(views):
        for index in range(len(views)):
            done = sorted(path.name for path in tmp_path.rglob("*.png"))
            assert done == sorted(2 * [f"r_{k}.png" for k in range(index)])
            rendered.append(np.full((HEIGHT, WIDTH, 3), 0.1 * index, np.float32))
            yield rendered[-1]

    scores = report.write_images(
        tmp_path, dataset, render, with_renders=True, with_comparisons=True
    )
    for score, image, view in zip(scores, rendered, dataset.test, strict=True):
        assert score.psnr == pytest.approx(decibels(image, view.image))
        assert score.ssim == ssim(image, view.image)
        written = np.asarray(Image.open(tmp_path / "renders" / "test" / f"{view.name}.png")) / 255
        assert np.abs(written - image).max() < 0.5 / 255 + 1e-6


def test_comparison_shows_fitted_photograph_and_difference(out, dataset, images):
    pixels = np.asarray(Image.open(out / "side_by_side" / "test" / "r_2.png")) / 255
    step = WIDTH + report.IMAGE_GAP_PX
    fitted, photograph, difference = (pixels[:, k * step : k * step + WIDTH] for k in range(3))
    rounding = 0.5 / 255 + 1e-6
    assert np.abs(fitted - images[2]).max() < rounding
    assert np.abs(photograph - dataset.test[2].image).max() < rounding
    expected = np.clip(0.5 + 5 * (images[2] - dataset.test[2].image), 0, 1)
    assert np.abs(difference - expected).max() < rounding
    assert pixels.shape == (HEIGHT, 3 * WIDTH + 2 * report.IMAGE_GAP_PX, 3)
    assert (pixels[:, WIDTH : WIDTH + report.IMAGE_GAP_PX] == 1).all()


def test_masked_pixels_show_no_difference(dataset, images):
    mask = np.ones((HEIGHT, WIDTH), np.float32)
    mask[:, : WIDTH // 2] = 0
    view = replace(dataset.test[2], mask=mask)
    shown = report.difference(images[2], view)
    assert (shown[:, : WIDTH // 2] == 0.5).all()
    whole = report.difference(images[2], dataset.test[2])
    np.testing.assert_array_equal(shown[:, WIDTH // 2 :], whole[:, WIDTH // 2 :])
    error = (images[2] - view.image)[:, WIDTH // 2 :].astype(np.float64)
    assert report.score(images[2], view).psnr == pytest.approx(-10 * np.log10(np.mean(error**2)))


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
    line = np.array([int(curves.LIGHT.line[i : i + 2], 16) for i in (1, 3, 5)])
    for row in np.array_split(pixels, 2, axis=0):
        for panel in np.array_split(row, 3, axis=1):
            assert (np.abs(panel.astype(int) - line).max(axis=2) < 8).sum() > 100


@pytest.mark.slow
@pytest.mark.parametrize(
    "rows",
    [
        [],
        history(1).rows,
        [replace(row, wall_s=1.0) for row in history(3).rows],
        [replace(row, loss=float("nan"), psnr=float("nan")) for row in history(3).rows],
    ],
    ids=["empty", "one row", "no time between rows", "diverged"],
)
@pytest.mark.filterwarnings("error")
def test_curves_of_unusual_histories_are_drawn(tmp_path, rows):
    shown = SimpleNamespace(rows=rows, density=())
    curves.write_curves(tmp_path / "curves.png", shown)
    with Image.open(tmp_path / "curves.png") as image:
        assert image.size[0] > 800


def test_panels_show_the_history():
    panels = {panel.title: panel for panel in curves.panels_of(history(12))}
    assert panels["Loss"].y[:5] == pytest.approx([1, 1 / 2, 1 / 3, 1 / 4, 1 / 5])
    assert panels["Gaussians"].y[:5].tolist() == [100, 200, 300, 400, 500]
    assert panels["Iterations per second"].x.tolist() == list(range(2, 13))
    assert panels["Iterations per second"].y == pytest.approx([2] * 11)


def test_time_of_curves_is_extrapolated_from_measured_ones(monkeypatch):
    """The first one, of whatever kind, also loads libraries: 9 s here, later ones 1 s, or 0.5 s."""
    drawn = []

    def seconds(panel):
        drawn.append(panel)
        return 9.0 if len(drawn) == 1 else {"log": 1.0, "linear": 0.5}[panel.scale]

    monkeypatch.setattr(report, "_seconds_of_curve", seconds)
    panels = curves.panels_of(history(12))
    once = sum(1.0 if panel.scale == "log" else 0.5 for panel in panels)
    themes = 3  # two in the page, one in the image of all
    assert report.seconds_of_curves() == pytest.approx(themes * once)
    monkeypatch.undo()
    assert report.seconds_of_curves() > 0


def test_population_panel_shows_added_and_removed_gaussians(tmp_path):
    shown = history(90, CHANGES)
    (panel,) = (p for p in curves.panels_of(shown) if p.title == "Gaussians")
    assert set(panel.others) == {"added", "removed"}  # nothing was relocated
    (x, added), (_, removed) = panel.others["added"], panel.others["removed"]
    assert x.tolist() == [0, 20, 40, 60, 90]  # the last iteration
    now = [1000, *(change.num_gaussians for change in CHANGES)]
    assert (1000 + added - removed).tolist() == [*now, now[-1]]
    relocated = [*CHANGES, DensityRow(iteration=80, num_gaussians=2400, relocated=7)]
    (panel,) = (p for p in curves.panels_of(history(80, relocated)) if p.title == "Gaussians")
    assert panel.others["relocated"][1].tolist() == [0, 0, 0, 0, 7, 7]
    (panel,) = (p for p in curves.panels_of(history(80)) if p.title == "Gaussians")
    assert not panel.others


def test_density_summary_lists_actions_and_refusals():
    assert summarize_density("adc", []) is None
    assert summarize_density("adc", CHANGES) == (
        "adc: 1,000 \u2192 2,400 Gaussians; 410 cloned, 1,200 split, 210 pruned, 3 refused"
    )
    relocated = [DensityRow(iteration=8, num_gaussians=50, relocated=9)]
    assert summarize_density("mcmc", relocated) == (
        "mcmc: 50 \u2192 50 Gaussians; 9 relocated, 0 pruned, 0 refused"
    )


def test_psnr_is_plotted_over_time():
    (panel,) = (p for p in curves.panels_of(history(12)) if "test views" in p.title)
    assert panel.x_label == "time [min]"
    assert panel.x == pytest.approx([2.5 / 60, 5 / 60])
    assert panel.y == pytest.approx([8.5, 9])


@pytest.mark.parametrize("count", [1, 7, 50, 333])
def test_running_mean_averages_neighbouring_rows(count):
    values = np.random.default_rng(0).normal(size=count)
    reach = count // 100
    expected = [values[max(0, i - reach) : i + reach + 1].mean() for i in range(count)]
    assert curves._running_mean(values) == pytest.approx(expected)


# ----------------------------------------------------------------------------------------------
# Page
# ----------------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Checks that elements nest; collects text and everything that refers to something."""

    def __init__(self, path):
        super().__init__()
        self.text, self.references, self.open, self.tags = [], [], [], []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        names = ("src", "srcset", "href", "data", "action", "poster", "background", "style")
        self.references += [value for name, value in attributes if name in names]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    def images(self):
        """(bytes) of every embedded image."""
        for reference in self.references:
            if reference.startswith("data:image"):
                kind, data = re.fullmatch(r"data:(image/\w+);base64,(.*)", reference).groups()
                yield kind, base64.b64decode(data, validate=True)


@pytest.fixture(scope="module")
def page(out):
    return Page(out / "report.html")


def test_page_has_no_external_references(page):
    embedded = [reference for reference in page.references if reference.startswith("data:")]
    # The icon, the orbit and its first frame, comparisons, curves for light and dark pages.
    assert len(embedded) == 1 + 2 + 3 * 3 + 6 * 2
    # To be downloaded, and to walk around in.
    assert set(page.references) - set(embedded) == {"point_cloud.ply", "viewer.html"}
    for outside in ("http:", "https:", "file:", "//", "@import", "url(", "<script"):
        assert outside not in re.sub(r"base64,[A-Za-z0-9+/=]*", "", page.source), outside
    assert set(page.tags).isdisjoint({"script", "iframe", "object", "embed"})


def test_images_and_curves_are_stacked_on_a_phone(page):
    phone = re.search(r"@media \(max-width: 560px\) \{(.*?\}\s*)\}", page.source, re.DOTALL)[1]
    assert ".three, .curves { grid-template-columns: minmax(0, 1fr); }" in phone
    text = " ".join(" ".join(page.text).split())
    assert text.count("Fitted Reference Difference") == 3  # each below its own image
    assert page.source.count('<div class="curves"><picture>') == 1
    assert page.tags.count("picture") == 6


def test_the_orbit_can_be_paused_and_honours_reduced_motion(page):
    assert '<input type="checkbox" id="orbit">' in page.source
    assert '<label for="orbit">' in page.source
    still, moving = (re.search(rf'class="{c}"[^>]*src="(.*?)"', page.source)[1] for c in KINDS)
    frames = []
    for rendered in (still, moving):
        with Image.open(io.BytesIO(base64.b64decode(rendered.partition(",")[2]))) as image:
            frames.append((image.n_frames, np.asarray(image.convert("RGB")) / 255))
    assert [count for count, _ in frames] == [1, report.ORBIT_FRAMES]
    assert np.abs(frames[0][1] - frames[1][1]).mean() < 0.05  # lossy, of small colourful images
    reduced = page.source.partition("prefers-reduced-motion: reduce")[2].partition("\n}\n")[0]
    assert ".orbit .moving, .orbit .pause" in reduced.partition("display: none")[0]


@pytest.mark.slow
def test_rendered_datasets_are_not_called_photographs(tmp_path, dataset, images, out, page):
    path, taken = tmp_path / "report.html", replace(dataset, rendered=False)
    orbit = (out / "orbit.webp").read_bytes()
    report.write_report(path, "a", taken, *scored(images, taken), history(2), metrics(), orbit)
    rendered, photographed = "".join(page.text), "".join(Page(path).text)
    assert "Reference" in rendered and "fitted \u2212 reference" in rendered
    assert "Photograph" in photographed and "fitted \u2212 photograph" in photographed
    assert "Photograph" not in rendered and "Reference" not in photographed


def test_images_of_the_page_are_complete(page, out, tmp_path):
    sizes = []
    for index, (kind, data) in enumerate(page.images()):
        path = tmp_path / str(index)
        path.write_bytes(data)
        with Image.open(path) as image:
            image.load()
            assert kind == f"image/{image.format.lower()}"
            sizes.append(image.size)
    assert (out / "orbit.webp").read_bytes() in [data for _, data in page.images()]
    assert sizes.count((WIDTH, HEIGHT)) == 2 + 9
    assert len(page.source) < 3_000_000


def test_page_contains_the_metrics(page):
    text = " ".join(" ".join(page.text).split())
    for stated in (
        "blobs", "noise <small>", "31.23 dB", "mean of 4 test views", "0.9000", "12,345",
        "1 min 15 s", "1,200 iterations", "A <Processor>, 2 threads", "2026-11-23 01:02 (UTC+0100)",
        "drgs fit 'my scene.yml' --data <DIR>", "Seed 7", "drgs 1.2.3, Mitsuba 3.9.1",
        "16.0", "LLVM 19.1.7", "sh_increase_every: 750", "path: photographs",
        "Population budget: 1,000 \u2192 2,400 Gaussians",
    ):  # fmt: skip
        assert stated in text, stated


def test_the_page_shows_the_best_the_median_and_the_worst_view(page, dataset, images):
    scores = {
        view.name: decibels(image, view.image)
        for view, image in zip(dataset.test, images, strict=True)
    }
    ranked = sorted(scores, key=scores.get, reverse=True)
    text = " ".join(" ".join(page.text).split())
    for label, name in (("Best", ranked[0]), ("Median", ranked[2]), ("Worst", ranked[3])):
        assert f"{label}: {name} PSNR {scores[name]:.2f} dB" in text
    for name, score in scores.items():
        assert f"{name} {score:.2f}" in text


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([3.0], [("View", 0)]),
        ([3.0, 5.0], [("View", 1), ("View", 0)]),
        ([1.0, 9.0, 5.0, 7.0, 3.0], [("Best", 1), ("Median", 2), ("Worst", 0)]),
    ],
)
def test_views_are_chosen_by_their_psnr(scores, expected):
    assert report.choose_views(scores) == expected


@pytest.mark.slow
def test_external_text_is_escaped(tmp_path, dataset, images, out):
    hostile = "</pre><script>alert(1)</script>"
    test = tuple(replace(view, name=f"<b>{view.name}") for view in dataset.test)
    dataset = replace(dataset, test=test, description=hostile, test_split=hostile)
    report.write_report(
        tmp_path / "report.html",
        hostile,
        dataset,
        *scored(images, dataset),
        history(),
        metrics(source=hostile),
        (out / "orbit.webp").read_bytes(),
    )
    page = Page(tmp_path / "report.html")
    assert "script" not in page.tags
    assert "<b>r_0" in "".join(page.text)


@pytest.mark.slow
def test_image_equal_to_its_photograph_has_infinite_psnr(tmp_path, dataset, out):
    equal = replace(dataset, test=dataset.test[:1])
    report.write_report(
        tmp_path / "report.html",
        "equal",
        equal,
        *scored([equal.test[0].image], equal),
        history(2),
        json.loads(json.dumps(metrics())),
        (out / "orbit.webp").read_bytes(),
    )
    assert "PSNR infinite" in " ".join(Page(tmp_path / "report.html").text)


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 0 s"), (591, "9 min 51 s"), (7260, "2 h 1 min")],
)
def test_durations_are_readable(seconds, expected):
    assert report.duration(seconds) == expected
