"""Binary glTF: what stands in a file, what others may write, and what is refused by the place."""

import json
import struct

import numpy as np
import pytest
from support.datasets import set_value
from support.formats import distance_of_ellipsoids, gaussians_within_ranges, refusal

from drgs.gaussians.parameters import Gaussians

NAME = "KHR_gaussian_splatting"
WHERE = "meshes[0].primitives[0]"
PRIMITIVE = "meshes 0 primitives 0"
TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def split(content):
    """The JSON part as Python has it, and the binary part: as the specification's section 4.4."""
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def joined(document, binary):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    length = 28 + len(text) + len(binary)
    head = struct.pack("<4sIII4s", b"glTF", 2, length, len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def numbers(document, binary, name):
    """Return an attribute's first byte, and its numbers as section 3.6 defines them."""
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    accessor = document["accessors"][attributes[name]]
    view = document["bufferViews"][accessor["bufferView"]]
    start = view["byteOffset"]
    part = binary[start : start + view["byteLength"]]
    kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
    assert start % 4 == 0
    return start, np.frombuffer(part, kind).reshape(accessor["count"], TYPES[accessor["type"]])


@pytest.fixture
def gaussians():
    return gaussians_within_ranges(7, degree=2)


@pytest.fixture
def parts(gaussians):
    return split(gaussians.to_bytes("glb"))


def refused(path, document, binary):
    path.write_bytes(joined(document, binary))
    return refusal(path)


def test_a_file_follows_the_extensions_specification(gaussians, parts):
    document, binary = parts
    assert document["extensionsUsed"] == [NAME] and document["asset"]["version"] == "2.0"
    assert document["nodes"] == [{"mesh": 0}]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"] == {
        NAME: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    }
    x, y, z = gaussians.means.T
    expected = {
        "POSITION": (np.column_stack([x, z, -y]), 0),  # z up -> y up
        f"{NAME}:SCALE": (gaussians.scales, 1e-6),
        f"{NAME}:OPACITY": (gaussians.opacities[:, None], 1e-6),
        f"{NAME}:SH_DEGREE_0_COEF_0": (gaussians.sh0[:, 0], 0),
    }
    for name, (values, tolerance) in expected.items():
        _, found = numbers(document, binary, name)
        np.testing.assert_allclose(found, values, rtol=tolerance, err_msg=name)
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    position = expected["POSITION"][0]
    assert np.float32([accessor["min"], accessor["max"]]).tolist() == [
        position.min(axis=0).tolist(),
        position.max(axis=0).tolist(),
    ]
    _, rotations = numbers(document, binary, f"{NAME}:ROTATION")
    np.testing.assert_allclose(np.linalg.norm(rotations, axis=1), 1, rtol=1e-6)
    fallback, colors = numbers(document, binary, "COLOR_0")[1], 0.5 + 0.28209479 * gaussians.sh0
    np.testing.assert_allclose(fallback[:, :3] / 255, colors[:, 0], atol=0.5 / 255 + 1e-6)
    harmonics = [n for n in primitive["attributes"] if ":SH_DEGREE_" in n]
    assert harmonics[1:] == [
        f"{NAME}:SH_DEGREE_{degree}_COEF_{k}" for degree in (1, 2) for k in range(2 * degree + 1)
    ]


@pytest.mark.parametrize("extras", [7, None, [{"drgs": 1}], {"theirs": {"low_pass": []}}])
def test_foreign_extras_are_ignored(tmp_path, parts, extras):
    document, binary = parts
    document["meshes"][0]["primitives"][0]["extras"] = extras
    (tmp_path / "a.glb").write_bytes(joined(document, binary))
    assert Gaussians.load(tmp_path / "a.glb").rendered_with is None


@pytest.mark.parametrize(
    "extras",
    [
        [1, 2],
        None,
        {"low_pass": [0.1]},
        {"low_pass": None},
        {"low_pass": 10**400},
        {"order": "by\nhand"},
        {"Two words": 1},
    ],
)
def test_damaged_drgs_extras_are_refused(tmp_path, parts, extras):
    document, binary = parts
    document["meshes"][0]["primitives"][0]["extras"] = {"drgs": extras}
    expected = f"{WHERE}.extras.drgs: must be an object of names and values of one word, got "
    assert refused(tmp_path / "a.glb", document, binary).startswith(expected)


