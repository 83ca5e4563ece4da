"""Attacks by options that do not go together, and by folders that are somebody's."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from functools import partial
from itertools import combinations
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import yaml

from support.attacks.attack import Attack
from support.attacks.attack_folder import CAPTURE, SETTINGS

FIT_OPTIONS = """
    fit.yml; --resume stopped; --data lego; --out out; --overwrite; --set seed=1; --threads 1;
    --budget 0.01s; --leave-out train/r_1
"""
"""Arguments of ``fit`` that are valid on their own."""

RENDER_OPTIONS = """
    --split test; --orbit 2; --camera camera.json; --origin 3 0 1; --target 0 0 0.5; --up 0 1 0;
    --fov 50; --size 8 6; --background black; --background sky.png; --ignore motion;
    --scene photos.yml; --data lego; --set data.image_size=10; --define a=b; --threads 1;
    --variant scalar_rgb
"""

SUBJECTS = ("run", "gaussians.ply", "splats.xml", "stopped", "photos")


def _pairs(options: str) -> Iterator[tuple[str, ...]]:
    for left, right in combinations(options.split(";"), 2):
        yield (*left.split(), *right.split())


def combination_attacks() -> Iterator[Attack]:
    """Every two options of ``fit``, and every two of ``render`` for each kind of subject."""
    for words in _pairs(FIT_OPTIONS):
        out = "stopped" if "--resume" in words else "out"
        yield Attack(f"together/fit/{' '.join(words)}", "fit", words, out=out)
    for subject in SUBJECTS:
        for pair in _pairs(RENDER_OPTIONS):
            words = (subject, *pair)
            yield Attack(f"together/render/{' '.join(words)}", "render", (*words, "--out", "out"))


COMMANDS = {
    "fit": ("fit", ("fit.yml",)),
    "fit over": ("fit", ("fit.yml", "--overwrite")),
    "fit photographs": ("fit", ("photos.yml", "--overwrite")),
    "split": ("render", ("run",)),
    "orbit": ("render", ("gaussians.ply", "--orbit", "2", "--size", "8", "6")),
    "camera": ("render", ("gaussians.ply", "--camera", "camera.json")),
    "origin": ("render", ("gaussians.ply", "--origin", "3", "0", "1", "--size", "8", "6")),
    "scene": ("render", ("splats.xml",)),
    "capture": ("capture", CAPTURE),
}
"""Every way to write a folder; ``--out`` is added."""

FOREIGN = """
    config.yml metrics.json point_cloud.ply checkpoint.npz report.html viewer.html plan.txt
    point_cloud_drgs.ply history.csv density.csv cameras.json orbit.webp orbit.gif orbit_0.png
    orbit_000.png camera.png camera_0.png
    r_0.png splats.png splats.exr capture.json points3d.ply transforms_train.json
    train/r_0.png renders/test/r_0.png renders/test/mine.png side_by_side/notes.txt renders/keep
    thesis.tex .hidden
"""
"""Files of the user's that a folder might hold, some of them named as those that commands write."""


def _add(file: str, folder: Path) -> None:
    path = folder / "out" / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("mine")


def _add_to_result(file: str, folder: Path) -> None:
    shutil.copytree(folder / "run", folder / "out")
    _add(file, folder)


def _link(target: str, folder: Path) -> None:
    (folder / "out").symlink_to(folder / target)


def _config_inside(folder: Path) -> None:
    values = {"data": {"path": "../lego"}, "init": {"point_cloud": "../points.ply"}}
    values["output"] = {"dir": "."}
    (folder / "out").mkdir()
    (folder / "out" / "config.yml").write_text(f"# mine\n{yaml.safe_dump(SETTINGS | values)}")


