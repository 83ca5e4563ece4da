"""The ``splats_minimal`` integrator: ``splats`` without options on one page, to be read first."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.core.constants import NEAR
from drgs.core.environment import check_variant
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.film import develop_pixels, pixels_adjoint
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.splatting.footprint import DEFAULT
from drgs.splatting.grid import TileGrid
from drgs.splatting.projection import load_rows
from drgs.splatting.rasterize import CompositedTiles, Records, composite, composite_adjoint
from drgs.splatting.rendering import CameraGradients, Pipeline, gradients_by_row
from drgs.splatting.tiles import bin_splats, splat_table


class MinimalSplatsIntegrator(mi.CppADIntegrator):
    """3D Gaussian splatting alone over black, for a ``perspective`` sensor and a box filter.

    .. pluginparameters::

     * - filename
       - |string|
       - File of the Gaussians, in a format that ``splats`` reads.
     * - means, quats, log_scales, logit_opacities, sh0, shN
       - |tensor|
       - Parameters of the Gaussians, as of ``splats``; not properties of a scene description.
         (Default: those of ``filename``)
       - |exposed|, |differentiable|

    Each pixel has one sample, at its centre; ``seed`` and ``spp`` make no difference. Not
    differentiated: the sensor, visibility, the order of the splats.
    """

    def __init__(self, props: mi.Properties) -> None:
        check_variant("splats_minimal", mi.variant())
        super().__init__(props)
        gaussians = Gaussians.load(str(props["filename"])).to(mi.TensorXf)
        for name in PARAMETER_NAMES:
            setattr(self, name, getattr(gaussians, name))
        self.pipeline = Pipeline(gaussians.sh_degree)

    @override
    def traverse(self, cb: mi.TraversalCallback) -> None:
        for name in PARAMETER_NAMES:
            cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    @override
    def render(
        self, scene: mi.Scene, sensor: int | mi.Sensor = 0, seed: int | mi.UInt32 = 0, spp: int = 0,
        develop: bool = True, evaluate: bool = True,
    ) -> mi.TensorXf:  # fmt: skip
        with dr.suspend_grad():
            film, _, tiles = self._composite(scene, sensor)
            return develop_pixels(film, _channels(film, tiles.planes()), [])

    @override
    def render_backward(
        self, scene: mi.Scene, params: object, grad_in: mi.TensorXf,
        sensor: int | mi.Sensor = 0, seed: int | mi.UInt32 = 0, spp: int = 0,
    ) -> None:  # fmt: skip
        with dr.suspend_grad():
            film, camera, tiles = self._composite(scene, sensor)
            planes = tiles.planes()
            with dr.resume_grad():  # colours are converted again, and differentiated by Dr.Jit
                dr.enable_grad(planes)
                channels = _channels(film, planes)
                dr.accum_grad(channels, pixels_adjoint(film, {}, grad_in, []))
                dr.enqueue(dr.ADMode.Backward, channels)
                dr.traverse(dr.ADMode.Backward)
                d_planes = dr.grad(planes)
            of_splats = composite_adjoint(tiles, d_planes)
            given = CameraGradients(camera, self.pipeline, of_splats)
            gradients = gradients_by_row(self._gaussians, given)[0].parameters
        for name in PARAMETER_NAMES:
            if dr.grad_enabled(getattr(self, name)):
                dr.accum_grad(getattr(self, name), getattr(gradients, name))

    @property
    def _gaussians(self) -> Gaussians:
        return Gaussians(**{name: dr.detach(getattr(self, name)) for name in PARAMETER_NAMES})

    def _composite(
        self, scene: mi.Scene, sensor: int | mi.Sensor
    ) -> tuple[mi.Film, Camera, CompositedTiles]:
        """Project the Gaussians, sort them into tiles, and composite each tile's front to back."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        camera = camera_from_sensor(read_sensor(sensor, NEAR))
        rows = load_rows(self._gaussians, self.pipeline.sh_degree)
        splats = self.pipeline.project(rows, camera)
        grid = TileGrid(camera.width, camera.height)
        bins = bin_splats(splat_table(splats, grid, list(splats.colors)), grid, DEFAULT)
        tiles = composite(bins, Records.from_splats(bins, bins.rows.load))
        return sensor.film(), camera, tiles


def _channels(film: mi.Film, planes: list[mi.Float]) -> list[mi.Float]:
    """Return linear red, green and blue of encoded colours, and alpha if the film has it."""
    transmittance, *colors = planes
    linear = list(mi.math.srgb_to_linear(mi.Color3f(colors)))
    return linear + [1 - transmittance] * mi.has_flag(film.flags(), mi.FilmFlags.Alpha)


mi.register_integrator("splats_minimal", lambda props: MinimalSplatsIntegrator(props))
