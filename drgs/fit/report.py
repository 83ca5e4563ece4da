"""The report of a fit: comparisons, curves, an orbit, and one page with all of them."""

from __future__ import annotations

import base64
import html
import io
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from importlib import resources
from pathlib import Path
from string import Template
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import yaml
from PIL import Image

from drgs.cameras.orbits import orbit_of_views, orbit_size
from drgs.cameras.viewpoints import field_of_view
from drgs.core.files import write_bytes
from drgs.datasets.images import downscale
from drgs.datasets.types import Dataset, View, evenly_spaced
from drgs.fit.curves import NUM_PANELS, Panel, draw_curve, panels_of, write_curves
from drgs.fit.loop import History
from drgs.fit.ranking import RankedPhotograph, Render, rank_photographs
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import render_views
from drgs.io.images import encode, to_uint8, write_animation, write_png
from drgs.results.folder import (
    CURVES,
    GAUSSIANS,
    ORBIT,
    OWN_GAUSSIANS,
    RENDERS,
    REPORT,
    SIDE_BY_SIDE,
    VIEWER,
)
from drgs.results.history import summarize_density
from drgs.results.html_viewer import DisplaySettings, seconds_of_page, write_viewer
from drgs.results.metrics import FitMetrics, map_ahead, psnr, ssim

MAX_PICTURES = 25
"""Test views, at most, whose images are written; ``python -m drgs.render`` writes all."""

DIFFERENCE_GAIN = 5.0
"""Gain of difference images, 0.5 + gain (fitted - truth): they saturate at 10 % of the range."""

IMAGE_GAP_PX = 4  # white, between the images of a comparison
ORBIT_FRAMES = 60
PANEL_WIDTH_PX = 360  # maximum width of an image in the page's comparisons

PANEL_ENCODING = {"lossless": True, "quality": 60, "method": 2}
"""Lossy coding leaves a haze around objects before a white background."""

MIN_TRIAL_SECONDS = 0.05  # for averaging calls of a few milliseconds
FILES_SECONDS = 0.3  # time of the other files, measured with 50,000 Gaussians


class Score(NamedTuple):
    """Scores of an image against its photograph."""

    psnr: float  # dB
    ssim: float


def write_images(
    out: Path, dataset: Dataset, render: Render, with_renders: bool, with_comparisons: bool
) -> list[Score]:
    """Score the test views, and write ``renders/`` and ``side_by_side/`` if requested."""
    split = dataset.test_split
    pictured = {view.name for view in evenly_spaced(dataset.test, MAX_PICTURES)}

    def finish(view: View, image: np.ndarray) -> Score:
        view = replace(view, image=np.asarray(view.image))  # converted once
        is_pictured = view.name in pictured
        if with_renders and is_pictured:
            write_png(out / RENDERS / split / f"{view.name}.png", image)
        if with_comparisons and is_pictured:
            write_png(out / SIDE_BY_SIDE / split / f"{view.name}.png", side_by_side(image, view))
        return score(image, view)

    return list(map_ahead(finish, zip(dataset.test, render(dataset.test), strict=True)))


@dataclass(frozen=True, eq=False)
class FitImages:
    """Renderer inputs of a finished fit."""

    scene: mi.Scene  # renders ``gaussians``, in display space
    gaussians: Gaussians
    render: Render
    shown: DisplaySettings  # in ``viewer.html``


def write_results(
    out: Path,
    dataset: Dataset,
    fitted: FitImages,
    scores: Sequence[Score],
    history: History,
    metrics: FitMetrics,
) -> None:
    """Write ``curves.png``, ``orbit.webp``, ``viewer.html``, ``report.html``; scores: by view."""
    orbit = orbit_of_views(dataset.train, fitted.gaussians)
    size, fov = orbit_size(dataset.train), field_of_view(dataset.train)
    cameras = orbit.viewpoints(ORBIT_FRAMES, *size, fov)
    frames = [to_uint8(frame) for frame in render_views(fitted.scene, cameras)]
    with ThreadPoolExecutor(1) as pool:
        encoding = pool.submit(write_animation, out / ORBIT, frames)
        write_curves(out / CURVES, history)
        write_viewer(out, dataset, fitted.shown)
        encoding.result()
    animation, title = (out / ORBIT).read_bytes(), out.resolve().name
    write_report(out / REPORT, title, dataset, fitted.render, scores, history, metrics, animation)


class Seconds(NamedTuple):
    """Times after the iterations."""

    measuring: float  # the test views
    viewers: float  # those of them that the file for other viewers is measured on
    renders: float  # ``renders/``
    report: float  # ``side_by_side/`` and what :func:`write_results` writes


