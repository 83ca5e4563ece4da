"""Attacks by files: damaged, lying, strange, huge, and others in their place."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from support.attacks.attack import Attack
from support.attacks.attack_folder import CAPTURE, HEIGHT, WIDTH, capture_size
from support.attacks.mutations import mutate_bytes, mutate_chunks, mutate_header, mutate_tree

RENDER = ("--origin", "3", "0", "1", "--size", "8", "6", "--out", "out")

READERS = {
    "fit.yml": ("fit", ("fit.yml", "--out", "out")),
    "points.ply": ("fit", ("fit.yml", "--out", "out")),
    "lego/transforms_train.json": ("fit", ("fit.yml", "--out", "out")),
    "lego/transforms_test.json": ("fit", ("fit.yml", "--out", "out")),
    "lego/train/r_1.png": ("fit", ("fit.yml", "--out", "out")),
    "lego/test/r_0.png": ("fit", ("fit.yml", "--out", "out")),
    "photos/transforms.json": ("fit", ("photos.yml", "--out", "out")),
    "photos/2.png": ("fit", ("photos.yml", "--out", "out")),
    "photos/mask.png": ("fit", ("photos.yml", "--out", "out")),
    "photos/depth.npy": ("fit", ("photos.yml", "--out", "out")),
    "photos/depth.png": ("fit", ("photos.yml", "--out", "out")),
    "gaussians.ply": ("render", ("gaussians.ply", *RENDER)),
    "gaussians.compressed.ply": ("render", ("gaussians.compressed.ply", *RENDER)),
    "gaussians.spz": ("render", ("gaussians.spz", *RENDER)),
    "gaussians.glb": ("render", ("gaussians.glb", *RENDER)),
    "gaussians.splat": ("render", ("gaussians.splat", *RENDER)),
    "camera.json": ("render", ("gaussians.ply", "--camera", "camera.json", "--out", "out")),
    "sky.png": ("render", ("gaussians.ply", *RENDER, "--background", "sky.png")),
    "run/config.yml": ("render", ("run", "--orbit", "2", "--out", "out")),
    "run/point_cloud.ply": ("render", ("run", "--orbit", "2", "--out", "out")),
    "stopped/config.yml": ("fit", ("--resume", "stopped")),
    "stopped/checkpoint.npz": ("fit", ("--resume", "stopped")),
    "splats.xml": ("render", ("splats.xml", "--out", "out")),
    "ball.xml": ("capture", ("ball.xml", *CAPTURE, *capture_size(4), "--out", "out")),
    "captured/capture.json": (
        "capture",
        ("ball.xml", *CAPTURE, *capture_size(6), "--out", "captured"),
    ),
}
"""Command that reads a file, with its arguments."""

REWRITTEN = ("captured/capture.json",)
"""Files without which a command begins anew."""


NATIVE = ("splats.xml", "ball.xml")
"""Files that Mitsuba reads itself."""


def _attack(name: str, file: str, change: Callable[[Path], None], **more: object) -> Attack:
    """An attack by what is at the path of a file; the reader's message names it."""
    command, words = READERS[file]
    out = words[-1] if words[-2] in ("--out", "--resume") else "out"
    change = partial(_apply, change, file)
    return Attack(name, command, words, change, out=out, risky=file in NATIVE, **more)


def _apply(change: Callable[[Path], None], file: str, folder: Path) -> None:
    change(folder / file)


# ----------------------------------------------------------------------------------------------
# Something else in its place
# ----------------------------------------------------------------------------------------------


def _replaced(make: Callable[[Path], None], path: Path) -> None:
    path.unlink()
    make(path)


