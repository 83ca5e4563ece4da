"""Mistakes in hand-written derivatives are found by the laws on the cases of the matrix.

Every partial derivative in the source of the adjoints and tangents is scaled by 1.01 and, on its
own, changes its sign; every decision that they replay is dropped, or taken the other way where
two numbers are equal. ``mutants`` makes the mutants; each must violate a law on some case, in
double precision. Laws of hard cases are asked about the mutants that the others do not notice.

Where Dr.Jit differentiates (projection, spherical harmonics), mutants are what it is given and
what it returns. ``pytest tests/test_mutants.py -m slow -n 0 -s`` shows what noticed what.
"""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float64
from support import loss_checks, special_checks
from support.cases import CASES
from support.instrumented import Instrumented
from support.kernels import kernels_of
from support.mutants import ALWAYS, AT_EQUALITY, NEGATED, NEVER, SCALED, Mutant, Switchboard

from drgs.accuracy import exact, pixel_order, ray_colors
from drgs.splatting import footprint, order, rasterize, reduction, rendering
from drgs.testing import (
    Case,
    adjoint_is_transpose,
    camera_gradients_equal_differences,
    gradients_equal_differences,
)
from drgs.training import losses

FALLOFF_DERIVATIVES = ("moments", "derivatives", "pack_tangents", "tangent")

STAGES = ("composite_adjoint", "composite_tangent")

SUMS = ("CompositedPairs", "split_bands", "assign_slots", "sum_entries", "sum_runs")


# ----------------------------------------------------------------------------------------------
# Instrumented copies
# ----------------------------------------------------------------------------------------------


class Copies:
    """Copies of the modules with derivatives, whose values pass through a board's switches."""

    def __init__(self, board: Switchboard) -> None:
        sums = Instrumented(
            board,
            reduction,
            derivatives=["CompositedPairs.find", *SUMS[1:]],
            forward=[],
            PAIRS_AT_ONCE=0,  # so that slots are counted
        )
        self.kernels = Instrumented(
            board,
            rasterize,
            derivatives=STAGES,
            forward=["composite", "Records.from_splats", "CompositedTiles.planes"],
            **{name: sums[name] for name in SUMS},
        )
        self.chain = Instrumented(
            board,
            rendering,
            derivatives=["frames_adjoint", "splats_adjoint", "frames_tangent"],
            forward=["render", "Frame.planes"],
        )
        self.model = Instrumented(
            board,
            footprint,
            derivatives=[
                "ImageModel.footprint",
                "ImageModel.alphas",
                *(f"GaussianFalloff.{name}" for name in FALLOFF_DERIVATIVES),
                *(f"PixelCenters.{name}" for name in ("sum", "sum_dx", "sum_dy", "sum_dy_dy")),
                *(f"SplatFeatures.{name}" for name in ("add_derivatives", "tangents")),
            ],
            forward=["ImageModel.footprint", "ImageModel.alphas"],
        )
        self.falloff = Instrumented(
            board,
            exact,
            derivatives=[f"RayFalloff.{name}" for name in FALLOFF_DERIVATIVES],
            forward=["RayFalloff.footprint", "RayFalloff.geometry", "RayFalloff.bounds"],
            RayFootprint=exact.RayFootprint,  # footprints are the package's
        )
        self.order = Instrumented(
            board,
            pixel_order,
            derivatives=["PixelOrder.adjoint", "PixelOrder.tangent"],
            forward=["PixelOrder.composite", "PixelOrder.keys"],
            _OrderedTiles=pixel_order._OrderedTiles,  # as are tiles
        )
        self.colors = Instrumented(
            board,
            ray_colors,
            derivatives=["RayColors.add_derivatives", "RayColors.tangents"],
            forward=["RayColors.pixel_values", "RayColors.bind"],
        )
        # All of the loss: its forward pass evaluates the partial derivatives, too.
        self.loss = Instrumented(
            board,
            losses,
            derivatives=["PhotometricLoss.__call__", "l1_loss"],
            forward=["prepare_target", "Target.image"],
        )

    def frame(self, frame: rendering.Frame) -> rendering.Frame:
        """Return a frame of the package with the copies' derivatives."""
        bins, order = frame.tiles.bins, frame.order
        falloff, features = bins.model.falloff, bins.model.features
        if isinstance(falloff, exact.RayFalloff):
            falloff = self.falloff["RayFalloff"](falloff.camera)
        if isinstance(features, ray_colors.RayColors):
            features = self.colors["RayColors"](features.sh_degree, features.camera)
        if isinstance(order, pixel_order.PixelOrder):
            order = self.order["PixelOrder"](order.window, order.depths)
        bins = replace(bins, model=replace(bins.model, falloff=falloff, features=features))
        return replace(frame, tiles=replace(frame.tiles, bins=bins), order=order)

    def stage(self, name: str) -> Callable:
        """Return the copy of a stage of compositing, which uses the copy of the model."""

        def run(tiles, *arguments):
            given = {
                name: value
                for name, value in vars(tiles.bins.model).items()
                if type(value).__module__ != footprint.__name__ or name == "cutoffs"
            }
            bins = replace(tiles.bins, model=self.model["ImageModel"](**given))
            return self.kernels[name](replace(tiles, bins=bins), *arguments)

        return run

    def apply(self, patch: pytest.MonkeyPatch) -> None:
        """Let the package use the copies' derivatives, and its own forward pass."""
        render = rendering.render
        patch.setattr(rendering, "render", lambda *a: self.frame(render(*a)))
        for name in ("frames_adjoint", "frames_tangent"):
            patch.setattr(rendering, name, self.chain[name])
        for name in STAGES:
            patch.setattr(order, name, self.stage(name))
        patch.setattr(footprint, "GaussianFalloff", self.model["GaussianFalloff"])
        patch.setattr(special_checks, "Alpha", self.model["Alpha"])
        patch.setattr(special_checks, "composite_step", self.kernels["composite_step"])
        patch.setattr(exact, "RayFalloff", self.falloff["RayFalloff"])
        patch.setattr(ray_colors, "RayColors", self.colors["RayColors"])
        patch.setattr(pixel_order, "_add_product", self.order["_add_product"])
        for name in ("PhotometricLoss", "l1_loss"):
            patch.setattr(loss_checks, name, self.loss[name])


