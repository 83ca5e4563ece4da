"""Attacks by files: damaged, lying, strange, huge, and others in their place."""

from __future__ import annotations

import gzip
import io
import os
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from support.attacks.attack import Attack
from support.attacks.attack_folder import CAPTURE
from support.attacks.mutations import (
    mutate_bytes,
    mutate_chunks,
    mutate_header,
    mutate_json,
    mutate_yaml,
)
from support.small_capture import HEIGHT, WIDTH

LEGO = ("fit", "fit.yml", "--out", "out")
PHOTOS = ("fit", "photos.yml", "--out", "out")
CAMERA = ("--origin", "3", "0", "1", "--size", "8", "6", "--out", "out")
RUN = ("render", "run", "--orbit", "2", "--out", "out")
RESUME = ("fit", "--resume", "stopped")

READERS = {
    "fit.yml": LEGO,
    "points.ply": LEGO,
    "lego/transforms_train.json": LEGO,
    "lego/transforms_test.json": LEGO,
    "lego/train/r_1.png": LEGO,
    "lego/test/r_0.png": LEGO,
    "photos/transforms.json": PHOTOS,
    "photos/2.png": PHOTOS,
    "photos/mask.png": PHOTOS,
    "photos/depth.npy": PHOTOS,
    "photos/depth.png": PHOTOS,
    **{
        f"gaussians.{kind}": ("render", f"gaussians.{kind}", *CAMERA)
        for kind in ("ply", "compressed.ply", "spz", "glb", "sog", "ksplat", "splat")
    },
    "camera.json": ("render", "gaussians.ply", "--camera", "camera.json", "--out", "out"),
    "sky.png": ("render", "gaussians.ply", *CAMERA, "--background", "sky.png"),
    "run/config.yml": RUN,
    "run/point_cloud_drgs.ply": RUN,
    "stopped/config.yml": RESUME,
    "stopped/checkpoint.npz": RESUME,
    "splats.xml": ("render", "splats.xml", "--out", "out"),
    "ball.xml": ("capture", *CAPTURE, "--out", "out"),
    "captured/capture.json": ("capture", *CAPTURE, "--out", "captured"),
}
"""Command line that reads a file; the file's mutations are chosen by its suffix."""


def _attack(name: str, file: str, change: Callable[[Path], None], **more: object) -> Attack:
    """An attack by what is at the path of a file."""
    command, *words = READERS[file]
    out = words[-1] if words[-2] in ("--out", "--resume") else "out"
    return Attack(name, command, tuple(words), lambda f: change(f / file), out=out, **more)


def _replaced(make: Callable[[Path], None], path: Path) -> None:
    path.unlink()
    make(path)


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
    "a hole of 1 TB": lambda path: (path.write_bytes(b""), os.truncate(path, 1 << 40)),
    "itself, grown to 1 TB": lambda path: os.truncate(path, 1 << 40),
    "text": lambda path: path.write_text("hello\n"),
    "not UTF-8": lambda path: path.write_bytes(b"\xff\xfe\xfa" * 9),
    "UTF-16": lambda path: path.write_bytes("a: 1".encode("utf-16")),
    "a web page": lambda path: path.write_text("<!DOCTYPE html><html><body>404</body></html>"),
    "an LFS pointer": lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\n"),
    "an archive": lambda path: zipfile.ZipFile(path, "w").writestr("a.txt", "a"),
    "a pickle": lambda path: path.write_bytes(b"cos\nsystem\n(S'touch hacked'\ntR."),
    "its first half": lambda path: os.truncate(path, path.stat().st_size // 2),
    "all but its last byte": lambda path: os.truncate(path, path.stat().st_size - 1),
    "itself twice": lambda path: path.write_bytes(path.read_bytes() * 2),
    "itself and a line": lambda path: path.write_bytes(path.read_bytes() + b"\nmore"),
}

HARMLESS = ("itself and a line", "all but its last byte", "itself twice")
"""After which a file may still be what it was."""

MISSING = ("nothing", "a link to nowhere", "a link to itself")
NO_FILES = (*MISSING, "a folder", "a pipe", "a terminal", "an endless device", "an empty device")
"""In whose place there is no file of any kind."""

ONE_OF_SEVERAL = ("photos/2.png", "photos/depth.npy", "photos/depth.png", "lego/train/r_1.png")
"""Files without which the others are fitted; so is a test view."""

MAY_BE_ACCEPTED = {
    *(("stopped/checkpoint.npz", name) for name in MISSING),
    *((file, name) for file in (*ONE_OF_SEVERAL, "lego/test/r_0.png") for name in NO_FILES),
    ("gaussians.splat", "its first half"),
    ("run/config.yml", "its first half"),
}
"""A fit without a checkpoint begins anew. The last two: whole rows without a header that says how
many there were, and YAML that may end between two values."""


