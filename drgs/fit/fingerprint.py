"""Fingerprints of datasets, by which another dataset and its differences are recognized."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from drgs.core.folders import digest
from drgs.datasets.reader import map_on_threads
from drgs.datasets.types import Dataset, View, ViewFilter, all_views

CAMERA_TOLERANCE = 1e-9
"""Relative and absolute, of a camera's numbers: rounding of another machine's mathematics."""


class ViewPrint(BaseModel):
    """Fingerprint of a view."""

    model_config = ConfigDict(frozen=True)

    name: str
    size: tuple[int, int]  # px, width and height, as configured
    camera: list[float]  # pose, intrinsics, lens, second pose
    kind: str  # of lens and shutter
    files: dict[str, str]  # digests by image, mask, depth; empty: not read, equal to any

    @staticmethod
    def from_view(view: View, digests: dict[Path, str]) -> ViewPrint:
        """Return the fingerprint of a view, from digests of its files that were read."""
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

    def changes(self, now: ViewPrint) -> Iterator[str]:
        """Yield the parts of a view that are different ``now``."""
        if self.size != now.size:
            sizes = ("x".join(map(str, view.size)) for view in (self, now))
            yield "the size ({}, now {})".format(*sizes)
        elif (self.kind, len(self.camera)) != (now.kind, len(now.camera)) or not np.allclose(
            self.camera, now.camera, rtol=CAMERA_TOLERANCE, atol=CAMERA_TOLERANCE
        ):
            yield "the camera"
        for what in {**self.files, **now.files}:
            if _is_different(self.files.get(what), now.files.get(what)):
                yield f"the {what}"


class Fingerprint(BaseModel):
    """Fingerprint of a dataset, with views in its order."""

    model_config = ConfigDict(frozen=True)

    train: list[ViewPrint]
    test: list[ViewPrint]

    def to_bytes(self) -> bytes:
        """Return the content of a file."""
        return self.model_dump_json().encode()

    @staticmethod
    def from_bytes(content: bytes) -> Fingerprint:
        """Return the fingerprint of a file; ValueError for other content."""
        try:
            return Fingerprint.model_validate_json(content)
        except ValidationError:
            raise ValueError("no fingerprint of data") from None

    def differences(self, now: Fingerprint) -> list[str]:
        """Describe the differences ``now``; empty: the data is the same."""
        pairs = ((self.train, now.train, "training"), (self.test, now.test, "test"))
        return [text for pair in pairs for text in _differences(*pair)]

    def other_files(self, views: Iterable[View], now: Fingerprint) -> list[Path]:
        """Return files of training views (all, in the order of ``now``) that are different."""
        before = {view.name: view.files for view in self.train}
        return [
            path
            for view, print_now in zip(views, now.train, strict=True)
            for what, path in view.files.items()
            if _is_different(before.get(view.name, {}).get(what), print_now.files[what])
        ]


def fingerprint_of(dataset: Dataset, reads: ViewFilter = all_views) -> Fingerprint:
    """Return the fingerprint of a dataset, for which the files of its views are read.

    reads: accepts views by name; the files of others have empty digests.

    Raises :class:`UserError` for a missing file.
    """
    views = [view for view in (*dataset.train, *dataset.test) if reads(view.name)]
    files = sorted({path for view in views for path in view.files.values()})
    digests = dict(zip(files, map_on_threads(digest, files), strict=True))
    train, test = (
        [ViewPrint.from_view(view, digests) for view in views]
        for views in (dataset.train, dataset.test)
    )
    return Fingerprint(train=train, test=test)


def _differences(
    before: Sequence[ViewPrint], now: Sequence[ViewPrint], split: str
) -> Iterator[str]:
    old, new = ({view.name: view for view in views} for views in (before, now))
    yield from (f"{split} view {name} is missing" for name in old if name not in new)
    yield from (f"{split} view {name} is new" for name in new if name not in old)
    if old.keys() == new.keys() and list(old) != list(new):
        yield f"the {split} views are in another order"
    for name in filter(new.__contains__, old):
        yield from (f"{what} of {split} view {name}" for what in old[name].changes(new[name]))


def _is_different(before: str | None, now: str | None) -> bool:
    return before != now and "" not in (before, now)
