"""``python -m drgs.export RUN_OR_FILE --format NAME``: Gaussians for other programs.

Exports a file, or a fit's file for other programs (``drgs.fit.viewers_fit``), in the formats of
``drgs.io.formats``; crops, filters, decimates and turns it upright.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drgs.cameras.orbits import up_of
from drgs.cli.commands import CommandParser, bounded_int, file_or_folder, run_command
from drgs.cli.execution import select_variant
from drgs.config.approximations import DECLARED, Approximations
from drgs.core.constants import LOW_PASS
from drgs.core.environment import require_module
from drgs.core.errors import UserError, did_you_mean, one_line
from drgs.core.files import write_together
from drgs.core.folders import FolderRecord
from drgs.core.registry import HOW_TO_INSTALL
from drgs.export.cleaning import add_cleaning_arguments, clean, reduce_to
from drgs.export.levels import LOD_META, encode_levels
from drgs.export.source import ExportSource, Honoured, load_source
from drgs.io import sog
from drgs.io.formats import format_for, writable_formats
from drgs.results.folder import VIEWS
from drgs.results.html_viewer import HONOURED, DisplaySettings, InitialView, viewer_page

COMMAND = "export"

Z_UP = np.array([0.0, 0.0, 1.0])  # of datasets, and of Gaussians that formats with axes encode
Y_DOWN = np.array([0.0, -1.0, 0.0])  # of formats without axes: COLMAP's, hence the reference's

PLAYCANVAS_LOW_PASS = 0.075  # px^2, of PlayCanvas and SuperSplat; others add 0.3

PLAYCANVAS = ("compressed-ply", "sog")  # formats that are read by them

NUM_LEVELS = (2, 8)

MESH_SIZE, MESH_SIZES = 256, (16, 2048)  # voxels along the longest side: default, range

MIN_SNAP_COSINE = np.cos(np.radians(5))  # angle below which the cameras' up is snapped to an axis


def _honoured_by_playcanvas(fitted: Approximations) -> frozenset[str]:
    ours = abs(fitted.low_pass - PLAYCANVAS_LOW_PASS)
    return HONOURED if ours < abs(fitted.low_pass - LOW_PASS) else frozenset()


@dataclass(frozen=True)
class ExportTarget:
    """A format that ``--format`` names."""

    suffix: str  # of files, in small letters
    text: str  # description, one phrase
    encode: Callable[..., bytes]  # of a source and the output file; deterministic
    up: np.ndarray  # (3,) in programs
    has_axes: bool = False  # whether the format defines up: then models are always turned
    honoured: Honoured | None = None  # None: none


def targets() -> dict[str, ExportTarget]:
    """Return the targets of ``--format`` by name: file formats, and the page."""
    formats = {
        each.name: ExportTarget(
            suffix=each.value.suffix,
            text=each.value.description,
            encode=lambda source, _, name=each.name: source.gaussians.to_bytes(name),
            up=Y_DOWN if each.value.up is None else Z_UP,
            has_axes=each.value.up is not None,
            honoured=_honoured_by_playcanvas if each.name in PLAYCANVAS else None,
        )
        for each in writable_formats()
    }
    return {**formats, "html": PAGE, "mesh": MESH}


def _page(source: ExportSource, out: Path) -> bytes:
    """Encode a page with the first view and the background of the fit; else black."""
    gaussians, config = source.gaussians, source.config
    if source.cameras is not None and not source.is_turned:
        initial_view = InitialView.from_views(source.cameras, gaussians)
    else:
        initial_view = InitialView.from_gaussians(gaussians, Z_UP)
    title = source.path.name if config is None else source.path.parent.resolve().name
    background = (0.0, 0.0, 0.0) if config is None else config.data.background_rgb
    shown = DisplaySettings(gaussians, Approximations.from_values(gaussians.rendered_with or {}))
    return viewer_page(title, shown, initial_view, background)


_PAGE_TEXT = "a page to walk around in, for any browser"
PAGE = ExportTarget(".html", _PAGE_TEXT, _page, Z_UP, honoured=lambda _: HONOURED)


def _mesh(source: ExportSource, out: Path, size: int = MESH_SIZE) -> bytes:
    """Encode the surface that the fit's training cameras see; for a file, cameras around it."""
    from drgs.export import mesh as surface

    for module in surface.MODULES:  # before anything is rendered
        require_module(module, "mesh", "--format mesh")
    views = source.views(Z_UP, surface.VIEWS_PER_RING, surface.RING_SIDE_PX)
    images = list(surface.depth_images(source.gaussians, source.settings, views))
    mesh = surface.mesh_of(images, size)
    print(f"{len(images)} views: {len(mesh.faces):,} triangles")
    encode = surface.encode_glb if out.suffix.lower() == ".glb" else surface.encode_ply
    return encode(mesh, source.gaussians.origin)


