"""Contents of folders."""

from pathlib import Path


def visible(folder: Path) -> set[str]:
    """The names of all files, relative to the folder, but for hidden ones: what was asked for."""
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {path.as_posix() for path in files if not path.name.startswith(".")}


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of all files, hidden ones as well, by name."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
