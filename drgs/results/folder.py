"""The output folder of a fit: one folder, one run, and no result is lost by accident.

A folder belongs to the run whose ``config.yml`` it holds. A fit takes a folder that is missing or
empty, or that holds an unfinished run of the same configuration, which it continues; it never
writes over results.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from drgs.config.load import dump_config, load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError, one_line
from drgs.core.files import remove_stale_temporaries, why_refused
from drgs.results.files import CONFIG, METRICS, RESULTS

MAX_NAMED = 3
"""Values or files that a message names; the rest are counted."""


def claim_output_folder(folder: Path, config: FitConfig) -> None:
    """Make ``folder`` (absolute or relative to the current one) the output folder of a run.

    Creates it, with its parents, and writes ``config.yml``; what else it holds stays as it is.

    Raises :class:`UserError` where it holds results of another run or files of others, or cannot
    be written.
    """
    _make_folder(folder)
    present = _visible_names(folder)
    if CONFIG not in present and present:
        raise UserError(
            f"{folder}: the output folder must be new or empty, got one that holds "
            f"{_listed(present)}; choose another with --out"
        )
    if set(present) - {CONFIG} and not _belongs_to(folder, config):
        raise UserError(
            f"{folder}: already holds {_which_run(folder, config)}; choose another folder with "
            f"--out, continue that run with --resume {folder}, or replace it with --overwrite"
        )
    remove_stale_temporaries(folder)
    dump_config(config, folder / CONFIG)


def require_no_run(folder: Path) -> None:
    """Raise :class:`UserError` where ``folder`` holds a run: for one that cannot be continued."""
    if os.path.lexists(folder) and (names := _visible_names(folder)):
        raise UserError(
            f"{folder}: must be new or empty for a fit with --budget, got one that holds "
            f"{_listed(names)}; choose another with --out, go on with --resume {folder}, or "
            "replace it with --overwrite"
        )


def is_finished(folder: Path, config: FitConfig) -> bool:
    """Whether ``folder`` holds the whole result of this very configuration."""
    return (folder / METRICS).is_file() and _belongs_to(folder, config)


def load_run_config(folder: Path) -> FitConfig:
    """The configuration of the run that ``folder`` holds.

    Raises :class:`UserError` where it holds none.
    """
    if not os.path.isfile(folder / CONFIG):
        what = "has no" if os.path.isdir(folder) else "does not exist, and so has no"
        raise UserError(f"{folder}: is not the output folder of a fit: it {what} {CONFIG}")
    return load_config(folder / CONFIG)


def remove_run(folder: Path) -> None:
    """Remove the run that ``folder`` holds, if any, to make room for another.

    ``config.yml`` goes last: interrupted, the folder is still known for what it is.

    Raises :class:`UserError`, with nothing removed, for a folder that holds anything else.
    """
    if not os.path.lexists(folder) or not (names := _visible_names(folder)):
        return
    load_run_config(folder)
    strangers = sorted(set(names) - {CONFIG, *RESULTS})
    if strangers:
        raise UserError(
            f"{folder}: must hold nothing but a run to be replaced, got {_listed(strangers)}; move "
            "that away, or choose another folder with --out"
        )
    for name in sorted(names, key=lambda name: name == CONFIG):
        _remove(folder / name)


def _remove(path: Path) -> None:
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    except OSError as error:
        raise UserError(f"{path}: cannot be removed: {why_refused(error)}") from error


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
        return not _differences(_values(load_run_config(folder)), _values(config))
    except UserError:
        return False


def _which_run(folder: Path, config: FitConfig) -> str:
    """The other run that ``folder`` holds, compared with ``config``."""
    try:
        earlier = load_run_config(folder)
    except UserError:
        return f"another run, with a {CONFIG} that is not readable"
    return (
        f"another run, which differs in {_listed(_differences(_values(earlier), _values(config)))}"
    )


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


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return ", ".join(names[:MAX_NAMED]) + more
