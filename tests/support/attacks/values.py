"""Attacks by values: every value of the configuration, and every option of the commands."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib import import_module

from drgs.__main__ import COMMANDS
from drgs.cli.commands import CommandParser
from drgs.config.load import known_keys
from support.attacks.attack import Attack, label
from support.attacks.attack_folder import CAPTURE

VALUES = (
    # Numbers.
    *(".nan", ".inf", "-.inf", "-1", "0", "-0.0", "1", "2", "7", "1e-320", "1e-200", "1e-45"),
    *("1e-40", "1e-30", "1e-10", "1e-3", "0.5", "0.9999999999999999", "0.99999995", "1.0000001"),
    *("10000.0", "1e10", "1e20", "3e38", "1e39", "1e200", "1e308", "2147483647", "2147483648"),
    *("4294967296", "9223372036854775808", "1" + "0" * 400),
    # Others.
    *("true", "null", "", "''", "x", "'3'", "[]", "[1, 2]", "[0.1, 0.2, 0.3]", "[0, 0, 1e300]"),
    *("[[[1]]]", "{}", "{a: 1}", "2026-01-01", "0o17", "1_000", "*a", "!!binary aGk="),
    *("!!python/object/apply:os.system [true]", '"\\0"', '"\\ud800"', "x" * 5000, '"a\\nb\\nc"'),
    *("[{until: 1, factor: 2}]", "[{until: 1, factor: 64}, {until: 2, factor: 2}]"),
    *("[{until: 2147483647, factor: 64}]", "[{after: 0, end: 1}, {after: 1, end: 2147483647}]"),
)
"""In YAML."""

LONG_WORK = {
    "data.shutter_samples": ("1_000",),
    "iterations": ("10000.0", "2147483647", "1_000"),
}
"""Valid values that mean endless work, by key."""

ENABLING_SETTINGS = {
    "init.num_points": ("init.point_cloud=null", "densify.max_gaussians=100000000"),
    "init.half_extent": ("init.point_cloud=null", "init.num_points=20"),
    "densify": ("densify.start=0", "densify.every=1", "densify.stop=9"),
    "cameras": ("cameras.optimise=true",),
    "colors": ("colors.lr=0.01",),
}
"""Further values that make a key or section take effect."""

LISTS = ("coarse", "optimizer.means_lr_aims", "densify.stop_aims")
"""Keys whose values are lists of sections."""


def leaves() -> list[str]:
    """Keys of the configuration that are no sections."""
    keys = known_keys()
    sections = {key.rpartition(".")[0] for key in keys} - set(LISTS)
    of_lists = tuple(f"{name}." for name in LISTS)
    return [key for key in keys if key not in sections and not key.startswith(of_lists)]


def schema_attacks() -> Iterator[Attack]:
    """Each value of the configuration set to each of the values above, in fits of 2 iterations.

    Those of ``data`` with photographs that have all that a view may have.
    """
    for key in leaves():
        section = key.partition(".")[0]
        config = "photos.yml" if section in ("data", "cameras", "loss") else "fit.yml"
        others = ENABLING_SETTINGS.get(key, ENABLING_SETTINGS.get(section, ()))
        others = [word for word in others if not word.startswith(f"{key}=")]
        for text in VALUES:
            if text in LONG_WORK.get(key, ()):
                continue
            sets = [word for other in (*others, f"{key}={text}") for word in ("--set", other)]
            words, out = (config, *sets), "out"
            if key != "output.dir":
                words += ("--out", "out")
            elif text != "null":
                out = text or "."
            else:
                out = "out/fit"
            yield Attack(f"schema/{key}={label(text)}", "fit", words, out=out)


WORDS = (
    *("", " ", "nan", "inf", "-inf", "-1", "0", "1", "3.5", "1e-320", "1e-40", "1e10", "1e39"),
    *("1e300", "1e400", "10000", "100000", "1000000000", "2147483648", "4294967296"),
    *("18446744073709551616", "1" + "0" * 20, "9" * 5000, "\u0663\u0663", "\u00b2", "0x10", "1_0"),
    *("x", "\u00e4", "\udcff", "a\nb", "a\tb", "\x1b[31mred", "a\0b", "x" * 300, "x" * 5000),
    *("mine/../nowhere", "~no-such-user/x", "/dev/null", "/dev/zero", "/dev/urandom"),
    *("/proc/self/mem", ".", "mine", "mine/notes.txt", "photos", "run", "stopped", "sky.png"),
    *("fit.yml", "gaussians.ply", "splats.xml", "camera.json", "a=b", "iterations=1"),
    *("5m5", "1h30", "99999h", "0.001s", "-", "--"),
)
"""Arguments of options."""

RENDER_WORDS = ("", "0", "1", "1e300", "1000000000", "a\0b", "photos")

BASES = {
    "fit": ("fit", ("fit.yml",), WORDS),
    "render": ("render", ("gaussians.ply", "--origin", "3", "0", "1", "--size", "8", "6"), WORDS),
    "capture": ("capture", CAPTURE, WORDS),
    "render split": ("render", ("run", "--split", "test"), RENDER_WORDS),
    "render orbit": ("render", ("gaussians.ply", "--orbit", "2", "--size", "8", "6"), RENDER_WORDS),
    "render camera": ("render", ("gaussians.ply", "--camera", "camera.json"), RENDER_WORDS),
    "render scene": ("render", ("splats.xml",), RENDER_WORDS),
}
"""Command, valid arguments and words by name; ``--out out`` is added."""

MANY = ("10000", "100000")

COSTLY = {
    ("fit", ""): ("photos",),
    ("fit", "--budget"): ("1", "3.5", "10000", "100000", "1e10", "\u0663\u0663"),
    ("fit", "--threads"): MANY,
    ("render", "--threads"): MANY,
    ("render", "--orbit"): MANY,
    ("render", "--size"): ("10000",),
    ("capture", "--size"): ("10000",),
    ("capture", "--views"): MANY,
    ("capture", "--val-views"): MANY,
    ("capture", "--test-views"): MANY,
    ("capture", "--spp"): MANY,
}
"""Valid values that mean a lot of work, by command and option."""


def options_of(command: str) -> list[argparse.Action]:
    """The options of a command and its positional argument, without those that take no value."""
    parser = CommandParser(prog=command)
    import_module(COMMANDS[command].module).add_arguments(parser)
    return [action for action in parser._actions if action.nargs != 0]  # argparse has no other list


def option_attacks() -> Iterator[Attack]:
    """Each option of the commands with each of the words above."""
    for kind, (command, base, given) in BASES.items():
        for action in options_of(command):
            option = action.option_strings[0] if action.option_strings else ""
            if given is RENDER_WORDS and (not option or option in base):
                continue
            count = action.nargs if isinstance(action.nargs, int) else 1
            for word in given:
                if word not in COSTLY.get((kind, option), ()):
                    words, out = _words(base, option, (word,) * count)
                    name = f"option/{kind}/{option or action.dest}={label(word)}"
                    yield Attack(name, command, words, out=out)


def _words(
    base: tuple[str, ...], option: str, values: tuple[str, ...]
) -> tuple[tuple[str, ...], str]:
    """The command line with one option set, and the folder that it may fill."""
    if not option:
        return (*values, *base[1:], "--out", "out"), "out"
    if option == "--out":
        return (*base, option, *values), values[0] or "."
    if option == "--resume":
        return (option, *values), values[0]
    if option in base:
        at = base.index(option)
        end = next((i for i in range(at + 1, len(base)) if base[i].startswith("--")), len(base))
        base = base[:at] + base[end:]
    return (*base, "--out", "out", option, *values), "out"