def _sparse(size: int, path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(size)


def _grown(size: int, path: Path) -> None:
    with path.open("ab") as file:
        file.truncate(size)


REPLACEMENTS = {
    "nothing": lambda path: path.unlink(),
    "an empty file": lambda path: path.write_bytes(b""),
    "a null byte": lambda path: path.write_bytes(b"\0"),
    "zeros": lambda path: path.write_bytes(bytes(5000)),
    "noise": lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000)),
    "a folder": partial(_replaced, Path.mkdir),
    "a pipe": partial(_replaced, os.mkfifo),
    "a link to nowhere": partial(_replaced, lambda path: path.symlink_to("nowhere")),
    "a link to itself": partial(_replaced, lambda path: path.symlink_to(path)),
    "an endless device": partial(_replaced, lambda path: path.symlink_to("/dev/zero")),
    "an empty device": partial(_replaced, lambda path: path.symlink_to("/dev/null")),
    "a terminal": partial(_replaced, lambda path: path.symlink_to("/dev/tty")),
    "memory": partial(_replaced, lambda path: path.symlink_to("/proc/self/mem")),
    "a hole of 1 TB": partial(_sparse, 1 << 40),
    "itself, grown to 1 TB": partial(_grown, 1 << 40),
    "text": lambda path: path.write_text("hello\n"),
    "not UTF-8": lambda path: path.write_bytes(b"\xff\xfe\xfa" * 9),
    "UTF-16": lambda path: path.write_bytes("a: 1".encode("utf-16")),
    "a web page": lambda path: path.write_text("<!DOCTYPE html><html><body>404</body></html>"),
    "an LFS pointer": lambda path: path.write_text(
        "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n"
    ),
    "an archive": lambda path: path.write_bytes(_archive()),
    "a pickle": lambda path: path.write_bytes(b"cos\nsystem\n(S'touch hacked'\ntR."),
    "its first half": lambda path: os.truncate(path, path.stat().st_size // 2),
    "all but its last byte": lambda path: os.truncate(path, path.stat().st_size - 1),
    "itself twice": lambda path: path.write_bytes(path.read_bytes() * 2),
    "itself and a line": lambda path: path.write_bytes(path.read_bytes() + b"\nmore"),
}
"""Replacements of a file, by name."""

HARMLESS = (
    "itself and a line",
    "all but its last byte",
    "itself twice",
)
"""After which a file may still be what it was."""


MAY_BE_MISSING = [
    ("stopped/checkpoint.npz", name)
    for name in ("nothing", "a link to nowhere", "a link to itself")
]
"""A fit without a checkpoint begins anew."""

NO_FILES = (
    *("nothing", "a folder", "a pipe", "a terminal", "a link to nowhere", "a link to itself"),
    *("an endless device", "an empty device"),
)
"""In whose place there is no file of any kind."""

LEFT_OUT = [
    (file, name)
    for file in (
        *("photos/2.png", "photos/depth.npy", "photos/depth.png"),
        *("lego/train/r_1.png", "lego/test/r_0.png"),
    )
    for name in NO_FILES
]
"""One of several files that are named: the others are fitted."""

MAY_BE_ACCEPTED = [
    *MAY_BE_MISSING,
    *LEFT_OUT,
    ("gaussians.splat", "its first half"),
    ("run/config.yml", "its first half"),
]
"""The last two: whole rows without a header that says how many there were, and YAML that may end
between two values."""


def _archive() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr("a.txt", "a")
    return stream.getvalue()


def other_file_attacks() -> Iterator[Attack]:
    """Each of the files that commands read, with each of the above in its place."""
    for file in READERS:
        for name, change in REPLACEMENTS.items():
            may_be_read = name in HARMLESS or file in REWRITTEN
            may_be_read |= (file, name) in MAY_BE_ACCEPTED
            yield _attack(f"instead/{file}/{name}", file, change, must_refuse=not may_be_read)


# ----------------------------------------------------------------------------------------------
# Damaged
# ----------------------------------------------------------------------------------------------


def _damaged(mutate: Callable, seed: int, path: Path) -> None:
    path.write_bytes(mutate(np.random.default_rng(seed), path.read_bytes()))


def _json_tree(rng: np.random.Generator, content: bytes) -> bytes:
    return json.dumps(mutate_tree(rng, json.loads(content))).encode()


def _glb_tree(rng: np.random.Generator, content: bytes) -> bytes:
    """The JSON part, with the lengths that it then has."""
    size = struct.unpack_from("<I", content, 12)[0]
    text = _json_tree(rng, content[20 : 20 + size])
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, len(content) - size + len(text), len(text), b"JSON")
    return head + text + content[20 + size :]


