"""What a folder holds that is no dataset yet, and how it becomes one.

Imported when no layout's file was found, to say more than that.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from drgs.core.errors import listed
from drgs.datasets.file_names import PICTURE_FOLDERS, PICTURE_SUFFIXES

VIDEOS = frozenset({".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v"})

COLMAP_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
"""Where COLMAP's models lie in the folders of datasets."""

WORKSPACES = ("", "dense/0", "dense")
"""Folders of that kind in COLMAP's automatic reconstruction, with their photographs."""

OTHER_COLMAP_FOLDERS = ("0", ".")
"""Folders of models in COLMAP's own folders and, beside the photographs, in flat exports."""

GUIDE = 'docs/guide.md, "From photographs to a dataset"'


def what_is_there(folder: Path, markers: Sequence[str]) -> str:
    """What ``folder`` was recognised as, and what to do; one line, without the folder's name.

    markers: the files that the layouts have, none of which is there.
    """
    names = sorted(os.listdir(folder))
    recognisers: tuple[Callable[[Path, list[str], Sequence[str]], str | None], ...] = (
        _output_of_a_fit,
        _splits_without_training,
        _dataset_below,
        _colmap_model,
        _llff_poses,
        _pictures,
        _videos,
        _pictures_below,
    )
    for recognise in recognisers:
        if (found := recognise(folder, names, markers)) is not None:
            return found
    return (
        f"neither {' nor '.join(markers)} is there; data.path must be a folder in the layout of "
        "NeRF-synthetic, of nerfstudio / instant-ngp or of COLMAP"
    )


def is_picture(name: str) -> bool:
    """By its name; hidden files, as systems leave beside photographs (``._a.jpg``), are none."""
    return not name.startswith(".") and Path(name).suffix.lower() in PICTURE_SUFFIXES


def _output_of_a_fit(folder: Path, names: list[str], markers: Sequence[str]) -> str | None:
    if "config.yml" not in names or not {"point_cloud.ply", "checkpoint.npz"} & set(names):
        return None
    return (
        "is the output folder of a fit, not a dataset; data.path must be the folder of the "
        "photographs, which config.yml there names"
    )


def _splits_without_training(folder: Path, names: list[str], markers: Sequence[str]) -> str | None:
    splits = [n for n in names if n.startswith("transforms_") and n.endswith(".json")]
    if not splits:
        return None
    return (
        f"holds {_listed(splits)} of the NeRF-synthetic layout, but not transforms_train.json; get "
        "the missing file, or rename the one to train on"
    )


def _dataset_below(folder: Path, names: list[str], markers: Sequence[str]) -> str | None:
    for name in names:
        for marker in markers:
            if os.path.isfile(folder / name / marker):
                return f"holds a dataset in its folder {name}; give {_quoted(folder / name)}"
        if has_colmap_model(folder / name) and _pictures_in(_folder_of_pictures(folder / name)):
            return f"holds a dataset in its folder {name}; give {_quoted(folder / name)}"
    return None


def has_colmap_model(folder: Path) -> bool:
    """Whether a model of COLMAP lies where datasets have it."""
    return colmap_dataset(folder) is not None


def colmap_dataset(folder: Path) -> tuple[Path, Path] | None:
    """The folder of the photographs' folders and masks, and that of the model; None: no model.

    The first that has both photographs and a model; else the first model in a place of its own.
    """
    for workspace in WORKSPACES:
        root = folder / workspace
        for below in (*COLMAP_FOLDERS, "."):
            if _found_model(root, (below,)) and _has_pictures(root):
                return root, root / below
    for below in COLMAP_FOLDERS:
        if _found_model(folder, (below,)):
            return folder, folder / below
    return None


def _has_pictures(root: Path) -> bool:
    """Return whether photographs lie where those of a model do."""
    if any((root / f"images{suffix}").is_dir() for suffix in ("", "_2", "_4", "_8")):
        return True
    return any(map(_pictures_in, (root, *_folders_in(root))))


