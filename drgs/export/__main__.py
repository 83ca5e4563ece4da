"""``python -m drgs.export RUN_OR_FILE... --format NAME``: Gaussians for other programs.

Exports files, or a fit's file for other programs (``drgs.fit.viewers_fit``), in the formats of
``drgs.io.formats``. :mod:`drgs.export.operations` are applied between, in the order given.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from drgs.cli.commands import VECTOR, CommandParser, bounded_int, file_or_folder, run_command
from drgs.cli.execution import add_variant_argument, select_variant
from drgs.config.approximations import DECLARED, Approximations
from drgs.core.constants import LOW_PASS
from drgs.core.environment import require_module
from drgs.core.errors import UserError, did_you_mean, one_line
from drgs.core.files import write_together
from drgs.core.folders import FolderRecord
from drgs.core.registry import HOW_TO_INSTALL
from drgs.export.levels import LOD_META, encode_levels
from drgs.export.operations import add_operations, apply_steps, reduce_to, turn_up
from drgs.export.source import Z_UP, ExportSource, Honoured, load_source, merge_sources
from drgs.io import sog
from drgs.io.formats import PLAYCANVAS, Scalar, format_for, writable_formats
from drgs.results.html_viewer import HONOURED, DisplaySettings, InitialView, viewer_page

COMMAND = "export"

Y_DOWN = np.array([0.0, -1.0, 0.0])  # of formats without axes: COLMAP's, hence the reference's

DEFAULT_LEVELS, NUM_LEVELS = 4, (2, 8)

MESH_SIZE, MESH_SIZES = 256, (16, 2048)  # voxels along the longest side: default, range

NEEDED = {"mesh_size": "--format mesh", "levels": "--format lod", "seed_pos": "--filter-cluster"}
NEEDED["json"] = "--info"
"""Options that belong to another one, by the name of their argument."""


def _honoured_where(shown_with: Mapping[str, Scalar], fitted: Approximations) -> frozenset[str]:
    shown = Approximations.from_values(shown_with)
    is_nearer = abs(fitted.low_pass - shown.low_pass) < abs(fitted.low_pass - LOW_PASS)
    return HONOURED if is_nearer else frozenset()


@dataclass(frozen=True)
class ExportTarget:
    """A format that ``--format`` names."""

    suffix: str  # of files, in small letters; added to the input's name
    text: str  # description, one phrase
    encode: Callable[[ExportSource, Path, Namespace], Mapping[str, bytes]]
    """Function of the Gaussians, the output file and all arguments to files by name, relative to
    the output's folder; deterministic."""
    up: np.ndarray  # (3,) in programs
    has_axes: bool = False  # whether the format defines up: then models are always turned
    honoured: Honoured | None = None  # None: none


def targets() -> dict[str, ExportTarget]:
    """Return the targets of ``--format`` by name: file formats, and what is made of Gaussians."""
    formats = {
        each.name: ExportTarget(
            suffix=each.value.suffix,
            text=each.value.description,
            encode=partial(_encode_format, each.name),
            up=Y_DOWN if each.value.up is None else Z_UP,
            has_axes=each.value.up is not None,
            honoured=partial(_honoured_where, each.value.shown_with),
        )
        for each in writable_formats()
    }
    return {**formats, **MADE_TARGETS}


def _encode_format(name: str, source: ExportSource, out: Path, _: Namespace) -> dict[str, bytes]:
    content = source.gaussians.to_bytes(name)
    return sog.unpack(content) if _is_named(out, sog.META) else {out.name: content}


def _encode_page(source: ExportSource, out: Path, _: Namespace) -> dict[str, bytes]:
    """Encode a page with the first view and the background of the fit; else black."""
    gaussians, config = source.gaussians, source.config
    if source.cameras is not None and source.up is None:
        initial_view = InitialView.from_views(source.cameras, gaussians)
    else:
        initial_view = InitialView.from_gaussians(gaussians, Z_UP)
    title = source.path.name if config is None else source.path.parent.resolve().name
    background = (0.0, 0.0, 0.0) if config is None else config.data.background_rgb
    shown = DisplaySettings(gaussians, Approximations.from_values(gaussians.rendered_with or {}))
    return {out.name: viewer_page(title, shown, initial_view, background)}


def _encode_mesh(source: ExportSource, out: Path, args: Namespace) -> dict[str, bytes]:
    """Encode the surface that the fit's training cameras see; for a file, cameras around it."""
    from drgs.export import mesh as surface

    for module in surface.MODULES:  # before anything is rendered
        require_module(module, "mesh", "--format mesh")
    select_variant(args.variant)
    views = source.views(surface.VIEWS_PER_RING, surface.RING_SIDE_PX)
    images = list(surface.depth_images(source.gaussians, source.settings, views))
    mesh = surface.mesh_of(images, args.mesh_size or MESH_SIZE)
    print(f"{len(images)} views: {len(mesh.faces):,} triangles")
    encode = surface.encode_glb if out.suffix.lower() == ".glb" else surface.encode_ply
    return {out.name: encode(mesh, source.gaussians.origin)}


