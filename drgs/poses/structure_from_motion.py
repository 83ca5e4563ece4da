"""Where photographs were taken: structure from motion, by COLMAP.

COLMAP (Schoenberger and Frahm 2016) finds features in each photograph, matches them between pairs
of photographs, and puts together cameras and points from there. It runs through pycolmap, in a
process of its own: there, neither Ctrl-C nor what it may abort for can take this one with it.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from drgs.core.child_process import ChildEndedError, DeferredInterrupts, run_in_child
from drgs.core.environment import required
from drgs.core.errors import UserError, UserNote, listed, one_line
from drgs.core.files import why_refused
from drgs.core.folders import FolderRecord, sole_writer
from drgs.datasets.colmap import LENSES, find_model, model_folder
from drgs.datasets.files import is_image, masks_of, without_masks
from drgs.datasets.folders import explain_photographs
from drgs.datasets.images import read_mask
from drgs.io.pictures import check_readable, image_size, write_png

CAMERA_MODELS = tuple(LENSES)
"""Those that can be looked for: all that can be rendered."""

SIMPLE = "SIMPLE_RADIAL"
"""The one with the fewest numbers to find that suits photographs."""

READ = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
"""Suffixes of the pictures that COLMAP reads and that can be fitted."""

ALL_PAIRS = 100
"""Photographs, at most, of which every two are compared where nothing is said."""

NEIGHBOURS, STRIDE = 10, 8
"""Of more: each with so many that follow it by name and those at distances of powers of two, and
every so many-th with each other."""

AT_ONCE = 8
"""Photographs whose features are looked for in a call of COLMAP; it uses all cores within one."""

PAIRS_AT_ONCE = 64

MAX_SIDE = 3200
"""px: features are looked for in photographs scaled down to this, which is COLMAP's default."""

LEAST_PLACED = 3
"""Photographs with which there is a model at all."""

COMMAND = "poses"

MODEL_FILES = ("cameras.bin", "frames.bin", "points3D.bin", "rigs.bin", "images.bin")
"""In the order in which they are put in place: without the last there is no model."""

TEMPORARY = ".drgs-poses-"
"""Names of folders begin so that are removed in the end, or by the next run."""

SEED = 0

REMEDY = "if memory or the disk is full, free some of it, or take fewer or smaller photographs"
"""Where COLMAP gives up: it does not always tell the reason."""

Watch = Callable[[str, int, int], None]
"""Is called with what is counted, how many are done, and of how many."""


@dataclass(frozen=True)
class Search:
    """How cameras are looked for."""

    camera_model: str = "OPENCV"  # of CAMERA_MODELS
    compare: str = "auto"  # pairs: all, neighbours by name, or auto: by ALL_PAIRS
    share: str = "alike"  # a camera for all of the same size and EXIF (alike), for one, for each

    def compares_all(self, count: int) -> bool:
        """Whether every two of ``count`` photographs are compared."""
        return self.compare == "all" or (self.compare == "auto" and count <= ALL_PAIRS)

    def others(self, count: int) -> str:
        """Options that search otherwise, and may find more in ``count`` photographs, as text."""
        options = {
            "--compare all": not self.compares_all(count),
            "--share one": self.share != "one",
            f"--camera-model {SIMPLE}": self.camera_model != SIMPLE,
            "--camera-model OPENCV_FISHEYE (a fisheye)": "FISHEYE" not in self.camera_model,
        }
        return " or ".join(option for option, is_another in options.items() if is_another)


@dataclass(frozen=True)
class Placed:
    """What was found."""

    names: tuple[str, ...]  # of the photographs that have a camera
    missing: tuple[str, ...]  # of the others
    cameras: tuple[str, ...]  # their models and numbers, as text
    num_points: int
    error: float  # px: mean distance of points from where they were observed
    num_models: int  # that do not hang together; the largest is this


