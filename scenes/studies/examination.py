"""Check which effects an examination chooses for spoiled photographs, and what they are worth.

    python scenes/studies/examination.py scenes/lego FOX ROBOT_HEAD --only alarms
    python scenes/studies/examination.py scenes/lego FOX ROBOT_HEAD --only fits

Training photographs are spoiled in a known way, at three strengths, and examined: table 1 counts
how often each effect is chosen or named, over ten pairs of folder and random numbers, and how often
anything is without an effect, also in five kinds of path traced photographs. It takes hours: rows
are appended to a CSV file, and the same command continues. Table 2 has fits with and without the
choice, measured on test photographs that are not spoiled.
"""

from __future__ import annotations

import argparse
import csv
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drgs
import numpy as np
from clean_sets import KINDS, ROOM, clean_set
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cli.execution import select_variant
from drgs.config.changes import with_changes
from drgs.config.load import config_from
from drgs.config.schema import FitConfig
from drgs.core.environment import VARIANTS
from drgs.datasets.folders import config_for
from drgs.datasets.types import Dataset, View
from drgs.examine.examination import Decision
from drgs.examine.short_fits import with_background
from drgs.io.images import read_image
from drgs.results.alignment import align
from scipy import ndimage
from scipy.spatial.transform import Rotation

NUM_CASES = 10
BACKGROUND = np.array([0.3, 0.55, 0.4])  # display space
NOTHING = "nothing"
CLEAN_KINDS = tuple(kind.replace(" ", "_") for kind in KINDS)
CLEAN_ITERATIONS = 3000
ROWS = Path("out/examination.csv")

Spoil = Callable[[View, float, np.random.Generator], View]


def _with_image(view: View, image: np.ndarray) -> View:
    """Return the view with another image, where it is opaque."""
    before = np.asarray(view.image)
    if view.alpha is not None:
        image = before + np.asarray(view.alpha)[..., None] * (image - before)
    return replace(view, image=np.clip(image, 0, 1).astype(np.float32))


def spoil_exposure(view: View, strength: float, rng: np.random.Generator) -> View:
    """Multiply by exp(strength x), x normal."""
    return _with_image(view, np.asarray(view.image) * np.exp(strength * rng.normal()))


def spoil_white_balance(view: View, strength: float, rng: np.random.Generator) -> View:
    """Multiply each channel by exp(strength x), x normal."""
    return _with_image(view, np.asarray(view.image) * np.exp(strength * rng.normal(size=3)))


def spoil_pose(view: View, strength: float, rng: np.random.Generator) -> View:
    """Turn the camera about each of its axes, by strength x, degrees."""
    pose = view.camera_to_world.copy()
    turn = Rotation.from_rotvec(strength * rng.normal(size=3), degrees=True)
    pose[:3, :3] = pose[:3, :3] @ turn.as_matrix()
    return replace(view, camera_to_world=pose)


def spoil_background(view: View, strength: float, rng: np.random.Generator) -> View:
    """Make it opaque, on a colour that is as far from black as ``strength`` says."""
    del rng
    alpha = np.asarray(view.alpha)[..., None]
    image = np.asarray(view.image) - (1 - alpha) + (1 - alpha) * strength * BACKGROUND
    return replace(view, image=image.astype(np.float32), alpha=None)


def spoil_vignetting(view: View, strength: float, rng: np.random.Generator) -> View:
    """Darken the corners by ``strength``, and the rest with the squared radius."""
    del rng
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    squares = np.square(x - view.width / 2) + np.square(y - view.height / 2)
    squares *= 4 / (view.width**2 + view.height**2)
    return _with_image(view, np.asarray(view.image) * (1 - strength * squares[..., None]))


def spoil_response(view: View, strength: float, rng: np.random.Generator) -> View:
    """Take it by one of two cameras, with the exponents exp(strength) and exp(-strength)."""
    sign = rng.choice([-1.0, 1.0])
    image = np.clip(np.asarray(view.image), 0, 1) ** np.exp(sign * strength)
    return replace(_with_image(view, image), fx=view.fx * (1 + 1e-6 * sign))


def spoil_focal(view: View, strength: float, rng: np.random.Generator) -> View:
    """Give the camera focal lengths that are too long by ``strength``."""
    del rng
    return replace(view, fx=view.fx * (1 + strength), fy=view.fy * (1 + strength))


