"""Files that drgs does not read, recognised by name or content: what they are, and the way."""

from __future__ import annotations

import shlex
from contextlib import suppress
from pathlib import Path

from drgs.core.errors import UserError
from drgs.core.files import open_regular

WAYS = {
    ("mp4", "mov", "m4v", "avi", "mkv", "webm"): "a video: take photographs from it, as by "
    "ffmpeg -i {name} -vf fps=2 images/%05d.jpg, and give their folder to drgs poses",
    ("gz",): "compressed: unpack it first, as by gunzip -k {name}",
    ("zip", "7z", "rar", "tar", "tgz"): "an archive: unpack it first, and give what it holds",
    ("gltf",): "glTF as text, whose numbers are in other files: save it as .glb",
    ("lcc",): "LCC of XGRIDS, which is not read: export PLY or SPZ with its program",
    ("splatv", "rad"): "a format of viewers, which is not read: export PLY or SPZ",
}
"""Descriptions of files, with the way to use them, by suffix."""

SIGNATURES = {b"PK\3\4": "zip", b"\x1f\x8b": "gz", b"7z\xbc\xaf": "7z", b"\x1aE\xdf\xa3": "mkv"}


def describe_file(path: Path) -> str:
    """Return what a file of another kind is, and what to do with it; "" for all other files."""
    suffix, start = path.suffix.lower().removeprefix("."), b""
    with suppress(UserError, OSError), open_regular(path) as file:
        start = file.read(8)
    kinds = [kind for signature, kind in SIGNATURES.items() if start.startswith(signature)]
    suffix = "mp4" if start[4:] == b"ftyp" else [suffix, *kinds][-1]
    found = next((way for suffixes, way in WAYS.items() if suffix in suffixes), "")
    return found and f"is {found.format(name=shlex.quote(str(path)))}"
