"""Mitsuba scenes with the ``splats`` integrator, and what the float64 reference makes of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from support.helpers import NEAR_THRESHOLD, gaussians_on_film, single

# ----------------------------------------------------------------------------------------------
# Sensors
# ----------------------------------------------------------------------------------------------


def pose(axis, degrees, position=(0.0, 0.0, 0.0), mirrored=False) -> tuple:
    """A ``to_world`` (4 x 4 nested tuples, float32 values): rotated about an axis, then moved."""
    half = np.radians(degrees) / 2
    axis = np.asarray(axis) / np.linalg.norm(axis)
    matrix = np.eye(4)
    rotation = reference.quat_to_rotation(np.array([[np.cos(half), *(np.sin(half) * axis)]]))[0]
    matrix[:3, :3] = rotation @ np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0])
    matrix[:3, 3] = position
    return tuple(map(tuple, single(matrix)))


@dataclass(frozen=True)
class View:
    """A sensor: its dictionary, and the camera of a ``perspective`` one by the manual."""

    name: str
    width: int = 37
    height: int = 23
    fov: float = 50.0  # degrees, along fov_axis
    fov_axis: str = "x"
    focal_length: float | None = None  # mm, of a 36 mm x 24 mm film; instead of fov
    offset: tuple[float, float] = (0.0, 0.0)  # principal point offset
    crop: tuple[int, int, int, int] | None = None  # x, y, width, height
    near_clip: float = 0.01
    to_world: tuple = pose([0.3, -1.0, 0.5], 40, (0.4, -0.7, 1.1))
    others: tuple = ()  # (name, value) of a sensor of another type; a function returns its value

    @property
    def camera(self) -> reference.Camera:
        """The camera of the whole film. Mitsuba's camera has x to the left and y up."""
        lengths = {
            "x": self.width,
            "y": self.height,
            "smaller": min(self.width, self.height),
            "larger": max(self.width, self.height),
            "diagonal": np.hypot(self.width, self.height),
        }
        focal = lengths[self.fov_axis] / 2 / np.tan(np.radians(self.fov) / 2)
        if self.focal_length is not None:
            focal = lengths["diagonal"] * self.focal_length / np.hypot(36, 24)
        to_world = np.array(self.to_world)
        return reference.Camera(
            rotation=np.diag([-1.0, -1.0, 1.0]) @ to_world[:3, :3].T,
            center=to_world[:3, 3],
            fx=focal,
            fy=focal,
            cx=self.width / 2 - self.offset[0] * self.width,
            cy=self.height / 2 - self.offset[1] * self.height,
            width=self.width,
            height=self.height,
            near=self.near_clip,
        )

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the film that are rendered."""
        x, y, width, height = self.crop or (0, 0, self.width, self.height)
        return slice(y, y + height), slice(x, x + width)

    def sensor(
        self, pixel_format="rgba", rfilter="box", samples=1, sampler="independent", **film
    ) -> dict:
        """The dictionary for ``mi.load_dict``."""
        if self.crop is not None:
            x, y, width, height = self.crop
            film |= {"crop_offset_x": x, "crop_offset_y": y}
            film |= {"crop_width": width, "crop_height": height}
        fov = {"fov": self.fov, "fov_axis": self.fov_axis}
        if self.focal_length is not None:
            fov = {"focal_length": f"{self.focal_length}mm"}
        own = {
            "type": "perspective",
            **fov,
            "principal_point_offset_x": self.offset[0],
            "principal_point_offset_y": self.offset[1],
        }
        others = {name: value() if callable(value) else value for name, value in self.others}
        return {
            "near_clip": self.near_clip,
            "to_world": mi.ScalarTransform4f(np.array(self.to_world)),
            "film": {
                "type": "hdrfilm",
                "width": self.width,
                "height": self.height,
                "pixel_format": pixel_format,
                "component_format": "float32",
                "rfilter": {"type": rfilter},
                **film,
            },
            "sampler": {"type": sampler, "sample_count": samples},
            **(others or own),
        }

    def with_sensor(self, kind: str, **parameters) -> View:
        """A sensor of another type at the same place, with the same film."""
        return replace(self, others=(("type", kind), *parameters.items()))


VIEWS = (
    View("unrotated", to_world=pose([0, 0, 1], 0)),
    View("rotated and moved"),
    View("rolled", to_world=pose([0, 0, 1], 30, (0.1, 0.2, -0.3))),
    View("mirrored", to_world=pose([0.2, 1.0, 0.1], 70, (0.4, 0.1, 0.3), mirrored=True)),
    View("fov along y", fov_axis="y"),
    View("fov along the smaller side", fov_axis="smaller"),
    View("fov along the larger side of a tall film", 23, 37, fov_axis="larger"),
    View("fov along the smaller side of a tall film", 23, 37, fov_axis="smaller"),
    View("fov along the diagonal", fov_axis="diagonal"),
    View("focal length", focal_length=35.0),
    View("principal point", offset=(0.125, -0.25)),
    View("principal point of a tall film", 19, 41, offset=(-0.25, 0.125), fov_axis="y"),
    View("crop window", 53, 41, crop=(13, 7, 29, 18)),
    View("crop window, principal point", 41, 53, crop=(3, 21, 22, 31), offset=(0.125, 0.0625)),
)
"""Wide, tall and cropped films that no 16x16 tile divides."""


def side_by_side(*views: View, **film) -> dict:
    """A ``batch`` of views of one size; film: see ``View.sensor``."""
    whole = views[0].sensor(**film)
    whole["film"]["width"] *= len(views)
    children = {f"view_{k}": view.sensor() for k, view in enumerate(views)}
    return {"type": "batch", "film": whole["film"], "sampler": whole["sampler"], **children}


# ----------------------------------------------------------------------------------------------
# Gaussians before a view
# ----------------------------------------------------------------------------------------------


def splats_before(view: View, degree: int, count: int, seed: int) -> reference.Gaussians:
    """Gaussians on and around the window of ``view``, float32 values.

    The first four: behind the camera, at a depth of 0.15, too transparent to be seen, large.
    With a margin of 10% of the window they stay inside the slopes that no Jacobian clamps, so
    that the image of a window is part of the whole image.
    """
    rng = np.random.default_rng(seed)
    camera = view.camera
    rows, columns = view.window
    origin = np.array([columns.start, rows.start])
    size = np.array([columns.stop, rows.stop]) - origin
    film = origin + rng.uniform(-0.1, 1.1, (count, 2)) * size
    z = rng.uniform(1.0, 4.0, count)
    sizes = rng.lognormal(np.log(1.5), 0.6, (count, 3))
    logits = rng.normal(0.5, 1.5, count)
    z[:2], logits[2] = [-1.0, 0.15], -6.0
    film[1], sizes[1:4:2], logits[1] = origin + size * [0.41, 0.43], [[3.0], [8.0]], 1.0
    return gaussians_on_film(rng, camera, film, z, sizes, logits, degree)


def tensors(gaussians) -> dict:
    """The six parameters as Mitsuba tensors, by name."""
    return {
        name: mi.TensorXf(np.asarray(getattr(gaussians, name), np.float32))
        for name in PARAMETER_NAMES
    }


def to_linear(x) -> np.ndarray:
    """From display space to linear radiance (IEC 61966-2-1)."""
    x = np.asarray(x, dtype=np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0) + 0.055) / 1.055) ** 2.4)


def decode(color, coverage) -> np.ndarray:
    """A D(C / A): linear radiance of premultiplied colours (H, W, 3) of a coverage (H, W)."""
    covered = np.where(coverage > 0, coverage, 1)[..., None]
    return coverage[..., None] * to_linear(color / covered)


def to_linear_derivative(x) -> np.ndarray:
    """Its derivative."""
    x = np.asarray(x, dtype=np.float64)
    power = 2.4 / 1.055 * ((np.maximum(x, 0) + 0.055) / 1.055) ** 1.4
    return np.where(x <= 0.04045, 1 / 12.92, power)


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """A view, Gaussians before it, and the integrator's settings."""

    view: View = VIEWS[1]
    degree: int = 1  # stored
    sh_degree: int | None = None  # rendered; None for all that is stored
    antialiased: bool = False
    near: float = 0.01
    srgb_primitives: bool = False
    background: tuple[float, float, float] = (0.875, 0.375, 0.03125)
    count: int = 40
    seed: int = 0

    @property
    def gaussians(self) -> reference.Gaussians:
        return _gaussians(self.view, self.degree, self.count, self.seed)

    @property
    def settings(self) -> dict:
        """Dictionary of the integrator without the Gaussians."""
        settings = {
            "type": "splats",
            "antialiased": self.antialiased,
            "near": self.near,
            "srgb_primitives": self.srgb_primitives,
            "background": list(self.background),
        }
        return settings if self.sh_degree is None else settings | {"sh_degree": self.sh_degree}

    def load(self, **film) -> mi.Scene:
        """A new Mitsuba scene; film: see ``View.sensor``."""
        return self.load_with(self.view.sensor(**film))

    def load_with(self, sensor=None, objects=None, gaussians=None, **settings) -> mi.Scene:
        """A new scene with other objects or Gaussians, and more settings of the integrator."""
        own = self.own_tensors if gaussians is None else tensors(gaussians)
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": self.settings | own | settings,
                "sensor": sensor or self.view.sensor(),
                **(self.objects if objects is None else objects),
            }
        )

    @property
    def own_tensors(self) -> dict:
        """Gaussians that the integrator is given."""
        return tensors(self.gaussians)

    @property
    def objects(self) -> dict:
        """Shapes and emitters."""
        return {}

    @property
    def camera(self) -> reference.Camera:
        return replace(self.view.camera, near=max(self.near, self.view.near_clip))

    @property
    def rendered_degree(self) -> int:
        return self.degree if self.sh_degree is None else self.sh_degree

    @property
    def rendered(self) -> reference.RenderedImage:
        """The whole film by the reference, on black."""
        return _image(self)

    def image(self, rendered=None) -> np.ndarray:
        """The developed RGBA image (H, W, 4) of the window: linear radiance if so set."""
        rendered = rendered or self.rendered
        decode = to_linear if self.srgb_primitives else np.asarray
        color = decode(rendered.image + rendered.transmittance[..., None] * self.background)
        return np.concatenate([color, rendered.alpha[..., None]], axis=-1)[self.view.window]

    def gradients(self, weights, gaussians=None) -> dict[str, np.ndarray]:
        """Gradients of sum(weights * image()), weights (H, W, 4), by the reference.

        With P the premultiplied image, D the decoding and B the background, the image is
        D(P + T B), and alpha is 1 - T.
        """
        d_window = np.zeros((self.view.height, self.view.width, 4))
        d_window[self.view.window] = weights
        d_image, d_alpha = d_window[..., :3], d_window[..., 3]
        background, transmittance = np.array(self.background), self.rendered.transmittance
        if self.srgb_primitives:
            whole = self.rendered.image + transmittance[..., None] * background
            d_image = d_image * to_linear_derivative(whole)
        d_background = np.einsum("hw,hwc->c", transmittance, d_image)
        d_alpha = d_alpha - d_image @ background
        gradients = reference.render_gradients(
            gaussians or self.gaussians, self.camera, np.zeros(3), d_image, d_alpha, 0.0,
            self.rendered_degree, self.antialiased,
        )  # fmt: skip
        return gradients | {"background": d_background}

    def weights(self, seed=1) -> np.ndarray:
        """Random (H, W, 4) for the window."""
        rows, columns = self.view.window
        shape = rows.stop - rows.start, columns.stop - columns.start, 4
        return single(np.random.default_rng(seed).normal(0, 1, shape))


