"""Contents of folders."""

import json
from pathlib import Path

from drgs.core.files import write_json


def visible(folder: Path) -> set[str]:
    """The names of all files, relative to the folder, but for hidden ones: what was asked for."""
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {path.as_posix() for path in files if not path.name.startswith(".")}


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of all files, hidden ones as well, by name."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


EARLIER_NAMES = {
    "point_cloud.ply": "point_cloud_viewers.ply",
    "point_cloud_drgs.ply": "point_cloud.ply",
    "refined_cameras.json": "cameras.json",
}


def to_earlier_layout(folder: Path) -> None:
    """Give a fit's files, also in its record, their names in versions before 2026-12."""
    path = folder / ".drgs-fit.json"
    record = json.loads(path.read_text()) if path.exists() else {"files": {}}
    (folder / "cameras.json").unlink(missing_ok=True)
    for name, earlier in EARLIER_NAMES.items():
        if (folder / name).exists():
            (folder / name).rename(folder / earlier)
            record["files"][earlier] = record["files"].pop(name, None)
    if path.exists():
        write_json(path, record)
