"""A plugin of pytest with which programs and scenes in the pages are tests, by sybil.

``python -m pytest -p support.pages -n 0 -m '' README.md docs``
"""

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)

# isort: split

import importlib.util
import os
import tempfile
from pathlib import Path

import mitsuba as mi
from sybil import Sybil
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser, SkipParser

from support.helpers import host_gaussians
from support.small_capture import make_dataset, write_dataset
from support.views import Scene

REPOSITORY = Path(__file__).parents[2]

SMALL_FIT = """
data: {path: lego}
init: {num_points: 300, half_extent: 1.0}
densify: {start: 2, stop: 3, strategy: adc, adc: {white_background_reset: null}}
iterations: 4
"""


def enter_folder(namespace) -> None:
    """Enter a folder with small files under the names that programs read."""
    folder = Path(tempfile.mkdtemp())
    path = folder / "out" / "lego" / "point_cloud_drgs.ply"
    path.parent.mkdir(parents=True)
    host_gaussians(Scene(count=20, degree=3).gaussians).save(path)
    write_dataset(folder / "scenes" / "lego", make_dataset(train=3, test=1))
    (folder / "scenes" / "lego_mini.yml").write_text(SMALL_FIT)
    os.chdir(folder)
    namespace["has_torch"] = importlib.util.find_spec("torch") is not None


def render_xml(example) -> None:
    """Render the scene of a block."""
    mi.set_variant("llvm_ad_rgb")
    assert mi.render(mi.load_string(example.parsed)).shape


pytest_collect_file = Sybil(
    parsers=[SkipParser(), PythonCodeBlockParser(), CodeBlockParser("xml", render_xml)],
    path=str(REPOSITORY),
    patterns=["*.md"],
    setup=enter_folder,
    teardown=lambda namespace: os.chdir(REPOSITORY),
).pytest()