@cache
def _gaussians(view, degree, count, seed):
    return splats_before(view, degree, count, seed)


@cache
def _image(scene):
    return reference.render(
        scene.gaussians, scene.camera, np.zeros(3), scene.rendered_degree, scene.antialiased,
        threshold_width=NEAR_THRESHOLD,
    )  # fmt: skip


def image_of(scene: mi.Scene, **arguments) -> np.ndarray:
    """``mi.render`` as float64 numpy."""
    return np.array(mi.render(scene, **arguments)).astype(np.float64)


def gradients_of(
    scene: mi.Scene, weights, names=(*PARAMETER_NAMES, "background"), prefix="integrator."
) -> dict:
    """Gradients of sum(weights * mi.render(scene)) for the parameters ``names``."""
    params = mi.traverse(scene)
    for name in names:
        dr.enable_grad(params[prefix + name])
    image = mi.render(scene, params)
    dr.backward(dr.sum(image * mi.TensorXf(np.asarray(weights, np.float32)), axis=None))
    return {name: gradient(params[prefix + name]) for name in names}


def gradient(parameter) -> np.ndarray:
    """``dr.grad`` as float64 numpy: (N, ...) for tensors, (3,) for a colour."""
    values = np.array(dr.grad(parameter)).astype(np.float64)
    return values[:, 0] if isinstance(parameter, mi.Color3f) else values
