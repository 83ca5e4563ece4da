"""Views to train on and views to measure on, where a dataset specifies them.

Lists are in ``transforms.json`` (``train_filenames``, ``val_filenames``, ``test_filenames``, as in
nerfstudio), or in ``train.txt``, ``val.txt`` and ``test.txt`` beside COLMAP's model or in the
dataset's folder, a name a line: the 3DGS reference reads ``sparse/0/test.txt``. Without lists,
folders ``train`` and ``test`` or ``val`` that contain all photographs are the splits.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from drgs.config.schema import DataConfig
from drgs.core.errors import UserError, did_you_mean, format_names, one_line
from drgs.core.files import read_text
from drgs.datasets.files import IMAGE_FOLDERS, MIN_FOUND_SHARE, key_of, parts_of, stem_of
from drgs.datasets.transforms import TransformsFrame, unique_names

SPLITS = ("train", "val", "test")

MAX_LIST_BYTES = 1 << 26


@dataclass(frozen=True)
class Lists:
    """Names of the photographs of each split."""

    names: Mapping[str, Collection[str]]  # of frames, by SPLITS; at least one
    where: str  # keys or files that contain the lists, for the description


@dataclass(frozen=True)
class Split:
    """Indices of views."""

    train: Sequence[int]
    test: Sequence[int]
    name: str  # of the split that ``test`` is
    how: str  # reason of the choice, for the description


def listed_frames(
    source: Path, key: str, listing: Sequence[str], names: Sequence[str], notes: list[str]
) -> set[str]:
    """Return the ``names`` of frames that a list contains; source, key: of the list, for messages.

    A name may differ in its suffix, in case and by the folder of the photographs, where only one
    frame has such a name.

    Raises :class:`UserError` where fewer than half of a list are names of frames.
    """
    matched, unknown = _match_names(listing, names)
    if len(unknown) > (1 - MIN_FOUND_SHARE) * len(listing):
        raise UserError(
            f"{source}: {key} must list the photographs of frames, but {len(unknown):,} of its "
            f"{len(listing):,} names are not theirs: {format_names(unknown)}"
            f"{did_you_mean(unknown[0], names)}"
        )
    if unknown:
        notes.append(f"{source}: {key} has names that no frame has: {format_names(unknown)}")
    return matched


def _match_names(listing: Sequence[str], names: Sequence[str]) -> tuple[set[str], list[str]]:
    """Return the ``names`` that a list contains, and its other names, for messages."""
    exact = {"/".join(parts_of(name)): name for name in names}
    loose: dict[str, set[str]] = {}
    for name in names:
        loose.setdefault(_loose_key(name), set()).add(name)
    matched, unknown = set(), []
    for name in listing:
        same = exact.get("/".join(parts_of(name)))
        candidates = loose.get(_loose_key(name), set()) if same is None else {same}
        if len(candidates) == 1:
            matched |= candidates
        else:
            unknown.append(one_line(name, 100))
    return matched, unknown


def _loose_key(name: str) -> str:
    """Return a name without the image's suffix and the folder of photographs, in any case."""
    parts = [key_of(part) for part in parts_of(name)] or [""]
    if len(parts) > 1 and parts[0] in IMAGE_FOLDERS:
        del parts[0]
    return "/".join([*parts[:-1], stem_of(parts[-1])])


def unlisted_splits(
    folders: Sequence[Path], names: Sequence[str], notes: list[str]
) -> Lists | None:
    """Return the splits of a layout without lists of its own, by files or by folders.

    The first of ``folders`` with ``test.txt``, ``val.txt`` or ``train.txt`` decides; a file without
    a name of a frame is another program's.
    """
    for folder in folders:
        lists = {}
        for split in SPLITS:
            if (file := folder / f"{split}.txt").is_file():
                lines = map(str.strip, read_text(file, "list of names", MAX_LIST_BYTES).split("\n"))
                listing = [line for line in lines if line and not line.startswith("#")]
                if _match_names(listing, names)[0]:
                    lists[split] = listed_frames(folder, file.name, listing, names, notes)
                else:
                    notes.append(f"{file}: lists no photograph, and is not read")
        if lists:
            return Lists(lists, " and ".join(f"{split}.txt" for split in lists))
    lists = {}
    for name in names:
        below = [part for part in map(key_of, parts_of(name)[:-1]) if part in SPLITS]
        if not below:
            return None
        lists.setdefault(below[-1], set()).add(name)
    return Lists(lists, "folders") if len(lists) > 1 and "train" in lists else None


