"""Scenes of splats that lie on the film already, and what compositing them is checked against."""

from dataclasses import dataclass, field

import drjit as dr
import numpy as np
import pytest

from drgs.reference import splatting as reference
from drgs.splatting import rasterize
from drgs.splatting.cutoffs import Cutoffs
from drgs.splatting.footprint import FootprintModel
from drgs.splatting.grid import TileGrid
from drgs.splatting.projection import Splats2D
from drgs.splatting.rasterize import (
    SplatGradients,
    composite,
    composite_adjoint,
)
from support.helpers import (
    FLOAT32,
    FLOAT64,
    NEAR_THRESHOLD,
    assert_arrays_agree,
    bin_splats,
    rows,
    single,
)

GRADIENTS = {FLOAT64: 1e-12, FLOAT32: 5e-5}


@dataclass(frozen=True)
class FlatScene:
    """Splats on the film: the same numbers for both sides, representable in float32."""

    means2d: np.ndarray  # (N, 2) px
    conic_factor: np.ndarray  # (N, 3) p, r, s of U
    opacities: np.ndarray  # (N,)
    features: np.ndarray  # (N, C)
    depths: np.ndarray  # (N,)
    width: int
    height: int
    cutoffs: Cutoffs = field(default_factory=Cutoffs)

    @property
    def conics(self) -> np.ndarray:
        """(N, 2, 2): U^T U."""
        p, r, s = self.conic_factor.T
        return np.moveaxis(np.array([[p * p, p * r], [p * r, r * r + s * s]]), -1, 0)

    @property
    def visible(self) -> np.ndarray:
        return self.opacities > reference.ALPHA_CUT

    def colors(self, group) -> np.ndarray:
        """Features 3 group, 3 group + 1, ... as three colours, zero beyond the last."""
        padded = np.pad(self.features, ((0, 0), (0, 2)))[:, 3 * group : 3 * group + 3]
        return np.pad(padded, ((0, 0), (0, 3 - padded.shape[1])))

    def reference_arguments(self, group=0) -> dict:
        return {
            "means2d": self.means2d, "conics": self.conics, "opacities": self.opacities,
            "colors": self.colors(group), "depths": self.depths, "visible": self.visible,
            "background": np.zeros(3), "width": self.width, "height": self.height,
        }  # fmt: skip

    @property
    def num_groups(self) -> int:
        return -(-self.features.shape[1] // 3)

    def reference_planes(self) -> dict[str, np.ndarray]:
        """transmittance (H, W) and features (H, W, C)."""
        renders = [
            reference.composite(**self.reference_arguments(g)) for g in range(self.num_groups)
        ]
        images = np.concatenate([rendered.image for rendered in renders], axis=-1)
        return {
            "transmittance": renders[0].transmittance,
            "features": images[..., : self.features.shape[1]],
        }

    def reference_gradients(self, d_features, d_transmittance) -> dict[str, np.ndarray]:
        """Under the names of ``SplatGradients``. The loss is linear: groups of features add up."""
        total: dict[str, np.ndarray] = {}
        d_colors = []
        for group in range(self.num_groups):
            d_image = d_features[..., 3 * group : 3 * group + 3]
            d_image = np.pad(d_image, ((0, 0), (0, 0), (0, 3 - d_image.shape[-1])))
            d_alpha = -d_transmittance if group == 0 else None
            part = reference.composite_gradients(
                **self.reference_arguments(group), d_image=d_image, d_alpha=d_alpha
            )
            d_colors.append(part["colors"])
            for name in ("means2d", "conics", "opacities"):
                total[name] = total.get(name, 0) + part[name]
        p, r, s = self.conic_factor.T
        G = total.pop("conics")
        # A = U^T U and dL = sum_ij G_ij dA_ij, G symmetric: dL/dU = 2 U G.
        total["conic_factor"] = 2 * np.column_stack(
            [p * G[:, 0, 0] + r * G[:, 0, 1], p * G[:, 0, 1] + r * G[:, 1, 1], s * G[:, 1, 1]]
        )
        total["features"] = np.concatenate(d_colors, axis=-1)[:, : self.features.shape[1]]
        return total

    def near_threshold(self) -> np.ndarray:
        rendered = reference.composite(**self.reference_arguments(), threshold_width=NEAR_THRESHOLD)
        return rendered.near_threshold

    def num_stopped(self) -> int:
        """Pixels that are finished before the last splat that reaches them."""
        _, stops = reference.composite_and_stops(
            **self.reference_arguments(), threshold_width=NEAR_THRESHOLD
        )
        return int((stops < self.visible.sum()).sum())

    def num_clamped(self) -> int:
        """(pixel, splat) pairs whose alpha is clamped."""
        y, x = np.mgrid[: self.height, : self.width] + 0.5
        d = np.stack([x, y], axis=-1) - self.means2d[:, None, None]
        power = np.einsum("nhwi,nij,nhwj->nhw", d, self.conics, d)
        alpha = self.opacities[:, None, None] * np.exp(-0.5 * power)
        return int((alpha > reference.ALPHA_MAX).sum())

    # The kernels' side

    def splats(self, precision) -> Splats2D:
        determinants = np.linalg.det(self.conics)
        variances = np.column_stack([self.conics[:, 1, 1], self.conics[:, 0, 0]])
        return Splats2D(
            means2d=precision.vectors(self.means2d),
            conic_factor=precision.vectors(self.conic_factor),
            depths=precision.array(self.depths),
            opacities=precision.array(self.opacities),
            colors=precision.vectors(np.zeros((len(self.depths), 3))),
            variances=precision.vectors(variances / determinants[:, None]),
            visible=dr.llvm.ad.Bool(self.visible),
        )

    def composite(self, precision):
        columns = [precision.array(column) for column in self.features.T]
        grid, model = TileGrid(self.width, self.height), FootprintModel(cutoffs=self.cutoffs)
        bins = bin_splats(self.splats(precision), grid, columns, model)
        records = rasterize.Records.from_ranks(bins, bins.rows.load)
        return bins, records, composite(bins, records)

    def as_images(self, planes) -> dict[str, np.ndarray]:
        planes = [rows(plane).reshape(self.height, self.width) for plane in planes]
        return {"transmittance": planes[0], "features": np.stack(planes[1:], axis=-1)}

    def kernel_planes(self, precision) -> dict[str, np.ndarray]:
        return self.as_images(self.composite(precision)[2].planes())

    def kernel_gradients(self, precision, d_features, d_transmittance) -> dict[str, np.ndarray]:
        gradients = composite_adjoint(
            *self.composite(precision),
            [precision.array(plane) for plane in np.moveaxis(d_features, -1, 0)],
            precision.array(d_transmittance),
        )
        return as_arrays(gradients)

    def random_cotangents(self, seed=0) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(seed)
        shape = self.height, self.width
        return (
            single(rng.normal(0, 1, (*shape, self.features.shape[1]))),
            single(rng.normal(0, 1, shape)),
        )


def as_arrays(gradients: SplatGradients) -> dict[str, np.ndarray]:
    return {
        "means2d": rows(gradients.means2d),
        "conic_factor": rows(gradients.geometry[2:5]),
        "opacities": rows(gradients.opacities),
        "features": np.stack([rows(column) for column in gradients.features], axis=-1),
    }


def random_flat_scene(width, height, count, num_features=3, opaque=False, seed=0) -> FlatScene:
    """No pixel is near a threshold: seeds are tried until that holds."""
    for attempt in range(200):
        rng = np.random.default_rng([seed, attempt])
        extent = max(width, height)
        smallest, largest = (0.1 * extent, 0.5 * extent) if opaque else (0.55, 0.2 * extent + 2)
        sigma = np.exp(rng.uniform(np.log(smallest), np.log(largest), count))
        p = 1 / sigma
        s = 1 / (0.55 + (sigma - 0.55) * rng.uniform(0.1, 1, count))
        logits = rng.normal(0, 1.5, count)
        if opaque:
            logits = rng.uniform(1, 4, count)
            logits[::3] = 8.0
        scene = FlatScene(
            means2d=single(rng.uniform(-0.1, 1.1, (count, 2)) * [width, height]),
            conic_factor=single(np.column_stack([p, s * rng.normal(0, 0.7, count), s])),
            opacities=single(1 / (1 + np.exp(-logits))),
            features=single(rng.normal(0.5, 0.5, (count, num_features))),
            depths=single(rng.uniform(1, 4, count)),
            width=width,
            height=height,
        )
        if not scene.near_threshold().any():
            return scene
    raise AssertionError("no clear seed among 200")


def check_gradients_equal_the_reference(precision, scene):
    cotangents = scene.random_cotangents()
    actual = scene.kernel_gradients(precision, *cotangents)
    expected = scene.reference_gradients(*cotangents)
    assert_arrays_agree(actual, expected, GRADIENTS[precision])
    for name in actual:
        with pytest.raises(AssertionError, match=rf"{name}\["):
            scaled = {**actual, name: 1.01 * actual[name]}
            assert_arrays_agree(scaled, expected, GRADIENTS[precision])


def stack(opacities, width=1, height=1, sigma=10.0, offset=(0.0, 0.0)) -> FlatScene:
    """Splats behind each other on the film's centre, the nearest first, with features 1, 2, ..."""
    n = len(opacities)
    return FlatScene(
        means2d=np.tile(np.array([width / 2, height / 2]) + offset, (n, 1)),
        conic_factor=single(np.tile([1 / sigma, 0, 1 / sigma], (n, 1))),
        opacities=single(opacities),
        features=np.arange(1.0, n + 1)[:, None],
        depths=np.arange(1.0, n + 1),
        width=width,
        height=height,
    )