# ----------------------------------------------------------------------------------------------
# What notices mutants
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Detector:
    """A test of the suite that is to notice mutants."""

    name: str
    check: Callable[[], None]

    def notices(self) -> bool:
        """Whether the check fails. An error that is no failed comparison is passed on."""
        try:
            with np.errstate(all="ignore"):
                self.check()
        except (AssertionError, pytest.fail.Exception):
            return True
        return False


@dataclass(frozen=True)
class Outcome:
    """The results of all mutants."""

    board: Switchboard
    detectors: list[str]
    false_alarms: list[str]  # detectors that fail without a mutant
    noticed_by: dict[Mutant, list[str]]

    @property
    def table(self) -> str:
        """A line for each mutant."""
        lines = [
            f"{str(mutant)[:110]:110}  {mutant.change:11}  {', '.join(names) or '-'}"
            for mutant, names in self.noticed_by.items()
        ]
        reasons = Counter(reason for _, _, reason in self.board.left_out)
        lines += [f"left out {count:3}: {reason}" for reason, count in reasons.items()]
        return "\n".join(lines)


def find_noticed(board: Switchboard, general: list[Detector], special: list[Detector]) -> Outcome:
    """Ask about each mutant ``general`` detectors, then, if none noticed it, ``special`` ones."""
    false_alarms, reached, noticed_by = [], {}, {}
    for detector in (*general, *special):
        fails, reached[detector.name] = board.record(detector.notices)
        if fails:
            false_alarms.append(detector.name)
    for mutant in board.mutants:
        board.apply(mutant)

        def ask(group: list[Detector], mutant: Mutant = mutant) -> list[str]:
            return [d.name for d in group if mutant.switch in reached[d.name] and d.notices()]

        noticed_by[mutant] = ask(general) or ask(special)
    board.apply(None)
    return Outcome(board, list(reached), false_alarms, noticed_by)