def split_of(
    config: DataConfig, source: Path, lists: Lists | None, names: Sequence[str], notes: list[str]
) -> Split:
    """Divide views of frames called ``names``, in this order.

    Without lists, the views at indices 0, n, 2n, ... are to measure on, as in Mip-NeRF 360 and
    3DGS, with n = ``data.test_every``.

    Raises :class:`UserError` where there is no split as configured, nothing to train or to measure
    on, or a photograph for both.
    """
    if len(names) < 2:
        raise UserError(
            f"{source}: at least 2 views are needed, one of them to test; got {len(names)}"
        )
    if lists is None:
        return _split_every_nth(config, source, len(names))
    name, train, test = _listed_split(config, source, lists, set(names))
    both = sorted(train & test)
    if both and name != "train":
        raise UserError(
            f"{source}: a photograph must be either to train or to measure on, but {lists.where} "
            f"have {len(both):,} in both train and {name}: {one_line(format_names(both))}; take "
            "them out of one"
        )
    if not (train and test):
        raise UserError(
            f"{source}: at least 1 view of the splits train and {name} is needed, and "
            f"{lists.where} leave none"
        )
    left = [n for n in names if n not in set().union(train, test, *lists.names.values())]
    if left:
        notes.append(
            f"{source}: left out, as no list has them ({lists.where}): {len(left):,} of "
            f"{len(names):,} photographs ({format_names(left)})"
        )
    trained, measured = ([i for i, n in enumerate(names) if n in m] for m in (train, test))
    return Split(trained, measured, name, f"split {name}, by {lists.where}")


def _listed_split(
    config: DataConfig, source: Path, lists: Lists, names: set[str]
) -> tuple[str, set[str], set[str]]:
    """Return the split to measure on, and ``names`` to train on and to measure on.

    Photographs of a split without a list are those in no other list.
    """
    is_val = "val" in lists.names and "test" not in lists.names
    name = config.test_split or ("val" if is_val else "test")
    if config.test_split and name not in (*lists.names, "train"):
        there = " and ".join(lists.names)
        raise UserError(f"{source}: there is no split {name}, only {there}; set data.test_split")
    for_others = [chosen for split, chosen in lists.names.items() if split != "train"]
    train = names.intersection(lists.names.get("train", names.difference(*for_others)))
    test = train if name == "train" else names.intersection(lists.names.get(name, names - train))
    return name, train, test


def _split_every_nth(config: DataConfig, source: Path, num_views: int) -> Split:
    if config.test_split not in (None, "test"):
        raise UserError(
            f"{source}: this layout has no split {config.test_split}; leave data.test_split out "
            "(data.test_every chooses the test views)"
        )
    n = config.test_every
    train = [index for index in range(num_views) if index % n]
    return Split(train, range(0, num_views, n), "test", f"every {n}th by file name")


def ends_in(file: Path, name: str) -> bool:
    """Return whether ``name`` is the end of a path, with its suffix or without."""
    parts = Path(name).parts
    ends = (path.parts[-len(parts) :] for path in (file, file.with_suffix("")))
    return bool(parts) and parts in ends


def left_out(config: DataConfig, frames: Sequence[TransformsFrame]) -> set[str]:
    """Return ``file_path`` of the frames that ``data.leave_out`` names: they are not opened.

    A name is that of the view, or the end of the photograph's path, with its suffix or without.
    """
    paths, found = [frame.file_path for frame in frames], set()
    views = unique_names(paths) if config.leave_out else []
    for name in config.leave_out:
        rows = zip(paths, views, (frame.files["image"] for frame in frames), strict=True)
        same = {path for path, view, file in rows if name == view or ends_in(file, name)}
        if not same:
            raise UserError(
                f"data.leave_out: {config.path} has no photograph {one_line(name, 60)}"
                f"{did_you_mean(name, views)}"
            )
        found |= same
    if found and found.issuperset(paths):
        raise UserError(f"data.leave_out: no photograph is left to train on in {config.path}")
    return found
