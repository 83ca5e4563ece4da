"""Scenes in which one parameter moves, as Mitsuba tests its differentiable integrators."""

from __future__ import annotations

from functools import cache
from typing import Any

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


def splats(gaussians, **settings) -> dict:
    """The integrator's dictionary: splats that fade out where others are cut off."""
    return {
        "type": "splats",
        "background": [0.15, 0.2, 0.3],
        "alpha_cut": 0.0,
        "transmittance_stop": 0.0,
        "extent": 6.0,
        **{name: tensor(values) for name, values in gaussians.items()},
        **settings,
    }


class Config:
    """A scene, one of its parameters, and how that depends on a number theta, 0 at the start."""

    rendered: str  # name of the stored one
    key: str
    along: Any = 1.0  # derivative of the parameter in theta, broadcast to its shape
    row: int | None = None  # the only one that changes, where it is a tensor; None: all
    epsilon = 0.01  # step of theta
    spp = 1

    # Mitsuba's are 0.05, 0.5 and 0.05. Images are single: rounding of 1e-6 over a step of 0.01 is
    # 1e-4 of derivatives around 1, and averages out in sums. In linear radiance the maximum is that
    # of pixels within a step of the kink of the conversion, where slopes differ by 1.8 %, half of
    # which is missed. Measured: mean 1.1e-4, maximum 9.8e-3, of sums 4.6e-5.
    error_mean_threshold = 3e-4
    error_max_threshold = 2e-2
    error_mean_threshold_bwd = 2e-4

    def gaussians(self) -> dict[str, np.ndarray]:
        return gaussians()

    def integrator(self) -> dict:
        return splats(self.gaussians())

    def film(self) -> dict:
        return {
            "type": "hdrfilm",
            "width": WIDTH,
            "height": HEIGHT,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }

    def to_world(self, origin=(0.6, 0.4, 4.0)) -> mi.ScalarTransform4f:
        return mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 1, 0])

    def sensor(self) -> dict:
        return {"type": "perspective", "fov": 41.0}

    def objects(self) -> dict:
        """Shapes and emitters."""
        return {}

    def scene_dict(self) -> dict:
        """The scene, for ``mi.load_dict``."""
        sampler = {"type": "independent", "sample_count": self.spp}
        common = {"film": self.film(), "sampler": sampler, "to_world": self.to_world()}
        sensor = common | self.sensor()
        return {
            "type": "scene",
            "integrator": self.integrator(),
            "sensor": sensor,
            **self.objects(),
        }

    def initialize(self) -> None:
        """Load the scene, if no other config has, and note where the parameter starts."""
        self.scene = scene_of(self.rendered)
        self.params = mi.traverse(self.scene)
        self.initial_state = type(self.params[self.key])(self.params[self.key])

    def update(self, theta: mi.Float) -> None:
        """Set the parameter, attached to ``theta``."""
        self.params[self.key] = self.at(theta)
        self.params.update()

    def at(self, theta: mi.Float) -> Any:
        """The parameter; a pose is moved along the sensor's axes."""
        initial = self.initial_state
        if isinstance(initial, mi.AffineTransform4f):
            step = [theta * a for a in self.along]
            return initial @ mi.AffineTransform4f().translate(step)
        if isinstance(initial, mi.Color3f):
            return initial + self.along * theta
        direction = np.zeros(initial.shape)
        rows = slice(None) if self.row is None else self.row
        direction[rows] = np.broadcast_to(self.along, initial.shape)[rows]
        if isinstance(initial, mi.Float):
            return initial + tensor(direction).array * theta
        return mi.TensorXf(initial.array + tensor(direction).array * theta, initial.shape)


# Splats alone ---------------------------------------------------------------------------------
class Means(Config):
    """All move to the right."""

    rendered = "splats"
    key = "integrator.means"
    along = (1.0, 0.0, 0.0)


class Scale(Means):
    key = "integrator.log_scales"
    along = 1.0
    row = 5


class Rotation(Means):
    key = "integrator.quats"
    along = (0.3, -0.5, 0.8, 0.4)
    row = 5


class Opacity(Means):
    key = "integrator.logit_opacities"
    along = 1.0


class ColorOfDegree0(Means):
    key = "integrator.sh0"
    along = 1.0
    row = 5


class ColorOfDegree1(Means):
    key = "integrator.shN"
    along = ((1.0,), (-0.5,), (0.25,))


class Background(Means):
    key = "integrator.background"
    along = 1.0


class DefaultCutoffs(Means):
    """The ends of splats are not differentiated: Mitsuba's thresholds allow for that.

    At the end of a splat alpha jumps by 1/255. Where a step of theta moves that past a pixel,
    differences are off by 8 / (12 epsilon 255), 0.13 of Mitsuba's floor. Large splats end flatly,
    so that larger steps are as good. Measured: mean 0.018, maximum 0.22, of the sum 0.005.
    """

    rendered = "default_cutoffs"
    epsilon = 0.1
    error_mean_threshold, error_max_threshold = 0.03, 0.5
    error_mean_threshold_bwd = 0.02

    def gaussians(self):
        return gaussians(size=0.45)

    def integrator(self):
        settings = super().integrator()
        for name in ("alpha_cut", "transmittance_stop", "extent"):
            del settings[name]
        return settings


