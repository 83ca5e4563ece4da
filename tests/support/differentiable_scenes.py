"""Small scenes in which derivatives of images with respect to all kinds of parameters are tested.

Cut-offs are off where they are not what is tested, and orders do not change: steps that are
documented as not differentiated do not occur.
"""

from __future__ import annotations

from functools import cache

import mitsuba as mi
import numpy as np

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.arrays import from_host

WIDTH, HEIGHT = 48, 32


def tensor(values) -> mi.TensorXf:
    """Aligned as Dr.Jit's own memory is: other memory is read by other kernels."""
    values = np.asarray(values, np.float32)
    return mi.TensorXf(from_host(mi.Float, values), values.shape)


def gaussians(count=24, farthest=-1.0, size=0.16) -> dict[str, np.ndarray]:
    """Raw parameters by name: around the origin, one behind the other from z = 1 to ``farthest``.

    Colours stay within what spherical harmonics are clamped to, opacities below ``alpha_max``.
    """
    rng = np.random.RandomState(7)  # its streams are frozen, those of numpy's Generator are not
    z = np.linspace(1, farthest, count)
    distance = (4 - z) / 4  # from the camera, that of the origin is 1
    x, y = rng.uniform(-1, 1, (2, count)) * [[1.3], [0.8]] * distance
    return {
        "means": np.column_stack([x, y, z]),
        "quats": rng.normal(0, 1, (count, 4)),
        "log_scales": np.log(size * distance)[:, None] + rng.uniform(-0.8, 0.6, (count, 3)),
        "logit_opacities": rng.uniform(-1, 2, count),
        "sh0": rng.uniform(-1.2, 1.2, (count, 1, 3)),
        "shN": rng.uniform(-0.12, 0.12, (count, 3, 3)),
    }


SMOOTH = {"alpha_cut": 0.0, "transmittance_stop": 0.0, "extent": 6.0}
"""Splats that fade out where others are cut off."""


def film(width=WIDTH, rfilter="box", **others) -> dict:
    return {
        "type": "hdrfilm",
        "width": width,
        "height": HEIGHT,
        "pixel_format": "rgba",
        "component_format": "float32",
        "rfilter": {"type": rfilter},
        **others,
    }


def look_from(*origin) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 1, 0])


def scene(raw=None, cutoffs=SMOOTH, sensor=None, spp=1, objects=None, **settings) -> dict:
    """A scene for ``mi.load_dict``; sensor replaces entries of the usual one."""
    raw = gaussians() if raw is None else raw
    integrator = {
        "type": "splats",
        "background": [0.15, 0.2, 0.3],
        **cutoffs,
        **{name: tensor(values) for name, values in raw.items()},
        **settings,
    }
    camera = {
        "film": film(),
        "sampler": {"type": "independent", "sample_count": spp},
        "to_world": look_from(0.6, 0.4, 4.0),
    }
    camera |= {"type": "perspective", "fov": 41.0} if sensor is None else sensor
    return {"type": "scene", "integrator": integrator, "sensor": camera, **(objects or {})}


def with_aovs():
    """Depth, alpha, normals and features behind the colours."""
    number = np.arange(24.0)
    mark = tensor(np.column_stack([np.sin(number), np.cos(0.5 * number)]))
    return scene(aovs="f:feature_mark, z:depth, a:alpha, n:normal", feature_mark=mark)


def antialiased():
    """Splats smaller than a pixel."""
    raw = gaussians(size=0.05)
    return scene(raw | {"logit_opacities": raw["logit_opacities"] + 2}, antialiased=True)


def sampled():
    """At four points of each pixel, which a filter adds to several."""
    wide = film(rfilter="gaussian", sample_border=True)
    return scene(sensor={"type": "perspective", "fov": 41.0, "film": wide}, spp=4)


def orthographic():
    to_world = look_from(0.6, 0.4, 4.0) @ mi.ScalarTransform4f().scale([1.4, 1.4, 1])
    return scene(sensor={"type": "orthographic", "to_world": to_world})


def crop_window():
    """Left of the middle of a film that is twice as large."""
    window = {"crop_width": WIDTH, "crop_height": HEIGHT, "crop_offset_x": 15, "crop_offset_y": 19}
    whole = film(2 * WIDTH, **window) | {"height": 2 * HEIGHT}
    return scene(sensor={"type": "perspective", "fov": 41.0, "film": whole})


