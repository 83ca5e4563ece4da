"""``python -m drgs.export RUN_OR_FILE --format NAME``: Gaussians for other programs.

Exports a file, or a fit's file for other programs (``drgs.training.viewers``), in the formats of
``drgs.io.formats``; crops, filters and turns it upright.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from drgs.cli.commands import CommandParser, file_or_folder, finite_number, run_command
from drgs.config.approximations import DECLARED, Approximations, from_ply_header
from drgs.core.constants import LOW_PASS
from drgs.core.errors import UserError, UserNote, did_you_mean, one_line
from drgs.core.files import atomic_path
from drgs.core.folders import FolderRecord
from drgs.core.registry import HOW_TO_INSTALL
from drgs.datasets.orbits import up_of
from drgs.effects.smoothing import bake_smoothing
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.similarity import rotation_towards
from drgs.io.formats import file_formats, format_for
from drgs.io.quantization import morton_order
from drgs.results.files import CONFIG, GAUSSIANS, GAUSSIANS_FOR_VIEWERS, VIEWS
from drgs.results.folder import load_run_config
from drgs.results.refined_cameras import training_cameras
from drgs.results.viewer import HONOURED, DisplaySettings, InitialView, viewer_page

COMMAND = "export"

Z_UP = np.array([0.0, 0.0, 1.0])  # of datasets, and of Gaussians that formats with axes encode
Y_DOWN = np.array([0.0, -1.0, 0.0])  # of formats without axes: COLMAP's, hence the reference's

PLAYCANVAS_LOW_PASS = 0.075  # px^2, of PlayCanvas and SuperSplat; others add 0.3

MIN_SNAP_COSINE = np.cos(np.radians(5))  # angle below which the cameras' up is snapped to an axis


@dataclass(frozen=True)
class ExportSource:
    """Gaussians to export."""

    gaussians: Gaussians[np.ndarray]  # without a smoothing filter
    path: Path  # of the file
    folder: Path | None  # of the fit; None: a file was named
    is_turned: bool = False  # then the fit's cameras no longer match


Honoured = Callable[[Approximations], frozenset[str]]
"""Function from fitted approximations to the names of those that a program honours, about."""


def _honoured_by_playcanvas(fitted: Approximations) -> frozenset[str]:
    ours = abs(fitted.low_pass - PLAYCANVAS_LOW_PASS)
    return HONOURED if ours < abs(fitted.low_pass - LOW_PASS) else frozenset()


@dataclass(frozen=True)
class ExportTarget:
    """A format that ``--format`` names."""

    suffix: str  # of files, in small letters
    text: str  # description, one phrase
    encode: Callable[[ExportSource], bytes]  # deterministic
    up: np.ndarray  # (3,) in programs
    has_axes: bool = False  # whether the format defines up: then models are always turned
    honoured: Honoured | None = None  # None: none


def targets() -> dict[str, ExportTarget]:
    """Return the targets of ``--format`` by name: file formats, and the page."""
    found = {
        each.name: ExportTarget(
            suffix=each.value.suffix,
            text=each.value.description,
            encode=lambda source, name=each.name: source.gaussians.to_bytes(name),
            up=Y_DOWN if each.value.up is None else Z_UP,
            has_axes=each.value.up is not None,
            honoured=_honoured_by_playcanvas if each.name == "compressed-ply" else None,
        )
        for each in file_formats()
    }
    return {**found, "html": PAGE}


def _page(source: ExportSource) -> bytes:
    """Encode a page with the first view and the background of the fit; else black."""
    gaussians, folder = source.gaussians, source.folder
    title, background, cameras = source.path.name, (0.0, 0.0, 0.0), None
    if folder is not None:
        title = folder.resolve().name
        background = load_run_config(folder).data.background_rgb
        cameras = None if source.is_turned else training_cameras(folder, gaussians.origin)
    if cameras is not None:
        initial_view = InitialView.from_views(cameras, gaussians)
    else:
        initial_view = InitialView.from_gaussians(gaussians, Z_UP)
    shown = DisplaySettings(gaussians, Approximations.from_values(gaussians.rendered_with or {}))
    return viewer_page(title, shown, initial_view, background)


_PAGE_TEXT = "a page to walk around in, for any browser"
PAGE = ExportTarget(".html", _PAGE_TEXT, _page, Z_UP, honoured=lambda _: HONOURED)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m drgs.export``."""
    run_command(add_arguments, "python -m drgs.export", arguments)


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Export Gaussians to other programs."
    parser.show_examples(
        "%(prog)s out/lego --format spz",
        "%(prog)s out/lego --out lego.glb --min-opacity 0.02",
        "%(prog)s model.ply --up 0 -1 0 --out model.spz",
    )
    parser.add_argument(
        "what",
        type=file_or_folder,
        metavar="OUT_DIR|MODEL",
        help="the output folder of a fit, or a file of Gaussians",
    )
    names = "; ".join(f"{name}: {target.text}" for name, target in targets().items())
    parser.add_argument(
        "--format", metavar="NAME", help=f"{names} (default: by the suffix of --out)"
    )
    parser.add_argument(
        "--out",
        type=file_or_folder,
        metavar="FILE",
        help="output file (default: the name of the input, with the suffix of the format)",
    )
    _add_cleaning(parser)
    parser.set_defaults(run=run)


