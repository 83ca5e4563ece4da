"""A type checker, basedpyright in its standard mode, finds nothing in the package.

Mitsuba's stubs declare classes ``Float``, ``Bool``, ``Vector3f``, ... that are unrelated to the
types of ``drjit.auto.ad``, which its methods take and return. The checker sees corrected stubs.
"""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY

CHECKER = shutil.which("basedpyright", path=str(Path(sys.executable).parent))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHECKER is None, reason="basedpyright is not installed"),
]

FLAT = r"(?:Bool|U?Int(?:32|64)?|Float(?:16|32|64)?|Matrix[234]f(?:64)?|TensorXf(?:16|32)?)"
VECTOR = r"(?:Vector|Point|Normal|Color)([0-4])([fiu]?)(\d*)"
BODY = r".*(?:\n(?:    .*)?)*?(?=\n\S)"
"""The rest of a class."""


def correct_stub(text):
    """Return Mitsuba's stub with aliases of Dr.Jit's types for its own."""
    declare = r"\1: TypeAlias = drjit.auto.ad."
    text = re.sub(rf"^class ({FLAT})\(drjit\.ArrayBase{BODY}", rf"{declare}\1", text, flags=re.M)
    text = re.sub(
        rf"^class ({VECTOR})\(drjit\.ArrayBase{BODY}",
        lambda m: f"{m[1]}: TypeAlias = drjit.auto.ad.Array{m[2]}{m[3] or 'f'}{m[4]}",
        text,
        flags=re.M,
    )
    text = re.sub(
        rf"^class (UnpolarizedSpectrum|SpectrumEntry|Spectrum)\({BODY}",
        rf"{declare}Array3f",
        text,
        flags=re.M,
    )
    # Values of Python are converted: they are the stubs' own defaults.
    for kind, host in {"Bool": "bool", "UInt": "int", "Float": "float"}.items():
        parameter = rf"(\b(?:active|coherent|seed): drjit\.auto\.ad\.{kind})\b(?= = |,|\))"
        text = re.sub(
            r"def [^\n]*", lambda m, p=parameter, h=host: re.sub(p, rf"\1 | {h}", m[0]), text
        )
    return text.replace("def bsdf(self, ray: RayDifferential3f)", "def bsdf(self, ray: Ray3f)")


def write_stubs(folder):
    """Write the corrected stubs of Mitsuba, and copies of its Python modules."""
    source = Path(importlib.util.find_spec("mitsuba").origin).parent
    for path in [*source.glob("*.pyi"), *source.rglob("python/**/*.py")]:
        copy = folder / "mitsuba" / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(
            correct_stub(path.read_text()) if path.name == "__init__.pyi" else path.read_text()
        )


def test_type_checker_finds_no_errors(tmp_path):
    write_stubs(tmp_path / "stubs")
    settings = {
        "typeCheckingMode": "standard",
        "reportImplicitOverride": "error",
        "include": [str(REPOSITORY / "drgs"), str(REPOSITORY / "plugins")],
        "extraPaths": [str(REPOSITORY)],
        "stubPath": str(tmp_path / "stubs"),
    }
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [CHECKER, "-p", str(tmp_path), "--pythonpath", sys.executable]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
