"""Renderings and loaded scenes leave nothing behind: hundreds of them take no more memory."""

import gc
import itertools
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest
from support.views import VIEWS, Scene

import drgs  # noqa: F401  (registers the plugin)

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 200, 150
"""px: an image that is kept would take 0.5 MB, its frame 3 MB."""

MEGABYTE = 1 << 20
SCENE = Scene(count=2000)
KINDS = {"splats": {}, "surfaces": {"floor": {"type": "rectangle"}, "sky": {"type": "constant"}}}


def load(kind):
    size = {"width": WIDTH, "height": HEIGHT}
    sensors = {f"sensor_{k}": VIEWS[k].sensor(**size) for k in range(2)}
    return SCENE.load_with(SCENE.view.sensor(**size), sensors | KINDS[kind])


def resident() -> int:
    """Bytes that the process has, without what Dr.Jit keeps for its next arrays."""
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    statm = Path("/proc/self/statm")
    if not statm.exists():
        pytest.skip("there is no /proc here")
    return int(statm.read_text().split()[1]) * 4096


def growth(action, warm, count) -> float:
    """Megabytes that ``count`` actions leave behind, after ``warm`` of them.

    The least of three times: a leak shows each time, memory that the process takes once does not.
    """
    steps, grown = itertools.count(), []
    for _ in range(warm):
        action(next(steps))
    for _ in range(3):
        before = resident()
        for _ in range(count):
            action(next(steps))
        grown.append((resident() - before) / MEGABYTE)
    return min(grown)


@pytest.mark.parametrize(("kind", "count"), [("splats", 130), ("surfaces", 40)])
def test_rendering_does_not_leak_memory(kind, count):
    """2,000 of splats, measured by hand, stayed at 185.6 MB from the 500th on."""
    scene = load(kind)
    assert growth(lambda k: dr.eval(mi.render(scene, sensor=k % 3, seed=k)), 60, count) < 4


def test_optimizer_steps_do_not_leak_memory():
    scene = load("splats")
    params = mi.traverse(scene)
    optimizer = mi.ad.Adam(lr=1e-4, params={"integrator.means": params["integrator.means"]})

    def step(k):
        params.update(optimizer)
        dr.backward(dr.mean(mi.render(scene, params, sensor=k % 3), axis=None))
        optimizer.step()

    assert growth(step, 100, 70) < 4