def _found_model(folder: Path, folders: Sequence[str]) -> str | None:
    """The file of the cameras, below ``folder``."""
    for below in folders:
        for suffix in (".bin", ".txt"):
            if all(os.path.isfile(folder / below / f"{n}{suffix}") for n in ("cameras", "images")):
                return str(Path(below, f"cameras{suffix}"))
    return None


def _colmap_model(folder: Path, names: list[str], markers: Sequence[str]) -> str | None:
    found = _found_model(folder, OTHER_COLMAP_FOLDERS)
    if found is None:
        return None
    return (
        f"is a model of COLMAP ({found}) without photographs; give the folder that has it in "
        "sparse/0 and the photographs in images"
    )


def _llff_poses(folder: Path, names: list[str], markers: Sequence[str]) -> str | None:
    if "poses_bounds.npy" not in names:
        return None
    return (
        "is in the layout of LLFF (poses_bounds.npy), which is not read; convert it to "
        f"transforms.json; see {GUIDE}"
    )


def _pictures(folder: Path, names: list[str], markers: Sequence[str]) -> str | None:
    below = _folder_of_pictures(folder)
    pictures = _pictures_in(below)
    if not pictures:
        return None
    there = folder if below.name == "images" else below
    count = "1 picture" if len(pictures) == 1 else f"{len(pictures):,} pictures"
    return (
        f"holds {count} ({_listed(pictures)}), but no cameras: where each was taken must be known; "
        f"find it out: drgs poses {_quoted(there)}; see {GUIDE}"
    )


def _videos(folder: Path, names: list[str], markers: Sequence[str]) -> str | None:
    videos = [n for n in names if Path(n).suffix.lower() in VIDEOS]
    if not videos:
        return None
    return (
        f"holds a video ({_listed(videos)}), but no photographs: take two frames of each second "
        f"(mkdir DIR; ffmpeg -i {_quoted(folder / videos[0])} -r 2 DIR/%04d.jpg), find out where "
        f"they were taken (drgs poses DIR), and give DIR; see {GUIDE}"
    )


def _pictures_below(folder: Path, names: list[str], markers: Sequence[str]) -> str | None:
    if where := folders_of_pictures(folder):
        return f"holds pictures only {where}; see {GUIDE}"
    return None


def folders_of_pictures(folder: Path) -> str:
    """Where pictures lie in folders of ``folder``, and what to do; "": nowhere."""
    if any(map(_pictures_in, _folders_in(folder / "images"))):
        return (
            "in folders of its folder images, but no cameras: find out where each was taken: "
            f"drgs poses {_quoted(folder)}"
        )
    found = list(filter(_pictures_in, _folders_in(folder)))
    if not found:
        return ""
    names = [path.name for path in found]
    remedy = f"find out where each was taken: drgs poses {_quoted(found[0])}"
    if len(found) > 1:
        remedy = (
            f"if they show one scene, move these folders into {_quoted(folder / 'images')} and "
            f"find out where each was taken: drgs poses {_quoted(folder)}"
        )
    return f"in its {_counted(names)}, but no cameras: {remedy}"


def _counted(names: Sequence[str]) -> str:
    return f"folder {names[0]}" if len(names) == 1 else f"folders {listed(names)}"


def _folders_in(folder: Path) -> list[Path]:
    """Sorted; without hidden ones, and those that may not be read."""
    return [
        path
        for path in (sorted(folder.iterdir()) if folder.is_dir() else ())
        if not path.name.startswith(".") and path.is_dir() and os.access(path, os.R_OK | os.X_OK)
    ]


def _pictures_in(folder: Path) -> list[str]:
    """Sorted names."""
    return list(filter(is_picture, sorted(os.listdir(folder))))


def _folder_of_pictures(folder: Path) -> Path:
    """The folder itself, or the one in it that is for pictures."""
    smaller = sorted(path.name for path in folder.glob("images_*"))
    below = (folder / name for name in (*PICTURE_FOLDERS, *smaller))
    return next((path for path in below if os.access(path, os.R_OK) and path.is_dir()), folder)


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _quoted(path: Path) -> str:
    """As a shell reads it."""
    return shlex.quote(str(path))
