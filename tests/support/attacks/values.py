"""Attacks by values: of the configuration, of options, and of properties of Mitsuba scenes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path

from drgs.__main__ import commands
from drgs.cli.commands import CommandParser
from drgs.config.approximations import DECLARED
from drgs.config.load import known_keys
from support.attacks.attack import Attack, label
from support.attacks.attack_folder import CAPTURE, SPLATS

NUMBERS = """
    .nan .inf -.inf -1 0 -0.0 1 2 7 1e-320 1e-200 1e-45 1e-40 1e-30 1e-10 1e-3 0.5
    0.9999999999999999 0.99999995 1.0000001 10000.0 1e10 1e20 3e38 1e39 1e200 1e308 2147483647
    2147483648 4294967296 9223372036854775808
"""

VALUES = (
    *(*NUMBERS.split(), "1" + "0" * 400),
    *("true", "null", "", "''", "x", "'3'", "[]", "[1, 2]", "[0.1, 0.2, 0.3]", "[0, 0, 1e300]"),
    *("[[[1]]]", "{}", "{a: 1}", "2026-01-01", "0o17", "1_000", "*a", "!!binary aGk="),
    *("!!python/object/apply:os.system [true]", '"\\0"', '"\\ud800"', "x" * 5000, '"a\\nb\\nc"'),
    *("[{until: 1, factor: 2}]", "[{until: 1, factor: 64}, {until: 2, factor: 2}]"),
    *("[{until: 2147483647, factor: 64}]", "[{after: 0, end: 1}, {after: 1, end: 2147483647}]"),
)
"""In YAML."""

MANY_ITERATIONS = ("10000.0", "2147483647", "1_000")
LONG_WORK = {
    "data.shutter_samples": ("1_000",),
    "iterations": MANY_ITERATIONS,
    "stop_after": MANY_ITERATIONS,
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

LISTS = ("coarse",)
"""Keys whose values are lists of sections."""


def schema_attacks() -> Iterator[Attack]:
    """Each value of the configuration set to each of the values above, in fits of 2 iterations.

    Those of ``data`` with photographs that have all that a view may have.
    """
    keys = known_keys()
    sections = {key.rpartition(".")[0] for key in keys} - set(LISTS)
    of_lists = tuple(f"{name}." for name in LISTS)
    for key in keys:
        if key in sections or key.startswith(of_lists):
            continue
        section = key.partition(".")[0]
        config = "photos.yml" if section in ("data", "cameras", "loss") else "fit.yml"
        others = ENABLING_SETTINGS.get(key, ENABLING_SETTINGS.get(section, ()))
        others = [word for word in others if not word.startswith(f"{key}=")]
        for text in VALUES:
            if text in LONG_WORK.get(key, ()):
                continue
            sets = [word for other in (*others, f"{key}={text}") for word in ("--set", other)]
            words, out = (config, *sets), "out"
            if key == "output.dir":
                out = "out/fit" if text == "null" else text or "."
            else:
                words += ("--out", "out")
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
    **{("capture", f"--{name}"): MANY for name in ("views", "val-views", "test-views", "spp")},
}
"""Valid values that mean a lot of work, by command and option."""


def option_attacks() -> Iterator[Attack]:
    """Each option that takes values, and the positional argument, with each of the words above."""
    for kind, (command, base, given) in BASES.items():
        parser = CommandParser(prog=command)
        import_module(commands()[command].module).add_arguments(parser)
        for action in parser._actions:  # argparse has no other list
            option = action.option_strings[0] if action.option_strings else ""
            is_known = given is RENDER_WORDS and (not option or option in base)
            if action.nargs == 0 or is_known:
                continue
            count = action.nargs if isinstance(action.nargs, int) else 1
            for word in given:
                if word not in COSTLY.get((kind, option), ()):
                    words, out = _words(base, option, (word,) * count)
                    name = f"option/{kind}/{option or action.dest}={label(word)}"
                    yield Attack(name, command, words, out=out)


def _words(base: tuple, option: str, values: tuple) -> tuple[tuple[str, ...], str]:
    """The command line with one option set, and the folder that it may fill."""
    if not option:
        return (*values, *base[1:], "--out", "out"), "out"
    if option == "--out":
        return (*base, option, *values), values[0] or "."
    if option == "--resume":
        return (option, *values), values[0]
    return (*base, "--out", "out", option, *values), "out"  # of two values the last one counts


SCENE_WORDS = ("splats.xml", "--out", "out")

PROPERTY_VALUES = {
    "float": ("0", "-1", "nan", "inf", "1e-40", "1e-30", "0.5", "1", "3", "1e10", "1e30", "1e38"),
    "integer": ("0", "-1", "1", "3", "17", "1000000000", "2147483647", "9223372036854775807"),
    "string": (
        *("", "x", "ewa", "exact", "a:depth", "motion", "gaussians.ply", "x" * 3000, "sky.png"),
    ),
    "boolean": ("true", "false"),
    "rgb": ("0, 0, 0", "-1, 0, 2", "nan, 0, 0", "1e30, 1e30, 1e30"),
    "spectrum": ("0.5", "400:1, 700:0"),
    "point": ("0, 0, 0", "nan, 0, 0"),
}
"""Property values, by XML tag."""

SENSOR_PROPERTIES = """
    near_clip far_clip principal_point_offset_x aperture_radius focus_distance shutter_open
    shutter_close fov_axis focal_length
