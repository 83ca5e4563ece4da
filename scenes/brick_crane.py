"""The shipped scene: a brick-built crane truck lifting a load of bricks, for ``drgs.capture``.

Our own design, under the licence of this repository; no commercial set or data set was copied.

Lengths are in studs, with x to the truck's front, y to its left and z up from the base plate's
top. The numbers are where a part sits: read them beside an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import mitsuba as mi
import numpy as np
from bricks import PLATE, STUD_HEIGHT, Builder, rotation

SCALE = 0.068  # world units per stud: the model lies within [-1.2, 1.2]^3
MIDDLE_STUDS = 4.6  # studs: this height is z = 0 in the world
BOOM_PITCH, BOOM_LENGTH = 42, 18  # degrees, studs
LOAD_HEIGHT = 2.0  # studs above the deck
STEPS = np.linspace(0, 1, 16)  # along a hose


def base(b: Builder) -> None:
    """A road of tiles between grass and a building site."""
    b.block(-16, -11, -2, 32, 22, 1, "dark grey", studs=False)
    for x, y in product(range(-16, 16, 4), range(-7, 5, 2)):
        b.tile(x, y, -1, 4, 2, "asphalt" if (x // 4 + y // 2) % 2 else "asphalt 2")
    for x in range(-16, 16, 4):
        b.plate(x, -11, -1, 4, 2, "tan")
        b.plate(x, -9, -1, 4, 2, "tan")
        b.plate(x, 6, -1, 4, 3, "green")
        b.plate(x, 9, -1, 4, 2, "green")
        b.tile(x, 5, -1, 4, 1, "light grey")
        b.tile(x, 5, 0, 4, 1, "light grey")
        b.tile(x + 1, -6.7, -0.8, 2, 0.5, "white")


def truck(b: Builder) -> None:
    """Chassis, wheels, deck and outriggers; the cab is separate."""
    for x in (-9.6, -5.6, 9.2):
        for side in (-1, 1):
            # Its outer side faces away from the truck.
            with b.at(x, 4.1 * side, 1.75, yaw=90 * side), b.at(0, 0, 0, pitch=-90):
                b.wheel(1.75, 1.5)
        b.rod((x, -3, 1.75), (x, 3, 1.75), 0.25, "dark grey")
    for x in range(-13, 11, 4):
        b.block(x, -2, 5, 4, 4, 4, "dark grey", studs=False)
    for x in range(-13, 7, 2):
        for y in (-4, 3):
            b.plate(x, y, 9, 2, 1, "blue")
        for y in (-3, 0):
            b.plate(x, y, 9, 2, 3, "light grey")
    for side in (-1, 1):
        y = 2.3 if side > 0 else -4.1
        b.rod((1.4, 3.2 * side, 2.5), (5.4, 3.2 * side, 2.5), 0.85, "chrome", 32)  # tanks
        for x in (2.1, 4.5):
            b.box(x, y, 1.6, 0.3, 1.8, 2.0, "black")
        for x in (-2.6, -0.6):
            b.block(x, y, 5, 2, 1.8, 4, "blue", studs=False)
            b.box(x + 0.7, 4.1 * side - 0.06, 2.9, 0.6, 0.12, 0.16, "chrome")
        for x in (-12.6, 6.2):  # outriggers
            b.box(x - 0.4, min(2 * side, 6.4 * side), 2.5, 0.8, 4.4, 0.7, "yellow")
            b.rod((x, 5.9 * side, 0.3), (x, 5.9 * side, 3.6), 0.2, "chrome")
            b.rod((x, 5.9 * side, 2.0), (x, 5.9 * side, 4.2), 0.36, "dark grey")
            with b.at(x, 5.9 * side, 0.0):
                b.lathe([(0.95, 0), (0.95, 0.25), (0.5, 0.45), (0, 0.45)], "black", 24)
        b.box(-13.5, 2.4 * side - 0.9, 2.2, 0.5, 1.8, 1.0, "dark grey")
        b.box(-13.6, 2.4 * side - 0.6, 2.5, 0.12, 0.5, 0.4, "red")
        b.box(-13.6, 2.4 * side + 0.1, 2.5, 0.12, 0.5, 0.4, "orange")
        for x in range(-12, -8, 1):  # railing
            b.rod((x, 3.85 * side, 4), (x, 3.85 * side, 5.4), 0.08, "black")
        b.rod((-12, 3.85 * side, 5.4), (-9, 3.85 * side, 5.4), 0.08, "black")


def cab(b: Builder) -> None:
    """The driver's cab, x 7 to 13."""
    b.block(7, -4, 9, 6, 8, 1, "dark grey", studs=False)
    for y in (-4, 3):
        b.wall(7, y, 10, 6, 1, 1, "blue")
        b.block(7, y, 13, 6, 1, 1, "white", studs=False)
        b.block(7, y, 14, 6, 1, 2, "blue", studs=False)
    for x, d in ((7, 6), (12, 6)):
        b.wall(x, -3, 10, 1, d, 1, "blue")
        b.block(x, -3, 13, 1, d, 1, "white", studs=False)
        b.block(x, -3, 14, 1, d, 2, "blue", studs=False)
    for y in (-4.0, -0.15, 3.7):  # pillars and window bars
        b.box(7, y, 6.4, 0.3, 0.3, 2.8, "blue")
        if y != -0.15:
            b.box(12.7, y, 6.4, 0.3, 0.3, 2.8, "blue")
            b.box(9.6, y, 6.4, 0.25, 0.3, 2.8, "blue")
    for x in range(7, 13, 2):
        b.plate(x, -4, 23, 2, 4, "white")
        b.plate(x, 0, 23, 2, 4, "white")
    b.slope(13, -4, 23, 0.9, 8, 1.6, "blue")  # sun visor
    # Inside: two seats, dashboard, steering wheel.
    for y in (-2.7, 0.9):
        b.box(8.2, y, 4.2, 2, 1.8, 1.6, "red")
        b.box(8.0, y, 5.6, 0.5, 1.8, 2.4, "red")
    b.slope(12, -3, 14, -1.4, 6, 3, "dark grey")
    with b.at(10.9, 1.8, 6.6, pitch=-60), b.at(0, 0, 0, pitch=90):
        ring = [(0.75 + 0.1 * np.sin(a), -0.1 * np.cos(a)) for a in np.arange(9) * np.pi / 4]
        b.lathe(ring, "black", 24)
        b.rod((-0.7, 0, 0), (0.7, 0, 0), 0.08, "black")
    # Face: bumper, grille, headlights.
    b.block(12.4, -4, 4, 1.2, 8, 3, "white", studs=False)
    b.block(12.2, -4, 7, 0.8, 8, 3, "dark grey", studs=False)
    for i in range(4):
        b.box(12.98, -1.9, 4.15 + 0.5 * i, 0.14, 3.8, 0.24, "black")
    for y in (-3.0, 3.0):
        b.rod((12.9, y, 4.9), (13.2, y, 4.9), 0.55, "chrome", 24)
        b.rod((13.1, y, 4.9), (13.26, y, 4.9), 0.42, "lamp", 24)
        b.rod((13.5, y, 2.2), (13.72, y, 2.2), 0.3, "orange", 20)
    b.box(13.55, -0.9, 1.9, 0.1, 1.8, 0.5, "yellow")
    for side in (-1, 1):
        y = 4.0 * side
        b.rod((12.6, y, 6.6), (12.9, y + 0.8 * side, 6.9), 0.08, "black")  # mirrors
        b.rod((12.9, y + 0.8 * side, 6.9), (12.9, y + 0.8 * side, 8.6), 0.08, "black")
        b.box(12.75, y + 0.8 * side - 0.35, 7.2, 0.25, 0.7, 1.2, "black")
        b.box(9.3, y - 0.08, 5.7, 0.7, 0.16, 0.14, "chrome")  # door handle
        for z in (1.2, 2.2, 3.2):  # ladder
            b.rod((11.3, y, z), (12.1, y, z), 0.1, "chrome")
        for x in (11.3, 12.1):
            b.rod((x, y, 0.9), (x, y, 3.7), 0.1, "chrome")
    for y in (-2.5, 2.5):  # beacons
        with b.at(11.5, y, 24 * PLATE + STUD_HEIGHT):
            b.lathe([(0.42, 0), (0.42, 0.25), (0.34, 0.25), (0.34, 0.7), (0, 0.85)], "orange", 24)
    for i in range(4):
        b.rod((13.1, -1.5 + i, 10.1), (13.4, -1.5 + i, 10.1), 0.32, "lamp", 20)
    b.rod((13.1, -2, 9.75), (13.1, 2, 9.75), 0.09, "black")
    b.rod((7.5, 3.5, 9.6), (6.6, 3.9, 13.2), 0.06, "black")  # antenna
    b.rod((6.3, 3.2, 4), (6.3, 3.2, 10.6), 0.3, "chrome", 24)  # exhaust
    b.rod((6.3, 3.2, 5.4), (6.3, 3.2, 8.2), 0.45, "dark grey", 24)
    b.wall(5, -3, 10, 1, 5, 2, "dark grey")


