"""Damaged files give an error that names them, or are read; never another exception, never a hang.

Each mutation is made by a generator with its own seed, which a failure prints.
"""

import copy
import io
import json
import os
import struct
import time
import zlib

import imageio.v3 as iio
import numpy as np
import pytest
import yaml
from plyfile import PlyData, PlyElement

from drgs.config.load import dump_config, load_config
from drgs.config.schema import DataConfig, FitConfig
from drgs.core.errors import UserError
from drgs.data import initial_gaussians, load_dataset
from drgs.data.images import composite
from drgs.gaussians.parameters import Gaussians
from drgs.io.pictures import read_image
from drgs.io.ply import read_points

COUNT = 600
"""Mutations of each format."""

MAX_SECONDS = 5.0
"""Of a single file. They take about 5 ms; the rest is for a machine that is busy."""

STRANGE_VALUES = [
    None, True, 0, -1, 3.5, 10**9, 2**63, 10**400, 1e-320, 1e300, float("nan"), float("inf"),
    "", "x", "7", "\0", "\ud800", "a\nb", "~no-such-user", "x" * 5000, [], {}, [[]], [1, [2]],
    {"a": {"b": []}}, [[1.0] * 4] * 4, [[0] * 4] * 4, [[["x"]]],
]  # fmt: skip

STRANGE_BYTES = [b"\0", b"\xff\xfe", b"\n", b"[" * 400, b'"', b"{", b"*a", b"&a ", b"9" * 30, b"-"]


# Mutations


def mutate_bytes(rng, content):
    """Flip, replace, insert, cut out, cut off or repeat, one to three times."""
    content = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(content) + 1))
        length = int(rng.integers(1, 30))
        kind = rng.integers(7)
        if kind == 0 and at < len(content):
            content[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            content[at : at + 1] = rng.bytes(1)
        elif kind == 2:
            content[at:at] = rng.bytes(length)
        elif kind == 3:
            content[at:at] = STRANGE_BYTES[rng.integers(len(STRANGE_BYTES))]
        elif kind == 4:
            del content[at : at + length]
        elif kind == 5:
            del content[at:]
        elif kind == 6:
            content[at:at] = content[at : at + 10 * length]
    return bytes(content)


def places(tree):
    """(container, key) of every value within nested lists and dictionaries."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        yield tree, key
        if isinstance(value, (dict, list)):
            yield from places(value)


def mutate_tree(rng, tree):
    """Drop, replace, repeat or rename values, one to three times."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.integers(1, 4)):
        found = list(places(tree))
        if not found:
            return tree
        container, key = found[rng.integers(len(found))]
        kind = rng.integers(4)
        if kind == 0:
            del container[key]
        elif kind == 1:
            container[key] = copy.deepcopy(STRANGE_VALUES[rng.integers(len(STRANGE_VALUES))])
        elif kind == 2 and isinstance(container, list):
            container.insert(key, copy.deepcopy(container[key]))
        elif kind == 2:
            container[f"{key}x"] = container.pop(key)
        else:
            other, other_key = found[rng.integers(len(found))]
            container[key] = copy.deepcopy(other[other_key])
    return tree


def mutate_header(rng, content):
    """Drop, repeat, swap or rewrite lines of a PLY header."""
    header, end, rows = content.partition(b"end_header\n")
    lines = header.split(b"\n")[:-1]
    for _ in range(rng.integers(1, 3)):
        at = int(rng.integers(1, len(lines)))
        kind = rng.integers(5)
        if kind == 0 and len(lines) > 2:
            del lines[at]
        elif kind == 1:
            lines.insert(at, lines[rng.integers(1, len(lines))])
        elif kind == 2:
            counts = [b"0", b"-1", b"2", b"4", b"1000", b"1000000000000", b"9" * 5000, b"x"]
            lines[at] = b"element vertex " + counts[rng.integers(len(counts))]
        elif kind == 3:
            types = [b"double", b"uchar", b"list uchar int", b"list uint double", b"int", b"half"]
            name = lines[at].split()[-1]
            lines[at] = b"property " + types[rng.integers(len(types))] + b" " + name
        else:
            lines[at] = lines[at].replace(b" ", b"  ", 1)[: int(rng.integers(1, 40))]
    return b"\n".join(lines) + b"\n" + end + rows


def mutate_chunks(rng, content):
    """Drop, repeat, swap or damage chunks of a PNG, with checksums that are right."""
    signature, rest = content[:8], content[8:]
    chunks = []
    while rest:
        (length,) = struct.unpack(">I", rest[:4])
        chunks.append((rest[4:8], rest[8 : 8 + length]))
        rest = rest[12 + length :]
    at = int(rng.integers(len(chunks)))
    kind, body = chunks[at]
    change = rng.integers(5)
    if change == 0:
        del chunks[at]
    elif change == 1:
        chunks.insert(int(rng.integers(len(chunks))), chunks[at])
    elif change == 2 and kind == b"IHDR":
        fields = list(struct.unpack(">IIBBBBB", body))
        sizes = [0, 1, 5, 7, 9000, 10**6, 2**31 - 1, 2**32 - 1]
        small = [0, 1, 2, 3, 4, 6, 8, 16, 255]
        i = int(rng.integers(7))
        fields[i] = (sizes if i < 2 else small)[rng.integers(8)]
        chunks[at] = (kind, struct.pack(">IIBBBBB", *fields))
    elif change == 3:
        kinds = [b"PLTE", b"tRNS", b"acTL", b"fcTL", b"eXIf", b"iCCP", b"zTXt", b"gAMA"]
        chunks.insert(1, (kinds[rng.integers(8)], rng.bytes(int(rng.integers(30)))))
    else:
        chunks[at] = (kind, mutate_bytes(rng, body or b"\0"))
    return signature + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


# Valid files


def write_image(path, seed):
    pixels = np.random.default_rng(seed).integers(0, 256, (5, 7, 4), np.uint8)
    iio.imwrite(path, pixels)


def camera_at(angle):
    """A camera on a circle of radius 4 in OpenGL axes, looking at the origin."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return [[-s, 0, c, 4 * c], [c, 0, s, 4 * s], [0, 1, 0, 0], [0, 0, 0, 1]]


@pytest.fixture
def photographs(tmp_path):
    """A valid nerfstudio folder (nerf_synthetic reads its frames by the same functions)."""
    frames = []
    for i in range(3):
        write_image(tmp_path / f"{i}.png", i)
        frames.append({"file_path": f"{i}.png", "transform_matrix": camera_at(i)})
    meta = {"fl_x": 9.0, "fl_y": 9.0, "cx": 3.5, "cy": 2.5, "w": 7, "h": 5, "k1": 0.0}
    meta |= {"camera_model": "OPENCV", "camera_angle_x": 0.7, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    return tmp_path


def gaussians_file(text):
    """Bytes of a PLY of three degree-0 Gaussians with colours, and a face."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1"]
    names += ["scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rows = np.zeros(3, [(n, "f4") for n in names] + [(n, "u1") for n in ("red", "green", "blue")])
    for i, name in enumerate(names):
        rows[name] = 0.1 * i
    faces = np.zeros(1, [("vertex_indices", object)])
    faces["vertex_indices"][0] = np.arange(3, dtype=np.int32)
    stream = io.BytesIO()
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=text, byte_order="<").write(stream)
    return stream.getvalue()