def other_file_attacks() -> Iterator[Attack]:
    """Each of the files that commands read, with each of the above in its place."""
    for file in READERS:
        for name, change in REPLACEMENTS.items():
            may_be_read = name in HARMLESS or (file, name) in MAY_BE_ACCEPTED
            may_be_read |= file == "captured/capture.json"  # without which a capture begins anew
            yield _attack(f"instead/{file}/{name}", file, change, must_refuse=not may_be_read)


def _damaged(mutate: Callable, seed: int, path: Path) -> None:
    path.write_bytes(mutate(np.random.default_rng(seed), path.read_bytes()))


def _glb_tree(rng: np.random.Generator, content: bytes) -> bytes:
    """The JSON part, with the lengths that it then has."""
    size = struct.unpack_from("<I", content, 12)[0]
    text = mutate_json(rng, content[20 : 20 + size])
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, len(content) - size + len(text), len(text), b"JSON")
    return head + text + content[20 + size :]


def _npz_arrays(rng: np.random.Generator, content: bytes) -> bytes:
    """One of the arrays dropped, of another shape or type, or with other numbers."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    name = list(arrays)[rng.integers(len(arrays))]
    value = arrays.pop(name)
    changes = [
        lambda: {},
        lambda: {f"{name}x": value},
        lambda: {name: value[..., None]},
        lambda: {name: value.reshape(-1)[: max(0, value.size - 1)]},
        lambda: {name: np.zeros(0, value.dtype)},
        *(
            lambda number=number: {name: np.full(value.shape, number)}
            for number in (np.nan, np.inf, -(2**40), "text", 1j)
        ),
    ]
    arrays |= changes[rng.integers(len(changes))]()
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _npy_header(rng: np.random.Generator, content: bytes) -> bytes:
    """Another shape, order or type than the numbers have."""
    shapes = ["()", "(0,)", "(24, 32, 2)", "(1000000, 1000000)", "(-1, 32)", "(24, 32, 1)"]
    shapes += [f"({2**62}, {2**62})", "(24.0, 32)", "('a',)", "(32, 24)", "(True, 768)"]
    types = ["'<f4'", "'>f8'", "'|O'", "'<c8'", "'<U4'", "'|V4'", "'<M8[s]'", "'|b1'"]
    types += ["[('a', '<f4')]", "'<f2'", "'<i8'", "'nonsense'", "None", "'|S1'"]
    kind, shape = types[rng.integers(len(types))], shapes[rng.integers(len(shapes))]
    order = ["True", "False", "7"][rng.integers(3)]
    text = f"{{'descr': {kind}, 'fortran_order': {order}, 'shape': {shape}}}\n".encode()
    rows = content[-WIDTH * HEIGHT * 4 :]
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + rows


def _xml_values(rng: np.random.Generator, content: bytes) -> bytes:
    """One of the values of a scene, its tag or its name replaced by others."""
    parts = content.split(b'"')
    at = 1 + 2 * int(rng.integers(len(parts) // 2))
    values = [b"", b"0", b"-1", b"nan", b"inf", b"1e30", b"1e-30", b"1000000000", b"2147483648"]
    values += [b"x", b"1, 2", b"1, 1, 1, 1", b"true", b"/dev/zero", b"$none", b"x" * 3000]
    values += parts[1::2]
    parts[at] = values[rng.integers(len(values))]
    return b'"'.join(parts)


MUTATIONS = {
    ".yml": mutate_yaml,
    ".json": mutate_json,
    ".ply": mutate_header,
    ".png": mutate_chunks,
    ".npy": _npy_header,
    ".npz": _npz_arrays,
    ".glb": _glb_tree,
    ".xml": _xml_values,
}
"""Damage beside that of bytes, by suffix: functions of a random generator and the content."""

NUM_DAMAGED = 40  # versions of each file, by kind


def damage_attacks() -> Iterator[Attack]:
    """Damages of each kind for each file, seeded by their number."""
    for file in READERS:
        kinds = {"bytes": mutate_bytes, "content": MUTATIONS.get(Path(file).suffix)}
        for kind, mutate in kinds.items():
            for seed in range(NUM_DAMAGED if mutate else 0):
                change = partial(_damaged, mutate, seed)
                yield _attack(f"damaged/{file}/{kind} {seed}", file, change)


def _ply_of_lists(path: Path) -> None:
    """4 MB, of which every byte is the empty list of a property."""
    lists = "".join(f"property list uchar float l{i}\n" for i in range(300))
    floats = "".join(f"property float {name}\n" for name in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 12000\n{floats}{lists}"
    path.write_bytes(f"{header}end_header\n".encode() + bytes(312 * 12000))


def _ply_of_elements(path: Path) -> None:
    elements = "".join(f"element e{i} 1\nproperty uchar a\n" for i in range(20000))
    path.write_bytes(f"ply\nformat ascii 1.0\n{elements}end_header\n".encode() + b"1\n" * 20000)


def _points(numbers: Iterable[float], path: Path) -> None:
    """Points whose x are these numbers, and y and z are 0."""
    rows = np.zeros(12, [(name, "f4") for name in "xyz"])
    rows["x"] = numbers
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))


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


def _sog_bomb(path: Path) -> None:
    """Positions of 225 million pixels in 30 kB."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    stream = io.BytesIO()
    Image.new("1", (15_000, 15_000)).save(stream, "PNG")
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (files | {"means_l.webp": stream.getvalue()}).items():
            archive.writestr(name, content)