def crane(b: Builder) -> None:
    """The superstructure around the turntable's axis, its boom, ropes and load."""
    b.lathe([(3.1, 0), (3.1, 0.3), (2.8, 0.3), (2.8, 0.8), (0, 0.8)], "dark grey", 48)
    for x in range(-6, 4, 2):
        b.plate(x, -3, 2, 2, 6, "dark grey")
    b.wall(-5, -3, 3, 4, 2, 2, "orange")
    b.wall(-5, -1, 3, 4, 2, 2, "orange")
    b.wall(-5, 1, 3, 4, 2, 2, "orange")
    for x in (-5, -3):
        b.block(x, -3, 9, 2, 6, 1, "orange", studs=x == -3)
    for y in (-3, -1, 1):
        b.block(-6, y, 3, 1, 2, 3, "light grey", studs=False)
        b.block(-6, y, 6, 1, 2, 4, "light grey", studs=False)
    for side in (-1, 1):
        for i in range(5):
            b.box(-4.4 + 0.55 * i, 3.0 * side - 0.07, 1.7, 0.25, 0.14, 1.5, "black")
        b.box(-6.06, 1.4 * side - 0.9, 2.0, 0.12, 1.8, 0.5, "red")
        b.box(0.2, 1.25 * side - 0.2, 1.2, 1.8, 0.4, 1.6, "dark grey")  # boom bracket
        with b.at(-2.2, 1.3 * side, 4.0):  # gantry
            b.rod((0.6, 0, 0), (-1.2, -0.3 * side, 4.6), 0.18, "yellow")
            b.rod((-2.2, 0, 0), (-1.2, -0.3 * side, 4.6), 0.18, "yellow")
    b.rod((-3.4, -1.3, 8.6), (-3.4, 1.3, 8.6), 0.25, "dark grey")
    b.rod((-2.6, -1.9, 4.7), (-2.6, 1.9, 4.7), 0.55, "brown", 24)  # winch
    for y in (-1.5, 1.5):
        b.rod((-2.6, y - 0.1, 4.7), (-2.6, y + 0.1, 4.7), 0.9, "dark grey", 28)
    b.rod((1, -1.6, 2.2), (1, 1.6, 2.2), 0.32, "chrome", 20)
    operator_cab(b)
    for y in (-0.5, 0.5):
        arc = [(3.4 * t - 1, y, 3.2 + 1.9 * np.sin(2.2 * t) - 0.2 * t) for t in STEPS]
        b.hose(arc, 0.14, "black")
    with b.at(1, 0, 2.2, pitch=BOOM_PITCH):
        boom(b)
    x, _, z = np.array([1, 0, 2.2]) + rotation(1, -BOOM_PITCH) @ [BOOM_LENGTH, 0, 0]
    for y in (-0.35, 0.35):
        b.rod((-3.4, y * 2, 8.7), (x - 0.3, y, z + 0.5), 0.07, "black", 8)
        b.rod((x + 0.55, 0.4 * y, z), (x + 0.55, 0.4 * y, LOAD_HEIGHT + 7), 0.06, "black", 8)
    with b.at(x + 0.55, 0, LOAD_HEIGHT, yaw=20):
        load(b)