class DisplaySpace(Means):
    rendered = "display_space"

    def integrator(self):
        return super().integrator() | {"srgb_primitives": False}


class Feature(Config):
    """Behind it the channels of depth, alpha and normals."""

    rendered = "aovs"
    key = "integrator.feature_mark"

    def integrator(self):
        number = np.arange(24.0)
        mark = np.column_stack([np.sin(number), np.cos(0.5 * number)])
        aovs = "f:feature_mark, z:depth, a:alpha, n:normal"
        return super().integrator() | {"aovs": aovs, "feature_mark": tensor(mark)}


class DepthOfMeans(Feature):
    key = "integrator.means"
    along = (0.0, 0.0, 1.0)


class NormalOfRotations(Feature):
    key = "integrator.quats"
    along = (0.3, -0.5, 0.8, 0.4)


class AntialiasedScale(Config):
    """Splats smaller than a pixel."""

    rendered = "antialiased"
    key = "integrator.log_scales"

    def gaussians(self):
        raw = gaussians(size=0.05)
        return raw | {"logit_opacities": raw["logit_opacities"] + 2}

    def integrator(self):
        return super().integrator() | {"antialiased": True}


class UnscentedMeans(Means):
    """Each pixel sees the colour in its own direction."""

    rendered = "unscented"

    def integrator(self):
        return super().integrator() | {"projection": "unscented", "sh_direction": "pixel"}


class ExactMeans(Means):
    """Far behind each other, so that at no pixel the order of their peaks changes."""

    rendered = "exact"

    def gaussians(self):
        return gaussians(count=10, farthest=-7.0)

    def integrator(self):
        return super().integrator() | {"projection": "exact", "order": "pixel"}


class ExactScale(ExactMeans):
    key = "integrator.log_scales"
    along = 1.0
    row = 3


class ExactRotation(ExactMeans):
    key = "integrator.quats"
    along = (0.3, -0.5, 0.8, 0.4)
    row = 3


class Sampled(Means):
    """At four points of each pixel, which a filter adds to several."""

    rendered = "sampled"
    spp = 4

    def film(self):
        return super().film() | {"rfilter": {"type": "gaussian"}, "sample_border": True}


# Sensors --------------------------------------------------------------------------------------
OBLIQUE = (0.8, -0.6, 0.5)


class Perspective(Means):
    key = "sensor.to_world"
    along = OBLIQUE


class FieldOfView(Means):
    key = "sensor.x_fov"
    along = 1.0
    epsilon = 0.4  # degrees


class ThinLens(Config):
    rendered = "thin_lens"
    key = "sensor.to_world"
    along = OBLIQUE

    def sensor(self):
        return {"type": "thinlens", "fov": 41.0, "aperture_radius": 0.3, "focus_distance": 3.2}


class Aperture(ThinLens):
    key = "sensor.aperture_radius"
    along = 1.0


class Orthographic(Config):
    rendered = "orthographic"
    key = "sensor.to_world"
    along = OBLIQUE

    def to_world(self):
        return super().to_world() @ mi.ScalarTransform4f().scale([1.4, 1.4, 1])

    def sensor(self):
        return {"type": "orthographic"}


class Calibrated(Config):
    rendered = "calibrated"
    key = "sensor.to_world"
    along = OBLIQUE

    def sensor(self):
        distortion = {"k1": -0.3, "k2": 0.1, "p1": 0.01, "p2": -0.02}
        return {"type": "calibrated", "fx": 64.0, "fy": 60.0, "lens": "opencv", **distortion}


class Distortion(Calibrated):
    key = "sensor.k1"
    along = 1.0


class CropWindow(Means):
    """Left of the middle of a film that is twice as large."""

    rendered = "crop_window"

    def film(self):
        whole = {"width": 2 * WIDTH, "height": 2 * HEIGHT}
        window = {"crop_width": WIDTH, "crop_height": HEIGHT}
        return super().film() | whole | window | {"crop_offset_x": 15, "crop_offset_y": 19}


class CropWindowFieldOfView(CropWindow):
    key = "sensor.x_fov"
    along = 1.0
    epsilon = 0.4


