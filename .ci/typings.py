"""Writes ``typings/``: Mitsuba's stubs, corrected, for the type checker.

Mitsuba's stubs declare classes ``Float``, ``Bool``, ``Vector3f``, ... that are unrelated to the
types of ``drjit.auto.ad``, which its methods take and return. Run this after another version of
Mitsuba is installed: ``python .ci/typings.py``.
"""

import importlib.metadata
import importlib.util
import re
import sys
from pathlib import Path

FLAT = r"(?:Bool|U?Int(?:32|64)?|Float(?:16|32|64)?|Matrix[234]f(?:64)?|TensorXf(?:16|32)?)"
VECTOR = r"(?:Vector|Point|Normal|Color)([0-4])([fiu]?)(\d*)"
BODY = r".*(?:\n(?:    .*)?)*?(?=\n\S)"
"""The rest of a class."""


def correct_stub(text: str) -> str:
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


def write_stubs(folder: Path) -> None:
    """Write the corrected stubs of the installed Mitsuba into ``folder``."""
    source = Path(importlib.util.find_spec("mitsuba").origin).parent
    version = importlib.metadata.version("mitsuba")
    folder.mkdir(parents=True, exist_ok=True)
    for path in source.glob("*.pyi"):
        header = f"# Corrected by .ci/typings.py from the stubs of Mitsuba {version}\n"
        (folder / path.name).write_text(header + correct_stub(path.read_text()))


if __name__ == "__main__":
    write_stubs(Path(sys.argv[1] if len(sys.argv) > 1 else "typings/mitsuba"))
