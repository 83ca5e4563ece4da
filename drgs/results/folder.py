"""The output folder of a fit.

A folder belongs to the run whose ``config.yml`` it contains. A fit accepts a missing or empty
folder, or an unfinished run of the same configuration, which it continues. It never overwrites
results, nor files that no fit has written.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

import yaml

from drgs.config.changes import with_changes, with_decisions
from drgs.config.extensions import EFFECTS
from drgs.config.load import dump_config, load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError, UserNote, format_names, note_user, one_line
from drgs.core.files import is_temporary, read_text, refusal_reason, remove_stale_temporaries
from drgs.core.folders import FolderRecord
from drgs.io.formats import fitted_formats

# Names of the files and folders in a fit's output folder.

CONFIG = "config.yml"  # every value of the configuration; marks whose folder it is
CHECKPOINT = "checkpoint.npz"  # while the fit runs: see :mod:`drgs.fit.checkpoint`
GAUSSIANS = "point_cloud.ply"  # as most viewers render; in earlier versions, as the fit does
OWN_GAUSSIANS = "point_cloud_drgs.ply"  # as the fit renders, if viewers do otherwise
EARLIER_FOR_VIEWERS = "point_cloud_viewers.ply"  # of earlier versions
HISTORY = "history.csv"
DENSITY = "density.csv"  # changes of the population, if there are any
CURVES = "curves.png"
ORBIT = "orbit.webp"
ORBIT_GIF = "orbit.gif"  # of earlier versions
REPORT = "report.html"
VIEWER = "viewer.html"  # interactive page of the Gaussians, unless too large
RENDERS = "renders"  # a folder for each split, with an image of each view
SIDE_BY_SIDE = "side_by_side"  # the same, with the photograph and the difference beside the image
VIEWS = "views.json"  # the dataset's cameras of the training views, for orbits
CAMERAS = "cameras.json"  # training cameras as pinholes, in the layout of the 3DGS reference
EXAMINATION = "examination.json"  # which effects an examination chose, with the evidence
BUDGET_PLAN = "plan.txt"  # the plan for a budget of time, with reasons
METRICS = "metrics.json"  # written last
ERROR_BUDGET = "error_budget.json"  # of ``drgs render --error``


def result_names() -> list[str]:
    """Return the files of a fit but for ``config.yml``, with those of effects."""
    return [*_names_without_small_files(), *small_file_names().values()]


def _names_without_small_files() -> list[str]:
    names = []
    for each in EFFECTS.all():
        names += each.value.files or [f"{each.name}.json"] * each.value.has_numbers
    names += [CHECKPOINT, CURVES, DENSITY, EXAMINATION, HISTORY, METRICS, ORBIT, ORBIT_GIF]
    names += [BUDGET_PLAN, CAMERAS, RENDERS, REPORT, SIDE_BY_SIDE, VIEWER, VIEWS]
    return [*names, GAUSSIANS, OWN_GAUSSIANS, EARLIER_FOR_VIEWERS]


def small_file_names() -> dict[str, str]:
    """Return the names of the files of ``output.small_file``, by format."""
    return {each.name: f"point_cloud{each.value.suffix}" for each in fitted_formats()}


def small_file_name(config: FitConfig) -> str | None:
    """Return the name of ``output.small_file``; raise :class:`UserError` for another format."""
    if (name := config.output.small_file) is None:
        return None
    if name not in (names := small_file_names()):
        raise UserError(
            f"output.small_file: must be one of {', '.join(names)}, or null, got {one_line(name)}; "
            "drgs export writes other formats"
        )
    return names[name]


def own_gaussians(folder: Path) -> Path:
    """Return the file of a fit's own Gaussians, which drgs renders as the fit does.

    It may be missing: no other file takes the place of one that the fit has written.
    """
    path = folder / OWN_GAUSSIANS
    has_own = path.is_file() or FolderRecord(folder, COMMAND).has_written(OWN_GAUSSIANS)
    return path if has_own else folder / GAUSSIANS


def viewer_gaussians(folder: Path) -> Path:
    """Return the file of a fit that other viewers render correctly, if there is one."""
    return path if (path := folder / EARLIER_FOR_VIEWERS).is_file() else folder / GAUSSIANS


COMMAND = "fit"
MAX_CONFIG_BYTES = 1 << 28
FOLDERS = (RENDERS, SIDE_BY_SIDE)  # results that are folders

SECTIONS = {"data", "init", "model", "optimizer", "loss", "densify", "output", "iterations", "seed"}
"""Keys of every ``config.yml`` that a fit has written."""

DATA_PATHS = ("data.path", "init.point_cloud", "init.gaussians")
"""Also recorded relative to the folder."""


def claim_output_folder(folder: Path, config: FitConfig, images: Sequence[str] = ()) -> None:
    """Make ``folder`` the output folder of a run.

    Creates it, with its parents, and writes ``config.yml``; other files are unchanged. images:
    names from :func:`image_names`.

    Raises :class:`UserError` as :func:`check_output_folder`, and if it is not writable.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unusable(folder, error) from error
    check_output_folder(folder, config, images)
    continue_run(folder, config, images)