def test_interleaved_and_quantised_numbers_are_read(tmp_path, gaussians, parts):
    """Rotations in 16 bits and opacities in 8, all in rows of one part of the buffer."""
    document, binary = parts
    rows = np.zeros(7, [("rotation", "<i2", 4), ("opacity", "u1"), ("gap", "u1", 3)])
    rows["rotation"] = np.round(numbers(document, binary, f"{NAME}:ROTATION")[1] * 32767)
    rows["opacity"] = np.round(numbers(document, binary, f"{NAME}:OPACITY")[1][:, 0] * 255)
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": rows.nbytes, "byteStride": 12}
    document["bufferViews"].append(view)
    where = {"bufferView": len(document["bufferViews"]) - 1, "count": 7, "normalized": True}
    kinds = {"ROTATION": (0, 5122, "VEC4"), "OPACITY": (8, 5121, "SCALAR")}
    for name, (offset, kind, shape) in kinds.items():
        set_value(document, f"{PRIMITIVE} attributes {NAME}:{name}", len(document["accessors"]))
        accessor = {"byteOffset": offset, "componentType": kind, "type": shape}
        document["accessors"].append(where | accessor)
    (tmp_path / "a.glb").write_bytes(joined(document, binary + rows.tobytes()))
    found = Gaussians.load(tmp_path / "a.glb")
    np.testing.assert_allclose(found.opacities, gaussians.opacities, atol=0.5 / 255 + 1e-6)
    assert distance_of_ellipsoids(found.quats, gaussians.quats).max() <= 0.5 / 32767 * 2 + 1e-6


EXTENSION = f"{PRIMITIVE} extensions {NAME}"
SCALED = {"children": [0], "scale": [2, 2, 2]}


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (f"{PRIMITIVE} mode", 4, f"{WHERE}.mode must be one of 0, got 4"),
        (f"{EXTENSION} kernel", "cube", f"{WHERE}.extensions.{NAME}.kernel must be one of"),
        (f"{EXTENSION} colorSpace", "lin_rec709_display", f"{WHERE}.extensions.{NAME}.colorSpace"),
        (f"{EXTENSION} extensions", {"a": {}}, f"{WHERE}.extensions.{NAME}.extensions "),
        (f"{PRIMITIVE} extensions", {}, f"must have one primitive with {NAME}"),
        ("extensionsRequired", ["KHR_draco"], f"extensionsRequired[0] must be one of '{NAME}', g"),
        (f"{PRIMITIVE} attributes {NAME}:SCALE", None, f"{WHERE}: attributes {NAME}:SCALE are mis"),
        (
            f"{PRIMITIVE} attributes {NAME}:SH_DEGREE_2_COEF_3",
            None,
            f"{WHERE}: harmonics must be complete: all those below",
        ),
        (f"{PRIMITIVE} attributes POSITION", 99, "accessors[99] must be there, got "),
        ("accessors 0 count", 8, f"{WHERE}: POSITION: 8 times VEC3 in 96 bytes"),
        ("accessors 2 type", "VEC3", f"{WHERE}: {NAME}:ROTATION: 7"),
        ("accessors 0 sparse", {}, "accessors[0].sparse must be None"),
        ("bufferViews 0 byteLength", 2**31, f"{WHERE}: POSITION: 7 times VEC3 in 84 bytes"),
        ("bufferViews 0 buffer", 1, "bufferViews[0].buffer must be one of 0, got 1"),
        ("nodes 0 scale", [2, 2, 2], "nodes[0].scale: splats that a node rotates or scales are"),
        ("nodes 0 translation", [1, 0, 1e13], "nodes[0].translation[2] must be <= 1e+12"),
        ("nodes", [{"mesh": 0}, {"mesh": 0}], "the splats must be shown once, got 2 nodes"),
        ("nodes", [{"mesh": 0}, SCALED], "nodes[1].scale: splats"),
        ("meshes", {}, "meshes must be a list, got {}"),
    ],
)
def test_invalid_document_is_refused(tmp_path, parts, path, value, message):
    document, binary = parts
    set_value(document, path, value)
    assert refused(tmp_path / "a.glb", document, binary).startswith(message)


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("SCALE", -4.5, "must be at least 0, got -4.5"),
        ("OPACITY", 1.5, "must be from 0 to 1, got 1.5"),
        ("ROTATION", np.nan, "must be finite, got nan"),
    ],
)
def test_a_number_out_of_range_is_refused_by_its_row(tmp_path, parts, attribute, value, message):
    document, binary = parts
    start, there = numbers(document, binary, f"{NAME}:{attribute}")
    at = start + 5 * 4 * there.shape[1]
    changed = binary[:at] + struct.pack("<f", value) + binary[at + 4 :]
    text = refused(tmp_path / "a.glb", document, changed)
    assert text.startswith(f"{NAME}:{attribute} of Gaussian 5 {message}")


def test_zero_scales_and_opacities_are_clamped_before_the_logarithm(tmp_path):
    gaussians = gaussians_within_ranges(3, degree=0)
    gaussians.log_scales[1] = -300
    gaussians.logit_opacities[:] = [-300, 0, 300]
    gaussians.save(tmp_path / "a.glb")
    found = Gaussians.load(tmp_path / "a.glb")
    tiny = np.finfo(np.float32).tiny
    assert (found.scales[1] <= 2 * tiny).all() and np.isfinite(found.log_scales).all()
    assert found.opacities[0] <= 8 * tiny and 1 - 2.0**-22 < found.opacities[2] < 1