def _add_cleaning(parser: CommandParser) -> None:
    add = parser.add_argument_group("selection and orientation").add_argument
    corners = tuple(f"{axis}{end}" for end in "01" for axis in "XYZ")
    add(
        "--crop",
        type=finite_number,
        nargs=6,
        metavar=corners,
        help="keep the Gaussians inside a box",
    )
    add("--min-opacity", type=_opacity, metavar="P", help="remove less opaque Gaussians, 0 to 1")
    add(
        "--max-size",
        type=_size,
        metavar="S",
        help="remove Gaussians with a larger standard deviation, scene units",
    )
    add(
        "--up",
        nargs="+",
        metavar="UP",
        help="rotate the model so that this direction, X Y Z, is up; cameras: the mean up "
        "direction of the training cameras (default: for formats with an up direction, cameras, or "
        "0 0 1 without any; other formats are not rotated)",
    )
    add(
        "--order",
        choices=("file", "morton"),
        default="file",
        help="morton: sort along a space-filling curve (default: order of the input, or of the "
        "format)",
    )


def _opacity(text: str) -> float:
    if not 0 <= (number := finite_number(text)) <= 1:
        raise argparse.ArgumentTypeError(f"must be between 0 and 1, got {text}")
    return number


def _size(text: str) -> float:
    if not (number := finite_number(text)) > 0:
        raise argparse.ArgumentTypeError(f"must be above 0, got {text}")
    return number


def run(args: argparse.Namespace) -> None:
    """Export the model of the command line."""
    name, out = _destination(args)
    target = targets()[name]
    source = load_source(args.what, target.honoured)
    if out.resolve() == source.path.resolve():
        raise UserError(f"--out {out}: is the input; choose another name")
    print(f"{source.path}: {source.gaussians.num_gaussians:,} Gaussians", flush=True)
    up = _up_direction(args, source, target)
    gaussians = _select(source, args)
    if up is not None:
        gaussians = rotation_towards(gaussians, up, target.up)
    if args.order == "morton":
        gaussians = take(gaussians, morton_order(gaussians.means))
    content = target.encode(replace(source, gaussians=gaussians, is_turned=up is not None))
    FolderRecord(out.parent, COMMAND).claim([out.name])
    with atomic_path(out) as temporary:
        temporary.write_bytes(content)
    FolderRecord(out.parent, COMMAND).seal()
    print(f"written: {out} ({len(content) / 1e6:.1f} MB)")


def load_source(what: Path, honoured: Honoured | None = None) -> ExportSource:
    """Load a file, or a fit's Gaussians for other programs, and bake in a smoothing filter.

    honoured: by the target; if that is enough, the fit's own Gaussians are loaded. Other
    non-default approximations of the file give a :class:`UserNote`.
    """
    if not what.exists():
        raise UserError(f"{what}: there is no such file or folder")
    path = what
    if what.is_dir():
        names = [name for name in (GAUSSIANS_FOR_VIEWERS, GAUSSIANS) if (what / name).is_file()]
        if not names or not (what / CONFIG).is_file():
            raise UserError(
                f"{what}: must be the output folder of a fit that has ended, but there is no "
                f"{CONFIG if names else GAUSSIANS} in it"
            )
        shows_own = False
        if honoured is not None:
            fitted = load_run_config(what).model.approximations
            shows_own = fitted.non_default.keys() <= honoured(fitted)
        path = what / (names[-1] if shows_own else names[0])
    gaussians = Gaussians.load(path)
    recorded = from_ply_header(str(path), gaussians.rendered_with or {})
    others = {name: value for name, value in recorded.items() if value != DECLARED[name].default}
    shown = frozenset() if honoured is None else honoured(Approximations.from_values(recorded))
    if unknown := [f"{k} {str(v).lower()}" for k, v in others.items() if k not in shown]:
        beside = path.with_name(GAUSSIANS_FOR_VIEWERS)
        note = (
            f"{path}: made to be rendered with {', '.join(unknown)}; programs that do not will "
            "show it otherwise" + (f"; export {beside} instead" if beside.is_file() else "")
        )
        warnings.warn(UserNote(note), stacklevel=2)
    gaussians = bake_smoothing(replace(gaussians, rendered_with=others or None))
    return ExportSource(gaussians, path, what if what.is_dir() else None)


