"""USD that other programs may write: its variants, and what is refused by the prim."""

import contextlib
import os
import time

import numpy as np
import pytest
from support.formats import (
    PRECISION,
    Z_TO_Y,
    assert_within,
    gaussians_within_ranges,
    refusal,
    turned,
)

from drgs.core.errors import UserError, UserNote
from drgs.gaussians.parameters import Gaussians
from drgs.io import usd

pytest.importorskip("pxr.UsdVol", exc_type=ImportError)


def text(gaussians, attributes=(), transform="", kind="ParticleField3DGaussianSplat", up="Y"):
    """A stage in OpenUSD's text format, number by number."""

    def points(rows):
        return "[" + ", ".join("(" + ", ".join(map(repr, map(float, r))) + ")" for r in rows) + "]"

    sh = np.concatenate([gaussians.sh0, gaussians.shN], axis=1).reshape(-1, 3)
    quats = gaussians.quats.astype(np.float64)
    opacities = ", ".join(map(repr, map(float, gaussians.opacities)))
    given = {
        "point3f[] positions": points(gaussians.means),
        "quatf[] orientations": points(quats / np.linalg.norm(quats, axis=1, keepdims=True)),
        "float3[] scales": points(gaussians.scales),
        "float[] opacities": f"[{opacities}]",
        "int radiance:sphericalHarmonicsDegree": "1",
        "float3[] radiance:sphericalHarmonicsCoefficients": points(sh),
    } | dict(attributes)
    lines = "\n".join(f"{name} = {value}" for name, value in given.items() if value)
    return (
        f'#usda 1.0\n(\n    upAxis = "{up}"\n)\ndef Xform "World" {{\n{transform}\n'
        f'def {kind} "Splats" {{\n{lines}\n}}\n}}\n'
    )


@pytest.fixture
def gaussians():
    return gaussians_within_ranges(5, degree=1)


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_a_stage_is_read_with_its_axis_and_translation(tmp_path, gaussians, up):
    move = "double3 xformOp:translate = (4000000, 1, 2)\n"
    move += 'uniform token[] xformOpOrder = ["xformOp:translate"]'
    (tmp_path / "a.usda").write_text(text(gaussians, transform=move, up=up))
    rotation = Z_TO_Y.T if up == "Y" else np.eye(3)
    found = Gaussians.load(tmp_path / "a.usda")
    assert_within(PRECISION["glb"], turned(gaussians, rotation), found)
    np.testing.assert_array_equal(found.origin, rotation @ [4000000, 1, 2])
    assert found.rendered_with is None


def test_half_precision_and_animations_are_read(tmp_path, gaussians):
    rows = ", ".join(str(tuple(map(float, np.float16(row)))) for row in gaussians.means)
    halves = {"point3f[] positions": None, "point3h[] positionsh": f"[{rows}]"}
    (tmp_path / "a.usda").write_text(text(gaussians, halves, up="Z"))
    found = Gaussians.load(tmp_path / "a.usda")
    np.testing.assert_array_equal(found.means, np.float16(gaussians.means))
    first, second = (str([tuple(map(float, r * f)) for r in gaussians.means]) for f in (1, 2))
    moving = {
        "point3f[] positions": None,
        "point3f[] positions.timeSamples": f"{{ 3: {first}, 4: {second} }}",
    }
    (tmp_path / "a.usda").write_text(text(gaussians, moving, up="Z"))
    np.testing.assert_array_equal(Gaussians.load(tmp_path / "a.usda").means, gaussians.means)


def test_another_colour_space_is_a_note(tmp_path, gaussians):
    space = {"uniform token colorSpace:name": '"lin_rec709_scene"'}
    applied = '"Splats" (prepend apiSchemas = ["ColorSpaceAPI"]) {'
    content = text(gaussians, space).replace('"Splats" {', applied)
    (tmp_path / "a.usda").write_text(content)
    with pytest.warns(
        UserNote, match="prim /World/Splats: colours of the space lin_rec709_scene are"
    ):
        Gaussians.load(tmp_path / "a.usda")