def batch():
    """From the right and from the left."""
    half = {"type": "perspective", "film": film(WIDTH // 2), "fov": 28.0}
    origins = {"right": (0.6, 0.4, 4.0), "left": (-1.0, 0.2, 3.8)}
    sensors = {name: half | {"to_world": look_from(*o)} for name, o in origins.items()}
    return scene(sensor={"type": "batch", **sensors})


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def lamp(position) -> dict:
    """A rectangle that shines on the ball."""
    facing = mi.ScalarTransform4f().look_at(origin=position, target=[0, 0, -2], up=[0, 1, 0])
    area = {"type": "area", "radiance": rgb(6.0, 5.0, 4.0)}
    return {"type": "rectangle", "to_world": facing, "emitter": area}


def hybrid(light=None, hide_emitters=False, srgb_primitives=True, **objects):
    """Before, beside and behind a diffuse ball that is lit from the left."""
    near, far = gaussians(count=14), gaussians(count=8, farthest=0.5)
    far["means"] = far["means"] * [1.9, 1.9, 1] - [0, 0, 5]
    raw = {name: np.concatenate([near[name], far[name]]) for name in near}
    place = mi.ScalarTransform4f().translate([-0.2, -0.1, -2.2]).scale(0.9)
    bsdf = {"type": "diffuse", "reflectance": rgb(0.8, 0.4, 0.3)}
    ball = {"type": "sphere", "to_world": place, "bsdf": bsdf}
    objects = {"ball": ball, "light": light or lamp([-4, 3, 1]), **objects}
    hidden = {"hide_emitters": hide_emitters}
    nested = {"type": "path", "max_depth": 3, **hidden}
    settings = {"nested": nested, "nested_spp": 16, "srgb_primitives": srgb_primitives}
    return scene(raw, objects=objects, **settings, **hidden)


def hidden_emitters():
    """A lamp beside the ball and a sky, of which only the light on the ball is seen.

    Not before the ball: what Mitsuba 3.9 sees through a hidden lamp is not lit by it.
    """
    light = lamp([-1.2, 0.7, 0])
    light["to_world"] = light["to_world"].scale(0.4)
    sky = {"type": "constant", "radiance": rgb(0.1, 0.2, 0.4)}
    return hybrid(light, hide_emitters=True, sky=sky)


def shape_of(raw) -> dict:
    sh = np.concatenate([raw["sh0"], raw["shN"]], axis=1)
    held = {
        "centers": raw["means"],
        "scales": np.exp(raw["log_scales"]),
        "quaternions": raw["quats"][:, [1, 2, 3, 0]],
        "opacities": 1 / (1 + np.exp(-raw["logit_opacities"]))[:, None],
        "sh_coeffs": sh.reshape(len(sh), -1),
    }
    return {"type": "ellipsoids", **{name: tensor(values) for name, values in held.items()}}


def merged():
    """The integrator's own Gaussians before those of a shape whose harmonics are turned."""
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], 40)
    own = gaussians(8, farthest=1.0)
    own["means"][:, 2] += np.linspace(1, 0.2, 8)
    feature = {"aovs": "f:feature_x", "feature_x": tensor(np.sin(np.arange(16.0)).reshape(8, 2))}
    objects = {"shape": shape_of(gaussians())}
    return scene(own, objects=objects, shapes_to_world_shape=turned, **feature)


def placed(**settings):
    """Turned about the axis along which the camera looks, so that the order stays."""
    to_world = mi.ScalarTransform4f().translate([0.1, -0.1, 0]).rotate([0, 0, 1], 40).scale(1.2)
    return scene(to_world=to_world, **settings)


def off_centre():
    """A crop window of a film whose principal point is moved."""
    description = crop_window()
    offsets = {"principal_point_offset_x": 0.125, "principal_point_offset_y": 0.0625}
    description["sensor"] |= offsets
    return description


def calibrated(**others):
    return scene(sensor=CALIBRATED | others)


def moving(**shutter):
    """A camera that moves and turns, with a rational lens."""
    return calibrated(to_world_close=look_from(0.75, 0.3, 3.9), k1=-0.1, k4=0.1, **shutter)


