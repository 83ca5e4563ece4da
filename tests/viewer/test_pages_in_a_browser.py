"""The pages of ``fit --view`` and ``view`` in a headless browser: images come and follow."""

import argparse
import json
import math
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.fit_command import write_scene

from drgs import view
from drgs.datasets.viewpoints import FIELD_OF_VIEW
from drgs.integrator.scene import render_views
from drgs.results.model import load_model

pytest.importorskip("viser", reason="viser is not installed (the extra viewer)")
browsers = pytest.importorskip("support.browser", reason="needs POSIX", exc_type=ImportError)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(browsers.PROGRAM is None, reason="needs Chromium or Chrome"),
]

ENDLESS = 100_000
"""Iterations."""

FADE_SECONDS = 3
"""Time until a page appears and shows the progress of a fit."""


@contextmanager
def command(*words, log: Path):
    """A command of drgs in a process, and the address of its page."""
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", *map(str, words)],
            cwd=REPOSITORY,
            stdout=output,
            stderr=subprocess.STDOUT,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
    try:
        browsers.wait_until(
            lambda: process.poll() is not None or "http://" in log.read_text(), "a page"
        )
        assert process.poll() is None, log.read_text()
        yield process, "http://" + log.read_text().split("http://")[1].split()[0]
    finally:
        process.kill()
        process.wait()


def shown(rendered: np.ndarray) -> np.ndarray:
    """(H, W, 3) float: below the browser's warning, beside and above the controls."""
    height, width, _ = rendered.shape
    return rendered[height // 5 : 3 * height // 5, : width // 2].astype(float)


def seen(page) -> np.ndarray:
    """The same of what the page shows, 0 to 255."""
    return shown(255 * page.rendered())


def wait_for_an_image(page) -> np.ndarray:
    """Splats on white, once the page has ceased to fade in."""

    def has_appeared() -> bool:
        rendered = 255 * page.rendered()
        return rendered[-20:, :20].min() > 250 and np.ptp(shown(rendered)) > 100

    browsers.wait_until(has_appeared, "an image")
    return seen(page)


def assert_clean(page, address: str) -> None:
    """No error, and nothing from anywhere else."""
    assert page.console_errors(["error"]) == []
    hosts = {urlsplit(request).netloc for request in page.requests() if request[:4] == "http"}
    assert hosts == {urlsplit(address).netloc}


def expected_view(run: Path, width: int, height: int) -> np.ndarray:
    """Return the image by ``drgs.render`` of the camera that a page begins with."""
    mi.set_variant("llvm_ad_rgb")
    args = argparse.Namespace(what=run, up=None)
    model = load_model(run)
    (camera,) = view.cameras_of(args, model)
    # The field of view spans the smaller side: a phone's window is narrower than high.
    focal = 0.5 * min(width, height) / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    size = {"cx": width / 2, "cy": height / 2, "width": width, "height": height}
    (rendered,) = render_views(model.scene(), [replace(camera, fx=focal, fy=focal, **size)])
    return 255 * rendered


@pytest.mark.parametrize("size", browsers.SIZES)
def test_page_shows_gaussians_and_orbits_with_the_mouse(fit, size, tmp_path):
    width, height = browsers.SIZES[size]
    with (
        command("drgs.view", fit, log=tmp_path / "log") as (process, address),
        browsers.browser_page(width, height) as page,
    ):
        page.open(address)
        wait_for_an_image(page)
        page.wait_for("/\\d+ ms for \\d+×\\d+/.test(document.body.innerText)")
        expected = shown(expected_view(fit, width, height))
        # JPEG at a quality of 92 is within one or two of 255, half a pixel more at edges.
        browsers.wait_until(lambda: np.abs(seen(page) - expected).mean() < 3, "the expected image")
        before, middle = seen(page), (0.3 * width, 0.3 * height)
        page.drag(middle, (middle[0] + 60, middle[1] - 20))
        browsers.wait_until(lambda: np.abs(seen(page) - before).mean() > 6, "another image")
        assert_clean(page, address)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


def test_page_of_a_fit_shows_pauses_and_ends_it(tmp_path):
    config = write_scene(tmp_path, iterations=ENDLESS, densify={"start": 1, "stop": 2})
    out, log = tmp_path / "out", tmp_path / "log"
    words = ("drgs.fit", config, "--out", out, "--view", "--set", "output.report=false")
    with (
        command(*words, log=log) as (process, address),
        browsers.browser_page(*browsers.SIZES["desktop"]) as page,
    ):

        def iteration() -> int:
            text = page.evaluate("document.body.innerText")
            return int(text.split(f" of {ENDLESS:,} ")[0].split()[-1].replace(",", ""))

        page.open(address)
        page.wait_for(f"document.body.innerText.includes(' of {ENDLESS:,} iterations')")
        browsers.wait_until(lambda: np.ptp(seen(page)) > 40, "an image")
        time.sleep(FADE_SECONDS)
        before = seen(page)
        page.drag((400, 500), (460, 470))
        browsers.wait_until(lambda: np.abs(seen(page) - before).mean() > 3, "another image")
        first = iteration()
        browsers.wait_until(lambda: iteration() > first, "progress")
        page.click("Pause")
        page.wait_for(
            "[...document.querySelectorAll('button')].some(b => b.innerText == 'Continue')"
        )
        time.sleep(FADE_SECONDS)
        held, still = iteration(), seen(page)
        page.drag((400, 500), (340, 530))
        browsers.wait_until(lambda: np.abs(seen(page) - still).mean() > 3, "an image in the pause")
        assert iteration() == held
        page.click("Continue")
        browsers.wait_until(lambda: iteration() > held, "progress after the pause")
        assert_clean(page, address)  # once the fit has ended, nobody answers the page
        page.click("End and write results")
        page.click("End")
        assert process.wait(120) == 0, log.read_text()
        done = json.loads((out / "metrics.json").read_text())["iterations"]
        assert held < done < ENDLESS and f"{done} iterations in" in log.read_text()
