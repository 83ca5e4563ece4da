"""Attacks by Mitsuba scenes: every property of the plugins, and what Mitsuba has around them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from drgs.config.approximations import DECLARED
from support.attacks.attack import Attack
from support.attacks.attack_folder import SPLATS

WORDS = ("render", ("splats.xml", "--out", "out"))

NUMBERS = {
    "float": ("0", "-1", "nan", "inf", "1e-40", "1e-30", "0.5", "1", "3", "1e10", "1e30", "1e38"),
    "integer": ("0", "-1", "1", "3", "17", "1000000000", "2147483647", "9223372036854775807"),
}

PROPERTY_VALUES = {
    "string": (
        "",
        "x",
        "ewa",
        "exact",
        "a:depth",
        "motion",
        "gaussians.ply",
        "sky.png",
        "x" * 3000,
    ),
    "boolean": ("true", "false"),
    "rgb": ("0, 0, 0", "-1, 0, 2", "nan, 0, 0", "1e30, 1e30, 1e30"),
    "spectrum": ("0.5", "400:1, 700:0"),
    "point": ("0, 0, 0", "nan, 0, 0"),
}
"""Property values, by XML tag."""

SPLATS_PROPERTIES = (
    "filename",
    "to_world",
    "shapes_to_world",
    "sh_degree",
    "background",
    "hide_emitters",
    "nested_spp",
    "near",
    "srgb_primitives",
    "aovs",
    "ignore",
    "smoothing",
    "means",
    "shN",
    "feature_a",
    "nonsense",
    *DECLARED,
)
"""Properties of ``splats``."""

CALIBRATED = (
    *("fx", "fy", "cx", "cy", "lens", "k1", "k4", "k6", "p2", "near_clip", "far_clip"),
    *("to_world_close", "shutter", "shutter_open", "shutter_close", "shutter_samples"),
)
"""Properties of ``calibrated``."""

SENSOR_PROPERTIES = (
    *("near_clip", "far_clip", "principal_point_offset_x", "aperture_radius", "focus_distance"),
    *("shutter_open", "shutter_close", "fov_axis", "focal_length"),
)
"""Properties of Mitsuba's sensors."""

FILM = ("width", "height", "crop_width", "crop_offset_x", "pixel_format", "component_format")


def _insert(place: str, text: str, path: Path) -> None:
    """Add a property to an object of the scene; sensors, films and samplers have others there."""
    scene = path.read_text()
    start = {
        "splats": '<integrator type="splats">',
        "sensor": '<sensor type="perspective">',
        "lens": '<sensor type="perspective">',
        "calibrated": '<sensor type="perspective">',
        "film": '<film type="hdrfilm">',
        "sampler": '<sampler type="independent">',
        "scene": '<scene version="3.0.0">',
    }[place]
    name = text.partition('name="')[2].partition('"')[0]
    lines = [line for line in scene.splitlines() if f'name="{name}"' not in line or start in line]
    scene = "\n".join(lines).replace(start, f"{start}\n{text}")
    if name in ("width", "height"):
        kept = {"width": "height", "height": "width"}[name]
        scene = scene.replace(start, f'{start}\n<integer name="{kept}" value="16"/>')
    if place == "lens":
        scene = scene.replace('"perspective"', '"thinlens"')
    if place == "calibrated":
        scene = scene.replace('"perspective"', '"calibrated"').replace(
            '<float name="fov" value="40"/>', '<float name="fx" value="30"/>'
        )
    path.write_text(scene)


def _change(place: str, text: str, folder: Path) -> None:
    _insert(place, text, folder / "splats.xml")


def property_attacks() -> Iterator[Attack]:
    """Every property of the plugins, of sensors, films and samplers, with values of every type."""
    places = {
        "splats": SPLATS_PROPERTIES,
        "calibrated": CALIBRATED,
        "sensor": SENSOR_PROPERTIES,
        "lens": SENSOR_PROPERTIES,
        "film": FILM,
        "sampler": ("sample_count", "seed"),
    }
    for place, names in places.items():
        for name in names:
            for tag, values in (NUMBERS | PROPERTY_VALUES).items():
                for number, value in enumerate(values):
                    text = f'<{tag} name="{name}" value="{value}"/>'
                    label = value if len(value) < 30 else f"long {number}"
                    yield _attack(f"property/{place}/{name} {tag}={label}", place, text)