def cargo(b: Builder) -> None:
    """Put a load on the deck: a spare wheel, a crate, a coil of rope, barrels."""
    with b.at(3.0, 2.0, 5.6):
        b.wheel(1.6, 1.3)
    for z in (10, 11, 12):
        b.block(-0.5, 1.2, z, 2, 2, 1, "brown" if z != 11 else "tan", studs=z == 12)
    with b.at(0.8, -1.0, 4.2):
        for z in (0.15, 0.45, 0.75):
            angles = np.arange(9) * np.pi / 4
            b.lathe([(0.8 + 0.17 * np.sin(a), z - 0.17 * np.cos(a)) for a in angles], "tan", 28)
    for x, y, color in ((2.4, -2.9, "red"), (3.9, -2.9, "red"), (3.2, -1.6, "yellow")):
        b.num_parts += 1
        with b.at(x, y, 4.2):
            for z in (0, 0.85):
                b.lathe([(0.6, z), (0.66, z + 0.06), (0.6, z + 0.12), (0.6, z + 0.85)], color, 28)
            b.lathe([(0.6, 1.7), (0.66, 1.76), (0.6, 1.82), (0.5, 1.76), (0, 1.76)], color, 28)


def operator_cab(b: Builder) -> None:
    """The crane operator's cab, on the right of the boom."""
    b.block(0, -4, 3, 3, 2, 3, "orange", studs=False)
    b.block(0, -4, 13, 3, 2, 1, "orange", studs=True)
    for x, y in product((0, 2.75), (-4, -2.25)):
        b.box(x, y, 2.4, 0.25, 0.25, 2.8, "orange")
    b.box(0.5, -3.6, 2.4, 1.2, 1.2, 0.5, "black")
    b.box(0.4, -3.6, 2.4, 0.3, 1.2, 1.6, "black")
    b.rod((2.2, -3, 2.4), (2.0, -3, 3.4), 0.1, "chrome")