def waves() -> mi.Bitmap:
    """Three colours that change slowly: texels are interpolated linearly."""
    y, x = np.mgrid[:64, :128]
    waves = np.sin(x / 64 * np.pi), np.cos(y / 64 * np.pi), np.cos(x / 32 * np.pi)
    return mi.Bitmap((1 + 0.5 * np.stack(waves, axis=-1)).astype(np.float32))


def before_a_sky(sensor=None, **settings):
    sky = {"type": "envmap", "bitmap": waves()}
    return scene(sensor=sensor, objects={"sky": sky}, **settings)


def before_an_image(**settings):
    values = np.random.RandomState(4).uniform(0.05, 1.5, (6, 8, 3)).astype(np.float32)
    return scene(
        background={"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}, **settings
    )


CALIBRATED = {"type": "calibrated", "fx": 64.0, "fy": 60.0, "lens": "opencv"}
LENSES = {
    "opencv": {"k1": -0.3, "p2": -0.02},
    "thin_prism_fisheye": {"k1": -0.1, "p2": 0.01, "sy1": 0.02},
}
"""Lenses through which a sky is seen, along rays that a search finds."""

ZEROS = {
    "opencv": ("k1", "k2", "p1"),
    "fisheye": ("k1", "k2"),
    "thin_prism_fisheye": ("k1", "p1", "sx1"),
}
"""Coefficients that are given as 0, and can be optimised."""

THIN_LENS = {"type": "thinlens", "fov": 41.0, "aperture_radius": 0.3, "focus_distance": 3.2}
DISTORTION = {"k1": -0.3, "k2": 0.1, "p1": 0.01, "p2": -0.02}

SCENES = {
    "splats": scene,
    "default_cutoffs": lambda: scene(gaussians(size=0.45), {}),
    "display_space": lambda: scene(srgb_primitives=False),
    "aovs": with_aovs,
    "antialiased": antialiased,
    "unscented": lambda: scene(projection="unscented", sh_direction="pixel"),
    # Far behind each other, so that at no pixel the order of their peaks changes.
    "exact": lambda: scene(gaussians(10, farthest=-7.0), projection="exact", order="pixel"),
    "sampled": sampled,
    "thin_lens": lambda: scene(sensor=THIN_LENS),
    "orthographic": orthographic,
    "calibrated": lambda: calibrated(**DISTORTION),
    "crop_window": crop_window,
    "batch": batch,
    "hybrid": hybrid,
    "point_light": lambda: hybrid(
        {"type": "point", "position": [-2, 2.5, 1], "intensity": rgb(20.0, 18.0, 15.0)}
    ),
    "constant_emitter": lambda: hybrid({"type": "constant", "radiance": rgb(0.4, 0.6, 0.9)}),
    "hidden_emitters": hidden_emitters,
    "shapes": lambda: scene({}, objects={"shape": shape_of(gaussians())}),
}
"""By the names of stored images."""

UNSTORED_SCENES = {
    "off_centre": off_centre,
    "rolling_shutter": lambda: moving(shutter="rolling"),
    "global_shutter": lambda: moving(shutter_samples=2),
    **{
        f"{lens}_of_zeros": lambda lens=lens, names=names: calibrated(
            lens=lens, **dict.fromkeys(names, 0.0)
        )
        for lens, names in ZEROS.items()
    },
    "placed": placed,
    "placed_smoothed": lambda: placed(
        smoothing=mi.Float(np.geomspace(0.02, 0.4, 24)),
        shN=tensor(np.random.RandomState(5).uniform(-0.05, 0.05, (24, 15, 3))),
    ),
    "merged": merged,
    "hybrid_display": lambda: hybrid(
        srgb_primitives=False, sky={"type": "constant", "radiance": rgb(0.4, 0.6, 0.9)}
    ),
    "sky": before_a_sky,
    "sky_display": lambda: before_a_sky(srgb_primitives=False),
    "sky_defocused": lambda: before_a_sky(THIN_LENS),
    **{
        f"sky_{lens}": lambda lens=lens, values=values: before_a_sky(
            CALIBRATED | {"lens": lens, **values}
        )
        for lens, values in LENSES.items()
    },
    "image": before_an_image,
    "image_display": lambda: before_an_image(srgb_primitives=False),
}
"""Other tests compare their images."""


@cache
def load(name: str) -> mi.Scene:
    """One for all parameters: Mitsuba compiles light paths anew for each scene."""
    return mi.load_dict((SCENES | UNSTORED_SCENES)[name]())
