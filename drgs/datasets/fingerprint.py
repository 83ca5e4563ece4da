"""What a dataset is, in short: enough to say later whether, and in what, another one differs.

Of each view: its name, size and camera as the configuration has them, and a digest of each file
that it was read from. Where the dataset lies is no part of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from drgs.core.folders import digest
from drgs.datasets.reader import in_parallel
from drgs.datasets.types import Dataset, Keeps, View, all_of_them

TOLERANCE = 1e-9
"""Relative and absolute, of a camera's numbers: what another machine's mathematics may change."""

PICTURES = {"image": "the picture", "mask": "the mask", "depth": "the depth"}
"""What messages call the files of a view."""


class _Print(BaseModel):
    model_config = ConfigDict(frozen=True)


class ViewPrint(_Print):
    """Of one view."""

    name: str
    size: tuple[int, int]  # px, width and height, as configured
    camera: list[float]  # pose, intrinsics, lens, second pose
    kind: str  # of lens and shutter
    files: dict[str, str]  # digests, by what is in the file; empty: not read, equal to any


class Fingerprint(_Print):
    """Of the views to train on and of those to measure on, in their order."""

    train: list[ViewPrint]
    test: list[ViewPrint]

    def to_bytes(self) -> bytes:
        """For a file."""
        return self.model_dump_json().encode()

    @staticmethod
    def from_bytes(content: bytes) -> Fingerprint:
        """What :meth:`to_bytes` gave; ValueError for anything else."""
        try:
            return Fingerprint.model_validate_json(content)
        except ValidationError:
            raise ValueError("no fingerprint of data") from None

    def differences(self, now: Fingerprint) -> list[str]:
        """What is different ``now``, in words; nothing: the data is the same."""
        pairs = ((self.train, now.train, "training"), (self.test, now.test, "test"))
        return [text for pair in pairs for text in _differences(*pair)]

    def other_files(self, views: Iterable[View], now: Fingerprint) -> list[Path]:
        """Files of training views (all of them, in the order of ``now``) that are different."""
        was = {view.name: view.files for view in self.train}
        return [
            path
            for view, is_now in zip(views, now.train, strict=True)
            for what, path in view.files.items()
            if _is_other(was.get(view.name, {}).get(what), is_now.files[what])
        ]


def fingerprint_of(dataset: Dataset, reads: Keeps = all_of_them) -> Fingerprint:
    """Reads the files of the views, which were in memory a moment ago.

    reads: of which views, by name; the files of others have empty digests.

    Raises :class:`drgs.core.errors.UserError` where one is gone.
    """
    views = [view for view in (*dataset.train, *dataset.test) if reads(view.name)]
    files = {path for view in views for path in view.files.values()}
    ordered = sorted(files)
    digests = dict(zip(ordered, in_parallel(digest, ordered), strict=True))
    train, test = (
        [_print_of(view, digests) for view in views] for views in (dataset.train, dataset.test)
    )
    return Fingerprint(train=train, test=test)


def _print_of(view: View, digests: dict[Path, str]) -> ViewPrint:
    camera, kinds = [*view.camera_to_world.ravel(), view.fx, view.fy, view.cx, view.cy], []
    if view.lens is not None:
        kinds.append(f"{view.lens.kind} {' '.join(view.lens.coefficients())}")
        camera += view.lens.coefficients().values()
    if view.motion is not None:
        kinds.append(view.motion.shutter)
        camera += [*view.motion.close_to_world.ravel()]
    return ViewPrint(
        name=view.name,
        size=(view.width, view.height),
        camera=[float(number) for number in camera],
        kind=", ".join(kinds),
        files={what: digests.get(path, "") for what, path in view.files.items()},
    )


def _differences(
    before: Sequence[ViewPrint], now: Sequence[ViewPrint], split: str
) -> Iterator[str]:
    was, is_now = ({view.name: view for view in views} for views in (before, now))
    for name in was:
        if name not in is_now:
            yield f"{split} view {name} is missing"
    for name in is_now:
        if name not in was:
            yield f"{split} view {name} is new"
    if was.keys() == is_now.keys() and list(was) != list(is_now):
        yield f"the {split} views are in another order"
    for name in filter(is_now.__contains__, was):
        yield from (f"{what} of {split} view {name}" for what in _changes(was[name], is_now[name]))


def _changes(was: ViewPrint, now: ViewPrint) -> Iterator[str]:
    if was.size != now.size:
        yield f"the size ({_size(was)}, now {_size(now)})"
    elif was.kind != now.kind or not _close(was.camera, now.camera):
        yield "the camera"
    for what in {**was.files, **now.files}:
        if _is_other(was.files.get(what), now.files.get(what)):
            yield PICTURES.get(what, what)


def _is_other(was: str | None, now: str | None) -> bool:
    return was != now and "" not in (was, now)


def _size(view: ViewPrint) -> str:
    return "x".join(map(str, view.size))


def _close(was: Sequence[float], now: Sequence[float]) -> bool:
    return len(was) == len(now) and all(
        math.isclose(a, b, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
        for a, b in zip(was, now, strict=True)
    )