class Batch(Means):
    """From the right and from the left."""

    rendered = "batch"

    def sensor(self):
        film = self.film() | {"width": WIDTH // 2}
        origins = {"right": (0.6, 0.4, 4.0), "left": (-1.0, 0.2, 3.8)}
        sensors = {
            name: {"type": "perspective", "film": film, "to_world": self.to_world(o), "fov": 28.0}
            for name, o in origins.items()
        }
        return {"type": "batch", **sensors}


class BatchPose(Batch):
    key = "sensor.left.to_world"
    along = OBLIQUE


# Splats and surfaces --------------------------------------------------------------------------
def emitter(position, radiance) -> dict:
    """A rectangle that shines on the ball."""
    facing = mi.ScalarTransform4f().look_at(origin=position, target=[0, 0, -2], up=[0, 1, 0])
    area = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return {"type": "rectangle", "to_world": facing, "emitter": area}


class Hybrid(Means):
    """Before, beside and behind a diffuse ball that is lit from the left."""

    rendered = "hybrid"
    hide_emitters = False

    def gaussians(self):
        near, far = gaussians(count=14), gaussians(count=8, farthest=0.5)
        far["means"] = far["means"] * [1.9, 1.9, 1] - [0, 0, 5]
        return {name: np.concatenate([near[name], far[name]]) for name in near}

    def integrator(self):
        hidden = {"hide_emitters": self.hide_emitters}
        nested = {"type": "path", "max_depth": 3, **hidden}
        return super().integrator() | {"nested": nested, "nested_spp": 16, **hidden}

    def light(self):
        return emitter([-4, 3, 1], [6.0, 5.0, 4.0])

    def objects(self):
        place = mi.ScalarTransform4f().translate([-0.2, -0.1, -2.2]).scale(0.9)
        color = {"type": "rgb", "value": [0.8, 0.4, 0.3]}
        bsdf = {"type": "diffuse", "reflectance": color}
        ball = {"type": "sphere", "to_world": place, "bsdf": bsdf}
        return {"ball": ball, "light": self.light()}


class HybridOpacity(Hybrid):
    key = "integrator.logit_opacities"
    along = 1.0


class HybridColor(Hybrid):
    """Also of splats that the ball hides."""

    key = "integrator.sh0"
    along = 1.0


class DiffuseAlbedo(Hybrid):
    key = "ball.bsdf.reflectance.value"
    along = 1.0


class AreaLightRadiance(Hybrid):
    key = "light.emitter.radiance.value"
    along = 1.0


class PointLightIntensity(Hybrid):
    rendered = "point_light"
    key = "light.intensity.value"
    along = 1.0

    def light(self):
        intensity = {"type": "rgb", "value": [20.0, 18.0, 15.0]}
        return {"type": "point", "position": [-2, 2.5, 1], "intensity": intensity}


class BeforeConstantEmitter(Hybrid):
    """It lights the ball, and is seen behind all."""

    rendered = "constant_emitter"

    def light(self):
        return {"type": "constant", "radiance": {"type": "rgb", "value": [0.4, 0.6, 0.9]}}


class ConstantEmitterRadiance(BeforeConstantEmitter):
    key = "light.radiance.value"
    along = 1.0


class HiddenEmitters(AreaLightRadiance):
    """A lamp beside the ball and a sky, of which only the light on the ball is seen.

    Not before the ball: what Mitsuba 3.9 sees through a hidden lamp is not lit by it.
    """

    rendered = "hidden_emitters"
    hide_emitters = True

    def light(self):
        lamp = emitter([-1.2, 0.7, 0], [6.0, 5.0, 4.0])
        return lamp | {"to_world": lamp["to_world"].scale(0.4)}

    def objects(self):
        sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.4]}}
        return super().objects() | {"sky": sky}


# Shapes ---------------------------------------------------------------------------------------
class ShapeData(Config):
    """Centres, scales and quaternions."""

    rendered = "shapes"
    key = "shape.data"
    along = np.tile([1, 0, 0, 0.1, 0.1, 0.1, 0.3, -0.5, 0.8, 0.4], 24)

    def integrator(self):
        return splats({})

    def objects(self):
        raw = self.gaussians()
        sh = np.concatenate([raw["sh0"], raw["shN"]], axis=1)
        held = {
            "centers": raw["means"],
            "scales": np.exp(raw["log_scales"]),
            "quaternions": raw["quats"][:, [1, 2, 3, 0]],
            "opacities": 1 / (1 + np.exp(-raw["logit_opacities"]))[:, None],
            "sh_coeffs": sh.reshape(len(sh), -1),
        }
        attributes = {name: tensor(values) for name, values in held.items()}
        return {"shape": {"type": "ellipsoids", **attributes}}


class ShapeOpacities(ShapeData):
    key = "shape.opacities"
    along = 1.0


class ShapeColors(ShapeData):
    key = "shape.sh_coeffs"
    along = 1.0


def _kinds(kind: type) -> list[type[Config]]:
    return [k for subclass in kind.__subclasses__() for k in (subclass, *_kinds(subclass))]


CONFIGS = _kinds(Config)


IMAGES = {config.rendered: config for config in reversed(CONFIGS)}
"""A config of each, with which it is rendered."""


@cache
def scene_of(rendered: str) -> mi.Scene:
    """One for all configs that show it: Mitsuba compiles light paths anew for each scene."""
    return mi.load_dict(IMAGES[rendered]().scene_dict())
