"""The ``calibrated`` sensor: a camera as calibration tools describe it.

Executed once per Mitsuba variant (see ``drgs.plugins``). The lenses are in ``drgs.cameras``; this
file is where they meet Mitsuba's rays, films and parameters.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.cameras.camera import Camera
from drgs.cameras.lens import LENSES, Lens
from drgs.core.constants import MAX_SHUTTER_SAMPLES, SHUTTER_SAMPLES
from drgs.core.environment import check_variant
from drgs.core.errors import PluginError, UserError
from drgs.integrator.properties import (
    integer,
    matrix,
    number,
    one_of,
    positive,
    refuse_unknown,
)
from drgs.integrator.sensors import (
    SensorState,
    on_crop_window,
    opaque_host,
    pose_from_to_world,
    read_sensor,
)

SHUTTERS = ("global", "rolling")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "sx1", "sy1")
"""Coefficients of the shipped lenses; other lenses have others."""

KNOWN = (
    *("to_world", "to_world_close", "fx", "fy", "cx", "cy", "lens", *COEFFICIENTS),
    *("near_clip", "far_clip", "shutter", "shutter_open", "shutter_close", "shutter_samples"),
)
"""Names of the properties, but for the film, the sampler and what else Mitsuba's sensors have."""


class CalibratedSensor(mi.Sensor):
    r"""
    .. _sensor-calibrated:

    Calibrated camera (:monosp:`calibrated`)
    ----------------------------------------

    .. pluginparameters::

     * - to_world
       - |transform|
       - Pose, in the axes of Mitsuba's ``perspective`` (x to the left, y up, z forward).
         (Default: the identity)
       - |exposed|, |differentiable|

     * - fx, fy
       - |float|
       - Focal lengths in pixels of the whole film. (Default of ``fx``: the film's width; of ``fy``:
         ``fx``)
       - |exposed|, |differentiable|

     * - cx, cy
       - |float|
       - Principal point in pixels from the upper left corner of the whole film; the middle of the
         first pixel is at (0.5, 0.5). (Default: the film's centre)
       - |exposed|, |differentiable|

     * - lens
       - |string|
       - ``pinhole``; ``opencv``, radial and tangential distortion; ``fisheye``, by the angle from
         the axis (Kannala and Brandt 2006); ``thin_prism_fisheye``, one with tangential and thin
         prism terms (COLMAP's THIN_PRISM_FISHEYE); or the name of a lens that another package
         registers, whose coefficients are parameters as well. (Default: ``pinhole``)

     * - k1, k2, k3, k4, k5, k6, p1, p2, sx1, sy1
       - |float|
       - Coefficients of the lens as OpenCV and COLMAP define them. ``opencv`` has ``k1`` to ``k6``,
         ``p1`` and ``p2``; ``fisheye`` has ``k1`` to ``k4``, ``thin_prism_fisheye`` ``p1``, ``p2``,
         ``sx1`` and ``sy1`` besides. Those that are given, be it as 0, are exposed; what is not
         given costs nothing. (Default: 0)
       - |exposed|, |differentiable|

     * - near_clip, far_clip
       - |float|
       - Depths (with fisheyes: distances) between which something is seen. The ``splats``
         integrator knows no ``far_clip``: it draws splats at any depth beyond ``near_clip``.
         (Default: 0.01, 10000)

     * - to_world_close
       - |transform|
       - Pose when the shutter closes, for a camera that moves by less than half a turn.
         (Default: none, it does not move)
       - |exposed|

     * - shutter_open, shutter_close
       - |float|
       - Times of the two poses, among which integrators that trace rays choose a ray's.
         (Default: 0 and, if the camera moves, 1)

     * - shutter
       - |string|
       - Of a camera that moves. ``global``: the whole film is open all the time, what moves is
         blurred; ``rolling``: its rows are read one after the other, from the first to the last.
         (Default: ``global``)

     * - shutter_samples
       - |int|
       - Times at which the ``splats`` integrator renders what a ``global`` shutter blurs. It takes
         the mean of what the film gets: of radiance, or of display values, which is no longer what
         a shutter does, where its ``srgb_primitives`` is false. At most 1000. (Default: 8)

    This sensor has the parameters that photographs are calibrated with. It works with every
    integrator that traces rays from the sensor: they are found by inverting the distortion. Where a
    film shows more than the lens model is made for, rays carry no weight.

    .. note:: Not differentiated: ``to_world_close``, and where the lens model ends.

    .. tabs::

        .. code-tab:: xml

            <sensor type="calibrated">
                <float name="fx" value="343.9"/>
                <string name="lens" value="opencv"/>
                <float name="k1" value="0.0578"/>
            </sensor>

        .. code-tab:: python

            'type': 'calibrated',
            'fx': 343.9,
            'lens': 'opencv',
            'k1': 0.0578
    """

    def __init__(self, props: mi.Properties) -> None:
        check_variant("calibrated", mi.variant())
        if "to_world_close" in props and "shutter_close" not in props:
            # Integrators that trace rays choose their times within these two.
            props["shutter_close"] = props.get("shutter_open", 0.0) + 1.0
        super().__init__(props)
        self.m_needs_sample_3 = False  # no aperture
        width, height = self.film().size()
        fx = positive(props, "fx", width)
        self.fx, self.fy = mi.Float(fx), mi.Float(positive(props, "fy", fx))
        self.cx = mi.Float(number(props, "cx", width / 2))
        self.cy = mi.Float(number(props, "cy", height / 2))
        self.lens = _lens(props)
        self.coefficients = {k: mi.Float(v) for k, v in self.lens.coefficients().items()}
        self.near, self.far = positive(props, "near_clip", 0.01), positive(props, "far_clip", 1e4)
        if self.near >= self.far:
            raise PluginError(
                f"calibrated: far_clip must be larger than near_clip, {self.near}, got {self.far}"
            )
        self.to_world_close = None
        if "to_world_close" in props:
            close = matrix(props, "to_world_close").astype(np.float32)
            self.to_world_close = mi.AffineTransform4f(close)
        self.shutter = one_of(props, "shutter", SHUTTERS)
        self.shutter_samples = integer(
            props, "shutter_samples", SHUTTER_SAMPLES, least=1, most=MAX_SHUTTER_SAMPLES
        )
        refuse_unknown(props, (*KNOWN, *self.lens.coefficient_names()))

    # ------------------------------------------------------------------------------------------
    # Parameters
    # ------------------------------------------------------------------------------------------

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the pose and the calibration."""
        super().traverse(callback)
        callback.put("to_world", self.m_to_world, mi.ParamFlags.Differentiable)
        for name in ("fx", "fy", "cx", "cy"):
            callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)
        for name, value in self.coefficients.items():
            callback.put(name, value, mi.ParamFlags.Differentiable)
        if self.to_world_close is not None:
            callback.put("to_world_close", self.to_world_close, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        """Where the lens model ends depends on its coefficients, which are read back."""
        if not keys or set(keys) & set(self.coefficients):
            values = {name: float(value[0]) for name, value in self.coefficients.items()}
            self.lens = _with_coefficients(type(self.lens), values) if values else self.lens

    def near_clip(self) -> float:
        """Nearer means and surfaces are not seen."""
        return self.near

    def far_clip(self) -> float:
        """Nor are surfaces farther than this."""
        return self.far

    def to_string(self) -> str:
        """One line a setting."""
        lens = ", ".join([type(self.lens).__name__, *map(str, self.coefficients)])
        return (
            f"CalibratedSensor[\n  fx = {self.fx}, fy = {self.fy},\n  cx = {self.cx}, "
            f"cy = {self.cy},\n  lens = {lens},\n  to_world = {self.m_to_world},\n"
            f"  film = {self.film()}\n]"
        )

    # ------------------------------------------------------------------------------------------
    # For the splats integrator: see ``drgs.integrator.sensors.CameraSensor``
    # ------------------------------------------------------------------------------------------

    def camera_parameters(self) -> list[str]:
        """Names of the parameters that the camera depends on."""
        moves = ["to_world_close"] if self.to_world_close is not None else []
        return ["to_world", *moves, "fx", "fy", "cx", "cy", *self.coefficients]

    def camera_from_state(self, state: SensorState) -> Camera:
        """The camera with these parameters."""
        camera = self._pinhole(state)
        return camera.with_lens(self.lens.with_coefficients(state.device))

    def num_poses(self) -> int:
        """Poses whose pictures are averaged: 1 unless motion blurs them."""
        moves = self.to_world_close is not None and self.shutter == "global"
        return self.shutter_samples if moves else 1

    def _pinhole(self, state: SensorState) -> Camera:
        device = state.device
        focal, principal = (device["fx"], device["fy"]), (device["cx"], device["cy"])
        camera = on_crop_window(state, opaque_host(state), device["to_world"], focal, principal)
        if self.to_world_close is None:
            return camera
        from drgs.cameras.motion import Motion, MotionBlur, RollingShutter

        motion = Motion.between(camera, *pose_from_to_world(device["to_world_close"]))
        if self.shutter == "rolling":
            return replace(camera, shutter=RollingShutter(*motion))
        return replace(camera, shutter=MotionBlur(*motion, self.shutter_samples))

    # ------------------------------------------------------------------------------------------
    # For integrators that trace rays
    # ------------------------------------------------------------------------------------------

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """A ray through the point ``sample2`` of the crop window; sample1: for the wavelength."""
        del sample3
        place = sample2 * mi.Vector2f(self.film().crop_size())
        state = read_sensor(self, 0.0)
        camera = self._pinhole(state)
        lens = self.lens.with_coefficients(state.device).upload(mi.Float)
        camera = replace(camera, lens=lens)
        _, direction, seen = camera.look_through(place.x, place.y)

        if camera.shutter is not None:
            camera = camera.shutter.pose(camera, self._time_of(camera, time, place.y))
        per_length = 1 / dr.norm(direction)
        near, far = lens.ray_range(direction * per_length, self.near, self.far)
        direction = camera.rotation.T @ (direction * per_length)
        wavelengths, weight = self.sample_wavelengths(
            dr.zeros(mi.SurfaceInteraction3f), sample1, active
        )
        ray = mi.Ray3f(
            o=mi.Point3f(camera.center) + direction * near,
            d=mi.Vector3f(direction),
            maxt=far - near,
            time=time,
            wavelengths=wavelengths,
        )
        return ray, weight & seen

    def _time_of(self, camera: Camera, time: Any, y: Any) -> Any:
        """From 0, the first pose, to 1, the second, of a ray that starts in the row ``y``, px."""
        if self.shutter == "rolling":
            return (y - camera.film_start.y) / (camera.film_end.y - camera.film_start.y)
        if self.shutter_open_time() == 0:
            return mi.Float(0)
        return (mi.Float(time) - self.shutter_open()) / self.shutter_open_time()

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """The same, with the rays of the neighbouring pixels."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        width, height = self.film().crop_size()
        beside = []
        for step in (mi.Vector2f(1 / width, 0), mi.Vector2f(0, 1 / height)):
            other, _ = self.sample_ray(time, sample1, sample2 + step, sample3, active)
            beside.append(other)
        result = mi.RayDifferential3f(ray)
        result.o_x, result.o_y = (other.o for other in beside)
        result.d_x, result.d_y = (other.d for other in beside)
        result.has_differentials = True
        return result, weight

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Of the centre: nothing of the camera is in the scene."""
        return mi.ScalarBoundingBox3f()


def _lens(props: mi.Properties) -> Lens:
    """Return the lens with those of its coefficients that are given."""
    kind = str(props.get("lens", "pinhole"))
    try:
        model = LENSES.get(kind, "calibrated: lens").value
    except UserError as error:
        raise PluginError(str(error)) from error
    names = model.coefficient_names()
    known = dict.fromkeys((*COEFFICIENTS, *names))
    given = {name: number(props, name, 0.0) for name in known if name in props}
    for name in given:
        if name not in names:
            raise PluginError(
                f"calibrated: lens '{kind}' has "
                f"{'the coefficients ' + ', '.join(names) if names else 'no coefficients'}, "
                f"got {name}"
            )
    return _with_coefficients(model, given)


def _with_coefficients(model: type[Lens], coefficients: dict[str, float]) -> Lens:
    try:
        return model.from_coefficients(**coefficients)
    except UserError as error:
        raise PluginError(f"calibrated: {error}") from error


mi.register_sensor("calibrated", lambda props: CalibratedSensor(props))