class RememberedCase(Case):
    """A case whose forward passes are computed once, for they are the same for all mutants."""

    @classmethod
    def of(cls, case: Case) -> RememberedCase:
        names = Case.__dataclass_fields__
        remembered = cls(**{name: getattr(case, name) for name in names})
        if case.reference is not None:
            object.__setattr__(remembered, "reference", _remember(case.reference))
        return remembered

    def frames(self, values, Float=Float64):
        if values is not self.values:
            return super().frames(values, Float)
        found = vars(self).setdefault("found", {})
        if Float not in found:
            found[Float] = super().frames(values, Float)
        return found[Float]


def _remember(reference):
    images = {}

    def call(case, values):
        key = tuple(value.tobytes() for value in values.values())
        if key not in images:
            images[key] = reference(case, values)
        return images[key]

    return call


@cache
def _loss_and_gradient(height, width, weight):
    """Return two images, the loss and its gradient by central differences of the naive formula."""
    x, y = loss_checks.images(height, width, seed=1)
    gradient, step = np.empty_like(x), 1e-5
    assert np.abs(x - y).min() > step  # |x - y| has a kink
    for index in np.ndindex(x.shape):
        moved = np.zeros_like(x)
        moved[index] = step
        ends = [loss_checks.reference(x + sign * moved, y, weight) for sign in (1, -1)]
        gradient[index] = (ends[0] - ends[1]) / (2 * step)
    return x, y, loss_checks.reference(x, y, weight), gradient


def _check_loss_and_gradient():
    x, y, expected_loss, expected_gradient = _loss_and_gradient(9, 3, 0.2)
    loss, gradient = loss_checks.value_and_gradient(x, y, 0.2)
    # Tolerances of test_losses.
    assert loss == pytest.approx(expected_loss, rel=1e-12)
    np.testing.assert_allclose(gradient, expected_gradient, rtol=1e-5, atol=2e-11)


LAWS_OF_DERIVATIVES = (
    gradients_equal_differences,
    adjoint_is_transpose,
    camera_gradients_equal_differences,
)


def detectors(which) -> list[Detector]:
    """Return laws on cases, given the names of cases and the laws."""
    named = {case.name: case for case in CASES}
    checks = {}
    for key, laws in which:
        case = RememberedCase.of(key() if callable(key) else named[key])
        checks |= {f"{case.name}: {law.__name__}": partial(law, case) for law in laws}
    return [Detector(*item) for item in checks.items()]


LOSSES = {
    "loss": _check_loss_and_gradient,
    "loss transpose": loss_checks.check_gradient_is_the_transpose_of_the_tangent,
    "loss at equality": loss_checks.check_l1_gradient_is_the_sign_and_zero_at_equality,
    "squared error": partial(
        loss_checks.check_squared_error_is_the_mean_over_pixels_and_channels, 0.2
    ),
    "squared error of L1": partial(
        loss_checks.check_squared_error_is_the_mean_over_pixels_and_channels, 0
    ),
    "loss of black": loss_checks.check_black_photographs_count_like_others,
    "loss overexposed": loss_checks.check_overexposed_images_do_not_blow_up_the_gradient,
}

GENERAL = [
    ("default, mixed", LAWS_OF_DERIVATIVES),
    ("all three, other cuts, close", (gradients_equal_differences, adjoint_is_transpose)),
]
SPECIAL = [
    ("pixel order, needles", (gradients_equal_differences, adjoint_is_transpose)),
    ("pixel colours, pinhole", (gradients_equal_differences, adjoint_is_transpose)),
]
"""Cases and laws that notice mutants: those asked about each mutant, and those about the others."""


@cache
def outcome() -> Outcome:
    """Return which detectors notice which mutants."""
    board = Switchboard()
    first, *others = (Detector(name, check) for name, check in LOSSES.items())
    others += [Detector(check.__name__, check) for check in special_checks.CHECKS]
    with pytest.MonkeyPatch.context() as patch:
        Copies(board).apply(patch)
        return find_noticed(board, [*detectors(GENERAL), first], detectors(SPECIAL) + others)


