"""Mutation check of the approximations' derivatives: exact falloff, order and colours of pixels.

As in ``test_adjoint_mutants``: every partial derivative is scaled by 1.01 and changes its sign, and
a check of the suite must notice it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import pytest
from support import approximation_checks as checks
from support.detectors import MutationChecks, detectors, find_noticed
from support.helpers import FLOAT64
from support.instrumented import Instrumented
from support.mutants import ALWAYS, AT_EQUALITY, Switchboard

from drgs.accuracy import exact, pixel_order, ray_colors
from drgs.splatting import rendering

_REASONS = {
    (
        "exact.RayFalloff.footprint",
        "squared < MAX_EXPONENT * denominator",
        (AT_EQUALITY, ALWAYS),
    ): "beyond it alpha is 2^-10000 = 0: it keeps the factors of that 0 from overflowing",
    (
        "pixel_order._walk",
        "along > 0",
        (AT_EQUALITY,),
    ): "an alpha at a depth of exactly 0; that it shows nothing is tested for RayFalloff",
    (
        "pixel_order._walk",
        "alpha >= UNORDERED_ALPHA",
        (AT_EQUALITY,),
    ): "an alpha of exactly 1e-4, which may be visited in either order",
}

EQUIVALENT = {
    (function, text, "", change): reason
    for (function, text, changes), reason in _REASONS.items()
    for change in changes
}
"""Mutants that change no result of any scene here, and why: (function, source, part, change)."""


@dataclass(frozen=True)
class Copies:
    """Instrumented copies of classes and a function."""

    falloff: type
    order: type
    colors: type
    add_product: Callable

    @staticmethod
    def of(board: Switchboard) -> "Copies":
        falloff = Instrumented(
            board,
            exact,
            derivatives=[
                f"RayFalloff.{name}"
                for name in ("moments", "derivatives", "pack_tangents", "tangent")
            ],
            forward=["RayFalloff.footprint", "RayFalloff.geometry", "RayFalloff.bounds"],
            RayFootprint=exact.RayFootprint,  # footprints are the package's
        )
        order = Instrumented(
            board,
            pixel_order,
            derivatives=["PixelOrder.adjoint", "PixelOrder.tangent"],
            forward=["PixelOrder.composite", "PixelOrder.keys"],
            _OrderedLayers=pixel_order._OrderedLayers,  # as are layers
        )
        colors = Instrumented(
            board,
            ray_colors,
            derivatives=["RayColors.add_derivatives", "RayColors.tangents"],
            forward=["RayColors.pixel_values", "RayColors.bind"],
        )
        return Copies(
            falloff=falloff["RayFalloff"],
            order=order["PixelOrder"],
            colors=colors["RayColors"],
            add_product=order["_add_product"],
        )

    def frame_with_copies(self, frame: rendering.Frame) -> rendering.Frame:
        """The frame, whose forward pass is that of the package, with derivatives of the copies."""
        model, order = frame.bins.model, frame.order
        features = model.features
        if isinstance(model.falloff, exact.RayFalloff):
            model = replace(model, falloff=self.falloff(model.falloff.camera))
        if isinstance(features, ray_colors.RayColors):
            model = replace(model, features=self.colors(features.sh_degree, features.camera))
        if isinstance(order, pixel_order.PixelOrder):
            order = self.order(order.window, order.depths)
        return replace(frame, bins=replace(frame.bins, model=model), order=order)


@pytest.fixture(scope="module")
def outcome():
    board = Switchboard()
    copies = Copies.of(board)
    package_render, problem_render = rendering.render, cache(checks.Problem.render)

    def render(problem, precision):
        gaussians, frame = problem_render(problem, precision)
        return gaussians, copies.frame_with_copies(frame)

    def with_copies(check):
        """For a test that uses the classes themselves."""

        def run():
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(exact, "RayFalloff", copies.falloff)
                patch.setattr(ray_colors, "RayColors", copies.colors)
                patch.setattr(pixel_order, "_add_product", copies.add_product)
                check()

        return run

    def rendering_with_copies(check):
        """For a test that renders no ``Problem``."""

        def run():
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(
                    rendering, "render", lambda *a: copies.frame_with_copies(package_render(*a))
                )
                check()

        return run

    gradients = checks.check_gradients_equal_central_differences_of_the_reference
    transpose = partial(checks.check_adjoint_is_the_transpose_of_the_tangent, FLOAT64)
    general = {"gradients": partial(gradients, "close", "all three, other cuts")}
    special = {
        "transpose": partial(transpose, "close", "all three, other cuts"),
        "around, by depth": partial(gradients, "around", "pixel order"),
        "around, by depth, transpose": partial(transpose, "around", "pixel order"),
        "no opacity": with_copies(checks.check_a_splat_without_opacity_has_no_derivatives),
        "at the camera": with_copies(checks.check_a_peak_in_the_plane_of_the_camera_shows_nothing),
        "colour at its minimum": with_copies(
            checks.check_a_colour_at_its_minimum_keeps_its_derivative
        ),
        "twice the precision": with_copies(
            checks.check_sums_of_products_are_exact_to_twice_the_precision
        ),
        "hundreds of layers": rendering_with_copies(
            checks.check_behind_hundreds_of_layers_gradients_keep_their_accuracy
        ),
        "twins": rendering_with_copies(
            checks.check_twins_are_composited_in_one_order_by_image_and_derivative
        ),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checks.Problem, "render", render)
        return find_noticed(board, detectors(general), detectors(special))


@pytest.mark.slow
class TestApproximations(MutationChecks):
    equivalent = EQUIVALENT
    derivatives = """
        exact.RayFalloff.moments
        exact.RayFalloff.derivatives exact.RayFalloff.tangent
        exact.RayFalloff.pack_tangents pixel_order._adjoint pixel_order._add_product
        pixel_order._totals pixel_order._pairs pixel_order._sum_pixels pixel_order._tangent
        ray_colors.RayColors.add_derivatives ray_colors.RayColors.tangents
    """
