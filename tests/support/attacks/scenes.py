"""Attacks by Mitsuba scenes: every property of the plugins, and what Mitsuba has around them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from drgs.config.approximations import DECLARED
from support.attacks.attack import Attack, label
from support.attacks.attack_folder import SPLATS

WORDS = ("splats.xml", "--out", "out")

VALUES = {
    "float": ("0", "-1", "nan", "inf", "1e-40", "1e-30", "0.5", "1", "3", "1e10", "1e30", "1e38"),
    "integer": ("0", "-1", "1", "3", "17", "1000000000", "2147483647", "9223372036854775807"),
    "string": (
        *("", "x", "ewa", "exact", "a:depth", "motion", "gaussians.ply", "sky.png", "x" * 3000),
    ),
    "boolean": ("true", "false"),
    "rgb": ("0, 0, 0", "-1, 0, 2", "nan, 0, 0", "1e30, 1e30, 1e30"),
    "spectrum": ("0.5", "400:1, 700:0"),
    "point": ("0, 0, 0", "nan, 0, 0"),
}
"""Property values, by XML tag."""

SPLATS_PROPERTIES = (
    *("filename", "to_world", "shapes_to_world", "sh_degree", "background", "hide_emitters"),
    *("nested_spp", "near", "srgb_primitives", "aovs", "ignore", "smoothing", "means", "shN"),
    *("feature_a", "nonsense", *DECLARED),
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


PLACES = {
    "splats": ('<integrator type="splats">', SPLATS_PROPERTIES),
    "calibrated": ('<sensor type="perspective">', CALIBRATED),
    "sensor": ('<sensor type="perspective">', SENSOR_PROPERTIES),
    "lens": ('<sensor type="perspective">', SENSOR_PROPERTIES),
    "film": ('<film type="hdrfilm">', FILM),
    "sampler": ('<sampler type="independent">', ("sample_count", "seed")),
}
"""Objects of a scene that get another property: their beginning, and properties."""

OTHER_SIDE = {"width": "height", "height": "width"}


def _insert(place: str, name: str, text: str, folder: Path) -> None:
    """Add a property to an object of the scene, in place of one of that name."""
    start = PLACES[place][0]
    lines = [line for line in SPLATS.splitlines() if f'name="{name}"' not in line or start in line]
    if name in OTHER_SIDE:
        text += f'<integer name="{OTHER_SIDE[name]}" value="16"/>'
    scene = "\n".join(lines).replace(start, f"{start}\n{text}")
    if place == "lens":
        scene = scene.replace('"perspective"', '"thinlens"')
    if place == "calibrated":
        scene = scene.replace('"perspective"', '"calibrated"')
        scene = scene.replace('<float name="fov" value="40"/>', '<float name="fx" value="30"/>')
    (folder / "splats.xml").write_text(scene)


def property_attacks() -> Iterator[Attack]:
    """Every property of the plugins, of sensors, films and samplers, with values of every type."""
    for place, (_, names) in PLACES.items():
        for name in names:
            for tag, values in VALUES.items():
                for value in values:
                    text = f'<{tag} name="{name}" value="{value}"/>'
                    change = partial(_insert, place, name, text)
                    full = f"property/{place}/{name} {tag}={label(value)}"
                    yield Attack(full, "render", WORDS, change)


def _file(tag: str, kind: str, name: str) -> str:
    return f'<{tag} type="{kind}"><string name="filename" value="{name}"/></{tag}>'


SENSOR = SPLATS[SPLATS.index("<sensor") : SPLATS.index("</sensor>") + len("</sensor>")]
AOV = '<integrator type="aov"><string name="aovs" value="d:depth"/><integrator type="splats">'
PATH, DIRECT, NESTED = (f'<integrator type="{kind}"/>' for kind in ("path", "direct", "splats"))
POSE = '<lookat origin="4, 0, 1" target="0, 0, 0" up="0, 0, 1"/>'

ENTITIES = "".join(
    f'<!ENTITY {name} "{text * 10}">'
    for name, text in (("a", "a"), ("b", "&a;"), ("c", "&b;"), ("d", "&c;"))
)
"""Ten thousand letters."""

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
"""What comes at the scene's end."""

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
"""Scenes, by name."""


def _rewrite(scene: str, folder: Path) -> None:
    (folder / "splats.xml").write_text(scene)


def object_attacks() -> Iterator[Attack]:
    """Scenes that are put together otherwise."""
    for name, scene in OBJECTS.items():
        yield Attack(f"object/{name}", "render", WORDS, partial(_rewrite, scene))