def check_output_folder(folder: Path, config: FitConfig, images: Sequence[str] = ()) -> None:
    """Raise :class:`UserError` for a folder with another run or foreign files."""
    if not (present := _visible_names(folder)):
        return
    if CONFIG not in present:
        raise UserError(
            f"{folder}: the output folder must be new or empty, got one that holds "
            f"{format_names(present)}; choose another with --out"
        )
    record, differences = FolderRecord(folder, COMMAND), _differences_of_run(folder, config)
    is_run = record.exists or CHECKPOINT in present
    is_config_alone = {*present} <= {CONFIG, EXAMINATION}
    if not _is_unmodified(folder / CONFIG) and (not is_run or (is_config_alone and differences)):
        raise UserError(
            f"{folder / CONFIG}: would be replaced, and was not written by a fit, or changed "
            "since; choose another folder with --out"
        )
    if differences and not is_config_alone:
        raise UserError(
            f"{folder}: already holds another run, {differences}; choose another folder with "
            f"--out, continue that run with --resume {folder}, or replace it with --overwrite"
        )
    record.check(names := _file_names(images, config), earlier=names)


def continue_run(folder: Path, config: FitConfig, images: Sequence[str] = ()) -> None:
    """Continue the run in ``folder``; config: its own, with the data's current paths.

    Raises :class:`UserError` if foreign files would be replaced.
    """
    record, names = FolderRecord(folder, COMMAND), _file_names(images, config)
    record.check(names, earlier=names)
    remove_stale_temporaries(folder)
    paths = {
        key: os.path.relpath(path, folder.resolve())
        for key, path in _data_paths(config).items()
        if path is not None
    }
    write_run_config(folder, config)
    record.claim(names, paths, earlier=names)


def image_names(split: str, views: Sequence[str]) -> list[str]:
    """Return the images of a split with views of these names, relative to the folder."""
    return [f"{kind}/{split}/{view}.png" for kind in (RENDERS, SIDE_BY_SIDE) for view in views]


def write_run_config(folder: Path, config: FitConfig) -> None:
    """Write ``config.yml`` unless the user has changed it."""
    path = folder / CONFIG
    if _is_unmodified(path):
        dump_config(config, path)
        return
    with suppress(UserError):
        if load_config(path) == config:
            return
    note_user(f"{path}: was changed after the fit wrote it, and is kept")


def require_no_run(folder: Path) -> None:
    """Raise :class:`UserError` for a folder that is not empty."""
    if names := _visible_names(folder):
        raise UserError(
            f"{folder}: must be new or empty for a fit with --budget, got one that holds "
            f"{format_names(names)}; choose another with --out, continue with --resume {folder}, "
            "or replace it with --overwrite"
        )


def has_results(folder: Path) -> bool:
    """Return whether the run in ``folder`` is complete."""
    return (folder / METRICS).is_file()