def boom(b: Builder) -> None:
    """A lattice boom along x from the pivot: four chords, braced on all sides."""
    stations = np.linspace(0.6, BOOM_LENGTH - 0.8, 12)
    widths = np.interp(stations, [0, 4, 14, BOOM_LENGTH], [0.75, 0.9, 0.8, 0.4])
    heights = np.interp(stations, [0, 4, 14, BOOM_LENGTH], [0.35, 0.9, 0.8, 0.4])
    signs = [(-1, -1), (-1, 1), (1, 1), (1, -1)]
    chords = [np.stack([stations, sy * widths, sz * heights], axis=1) for sy, sz in signs]
    for first, second in zip(chords, chords[1:] + chords[:1], strict=True):
        b.hose(first, 0.17, "yellow")
        for i in range(len(stations) - 1):
            start, end = (first, second) if i % 2 else (second, first)
            b.rod(start[i], end[i + 1], 0.1, "yellow", 8)
        b.rod(first[-1], second[-1], 0.15, "yellow")
        b.rod(first[0], second[0], 0.15, "yellow")
    for side in (-1, 1):
        b.box(-0.4, 0.75 * side - 0.15, -0.5, 1.6, 0.3, 1.0, "yellow")
        b.box(BOOM_LENGTH - 1, 0.42 * side - 0.1, -0.45, 1.3, 0.2, 0.9, "dark grey")
    b.rod((BOOM_LENGTH, -0.32, 0), (BOOM_LENGTH, 0.32, 0), 0.55, "red", 24)  # sheave
    b.rod((BOOM_LENGTH - 0.2, 0, 0.4), (BOOM_LENGTH - 0.2, 0, 1.2), 0.07, "black")
    with b.at(BOOM_LENGTH - 0.2, 0, 1.1):
        b.lathe([(0.25, 0), (0.25, 0.3), (0, 0.42)], "red", 16)


def load(b: Builder) -> None:
    """A pallet of bricks below a hook."""
    b.box(-0.45, -0.5, 6.2, 0.9, 1.0, 1.0, "red")
    hook = [(0.35 * np.sin(a), 0, 5.5 - 0.35 * np.cos(a)) for a in np.linspace(-1.8, 3.14, 14)]
    b.hose([*hook, (0, 0, 6.3)], 0.12, "chrome")
    for x, y in product((-1.6, 1.6), (-1.6, 1.6)):
        b.rod((0, 0, 5.2), (x, y, 3.1), 0.07, "black", 8)
        b.rod((x, y, 3.1), (x, y, 0.2), 0.07, "black", 8)
    for y in (-2, -0.5, 1):
        b.tile(-2, y, 0, 4, 1, "brown")
    for x in (-2, -0.5, 1):
        b.tile(x, -2, -1, 1, 4, "brown")
    for z, color, other in ((1, "red", "yellow"), (4, "white", "red")):
        b.brick(-1.5, -1.5, z, 3, 1, color)
        b.brick(-1.5, -0.5, z, 1, 2, other)
        b.brick(-0.5, -0.5, z, 2, 2, color)