# ----------------------------------------------------------------------------------------------
# Mutants
# ----------------------------------------------------------------------------------------------

REASONS = {
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
    **dict.fromkeys(
        (
            ("rendering.gradients_by_row", text, (SCALED, NEGATED))
            for text in (
                "dr.opaque(t.Float, 0)",
                "zeros = {name: [t.Float(zero) for _ in range(width)]"
                " for name, width in widths.items()}",
                "zeros.pop('')",
            )
        ),
        "zeros of Gaussians that no pixel depends on",
    ),
}

EQUIVALENT = {
    (function, text, "", change): reason
    for (function, text, changes), reason in REASONS.items()
    for change in changes
}
"""Mutants that change no result of any scene here, and why: (function, source, part, change)."""

ELSEWHERE = {
    **{
        f"losses.Loss.with_squared_error{site}": "test_extensions: a loss from outside"
        for site in (
            "error = dr.mean(dr.square(dr.detach(image).array - target.image.array))",
            "term dr.detach(image).array of dr.detach(image).array - target.image.array",
            "term target.image.array of dr.detach(image).array - target.image.array",
            "self(image, target)",
        )
    },
    **dict.fromkeys(
        (
            "reduction.split_bandsBand(tiles, entries, MICROS * len(entries))",
            "rasterize.composite_adjointnum_rows = int(pairs.row[dr.width(pairs.row) - 1])",
        ),
        "test_rasterize: bands of any size, among them one whose slots are not counted",
    ),
    "footprint.Cutoffs.log2_floorat_extent > least": "the package's own cut-offs are used",
    **dict.fromkeys(
        (
            "rendering.Pipeline.select_differentiable"
            "return rows if self.of_smoothing else replace(rows, smoothing=None)",
            "rendering._columns_ofd_rows.smoothing",
        ),
        "test_placement: a smoothing filter that grows with an object",
    ),
}
"""Places in the source that only other tests reach, and which."""

FUNCTIONS = """
    rasterize._partials rasterize._adjoint_step reduction.sum_entries reduction.sum_runs
    rasterize.composite_tangent rasterize.pack_tangents footprint.GaussianFalloff.moments
    footprint.GaussianFalloff.derivatives footprint.GaussianFalloff.tangent
    footprint.GaussianFalloff.pack_tangents footprint.SplatFeatures.add_derivatives
    footprint.PixelCenters.sum_dx rendering.frames_tangent
    rendering._back_to_rows rendering.gradients_by_row rendering._as_tensors
    losses._ssim_and_partials losses._assemble_gradient losses._PhotometricOp.backward
    losses._PhotometricOp.forward losses.l1_loss exact.RayFalloff.moments
    exact.RayFalloff.derivatives exact.RayFalloff.tangent exact.RayFalloff.pack_tangents
    pixel_order._add_product pixel_order._totals pixel_order._pairs
    pixel_order._sum_pixels pixel_order.PixelOrder.tangent ray_colors.RayColors.add_derivatives
    ray_colors.RayColors.tangents
"""
"""Functions that have mutants, at least these: derivatives are found by their callers."""


def _key(mutant: Mutant) -> tuple[str, str, str, str]:
    return mutant.site.function, mutant.site.text, mutant.part, mutant.change


