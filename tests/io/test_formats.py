"""Properties of all formats of Gaussians: files are read back, axes are kept, damage is refused."""

import re
import tracemalloc
import warnings
from dataclasses import replace

import numpy as np
import pytest
from support.attacks.mutations import mutate_bytes
from support.formats import (
    PRECISION,
    SH_C0,
    Z_TO_Y,
    assert_within,
    each_of,
    gaussians_within_ranges,
    matched,
    refusal,
)
from support.small_capture import FOCUS, photograph, pose_around, view

from drgs.core import memory
from drgs.core.errors import UserError
from drgs.gaussians.parameters import Gaussians
from drgs.io.formats import format_for, read_gaussians, readable_formats, writable_formats
from drgs.io.ply import encode_elements, read_elements
from drgs.io.quantization import MORTON_BITS, morton_order

pytestmark = pytest.mark.filterwarnings("ignore:.*left out")

MUTATIONS = 300  # of each format

FORMATS = [f for f in writable_formats() if f in readable_formats()]
each_format = pytest.mark.parametrize("each", each_of(FORMATS))
checked = pytest.mark.parametrize(
    "each", each_of([f for f in FORMATS if not f.value.allows_nonfinite])
)


@each_format
@pytest.mark.parametrize(("num", "degree"), [(1, 0), (600, 0), (600, 1), (600, 2), (600, 3)])
def test_round_trip_is_within_the_precision_of_the_format(tmp_path, each, num, degree):
    path = tmp_path / f"a{each.value.suffix}"
    expected = gaussians_within_ranges(num, degree)
    expected.save(path)
    found = Gaussians.load(path)
    assert found.sh_degree == (degree if each.value.has_harmonics else 0)
    assert all(getattr(found, n).dtype == np.float32 for n in ("means", "quats", "sh0", "shN"))
    assert_within(PRECISION[each.name], expected, matched(expected, found))


@each_format
def test_equal_gaussians_give_equal_bytes(each):
    first, second = (gaussians_within_ranges().to_bytes(each.name) for _ in range(2))
    assert first == second


@pytest.mark.slow
@pytest.mark.parametrize("each", each_of([f for f in FORMATS if f.name != "usd"]))  # not Python's
def test_too_large_files_are_refused_before_allocation(tmp_path, monkeypatch, each):
    path = tmp_path / f"a{each.value.suffix}"
    gaussians_within_ranges(50_000).save(path)
    Gaussians.load(path)  # imports
    tracemalloc.start()
    Gaussians.load(path)
    peak = tracemalloc.get_traced_memory()[1]
    monkeypatch.setattr(memory, "UNCHECKED_FILE_BYTES", 0)
    monkeypatch.setattr(memory, "available_memory", lambda: 0.9 * peak)
    tracemalloc.reset_peak()
    assert " of memory, of which" in refusal(path)
    assert tracemalloc.get_traced_memory()[1] < 0.6 * peak
    tracemalloc.stop()
    monkeypatch.setattr(memory, "available_memory", lambda: 3 * peak)
    Gaussians.load(path)


@checked
def test_what_a_format_cannot_hold_is_not_written(tmp_path, each):
    path, gaussians = tmp_path / f"a{each.value.suffix}", gaussians_within_ranges(5)
    with pytest.raises(UserError, match=r"no room for the smoothing of Gaussians: bake it"):
        replace(gaussians, smoothing=np.ones(5, np.float32)).save(path)
    gaussians.log_scales[3, 1] = np.nan
    with pytest.raises(UserError, match=r"log_scales of Gaussian 3 must be finite, got nan"):
        gaussians.save(path)
    assert not list(tmp_path.iterdir())