def check(seed, file, read):
    """Whether ``file`` is read; an error must be the user's, name the file, and fill one line."""
    started = time.perf_counter()
    try:
        read()
        refused = False
    except UserError as error:
        refused = True
        lines = str(error).splitlines()
        assert len(lines) == 1, f"seed {seed}: {error}"
        for line in lines:
            # Cameras that are valid one by one may determine no start box: that names the key.
            named = str(file.parent) in line or line.startswith("init.half_extent: ")
            assert named, f"seed {seed}: {error}"
            assert len(line) < 1000, f"seed {seed}: {error}"
    except Exception as error:
        raise AssertionError(f"seed {seed}: {type(error).__name__}: {error}") from error
    seconds = time.perf_counter() - started
    assert seconds < MAX_SECONDS, f"seed {seed}: {seconds:.1f} s"
    return refused


def assert_both_happen(refused):
    """The mutations reach far enough: some files are still valid, many are not."""
    assert 0.3 * len(refused) < sum(refused) < len(refused)


# Properties


def test_damaged_ply_files_are_read_or_refused(tmp_path):
    path = tmp_path / "a.ply"
    refused = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        content = gaussians_file(text=seed % 3 == 0)
        mutate = mutate_header if seed % 2 else mutate_bytes
        path.write_bytes(mutate(rng, content))
        for read in (Gaussians.load, read_points):
            refused.append(check(seed, path, lambda read=read: read(path)))
    assert_both_happen(refused)


def test_damaged_transforms_files_are_read_or_refused(photographs):
    path = photographs / "transforms.json"
    content = path.read_bytes()
    config = FitConfig(data={"path": photographs}, init={"num_points": 4})

    def read():
        initial_gaussians(config, load_dataset(config.data))

    refused = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        if seed % 2:
            path.write_text(json.dumps(mutate_tree(rng, json.loads(content))))
        else:
            path.write_bytes(mutate_bytes(rng, content))
        refused.append(check(seed, path, read))
    assert_both_happen(refused)


def test_damaged_pictures_are_read_or_refused(tmp_path):
    path = tmp_path / "a.png"
    write_image(path, 0)
    content = path.read_bytes()
    refused = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        mutate = mutate_chunks if seed % 2 else mutate_bytes
        path.write_bytes(mutate(rng, content))
        refused.append(check(seed, path, lambda: composite(read_image(path), (1, 1, 1))))
    assert_both_happen(refused)


def test_damaged_configurations_are_read_or_refused(tmp_path):
    path = tmp_path / "a.yml"
    values = FitConfig(data=DataConfig(path="x", background=(0, 0.5, 1))).model_dump(mode="json")

    def read():
        config = load_config(path)
        dump_config(config, tmp_path / "again.yml")
        assert load_config(tmp_path / "again.yml") == config

    refused = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        if seed % 2:
            text = yaml.safe_dump(mutate_tree(rng, values), sort_keys=False)
            path.write_bytes(text.encode(errors="surrogatepass"))
        else:
            path.write_bytes(mutate_bytes(rng, yaml.safe_dump(values).encode()))
        refused.append(check(seed, path, read))
    assert_both_happen(refused)
    assert sorted(os.listdir(tmp_path)) == ["a.yml", "again.yml"]
