"""Check which effects an examination chooses for spoiled photographs, and what they are worth.

    python scenes/studies/examination.py scenes/lego FOX ROBOT_HEAD --only alarms
    python scenes/studies/examination.py scenes/lego FOX ROBOT_HEAD --only fits

Training photographs are spoiled in a known way, at three strengths, and examined: table 1 counts
how often each effect is chosen, over ten pairs of folder and random numbers. Table 2 has fits with
and without the choice, measured on test photographs that are not spoiled.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drgs
import numpy as np
from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig
from drgs.datasets.folders import config_for
from drgs.datasets.types import Dataset, View
from drgs.examine.examination import Examination, with_background
from drgs.io.images import read_image
from drgs.results.alignment import align
from scipy.spatial.transform import Rotation

NUM_CASES = 10
BACKGROUND = np.array([0.3, 0.55, 0.4])  # display space
NOTHING = "nothing"

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


@dataclass(frozen=True)
class Effect:
    """An effect that is spoiled, and the name under which an examination lists it."""

    name: str
    listed: str
    spoil: Spoil
    strengths: tuple[float, float, float]  # just visible, between, strong
    unit: str


EFFECTS = (
    Effect("exposure", "exposure and white balance", spoil_exposure, (0.03, 0.1, 0.2), ""),
    Effect(
        "white balance", "exposure and white balance", spoil_white_balance, (0.02, 0.1, 0.2), ""
    ),
    Effect("poses", "camera refinement", spoil_pose, (0.1, 0.2, 0.5), "°"),
    Effect("background", "background of one colour", spoil_background, (0.1, 0.3, 1.0), ""),
)

MIXES: tuple[tuple[int, tuple[tuple[Spoil, float], ...]], ...] = (
    (0, ((spoil_exposure, 0.15), (spoil_pose, 0.3))),
    (0, ((spoil_background, 1.0), (spoil_white_balance, 0.1))),
    (1, ((spoil_exposure, 0.15), (spoil_pose, 0.3))),
)
"""Mixed effects of table 2, with the place of the folder."""


def load(folder: Path) -> tuple[FitConfig, Dataset]:
    """Return configuration and dataset of ``drgs fit FOLDER``."""
    config, _ = config_for(folder)
    return config, drgs.load_dataset(config.data_for_training)


def spoiled(dataset: Dataset, spoil: Spoil, strength: float, seed: int) -> Dataset:
    """Return the dataset with its training views spoiled."""
    rng = np.random.default_rng(seed)
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


def examine(config: FitConfig, dataset: Dataset, seed: int) -> Examination:
    """Return the examination with other random numbers in its short fits."""
    return drgs.examine(dataset, config.model_copy(update={"seed": seed}))


def count_alarms(folders: Sequence[Path]) -> Iterator[str]:
    """Yield table 1, row by row."""
    loaded = [load(folder) for folder in folders]
    yield "| effect | strength | chosen | gain when tried, dB | seconds |"
    yield "| --- | --- | --- | --- | --- |"
    for effect in (None, *EFFECTS):
        cut_out = effect is not None and effect.spoil is spoil_background
        usable = [pair for pair in loaded if not cut_out or pair[1].train[0].alpha is not None]
        for strength in (0.0,) if effect is None else effect.strengths:
            chosen, gains, seconds, others = 0, [], [], []
            for seed in range(NUM_CASES):
                config, dataset = usable[seed % len(usable)]
                if effect is not None:
                    dataset = spoiled(dataset, effect.spoil, strength, seed)
                found = examine(config, dataset, seed)
                seconds.append(found.wall_s)
                chosen += effect is None and bool(found.changes)
                for one in found.decisions:
                    is_it = effect is not None and one.effect == effect.listed
                    chosen += one.chosen and is_it
                    if one.chosen and not is_it:
                        others.append(one.effect)
                    if is_it and one.gain is not None:
                        gains.append(one.gain)
            name, unit = (NOTHING, "") if effect is None else (effect.name, effect.unit)
            gain = f"{min(gains):+.2f} to {max(gains):+.2f} ({len(gains)})" if gains else ""
            besides = f"; besides: {', '.join(others)}" if others and effect else ""
            yield (
                f"| {name} | {strength:g}{unit} | {chosen} of {NUM_CASES}{besides} | {gain} | "
                f"{min(seconds):.0f} to {max(seconds):.0f} |"
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
            dataset = spoiled(dataset, spoil, strength, seed=0)
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
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", type=Path, nargs="+", help="datasets; the first one is cut out")
    parser.add_argument("--only", choices=("alarms", "fits"))
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    if args.only != "fits":
        for line in count_alarms(args.folders):
            print(line, flush=True)
    if args.only != "alarms":
        for line in compare_fits(args.folders):
            print(line, flush=True)


if __name__ == "__main__":
    main()