def _yaml_tree(rng: np.random.Generator, content: bytes) -> bytes:
    text = yaml.safe_dump(mutate_tree(rng, yaml.safe_load(content)), sort_keys=False)
    return text.encode(errors="surrogatepass")


def _npz_arrays(rng: np.random.Generator, content: bytes) -> bytes:
    """One of the arrays dropped, of another shape or type, or with other numbers."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    name = list(arrays)[rng.integers(len(arrays))]
    value = arrays[name]
    kind = int(rng.integers(10))
    if kind == 0:
        del arrays[name]
    elif kind == 1:
        arrays[name] = value[..., None]
    elif kind == 2:
        arrays[name] = value.reshape(-1)[: max(0, value.size - 1)]
    elif kind == 3:
        arrays[name] = np.zeros(0, value.dtype)
    elif kind == 4:
        arrays[name] = np.full(value.shape, np.nan)
    elif kind == 5:
        arrays[name] = np.full(value.shape, np.inf)
    elif kind == 6:
        arrays[name] = np.full(value.shape, -(2**40))
    elif kind == 7:
        arrays[name] = np.full(value.shape, "text")
    elif kind == 8:
        arrays[name] = np.full(value.shape, 1j)
    else:
        arrays[f"{name}x"] = arrays.pop(name)
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _npy_header(rng: np.random.Generator, content: bytes) -> bytes:
    """Another shape, order or type than the numbers have."""
    shapes = ["()", "(0,)", "(16, 20, 2)", "(1000000, 1000000)", "(-1, 20)", "(16, 20, 1)"]
    shapes += [f"({2**62}, {2**62})", "(16.0, 20)", "('a',)", "(20, 16)", "(True, 320)"]
    types = [
        "'<f4'",
        "'>f8'",
        "'|O'",
        "'<c8'",
        "'<U4'",
        "'|V4'",
        "'<M8[s]'",
        "'|b1'",
        "[('a', '<f4')]",
    ]
    types += ["'<f2'", "'<i8'", "'nonsense'", "None", "'|S1'"]
    kind, shape = types[rng.integers(len(types))], shapes[rng.integers(len(shapes))]
    order = ["True", "False", "7"][rng.integers(3)]
    text = f"{{'descr': {kind}, 'fortran_order': {order}, 'shape': {shape}}}\n".encode()
    rows = content[-WIDTH * HEIGHT * 4 :]
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + rows


def _xml_numbers(rng: np.random.Generator, content: bytes) -> bytes:
    """One of the values of a scene, its tag or its name replaced by others."""
    parts = content.split(b'"')
    at = 1 + 2 * int(rng.integers(len(parts) // 2))
    values = [b"", b"0", b"-1", b"nan", b"inf", b"1e30", b"1e-30", b"1000000000", b"2147483648"]
    values += [b"x", b"1, 2", b"1, 1, 1, 1", b"true", b"/dev/zero", b"$none", b"x" * 3000]
    values += [part for part in parts[1::2]]
    parts[at] = values[rng.integers(len(values))]
    return b'"'.join(parts)


MUTATIONS = {
    "fit.yml": {"bytes": mutate_bytes, "tree": _yaml_tree},
    "points.ply": {"bytes": mutate_bytes, "header": mutate_header},
    "lego/transforms_train.json": {"bytes": mutate_bytes, "tree": _json_tree},
    "lego/train/r_1.png": {"bytes": mutate_bytes, "chunks": mutate_chunks},
    "photos/transforms.json": {"bytes": mutate_bytes, "tree": _json_tree},
    "photos/mask.png": {"bytes": mutate_bytes, "chunks": mutate_chunks},
    "photos/depth.npy": {"bytes": mutate_bytes, "header": _npy_header},
    "photos/depth.png": {"bytes": mutate_bytes, "chunks": mutate_chunks},
    "gaussians.ply": {"bytes": mutate_bytes, "header": mutate_header},
    "gaussians.compressed.ply": {"bytes": mutate_bytes, "header": mutate_header},
    "gaussians.spz": {"bytes": mutate_bytes},
    "gaussians.glb": {"bytes": mutate_bytes, "tree": _glb_tree},
    "gaussians.splat": {"bytes": mutate_bytes},
    "camera.json": {"bytes": mutate_bytes, "tree": _json_tree},
    "sky.png": {"bytes": mutate_bytes, "chunks": mutate_chunks},
    "run/config.yml": {"bytes": mutate_bytes, "tree": _yaml_tree},
    "run/point_cloud.ply": {"bytes": mutate_bytes, "header": mutate_header},
    "stopped/config.yml": {"bytes": mutate_bytes, "tree": _yaml_tree},
    "stopped/checkpoint.npz": {"bytes": mutate_bytes, "arrays": _npz_arrays},
    "captured/capture.json": {"bytes": mutate_bytes, "tree": _json_tree},
    "splats.xml": {"bytes": mutate_bytes, "values": _xml_numbers},
    "ball.xml": {"bytes": mutate_bytes, "values": _xml_numbers},
}
"""Kinds of damage by file: functions of a random generator and the content."""


def damage_attacks(count: int) -> Iterator[Attack]:
    """``count`` of each kind for each file, seeded by their number."""
    for file, kinds in MUTATIONS.items():
        for kind, mutate in kinds.items():
            for seed in range(count):
                change = partial(_damaged, mutate, seed)
                yield _attack(f"damaged/{file}/{kind} {seed}", file, change)


# ----------------------------------------------------------------------------------------------
# Bombs, and formats of others
# ----------------------------------------------------------------------------------------------


def _ply_of_lists(path: Path) -> None:
    """4 MB, of which every byte is the empty list of a property."""
    properties = "".join(f"property list uchar float l{i}\n" for i in range(300))
    floats = "".join(f"property float {name}\n" for name in "xyz")
    rows = 12000
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {rows}\n{floats}{properties}"
    path.write_bytes(f"{header}end_header\n".encode() + bytes(312 * rows))


def _ply_of_elements(path: Path) -> None:
    elements = "".join(f"element e{i} 1\nproperty uchar a\n" for i in range(20000))
    path.write_bytes(f"ply\nformat ascii 1.0\n{elements}end_header\n".encode() + b"1\n" * 20000)


def _ply_with(rows: np.ndarray, path: Path) -> None:
    from plyfile import PlyData, PlyElement

    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))


def _equal_points(path: Path) -> None:
    rows = np.zeros(18, [(name, "f4") for name in "xyz"])
    rows["x"][17] = 1
    _ply_with(rows, path)


def _far_points(path: Path) -> None:
    rows = np.zeros(12, [(name, "f4") for name in "xyz"])
    rows["x"] = np.linspace(-3e38, 3e38, 12)
    _ply_with(rows, path)


def _deep(path: Path) -> None:
    path.write_text("[" * 200_000 + "]" * 200_000)


def _gzip_bomb(path: Path) -> None:
    """1 GB of zeros behind the Gaussians, as extensions."""
    content = bytearray(gzip.decompress(path.read_bytes()))
    content[14] |= 2
    path.write_bytes(gzip.compress(bytes(content) + bytes(1 << 30), 1))


def _valid_gzip_bomb(path: Path) -> None:
    """1 GB of zeros, which are as many Gaussians as the header says."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, (1 << 30) // 20, 0, 12, 0, 0)
    path.write_bytes(gzip.compress(header + bytes((1 << 30) // 20 * 20), 1))


def _deep_glb(path: Path) -> None:
    text = b"[" * 200_000
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text), len(text), b"JSON")
    path.write_bytes(head + text + struct.pack("<I4s", 0, b"BIN\0"))


def _deep_object(path: Path) -> None:
    path.write_text('{"a":' * 100_000 + "1" + "}" * 100_000)


def _many_frames(path: Path) -> None:
    meta = json.loads(path.read_text())
    meta["frames"] = meta["frames"][:1] * 20_000
    path.write_text(json.dumps(meta))


def _zip_bomb(path: Path) -> None:
    """An array of 2 GB of zeros in 2 MB."""
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (536870912,)}\n"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file,
        file.open("trainer.means.npy", "w", force_zip64=True) as array,
    ):
        array.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
        for _ in range(2048):
            array.write(bytes(1 << 20))