def is_run_of(folder: Path, config: FitConfig) -> bool:
    """Return whether ``folder`` contains a run of this configuration, complete or not."""
    return (folder / CONFIG).is_file() and not _differences_of_run(folder, config)


def is_finished(folder: Path, config: FitConfig) -> bool:
    """Return whether ``folder`` contains a complete run of this configuration."""
    return has_results(folder) and not _differences_of_run(folder, config)


def require_results(folder: Path, *names: str) -> None:
    """Raise :class:`UserError` for a folder without ``config.yml`` and these results of a fit."""
    for name in (CONFIG, *names):
        if not (folder / name).is_file():
            raise UserError(
                f"{folder}: must be the output folder of a fit that has ended, but there is no "
                f"{name} in it"
            )


def load_run_config(folder: Path, overrides: Sequence[str] = ()) -> FitConfig:
    """Load the configuration of the run in ``folder``, with overrides; UserError without one."""
    if not os.path.isfile(folder / CONFIG):
        what = "has no" if os.path.isdir(folder) else "does not exist, and so has no"
        raise UserError(f"{folder}: is not the output folder of a fit: it {what} {CONFIG}")
    return load_config(folder / CONFIG, overrides)


def load_moved_config(folder: Path, overrides: Sequence[str] = ()) -> FitConfig:
    """Load the configuration of the run in ``folder`` with the data's current paths.

    overrides: see :func:`load_config`. A point cloud within the data is relocated with it.
    """
    before = load_run_config(folder)
    config = relocate_data(folder, load_run_config(folder, overrides))
    cloud, data = config.init.point_cloud, before.data.path
    if cloud is None or cloud.exists() or not cloud.is_relative_to(data):
        return config
    return with_changes(config, {"init.point_cloud": config.data.path / cloud.relative_to(data)})


def relocate_data(folder: Path, config: FitConfig, keys: Sequence[str] = DATA_PATHS) -> FitConfig:
    """Return a run's configuration with the data's current paths; keys: of DATA_PATHS.

    A missing path is replaced by its recorded path relative to the folder if that exists, with a
    :class:`UserNote`: both may have been moved together.
    """
    changes, recorded = {}, FolderRecord(folder, COMMAND).paths
    for key, path in _data_paths(config).items():
        if key not in keys or key not in recorded or path is None or os.path.exists(path):
            continue
        found = Path(os.path.normpath(folder.resolve() / recorded[key]))
        if found.exists():
            changes[key] = str(found)
            note_user(f"{key}: {path} is not there any more; taken from {found}")
    return with_changes(config, changes) if changes else config


def remove_run(folder: Path, images: Sequence[str] = ()) -> None:
    """Remove the run in ``folder``, if any.

    ``metrics.json`` is removed first and ``config.yml`` last: an interrupted removal leaves an
    unfinished run. images: of the next run.

    Raises :class:`UserError`, with nothing removed, if ``folder`` contains foreign files.
    """
    names = _visible_names(folder)
    record, files = FolderRecord(folder, COMMAND), list(_files(folder))
    if names:
        load_run_config(folder)
        foreign = sorted(set(names) - {CONFIG, *result_names()})
        _check_removable(folder, record, foreign, files, images)
    elif not os.path.lexists(folder):
        return
    remove_stale_temporaries(folder)
    try:
        for name in [METRICS, *files, CONFIG] if names else []:
            (folder / name).unlink(missing_ok=True)
        for kind in FOLDERS:
            for path, _, _ in os.walk(folder / kind, topdown=False):
                os.rmdir(path)
        record.remove()
    except OSError as error:
        raise UserError(f"{error.filename}: cannot be removed: {refusal_reason(error)}") from error


