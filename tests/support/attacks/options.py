"""Attacks by options that do not go together, and by folders that are somebody's."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import yaml

from support.attacks.attack import Attack
from support.attacks.attack_folder import CAPTURE, SETTINGS, capture_size

OPTIONS = {
    "fit": {
        "config": ("fit.yml",),
        "--resume": ("--resume", "stopped"),
        "--data": ("--data", "lego"),
        "--out": ("--out", "out"),
        "--overwrite": ("--overwrite",),
        "--set": ("--set", "seed=1"),
        "--threads": ("--threads", "1"),
        "--budget": ("--budget", "0.01s"),
    },
    "render": {
        "--split": ("--split", "test"),
        "--orbit": ("--orbit", "2"),
        "--camera": ("--camera", "camera.json"),
        "--origin": ("--origin", "3", "0", "1"),
        "--target": ("--target", "0", "0", "0.5"),
        "--up": ("--up", "0", "1", "0"),
        "--fov": ("--fov", "50"),
        "--size": ("--size", "8", "6"),
        "--background": ("--background", "black"),
        "--background image": ("--background", "sky.png"),
        "--ignore": ("--ignore", "motion"),
        "--scene": ("--scene", "photos.yml"),
        "--data": ("--data", "lego"),
        "--set": ("--set", "data.image_size=10"),
        "--define": ("--define", "a=b"),
        "--threads": ("--threads", "1"),
        "--variant": ("--variant", "scalar_rgb"),
    },
}
"""Options that are valid on their own, by command and name."""

SUBJECTS = ("run", "gaussians.ply", "splats.xml", "stopped", "photos")
"""Inputs of ``render``."""


def combination_attacks() -> Iterator[Attack]:
    """Every two options of ``fit``, and every two of ``render`` for each kind of subject."""
    for left, right in combinations(OPTIONS["fit"], 2):
        words = OPTIONS["fit"][left] + OPTIONS["fit"][right]
        out = "stopped" if "--resume" in words else "out"
        yield Attack(f"together/fit/{left} {right}", "fit", words, out=out)
    for subject in SUBJECTS:
        for left, right in combinations(OPTIONS["render"], 2):
            words = OPTIONS["render"][left] + OPTIONS["render"][right]
            name = f"together/render {subject}/{left} {right}"
            yield Attack(name, "render", (subject, *words, "--out", "out"))


# ----------------------------------------------------------------------------------------------
# Folders of others
# ----------------------------------------------------------------------------------------------

COMMANDS = {
    "fit": ("fit", ("fit.yml",)),
    "fit over": ("fit", ("fit.yml", "--overwrite")),
    "fit photographs": ("fit", ("photos.yml", "--overwrite")),
    "split": ("render", ("run",)),
    "orbit": ("render", ("gaussians.ply", "--orbit", "2", "--size", "8", "6")),
    "camera": ("render", ("gaussians.ply", "--camera", "camera.json")),
    "origin": ("render", ("gaussians.ply", "--origin", "3", "0", "1", "--size", "8", "6")),
    "scene": ("render", ("splats.xml",)),
    "capture": ("capture", ("ball.xml", *CAPTURE, *capture_size(4))),
}
"""Every way to write a folder; ``--out`` is added."""

FOREIGN = (
    "config.yml",
    "metrics.json",
    "point_cloud.ply",
    "checkpoint.npz",
    "report.html",
    "viewer.html",
    "orbit.webp",
    "orbit.gif",
    "orbit_0.png",
    "orbit_000.png",
    "camera.png",
    "camera_0.png",
    "r_0.png",
    "splats.png",
    "splats.exr",
    "plan.txt",
    "cameras.json",
    "history.csv",
    "density.csv",
    "capture.json",
    "points3d.ply",
    "transforms_train.json",
    "train/r_0.png",
    "renders/test/r_0.png",
    "renders/test/mine.png",
    "side_by_side/notes.txt",
    "renders/keep",
    "thesis.tex",
    ".hidden",
)
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
    (folder / "out").mkdir()
    values = SETTINGS | {"data": {"path": "../lego"}, "init": {"point_cloud": "../points.ply"}}
    values |= {"output": {"dir": "."}}
    (folder / "out" / "config.yml").write_text(f"# my own words\n{yaml.safe_dump(values)}")


def folder_attacks() -> Iterator[Attack]:
    """Every way to write a folder, into folders that hold something of the user's."""
    for name, (command, words) in COMMANDS.items():
        for file in FOREIGN:
            yield _into(f"folder/{name}/{file}", command, words, partial(_add, file), file)
        for target in ("lego/test", "photos", "mine", "run", "captured", "stopped", "."):
            theirs = (*words, "--out", target)
            label = f"folder/{name}/{target.replace('/', ' ')} itself"
            yield Attack(label, command, theirs, out=target)
            change = partial(_link, target)
            yield Attack(
                f"folder/{name}/{target.replace('/', ' ')} by a link",
                command,
                (*words, "--out", "out"),
                change,
                out=target,
            )
    for file in ("renders/test/mine.png", "renders/keep", "side_by_side/notes.txt", "thesis.tex"):
        words = ("fit.yml", "--overwrite")
        change = partial(_add_to_result, file)
        yield _into(f"folder/fit over a result/{file}", "fit", words, change, file)
    for name in ("fit", "fit over"):
        words = ("out/config.yml", *COMMANDS[name][1][1:])
        change = _config_inside
        yield _into(f"folder/{name}/its configuration", "fit", words, change, "config.yml")


