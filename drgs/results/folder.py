"""The output folder of a fit: one folder, one run, and no result is lost by accident.

A folder belongs to the run whose ``config.yml`` it holds. A fit takes a folder that is missing or
empty, or that holds an unfinished run of the same configuration, which it continues; it never
writes over results, nor over anything else that no fit has written.
"""

from __future__ import annotations

import html
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import yaml

from drgs.config.changes import changed, decided_as
from drgs.config.load import dump_config, load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError, UserNote, listed, one_line
from drgs.core.files import is_temporary, read_text, remove_stale_temporaries, why_refused
from drgs.core.folders import FolderRecord
from drgs.results.files import (
    CHECKPOINT,
    CONFIG,
    EVENTS,
    METRICS,
    RENDERS,
    REPORT,
    RESULTS,
    SIDE_BY_SIDE,
    TENSORBOARD,
)

COMMAND = "fit"

MAX_BYTES = 1 << 28
"""Of a report."""

FOLDERS = (RENDERS, SIDE_BY_SIDE, TENSORBOARD)
"""Of pictures, in folders named after splits, and of TensorBoard; the other results are files."""

SECTIONS = {"data", "init", "model", "optimizer", "loss", "densify", "output", "iterations", "seed"}
"""That every version has written into ``config.yml``."""

FOUND_AGAIN = ("data.path", "init.point_cloud")
"""Values that are also kept relative to the folder."""


def claim_output_folder(folder: Path, config: FitConfig, pictures: Sequence[str] = ()) -> None:
    """Make ``folder`` (absolute or relative to the current one) the output folder of a run.

    Creates it, with its parents, and writes ``config.yml``; what else it holds stays as it is.
    pictures: names that :func:`pictures_of` gave.

    Raises :class:`UserError` as :func:`check_output_folder`, and where it cannot be written.
    """
    _make_folder(folder)
    check_output_folder(folder, config, pictures)
    _take(folder, config, pictures)


def check_output_folder(folder: Path, config: FitConfig, pictures: Sequence[str] = ()) -> None:
    """Raise :class:`UserError` where ``folder`` cannot become the output folder of a run.

    That is where it holds results of another run, or files of others; nothing is written.
    """
    if not os.path.lexists(folder) or not (present := _visible_names(folder)):
        return
    if CONFIG not in present:
        raise UserError(
            f"{folder}: the output folder must be new or empty, got one that holds "
            f"{listed(present)}; choose another with --out"
        )
    record, is_own = FolderRecord(folder, COMMAND), _belongs_to(folder, config)
    is_run, is_written = record.exists or CHECKPOINT in present, _may_be_replaced(folder / CONFIG)
    if not is_written and (not is_run or (present == [CONFIG] and not is_own)):
        raise UserError(
            f"{folder / CONFIG}: would be replaced, and was not written by a fit, or changed "
            "since; choose another folder with --out"
        )
    if present != [CONFIG] and not is_own:
        raise UserError(
            f"{folder}: already holds {_which_run(folder, config)}; choose another folder with "
            f"--out, continue that run with --resume {folder}, or replace it with --overwrite"
        )
    record.check(_names(pictures), earlier=_names(pictures))


def continue_run(folder: Path, config: FitConfig, pictures: Sequence[str] = ()) -> None:
    """Take the run that ``folder`` holds up again; config: its own, with where the data is now.

    Raises :class:`UserError` where files of others would be replaced.
    """
    FolderRecord(folder, COMMAND).check(_names(pictures), earlier=_names(pictures))
    _take(folder, config, pictures)


def seal_run(folder: Path) -> None:
    """Note that all results are written."""
    FolderRecord(folder, COMMAND).seal()


def pictures_of(split: str, views: Sequence[str]) -> list[str]:
    """The pictures of a split with views of these names, relative to the folder."""
    return [f"{kind}/{split}/{view}.png" for kind in (RENDERS, SIDE_BY_SIDE) for view in views]


def _take(folder: Path, config: FitConfig, pictures: Sequence[str]) -> None:
    remove_stale_temporaries(folder)
    record, paths = FolderRecord(folder, COMMAND), {}
    for key, path in _paths(config).items():
        if path is not None:
            paths[key] = os.path.relpath(path, folder.resolve())
    write_run_config(folder, config)
    names = _names(pictures)
    record.claim(names, paths, earlier=names)


def _names(pictures: Sequence[str]) -> list[str]:
    """Files that a fit writes, but for ``config.yml``, which shows by itself who wrote it."""
    return [*(name for name in RESULTS if name not in FOLDERS), EVENTS, *pictures]