def pictures_in(folder: Path) -> tuple[Path, list[str]]:
    """The folder of photographs, ``folder/images`` or ``folder`` itself, and their names there.

    Those that COLMAP does not read are left out, with a :class:`UserNote`. Raises
    :class:`UserError` where there are no others, or one that cannot be fitted.
    """
    below = folder / "images"
    pictures = below if below.is_dir() else folder
    try:
        if pictures == below:
            found = [Path(root, name) for root, _, names in os.walk(below) for name in names]
        else:
            found = [pictures / name for name in os.listdir(pictures)]
    except OSError as error:
        raise UserError(f"{folder}: cannot open the folder: {error.strerror or error}") from None
    found = without_masks([p for p in found if is_image(p.name) and p.is_file()])
    found.sort(key=_as_counted)
    files = [path for path in found if path.suffix.lower() in READ]
    others = [path.relative_to(pictures) for path in found if path.suffix.lower() not in READ]
    if not files:
        below = explain_photographs(folder)
        got = f"one that {below}" if below else "none"
        if others:
            got = f"{listed(others)}, which COLMAP does not read; convert them to JPEG"
        raise UserError(
            f"{folder}: must hold photographs, or have them in a folder images, got {got}"
        )
    if others:
        note = f"{pictures}: left out, as COLMAP does not read them: {listed(others)}"
        warnings.warn(UserNote(note), stacklevel=2)
    for file in files:
        check_readable(file)  # what a fit refuses is refused before hours of work
    names = [file.relative_to(pictures).as_posix() for file in files]
    for name in names:
        if os.fsencode(name) != name.encode(errors="replace"):
            raise UserError(f"{pictures / name}: COLMAP knows names in UTF-8 only; rename it")
    return pictures, names


def _as_counted(file: Path) -> list[tuple[int, str]]:
    """An order in which ``frame 10`` follows ``frame 9``."""
    parts = re.split(r"([0-9]+)", str(file))
    return [(int(part[:18]), part) if part.isdecimal() else (0, part) for part in parts]


def place(folder: Path, search: Search, replace: bool, watch: Watch) -> Placed:
    """Write ``folder/sparse/0``, COLMAP's model of the photographs in ``folder``.

    replace: the model that is there, if it was written here. Nothing is written where none is
    found, and other files in that folder stay.

    Raises :class:`UserError`, with what to do, where no cameras are found, where a model is there
    that is not to be replaced, and while another process writes to ``folder``.
    """
    pictures, names = pictures_in(folder)
    model = folder / "sparse" / "0"
    with DeferredInterrupts() as interrupts, sole_writer(folder) as keep:
        _check_free(folder, model, replace)
        try:
            if keep():
                _remove_left_behind(folder, model)
            with tempfile.TemporaryDirectory(prefix=TEMPORARY, dir=_place_of(model)) as temporary:
                found = run_in_child(
                    _find, search, pictures, folder, names, Path(temporary),
                    watch=watch, interrupts=interrupts,
                )  # fmt: skip
                _put(Path(temporary, "model"), model)
        except BrokenPipeError:  # of the output, whose reader has gone
            raise
        except OSError as error:
            raise UserError(f"{model}: cannot write the model: {why_refused(error)}") from None
        except ChildEndedError as error:
            raise UserError(
                f"{pictures}: structure from motion was ended: {error}; {REMEDY}"
            ) from None
    return found


def _check_free(folder: Path, model: Path, replace: bool) -> None:
    """Raise :class:`UserError` where a model is there, or files that are not to be replaced."""
    for path in (model.parent, model):
        if os.path.lexists(path) and not path.is_dir():
            raise UserError(f"{path}: must be a folder, got something else; move it away")
    record = FolderRecord(model, COMMAND)
    if not replace and find_model(folder):
        there = model_folder(folder)
        does = f"--overwrite writes {model}, which is then used instead"
        if there == model:
            is_own = not record.strangers(MODEL_FILES)
            does = "--overwrite replaces it" if is_own else "for another, move it away"
        fit = shlex.join(["drgs", "fit", str(folder)])
        raise UserError(f"{there}: is there already; {fit} uses it, {does}")
    record.check(MODEL_FILES)


def _place_of(model: Path) -> Path:
    """The folder for temporary files: the one to which they are moved, or the next above it."""
    return next(path for path in (model, *model.parents) if path.is_dir())


def _remove_left_behind(folder: Path, model: Path) -> None:
    """Remove temporary files of runs that were killed; to be called by the only writer."""
    for path in (folder, model.parent, model):
        for left in path.glob(f"{TEMPORARY}*"):
            shutil.rmtree(left, ignore_errors=True)


def _put(written: Path, model: Path) -> None:
    """Move the files of a model to their place, where an earlier one is replaced.

    Before the first of them is in place the last one is gone: there is no mixture of two models.
    """
    record = FolderRecord(model, COMMAND)
    record.claim(MODEL_FILES)
    (model / MODEL_FILES[-1]).unlink(missing_ok=True)
    for name in MODEL_FILES:
        (written / name).replace(model / name)
    record.seal()
    if stale := sorted(path.name for path in model.glob("*.txt") if path.stem in _STEMS):
        note = (
            f"{model}: {listed(stale)} of another model stay there; what reads both takes the "
            "binary files, which are new"
        )
        warnings.warn(UserNote(note), stacklevel=2)