def _in_format(kind: str, mode: str, path: Path) -> None:
    image = Image.new("L" if mode in "IF" else "RGB", (WIDTH, HEIGHT), 90)
    image.convert(mode).save(path, kind)


def _animated(path: Path) -> None:
    frames = [Image.new("RGB", (WIDTH, HEIGHT), (i, i, i)) for i in range(9)]
    frames[0].save(path, "GIF", save_all=True, append_images=frames[1:])


def _rotated(orientation: int, path: Path) -> None:
    rendered = Image.open(path).convert("RGB").transpose(Image.Transpose.ROTATE_90)
    exif = Image.Exif()
    exif[0x0112] = orientation
    rendered.save(path, "JPEG", exif=exif)


LISTS = {"lists": _ply_of_lists, "elements": _ply_of_elements}
BOMB = {"bomb": lambda path: Image.new("1", (8000, 7500)).save(path, "PNG")}
"""60 million pixels in 8 kB: 0.7 GB of numbers, which a background may take."""

IMAGES = {**BOMB, "animated": _animated}
DEEP = {
    "deep": lambda path: path.write_text("[" * 200_000 + "]" * 200_000),
    "object": lambda path: path.write_text('{"a":' * 100_000 + "1" + "}" * 100_000),
}

SPECIAL = {
    "points.ply": {
        **LISTS,
        "equal": partial(_points, np.arange(12) == 11),
        "far": partial(_points, np.linspace(-3e38, 3e38, 12)),
    },
    "gaussians.ply": LISTS,
    "gaussians.spz": {"bomb": _gzip_bomb, "larger bomb": _valid_gzip_bomb},
    "gaussians.glb": {"deep": _deep_glb},
    "gaussians.sog": {"image bomb": _sog_bomb, "zip bomb": _zip_bomb},
    "lego/transforms_train.json": DEEP,
    "photos/transforms.json": DEEP,
    "camera.json": DEEP,
    "captured/capture.json": DEEP,
    "fit.yml": DEEP,
    "stopped/checkpoint.npz": {"zip bomb": _zip_bomb},
    "photos/2.png": {**IMAGES, **{f"turned {n}": partial(_rotated, n) for n in (1, 3, 6, 8, 77)}},
    "sky.png": IMAGES,
    "photos/mask.png": IMAGES,
    "photos/depth.png": BOMB,
}

FORMATS = (
    *(("JPEG", "RGB"), ("JPEG", "L"), ("JPEG", "CMYK"), ("WEBP", "RGB"), ("WEBP", "RGBA")),
    *(("GIF", "P"), ("BMP", "RGB"), ("TIFF", "RGB"), ("TIFF", "CMYK"), ("TIFF", "F")),
    *(("TIFF", "I"), ("ICO", "RGBA"), ("PPM", "RGB"), ("PNG", "1"), ("PNG", "P"), ("PNG", "LA")),
)


def special_attacks() -> Iterator[Attack]:
    """Bombs and images of every kind."""
    for file, kinds in SPECIAL.items():
        for name, change in kinds.items():
            # A background may have so many pixels, which Mitsuba keeps as floats.
            megabytes = 1200.0 if (file, name) == ("sky.png", "bomb") else 400.0
            yield _attack(f"special/{file}/{name}", file, change, megabytes=megabytes)
    for file in ("photos/2.png", "photos/mask.png", "photos/depth.png", "sky.png"):
        for kind, mode in FORMATS:
            change = partial(_in_format, kind, mode)
            yield _attack(f"special/{file}/{kind} {mode}", file, change)