def folder_attacks() -> Iterator[Attack]:
    """Every way to write a folder, into folders that hold something of the user's."""
    for name, (command, words) in COMMANDS.items():
        into_out = (*words, "--out", "out")
        for file in FOREIGN.split():
            theirs, change = (f"out/{file}",), partial(_add, file)
            yield Attack(f"folder/{name}/{file}", command, into_out, change, theirs=theirs)
        for target in ("lego/test", "photos", "mine", "run", "captured", "stopped", "."):
            label = f"folder/{name}/{target.replace('/', ' ')}"
            yield Attack(f"{label} itself", command, (*words, "--out", target), out=target)
            change = partial(_link, target)
            yield Attack(f"{label} by a link", command, into_out, change, out=target)
    for file in ("renders/test/mine.png", "renders/keep", "side_by_side/notes.txt", "thesis.tex"):
        theirs, change = (f"out/{file}",), partial(_add_to_result, file)
        words = ("fit.yml", "--overwrite", "--out", "out")
        yield Attack(f"folder/fit over a result/{file}", "fit", words, change, theirs=theirs)
    for name, options in (("fit", ()), ("fit over", ("--overwrite",))):
        words = ("out/config.yml", *options, "--out", "out")
        label, theirs = f"folder/{name}/its configuration", ("out/config.yml",)
        yield Attack(label, "fit", words, _config_inside, theirs=theirs)


NAMES = {
    "spaces": "a b  c",
    "umlaut": "\u00e4\u00f6",
    "emoji": "\U0001f600",
    "not UTF-8": "\udcff\udcfe",
    "newline": "a\nb",
    "escape": "\x1b[31m",
    "quotes": "a'b\"c",
    "dash": "-x",
    "percent": "%d%s",
    "brackets": "[red]a",
    "dollar": "$HOME",
    "markup": "<script>",
    "251 letters": "x" * 251,
    "255 letters": "x" * 255,
    "300 letters": "x" * 300,
    "backslash": "a\\b",
    "dots": "...",
}


def _moved(old: str, new: str, folder: Path) -> None:
    if len(os.fsencode(new)) <= 255:
        (folder / old).rename(folder / new)


def _renamed_image(stem: str, folder: Path) -> None:
    """A test view of another name, in the folder and in the file that names it."""
    path = folder / "lego" / "transforms_test.json"
    if len(os.fsencode(f"{stem}.png")) <= 255:
        (folder / "lego" / "test" / "r_0.png").rename(folder / "lego" / "test" / f"{stem}.png")
    in_json = json.dumps(stem, ensure_ascii=False)[1:-1]
    path.write_text(path.read_text().replace("r_0", in_json), errors="surrogateescape")


def name_attacks() -> Iterator[Attack]:
    """Strange names of everything, with output that is UTF-8 or ASCII."""
    for label, name in NAMES.items():
        path = f"./{name}" if name.startswith("-") else name
        fit = ("fit.yml", "--out", "out")
        uses = {
            "output of a fit": ("fit", ("fit.yml", "--out", path), None),
            "output of a rendering": ("render", ("run", "--out", path), None),
            "data": ("fit", (*fit, "--data", path), partial(_moved, "lego", name)),
            "configuration": ("fit", (f"{path}.yml",), partial(_moved, "fit.yml", f"{name}.yml")),
            "image": ("fit", fit, partial(_renamed_image, name)),
        }
        move = partial(_moved, "splats.xml", f"{name}.xml")
        uses["scene"] = ("render", (f"{path}.xml", "--out", "out"), move)
        for use, (command, words, change) in uses.items():
            more = {"change": change} if change else {"out": name}
            for encoding in ("utf-8", "ascii"):
                full = f"name/{use}/{label} in {encoding}"
                yield Attack(full, command, words, encoding=encoding, **more)


def drawn_attacks() -> Iterator[Attack]:
    """Fits with everything that they draw, which takes seconds each."""

    def shrink_images(folder: Path) -> None:
        for path in (folder / "lego").glob("*/*.png"):
            iio.imwrite(path, np.full((1, 1, 4), 200, np.uint8))

    words = ("fit.yml", "--out", "out")
    attacks = {
        "as it is": (words, {}),
        "markup": (words, {"change": partial(_renamed_image, NAMES["markup"])}),
        "not UTF-8": (words, {"change": partial(_renamed_image, NAMES["not UTF-8"])}),
        "newline": (("fit.yml", "--out", NAMES["newline"]), {"out": NAMES["newline"]}),
        "one pixel": (words, {"change": shrink_images}),
        "photographs": (("photos.yml", "--out", "out"), {}),
        "one iteration": ((*words, "--set", "iterations=1"), {}),
    }
    for name, (line, more) in attacks.items():
        yield Attack(f"drawn/{name}", "fit", line, draws=True, **more)