def spoil_distortion(view: View, strength: float, rng: np.random.Generator) -> View:
    """Give the camera a distortion k1, relative to half the diagonal, that it does not have."""
    del rng
    old = {} if view.lens is None else view.lens.coefficients()
    reach = (view.width**2 + view.height**2) / 4 / view.fx**2
    values = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0} | old
    values["k1"] += strength / reach
    return replace(view, lens=RadialTangential.from_coefficients(**values))


def blur(view: View, strength: float) -> View:
    """Blur it by ``strength``, thousandths of its width."""
    sigma = strength * view.width / 1000
    image = ndimage.gaussian_filter(np.asarray(view.image), (sigma, sigma, 0))
    return _with_image(view, image)


def overexpose(view: View, strength: float) -> View:
    """Multiply its brightness by 1 + strength."""
    return _with_image(view, np.asarray(view.image) * (1 + strength))


def put_finger(view: View, strength: float) -> View:
    """Cover this share of it, from a corner, with a brown disc."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    radius = np.sqrt(strength * view.width * view.height * 4 / np.pi)
    soft = np.clip((radius - np.hypot(x, y)) / (0.03 * view.width) + 0.5, 0, 1)[..., None]
    image = np.asarray(view.image) * (1 - soft) + soft * np.array([0.45, 0.3, 0.25])
    alpha = None if view.alpha is None else np.maximum(view.alpha, soft[..., 0])
    return replace(view, image=image.astype(np.float32), alpha=alpha)


def put_mover(view: View, strength: float, rng: np.random.Generator) -> View:
    """Put a thing of its own colour somewhere: a disc of this share of the photograph."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    radius = np.sqrt(strength * view.width * view.height / np.pi)
    places = rng.uniform(0.2, 0.8, 2) * (view.width, view.height)
    is_there = (np.hypot(x - places[0], y - places[1]) < radius)[..., None]
    image = np.where(is_there, rng.uniform(0, 1, 3), np.asarray(view.image))
    alpha = None if view.alpha is None else np.maximum(view.alpha, is_there[..., 0])
    return replace(view, image=image.astype(np.float32), alpha=alpha)


Bad = tuple[Dataset, set[str]]  # a dataset, and names of photographs that are bad
SpoilDataset = Callable[[Dataset, float, np.random.Generator, Dataset], Bad]


def each(spoil: Spoil) -> SpoilDataset:
    """Spoil all training photographs."""

    def change(dataset: Dataset, strength: float, rng: np.random.Generator, _: Dataset) -> Bad:
        return spoiled(dataset, spoil, strength, rng), set()

    return change


def some(spoil: Callable[[View, float], View], count: int = 2) -> SpoilDataset:
    """Spoil so many training photographs."""

    def change(dataset: Dataset, strength: float, rng: np.random.Generator, _: Dataset) -> Bad:
        train = list(dataset.train)
        chosen = rng.choice(len(train), count, replace=False)
        for index in chosen:
            train[index] = spoil(train[index], strength)
        return replace(dataset, train=tuple(train)), {train[index].name for index in chosen}

    return change


def swap(dataset: Dataset, strength: float, rng: np.random.Generator, _: Dataset) -> Bad:
    """Exchange the images of ``strength`` pairs of views."""
    train, bad = list(dataset.train), set()
    for a, b in rng.choice(len(train), (round(strength), 2), replace=False):
        one, other = train[a], train[b]
        train[a] = replace(one, image=other.image, alpha=other.alpha)
        train[b] = replace(other, image=one.image, alpha=one.alpha)
        bad |= {one.name, other.name}
    return replace(dataset, train=tuple(train)), bad


def replace_some(
    dataset: Dataset, strength: float, rng: np.random.Generator, other: Dataset
) -> Bad:
    """Replace the images of ``strength`` views by those of another place."""
    train, bad = list(dataset.train), set()
    for index in rng.choice(len(train), round(strength), replace=False):
        view = train[index]
        photograph = np.asarray(other.train[index % len(other.train)].image)
        rows = np.arange(view.height) * photograph.shape[0] // view.height
        columns = np.arange(view.width) * photograph.shape[1] // view.width
        alpha = None if view.alpha is None else np.ones((view.height, view.width), np.float32)
        train[index] = replace(view, image=photograph[rows[:, None], columns], alpha=alpha)
        bad.add(view.name)
    return replace(dataset, train=tuple(train)), bad


