#!/usr/bin/env python3
"""``python .ci/viewer.py``: fetch the viewer that ``viewer.html`` holds, at a pinned version.

For releases, never at run time: what it writes, ``drgs/results/supersplat_viewer/``, belongs to the
repository. Needs npm and Linux on x86-64. ``MANIFEST.json`` has the versions, what is changed in
the source, and the hashes of what is shipped; the same versions give the same bytes.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import subprocess
import tarfile
import tempfile
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).resolve().parent.parent / "drgs" / "results" / "supersplat_viewer"


class Package(NamedTuple):
    """One that npm has, with the sha512 of its archive as npm gives it."""

    name: str
    version: str
    integrity: str


VIEWER = Package(
    "@playcanvas/supersplat-viewer",
    "1.36.2",
    "sha512-L7w0BlagAonRHQg5qhaDyBB8zrRtiU9QgglNU3kUgsqHpokCAtuf9j4P0kxsUaQn61FZ1qJGkRKsOCbrLCDR0w==",
)
ENGINE = Package(
    "playcanvas",
    "2.22.6",
    "sha512-h5yBfE3jfGYWVEsRp8E3BqcPvpG14wwZUpQiJt+/ePsASaPHbfhtdFbABu5igUTN2k37QBQvfg7H1aCEnw/OFQ==",
)
"""Whose code the viewer's bundle contains; only its licence is fetched."""

MINIFIER = Package(
    "@esbuild/linux-x64",
    "0.28.2",
    "sha512-4xTZr1FUmSoQW4XIWmit3tzQrUTZM+N3P0XV8xROKYF50XfI7xeO90+1bZvNwxIufQ9hDQVRJH5YhgPVF8A/HQ==",
)
"""esbuild's program, which needs nothing else."""


class Change(NamedTuple):
    """Of the bundle's source, where ``old`` must stand exactly once."""

    reason: str
    old: str
    new: str


LOW_PASS = (
    "The low-pass filter is a uniform: the viewer's own 0.3 acts in half pixels, and so is 0.075 "
    "square pixels, where files of 3D Gaussians expect 0.3 or what their fit had."
)
GAUSSIAN = (
    "Splats fall off as Gaussians down to 1/255, as 3D Gaussian splatting has it; the viewer lets "
    "them end at sqrt(8) standard deviations and lowers them by what is left there."
)
CHANGES = (
    Change(LOW_PASS, "uniform float minPixelSize;", "uniform float minPixelSize, lowPass;"),
    Change(
        LOW_PASS,
        "float detBlur = (cov[0][0] + 0.3) * (cov[1][1] + 0.3)",
        "float detBlur = (cov[0][0] + lowPass) * (cov[1][1] + lowPass)",
    ),
    Change(
        LOW_PASS, "float diagonal1 = cov[0][0] + 0.3;", "float diagonal1 = cov[0][0] + lowPass;"
    ),
    Change(
        LOW_PASS, "float diagonal2 = cov[1][1] + 0.3;", "float diagonal2 = cov[1][1] + lowPass;"
    ),
    Change(
        GAUSSIAN,
        "float clip = min(1.0, sqrt(max(0.0, log(alpha / alphaClipValue))) * 0.5);",
        "float clip = sqrt(max(0.0, log(alpha / alphaClipValue))) * 0.5;",
    ),
    Change(
        GAUSSIAN,
        "float normExp(float x) {\n\treturn (exp(x * -4.0) - EXP4) * INV_EXP4;",
        "float normExp(float x) {\n\treturn exp(x * -4.0);",
    ),
    Change(GAUSSIAN, "\tif (A > 1.0) {", "\tif (A > 2.0) {"),
)
"""In the GLSL shaders: the page renders by WebGL."""


def main() -> None:
    """Write the folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        packages = VIEWER, ENGINE, MINIFIER
        viewer, engine, minifier = (fetched(package, folder) for package in packages)
        bundle = (viewer / "public" / "index.js").read_text("utf-8")
        if f'"{ENGINE.version}"' not in bundle:
            raise SystemExit(f"the bundle does not contain {ENGINE.name} {ENGINE.version}")
        code = minified(changed(bundle), minifier / "bin" / "esbuild", folder)
        files = {
            "viewer.js.gz": gzip.compress(code, 9, mtime=0),
            "viewer.css": (viewer / "public" / "index.css").read_bytes(),
            "LICENSE": licences({VIEWER: viewer, ENGINE: engine}),
        }
    FOLDER.mkdir(exist_ok=True)
    for name, content in files.items():
        (FOLDER / name).write_bytes(content)
        print(f"{name}: {len(content):,} bytes")
    (FOLDER / "MANIFEST.json").write_text(json.dumps(manifest(files), indent=2) + "\n")


def fetched(package: Package, folder: Path) -> Path:
    """The folder of a package's files, whose archive has been checked."""
    where = folder / package.name.replace("/", "-")
    where.mkdir()
    command = ["npm", "pack", "--silent", f"{package.name}@{package.version}"]
    subprocess.run(command, cwd=where, check=True, stdout=subprocess.DEVNULL)
    (archive,) = where.glob("*.tgz")
    digest = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
    if f"sha512-{digest}" != package.integrity:
        raise SystemExit(f"{package.name}: expected {package.integrity}, got sha512-{digest}")
    with tarfile.open(archive) as file:
        file.extractall(where, filter="data")
    return where / "package"


def changed(source: str) -> str:
    """The bundle with all changes."""
    for change in CHANGES:
        if (count := source.count(change.old)) != 1:
            raise SystemExit(f"must stand in the bundle once, not {count} times: {change.old}")
        source = source.replace(change.old, change.new)
    return source


def minified(source: str, program: Path, folder: Path) -> bytes:
    """The module without what only people read."""
    (folder / "bundle.mjs").write_text(source, "utf-8")
    command = [program, "bundle.mjs", "--minify", "--log-level=error"]
    return subprocess.run(command, cwd=folder, check=True, stdout=subprocess.PIPE).stdout


def licences(folders: dict[Package, Path]) -> bytes:
    """Those of all packages, one after the other."""
    texts = (
        f"{package.name} {package.version}\n\n{(folder / 'LICENSE').read_text('utf-8').strip()}\n"
        for package, folder in folders.items()
    )
    return "\n\n".join(texts).encode()


def manifest(files: dict[str, bytes]) -> dict[str, object]:
    """What is shipped, and where it is from."""
    return {
        "made_by": "python .ci/viewer.py",
        "packages": [package._asdict() for package in (VIEWER, ENGINE)],
        "minifier": MINIFIER._asdict(),
        "changes": [change._asdict() for change in CHANGES],
        "sha256": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
    }


if __name__ == "__main__":
    main()
