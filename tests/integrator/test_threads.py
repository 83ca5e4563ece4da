"""Images of one integrator from several threads of a program."""

import time
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.views import VIEWS, Scene, image_of

import drgs  # noqa: F401  (registers the plugin)


def run_in_two_threads(work) -> list:
    """``work(0)`` and ``work(1)``, run at once; their exceptions are raised here."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(work, (0, 1)))


@pytest.mark.parametrize("shared", [True, False], ids=["one scene", "two scenes"])
def test_two_threads_render_the_same_images_as_one(shared):
    """From sensors in turn, so that no frame is that of the image before."""
    sensors = {f"sensor_{k}": VIEWS[k].sensor() for k in range(3)}  # besides the scene's own
    first = Scene(VIEWS[1]).load_with(objects=sensors)
    scenes = [first, first if shared else Scene(VIEWS[3]).load_with(objects=sensors)]
    expected = [[image_of(scenes[k], sensor=2 * k + s) for s in (0, 1)] for k in (0, 1)]

    def work(number):
        turns = [n % 2 for n in range(10)]
        return [(s, image_of(scenes[number], sensor=2 * number + s)) for s in turns]

    for number, images in enumerate(run_in_two_threads(work)):
        for sensor, rendered in images:
            np.testing.assert_array_equal(rendered, expected[number][sensor])


def test_integrator_renders_one_image_at_a_time():
    """Its frames, its film and the nested integrator's recordings are not those of two."""
    active, most = [], []

    class Slow(mi.CppADIntegrator):
        """Sees nothing, for a while."""

        def render(self, scene, sensor, seed=0, spp=0, develop=True, evaluate=True):
            del scene, seed, spp, develop, evaluate
            active.append(sensor)
            most.append(len(active))
            time.sleep(0.05)
            active.pop()
            width, height = sensor.film().crop_size()
            return dr.zeros(mi.TensorXf, (height, width, 4))

    objects = {"floor": {"type": "rectangle"}, "other": VIEWS[0].sensor()}
    loaded = Scene(VIEWS[1]).load_with(objects=objects, inner=Slow(mi.Properties()))
    run_in_two_threads(lambda number: [image_of(loaded, sensor=number) for _ in range(3)])
    assert most == [1] * 6