def seconds_of_results(
    scene: mi.Scene, dataset: Dataset, num_gaussians: int, sh_degree: int
) -> Seconds:
    """Estimate the results' time by timing one test view and two curves, for the last Gaussians."""
    view, x = dataset.test[0], np.linspace(1.0, 100.0, 1000)
    (image,) = render_views(scene, (view,))
    rendered = _seconds_of(lambda: list(render_views(scene, (view,))))
    scored = _seconds_of(lambda: score(image, view))
    written = _seconds_of(lambda: encode(image, "png"))
    compared = _seconds_of(lambda: encode(side_by_side(image, view), "png"))
    encoded = _seconds_of(lambda: encode(image, "webp", **PANEL_ENCODING))
    log, linear = (
        _seconds_of(lambda: draw_curve(Panel("", x, x, scale=scale, noisy=True)))  # noqa: B023
        for scale in ("log", "linear")
    )
    views, pictures = len(dataset.test), min(MAX_PICTURES, len(dataset.test))
    return Seconds(
        measuring=FILES_SECONDS + views * (rendered + scored),
        viewers=FILES_SECONDS + pictures * (rendered + scored),
        renders=pictures * written,
        report=seconds_of_page(num_gaussians, sh_degree)
        + pictures * compared
        + len(choose_views(range(views))) * (rendered + 3 * encoded)
        + len(dataset.train) * rendered  # to be ranked
        + ORBIT_FRAMES * (2 * rendered + encoded)
        + 2 * NUM_PANELS * (log + 2 * linear) / 3,  # a third of the curves are logarithmic
    )


def _seconds_of(call: Callable[[], object]) -> float:
    """Return the median time of a call, without the first, which loads kernels and libraries."""
    call()
    times: list[float] = []
    while sum(times) < MIN_TRIAL_SECONDS:
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def side_by_side(image: np.ndarray, view: View) -> np.ndarray:
    """Return (H, 3 W + 2 gaps, 3): fitted, truth, 0.5 + 5 (fitted - truth)."""
    gap = np.ones((len(image), IMAGE_GAP_PX, 3), np.float32)
    return np.concatenate([image, gap, view.image, gap, difference(image, view)], axis=1)


def difference(image: np.ndarray, view: View) -> np.ndarray:
    """Return 0.5 + 5 (fitted - truth), clipped; 0.5 in masked pixels."""
    values = image - view.image
    if view.mask is not None:
        values = values * view.mask[..., None]
    return np.clip(0.5 + DIFFERENCE_GAIN * values, 0, 1)


def score(image: np.ndarray, view: View) -> Score:
    """Score an image (H, W, 3) of ``view``, display space."""
    photograph = np.asarray(view.image)
    return Score(psnr(image, photograph, view.mask), ssim(image, photograph, view.mask))


def write_report(
    path: Path,
    title: str,
    dataset: Dataset,
    render: Render,
    scores: Sequence[Score],
    history: History,
    metrics: FitMetrics,
    orbit: bytes,
) -> None:
    """Write a self-contained HTML file; scores: by test view; orbit: bytes of an animated WebP."""
    chosen, has_viewer = choose_views([s.psnr for s in scores]), path.with_name(VIEWER).is_file()
    ranked = rank_photographs(dataset.train, render, dataset.background)
    first_frame = Image.open(io.BytesIO(orbit)).convert("RGB")
    template = resources.files("drgs.results").joinpath("page.html").read_text("utf-8")
    page = Template(template).substitute(
        title=html.escape(title),
        description=html.escape(dataset.description),
        tiles=_headline(metrics),
        facts="".join(_row(*fact) for fact in _facts(dataset, metrics, history)),
        split=html.escape(dataset.test_split),
        orbit=_uri("image/webp", orbit),
        still=_data_uri(np.asarray(first_frame), lossless=True),
        gaussians=GAUSSIANS,
        viewers=_viewers(metrics),
        walk=f'<a href="{VIEWER}">Walk around in it</a>. ' if has_viewer else "",
        command=html.escape(metrics["command"]),
        comparisons="".join(
            _comparison(dataset, render, label, index, scores[index]) for label, index in chosen
        ),
        truth=_truth(dataset).lower(),
        gain=f"{DIFFERENCE_GAIN:g}",
        curves="".join(_curve(panel) for panel in panels_of(history)),
        views="".join(
            _row(view.name, f"{score.psnr:.2f}")
            for view, score in zip(dataset.test, scores, strict=True)
        ),
        worst="".join(_photograph_figure(each) for each in ranked if each.images is not None),
        training_views="".join(_row(each.name, f"{each.psnr:.2f}") for each in ranked),
        config=html.escape(yaml.safe_dump(metrics["config"], sort_keys=False)),
    )
    write_bytes(path, page.encode("utf-8", "backslashreplace"))