def write_run_config(folder: Path, config: FitConfig) -> None:
    """Write ``config.yml``, unless it says just that, or somebody else has changed it."""
    path = folder / CONFIG
    if _may_be_replaced(path):
        dump_config(config, path)
    elif not _says(path, config):
        note = f"{path}: was changed since the fit wrote it, and stays as it is"
        warnings.warn(UserNote(note), stacklevel=2)


def _says(path: Path, config: FitConfig) -> bool:
    try:
        return load_config(path) == config
    except UserError:
        return False


def _may_be_replaced(path: Path) -> bool:
    """Whether nothing but :func:`dump_config` writes such a file; an empty one holds nothing."""
    if not os.path.lexists(path):
        return True
    try:
        if path.stat().st_size == 0:
            return True
        load_config(path)  # of a bounded size, without aliases
        text = read_text(path, "configuration", MAX_BYTES)
    except (UserError, OSError):
        return False
    values = yaml.safe_load(text)
    return set(values) >= SECTIONS and yaml.safe_dump(values, sort_keys=False) == text


def require_no_run(folder: Path) -> None:
    """Raise :class:`UserError` where ``folder`` holds a run: for one that cannot be continued."""
    if os.path.lexists(folder) and (names := _visible_names(folder)):
        raise UserError(
            f"{folder}: must be new or empty for a fit with --budget, got one that holds "
            f"{listed(names)}; choose another with --out, go on with --resume {folder}, or "
            "replace it with --overwrite"
        )


def has_results(folder: Path) -> bool:
    """Whether the run that ``folder`` holds has ended, with all of its results."""
    return (folder / METRICS).is_file()


def is_finished(folder: Path, config: FitConfig) -> bool:
    """Whether ``folder`` holds the whole result of this very configuration."""
    return has_results(folder) and _belongs_to(folder, config)


def load_run_config(folder: Path, overrides: Sequence[str] = ()) -> FitConfig:
    """The configuration of the run that ``folder`` holds; overrides: see :func:`load_config`.

    Raises :class:`UserError` where it holds none.
    """
    if not os.path.isfile(folder / CONFIG):
        what = "has no" if os.path.isdir(folder) else "does not exist, and so has no"
        raise UserError(f"{folder}: is not the output folder of a fit: it {what} {CONFIG}")
    return load_config(folder / CONFIG, overrides)


def load_moved_config(folder: Path, overrides: Sequence[str] = ()) -> FitConfig:
    """The configuration of the run that ``folder`` holds, with paths to where its data is now.

    overrides: see :func:`load_config`; a start point that lay within the data has moved with it.
    """
    before = load_run_config(folder)
    config = found_again(folder, load_run_config(folder, overrides))
    cloud, data = config.init.point_cloud, before.data.path
    if cloud is None or cloud.exists() or not cloud.is_relative_to(data):
        return config
    return changed(config, {"init.point_cloud": config.data.path / cloud.relative_to(data)})


def found_again(folder: Path, config: FitConfig, keys: Sequence[str] = FOUND_AGAIN) -> FitConfig:
    """A run's configuration with paths to where its data is now; keys: which of FOUND_AGAIN.

    A path that is no longer there is looked for where it was relative to the folder: both may have
    been moved together. What is found is noted, and what is not stays as it is.
    """
    changes = {}
    for key, path in _paths(config).items():
        if key not in keys or path is None or os.path.exists(path):
            continue
        relative = FolderRecord(folder, COMMAND).paths.get(key)
        if relative is None and config.output.dir is not None:  # of a version without records
            relative = os.path.relpath(path, config.output.dir)
        found = None if relative is None else Path(os.path.normpath(folder.resolve() / relative))
        if found is not None and found.exists():
            changes[key] = str(found)
            note = f"{key}: {path} is not there any more; taken from {found}"
            warnings.warn(UserNote(note), stacklevel=2)
    return changed(config, changes) if changes else config


def _paths(config: FitConfig) -> dict[str, Path | None]:
    """The values of FOUND_AGAIN."""
    sections = (key.split(".") for key in FOUND_AGAIN)
    values = (getattr(getattr(config, section), name) for section, name in sections)
    return dict(zip(FOUND_AGAIN, values, strict=True))


