"""The scene representation: N anisotropic 3D Gaussians with view-dependent colour.

A :class:`Gaussians` comes from a file, from numpy arrays or from the trainer's optimizer and is
what ``drgs.splatting.projection`` and ``drgs.gaussians.sh`` read. It holds either numpy arrays (as
files give them; no Dr.Jit backend is touched) or Dr.Jit arrays, from which stages derive types.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

import drjit as dr
import numpy as np
from drjit.auto.ad import Array3f, Array4f, Matrix3f

from drgs.core.arrays import from_host, real_numbers, types_of
from drgs.core.errors import UserError, check_type, note_user
from drgs.core.files import write_bytes
from drgs.core.origin import WORLD, Origin, format_origin
from drgs.core.registry import HOW_TO_INSTALL
from drgs.core.types import TensorXf

if TYPE_CHECKING:
    from drgs.io.formats import Scalar

Tensor = TypeVar("Tensor", bound=np.ndarray | dr.ArrayBase)  # ``np.ndarray`` or ``TensorXf``

PARAMETER_NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


@dataclass(frozen=True)
class Gaussians(Generic[Tensor]):
    """N Gaussians. Raw, unconstrained values carry ``log_`` / ``logit_`` in their names.

    All are row-major tensors (``TensorXf`` / ``TensorXf64``, or numpy arrays), except
    ``logit_opacities``, a flat ``Float``.
    """

    means: Tensor  # (N, 3) world
    quats: Tensor  # (N, 4) wxyz, not normalised
    log_scales: Tensor  # (N, 3) natural logarithm of the standard deviations, world units
    logit_opacities: Tensor  # (N,)
    sh0: Tensor  # (N, 1, 3) degree-0 coefficients, display space
    shN: Tensor  # (N, K - 1, 3) coefficients of degree >= 1, K = (degree + 1)^2  # noqa: N815
    smoothing: Tensor | None = None  # (N,) world units, not optimised: drgs.effects.smoothing
    features: Mapping[str, Tensor] | None = None  # (N, C) by name, composited besides colours
    rendered_with: Mapping[str, bool | int | float | str] | None = None  # settings of a file
    origin: Origin = WORLD  # world: what the means are relative to

    @staticmethod
    def load(path: str | Path) -> Gaussians[np.ndarray]:
        """Read the Gaussians of a file, as numpy arrays: PLY, or another of ``drgs.io.formats``.

        float32, with the values, the SH degree and the recorded settings of the file. Gaussians of
        a format whose y axis is up are turned so that z is, as it is in datasets.

        Raises ``drgs.core.errors.UserError`` (a ValueError) naming the file and what is wrong.
        """
        from drgs.io.formats import UP, Z_TO_Y, pop_origin, read_gaussians

        check_type("Gaussians.load()", "path", path, str, Path)
        extension, arrays, rendered_with = read_gaussians(path)
        up = extension.value.up and rendered_with.pop(UP, extension.value.up)
        origin = pop_origin(path, rendered_with)
        gaussians = Gaussians.from_arrays(arrays)
        gaussians = replace(gaussians, rendered_with=rendered_with or None, origin=origin)
        return gaussians._rotate(Z_TO_Y.T) if up == "y" else gaussians

    def save(self, path: str | Path) -> None:
        """Write a file, atomically, in the format that its suffix names: see ``drgs.io.formats``.

        Equal Gaussians give equal bytes. Formats whose y axis is up get them turned, as ``load``
        expects them. Not saved: ``features``, and what the format has no room for (a ``UserNote``).

        Raises ``drgs.core.errors.UserError`` (a ValueError) for another suffix, or where the format
        cannot hold them.
        """
        from drgs.io.formats import format_for, writable_formats

        check_type("Gaussians.save()", "path", path, str, Path)
        chosen = format_for(path)
        if chosen is None:
            suffixes = ", ".join(each.value.suffix for each in writable_formats())
            raise UserError(f"{path}: the name must end in one of {suffixes}; {HOW_TO_INSTALL}")
        write_bytes(path, self.to_bytes(chosen.name))

    def to_bytes(self, name: str) -> bytes:
        """Return what ``save`` writes in the format ``name`` of ``drgs.io.formats.FORMATS``."""
        from drgs.io.formats import encode

        return encode(name, *self.arrays_for(name))

    def arrays_for(self, name: str) -> tuple[dict[str, np.ndarray], dict[str, Scalar]]:
        """Return the arguments of ``drgs.io.formats.encode``, in the axes of the format ``name``.

        A ``UserNote`` names what the format has no room for.
        """
        from drgs.io.formats import FORMATS, ORIGIN, Z_TO_Y, check_shapes

        chosen, host = FORMATS.get(name).value, self.numpy()
        check_shapes(name, {n: getattr(host, n) for n in host._names})
        values = dict(self.rendered_with or {})
        lost = ["harmonics"] if self.sh_degree > 0 and not chosen.has_harmonics else []
        lost += [f"{key} {value}" for key, value in values.items() if not chosen.holds(key)]
        if self.origin != WORLD and not chosen.holds(ORIGIN[0]):
            lost.append(f"the origin {format_origin(self.origin)} of its coordinates")
        if lost:
            note_user(f"the format {name} has no room for {', '.join(lost)}: left out")
        host = host._rotate(Z_TO_Y) if chosen.up == "y" else host
        if self.origin != WORLD:
            values |= dict(zip(ORIGIN, host.origin, strict=True))
        return {n: getattr(host, n) for n in host._names}, values

    @staticmethod
    def from_numpy(
        means: np.ndarray,
        quats: np.ndarray,
        scales: np.ndarray,
        opacities: np.ndarray,
        sh: np.ndarray,
    ) -> Gaussians[np.ndarray]:
        """Return Gaussians of float32 numpy arrays from activated values, as they are seen.

        means: (N, 3) world; quats: (N, 4) wxyz, of any norm; scales: (N, 3) standard deviations,
        world units; opacities: (N,); sh: (N, K, 3) coefficients, display space, of degree 0 to 3,
        K = (degree + 1)^2.

        Raises TypeError for values that are no real numbers, and ValueError for another shape, a
        number that is not finite, a quaternion of zeros, a scale that is not positive, or an
        opacity that is not between 0 and 1.
        """
        given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
        means, quats, scales, opacities, sh = (
            real_numbers("Gaussians.from_numpy()", *item).astype(np.float32)
            for item in given.items()
        )
        num = len(np.atleast_1d(means))
        shapes = {
            "means": (means, [(num, 3)]),
            "quats": (quats, [(num, 4)]),
            "scales": (scales, [(num, 3)]),
            "opacities": (opacities, [(num,)]),
            "sh": (sh, [(num, (degree + 1) ** 2, 3) for degree in range(4)]),
        }
        where = "Gaussians.from_numpy(): "
        for name, (values, allowed) in shapes.items():
            if values.shape not in allowed:
                expected = " or ".join(map(str, allowed))
                raise ValueError(f"{where}{name} must be of shape {expected}, got {values.shape}")
            if not np.isfinite(values).all():
                raise ValueError(f"{where}{name} must be finite in single precision")
        for name, values, most in (("scales", scales, np.inf), ("opacities", opacities, 1)):
            bad = values[~((values > 0) & (values < most))]
            if len(bad):
                raise ValueError(f"{where}{name} must be above 0 and below {most}, got {bad[0]}")
        if not quats.any(axis=1).all():
            raise ValueError(f"{where}quats must not be all zero")
        return Gaussians(
            means=means,
            quats=quats,
            log_scales=np.log(scales),
            logit_opacities=np.log(opacities) - np.log1p(-opacities),
            sh0=sh[:, :1],
            shN=sh[:, 1:],
        )

    @staticmethod
    def concatenate(parts: Sequence[Gaussians[Any]]) -> Gaussians[np.ndarray]:
        """Return the Gaussians of all parts as numpy arrays, with zeros for harmonics they lack.

        Origin and ``rendered_with`` are those of the first part. Features and the smoothing filter
        are left out where a part has none.
        """
        first, hosts, arrays = parts[0], [part.numpy() for part in parts], {}
        count = max(host.shN.shape[1] for host in hosts)
        for name in set.intersection(*(set(host.arrays) for host in hosts)):
            values = [host.arrays[name] for host in hosts]
            if name == "means":
                values = [h.means + np.subtract(h.origin, first.origin) for h in hosts]
            elif name == "shN":
                values = [np.pad(v, ((0, 0), (0, count - v.shape[1]), (0, 0))) for v in values]
            arrays[name] = np.concatenate(values).astype(hosts[0].arrays[name].dtype)
        whole = Gaussians.from_arrays(arrays)
        return replace(whole, rendered_with=first.rendered_with, origin=first.origin)

    def __len__(self) -> int:
        """Return N."""
        return self.num_gaussians

    def __getitem__(self, rows: Any) -> Gaussians[np.ndarray]:
        """Return some of the Gaussians as numpy arrays.

        rows: a mask (N,), indices, a slice or a number.
        """
        rows = np.atleast_1d(np.arange(self.num_gaussians)[rows])
        some = {name: np.asarray(array)[rows] for name, array in self.arrays.items()}
        chosen = Gaussians.from_arrays(some)
        return replace(chosen, rendered_with=self.rendered_with, origin=self.origin)

    @property
    def num_gaussians(self) -> int:
        """N."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest spherical-harmonics degree stored: 0 to 3."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[self.shN.shape[1]]

    @property
    def scales(self) -> Tensor:
        """(N, 3) standard deviations, world units."""
        return _exp(self.log_scales)

    @property
    def opacities(self) -> Tensor:
        """(N,) in (0, 1)."""
        return cast("Tensor", 1.0 / (1.0 + _exp(-self.logit_opacities)))

    @property
    def sh(self) -> Tensor:
        """(N, K, 3) coefficients of all degrees, display space; K = (sh_degree + 1)^2."""
        if self.shN.shape[1] == 0:  # which dr.concat does not take
            return self.sh0
        concat = np.concatenate if isinstance(self.sh0, np.ndarray) else dr.concat
        return cast("Callable[..., Tensor]", concat)((self.sh0, self.shN), axis=1)

    @property
    def arrays(self) -> dict[str, Tensor]:
        """All arrays by name: the parameters, the smoothing filter if there is one, features."""
        return {name: getattr(self, name) for name in self._names} | dict(self.features or {})

    @staticmethod
    def from_arrays(arrays: Mapping[str, Any]) -> Gaussians[Any]:
        """Return Gaussians of :attr:`arrays`; names of no parameter are those of features."""
        names = (*PARAMETER_NAMES, "smoothing")
        features = {name: array for name, array in arrays.items() if name not in names}
        parameters = {name: array for name, array in arrays.items() if name in names}
        return Gaussians(**parameters, features=features or None)

    def numpy(self) -> Gaussians[np.ndarray]:
        """Return the same Gaussians as numpy arrays on the host."""
        host = Gaussians.from_arrays({name: np.array(v) for name, v in self.arrays.items()})
        return replace(host, rendered_with=self.rendered_with, origin=self.origin)

    def to(self, tensor_type: type[dr.ArrayBase]) -> Gaussians[TensorXf]:
        """Copy to Dr.Jit tensors of type ``tensor_type`` (``TensorXf`` or ``TensorXf64``)."""
        flat_type = dr.array_t(tensor_type)

        def upload(array: Tensor) -> dr.ArrayBase:
            values = np.asarray(array)
            flat = from_host(flat_type, values)
            return flat if values.ndim == 1 else tensor_type(flat, values.shape)

        uploaded = Gaussians.from_arrays({name: upload(v) for name, v in self.arrays.items()})
        return replace(uploaded, rendered_with=self.rendered_with, origin=self.origin)

    def _rotate(self: Gaussians[np.ndarray], rotation: np.ndarray) -> Gaussians[np.ndarray]:
        from drgs.gaussians.rotation import rotate_gaussians, to_float32

        parts = rotate_gaussians(self.means, self.quats, self.shN, rotation)
        names = ("means", "quats", "shN")
        means, quats, shN = (to_float32(n, p) for n, p in zip(names, parts, strict=True))
        x, y, z = (rotation @ self.origin).tolist()
        return replace(self, means=means, quats=quats, shN=shN, origin=(x, y, z))

    @property
    def _names(self) -> tuple[str, ...]:
        return PARAMETER_NAMES if self.smoothing is None else (*PARAMETER_NAMES, "smoothing")