def choose_views(scores: Sequence[float]) -> list[tuple[str, int]]:
    """Return (label, index) of the best, median and worst view; of all if fewer than three."""
    order = sorted(range(len(scores)), key=lambda index: -scores[index])
    if len(order) < 3:
        return [("View", index) for index in order]
    return [("Best", order[0]), ("Median", order[len(order) // 2]), ("Worst", order[-1])]


def _headline(metrics: FitMetrics) -> str:
    test, unit = metrics["test"], " <small>dB</small>"
    numbers = {
        f"PSNR, mean of {test['num_views']} {test['split']} views": f"{test['psnr']:.2f}{unit}",
        "SSIM": f"{test['ssim']:.4f}",
        "Gaussians": f"{metrics['num_gaussians']:,}",
        f"for {metrics['iterations']:,} iterations": duration(metrics["wall_s"]),
    }
    return "".join(
        f"<div><strong>{value}</strong><span>{html.escape(label)}</span></div>"
        for label, value in numbers.items()
    )


def _facts(dataset: Dataset, metrics: FitMetrics, history: History) -> list[tuple[str, str]]:
    versions = metrics["versions"]
    names = {"mitsuba": "Mitsuba", "drjit": "Dr.Jit", "numpy": "NumPy", "python": "Python"}
    names["llvm"] = "LLVM"
    speed = metrics["iterations"] / max(metrics["wall_s"], 1e-9)
    population = summarize_density(metrics["config"]["densify"]["strategy"], history.density)
    return [
        ("Training views", f"{len(dataset.train)}"),
        ("Test views", f"{len(dataset.test)} (split {dataset.test_split})"),
        *([] if population is None else [("Population", population)]),
        ("Iterations per second", f"{speed:.1f}"),
        ("Processor", f"{metrics['processor']}, {metrics['threads']} threads"),
        ("Date", f"{datetime.fromisoformat(metrics['date']):%Y-%m-%d %H:%M (UTC%z)}"),
        ("Mitsuba variant", metrics["variant"]),
        ("Seed", f"{metrics['seed']}"),
        ("Versions", ", ".join(f"{names.get(k, k)} {v}" for k, v in versions.items())),
    ]


def _viewers(metrics: FitMetrics) -> str:
    if "viewers" not in metrics:
        return "splat viewers read it"
    shown = metrics["viewers"]
    link = f'<a href="{OWN_GAUSSIANS}" download>{OWN_GAUSSIANS}</a>'
    return (
        f"most splat viewers show {shown['num_views']} {shown['split']} views at "
        f"{shown['psnr']:.2f} dB; for drgs, use {link}"
    )


def duration(seconds: float) -> str:
    """Return a text such as ``9 min 51 s``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _comparison(dataset: Dataset, render: Render, label: str, index: int, score: Score) -> str:
    view = dataset.test[index]
    (image,) = render((view,))
    panels = {"Fitted": image, _truth(dataset): view.image, "Difference": difference(image, view)}
    renders = "".join(
        f'<div><img alt="{name} {html.escape(view.name)}" '
        f'src="{_data_uri(downscale(np.clip(rendered, 0, 1), PANEL_WIDTH_PX), **PANEL_ENCODING)}">'
        f"<span>{name}</span></div>"
        for name, rendered in panels.items()
    )
    psnr = f"{score.psnr:.2f} dB" if math.isfinite(score.psnr) else "infinite"
    caption = f"<b>{label}: {html.escape(view.name)}</b> PSNR {psnr}, SSIM {score.ssim:.4f}"
    return f'<figure><figcaption>{caption}</figcaption><div class="three">{renders}</div></figure>'


def _photograph_figure(photograph: RankedPhotograph) -> str:
    assert photograph.images is not None, "the worst have images"
    name, hint = html.escape(photograph.name), html.escape(photograph.hint)
    source = _data_uri(np.clip(photograph.images, 0, 1), **PANEL_ENCODING)
    caption = f"<b>{name}</b> PSNR {photograph.psnr:.2f} dB{': ' if hint else ''}{hint}"
    return (
        f'<figure><img alt="{name}, photograph and rendering" src="{source}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _truth(dataset: Dataset) -> str:
    return "Reference" if dataset.rendered else "Photograph"


def _curve(panel: Panel) -> str:
    source = _uri("image/svg+xml", draw_curve(panel).encode())
    return f'<img alt="{panel.title} over {panel.x_label}" src="{source}">'


def _row(name: str, value: str) -> str:
    return f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>"


def _data_uri(image: np.ndarray, **options: float) -> str:
    return _uri("image/webp", encode(image, "webp", **options))


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