def _check_removable(
    folder: Path, record: FolderRecord, foreign: list[str], files: list[str], images: Sequence[str]
) -> None:
    """Raise :class:`UserError` for the names ``foreign`` and files that no fit has written."""
    if record.exists:
        foreign += record.foreign_files(files)
    else:
        known = {*result_names(), *images}
        paths = {name: folder / name for name in files}
        regular = {name for name, path in paths.items() if path.is_file() and not path.is_symlink()}
        foreign += [name for name in files if name not in known & regular]
    if not _is_unmodified(folder / CONFIG):
        foreign.append(CONFIG)
    if foreign:
        raise UserError(
            f"{folder}: must hold nothing but a run to be replaced, got {format_names(foreign)}; "
            "move that away, or choose another folder with --out"
        )


def _files(folder: Path) -> Iterator[str]:
    """Yield the names of the results that are there, and of everything in FOLDERS."""
    for name in result_names():
        path = folder / name
        if name not in FOLDERS or path.is_symlink() or not path.is_dir():
            if os.path.lexists(path):
                yield name
            continue
        for inside, folders, files in os.walk(path):
            folders.sort()
            kept = (file for file in sorted(files) if not is_temporary(file))
            yield from ((Path(inside).relative_to(folder) / file).as_posix() for file in kept)


def _file_names(images: Sequence[str], config: FitConfig) -> list[str]:
    """Return the files that a fit writes, except ``config.yml``, whose content is checked."""
    small_file = small_file_name(config)
    names = [*_names_without_small_files(), *([small_file] if small_file else [])]
    return [*(name for name in names if name not in FOLDERS), *images]


def _visible_names(folder: Path) -> list[str]:
    if not os.path.lexists(folder):
        return []
    try:
        return sorted(name for name in os.listdir(folder) if not name.startswith("."))
    except OSError as error:
        raise _unusable(folder, error) from error


def _unusable(folder: Path, error: OSError) -> UserError:
    return UserError(f"{folder}: cannot be the output folder: {refusal_reason(error)} (--out)")


def _is_unmodified(path: Path) -> bool:
    """Return whether a file is missing, empty, or exactly as :func:`dump_config` writes it."""
    if not os.path.lexists(path):
        return True
    try:
        if path.stat().st_size == 0:
            return True
        load_config(path)  # limits size and aliases
        text = read_text(path, "configuration", MAX_CONFIG_BYTES)
    except (UserError, OSError):
        return False
    values = yaml.safe_load(text)
    return set(values) >= SECTIONS and yaml.safe_dump(values, sort_keys=False) == text


def _data_paths(config: FitConfig) -> dict[str, Path | None]:
    values = (config.data.path, config.init.point_cloud, config.init.gaussians)
    return dict(zip(DATA_PATHS, values, strict=True))


def _differences_of_run(folder: Path, config: FitConfig) -> str:
    """Describe the differences between the run in ``folder`` and ``config``; empty: none.

    Values that one leaves to the dataset are taken from the other.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserNote)
            run = relocate_data(folder, load_run_config(folder))
    except UserError:
        return f"with a {CONFIG} that is not readable"
    theirs, ours = _values(with_decisions(run, config)), _values(with_decisions(config, run))
    differences = _differences(theirs, ours)
    return f"which differs in {format_names(differences)}" if differences else ""


def _values(config: FitConfig) -> dict[str, object]:
    """Return all values that determine a fit, without sections of strategies that are not used."""
    unused = config.densify.sections.keys() - {config.densify.strategy}
    ignored = {"output": True, "data": {"in_memory"}, "densify": unused}
    off = {n: True for n, each in config.sections.items() if each.is_off}
    return config.model_dump(mode="json", exclude={**ignored, **off})


def _differences(theirs: object, ours: object, key: str = "") -> list[str]:
    if isinstance(theirs, dict) and isinstance(ours, dict):
        pairs = {name: (theirs.get(name), ours.get(name)) for name in {**ours, **theirs}}
        found = (_differences(*pair, f"{key}.{n}".strip(".")) for n, pair in pairs.items())
        return list(chain.from_iterable(found))
    return [] if theirs == ours else [one_line(f"{key} = {theirs} (here {ours})", limit=120)]
