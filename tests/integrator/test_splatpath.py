"""Light between splats and surfaces, against closed forms and Mitsuba's own integrators."""

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
import pytest
from support.lit_scenes import (
    FAR_AWAY,
    along_rays,
    camera,
    mean_and_error,
    pixel_rays,
    radiance_of,
    scene_of,
)
from support.rays import composite_segments
from support.reference_lenses import gaussians_at
from support.views import to_linear

import drgs  # noqa: F401  (registers the plugins)


def room():
    """A rough floor, a glass ball and a lamp that it may hit."""
    T = mi.ScalarTransform4f
    return {
        "sensor": camera([0, 2, 4], [0, 0.3, 0]),
        "floor": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90).scale(4),
            "bsdf": {"type": "roughconductor", "alpha": 0.3},
        },
        "ball": {
            "type": "sphere",
            "center": [0, 0.5, 0],
            "radius": 0.5,
            "bsdf": {"type": "dielectric"},
        },
        "matt": {
            "type": "sphere",
            "center": [1.2, 0.4, 0],
            "radius": 0.4,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.2]}},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 4, 1]).rotate([1, 0, 0], 90),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 6.0}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.4, 0.5]}},
    }


def before_a_mirror(**film):
    to_world = mi.ScalarTransform4f().scale(10)
    bsdf = {"type": "conductor", "material": "none"}
    return {
        "mirror": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf},
        "sensor": camera([0, 0, 4], [0, 0, 0], **film),
    }


@pytest.mark.slow
@pytest.mark.parametrize("max_depth", [1, 2, 3, 8])
def test_image_without_splats_matches_path(max_depth):
    """Within five standard errors everywhere, and within one and a bit on average."""
    found = []
    for nested, light in (("splatpath", "rays"), ("path", "none")):
        scene = scene_of(FAR_AWAY, light, max_depth, nested, **room())
        found.append(mean_and_error(lambda seed, s=scene: mi.render(s, seed=seed), 24))
    (ours, our_error), (theirs, their_error) = found
    error = np.sqrt(our_error**2 + their_error**2) + 1e-6 + 1e-3 * theirs
    deviation = np.abs(ours - theirs) / error
    assert theirs.mean() > 0.05
    assert deviation.max() < 6 and np.sqrt((deviation**2).mean()) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("has_sky", [False, True])
def test_a_mirror_shows_the_mirrored_gaussians(has_sky):
    """Exactly: all splats are composited, and one path is as good as many."""
    rng = np.random.default_rng(0)
    means = rng.normal(0, 0.5, (20, 3)) * [1, 1, 0.5] + [0, 0, 6]
    splats = gaussians_at(means, 0.3, 0.7, rng.uniform(0, 1, (20, 3)))
    mirror = before_a_mirror()
    if has_sky:
        mirror["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": 0.0}}
    origins, directions = pixel_rays(mi.load_dict(mirror["sensor"]))
    cutoffs = {"alpha_max": 0.6, "alpha_cut": 0.05}
    scene = scene_of(splats, light_samples=0, **cutoffs, **mirror)
    rendered = along_rays(scene, origins, directions)
    mirrored = replace(splats, means=np.float32(means * [1, 1, -1]))
    seen = composite_segments(
        mirrored, origins, directions, np.full(len(origins), np.inf), **cutoffs
    )
    expected = radiance_of(seen, is_open=not has_sky)
    np.testing.assert_allclose(rendered, expected, atol=2e-4)
    assert expected.max() > 0.3


