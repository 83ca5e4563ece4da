"""The ``splatpath`` integrator: a path tracer whose paths pass splats (``drgs.light``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar, cast

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import (  # pyright: ignore[reportMissingImports]  no stub
    RBIntegrator,
    mis_weight,
    solid_angle_to_area_jacobian,
)

from drgs.config.approximations import Declared
from drgs.core.environment import check_variant
from drgs.core.errors import UnsupportedError
from drgs.integrator.light.rays import (
    UNBOUNDED_DEPTH,
    PathSegment,
    SplatTransport,
    StraightRays,
    has_transparent_parts,
)
from drgs.integrator.properties import integer, read, refuse_unknown

T = TypeVar("T")

PROPERTIES = {
    "max_depth": integer(-1, least=-1),
    "rr_depth": integer(5, least=1),
    "hide_emitters": Declared(False),
}

MAX_SURVIVAL_PROBABILITY = 0.95  # largest probability of Russian roulette, as in Mitsuba's ``path``


class SplatPathIntegrator(RBIntegrator):
    """Path tracer whose paths pass splats: to be nested in ``splats`` that set ``light``.

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path depth: 1 shows emitters only, 2 adds direct illumination, and so on; -1: no
         limit. (Default: -1)
     * - rr_depth
       - |int|
       - Path depth from which on Russian roulette ends paths. (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: false)

    The first segment of a path passes no splats: ``splats`` renders those. Surfaces that light
    passes straight on (``null``, ``mask``, ``thindielectric``) are no vertices. Derivatives by path
    replay with detached sampling, with respect to materials, emitters and poses of objects.

    Not differentiated: the splats and their light on a path, the directions of perfect mirrors and
    glass, silhouettes.
    """

    def __init__(self, props: mi.Properties) -> None:
        check_variant("splatpath", mi.variant())
        read(props, PROPERTIES)  # before the base class, which names no plugin
        super().__init__(props)
        refuse_unknown(props, list(PROPERTIES))
        if "max_depth" not in props:
            self.max_depth = UNBOUNDED_DEPTH
        self.sees_through = False  # whether anything in the scene lets light pass straight on
        self._transport: SplatTransport | None = None

    def use_transport(self, transport: SplatTransport | None) -> None:
        """Set the transport through splats; None: there are none."""
        self._transport = transport

    @dr.syntax
    def sample(
        self,
        mode: dr.ADMode,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        active: mi.Bool,
        **others: Any,
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float], mi.Spectrum]:
        """Estimate radiance along rays, or its derivatives; others: see ``RBIntegrator.sample``.

        Path replay (Vicini et al. 2021): the second walk takes the same path, and subtracts each
        vertex from the first one's sum to have the radiance still to come.
        """
        primal = mode == dr.ADMode.Primal
        self.sees_through = has_transparent_parts(scene)
        path = self._begin(scene, ray, active)
        L = mi.Spectrum(0 if primal else others["state_in"])  # so far; in a replay, still to come
        δL = mi.Spectrum(0 if others["δL"] is None else others["δL"])
        is_seen = mi.Bool(not self.hide_emitters and scene.environment() is not None)

        while dr.hint(path.active, max_iterations=self.max_depth, label=f"splatpath ({mode.name})"):
            with dr.resume_grad(when=not primal):
                si = path.vertex(attached=not primal)
            splats, arrives = self._pass_splats(scene, path, sampler)
            here = _Vertex(scene, path, si, arrives)
            emitted = self._emitted_radiance(here, primal)
            goes_on = path.active & (path.depth + 1 < self.max_depth) & si.is_valid()
            direct = self._direct(here, sampler, goes_on, primal)
            step = self._bounce(here, sampler)
            passed = dr.select(step.is_null, 0, splats)  # or composited with what follows
            is_seen |= goes_on & ~step.is_null
            contribution = dr.detach(passed + emitted + direct)
            L = L + contribution if primal else L - contribution
            if dr.hint(not primal, mode="scalar"):
                with dr.resume_grad():
                    total = emitted + direct + L * step.relative_change(si, path.ray)
                    if not dr.grad_enabled(total):
                        raise UnsupportedError(
                            "splatpath: nothing that a path meets changes with the parameters "
                            "that are differentiated"
                        )
                    if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                        dr.backward_from(δL * total)
                    else:
                        δL += dr.forward_to(total)
            path = path.next_vertex(step, si)

        return (L if primal else δL), is_seen, [], L

    def _begin(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> _Path:
        ray, active = mi.Ray3f(dr.detach(ray)), mi.Bool(active)
        hit = scene.ray_intersect_preliminary(ray, coherent=True, reorder=False, active=active)
        if self.hide_emitters:  # begin at the first hit that is none
            skips = hit.is_valid() & (hit.shape.emitter() != None) & active  # noqa: E711
            si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, skips)
            hit[skips] = self.skip_area_emitters(scene, si.spawn_ray(ray.d), True, skips)
        return _Path(
            ray=ray,
            hit=hit,
            active=active,
            depth=mi.UInt32(0),
            throughput=mi.Spectrum(1),
            eta=mi.Float(1),
            straight=mi.Bool(True),
            origin=mi.Point3f(ray.o),
            length=mi.Float(0),
            last_ray=mi.Ray3f(ray),
            last_hit=dr.zeros(mi.PreliminaryIntersection3f),
            last_si=dr.zeros(mi.SurfaceInteraction3f),
            last_pdf=mi.Float(1),
            last_is_delta=mi.Bool(True),
        )

    def _emitted_radiance(self, here: _Vertex, primal: bool) -> mi.Spectrum:
        scene, path, si = here.scene, here.path, here.si
        shows = path.active & ~((path.depth == 0) & ~si.is_valid() & self.hide_emitters)
        ds = mi.DirectionSample3f(scene, si=si, ref=path.last_si)
        pdf = scene.pdf_emitter_direction(path.last_si, ds, ~path.last_is_delta)
        weight = mis_weight(path.last_pdf, pdf)
        with dr.resume_grad(when=not primal):
            return here.arrives * weight * ds.emitter.eval(si, shows)

    def _direct(
        self, here: _Vertex, sampler: mi.Sampler, active: mi.Bool, primal: bool
    ) -> mi.Spectrum:
        scene, si = here.scene, here.si
        bsdf = si.bsdf(here.path.ray)
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        rays, numbers = StraightRays(scene, False, self.sees_through), sampler.next_2d()
        ds, weight = scene.sample_emitter_direction(si, numbers, not rays.sees_through, active)
        active &= ds.pdf != 0
        ray = si.spawn_ray_to(ds.p)
        segment = PathSegment(ray, si.shape, ds.emitter, ds.pdf, is_open=mi.Bool(False))
        let_through = mi.Float(1)
        if self._transport is not None:
            let_through = self._transport.transmittance(segment, sampler.next_1d(), active)
        if dr.hint(rays.sees_through, mode="scalar"):
            let_through *= rays.transmittance(ray, active)
        with dr.resume_grad(when=not primal):
            if not primal:
                ds, weight = _attach_sample(scene, si, ds, weight, numbers, active)
            wo = si.to_local(ds.d)
            value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, active)
            mis = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
            return here.arrives * mis * value * weight * let_through

    def _bounce(self, here: _Vertex, sampler: mi.Sampler) -> _Step:
        scene, path, si = here.scene, here.path, here.si
        has_bounces = path.depth + 1 < self.max_depth
        may_pass = mi.Bool(self.sees_through)
        active = path.active & si.is_valid() & (has_bounces | may_pass)
        bsdf = si.bsdf(path.ray)
        numbers = sampler.next_1d(), sampler.next_2d()
        sample, weight = bsdf.sample(mi.BSDFContext(), si, *numbers, active)
        ray = si.spawn_ray(si.to_world(sample.wo))
        is_null = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        eta = path.eta * sample.eta
        throughput = dr.select(is_null, path.throughput, here.arrives) * weight
        most = dr.max(throughput)
        active = active & (most != 0) & (has_bounces | is_null)
        probability = dr.minimum(most * dr.square(eta), MAX_SURVIVAL_PROBABILITY)
        is_played = path.depth >= self.rr_depth
        throughput[is_played] *= dr.rcp(probability)
        active &= ~is_played | (sampler.next_1d() < probability)
        return _Step(
            ray=dr.detach(ray),
            hit=scene.ray_intersect_preliminary(ray, coherent=False, reorder=False, active=active),
            active=active,
            is_null=active & is_null,
            throughput=throughput,
            eta=eta,
            pdf=sample.pdf,
            type=sample.sampled_type,
            numbers=numbers,
        )

    def _pass_splats(
        self, scene: mi.Scene, path: _Path, sampler: mi.Sampler
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        """Return the radiance of splats before the vertex, and the throughput past them."""
        if self._transport is None:
            return mi.Spectrum(0), mi.Spectrum(path.throughput)
        radiance, let_through = self._transport.composite_segment(
            path.segment(scene), sampler.next_1d(), path.active & ~path.straight
        )
        # Radiance within glass of index n is n^2 times that outside, for splats as well.
        radiance *= dr.square(path.eta)
        return path.throughput * radiance, path.throughput * let_through


def _replace_grad(values: T, gradient: T) -> T:
    """Return ``values`` with the derivatives of ``gradient``."""
    return cast(T, dr.replace_grad(values, gradient))  # the stub has no return type


@dataclass  # not frozen: ``dr.syntax`` carries it through a loop
class _Path:
    ray: mi.Ray3f  # that leads here
    hit: mi.PreliminaryIntersection3f
    active: mi.Bool
    depth: mi.UInt32  # vertices before
    throughput: mi.Spectrum
    eta: mi.Float  # product of relative indices of refraction
    straight: mi.Bool  # whether it is straight from the camera on
    origin: mi.Point3f  # of the ray before it went straight on
    length: mi.Float  # from there to where the ray starts
    last_ray: mi.Ray3f  # of the last vertex that was not passed straight on; so are the following
    last_hit: mi.PreliminaryIntersection3f
    last_si: mi.SurfaceInteraction3f
    last_pdf: mi.Float  # of the direction
    last_is_delta: mi.Bool

    def segment(self, scene: mi.Scene) -> PathSegment:
        """Return the segment that leads here."""
        ray, hits = mi.Ray3f(self.ray), self.hit.is_valid()
        ray.o = self.origin
        ray.maxt = dr.select(hits, self.length + self.hit.t, dr.inf)
        environment = scene.environment()
        emitter = dr.select(hits, self.hit.shape.emitter(), environment)
        pdf = dr.select(self.last_is_delta, dr.inf, self.last_pdf)
        is_open = mi.Bool(False) if environment is not None else ~hits
        return PathSegment(ray, self.last_hit.shape, emitter, pdf, is_open)

    def vertex(self, attached: bool) -> mi.SurfaceInteraction3f:
        """Return the vertex; attached: to the surfaces of this vertex and the last."""
        si = self.hit.compute_surface_interaction(self.ray, ray_flags=mi.RayFlags.All)
        if attached:
            last = self.last_hit.compute_surface_interaction(self.last_ray, mi.RayFlags.Minimal)
            here = dr.detach(si)
            moved = here.to_local(dr.normalize(last.p - here.p))
            si.wi = _replace_grad(si.wi, dr.select(self.depth >= 1, moved, si.wi))
        return si

    def next_vertex(self, step: _Step, si: mi.SurfaceInteraction3f) -> _Path:
        """Return the path at the next vertex."""
        passes = step.is_null
        length = self.length + dr.dot(step.ray.o - self.ray.o, self.ray.d)
        return _Path(
            ray=step.ray,
            hit=step.hit,
            active=step.active,
            depth=self.depth + dr.select(si.is_valid() & ~passes, mi.UInt32(1), 0),
            throughput=step.throughput,
            eta=step.eta,
            straight=self.straight & passes,
            origin=dr.select(passes, self.origin, step.ray.o),
            length=dr.select(passes, length, 0),
            last_ray=dr.select(passes, self.last_ray, self.ray),
            last_hit=dr.select(passes, self.last_hit, self.hit),
            last_si=dr.select(passes, self.last_si, dr.detach(si, True)),
            last_pdf=dr.select(passes, self.last_pdf, step.pdf),
            last_is_delta=dr.select(passes, self.last_is_delta, step.is_delta),
        )


@dataclass(frozen=True)
class _Vertex:
    scene: mi.Scene
    path: _Path  # that leads here
    si: mi.SurfaceInteraction3f
    arrives: mi.Spectrum  # throughput past the splats before it


@dataclass(frozen=True)
class _Step:
    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    active: mi.Bool
    is_null: mi.Bool  # whether the path goes straight on
    throughput: mi.Spectrum
    eta: mi.Float
    pdf: mi.Float
    type: mi.UInt32  # flags of the BSDF's part that was sampled
    numbers: tuple[mi.Float, mi.Point2f]  # random, in 0..1

    @property
    def is_delta(self) -> mi.Bool:
        """True where the sampled part of the BSDF is a delta function."""
        return mi.has_flag(self.type, mi.BSDFFlags.Delta)

    def relative_change(self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> mi.Spectrum:
        """Return 1, attached to the relative change of the light that the vertex reflects."""
        bsdf, is_delta = si.bsdf(ray), self.is_delta
        next_si = self.hit.compute_surface_interaction(self.ray, mi.RayFlags.Minimal, self.active)
        # A moving vertex sees the next one in another solid angle.
        next_si = dr.detach(next_si)
        hits = self.active & next_si.is_valid() & ~is_delta
        jacobian = solid_angle_to_area_jacobian(si.p, next_si.p, next_si.n, hits)
        moved = dr.select(next_si.is_valid(), dr.normalize(next_si.p - si.p), self.ray.d)
        wo = si.to_local(_replace_grad(self.ray.d, moved))
        value = bsdf.eval(mi.BSDFContext(), si, wo, self.active & ~is_delta)
        # A delta function evaluates to 0; the same numbers sample it again.
        again, weight = bsdf.sample(mi.BSDFContext(), si, *self.numbers, self.active & is_delta)
        value = dr.select(is_delta, weight * again.pdf, value)
        return dr.relative_grad(value) * dr.relative_grad(jacobian)


def _attach_sample(
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    ds: mi.DirectionSample3f,
    weight: mi.Spectrum,
    numbers: mi.Point2f,
    active: mi.Bool,
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """Attach an emitter sample, drawn with ``numbers``, and its weight to emitter and vertex."""
    flags = ds.emitter.flags()
    is_surface = mi.has_flag(flags, mi.EmitterFlags.Surface)
    is_infinite = mi.has_flag(flags, mi.EmitterFlags.Infinite)
    is_textured = active & is_surface & mi.has_flag(flags, mi.EmitterFlags.SpatiallyVarying)
    # A point on a moving textured emitter changes its radiance.
    towards = si.spawn_ray_to(ds.p)
    towards.o = dr.fma(towards.d, towards.maxt, towards.o)
    towards.maxt = dr.largest(towards.maxt)
    moved = mi.DirectionSample3f(scene, scene.ray_intersect(towards, is_textured), si)
    moved = dr.select(is_textured, moved, dr.zeros(mi.DirectionSample3f))
    moved.d = dr.select(is_textured, moved.d, dr.normalize(ds.p - si.p))
    moved.d = dr.select(is_infinite, ds.d, moved.d)
    # An emitter without a surface: the same numbers sample it again.
    again, of_lamp = scene.sample_emitter_direction(si, numbers, False, active & ds.delta)
    moved.d = dr.select(ds.delta, again.d, moved.d)
    ds = _replace_grad(ds, moved)
    # Samples are points of the emitter: a moving vertex sees them in another solid angle.
    p, n = dr.detach(ds.p), dr.detach(ds.n)
    jacobian = solid_angle_to_area_jacobian(si.p, p, n, active & is_surface)
    emitted = scene.eval_emitter_direction(si, ds, active)
    density = dr.select(ds.pdf != 0, dr.rcp(dr.detach(ds.pdf)), 0)
    weight = _replace_grad(weight, dr.select(ds.delta, of_lamp, emitted * density))
    return ds, weight * dr.relative_grad(jacobian)


mi.register_integrator("splatpath", lambda props: SplatPathIntegrator(props))