OBJECTS = {
    "no Gaussians": lambda scene: scene.replace('name="filename"', 'name="nonsense"'),
    "two sensors": lambda scene: scene.replace("</scene>", f"{_sensor(scene)}</scene>"),
    "no sensor": lambda scene: scene.replace(_sensor(scene), ""),
    "no film": lambda scene: scene.replace("hdrfilm", "nonsense"),
    "a film of others": lambda scene: scene.replace("hdrfilm", "specfilm"),
    "a sensor of others": lambda scene: scene.replace('"perspective"', '"irradiancemeter"'),
    "a batch": lambda scene: scene.replace('"perspective"', '"batch"'),
    "another filter": lambda scene: scene.replace('"box"', '"lanczos"'),
    "another integrator": lambda scene: scene.replace('"splats"', '"path"'),
    "a nested integrator": lambda scene: scene.replace(
        "</integrator>", '<integrator type="path"/></integrator>'
    ),
    "two nested integrators": lambda scene: scene.replace(
        "</integrator>", '<integrator type="path"/><integrator type="direct"/></integrator>'
    ),
    "itself nested": lambda scene: scene.replace(
        "</integrator>", '<integrator type="splats"/></integrator>'
    ),
    "aovs around": lambda scene: scene.replace(
        '<integrator type="splats">',
        '<integrator type="aov"><string name="aovs" value="d:depth"/><integrator type="splats">',
    ).replace("</integrator>", "</integrator></integrator>"),
    "a shape that is missing": lambda scene: scene.replace(
        "</scene>",
        '<shape type="ply"><string name="filename" value="nowhere.ply"/></shape></scene>',
    ),
    "a shape of points": lambda scene: scene.replace(
        "</scene>", '<shape type="ply"><string name="filename" value="points.ply"/></shape></scene>'
    ),
    "ellipsoids": lambda scene: scene.replace(
        "</scene>",
        '<shape type="ellipsoids"><string name="filename" value="gaussians.ply"/></shape></scene>',
    ),
    "a sky that is missing": lambda scene: scene.replace(
        "</scene>",
        '<emitter type="envmap"><string name="filename" value="nowhere.exr"/></emitter></scene>',
    ),
    "a sky that is no image": lambda scene: scene.replace(
        "</scene>",
        '<emitter type="envmap"><string name="filename" value="fit.yml"/></emitter></scene>',
    ),
    "a file in itself": lambda scene: scene.replace(
        "</scene>", '<include filename="splats.xml"/></scene>'
    ),
    "a file that is missing": lambda scene: scene.replace(
        "</scene>", '<include filename="nowhere.xml"/></scene>'
    ),
    "an entity bomb": lambda scene: (
        '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">'
        '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;"><!ENTITY d "&c;&c;&c;&c;&c;&c;&c;&c;">]>'
        + scene.replace("gaussians.ply", "&d;")
    ),
    "an entity of a file": lambda scene: (
        '<!DOCTYPE a [<!ENTITY a SYSTEM "file:///etc/passwd">]>'
        + scene.replace("gaussians.ply", "&a;")
    ),
    "a thousand levels": lambda scene: scene.replace(
        "</scene>", "<shape>" * 1000 + "</shape>" * 1000 + "</scene>"
    ),
    "an unknown version": lambda scene: scene.replace("3.0.0", "99.0.0"),
    "no version": lambda scene: scene.replace(' version="3.0.0"', ""),
    "a singular pose": lambda scene: scene.replace(
        '<lookat origin="4, 0, 1" target="0, 0, 0" up="0, 0, 1"/>', '<scale value="0"/>'
    ),
    "a pose towards itself": lambda scene: scene.replace('origin="4, 0, 1"', 'origin="0, 0, 0"'),
    "a pose of NaN": lambda scene: scene.replace('origin="4, 0, 1"', 'origin="nan, 0, 1"'),
    "a pose far away": lambda scene: scene.replace('origin="4, 0, 1"', 'origin="1e30, 0, 1"'),
    "a mirrored pose": lambda scene: scene.replace(
        '<lookat origin="4', '<scale x="-1"/><lookat origin="4'
    ),
    "a stretched pose": lambda scene: scene.replace(
        '<lookat origin="4', '<scale x="5"/><lookat origin="4'
    ),
}
"""Scenes made of the attack folder's, by name."""


def _sensor(scene: str) -> str:
    return scene[scene.index("<sensor") : scene.index("</sensor>") + len("</sensor>")]


def _rewrite(change: Callable[[str], str], folder: Path) -> None:
    (folder / "splats.xml").write_text(change(SPLATS))


def object_attacks() -> Iterator[Attack]:
    """Scenes that are put together otherwise."""
    command, words = WORDS
    for name, change in OBJECTS.items():
        yield Attack(f"object/{name}", command, words, partial(_rewrite, change), risky=True)


def _attack(name: str, place: str, text: str) -> Attack:
    command, words = WORDS
    return Attack(name, command, words, partial(_change, place, text), risky=True)