@each_format
@pytest.mark.parametrize("field", ["means", "quats", "log_scales", "logit_opacities", "sh0", "shN"])
def test_arrays_of_other_shapes_are_not_written(tmp_path, each, field):
    gaussians = gaussians_within_ranges(5)
    values = getattr(gaussians, field)
    for wrong in (values[:-1], values[..., None], values.astype(str)):
        object.__setattr__(gaussians, field, wrong)
        named = field if len(wrong) == 5 or field != "means" else "quats"  # one more than means
        with pytest.raises(UserError, match=rf"the format {each.name}: {named}"):
            gaussians.save(tmp_path / f"a{each.value.suffix}")
    assert not list(tmp_path.iterdir())


@each_format
@pytest.mark.parametrize(
    ("field", "value"), [("sh0", 90), ("shN", 30), ("log_scales", 60), ("log_scales", -200)]
)
def test_a_note_says_what_a_format_cuts_off(tmp_path, each, field, value):
    """A note is given exactly where what is read differs from what was written."""
    path, gaussians = tmp_path / f"a{each.value.suffix}", gaussians_within_ranges(40, degree=1)
    rows = [7, 9]
    getattr(gaussians, field)[rows] = value
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        gaussians.save(path)
    found = getattr(matched(gaussians, Gaussians.load(path)), field)
    changed = found.size and np.abs(np.abs(found[rows]) - abs(value)).max() > 0.02 * abs(value)
    notes = [str(warning.message) for warning in caught if "cut" in str(warning.message)]
    assert len(notes) == bool(changed)
    if changed:
        assert each.name in notes[0] and re.search(r"\b2 (of 40 Gaussians|\(it holds )", notes[0])


def test_the_longest_suffix_decides_the_format():
    assert format_for("a.compressed.ply").name == "compressed-ply"
    assert format_for("A.PLY").name == "ply"
    assert format_for("a.obj") is None


@pytest.mark.slow
@checked
@pytest.mark.filterwarnings("ignore:.*(infinite logits|extensions of a vendor)")
def test_damaged_files_are_read_or_refused_by_file(tmp_path, each):
    """Nothing comes but finite Gaussians or a UserError that begins with the file."""
    path = tmp_path / f"a{each.value.suffix}"
    content = gaussians_within_ranges(40, degree=1).to_bytes(each.name)
    refused = 0
    for seed in range(MUTATIONS):
        path.write_bytes(mutate_bytes(np.random.default_rng(seed), content))
        try:
            found = Gaussians.load(path)
        except UserError as error:
            refused += 1
            assert re.match(rf"{re.escape(str(path))}: \w", str(error)), error
            continue
        values = (found.means, found.quats, found.log_scales, found.logit_opacities, found.shN)
        assert all(np.isfinite(v).all() for v in values)
    assert refused > MUTATIONS // 5  # the others change a number