TURNED = "float xformOp:rotateX = 90\n" + 'uniform token[] xformOpOrder = ["xformOp:rotateX"]'
REFUSED = {
    "no splats": ({"kind": "Sphere"}, "must have one ParticleField3DGaussianSplat, got none"),
    "turned": ({"transform": TURNED}, "prim /World/Splats: splats that a prim rotates or scales"),
    "positions": (
        {"attributes": {"point3f[] positions": None}},
        "prim /World/Splats: Positions: at least one expected, got 0",
    ),
    "count": (
        {"attributes": {"float[] opacities": "[0.5, 0.5]"}},
        "prim /World/Splats: Opacities: 5 of them expected, got 2",
    ),
    "opacity": (
        {"attributes": {"float[] opacities": "[0.5, 0, 1, 1.5, 0]"}},
        "prim /World/Splats: Opacities of Gaussian 3 must be from 0 to 1, got 1.5",
    ),
    "scale": (
        {"attributes": {"float3[] scales": str([(1, 1, -1.0)] * 5)}},
        "prim /World/Splats: Scales of Gaussian 0 must be at least 0, got -1.0",
    ),
    "harmonics": (
        {"attributes": {"float3[] radiance:sphericalHarmonicsCoefficients": "[(1, 1, 1)]"}},
        "prim /World/Splats: RadianceSphericalHarmonicsCoefficients: 1, 4, 9 or 16 for each of 5",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_wrong_stages_are_refused(tmp_path, gaussians, name):
    options, message = REFUSED[name]
    (tmp_path / "a.usda").write_text(text(gaussians, **options))
    assert refusal(tmp_path / "a.usda").startswith(message)


def test_another_file_is_refused(tmp_path):
    (tmp_path / "a.usda").write_text("hello")
    assert refusal(tmp_path / "a.usda").startswith("not a valid USD file: ")


HEAD = "#usda 1.0\n(\n    subLayers = [@{}@]\n)\n"
HOSTILE = {
    "nested": ("#usda 1.0\n" + 'def "a" {\n' * 100_000 + "}\n" * 100_000, "OpenUSD ended: SIGSEGV"),
    "a pipe below": (HEAD.format("./pipe.usda"), "files, which are not read (./pipe.usda)"),
    "a file elsewhere": (HEAD.format("/etc/hostname"), "refers to other files"),
    "a reference": ('#usda 1.0\ndef "a" (references = @../b.usda@) {}\n', "refers to other files"),
    "a payload": ('#usda 1.0\ndef "a" (payload = @b.usda@</a>) {}\n', "refers to other files"),
    "clips": (
        '#usda 1.0\ndef "a" (clips = { dictionary default = { asset[] assetPaths = [@./pipe.usda@] '
        'asset manifestAssetPath = @./pipe.usda@ string primPath = "/a" } }) {}\n',
        "",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_stages_are_refused_by_a_sentence(tmp_path, name):
    content, message = HOSTILE[name]
    os.mkfifo(tmp_path / "pipe.usda")
    (tmp_path / "a.usda").write_text(content)
    begun = time.monotonic()
    assert message in refusal(tmp_path / "a.usda")
    assert time.monotonic() - begun < 15


def test_a_file_takes_no_more_than_its_size_allows(tmp_path, gaussians, monkeypatch):
    gaussians.save(tmp_path / "a.usdc")
    monkeypatch.setattr(usd, "LEAST_BYTES", 1 << 24)
    assert refusal(tmp_path / "a.usdc").startswith("not a valid USD file: ")
    monkeypatch.setattr(usd, "LEAST_BYTES", 1 << 31)
    monkeypatch.setattr(usd, "LEAST_S", 0.02)
    assert "OpenUSD ended: it took longer than 0 s" in refusal(tmp_path / "a.usdc")
    monkeypatch.setattr(usd, "LEAST_S", 20.0)
    assert Gaussians.load(tmp_path / "a.usdc").num_gaussians == 5


def test_damaged_files_are_read_or_refused(tmp_path, gaussians):
    """Bytes are changed, removed and inserted; whatever OpenUSD does then ends in a sentence."""
    rng = np.random.default_rng(0)
    gaussians.save(tmp_path / "whole.usdc")
    content = (tmp_path / "whole.usdc").read_bytes()
    for k in range(24):
        place, other = rng.integers(len(content)), bytes(rng.integers(0, 256, 3, dtype=np.uint8))
        kept = content[place + (0, 3, 200)[k % 3] :]
        (tmp_path / "a.usdc").write_bytes(content[:place] + other + kept)
        with contextlib.suppress(UserError):
            assert np.isfinite(Gaussians.load(tmp_path / "a.usdc").means).all()