_MESH_TEXT = "the surface as triangles with colours (.ply or .glb)"
MESH = ExportTarget(".ply", _MESH_TEXT, _mesh, Z_UP, honoured=lambda _: frozenset(DECLARED))


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
        "%(prog)s out/lego --format mesh --out lego.glb",
        "%(prog)s out/lego --levels 4 --out web/lod-meta.json",
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
    parser.add_argument(
        "--mesh-size",
        type=bounded_int(*MESH_SIZES),
        metavar="N",
        help=f"voxels along the longest side of a mesh (default: {MESH_SIZE})",
    )
    parser.add_argument(
        "--levels",
        type=bounded_int(*NUM_LEVELS),
        metavar="N",
        help=f"levels of detail, each of half as many Gaussians as the one before (see "
        f"--decimate), as PlayCanvas streams them: {LOD_META} beside folders of SOG",
    )
    add_cleaning_arguments(parser)
    parser.add_argument_group("orientation").add_argument(
        "--up",
        nargs="+",
        metavar="UP",
        help="rotate the model so that this direction, X Y Z, is up; cameras: the mean up "
        "direction of the training cameras (default: for formats with an up direction, cameras, or "
        "0 0 1 without any; other formats are not rotated)",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Export the model of the command line."""
    target, out = _destination(args)
    source = load_source(args.what, target.honoured)
    if out.resolve() == source.path.resolve():
        raise UserError(f"--out {out}: is the input; choose another name")
    print(f"{source.path}: {source.gaussians.num_gaussians:,} Gaussians", flush=True)
    coarse = [f"{level}_0/{sog.META}" for level in range(args.levels or 0)]
    FolderRecord(out.parent, COMMAND).check([*coarse, out.name])
    up = _up_direction(args, source, target)
    source = clean(source, args)
    if args.decimate is not None or args.levels is not None or target.encode is _mesh:
        select_variant(args.variant)
    axis = Z_UP if up is None else up
    if args.decimate is not None:
        source = reduce_to(source, args.decimate(source.gaussians.num_gaussians), axis)
    most = source.gaussians.num_gaussians
    counts = [-(-most // 2**k) for k in range(1, args.levels or 1)]
    levels = [source, *(reduce_to(source, count, axis) for count in counts)]
    if up is not None:
        levels = [each.turn(up, target.up) for each in levels]
    if args.levels is not None:
        files = encode_levels([each.gaussians for each in levels])
    else:
        content = target.encode(levels[0], out, *filter(None, [args.mesh_size]))
        files = sog.unpack(content) if _is_named(out, sog.META) else {out.name: content}
    if source.path.resolve() in {(out.parent / path).resolve() for path in files}:
        raise UserError(f"--out {out}: would replace {source.path}, the input; choose another name")
    record = FolderRecord(out.parent, COMMAND)
    record.claim(files)
    write_together(out.parent, files)
    record.seal(files)
    print(f"written: {out} ({sum(map(len, files.values())) / 1e6:.1f} MB)")


def _destination(args: argparse.Namespace) -> tuple[ExportTarget, Path]:
    _check_levels(args)
    name = args.format or (None if args.levels is None else "sog")
    if name is None and args.out is not None:
        name = _target_name(args.out)
    known = targets()
    if name not in known:
        got = f"got {one_line(name, 40)}{did_you_mean(name, known)}" if name else "got none"
        raise UserError(f"--format: must be one of {', '.join(known)}, {got}; {HOW_TO_INSTALL}")
    target = known[name]
    if name != "mesh" and args.mesh_size is not None:
        raise UserError(f"--mesh-size: is for --format mesh, got {name}; leave it out")
    if args.out is None:
        read_as = format_for(args.what)
        path = args.what.resolve()
        path = path.parent if _is_named(path, sog.META) else path
        stem = args.what.name[: -len(read_as.value.suffix)] if read_as else path.name
        if args.levels is not None:
            return target, path.with_name(f"{stem}_levels") / LOD_META
        return target, path.with_name(f"{stem}{target.suffix}")
    named = _target_name(args.out)  # as a.compressed.ply is no name for a plain PLY
    if name == "mesh" and named in ("ply", "glb"):
        return replace(target, has_axes=named == "glb"), args.out
    if named != name:
        ends = ".ply or .glb" if name == "mesh" else target.suffix
        raise UserError(
            f"--out {args.out}: the name of a {name} file must end in {ends}, got that of "
            f"{f'a {named}' if named else 'no known'} file"
        )
    return target, args.out


def _is_named(path: Path, name: str) -> bool:
    return path.name.lower() == name


def _check_levels(args: argparse.Namespace) -> None:
    is_named = args.out is not None and _is_named(args.out, LOD_META)
    if args.levels is None and is_named:
        raise UserError(f"--out {args.out}: is a file of levels of detail; give --levels N")
    if args.levels is not None and (args.format or "sog") != "sog":
        got = one_line(args.format, 40)
        raise UserError(f"--levels: writes SOG, got --format {got}; leave it out")
    if args.levels is not None and args.out is not None and not is_named:
        raise UserError(f"--levels: writes a file named {LOD_META}, got --out {args.out}")


def _target_name(path: Path) -> str | None:
    if path.name.lower().endswith(PAGE.suffix):
        return "html"
    if _is_named(path, sog.META) or _is_named(path, LOD_META):
        return "sog"
    file_format = format_for(path)
    return None if file_format is None else file_format.name


def _up_direction(
    args: argparse.Namespace, source: ExportSource, target: ExportTarget
) -> np.ndarray | None:
    """Return and print the up direction (3,); None: do not turn the model."""
    words, cameras = args.up, source.cameras
    if words is None and not target.has_axes:
        return None
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