"""

PLACES = {
    "splats": (
        '<integrator type="splats">',
        """filename to_world shapes_to_world sh_degree background hide_emitters nested_spp near
        srgb_primitives aovs ignore smoothing means shN feature_a nonsense """
        + " ".join(DECLARED),
    ),
    "calibrated": (
        '<sensor type="perspective">',
        """fx fy cx cy lens k1 k4 k6 p2 near_clip far_clip to_world_close shutter shutter_open
        shutter_close shutter_samples""",
    ),
    "sensor": ('<sensor type="perspective">', SENSOR_PROPERTIES),
    "lens": ('<sensor type="perspective">', SENSOR_PROPERTIES),
    "film": (
        '<film type="hdrfilm">',
        "width height crop_width crop_offset_x pixel_format component_format",
    ),
    "sampler": ('<sampler type="independent">', "sample_count seed"),
}
"""Objects of a scene that get another property: their beginning, and properties."""


def _insert_property(place: str, name: str, text: str, folder: Path) -> None:
    """Add a property to an object of the scene, in place of one of that name."""
    start = PLACES[place][0]
    lines = [line for line in SPLATS.splitlines() if f'name="{name}"' not in line or start in line]
    if name in ("width", "height"):  # which are on one line
        text += f'<integer name="{"height" if name == "width" else "width"}" value="16"/>'
    scene = "\n".join(lines).replace(start, f"{start}\n{text}")
    if place == "lens":
        scene = scene.replace('"perspective"', '"thinlens"')
    if place == "calibrated":
        scene = scene.replace('"perspective"', '"calibrated"')
        scene = scene.replace('<float name="fov" value="40"/>', '<float name="fx" value="30"/>')
    _write_scene(scene, folder)


def _write_scene(scene: str, folder: Path) -> None:
    (folder / "splats.xml").write_text(scene)


def property_attacks() -> Iterator[Attack]:
    """Every property of the plugins, of sensors, films and samplers, with values of every type."""
    for place, (_, names) in PLACES.items():
        for name in names.split():
            for tag, values in PROPERTY_VALUES.items():
                for value in values:
                    text = f'<{tag} name="{name}" value="{value}"/>'
                    change = partial(_insert_property, place, name, text)
                    full = f"property/{place}/{name} {tag}={label(value)}"
                    yield Attack(full, "render", SCENE_WORDS, change)


def _file(tag: str, kind: str, name: str) -> str:
    return f'<{tag} type="{kind}"><string name="filename" value="{name}"/></{tag}>'


SENSOR = SPLATS[SPLATS.index("<sensor") : SPLATS.index("</sensor>") + len("</sensor>")]
AOV = '<integrator type="aov"><string name="aovs" value="d:depth"/><integrator type="splats">'
PATH, DIRECT, NESTED = (f'<integrator type="{kind}"/>' for kind in ("path", "direct", "splats"))
POSE = '<lookat origin="4, 0, 1" target="0, 0, 0" up="0, 0, 1"/>'

LETTERS = ("a", "a"), ("b", "&a;"), ("c", "&b;"), ("d", "&c;")
ENTITIES = "".join(f'<!ENTITY {name} "{text * 10}">' for name, text in LETTERS)

REPLACED = {
    "no Gaussians": ('name="filename"', 'name="nonsense"'),
    "no sensor": (SENSOR, ""),
    "no film": ("hdrfilm", "nonsense"),
    "a film of others": ("hdrfilm", "specfilm"),
    "a sensor of others": ('"perspective"', '"irradiancemeter"'),
    "a batch": ('"perspective"', '"batch"'),
    "another filter": ('"box"', '"lanczos"'),
    "another integrator": ('"splats"', '"path"'),
    "an unknown version": ("3.0.0", "99.0.0"),
    "no version": (' version="3.0.0"', ""),
    "a singular pose": (POSE, '<scale value="0"/>'),
    "a pose towards itself": ('origin="4, 0, 1"', 'origin="0, 0, 0"'),
    "a pose of NaN": ('origin="4, 0, 1"', 'origin="nan, 0, 1"'),
    "a pose far away": ('origin="4, 0, 1"', 'origin="1e30, 0, 1"'),
    "a mirrored pose": (POSE, f'<scale x="-1"/>{POSE}'),
    "a stretched pose": (POSE, f'<scale x="5"/>{POSE}'),
    "a nested integrator": ("</integrator>", f"{PATH}</integrator>"),
    "two nested integrators": ("</integrator>", f"{PATH}{DIRECT}</integrator>"),
    "itself nested": ("</integrator>", f"{NESTED}</integrator>"),
}
"""Text of the attack folder's scene, and what is in its place, by name."""