def _in_format(kind: str, mode: str, path: Path) -> None:
    rendered = Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    rendered = rendered.convert("L") if mode in "IF" else rendered
    rendered.convert(mode).save(path, kind)


def _animated(path: Path) -> None:
    frames = [Image.fromarray(np.full((HEIGHT, WIDTH, 3), i, np.uint8)) for i in range(9)]
    frames[0].save(path, "GIF", save_all=True, append_images=frames[1:])


def _rotated(orientation: int, path: Path) -> None:
    rendered = Image.open(path).convert("RGB").transpose(Image.Transpose.ROTATE_90)
    exif = Image.Exif()
    exif[0x0112] = orientation
    rendered.save(path, "JPEG", exif=exif)


def _png_bomb(path: Path) -> None:
    """60 million pixels in 8 kB: 0.7 GB of numbers, which a background may take."""
    Image.new("1", (8000, 7500)).save(path, "PNG")


SPECIAL = {
    "points.ply": {
        "lists": _ply_of_lists,
        "elements": _ply_of_elements,
        "equal": _equal_points,
        "far": _far_points,
    },
    "gaussians.ply": {"lists": _ply_of_lists, "elements": _ply_of_elements},
    "gaussians.spz": {"bomb": _gzip_bomb, "larger bomb": _valid_gzip_bomb},
    "gaussians.glb": {"deep": _deep_glb},
    "lego/transforms_train.json": {"deep": _deep, "object": _deep_object},
    "photos/transforms.json": {"deep": _deep, "object": _deep_object},
    "camera.json": {"deep": _deep, "object": _deep_object},
    "captured/capture.json": {"deep": _deep, "object": _deep_object},
    "fit.yml": {"deep": _deep, "object": _deep_object},
    "stopped/checkpoint.npz": {"zip bomb": _zip_bomb},
    "photos/2.png": {
        "bomb": _png_bomb,
        "animated": _animated,
        **{f"turned {n}": partial(_rotated, n) for n in (1, 3, 6, 8, 77)},
    },
    "sky.png": {"bomb": _png_bomb, "animated": _animated},
    "photos/mask.png": {"bomb": _png_bomb, "animated": _animated},
    "photos/depth.png": {"bomb": _png_bomb},
}
"""Special replacements, by file."""

