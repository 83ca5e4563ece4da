"""Images that ask for more than there is are refused before anything is allocated or compiled."""

import mitsuba as mi
import numpy as np
import pytest
from support.views import VIEWS, Scene
from support.wall_scenes import WALL

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.errors import PluginError
from drgs.integrator import image_render
from drgs.integrator.image_render import MAX_SAMPLES

SCENE = Scene(VIEWS[1], count=8)  # 37 x 23 px


load = SCENE.load_with


def refusal(scene, **arguments) -> str:
    with pytest.raises(PluginError) as caught:
        scene.integrator().render(scene, **arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("sampler", ["independent", "stratified", "orthogonal", "ldsampler"])
@pytest.mark.parametrize("count", [0, 10**9])
def test_invalid_sample_counts_are_refused(sampler, count):
    """Mitsuba makes some samplers' 0 a number of their own; ``independent`` ended the process."""
    scene = load(SCENE.view.sensor(sampler=sampler, samples=count))
    taken = scene.sensors()[0].sampler().sample_count()
    if taken == 0:
        assert refusal(scene) == (
            "splats: the samples per pixel (spp, or the sampler's sample_count) must be an integer "
            "of at least 1, got 0"
        )
    elif count:
        assert refusal(scene) == (
            f"splats: a pixel can have at most 4,096 samples, got {taken:,}; take the mean of "
            "images with other seeds, or, for surfaces alone, set nested_spp"
        )
    else:
        assert np.isfinite(np.array(mi.render(scene))).all()


@pytest.mark.parametrize(
    ("spp", "message"),
    [
        (-1, "at least 1, got -1"),
        (MAX_SAMPLES + 1, "at most 4,096 samples, got 4,097;"),
        (2**40, "at most 4,096 samples, got 1,099,511,627,776;"),
    ],
)
def test_invalid_spp_of_a_rendering_is_refused(spp, message):
    assert message in refusal(load(), spp=spp)


def test_shutter_samples_count_as_samples():
    film, moved = SCENE.view.sensor()["film"], mi.ScalarTransform4f().translate([0.1, 0, 0])
    sensor = {"type": "calibrated", "film": film, "to_world_close": moved}
    sensor |= {"shutter_samples": 1000}
    message = "got 5 times 1,000 poses of the shutter (shutter_samples)"
    assert message in refusal(load(sensor), spp=5)
    ignoring = load(sensor, ignore="motion")
    ignoring.integrator().render(ignoring, spp=1)
    rolling = load(sensor | {"shutter": "rolling"})
    rolling.integrator().render(rolling, spp=1)


@pytest.mark.parametrize("surfaces", [False, True])
def test_films_too_large_for_memory_are_refused(surfaces):
    sensor = SCENE.view.sensor(width=1_000_000, height=1_000_000)
    objects = {"wall": WALL.shape(SCENE.view.camera)} if surfaces else {}
    assert refusal(load(sensor, objects), spp=1).startswith(
        "splats: 1000000 x 1000000 px are too many for Dr.Jit, whose arrays end at 2^32 entries; "
        "at most "
    )
    assert refusal(load(SCENE.view.sensor(width=0))) == (
        "splats: the film must have 1 pixel at least, got 0 x 23"
    )


@pytest.mark.parametrize(("available", "most"), [(2**50, 2**32 - 1), (2**33, 2**27)])
def test_nested_samples_beyond_memory_are_refused(monkeypatch, available, most):
    monkeypatch.setattr(image_render, "available_memory", lambda: available)
    scene = load(objects={"wall": WALL.shape(SCENE.view.camera)}, nested_spp=10**9)
    assert refusal(scene) == (
        f"splats: on a film of 37 x 23 px, nested_spp (or spp) must be at most "
        f"{most // (37 * 23):,}, got 1,000,000,000; take the mean of images with other "
        "seeds"
    )


def test_features_that_no_channel_shows_are_not_limited():
    """Only features that an AOV uses are compiled."""
    load(aovs="n:normal", feature_x=mi.TensorXf(np.zeros((8, 2000), np.float32)))