def roll_shutter(dataset: Dataset, strength: float, rng: np.random.Generator, _: Dataset) -> Bad:
    """Read rows one after the other while each camera turns to the side, at speeds that differ.

    strength: standard deviation of the shift between first and last row, of the width.
    """
    train = []
    for view in dataset.train:
        shift = strength * view.width * rng.normal()
        rows, columns = np.indices((view.height, view.width))
        at = [rows, columns + shift * (rows / view.height - 0.5)]
        planes = np.moveaxis(np.asarray(view.image), 2, 0)
        moved = [ndimage.map_coordinates(plane, at, order=1, mode="nearest") for plane in planes]
        train.append(replace(view, image=np.stack(moved, axis=2).astype(np.float32)))
    return replace(dataset, train=tuple(train)), set()


@dataclass(frozen=True)
class Effect:
    """An effect that is spoiled, and the name under which an examination lists it."""

    name: str
    listed: str
    spoil: SpoilDataset
    strengths: tuple[float, float, float]  # half as strong, strong, twice as strong
    unit: str = ""


COLORS, BAD = "exposure and white balance", "bad photographs"

EFFECTS = (
    Effect("exposure", COLORS, each(spoil_exposure), (0.05, 0.1, 0.2)),
    Effect("white balance", COLORS, each(spoil_white_balance), (0.05, 0.1, 0.2)),
    Effect("poses", "camera refinement", each(spoil_pose), (0.15, 0.3, 0.6), "°"),
    Effect("background", "background of one colour", each(spoil_background), (0.15, 0.3, 0.6)),
    Effect("vignetting", "vignetting", each(spoil_vignetting), (0.15, 0.3, 0.6)),
    Effect("response", "response", each(spoil_response), (0.05, 0.1, 0.2)),
    Effect("focal length", "focal length", each(spoil_focal), (0.02, 0.04, 0.08)),
    Effect("distortion", "distortion", each(spoil_distortion), (0.025, 0.05, 0.1)),
    Effect("blurred", BAD, some(blur), (6.0, 12.0, 24.0), " of 1000"),
    Effect("overexposed", BAD, some(overexpose), (0.5, 1.0, 2.0)),
    Effect("finger", BAD, some(put_finger), (0.06, 0.12, 0.24)),
    Effect("swapped", BAD, swap, (1, 2, 4), " pairs"),
    Effect("of another place", BAD, replace_some, (1, 2, 4)),
    Effect("moving things", "things that move", each(put_mover), (0.02, 0.04, 0.08)),
    Effect("rolling shutter", "rolling shutter", roll_shutter, (0.01, 0.02, 0.04)),
)

MIXES: tuple[tuple[int, tuple[tuple[Spoil, float], ...]], ...] = (
    (0, ((spoil_exposure, 0.15), (spoil_pose, 0.3))),
    (0, ((spoil_background, 1.0), (spoil_white_balance, 0.1))),
    (1, ((spoil_exposure, 0.15), (spoil_pose, 0.3))),
)
"""Mixed effects of table 2, with the place of the folder."""


def load(folder: Path) -> tuple[FitConfig, Dataset]:
    """Return configuration and dataset of ``drgs fit FOLDER``, or of a clean set."""
    kind, _, seed = folder.name.partition("@")
    if kind in CLEAN_KINDS and seed:
        values = {"data": {"path": "."}, "iterations": CLEAN_ITERATIONS}
        if kind == "panoramas":
            values["init"] = {"half_extent": ROOM}
        config = config_from(values, "study")
        return config, clean_set(kind.replace("_", " "), int(seed))
    config, _ = config_for(folder)
    return config, drgs.load_dataset(config.data_for_training)