def surroundings(b: Builder) -> None:
    """A wall in the making, a street lamp, cones, plants and stacks of bricks."""
    b.wall(-11, -10, 0, 12, 1, 1, "brown")
    b.wall(-11, -10, 3, 8, 1, 1, "white")
    b.wall(-11, -10, 6, 2, 1, 2, "white")
    b.wall(-11, -9, 0, 1, 2, 1, "brown")
    b.wall(-11, -9, 3, 1, 2, 2, "white")
    b.brick(-5, -10, 6, 1, 1, "white")
    for x, z, w, h in ((-9, 2.4, 0.25, 3.2), (-5.25, 2.4, 0.25, 3.2), (-9, 5.35, 4, 0.25)):
        b.box(x, -9.9, z, w, 0.8, h, "red")  # window frame
    b.box(-7.1, -9.7, 2.4, 0.2, 0.4, 3.0, "red")
    b.box(-8.8, -9.7, 3.8, 3.6, 0.4, 0.2, "red")
    for i, (x, y, w, color) in enumerate(
        [(9, -10, 4, "white"), (9, -8, 3, "red"), (13, -9, 2, "yellow"), (3, -10, 3, "brown")]
    ):
        b.brick(x, y, 0, w, 2, color)
        if i % 2 == 0:
            b.brick(x, y, 3, 2, 2, "blue" if i else "red")
    for x, y in ((-13.5, -7.2), (10.5, -5.6), (14.2, -4.4)):
        b.box(x - 0.7, y - 0.7, 0, 1.4, 1.4, 0.2, "orange")
        with b.at(x, y, 0.2):
            b.lathe([(0.55, 0), (0.43, 0.6)], "orange", 24)
            b.lathe([(0.43, 0.6), (0.29, 1.3)], "white", 24)
            b.lathe([(0.29, 1.3), (0.15, 2.0), (0, 2.0)], "orange", 24)
    with b.at(-6, 8.5, 0):  # street lamp
        b.lathe([(1, 0), (1, 0.4), (0.5, 0.4), (0.5, 1.2), (0.22, 1.4), (0.22, 10)], "black", 24)
        arm = [(0, -2.6 * t * t, 10 + 1.2 * np.sin(1.57 * t)) for t in STEPS]
        b.hose(arm, 0.2, "black")
        b.box(-0.6, -3.9, 10.9, 1.2, 1.9, 0.35, "black")
        b.box(-0.4, -3.7, 10.75, 0.8, 1.5, 0.2, "lamp")
    for x, y, size in ((5, 8.5, 1.0), (12.5, 8.5, 0.75)):  # trees
        with b.at(x, y, 0):
            b.lathe([(0.45, 0), (0.45, 2 * size), (0, 2 * size)], "brown", 20)
            for i in range(3):
                r, z = (2.1 - 0.5 * i) * size, (1.6 + 1.7 * i) * size
                b.lathe([(0, z), (r, z), (r, z + 0.3), (0.35 * r, z + 1.9 * size)], "leaf", 28)
            b.lathe([(0.45 * size, 6.9 * size), (0, 7.6 * size)], "leaf", 28)
    for x, y, color in ((-13, 8, "red"), (-11, 9, "yellow"), (0, 7, "white"), (9, 8, "red")):
        with b.at(x + 0.5, y + 0.5, STUD_HEIGHT):
            b.rod((0, 0, 0), (0, 0, 0.8), 0.12, "leaf", 8)
            b.lathe([(0.2, 0.7), (0.5, 1.0), (0.2, 1.15), (0, 1.15)], color, 12)


def build() -> Builder:
    """The whole model, in studs."""
    b = Builder()
    base(b)
    surroundings(b)
    with b.at(-1, -1, 0):
        truck(b)
        cab(b)
        cargo(b)
        with b.at(-5, 0, 4, yaw=-28):
            crane(b)
    return b


def lamp(origin: Sequence[float], size: float, radiance: Sequence[float]) -> dict[str, Any]:
    """A square area light that shines on the model."""
    transform = mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 0, 1])
    return {
        "type": "rectangle",
        "to_world": transform @ mi.ScalarTransform4f().scale(size / 2),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}},
    }


def scene() -> dict[str, Any]:
    """The scene for Mitsuba, without a sensor."""
    return {
        "type": "scene",
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.58, 0.62, 0.68]}},
        "key": lamp([0.6, -3.6, 4.6], 2.4, [17, 15.6, 13.4]),
        "fill": lamp([3.6, 4.2, 3.2], 2.6, [6.0, 6.4, 7.0]),
        **build().meshes(SCALE, MIDDLE_STUDS),
    }