def _encode_levels(source: ExportSource, _: Path, args: Namespace) -> dict[str, bytes]:
    most, count = source.gaussians.num_gaussians, args.levels or DEFAULT_LEVELS
    levels = [reduce_to(source, -(-most // 2**k), args.variant) for k in range(count)]
    return encode_levels([each.gaussians for each in levels])


def _honour_all(_: Approximations) -> frozenset[str]:
    return frozenset(DECLARED)


_honoured_in_playcanvas = partial(_honoured_where, PLAYCANVAS)
_LOD = f"levels of detail as PlayCanvas streams them, {LOD_META} beside folders of SOG"
_PAGE = "a page to walk around in, for any browser"
_MESH = "the surface as triangles with colours (.ply or .glb)"
MADE_TARGETS = {
    "html": ExportTarget(".html", _PAGE, _encode_page, Z_UP, False, lambda _: HONOURED),
    "mesh": ExportTarget(".ply", _MESH, _encode_mesh, Z_UP, False, _honour_all),
    "lod": ExportTarget(
        f"_levels/{LOD_META}", _LOD, _encode_levels, Y_DOWN, False, _honoured_in_playcanvas
    ),
}
STATISTICS_ONLY = ExportTarget("", "no file", lambda *_: {}, Z_UP, False, _honour_all)


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
        "%(prog)s a.ply b.ply --rotate 0 0 90 --filter-value opacity,gt,0.1 --out both.sog",
    )
    add = parser.add_argument
    text = "the output folder of a fit, or a file of Gaussians; several are merged"
    add("what", nargs="+", type=file_or_folder, metavar="OUT_DIR|MODEL", help=text)
    names = "; ".join(f"{name}: {target.text}" for name, target in targets().items())
    add("--format", metavar="NAME", help=f"{names} (default: by the suffix of --out)")
    text = "output file (default: the name of the input, with the suffix of the format)"
    add("--out", type=file_or_folder, metavar="FILE", help=text)
    text = f"voxels along the longest side of a mesh (default: {MESH_SIZE})"
    add("--mesh-size", type=bounded_int(*MESH_SIZES), metavar="N", help=text)
    text = "levels of detail, each of half as many Gaussians as the one before (see --decimate)"
    text += f": --format lod (default: {DEFAULT_LEVELS})"
    add("--levels", type=bounded_int(*NUM_LEVELS), metavar="N", help=text)
    text = "--filter-cluster keeps that nearest to this point (default: with the most Gaussians)"
    add("--seed-pos", **VECTOR, help=text)
    text = "print --info as JSON, and all else to the standard error"
    add("--json", action="store_const", const=sys.stdout, help=text)
    add_variant_argument(parser)
    add_operations(parser)
    parser.set_defaults(run=run)


def run(args: Namespace) -> None:
    """Export what the command line names."""
    with redirect_stdout(sys.stderr if args.json else sys.stdout):
        target, out = _destination(args)
        sources = [load_source(what, target.honoured) for what in args.what]
        for each in sources:
            print(f"{each.path}: {each.gaussians.num_gaussians:,} Gaussians", flush=True)
        num_levels = (args.levels or DEFAULT_LEVELS) if _is_named(out, LOD_META) else 0
        names = [*(f"{level}_0/{sog.META}" for level in range(num_levels)), out.name]
        if target is not STATISTICS_ONLY:  # before anything takes long
            _check_output(out, names, sources)
        args.up_in_file = target.up
        source = apply_steps(merge_sources(sources), args)
        if target.has_axes and source.up is None:
            source = turn_up(source, [], args)
        if not (files := target.encode(source, out, args)):
            return
        _check_output(out, files, sources)
        record = FolderRecord(out.parent, COMMAND)
        record.claim(files)
        write_together(out.parent, files)
        record.seal(files)
        print(f"written: {out} ({sum(map(len, files.values())) / 1e6:.1f} MB)")


def _check_output(out: Path, names: Iterable[str], sources: Sequence[ExportSource]) -> None:
    """Raise :class:`UserError` if one of the files would replace an input, or a foreign file."""
    written = {(out.parent / name).resolve() for name in names}
    for each in sources:
        if each.path.resolve() in written:
            raise UserError(f"--out {out}: would replace {each.path}, an input; change the name")
    FolderRecord(out.parent, COMMAND).check(names)


def _destination(args: Namespace) -> tuple[ExportTarget, Path]:
    known, named = targets(), None if args.out is None else _target_name(args.out)
    name, options = args.format or named, [option for option, _ in args.steps]
    if args.levels is not None and name in (None, "sog"):
        name = "lod"
    for key, needed in NEEDED.items():
        if getattr(args, key) is not None and needed not in (f"--format {name}", *options):
            option = f"--{key.replace('_', '-')}"
            raise UserError(f"{option}: needs {needed}; add that, or leave {option} out")
    if name is None and args.out is None and "--info" in options:
        return STATISTICS_ONLY, Path()
    if name not in known:
        got = f"got {one_line(name, 40)}{did_you_mean(name, known)}" if name else "got none"
        raise UserError(f"--format: must be one of {', '.join(known)}, {got}; {HOW_TO_INSTALL}")
    target = known[name]
    if args.out is None:
        read_as, path = format_for(args.what[0]), args.what[0].resolve()
        path = path.parent if _is_named(path, sog.META) else path
        stem = args.what[0].name[: -len(read_as.value.suffix)] if read_as else path.name
        return target, path.parent / f"{stem}{target.suffix}"
    if name == "mesh" and named in ("ply", "glb"):
        return replace(target, has_axes=named == "glb"), args.out
    if named != name:  # as a.compressed.ply is no name for a plain PLY
        ends = {"mesh": ".ply or .glb", "lod": LOD_META}.get(name, target.suffix)
        raise UserError(
            f"--out {args.out}: the name of a {name} file must end in {ends}, got that of "
            f"{f'a {named}' if named else 'no known'} file"
        )
    return target, args.out


def _is_named(path: Path, name: str) -> bool:
    return path.name.lower() == name


def _target_name(path: Path) -> str | None:
    if path.name.lower().endswith(".html"):
        return "html"
    name, known = path.name.lower(), format_for(path)
    return {sog.META: "sog", LOD_META: "lod"}.get(name, known and known.name)


if __name__ == "__main__":
    main()