def check_replaceable(folder: Path, pictures: Sequence[str] = ()) -> None:
    """Raise :class:`UserError` where ``folder`` holds more than a run.

    pictures: those of the coming run, of which an earlier one may have left some.
    """
    if not os.path.lexists(folder) or not (names := _visible_names(folder)):
        return
    load_run_config(folder)
    record, files = FolderRecord(folder, COMMAND), list(_files(folder))
    strangers = sorted(set(names) - {CONFIG, *RESULTS})
    if record.exists:
        strangers += record.strangers(files)
    else:
        known = {*_names(pictures), *_listed_in_report(folder)}
        strangers += [name for name in files if name not in known or _is_other(folder / name)]
    if not _may_be_replaced(folder / CONFIG):
        strangers.append(CONFIG)
    if strangers:
        raise UserError(
            f"{folder}: must hold nothing but a run to be replaced, got {listed(strangers)}; move "
            "that away, or choose another folder with --out"
        )


def remove_run(folder: Path, pictures: Sequence[str] = ()) -> None:
    """Remove the run that ``folder`` holds, if any, to make room for another.

    ``metrics.json`` goes first and ``config.yml`` last: interrupted, the folder is still known for
    what it is, and not for finished.

    Raises :class:`UserError`, with nothing removed, as :func:`check_replaceable`.
    """
    check_replaceable(folder, pictures)
    if not os.path.lexists(folder):
        return
    remove_stale_temporaries(folder)
    files = [METRICS, *_files(folder), CONFIG] if _visible_names(folder) else []
    try:
        for name in files:
            (folder / name).unlink(missing_ok=True)
        for kind in FOLDERS:
            for path, _, _ in os.walk(folder / kind, topdown=False):
                os.rmdir(path)
        FolderRecord(folder, COMMAND).remove()
    except OSError as error:
        raise UserError(f"{error.filename}: cannot be removed: {why_refused(error)}") from error


def _files(folder: Path) -> Iterator[str]:
    """Names of the results that are there, and of everything in the folders among them."""
    for name in RESULTS:
        if name not in FOLDERS or _is_other(folder / name, Path.is_dir):
            if os.path.lexists(folder / name):
                yield name
            continue
        for path, folders, files in os.walk(folder / name):
            folders.sort()
            inside = Path(path).relative_to(folder)
            kept = (file for file in sorted(files) if not is_temporary(file))
            yield from ((inside / file).as_posix() for file in kept)


def _is_other(path: Path, is_kind: Callable[[Path], bool] = Path.is_file) -> bool:
    """Whether it is something else than what it should be: a file, or what ``is_kind`` says."""
    return path.is_symlink() or not is_kind(path)


def _listed_in_report(folder: Path) -> set[str]:
    """The pictures of a run of a version without records: its report lists their views."""
    if not (folder / REPORT).is_file():
        return set()
    page = read_text(folder / REPORT, "report", MAX_BYTES)
    pictures = (name for name in _files(folder) if name.endswith(".png"))
    return {name for name in pictures if f"<th>{html.escape(Path(name).stem)}</th>" in page}


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be the output folder: {why_refused(error)} (--out)"
        ) from error


def _visible_names(folder: Path) -> list[str]:
    """What it holds, but for hidden files: a desktop's, or temporary ones of a killed run."""
    try:
        return sorted(name for name in os.listdir(folder) if not name.startswith("."))
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be the output folder: {why_refused(error)} (--out)"
        ) from error


def _belongs_to(folder: Path, config: FitConfig) -> bool:
    try:
        earlier = _earlier_config(folder)
    except UserError:
        return False
    return not _what_differs(earlier, config)


def _earlier_config(folder: Path) -> FitConfig:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserNote)
        return found_again(folder, load_run_config(folder))


def _which_run(folder: Path, config: FitConfig) -> str:
    """The other run that ``folder`` holds, compared with ``config``."""
    try:
        earlier = _earlier_config(folder)
    except UserError:
        return f"another run, with a {CONFIG} that is not readable"
    return f"another run, which differs in {listed(_what_differs(earlier, config))}"


def _what_differs(earlier: FitConfig, config: FitConfig) -> list[str]:
    """What one of them leaves to the dataset, the other has from there."""
    theirs, ours = decided_as(earlier, config), decided_as(config, earlier)
    return _differences(_values(theirs), _values(ours))


def _values(config: FitConfig) -> dict[str, object]:
    """What decides a result: everything but the section ``output``."""
    return config.model_dump(mode="json", exclude={"output"})


def _differences(theirs: object, ours: object, key: str = "") -> list[str]:
    if isinstance(theirs, dict) and isinstance(ours, dict):
        return [
            difference
            for name in ours
            for difference in _differences(theirs.get(name), ours[name], f"{key}.{name}".strip("."))
        ]
    return [] if theirs == ours else [one_line(f"{key} = {theirs} (here {ours})", limit=120)]