@dataclass(frozen=True)
class Furnace:
    """The inside of a sphere of radius 1, a lamp in it, and fog.

    The sphere reflects diffusely and glows with the radiance 1. The fog is two Gaussians around its
    centre, a thousand times its size. From one point of the sphere to another, a ray meets them in
    the middle, with the same alpha to 5e-7: every bounce is through the same fog. The lamp is
    beside the centre, so that half of its light passes the middle. The camera has the fog behind
    it, and looks at where the lamp's does.
    """

    albedo: float
    alpha: float  # of each of the two
    color: float  # display space
    exposure: float = 1.0
    light_samples: int = 0  # splats of one colour are drawn with it: 0 and 1 are decoded exactly

    LAMP = -0.2
    """On the axis along which the camera looks."""

    @property
    def path_transmittance(self) -> float:
        return (1 - self.alpha) ** 2

    def radiances(self, most_depth) -> list[float]:
        """Return the radiance that the camera sees, with paths of a depth of 1, 2, ..., most_depth.

        Of two points of the sphere at the distance d, both cosines are d / 2: they see each other
        with cos cos / (pi d^2) = 1 / 4 pi, whichever they are, and what a bounce brings is the mean
        over the sphere. That of the lamp's irradiance is its intensity, pi, without fog.
        """
        fog = (1 - self.path_transmittance) * self.exposure * to_linear(self.color)
        of_lamp = self.albedo * (1 + self.path_transmittance) / 2
        of_lamp_there = self.albedo * self.path_transmittance / (1 - self.LAMP) ** 2
        seen, mean = [1.0], 1.0
        for _ in range(most_depth - 1):
            bounced = self.albedo * (fog + self.path_transmittance * mean)
            seen, mean = [*seen, 1 + of_lamp_there + bounced], 1 + of_lamp + bounced
        return seen

    def images(self, max_depth, seeds) -> np.ndarray:
        """Mean of the image of each seed."""
        wall = {
            "type": "sphere",
            "flip_normals": True,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": self.albedo}},
            # Not sampled: of a sphere around the point, Mitsuba's densities do not fit its samples,
            # and its own path tracer is off by 5e-4 of the light.
            "emitter": {
                "type": "area",
                "radiance": {"type": "rgb", "value": 1.0},
                "sampling_weight": 0.0,
            },
        }
        scene = scene_of(
            gaussians_at(np.zeros((2, 3)), 1e3, self.alpha, self.color),
            max_depth=max_depth,
            light_samples=self.light_samples,
            radiance_scale=self.exposure,
            spp=64,
            wall=wall,
            lamp={"type": "point", "position": [0, 0, self.LAMP], "intensity": np.pi},
            sensor=camera([0, 0, 0.3], [0, 0, 1], size=12, fov=0.1),  # sees one point
        )
        return np.array([np.array(mi.render(scene, seed=seed)).mean() for seed in range(seeds)])


FURNACES = {
    "dark": Furnace(0.8, 0.3, 0.0),
    "grey": Furnace(0.5, 0.2, 0.5),
    "white, drawn": Furnace(0.8, 0.3, 1.0, exposure=0.5, light_samples=4),
    # Lets less through than where roulette is played for the way to a lamp.
    "dense, drawn": Furnace(0.9, 0.6, 1.0, exposure=2.0, light_samples=2),
}

DEPTHS = [1, 2, 3, 4, 5, -1]
"""Maximum path depths. -1 is unlimited, and Russian roulette begins at 5."""

ROUNDING = 1e-5
"""Error of means of 64 samples up to 3, summed in single precision: 64 * 3 * 6e-8."""


@pytest.mark.slow
@pytest.mark.parametrize("furnace", FURNACES.values(), ids=FURNACES.keys())
def test_bounces_in_a_furnace_of_fog_converge_to_its_radiance(furnace):
    """To the solution of its equation, each adding less than the albedo times the one before.

    Within four standard errors of 16 seeds. With one seed, paths of all depths are the same as far
    as they go: what a bounce adds is known better than the sums.
    """
    exact = np.array(furnace.radiances(50))
    exact = exact[np.array(DEPTHS) - 1]  # the last but one for -1: behind it, 0.4^49 is to come
    found = np.array([furnace.images(depth, seeds=16) for depth in DEPTHS])
    for radiance, expected in ((found, exact), (np.diff(found, axis=0), np.diff(exact))):
        error = radiance.std(axis=1, ddof=1) / np.sqrt(16)
        assert (np.abs(radiance.mean(axis=1) - expected) <= 4 * error + ROUNDING).all()
    added = np.diff(found.mean(axis=1))
    assert (added > 0).all() and (added[2:4] < furnace.albedo * added[1:3]).all()


def test_nested_integrators_that_see_no_splats_are_refused():
    with pytest.raises(RuntimeError, match="must be splatpath, got PathIntegrator"):
        scene_of(gaussians_at([[0, 0, -1]], 0.3, 0.9, 1.0), nested="path", **room())