@checked
def test_truncated_file_is_refused_at_any_length(tmp_path, each):
    path = tmp_path / f"a{each.value.suffix}"
    content = gaussians_within_ranges(1, degree=1).to_bytes(each.name)
    count = 20 if each.name == "usd" else 200  # USD is read in a process of its own
    for end in range(0, len(content), max(1, len(content) // count)):
        path.write_bytes(content[:end])
        assert refusal(path)


@pytest.mark.parametrize("names", [("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r",)])
def test_bounds_of_a_compressed_file_give_finite_numbers_or_are_refused(tmp_path, names):
    path = tmp_path / "a.compressed.ply"
    gaussians_within_ranges().save(path)
    rows, _ = read_elements(path, ["chunk", "vertex", "sh"])
    for name in names:
        rows["chunk"][f"min_{name}"], rows["chunk"][f"max_{name}"] = -3e38, 3e38
    path.write_bytes(encode_elements(rows))
    if names == ("r",):
        assert refusal(path).startswith("sh0 of Gaussian 0 must be finite, got ")
    else:
        read = Gaussians.load(path)
        assert np.isfinite(read.means).all() and np.isfinite(read.log_scales).all()


def test_points_are_sorted_by_interleaved_bits():
    cells = np.random.default_rng(0).integers(0, 2**MORTON_BITS, (300, 3))
    cells[:2] = [[0, 0, 0], [2**MORTON_BITS - 1] * 3]  # the box that cells are counted in
    cells[-1] = cells[-2]  # equal ones keep their order
    digits = [[f"{value:0{MORTON_BITS}b}" for value in cell[::-1]] for cell in cells]
    codes = ["".join(map("".join, zip(*digit, strict=True))) for digit in digits]
    expected = sorted(range(300), key=lambda index: (codes[index], index))
    assert morton_order(cells.astype(np.float32)).tolist() == expected
    assert morton_order(np.zeros((0, 3))).tolist() == []


# ----------------------------------------------------------------------------------------------
# Axes: a scene looks the same in a file, from a camera turned with its axes
# ----------------------------------------------------------------------------------------------

ROUNDING = {
    "ply": 0,
    "compressed-ply": 1 / 64,
    "spz": 9 / 256,
    "glb": 0,
    "sog": 1 / 255,
    "splat": 1 / 255,
    "usd": 0,
}
"""Largest error of an SH coefficient by format, which exceeds any other error of a colour; for
``splat``, which has none, of a base colour."""


def asymmetric_scene() -> Gaussians:
    """Three long ellipsoids of different lengths along x, y and z, each with a colour of its own
    that depends on where one looks from; no symmetry of the world leaves them as they are."""
    rng = np.random.default_rng(2)
    colors = np.array([[0.9, 0.2, 0.1], [0.1, 0.8, 0.3], [0.2, 0.3, 0.9]])
    return Gaussians(
        means=(FOCUS + np.diag([0.7, 0.5, 0.6])).astype(np.float32),
        quats=np.float32([[1, 0.1, 0, 0], [1, 0, 0.2, 0], [1, 0, 0.1, 0.3]]),
        log_scales=np.log(np.float32([[0.5, 0.1, 0.05], [0.1, 0.4, 0.2], [0.15, 0.07, 0.3]])),
        logit_opacities=np.float32([2, 1.5, 1]),
        sh0=((colors - 0.5) / SH_C0)[:, None].astype(np.float32),
        shN=rng.uniform(-0.35, 0.35, (3, 15, 3)).astype(np.float32),
    )


def rendered(gaussians: Gaussians, rotation: np.ndarray) -> np.ndarray:
    """Render by the float64 reference, from a camera turned about the origin."""
    pose = pose_around(0.7, 0.4)
    pose[:3] = rotation @ pose[:3]
    black = np.zeros((1, 1, 3), np.float32)
    return photograph(gaussians, view("a", pose, black), np.zeros(3)).image


def difference(found: np.ndarray, expected: np.ndarray) -> float:
    seen = expected.max(axis=2) > 0.1
    return float(np.sqrt(np.square(found - expected)[seen].mean()))


@each_format
def test_scene_renders_the_same_in_the_axes_of_the_file(tmp_path, each):
    scene = asymmetric_scene()
    scene.save(tmp_path / f"a{each.value.suffix}")
    if not each.value.has_harmonics:
        scene = replace(scene, shN=scene.shN[:, :0])
    expected = rendered(scene, np.eye(3))
    _, arrays, _ = read_gaussians(tmp_path / f"a{each.value.suffix}")
    rotation = Z_TO_Y if each.value.up == "y" else np.eye(3)
    found = rendered(Gaussians(**arrays), rotation)
    # Rounding errors are uniform: of a third of their largest square; the squares of the 15
    # harmonics add up to 15 / (4 pi). Three times that, and what float32 leaves.
    limit = 3 * ROUNDING[each.name] * np.sqrt(15 / (4 * np.pi) / 3) + 1e-5
    assert difference(found, expected) <= limit
    again = rendered(Gaussians.load(tmp_path / f"a{each.value.suffix}"), np.eye(3))
    assert difference(again, expected) <= limit
    assert difference(rendered(scene, Z_TO_Y), expected) > 0.1  # what no turn would be