FORMATS = {
    "JPEG": "RGB",
    "grey JPEG": "L",
    "CMYK JPEG": "CMYK",
    "WEBP": "RGB",
    "WEBP with alpha": "RGBA",
    "GIF": "P",
    "BMP": "RGB",
    "TIFF": "RGB",
    "CMYK TIFF": "CMYK",
    "float TIFF": "F",
    "integer TIFF": "I",
    "ICO": "RGBA",
    "PPM": "RGB",
    "one-bit PNG": "1",
    "palette PNG": "P",
    "grey alpha PNG": "LA",
}
"""Pillow's modes by format, one word of which is Pillow's name for it."""


def special_attacks() -> Iterator[Attack]:
    """Bombs and images of every kind."""
    for file, kinds in SPECIAL.items():
        for name, change in kinds.items():
            # A background may have so many pixels, which Mitsuba keeps as floats.
            megabytes = 1200.0 if (file, name) == ("sky.png", "bomb") else 400.0
            yield _attack(f"special/{file}/{name}", file, change, megabytes=megabytes)
    Image.init()
    formats = set(Image.SAVE) - {"CMYK"}
    for file in ("photos/2.png", "photos/mask.png", "photos/depth.png", "sky.png"):
        for name, mode in FORMATS.items():
            kind = next(word for word in name.split() if word in formats)
            change = partial(_in_format, kind, mode)
            yield _attack(f"special/{file}/{name}", file, change)