_STEMS = frozenset(Path(name).stem for name in MODEL_FILES)


def _find(
    search: Search, pictures: Path, dataset: Path, names: Sequence[str], folder: Path, watch: Watch
) -> Placed:
    """Write ``folder/model``: what runs in a process of its own."""
    pycolmap = required("pycolmap", "colmap", "structure from motion")
    pycolmap.logging.minloglevel = 3  # what goes wrong is said below
    try:
        found, count = _Work(pycolmap, folder, pictures, dataset, names, search, watch).model()
        written = folder / "model"
        written.mkdir()
        found.write_binary(written)
        return _described(found, names, count)
    except UserError:
        raise
    except (RuntimeError, ValueError) as error:  # pycolmap's, for errors of the user and its own
        raise UserError(
            f"{pictures}: structure from motion failed: COLMAP says: {one_line(error, 500)}; "
            f"{REMEDY}"
        ) from None


@dataclass
class _Work:
    pycolmap: ModuleType
    folder: Path  # for what is written on the way
    pictures: Path
    dataset: Path  # which may have masks
    names: Sequence[str]
    search: Search
    watch: Watch

    def model(self) -> tuple[Any, int]:
        """The largest reconstruction, and of how many."""
        if len(self.names) < LEAST_PLACED:
            raise UserError(
                f"{self.pictures}: at least {LEAST_PLACED} photographs, got {len(self.names)}; "
                "take 30 or more, each showing most of what its neighbours show"
            )
        self._extract()
        self._match()
        models = self._reconstruct()
        if not models or max(m.num_reg_images() for m in models) < LEAST_PLACED:
            raise UserError(f"{self.pictures}: {self._why_none()}")
        return max(models, key=lambda m: (m.num_reg_images(), m.num_points3D())), len(models)

    @property
    def database(self) -> Path:
        return self.folder / "database.db"

    def _extract(self) -> None:
        """Features of all photographs, and which of them share a camera."""
        pycolmap, done = self.pycolmap, 0
        options = pycolmap.FeatureExtractionOptions()
        options.max_image_size = MAX_SIDE
        masks = self._masks_for_all()
        for group in self._groups():
            reader = pycolmap.ImageReaderOptions()
            reader.camera_model = self.search.camera_model
            if masks is not None:
                reader.mask_path = masks
            for start in range(0, len(group), AT_ONCE):
                chunk = group[start : start + AT_ONCE]
                self.watch("photograph", done, len(self.names))
                pycolmap.extract_features(
                    self.database,
                    self.pictures,
                    image_names=chunk,
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=reader,
                    extraction_options=options,
                )
                reader.existing_camera_id = self._camera_of(chunk)
                done += len(chunk)
        self.watch("photograph", done, len(self.names))

    def _groups(self) -> list[list[str]]:
        """Names of photographs that share a camera."""
        groups: dict[object, list[str]] = {}
        sizes = {image_size(self.pictures / name) for name in self.names}
        if self.search.share == "one" and len(sizes) > 1:
            (w, h), (other_w, other_h), *_ = sorted(sizes)
            raise UserError(
                f"{self.pictures}: photographs that share one camera must have one size, got "
                f"{w} x {h} and {other_w} x {other_h} px; use --share alike"
            )
        for name in self.names:
            key = {"one": 0, "each": name}.get(self.search.share)
            key = _taken_with(self.pictures / name) if key is None else key
            groups.setdefault(key, []).append(name)
        return list(groups.values())

    def _camera_of(self, names: Sequence[str]) -> int:
        """The number of the camera that photographs share, now that they have been read."""
        with self.pycolmap.Database.open(self.database) as database:
            cameras = {image.name: image.camera_id for image in database.read_all_images()}
        if missing := [name for name in names if name not in cameras]:
            raise UserError(
                f"{self.pictures / missing[0]}: COLMAP cannot read this photograph, or its mask; "
                "convert it, or take it away"
            )
        return cameras[names[0]]

    def _masks_for_all(self) -> Path | None:
        """A folder with a mask for each photograph, white for those without; None: there are none.

        Of the photographs' sizes, as a fit reads them. COLMAP leaves out photographs whose mask is
        missing.
        """
        given = dict(
            zip(self.names, masks_of(self.dataset, self.names, [], self.pictures), strict=True)
        )
        if not any(given.values()):
            return None
        folder = self.folder / "masks"
        for name in self.names:
            target = folder / f"{name}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            width, height = image_size(self.pictures / name)
            mask = np.ones((height, width), np.float32)
            if (file := given[name]) is not None:
                mask = read_mask(file, (width, height))
            write_png(target, mask)
        return folder

    def _match(self) -> None:
        """Compare pairs, some at a time.

        COLMAP's lists of pairs have spaces between names, which may hold some themselves: for as
        long as they are compared, photographs are called by their numbers.
        """
        pycolmap, pairs = self.pycolmap, list(self._pairs())
        listing = self.folder / "pairs.txt"
        options = pycolmap.ImportedPairingOptions()
        options.match_list_path = listing
        self._rename(str)
        for start in range(0, len(pairs), PAIRS_AT_ONCE):
            chunk = pairs[start : start + PAIRS_AT_ONCE]
            self.watch("pair of photographs", start, len(pairs))
            listing.write_text("".join(f"{a} {b}\n" for a, b in chunk))
            pycolmap.match_image_pairs(self.database, pairing_options=options)
        self.watch("pair of photographs", len(pairs), len(pairs))
        self._rename(lambda index: self.names[index])

    def _rename(self, name_of: Callable[[int], str]) -> None:
        """Call photographs in the database by what ``name_of`` makes of their places in names."""
        with self.pycolmap.Database.open(self.database) as database:
            images = {image.name: image for image in database.read_all_images()}
            for index, name in enumerate(self.names):
                image = images[name] if name in images else images[str(index)]
                image.name = name_of(index)
                database.update_image(image)

    def _pairs(self) -> Iterator[tuple[int, int]]:
        count = len(self.names)
        compares_all = self.search.compares_all(count)
        steps = {*range(1, NEIGHBOURS + 1), *(2**k for k in range(count.bit_length()))}
        for i, j in combinations(range(count), 2):
            if compares_all or j - i in steps or (i % STRIDE == 0 and j % STRIDE == 0):
                yield i, j

    def _reconstruct(self) -> list[Any]:
        options = self.pycolmap.IncrementalPipelineOptions()
        options.random_seed = SEED
        placed = 0

        def begin() -> None:
            nonlocal placed
            placed = 2
            self.watch("camera", placed, len(self.names))

        def count() -> None:
            nonlocal placed
            placed = min(placed + 1, len(self.names))
            self.watch("camera", placed, len(self.names))

        found = self.pycolmap.incremental_mapping(
            self.database,
            self.pictures,
            self.folder / "models",
            options=options,
            initial_image_pair_callback=begin,
            next_image_callback=count,
        )
        return list(found.values())

    def _why_none(self) -> str:
        with self.pycolmap.Database.open(self.database) as database:
            features = [
                database.num_keypoints_for_image(image.image_id)
                for image in database.read_all_images()
            ]
            verified = database.num_verified_image_pairs()
        few = sum(number < FEW_FEATURES for number in features)
        found = (
            f"{few} of {len(features)} photographs have hardly any features (blurred, dark, or of "
            "something plain)"
            if few > len(features) / 2
            else f"only {verified} pairs of photographs show the same, as far as one can tell"
        )
        return (
            f"no cameras were found: {found}; take more photographs, each showing most of what "
            "its neighbours show, while walking around (not turning on the spot), or try "
            f"{self.search.others(len(features))}"
        )


FEW_FEATURES = 100


def _taken_with(file: Path) -> tuple[object, ...]:
    """The same for photographs of the same size and, as far as EXIF says, the same lens."""
    size = image_size(file)
    tags = ExifTags.Base
    try:
        with Image.open(file) as image:
            exif = image.getexif()
            details = exif.get_ifd(ExifTags.IFD.Exif)
            told = (exif.get(tags.Make), exif.get(tags.Model), details.get(tags.FocalLength))
    except Exception:  # Pillow raises many types for broken EXIF, which says nothing
        told = ()
    return *size, *map(str, told)


def _described(found: Any, names: Sequence[str], num_models: int) -> Placed:
    placed = {image.name for image in found.images.values() if image.has_pose}
    cameras = tuple(
        f"{camera.model.name} {camera.width} x {camera.height} px "
        f"({camera.params_info.replace(' ', '')}: "
        f"{', '.join(f'{value:.5g}' for value in camera.params)})"
        for _, camera in sorted(found.cameras.items())
    )
    return Placed(
        names=tuple(name for name in names if name in placed),
        missing=tuple(name for name in names if name not in placed),
        cameras=cameras,
        num_points=found.num_points3D(),
        error=found.compute_mean_reprojection_error(),
        num_models=num_models,
    )