@pytest.mark.slow
class TestMutants:
    def test_nothing_is_noticed_without_a_mutant(self):
        """Instrumentation changes no result."""
        assert outcome().false_alarms == []

    def test_every_mutant_is_noticed(self):
        print(f"\n{outcome().table}\n{len(outcome().noticed_by)} mutants")
        unnoticed = [mutant for mutant, names in outcome().noticed_by.items() if not names]
        survivors = [f"{m}  {m.change}" for m in unnoticed if _key(m) not in EQUIVALENT]
        assert not survivors, "noticed by nobody:\n" + "\n".join(survivors)

    def test_equivalent_mutants_exist_and_are_not_noticed(self):
        """Otherwise the reason for leaving them out no longer holds."""
        noticed_by = {_key(mutant): names for mutant, names in outcome().noticed_by.items()}
        assert {key: noticed_by.get(key) for key in EQUIVALENT} == {key: [] for key in EQUIVALENT}

    def test_every_law_and_case_notices_a_mutant(self):
        busy = {name for names in outcome().noticed_by.values() for name in names}
        assert busy == set(outcome().detectors)

    def test_derivatives_have_mutants(self):
        scaled = {m.site.function for m in outcome().noticed_by if m.change == SCALED}
        assert set(FUNCTIONS.split()) <= scaled

    def test_every_site_is_evaluated(self):
        """A partial that no case reaches would have no mutant."""
        idle = {f"{s.function}{s.text}" for s in outcome().board.sites if not s.evaluated}
        assert idle == set(ELSEWHERE)


@pytest.mark.parametrize("check", special_checks.CHECKS, ids=lambda check: check.__name__)
def test_special_checks_hold(check):
    check()


# ----------------------------------------------------------------------------------------------
# The mutants themselves
# ----------------------------------------------------------------------------------------------

SAMPLE = """
import drjit as dr

def forward(x, y):
    return dr.select(x < y, x * y, 0)

def adjoint(x, y, g):
    below = x < y
    zero = type(x)(0)
    d_x = dr.select(below, g * y, zero)
    partials = [d_x, 1 - g * x]
    return partials
"""


def sample_mutants(source):
    """{(source, change): what the adjoint then returns} at x = 2, y = 3, g = 5."""
    board = Switchboard()
    adjoint = Instrumented(board, source, ["adjoint"], ["forward"])["adjoint"]
    arguments = Float64(2), Float64(3), Float64(5)

    def result():
        return [value[0] for value in adjoint(*arguments)]

    assert result() == [15, -9]
    results = {}
    for mutant in board.mutants:
        board.apply(mutant)
        results[mutant.site.text, mutant.change] = result()
    board.apply(None)
    assert result() == [15, -9]
    return results


def test_mutants_compute_their_described_change():
    expected = {
        ("x < y", AT_EQUALITY): [15, -9],
        ("x < y", ALWAYS): [15, -9],
        ("x < y", NEVER): [0, -9],
        ("d_x = dr.select(below, g * y, zero)", SCALED): [15.15, -9],
        ("d_x = dr.select(below, g * y, zero)", NEGATED): [-15, -9],
        ("dr.select(below, g * y, zero)", ALWAYS): [15, -9],
        ("dr.select(below, g * y, zero)", NEVER): [0, -9],
        ("d_x", SCALED): [15.15, -9],
        ("d_x", NEGATED): [-15, -9],
        ("term 1 of 1 - g * x", SCALED): [15, -8.99],
        ("term 1 of 1 - g * x", NEGATED): [15, -11],
        ("term g * x of 1 - g * x", SCALED): [15, -9.1],
        ("term g * x of 1 - g * x", NEGATED): [15, 11],
    }
    assert sample_mutants(SAMPLE) == {key: pytest.approx(value) for key, value in expected.items()}


def test_added_partial_has_mutants():
    added = SAMPLE.replace("1 - g * x]", "dr.fma(g, -x, 2 - x / x)]")
    texts = {text for text, _ in set(sample_mutants(added)) - set(sample_mutants(SAMPLE))}
    assert texts == {
        "term g of dr.fma(g, -x, 2 - x / x)",
        "term 2 of 2 - x / x",
        "term x / x of 2 - x / x",
    }


def test_mutants_compile_no_kernel():
    board = Switchboard()
    adjoint = Instrumented(board, SAMPLE, ["adjoint"], ["forward"])["adjoint"]
    arguments = [dr.opaque(Float64, value, 4) for value in (2, 3, 5)]

    def kernels():
        return kernels_of(lambda: dr.eval(adjoint(*arguments)))

    first = kernels()
    assert first
    for mutant in board.mutants:
        board.apply(mutant)
        assert kernels() == first, textwrap.shorten(str(mutant), 80)