def _destination(args: argparse.Namespace) -> tuple[str, Path]:
    name = args.format
    if name is None and args.out is not None:
        name = _target_name(args.out)
    known = targets()
    if name not in known:
        got = f"got {one_line(name, 40)}{did_you_mean(name, known)}" if name else "got none"
        raise UserError(f"--format: must be one of {', '.join(known)}, {got}; {HOW_TO_INSTALL}")
    suffix = known[name].suffix
    if args.out is None:
        read_as = format_for(args.what)
        stem = args.what.name[: -len(read_as.value.suffix)] if read_as else args.what.resolve().name
        return name, args.what.resolve().with_name(f"{stem}{suffix}")
    if (found := _target_name(args.out)) != name:  # as a.compressed.ply is no name for a plain PLY
        raise UserError(
            f"--out {args.out}: the name of a {name} file must end in {suffix}, got that of "
            f"{f'a {found}' if found else 'no known'} file"
        )
    return name, args.out


def _target_name(path: Path) -> str | None:
    if path.name.lower().endswith(PAGE.suffix):
        return "html"
    found = format_for(path)
    return None if found is None else found.name


def find_kept(
    gaussians: Gaussians[np.ndarray],
    box: Sequence[float] | None = None,
    min_opacity: float | None = None,
    max_scale: float | None = None,
) -> dict[str, np.ndarray]:
    """Return the mask (N,) of the Gaussians that each given criterion keeps.

    box: two opposite corners, world, of the means; max_scale: standard deviation, world units.
    """
    kept = {}
    if box is not None:
        corners = np.reshape(box, (2, 3))
        means = gaussians.means.astype(np.float64) + gaussians.origin
        inside = (means >= corners.min(axis=0)) & (means <= corners.max(axis=0))
        kept["box"] = inside.all(axis=1)
    if min_opacity is not None:
        kept["opacity"] = gaussians.opacities >= min_opacity
    if max_scale is not None:
        kept["size"] = gaussians.scales.max(axis=1) <= max_scale
    return kept


def take(gaussians: Gaussians[np.ndarray], rows: np.ndarray) -> Gaussians[np.ndarray]:
    """Return some of the Gaussians; rows: indices, or a mask (N,)."""
    values = {field.name: getattr(gaussians, field.name) for field in fields(gaussians)}
    arrays = {name: v[rows] for name, v in values.items() if isinstance(v, np.ndarray)}
    features = gaussians.features and {k: v[rows] for k, v in gaussians.features.items()}
    return replace(gaussians, **arrays, features=features)


def _select(source: ExportSource, args: argparse.Namespace) -> Gaussians[np.ndarray]:
    found = find_kept(source.gaussians, args.crop, args.min_opacity, args.max_size)
    if not found:
        return source.gaussians
    kept = np.logical_and.reduce(list(found.values()))
    lost = ", ".join(f"{name} {np.count_nonzero(~k):,}" for name, k in found.items())
    print(f"kept: {np.count_nonzero(kept):,}; left out by {lost}", flush=True)
    if not kept.any():
        raise UserError(f"{source.path}: nothing is left; crop and filter less")
    return take(source.gaussians, kept)


def _up_direction(
    args: argparse.Namespace, source: ExportSource, target: ExportTarget
) -> np.ndarray | None:
    """Return and print the up direction (3,); None: do not turn the model."""
    words = args.up
    if words is None and not target.has_axes:
        return None
    folder, origin = source.folder, source.gaussians.origin
    cameras = None if folder is None else training_cameras(folder, origin)
    if words is None:
        words = ["0", "0", "1"] if cameras is None else ["cameras"]
    if words == ["cameras"]:
        if cameras is None:
            raise UserError(
                f"--up cameras: needs the output folder of a fit with {VIEWS}; give --up X Y Z"
            )
        up, why = up_of(cameras), " (the training cameras')"
        axis = np.argmax(np.abs(up))
        if abs(up[axis]) >= MIN_SNAP_COSINE:  # what was estimated is off by a little
            up = np.sign(up[axis]) * np.eye(3)[axis] + 0.0
    else:
        up, why = _direction(words), "" if args.up else " (give --up otherwise)"
    print(f"up: {' '.join(f'{x:.3g}' for x in up)}{why}", flush=True)
    return up


def _direction(words: Sequence[str]) -> np.ndarray:
    with suppress(ValueError):
        up = np.array([float(word) for word in words])
        with np.errstate(over="ignore"):  # an infinite length is refused
            length = np.linalg.norm(up)
        if up.shape == (3,) and 0 < length < np.inf:
            return up / length
    got = one_line(" ".join(words), 60)
    raise UserError(f"--up: must be cameras, or three numbers not all zero, got {got}")


if __name__ == "__main__":
    main()