def spoiled(
    dataset: Dataset, spoil: Spoil, strength: float, rng: np.random.Generator | int
) -> Dataset:
    """Return the dataset with its training views spoiled."""
    rng = np.random.default_rng(rng)
    train = tuple(spoil(view, strength, rng) for view in dataset.train)
    if spoil is spoil_background:
        test = []
        for view in dataset.test:  # readers keep no alpha of test images, which are over white
            alpha = opacity_of(view)
            test.append(spoil(replace(view, alpha=alpha), strength, rng))
        dataset = replace(dataset, test=tuple(test), background=(0.0, 0.0, 0.0))
    return replace(dataset, train=train)


def opacity_of(view: View) -> np.ndarray:
    """Return the opacity (H, W) that the view's file has."""
    return read_image(view.files["image"])[..., 3]


FIELDS = ("effect", "strength", "seed", "set", "chosen", "gain", "others", "bad", "seconds")


def alarms(
    folders: Sequence[Path], seeds: Sequence[int]
) -> Iterator[tuple[str, float, int, Path, Effect | None]]:
    """Yield all cases of table 1, seed by seed, those of the middle strength first."""
    for places in ((1,), (0, 2)):
        for seed in seeds:
            for folder in (
                *(Path(f"{k}@{seed}") for k in CLEAN_KINDS),
                folders[seed % len(folders)],
            ):
                if places == (1,):
                    yield NOTHING, 0.0, seed, folder, None
            for effect in EFFECTS:
                usable = folders[:1] if effect.name == "background" else folders
                if effect.name == "vignetting":  # of a thing in the middle, it cannot be told
                    usable = [*folders[1:], Path(f"glossy@{seed}")]
                for place in places:
                    folder = usable[seed % len(usable)]
                    yield effect.name, effect.strengths[place], seed, folder, effect


def measure_alarms(
    folders: Sequence[Path], path: Path, seeds: Sequence[int], only: str | None
) -> None:
    """Append a row to a CSV file for each case that it lacks."""
    done = set()
    if path.exists():
        with path.open(newline="") as file:
            done = {(r["effect"], r["strength"], r["seed"], r["set"]) for r in csv.DictReader(file)}
    else:
        path.write_text(",".join(FIELDS) + "\n")
    for name, strength, seed, folder, effect in alarms(folders, seeds):
        key = name, f"{strength:g}", str(seed), folder.name
        if key in done or only not in (None, name):
            continue
        config, dataset = load(folder)
        bad: set[str] = set()
        if effect is not None:
            other = load(folders[(seed + 1) % len(folders)])[1]
            rng = np.random.default_rng(seed)
            dataset, bad = effect.spoil(dataset, strength, rng, other)
        found = drgs.examine(dataset, config.model_copy(update={"seed": seed}))
        listed = "" if effect is None else effect.listed
        decisions = {one.effect: one for one in found.decisions}
        it = decisions.get(listed)
        others = [o.effect for o in found.decisions if o.chosen and o.effect != listed]
        told = [o.effect for o in found.decisions if not o.chosen and is_named(o)]
        named = set(found.bad_photographs)
        row = {
            "effect": name,
            "strength": key[1],
            "seed": seed,
            "set": folder.name,
            "chosen": "" if it is None else "chosen" if it.chosen else "named" * is_named(it),
            "gain": "" if it is None or it.gain is None else f"{it.gain:.3f}",
            "others": " + ".join(others + [f"({each})" for each in told if each != listed]),
            "bad": f"{len(named & bad)} of {len(bad)} and {len(named - bad)} others",
            "seconds": f"{found.wall_s:.0f}" if not found.note else found.note,
        }
        with path.open("a", newline="") as file:
            csv.DictWriter(file, FIELDS).writerow(row)


def is_named(decision: Decision) -> bool:
    """Return whether the table has a remedy in this row, although no fit has it by itself."""
    return bool(decision.advice)