def _into(name: str, command: str, words: tuple[str, ...], change: Callable, file: str) -> Attack:
    theirs = (os.path.join("out", file),)
    return Attack(name, command, (*words, "--out", "out"), change, theirs=theirs)


# ----------------------------------------------------------------------------------------------
# Names, encodings
# ----------------------------------------------------------------------------------------------

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
"""Names of folders, images and configurations."""


def _moved(old: str, new: str, folder: Path) -> None:
    if len(os.fsencode(new)) <= 255:
        (folder / old).rename(folder / new)


def _renamed_image(stem: str, folder: Path) -> None:
    """A test view of another name, in the folder and in the file that names it."""
    path = folder / "lego" / "transforms_test.json"
    if len(os.fsencode(f"{stem}.png")) <= 255:
        (folder / "lego" / "test" / "r_0.png").rename(folder / "lego" / "test" / f"{stem}.png")
    text = path.read_text().replace("r_0", json_text(stem))
    path.write_text(text, errors="surrogateescape")


def json_text(text: str) -> str:
    """Return the text as it is written within quotes."""
    return json.dumps(text, ensure_ascii=False)[1:-1]


def name_attacks() -> Iterator[Attack]:
    """Strange names of everything, with output that is UTF-8 or ASCII."""
    for label, name in NAMES.items():
        for encoding in ("utf-8", "ascii"):
            kind = f"{label} in {encoding}"
            more = {"encoding": encoding}
            out = name if not name.startswith("-") else f"./{name}"
            yield Attack(
                f"name/output of a fit/{kind}", "fit", ("fit.yml", "--out", out), out=name, **more
            )
            yield Attack(
                f"name/output of a rendering/{kind}",
                "render",
                ("run", "--out", out),
                out=name,
                **more,
            )
            yield Attack(
                f"name/data/{kind}",
                "fit",
                ("fit.yml", "--data", out, "--out", "out"),
                partial(_moved, "lego", name),
                **more,
            )
            yield Attack(
                f"name/configuration/{kind}",
                "fit",
                (f"{out}.yml",),
                partial(_moved, "fit.yml", f"{name}.yml"),
                **more,
            )
            yield Attack(
                f"name/image/{kind}",
                "fit",
                ("fit.yml", "--out", "out"),
                partial(_renamed_image, name),
                **more,
            )
            yield Attack(
                f"name/scene/{kind}",
                "render",
                (f"{out}.xml", "--out", "out"),
                partial(_moved, "splats.xml", f"{name}.xml"),
                **more,
            )


# ----------------------------------------------------------------------------------------------
# Images of a fit
# ----------------------------------------------------------------------------------------------


def _tiny_images(folder: Path) -> None:
    """Write images of one pixel."""
    for path in (folder / "lego").glob("*/*.png"):
        iio.imwrite(path, np.full((1, 1, 4), 200, np.uint8))


def drawn_attacks() -> Iterator[Attack]:
    """Fits with everything that they draw, which takes seconds each."""
    words = ("fit.yml", "--out", "out")
    changes = {
        "as it is": (words, lambda folder: None),
        "markup": (words, partial(_renamed_image, NAMES["markup"])),
        "not UTF-8": (words, partial(_renamed_image, NAMES["not UTF-8"])),
        "newline": (("fit.yml", "--out", NAMES["newline"]), lambda folder: None),
        "one pixel": (words, _tiny_images),
        "photographs": (("photos.yml", "--out", "out"), lambda folder: None),
        "one iteration": ((*words, "--set", "iterations=1"), lambda folder: None),
    }
    for name, (line, change) in changes.items():
        yield Attack(f"drawn/{name}", "fit", line, change, out=line[2], draws=True, is_long=True)