ADDED = {
    "two sensors": SENSOR,
    "a shape that is missing": _file("shape", "ply", "nowhere.ply"),
    "a shape of points": _file("shape", "ply", "points.ply"),
    "ellipsoids": _file("shape", "ellipsoids", "gaussians.ply"),
    "a sky that is missing": _file("emitter", "envmap", "nowhere.exr"),
    "a sky that is no image": _file("emitter", "envmap", "fit.yml"),
    "a file in itself": '<include filename="splats.xml"/>',
    "a file that is missing": '<include filename="nowhere.xml"/>',
    "a thousand levels": "<shape>" * 1000 + "</shape>" * 1000,
}

OBJECTS = {
    **{name: SPLATS.replace(old, new) for name, (old, new) in REPLACED.items()},
    **{name: SPLATS.replace("</scene>", f"{more}</scene>") for name, more in ADDED.items()},
    "aovs around": SPLATS.replace('<integrator type="splats">', AOV).replace(
        "</integrator>", "</integrator></integrator>"
    ),
    "an entity bomb": f"<!DOCTYPE a [{ENTITIES}]>" + SPLATS.replace("gaussians.ply", "&d;"),
    "an entity of a file": '<!DOCTYPE a [<!ENTITY a SYSTEM "file:///etc/passwd">]>'
    + SPLATS.replace("gaussians.ply", "&a;"),
}


def object_attacks() -> Iterator[Attack]:
    """Scenes that are put together otherwise."""
    for name, scene in OBJECTS.items():
        change = partial(_write_scene, scene)
        yield Attack(f"object/{name}", "render", SCENE_WORDS, change)