def table_of_alarms(path: Path) -> Iterator[str]:
    """Yield table 1, row by row."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    yield "| effect | strength | chosen | named | gain when tried, dB | besides | seconds |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    groups: dict[tuple[str, float], list[dict[str, str]]] = {}
    for row in rows:
        name = row["set"].partition("@")[0] if row["effect"] == NOTHING else ""
        name = name if name in CLEAN_KINDS else ""
        label = f"{row['effect']}{': ' if name else ''}{name.replace('_', ' ')}"
        groups.setdefault((label, float(row["strength"])), []).append(row)
    order = {effect.name: index for index, effect in enumerate(EFFECTS)}
    for (label, strength), cases in sorted(
        groups.items(), key=lambda g: (order.get(g[0][0], -1), g[0])
    ):
        unit = next((effect.unit for effect in EFFECTS if effect.name == label), "")
        gains = [float(row["gain"]) for row in cases if row["gain"]]
        gain = f"{min(gains):+.2f} to {max(gains):+.2f} ({len(gains)})" if gains else ""
        seconds = [int(row["seconds"]) for row in cases if row["seconds"].isdigit()]
        besides = Counter(e for row in cases for e in row["others"].split(" + ") if e)
        count = {what: sum(row["chosen"] == what for row in cases) for what in ("chosen", "named")}
        if label.startswith(NOTHING):
            count["chosen"] = sum(
                any(e and e[0] != "(" for e in row["others"].split(" + ")) for row in cases
            )
            count["named"] = sum("(" in row["others"] for row in cases)
        yield (
            f"| {label} | {strength:g}{unit} | {count['chosen']} of {len(cases)} | "
            f"{count['named']} | {gain} | "
            f"{', '.join(f'{n} x {name}' for name, n in besides.items())} | "
            f"{min(seconds, default=0)} to {max(seconds, default=0)} |"
        )


def quality(config: FitConfig, dataset: Dataset) -> tuple[float, float, float]:
    """Fit; return the test views' PSNR as it is and with cameras' differences removed; seconds."""
    started = time.perf_counter()
    fitted = drgs.train(config, dataset)
    seconds = time.perf_counter() - started
    pairs = list(zip(dataset.test, fitted.trainer.images(dataset.test), strict=True))
    errors = [np.mean(np.square(np.asarray(v.image) - np.asarray(i))) for v, i in pairs]
    aligned = [align(view, np.asarray(image)).psnr for view, image in pairs]
    return float(np.mean(-10 * np.log10(errors))), float(np.mean(aligned)), seconds


def compare_fits(folders: Sequence[Path]) -> Iterator[str]:
    """Yield table 2, row by row."""
    yield "| photographs | chosen | test views | camera's differences removed | seconds |"
    yield "| --- | --- | --- | --- | --- |"
    cases = [(place, ()) for place in range(len(folders))]
    for place, mix in (*cases, *MIXES):
        config, dataset = load(folders[place])
        for spoil, strength in mix:
            dataset = spoiled(dataset, spoil, strength, 0)
        names = ", ".join(f"{s.__name__.removeprefix('spoil_')} {x:g}" for s, x in mix)
        found = drgs.examine(dataset, config)
        row = f"| {folders[place].name}{': ' if names else ''}{names.replace('_', ' ')} | "
        if not found.changes:
            yield f"{row}nothing | the same fit | | {found.wall_s:.0f} for the examination |"
            continue
        before = quality(config, dataset)
        changed = with_changes(config, found.changes)
        after = quality(changed, with_background(dataset, changed))
        text = ", ".join(found.changes)
        numbers = (f"{a:.2f} to {b:.2f} dB" for a, b in zip(before[:2], after[:2], strict=True))
        seconds = f"{before[2]:.0f} and {after[2]:.0f}, {found.wall_s:.0f} for the examination"
        yield f"{row}{text} | {' | '.join(numbers)} | {seconds} |"


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", type=Path, nargs="+", help="datasets; the first one is cut out")
    parser.add_argument("--only", choices=("alarms", "fits"))
    parser.add_argument("--rows", type=Path, default=ROWS, help="CSV file of table 1, continued")
    parser.add_argument("--effect", help="measure this one alone")
    parser.add_argument(
        "--seeds", default=f"0:{NUM_CASES}", metavar="FIRST:END", help="random ones"
    )
    args = parser.parse_args()
    seeds = range(*map(int, args.seeds.split(":")))
    warnings.simplefilter("ignore")
    select_variant(VARIANTS[0])
    if args.only != "fits":
        measure_alarms(args.folders, args.rows, seeds, args.effect)
        print("\n".join(table_of_alarms(args.rows)))
    if args.only != "alarms":
        for line in compare_fits(args.folders):
            print(line, flush=True)


if __name__ == "__main__":
    main()