def _exp(x: Tensor) -> Tensor:
    if not isinstance(x, np.ndarray):
        return dr.exp(x)
    with np.errstate(over="ignore"):  # infinite: an opacity of 0, a scale beyond all numbers
        return np.exp(x)


def quat_to_rotation(quats: Array4f) -> Matrix3f:
    """Return the rotation matrix of ``quats`` (wxyz, any norm).

    The quaternion is first divided by its largest component, so that norms of 1e-20 and 1e20
    neither underflow nor overflow. A zero quaternion is the identity, with zero gradient.
    """
    t = types_of(type(quats.x))
    size = dr.detach(dr.max(dr.abs(quats)))
    usable = ~(size <= 0)  # a NaN goes through: projection then drops the Gaussian
    q = dr.select(usable, quats, t.Array4f(1, 0, 0, 0)) / dr.select(usable, size, 1)
    w, x, y, z = q
    two = 2 / dr.squared_norm(q)
    return t.Matrix3f(
        [
            [1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
            [two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)],
            [two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)],
        ]
    )


def normalize(vector: Array3f) -> Array3f:
    """Return the unit vector; a zero vector stays zero, with zero gradient."""
    squared_norm = dr.squared_norm(vector)
    usable = squared_norm > 0
    return vector * dr.select(usable, dr.rsqrt(dr.select(usable, squared_norm, 1)), 0)
