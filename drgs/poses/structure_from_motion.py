"""Camera poses of photographs by structure from motion, with COLMAP.

COLMAP (Schoenberger and Frahm 2016) finds features in each photograph, matches them between pairs
of photographs, and reconstructs cameras and points: one photograph after another, or all at once
(GLOMAP, Pan et al. 2024). It runs through pycolmap, in a process of its own, so that neither Ctrl-C
nor an abort of COLMAP ends this one.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from PIL import ExifTags, Image
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from drgs.core.child_process import ChildEndedError, run_in_child
from drgs.core.environment import require_module
from drgs.core.errors import UserError, format_names, note_user, one_line
from drgs.core.file_kinds import describe_file
from drgs.core.folders import FolderRecord, sole_writer
from drgs.datasets.colmap import find_model
from drgs.datasets.files import is_image, masks_of, without_masks
from drgs.datasets.folders import explain_photographs
from drgs.datasets.images import read_mask
from drgs.io.images import image_size, read_header, write_png

if TYPE_CHECKING:
    import pycolmap

SIMPLE = "SIMPLE_RADIAL"  # the model with the fewest parameters that suits photographs

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
"""Suffixes of images that COLMAP reads and that can be fitted."""

ALL_PAIRS = 100  # most photographs of which every two are compared by default

NEIGHBOURS, STRIDE = 10, 8
"""Pairs of more photographs: each with NEIGHBOURS that follow it by name and those at distances of
powers of two, and every STRIDE-th with each other."""

PHOTOGRAPHS_AT_ONCE, PAIRS_AT_ONCE = 8, 64  # per call of COLMAP, which uses all cores within one

MAX_SIDE_PX = 3200  # of photographs for features, COLMAP's default: larger ones are scaled down

GLOBAL_PASSES, KNOWN_FOCAL = 3, 0.05
"""Most global mappings, each with the lenses that the one before found, until focal lengths change
by less than that share and all photographs are placed. Relative poses of pairs depend on the
lenses: with COLMAP's guess, 15 of the fox's 50 photographs are placed wrongly, with the right ones
none. One in ten mappings with the right lenses places too few: the next draws other numbers."""

MIN_SHARED_POINTS = 30
"""Points shared by two photographs that place one another, as many as COLMAP's incremental mapper
requires to place one. Global mapping also places photographs that share none, anywhere."""

MIN_PHOTOGRAPHS = 3  # photographs with which there is a model at all

COMMAND = "poses"

MODEL_FILES = ("cameras.bin", "frames.bin", "points3D.bin", "rigs.bin", "images.bin")
"""Files in the order in which they are put in place: without the last there is no model."""

TEMPORARY = ".drgs-poses-"  # beginning of the names of temporary folders

SEED = 0

REMEDY = "if memory or the disk is full, free some of it, or take fewer or smaller photographs"

T = TypeVar("T")

Progress = Callable[[str, int, int], None]  # takes name of the items, number done, and total


@dataclass(frozen=True)
class SfmSettings:
    """Settings of structure from motion."""

    camera_model: str = "OPENCV"  # of drgs.datasets.transforms.LENS_OF_MODEL
    compare: str = "auto"  # pairs: all, neighbours by name, or auto: by ALL_PAIRS
    share: str = "alike"  # one camera for all, for all of the same size and EXIF (alike), for each
    mapper: str = "incremental"  # or global: all photographs at once

    def compares_all(self, count: int) -> bool:
        """Return whether every two of ``count`` photographs are compared."""
        return self.compare == "all" or (self.compare == "auto" and count <= ALL_PAIRS)

    def alternative_options(self, count: int) -> str:
        """Return options that may place more of ``count`` photographs, as text."""
        options = {
            "--compare all": not self.compares_all(count),
            "--share one": self.share != "one",
            f"--camera-model {SIMPLE}": self.camera_model != SIMPLE,
            "--camera-model OPENCV_FISHEYE (a fisheye)": "FISHEYE" not in self.camera_model,
            "--mapper global": self.mapper != "global",
            "--mapper incremental": self.mapper != "incremental",
        }
        return " or ".join(option for option, is_another in options.items() if is_another)


@dataclass(frozen=True)
class SfmResult:
    """Result of structure from motion."""

    names: tuple[str, ...]  # of the photographs that have a camera
    missing: tuple[str, ...]  # of the others
    cameras: tuple[str, ...]  # their models and parameters, as text
    num_points: int
    error: float  # px: mean reprojection error
    num_models: int  # unconnected ones; the largest is this


def photographs_in(folder: Path) -> tuple[Path, list[str]]:
    """Return the folder of photographs, ``folder/images`` or ``folder``, and their names there.

    Photographs that COLMAP does not read are left out, with a :class:`UserNote`.

    Raises :class:`UserError` where there are none, or one that cannot be fitted.
    """
    below = folder / "images"
    photographs = below if below.is_dir() else folder
    try:
        images = list(photographs.rglob("*") if photographs == below else photographs.iterdir())
    except OSError as error:
        kind = describe_file(folder) or f"cannot open the folder: {error.strerror or error}"
        raise UserError(f"{folder}: {kind}") from None
    images = without_masks([p for p in images if is_image(p.name) and p.is_file()])
    # "frame 10" follows "frame 9".
    parts = {path: re.split(r"([0-9]+)", str(path)) for path in images}
    images.sort(key=lambda p: [(int(t[:18]) if t.isdecimal() else 0, t) for t in parts[p]])
    files = [path for path in images if path.suffix.lower() in SUFFIXES]
    unread = [path for path in images if path.suffix.lower() not in SUFFIXES]
    others = format_names([path.relative_to(photographs) for path in unread])
    if not files:
        got = f"{others}, which COLMAP does not read; convert them to JPEG" if others else "none"
        if not others and (below := explain_photographs(folder)):
            got = f"one that {below}"
        raise UserError(
            f"{folder}: must hold photographs, or have them in a folder images, got {got}"
        )
    if others:
        note_user(f"{photographs}: left out, as COLMAP does not read them: {others}")
    for file in files:
        read_header(file)  # a fit would refuse it after hours of work
        if os.fsencode(file) != str(file).encode(errors="replace"):
            raise UserError(f"{file}: COLMAP knows names in UTF-8 only; rename it")
    return photographs, [file.relative_to(photographs).as_posix() for file in files]


def reconstruct(folder: Path, settings: SfmSettings, replace: bool, watch: Progress) -> SfmResult:
    """Write ``folder/sparse/0``, COLMAP's model of the photographs in ``folder``.

    replace: the model that is there, if it was written here; other files in that folder stay.

    Raises :class:`UserError` where no cameras are found, where a model is there that is not to be
    replaced, and while another process writes to ``folder``.
    """
    photographs, names = photographs_in(folder)
    model = folder / "sparse" / "0"
    with sole_writer(folder) as keep:
        _check_free(folder, model, replace)
        try:
            for path in (folder, model.parent, model) if keep() else ():
                for left in path.glob(f"{TEMPORARY}*"):  # of runs that were killed
                    shutil.rmtree(left, ignore_errors=True)
            # On the disk to which the files are moved.
            parent = next(path for path in (model, *model.parents) if path.is_dir())
            with tempfile.TemporaryDirectory(prefix=TEMPORARY, dir=parent) as temporary:
                task = _Reconstruction(Path(temporary), photographs, folder, names, settings)
                result = run_in_child(_Reconstruction.run, task, watch=watch)
                record = FolderRecord(model, COMMAND)
                record.claim(MODEL_FILES)
                (model / MODEL_FILES[-1]).unlink(missing_ok=True)  # or two models could be mixed
                for name in MODEL_FILES:
                    Path(temporary, "model", name).replace(model / name)
                record.seal()
        except ChildEndedError as error:
            raise UserError(
                f"{photographs}: structure from motion was ended: {error}; {REMEDY}"
            ) from None
    return result


def _check_free(folder: Path, model: Path, replace: bool) -> None:
    """Raise :class:`UserError` where a model is there, or files that are not to be replaced."""
    for path in (model.parent, model):
        if os.path.lexists(path) and not path.is_dir():
            raise UserError(f"{path}: must be a folder, got something else; move it away")
    if not replace and (present := find_model(folder)) is not None:
        fit = shlex.join(["drgs", "fit", str(folder)])
        raise UserError(
            f"{present[1]}: is there already; {fit} uses it, --overwrite writes {model}, which is "
            "then used instead"
        )
    FolderRecord(model, COMMAND).check(MODEL_FILES)


@dataclass
class _Reconstruction:
    folder: Path  # for intermediate files
    photographs: Path
    dataset: Path  # which may have masks
    names: Sequence[str]
    settings: SfmSettings
    pycolmap: ModuleType = field(init=False)
    watch: Progress = field(init=False)

    def run(self, watch: Progress) -> SfmResult:
        """Write ``folder/model``: the function of the child process."""
        self.watch = watch
        self.pycolmap = require_module("pycolmap", "colmap", "structure from motion")
        self.pycolmap.logging.minloglevel = 3  # errors are reported below
        try:
            model, count = self.largest()
            written = self.folder / "model"
            written.mkdir()
            model.write_binary(written)
            return _summarize(model, self.names, count)
        except UserError:
            raise
        except (RuntimeError, ValueError) as error:  # pycolmap's, also for errors of the user
            raise UserError(
                f"{self.photographs}: structure from motion failed: COLMAP reports: "
                f"{one_line(error, 500)}; {REMEDY}"
            ) from None

    def largest(self) -> tuple[pycolmap.Reconstruction, int]:
        """Return the largest reconstruction, and the number of all."""
        if len(self.names) < MIN_PHOTOGRAPHS:
            raise UserError(
                f"{self.photographs}: at least {MIN_PHOTOGRAPHS} photographs, got "
                f"{len(self.names)}; take 30 or more, each showing most of what its neighbours show"
            )
        self.pycolmap.Database.open(self.database).close()
        self._extract()
        self._match()
        models = self._map_globally() if self.settings.mapper == "global" else self._map()
        if not models or max(m.num_reg_images() for m in models) < MIN_PHOTOGRAPHS:
            raise UserError(
                f"{self.photographs}: no cameras were found; take more photographs, neither "
                "blurred nor of something plain, each showing most of what its neighbours show, "
                "while walking around (not turning on the spot), or try "
                f"{self.settings.alternative_options(len(self.names))}"
            )
        return max(models, key=lambda m: (m.num_reg_images(), m.num_points3D())), len(models)

    @property
    def database(self) -> Path:
        return self.folder / "database.db"

    def _chunks(
        self, what: str, items: Sequence[T], size: int, done: int, total: int
    ) -> Iterator[Sequence[T]]:
        """Yield ``items`` in chunks of ``size``, counted from ``done`` of ``total``."""
        for start in range(0, len(items), size):
            self.watch(what, done + start, total)
            yield items[start : start + size]
        self.watch(what, done + len(items), total)

    def _extract(self) -> None:
        """Extract features of all photographs, groups of which share a camera."""
        pycolmap, done = self.pycolmap, 0
        options = pycolmap.FeatureExtractionOptions()
        options.max_image_size = MAX_SIDE_PX
        masks = self._masks_for_all()
        for group in self._groups():
            reader = pycolmap.ImageReaderOptions()
            reader.camera_model = self.settings.camera_model
            if masks is not None:
                reader.mask_path = masks
            self.watch("photograph", done, len(self.names))
            # In this order: threads would number the photographs in the order of their ends.
            mode = pycolmap.CameraMode.SINGLE
            pycolmap.import_images(self.database, self.photographs, mode, group, reader)
            sizes = PHOTOGRAPHS_AT_ONCE, done, len(self.names)
            for chunk in self._chunks("photograph", group, *sizes):
                pycolmap.extract_features(
                    self.database, self.photographs, chunk, mode, reader, options
                )
                self._check_features(chunk)
            done += len(group)

    def _groups(self) -> list[list[str]]:
        sizes = sorted({image_size(self.photographs / name) for name in self.names})
        if self.settings.share == "one" and len(sizes) > 1:
            (w, h), (other_w, other_h), *_ = sizes
            raise UserError(
                f"{self.photographs}: photographs that share one camera must have one size, got "
                f"{w} x {h} and {other_w} x {other_h} px; use --share alike"
            )
        groups: dict[object, list[str]] = {}
        for name in self.names:
            key = {"one": 0, "each": name}.get(self.settings.share)
            key = _size_and_lens(self.photographs / name) if key is None else key
            groups.setdefault(key, []).append(name)
        return list(groups.values())

    def _check_features(self, names: Sequence[str]) -> None:
        """Raise :class:`UserError` where COLMAP has left out a photograph."""
        with self.pycolmap.Database.open(self.database) as database:
            for name in names:
                image = database.read_image_with_name(name)
                if image is None or not database.exists_keypoints(image.image_id):
                    raise UserError(
                        f"{self.photographs / name}: COLMAP cannot read this photograph, or its "
                        "mask; convert it, or take it away"
                    )

    def _masks_for_all(self) -> Path | None:
        """Return a folder with a mask for each photograph; None: there are none.

        Photographs without one, which COLMAP would leave out, have white ones.
        """
        masks = masks_of(self.dataset, self.names, [], self.photographs)
        if not any(masks):
            return None
        folder = self.folder / "masks"
        for name, file in zip(self.names, masks, strict=True):
            target = folder / f"{name}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            size = image_size(self.photographs / name)
            write_png(target, np.ones(size[::-1]) if file is None else read_mask(file, size))
        return folder

    def _match(self) -> None:
        """Compare pairs, for which photographs are named by numbers.

        COLMAP's lists of pairs have spaces between names, which may contain some.
        """
        pycolmap, pairs = self.pycolmap, list(self._pairs())
        options = pycolmap.ImportedPairingOptions()
        options.match_list_path = self.folder / "pairs.txt"
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = SEED
        numbers = list(map(str, range(len(self.names))))
        self._rename(self.names, numbers)
        for chunk in self._chunks("pair of photographs", pairs, PAIRS_AT_ONCE, 0, len(pairs)):
            options.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in chunk))
            pycolmap.match_image_pairs(
                self.database, pairing_options=options, verification_options=verification
            )
        self._rename(numbers, self.names)

    def _rename(self, old: Sequence[str], new: Sequence[str]) -> None:
        with self.pycolmap.Database.open(self.database) as database:
            images = {image.name: image for image in database.read_all_images()}
            for name, new_name in zip(old, new, strict=True):
                images[name].name = new_name
                database.update_image(images[name])

    def _pairs(self) -> Iterator[tuple[int, int]]:
        count = len(self.names)
        compares_all = self.settings.compares_all(count)
        steps = {*range(1, NEIGHBOURS + 1), *(2**k for k in range(count.bit_length()))}
        for i, j in combinations(range(count), 2):
            if compares_all or j - i in steps or (i % STRIDE == 0 and j % STRIDE == 0):
                yield i, j

    def _map(self) -> list[pycolmap.Reconstruction]:
        options = self.pycolmap.IncrementalPipelineOptions()
        options.random_seed = SEED
        total, placed = len(self.names), 0

        def count(number: int) -> None:
            nonlocal placed
            placed = min(number, total)
            self.watch("camera", placed, total)

        models = self.pycolmap.incremental_mapping(
            self.database,
            self.photographs,
            self.folder / "models",
            options=options,
            initial_image_pair_callback=lambda: count(2),
            next_image_callback=lambda: count(placed + 1),
        )
        return list(models.values())

    def _map_globally(self) -> list[pycolmap.Reconstruction]:
        """Return reconstructions of all photographs at once: of several passes, the largest."""
        pycolmap, best = self.pycolmap, []
        calibration = pycolmap.ViewGraphCalibrationOptions()
        options = pycolmap.GlobalPipelineOptions()
        for done in range(GLOBAL_PASSES):
            self.watch("global mapping", done, GLOBAL_PASSES)
            calibration.random_seed = options.random_seed = SEED + done
            pycolmap.calibrate_view_graph(self.database, calibration)
            folder = self.folder / f"models {done}"
            mapped = pycolmap.global_mapping(self.database, self.photographs, folder, options)
            models = sorted(mapped.values(), key=_keep_connected)
            if models and (not best or models[-1].num_reg_images() >= best[-1].num_reg_images()):
                best = models
            known = self._set_lenses(models) < KNOWN_FOCAL
            if known and best and best[-1].num_reg_images() == len(self.names):
                break
        self.watch("global mapping", GLOBAL_PASSES, GLOBAL_PASSES)
        return best

    def _set_lenses(self, models: Sequence[pycolmap.Reconstruction]) -> float:
        """Write lenses to the database, of several the last model's; return the largest change.

        The change is of focal lengths, as a share of these.
        """
        change = 0.0
        with self.pycolmap.Database.open(self.database) as database:
            before = {c.camera_id: c.mean_focal_length() for c in database.read_all_cameras()}
            for number, camera in ((n, c) for model in models for n, c in model.cameras.items()):
                change = max(change, abs(camera.mean_focal_length() / before[number] - 1))
                camera.has_prior_focal_length = True
                database.update_camera(camera)
        return change


def _keep_connected(model: pycolmap.Reconstruction) -> int:
    """Remove all but the largest group of photographs that share points; return its size."""
    numbers = np.array(sorted(model.reg_image_ids()))
    tracks = [point.track.elements for point in model.points3D.values()]
    points = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    images = np.array([element.image_id for track in tracks for element in track], np.int64)
    places = np.searchsorted(numbers, images), points
    sees = csr_array((np.ones(len(points)), places), shape=(len(numbers), len(tracks)))
    sees.data[:] = 1  # a track may have two features of a photograph
    _, groups = connected_components((sees @ sees.T) >= MIN_SHARED_POINTS)
    for number in numbers[groups != np.bincount(groups).argmax()]:
        model.deregister_frame(model.image(number).frame_id)
    return model.num_reg_images()


def _size_and_lens(file: Path) -> tuple[object, ...]:
    """Return a key of photographs of one size and, as far as EXIF shows, one lens."""
    tags = ExifTags.Base
    try:
        with Image.open(file) as image:
            exif = image.getexif()
            details = exif.get_ifd(ExifTags.IFD.Exif)
            lens = (exif.get(tags.Make), exif.get(tags.Model), details.get(tags.FocalLength))
    except Exception:  # Pillow raises many types for broken EXIF, which is ignored
        lens = ()
    return *image_size(file), *map(str, lens)


def _summarize(model: pycolmap.Reconstruction, names: Sequence[str], num_models: int) -> SfmResult:
    placed = {image.name for image in model.images.values() if image.has_pose}
    cameras = tuple(
        f"{camera.model.name} {camera.width} x {camera.height} px "
        f"({camera.params_info.replace(' ', '')}: "
        f"{', '.join(f'{value:.5g}' for value in camera.params)})"
        for _, camera in sorted(model.cameras.items())
    )
    return SfmResult(
        names=tuple(name for name in names if name in placed),
        missing=tuple(name for name in names if name not in placed),
        cameras=cameras,
        num_points=model.num_points3D(),
        error=model.compute_mean_reprojection_error(),
        num_models=num_models,
    )
