"""The way of a reader: where reading begins, the paper's symbols, and names of the field."""

import ast
import re

import pytest
from conftest import REPOSITORY

from drgs.config.schema import FitConfig
from drgs.core import constants, memory
from drgs.datasets import transforms
from drgs.integrator import image_render
from drgs.io import images
from drgs.reference import splatting
from drgs.render import __main__ as render

REFERENCE = "drgs/reference/splatting.py"


def section(page, heading):
    text = (REPOSITORY / page).read_text()
    return text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]


@pytest.mark.parametrize("page", ["README.md", "docs/how_it_works.md"])
def test_reading_guide_begins_with_the_reference(page):
    first = re.search(r"\]\((.*?)\)", section(page, "Reading the code"))[1]
    assert first.removeprefix("../") == REFERENCE


def rows_of_symbols():
    """Symbol, and the code in the columns of the reference and of the kernels."""
    lines = section("docs/how_it_works.md", "Symbols").splitlines()
    cells = [line.strip("|").split("|") for line in lines if line.startswith("| ")][2:]
    for symbol, reference, kernels, _ in cells:
        yield symbol.strip(), *(re.findall(r"`([^`]+)`", cell) for cell in (reference, kernels))


def identifiers(*paths):
    found = set()
    for path in paths:
        for node in ast.walk(ast.parse((REPOSITORY / path).read_text())):
            for field in ("id", "attr", "name", "arg"):
                name = getattr(node, field, None)
                found |= {name} if isinstance(name, str) else set()
    return found


def test_symbols_of_the_paper_are_mapped_to_names_in_the_code():
    kernels = (
        *("drgs/splatting/projection.py", "drgs/splatting/footprint.py"),
        *("drgs/cameras/camera.py", "drgs/cameras/lens.py"),
        *("drgs/gaussians/parameters.py", "drgs/gaussians/sh.py"),
    )
    known = identifiers(REFERENCE), identifiers(*kernels)
    rows = list(rows_of_symbols())
    symbols = " ".join(symbol for symbol, *_ in rows)
    for symbol in (r"\mu", "$R$", "S = ", r"\Sigma = R S S^T R^T", "$W$", "$J$", r"\Sigma' = J W"):
        assert symbol in symbols
    for symbol, *columns in rows:
        assert columns[0], symbol
        for codes, names in zip(columns, known, strict=True):
            missing = set(re.findall(r"[A-Za-z_]\w*", " ".join(codes))) - names
            assert not missing, (symbol, missing)


def test_both_forms_of_the_projected_covariance_are_documented():
    text = (REPOSITORY / "docs" / "how_it_works.md").read_text()
    assert r"\Sigma' = J W \Sigma W^T J^T = J W R S S^T R^T W^T J^T = M M^T" in text
    assert "scenes/images/tiles.png" in text


# ----------------------------------------------------------------------------------------------
# Limits
# ----------------------------------------------------------------------------------------------


def test_documented_limits_match_the_code():
    text = section("docs/limits.md", "Sizes")
    cap = FitConfig.model_fields["densify"].annotation.model_fields["max_gaussians"]
    (largest,) = (limit.le for limit in cap.metadata if hasattr(limit, "le"))
    stated = {
        "a photograph": images.MAX_PIXELS,
        "a rendered image": memory.IMAGE_BYTES,
        "samples of a pixel": image_render.MAX_SAMPLES,
        "AOVs": constants.MAX_FEATURES,
        "Gaussians": largest,
        "frames of an orbit": render.MAX_FRAMES,
        "an animated WebP": images.MAX_WEBP_SIDE,
        "arrays": memory.MAX_LANES,
        "coordinates of cameras": int(transforms.MAX_COORDINATE),
    }
    rows = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|", text, re.MULTILINE))
    for what, limit in stated.items():
        assert re.search(rf"(?<![\d,]){limit:,}(?!,?\d)", rows[what]), what
    assert f"{cap.default:,}" in rows["Gaussians"]


def test_splats_page_documents_how_colours_are_stored():
    assert f"0.5 + {splatting.C_00:.4f} sh0" in (REPOSITORY / "docs" / "mitsuba.md").read_text()
