"""Attacks by values: every value of the configuration, and every option of the commands."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from importlib import import_module

from drgs.__main__ import COMMANDS
from drgs.cli.commands import CommandParser
from drgs.config.load import known_keys
from support.attacks.attack import Attack
from support.attacks.attack_folder import CAPTURE, capture_size

NUMBERS = {
    "nan": ".nan",
    "inf": ".inf",
    "-inf": "-.inf",
    "-1": "-1",
    "0": "0",
    "-0.0": "-0.0",
    "1": "1",
    "2": "2",
    "7": "7",
    "1e-320": "1e-320",
    "1e-200": "1e-200",
    "1e-45": "1e-45",
    "1e-40": "1e-40",
    "1e-30": "1e-30",
    "1e-10": "1e-10",
    "1e-3": "1e-3",
    "half": "0.5",
    "nearly 1": "0.9999999999999999",
    "nearly 1 in single precision": "0.99999995",
    "just above 1": "1.0000001",
    "1e4": "10000.0",
    "1e10": "1e10",
    "1e20": "1e20",
    "3e38": "3e38",
    "1e39": "1e39",
    "1e200": "1e200",
    "1e308": "1e308",
    "2^31-1": "2147483647",
    "2^31": "2147483648",
    "2^32": "4294967296",
    "2^63": "9223372036854775808",
    "10^400": "1" + "0" * 400,
}
"""Numbers in YAML, by name."""

OTHER_VALUES = {
    "true": "true",
    "null": "null",
    "nothing": "",
    "empty": "''",
    "text": "x",
    "quoted": "'3'",
    "list": "[]",
    "numbers": "[1, 2]",
    "colour": "[0.1, 0.2, 0.3]",
    "colour too bright": "[0, 0, 1e300]",
    "nested": "[[[1]]]",
    "section": "{}",
    "section of strangers": "{a: 1}",
    "date": "2026-01-01",
    "octal": "0o17",
    "underscores": "1_000",
    "tag": "!!python/object/apply:os.system [true]",
    "binary": "!!binary aGk=",
    "alias": "*a",
    "null byte": '"\\0"',
    "surrogate": '"\\ud800"',
    "long": "x" * 5000,
    "newlines": '"a\\nb\\nc"',
    "stages": "[{until: 1, factor: 2}]",
    "many stages": "[{until: 1, factor: 64}, {until: 2, factor: 2}]",
    "endless stages": "[{until: 2147483647, factor: 64}]",
    "aims": "[{after: 0, end: 1}, {after: 1, end: 2147483647}]",
}

RARELY_VALID = ("nan", "inf", "-inf", "-1", "2^63", "10^400")
"""Numbers that hardly any value may be: the others often begin a fit."""

LONG_WORK = {
    "data.shutter_samples": ("underscores",),
    "iterations": ("1e4", "2^31-1", "underscores"),
    "init.num_points": (),
    "densify.adc.split_count": (),
}
"""Valid values that mean endless work, by key."""

ENABLING_SETTINGS = {
    "init.num_points": ("init.point_cloud=null", "densify.max_gaussians=100000000"),
    "init.half_extent": ("init.point_cloud=null", "init.num_points=20"),
    "densify": ("densify.start=0", "densify.every=1", "densify.stop=9"),
    "cameras": ("cameras.optimise=true",),
    "colors": ("colors.lr=0.01",),
    "coarse": (),
}
"""Further values that make a key or section take effect."""


def leaves() -> list[str]:
    """Keys of the configuration that are no sections."""
    keys = known_keys()
    sections = {key.rpartition(".")[0] for key in keys}
    lists = {"coarse", "optimizer.means_lr_aims", "densify.stop_aims"}
    of_lists = tuple(f"{name}." for name in lists)
    return [
        key
        for key in keys
        if (key not in sections or key in lists) and not key.startswith(of_lists)
    ]


def schema_attacks() -> Iterator[Attack]:
    """Each value of the configuration set to each of the values above, in fits of 2 iterations.

    Those of ``data`` with photographs that have all that a view may have.
    """
    for key in leaves():
        of_data = key.partition(".")[0] in ("data", "cameras", "loss")
        config = "photos.yml" if of_data else "fit.yml"
        others = ENABLING_SETTINGS.get(key, ENABLING_SETTINGS.get(key.partition(".")[0], ()))
        others = [word for word in others if not word.startswith(f"{key}=")]
        for name, text in (NUMBERS | OTHER_VALUES).items():
            if name in LONG_WORK.get(key, ()):
                continue
            sets = [word for other in (*others, f"{key}={text}") for word in ("--set", other)]
            out = ("--out", "out") if key != "output.dir" else ()
            yield Attack(
                f"schema/{key}={name}",
                "fit",
                (config, *out, *sets),
                out=_out(key, text),
                is_long=name in NUMBERS and name not in RARELY_VALID,
            )


def _out(key: str, text: str) -> str:
    """The folder that a fit makes."""
    if key != "output.dir":
        return "out"
    return "out/fit" if text == "null" else text or "."


# ----------------------------------------------------------------------------------------------
# Options
# ----------------------------------------------------------------------------------------------

WORDS = {
    "nothing": "",
    "space": " ",
    "nan": "nan",
    "inf": "inf",
    "-inf": "-inf",
    "-1": "-1",
    "0": "0",
    "1": "1",
    "3.5": "3.5",
    "1e-320": "1e-320",
    "1e-40": "1e-40",
    "1e10": "1e10",
    "1e39": "1e39",
    "1e300": "1e300",
    "1e400": "1e400",
    "10^4": "10000",
    "10^5": "100000",
    "10^9": "1000000000",
    "2^31": "2147483648",
    "2^32": "4294967296",
    "2^64": "18446744073709551616",
    "10^20": "1" + "0" * 20,
    "5000 digits": "9" * 5000,
    "arabic digits": "\u0663\u0663",
    "superscript": "\u00b2",
    "hexadecimal": "0x10",
    "underscores": "1_0",
    "text": "x",
    "umlaut": "\u00e4",
    "surrogate": "\udcff",
    "newline": "a\nb",
    "tab": "a\tb",
    "escape": "\x1b[31mred",
    "null byte": "a\0b",
    "300 letters": "x" * 300,
    "5000 letters": "x" * 5000,
    "dots": "mine/../nowhere",
    "home": "~no-such-user/x",
    "null device": "/dev/null",
    "endless device": "/dev/zero",
    "random device": "/dev/urandom",
    "memory": "/proc/self/mem",
    "current folder": ".",
    "user's folder": "mine",
    "user's file": "mine/notes.txt",
    "photographs": "photos",
    "finished fit": "run",
    "stopped fit": "stopped",
    "image": "sky.png",
    "configuration": "fit.yml",
    "splats": "gaussians.ply",
    "scene": "splats.xml",
    "cameras": "camera.json",
    "assignment": "a=b",
    "key": "iterations=1",
    "minutes": "5m5",
    "hours": "1h30",
    "years": "99999h",
    "instant": "0.001s",
    "dash": "-",
    "dashes": "--",
}
"""Option arguments, by name."""

BASES = {
    "fit": ("fit.yml",),
    "render": ("gaussians.ply", "--origin", "3", "0", "1", "--size", "8", "6"),
    "capture": ("ball.xml", *CAPTURE, *capture_size(4)),
}
"""Valid arguments by command; ``--out out`` is added."""

OTHER_BASES = {
    "split": ("run", "--split", "test"),
    "orbit": ("gaussians.ply", "--orbit", "2", "--size", "8", "6"),
    "camera": ("gaussians.ply", "--camera", "camera.json"),
    "scene": ("splats.xml",),
}
"""Further valid arguments of ``render``, by name."""

COSTLY = {
    ("fit", ""): ("photographs",),
    ("fit", "--budget"): ("1", "3.5", "10^4", "10^5", "1e10", "arabic digits"),
    ("render", "--orbit"): ("10^4", "10^5"),
    ("capture", "--views"): ("10^4", "10^5"),
    ("capture", "--val-views"): ("10^4", "10^5"),
    ("capture", "--test-views"): ("10^4", "10^5"),
    ("capture", "--spp"): ("10^4", "10^5"),
    ("capture", "--size"): ("10^4",),
    ("render", "--size"): ("10^4",),
    ("fit", "--threads"): ("10^4", "10^5"),
    ("render", "--threads"): ("10^4", "10^5"),
}
"""Valid values that mean a lot of work, by command and option."""


def options_of(command: str) -> list[argparse.Action]:
    """The options of a command and its positional argument, without those that take no value."""
    parser = CommandParser(prog=command)
    import_module(COMMANDS[command].module).add_arguments(parser)
    return [action for action in parser._actions if action.nargs != 0]


def option_attacks() -> Iterator[Attack]:
    """Each option of the commands with each of the words above."""
    for command, base in BASES.items():
        for action in options_of(command):
            option = action.option_strings[0] if action.option_strings else ""
            count = action.nargs if isinstance(action.nargs, int) else 1
            for name, word in WORDS.items():
                if name not in COSTLY.get((command, option), ()):
                    words, out = _words(base, option, [word] * count)
                    label = f"option/{command}/{option or action.dest}={name}"
                    yield Attack(label, command, words, out=out)
    for kind, base in OTHER_BASES.items():
        for action in options_of("render"):
            option = action.option_strings[0] if action.option_strings else ""
            count = action.nargs if isinstance(action.nargs, int) else 1
            for name in ("nothing", "0", "1", "1e300", "10^9", "null byte", "photographs"):
                if option and option not in base:
                    words, out = _words(base, option, [WORDS[name]] * count)
                    yield Attack(f"option/render {kind}/{option}={name}", "render", words, out=out)


def _words(base: Sequence[str], option: str, values: list[str]) -> tuple[tuple[str, ...], str]:
    """The command line with one option set, and the folder that it may fill."""
    base = list(base)
    if not option:
        return (*values, *base[1:], "--out", "out"), "out"
    if option == "--out":
        return (*base, option, *values), values[0] or "."
    if option in base:
        at = base.index(option)
        end = next((i for i in range(at + 1, len(base)) if base[i].startswith("--")), len(base))
        base[at:end] = []
    out = () if option == "--resume" else ("--out", "out")
    if option == "--resume":
        base = []
    return (*base, *out, option, *values), values[0] if option == "--resume" else "out"
