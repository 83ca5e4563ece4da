"""Probes of flat mirrors: cameras that are mirrored, against rays."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.lit_scenes import camera, gaussians, scene_of

import drgs  # noqa: F401  (registers the plugins)
from drgs.integrator.mirrors import FlatMirror, Mirrors
from drgs.results import metrics

EYE, TARGET = [0.3, 1.0, -2.6], [0, -0.7, 0]
CONDUCTOR = {"type": "conductor", "material": "none"}


def at(x, y, z):
    return mi.ScalarTransform4f().translate([x, y, z])


def floor(**changes):
    to_world = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale([-3, 3, 5])
    return {"type": "rectangle", "to_world": to_world, "bsdf": CONDUCTOR, **changes}


def wall():
    """Return a wall of another metal: Mitsuba would merge equal ones."""
    to_world = at(0, 0, 1.2) @ mi.ScalarTransform4f().rotate([1, 0, 0], 180).scale(2)
    bsdf = {"type": "conductor", "material": "Al"}
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "twosided", "b": bsdf}}


def cloud(y=0.9, x=0.0, count=60):
    rng = np.random.default_rng(7)
    means = rng.uniform(-0.4, 0.4, (count, 3)) + np.array([x, y, 0])
    return gaussians(means, 0.12, 0.95, rng.random((count, 3)))


def scene(light="probe", splats=None, probes="floor", **others):
    settings = {"probes": probes} if light == "probe" else {"light_samples": 0}
    objects = {"floor": floor(), "sensor": camera(EYE, TARGET), **others}
    splats = cloud() if splats is None else splats
    return scene_of(splats, light=light, spp=16, max_depth=4, **settings, **objects)


def rendered(*arguments, **others):
    return np.array(mi.render(scene(*arguments, **others), seed=3), np.float64)


def images_by_light(probes="floor", **others):
    """Images without light, with probes, and with rays."""
    own = rendered(None, **others), rendered(probes=probes, **others)
    return *own, rendered("rays", **others)


@pytest.mark.slow
def test_mirror_matches_the_mirrored_camera(monkeypatch):
    """40 dB of the float64 reference, of which much is the noise of 64 paths: rays have 43."""
    monkeypatch.syspath_prepend(REPOSITORY / "scenes")
    import flat_mirror

    splats = flat_mirror.cloud(100)
    expected = flat_mirror.mirrored_camera(splats, 24)
    found = {name: flat_mirror.render(splats, 24, way) for name, way in flat_mirror.LIGHTS.items()}
    for name in ("probe", "rays, all splats"):
        assert metrics.psnr(found[name], expected) > 40, name
        assert found[name].mean() == pytest.approx(expected.mean(), rel=0.01), name
    assert metrics.psnr(found["none"], expected) < 20


def calibrated():
    sensor = camera(EYE, TARGET)
    del sensor["fov"]
    numbers = {"fx": 33.0, "fy": 33.0, "cx": 12.0, "cy": 12.0, "k1": 0.1}
    return sensor | numbers | {"type": "calibrated", "lens": "fisheye"}


def orthographic():
    sensor = camera(EYE, TARGET)
    del sensor["fov"]
    to_world = sensor["to_world"] @ mi.ScalarTransform4f().scale(1.2)
    return sensor | {"type": "orthographic", "to_world": to_world}


def cropped():
    sensor = camera(EYE, TARGET)
    crop = {"crop_offset_x": 3, "crop_offset_y": 7, "crop_width": 17, "crop_height": 12}
    return sensor | {"film": sensor["film"] | crop}


def batch():
    one, other = camera(EYE, TARGET), camera([-1, 1.2, -2.4], TARGET)
    film = one["film"] | {"width": 48}
    return {"type": "batch", "one": one, "other": other, "film": film, "sampler": one["sampler"]}


def pane():
    to_world = mi.ScalarTransform4f().look_at([0.2, 0.6, -1.6], TARGET, [0, 1, 0]).scale(3)
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "thindielectric"}}


LENS = {"aperture_radius": 0.05, "focus_distance": 3.4}

KINDS = {
    "a disk": lambda: {"floor": floor(type="disk")},
    "under a sky": lambda: {"sky": {"type": "constant", "radiance": 0.5}},
    "cut by the mirror": lambda: {"splats": cloud(0.1)},
    "behind": lambda: {
        "splats": cloud(-0.9),
        "floor": floor(bsdf={"type": "twosided", "bsdf": CONDUCTOR}),
        "sensor": camera([0.3, -1.0, -2.6], [0, 0.7, 0]),
    },
    "through a pane": lambda: {"pane": pane()},
    "a ball among the splats": lambda: {
        "ball": {"type": "sphere", "center": [0.1, 0.9, 0], "radius": 0.3}
    },
    "thinlens": lambda: {"sensor": camera(EYE, TARGET) | {"type": "thinlens"} | LENS},
    "orthographic": lambda: {"sensor": orthographic()},
    "fisheye": lambda: {"sensor": calibrated()},
    "crop": lambda: {"sensor": cropped()},
    "batch": lambda: {"sensor": batch()},
    "far away": lambda: {
        "splats": cloud(0.9, x=100),
        "floor": floor(to_world=at(100, 0, 0) @ floor()["to_world"]),
        "sensor": camera([100.3, 1.0, -2.6], [100, -0.7, 0]),
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_flat_mirror_matches_traced_rays(kind):
    """46 dB, between texels; without light there are less than 24."""
    none, probe, rays = images_by_light(**KINDS[kind]())
    assert metrics.psnr(probe, rays) > 46
    assert metrics.psnr(none, rays) < 24


@pytest.mark.slow
def test_rough_and_nested_mirrors_use_the_mirrored_camera():
    """Both are approximate; from the middles of the objects, there are 25 and 29 dB."""
    rough = {"floor": floor(bsdf={"type": "roughconductor", "alpha": 0.1})}
    for probes, objects, least in (("floor", rough, 29), ("floor, wall", {"wall": wall()}, 34)):
        none, probe, rays = images_by_light(probes, **objects)
        assert metrics.psnr(probe, rays) > least
        assert metrics.psnr(none, rays) < 24


@pytest.mark.slow
def test_mirror_images_are_cached_until_the_scene_changes(monkeypatch):
    counts, render = [], Mirrors.render
    monkeypatch.setattr(Mirrors, "render", lambda *values: counts.append(1) or render(*values))
    ball = {"type": "sphere", "radius": 0.3, "to_world": at(0.1, 0.9, 0)}
    found = scene(ball=ball)
    changes = {
        "integrator.sh0": lambda sh0: sh0 + 0.3,
        "sensor.to_world": lambda to_world: to_world @ mi.Transform4f().translate([0.1, 0, 0]),
        "floor.to_world": lambda to_world: to_world @ mi.Transform4f().translate([0, 0, 0.1]),
        "ball.to_world": lambda to_world: to_world @ mi.Transform4f().translate([0.3, 0, 0]),
    }
    mi.render(found)
    mi.render(found, seed=1)
    assert len(counts) == 1
    for number, (name, changed) in enumerate(changes.items(), 2):
        params = mi.traverse(found)
        params[name] = changed(params[name])
        params.update()
        kept = np.array(mi.render(found, seed=2))
        assert len(counts) == number, name
        cache = found.integrator().state.cache
        cache.kept.clear()
        np.testing.assert_array_equal(mi.render(found, seed=2), kept, err_msg=name)
        counts.pop()


def test_camera_motion_needs_no_new_kernels():
    found, kernels = scene(), []
    for _ in range(3):
        params = mi.traverse(found)
        step = mi.Transform4f().translate(mi.Point3f(dr.opaque(mi.Float, 0.05), 0, 0))
        params["sensor.to_world"] = step @ params["sensor.to_world"]
        params.update()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(mi.render(found))
            kernels.append({kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])})
    assert kernels[2] == kernels[1]


def test_flat_shapes_are_recognised_by_their_vertices():
    def plane(shape):
        return FlatMirror.from_shape(mi.load_dict(shape | {"bsdf": CONDUCTOR}))

    turned = at(1, 2, 3) @ mi.ScalarTransform4f().rotate([0, 1, 0], 30).scale([2, -3, 1])
    normal = np.array([0.5, 0, np.sqrt(0.75)])
    for kind in ("rectangle", "disk"):
        found = plane({"type": kind, "to_world": turned})
        sign = np.sign(found.offset)
        np.testing.assert_allclose(sign * np.array(found.normal), normal, atol=1e-6)
        assert abs(found.offset) == pytest.approx(normal @ [1, 2, 3], abs=1e-5)
        assert (found.has_delta, found.is_specular) == (True, True)
    for kind in ("cube", "sphere", "cylinder"):
        assert plane({"type": kind, "to_world": at(0, 0, 1)}) is None
    lamp = {"type": "rectangle", "emitter": {"type": "area"}}
    assert plane(lamp) is None


@pytest.mark.parametrize(
    ("bsdf", "has_delta", "is_specular"),
    [("plastic", True, False), ("dielectric", True, False), ("roughconductor", False, True)],
)
def test_scattered_reflections_do_not_read_the_mirrored_image(bsdf, has_delta, is_specular):
    found = FlatMirror.from_shape(mi.load_dict(floor(bsdf={"type": bsdf})))
    assert (found.has_delta, found.is_specular) == (has_delta, is_specular)
    assert FlatMirror.from_shape(mi.load_dict(floor(bsdf={"type": "diffuse"}))) is None
