"""A file format in one file outside of drgs works wherever a shipped one does."""

import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from support.commands import assert_ends_well
from support.small_capture import blobs

from drgs.core import registry
from drgs.core.errors import UserError
from drgs.export import __main__ as export
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.io import formats
from drgs.render import __main__ as render

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "npz_format.py"


@pytest.fixture
def installed(monkeypatch, tmp_path):
    """A folder on Python's path with the example and the entry point of an installed package."""
    folder = tmp_path / "site"
    about = folder / "drgs_npz-1.0.dist-info"
    about.mkdir(parents=True)
    (folder / EXAMPLE.name).write_bytes(EXAMPLE.read_bytes())
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: drgs-npz\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[drgs]\nnpz = npz_format\n")
    formats.readable_formats()  # imports those that are shipped
    monkeypatch.syspath_prepend(folder)
    with mock.patch.dict(sys.modules), registry.temporary_registrations():
        yield folder


def test_gaussians_are_saved_and_loaded(installed, tmp_path):
    given = replace(blobs(), origin=(4e6, 0.0, 1e6), rendered_with={"low_pass": 0.1})
    given.save(tmp_path / "a.npz")
    read = Gaussians.load(tmp_path / "a.npz")
    assert (read.origin, read.rendered_with) == (given.origin, given.rendered_with)
    for name in PARAMETER_NAMES:
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name))


@pytest.mark.slow
def test_commands_export_and_render_it(installed, tmp_path):
    blobs().save(tmp_path / "a.ply")
    shown = assert_ends_well(export.main, "--help").stdout
    assert "npz: NumPy's archive of arrays" in " ".join(shown.split())
    shown = assert_ends_well(export.main, tmp_path / "a.ply", "--format", "npz").stdout
    assert f"written: {tmp_path / 'a.npz'} (" in shown
    assert np.array_equal(np.load(tmp_path / "a.npz")["means"], blobs().means)
    options = ["--orbit", 2, "--size", 16, 16, "--out", tmp_path / "out"]
    assert_ends_well(render.main, tmp_path / "a.npz", *options)
    assert list((tmp_path / "out").glob("**/*.png"))


def test_messages_list_the_format(installed, tmp_path):
    with pytest.raises(UserError, match=r"in one of .*\.npz; .*entry point of the group"):
        blobs().save(tmp_path / "a.obj")
    with pytest.raises(UserError, match=r'"npzz"; did you mean npz\?; there are .*entry point'):
        blobs().to_bytes("npzz")


ARRAYS = {name: getattr(blobs(), name) for name in PARAMETER_NAMES}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (ARRAYS, r"KeyError: '.*rendered_with"),
        ({"means": ARRAYS["means"], "rendered_with": "{}"}, "ValueError: arrays must be means, q"),
        (
            {**ARRAYS, "quats": ARRAYS["means"], "rendered_with": "{}"},
            r"ValueError: quats: \(4,\) per Gaussian expected, got \(30, 3\)",
        ),
    ],
)
def test_errors_of_the_format_are_reported_with_its_name(installed, tmp_path, content, reason):
    np.savez(tmp_path / "a.npz", **content)
    with pytest.raises(UserError, match=rf'a\.npz: file format "npz" \(npz_format\): {reason}'):
        Gaussians.load(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "return content.getvalue()",
            "return 1 / 0",
            r'file format "npz" \(npz_format\): ZeroDivisionError: division by zero',
        ),
        (
            'suffix = ".npz"',
            'suffix = "npz"',
            r'cannot load the extension "npz" of the package drgs-npz \(npz_format\): TypeError: '
            r"Npz\.suffix must be a suffix in small",
        ),
        ("import io", "import no_such_module", 'cannot load the extension "npz" .*no_such_module'),
    ],
)
def test_errors_of_the_package_are_reported_with_its_name(installed, tmp_path, old, new, message):
    """Shipped formats go on."""
    module = installed / "npz_format.py"
    text = module.read_text()
    assert old in text
    module.write_text(text.replace(old, new))
    with pytest.raises(UserError, match=message):
        blobs().save(tmp_path / "a.npz")
    blobs().save(tmp_path / "a.ply")
    assert Gaussians.load(tmp_path / "a.ply").num_gaussians == 30
