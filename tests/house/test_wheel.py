"""What ``pip install`` of the wheel brings, used far from the checkout.

Nothing is fetched: the build tools and the dependencies are those of this environment.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from conftest import REPOSITORY
from PIL import Image
from support.small_capture import blobs

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        find_spec("pip") is None or find_spec("hatchling") is None,
        reason="needs pip and hatchling",
    ),
]

SCENE = """<scene version="3.0.0">
    <integrator type="splats"><string name="filename" value="model.ply"/></integrator>
    <sensor type="calibrated">
        <transform name="to_world">
            <lookat origin="0, -4, 1" target="0, 0, 0" up="0, 0, 1"/>
        </transform>
        <float name="fx" value="40"/><float name="fy" value="40"/>
        <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/>
        </film>
    </sensor>
</scene>
"""


def run(*command, cwd):
    """Standard output of a process that succeeds."""
    result = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def scripts(tmp_path_factory):
    """Folder of the scripts of a new virtual environment with the wheel in it."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("drgs", "plugins"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / name, source / name, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source / name)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input")
    offline = ("--quiet", "--no-deps", "--no-index")
    run(*pip, "wheel", *offline, "--no-build-isolation", "-w", folder, source, cwd=folder)
    (wheel,) = folder.glob("drgs-*.whl")
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
    scripts = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / f"python{sysconfig.get_config_var('EXE') or ''}"
    run(*pip, "--python", python, "install", *offline, wheel, cwd=folder)
    # The dependencies are this environment's, and come last. Its own .pth files, such as that of
    # an editable drgs, are not read there.
    where = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder)
    paths = [path for path in sys.path if path.endswith("site-packages")]
    Path(where.strip(), "dependencies.pth").write_text("\n".join(paths) + "\n")
    return scripts


@pytest.fixture
def model(tmp_path):
    blobs().save(tmp_path / "model.ply")
    return tmp_path / "model.ply"


def files_of(package):
    """Paths of a package's files, without what Python compiles."""
    found = (path.relative_to(package) for path in package.rglob("*") if path.is_file())
    return {path for path in found if "__pycache__" not in path.parts}


def test_the_package_is_the_wheels_and_holds_every_file(scripts, tmp_path):
    program = "import drgs, drgs.plugins; print(drgs.__file__, drgs.plugins.__file__, sep='\\n')"
    shown = run(scripts / "python", "-c", program, cwd=tmp_path).splitlines()
    package, plugins = (Path(file).parent for file in shown)
    assert package.is_relative_to(scripts.parent) and plugins == package / "plugins"
    expected = files_of(REPOSITORY / "drgs")
    expected |= {Path("plugins", path) for path in files_of(REPOSITORY / "plugins")}
    assert files_of(package) == expected


def test_the_console_script_and_the_module_are_the_same_program(scripts, tmp_path):
    script = run(scripts / "drgs", "--help", cwd=tmp_path)
    module = run(scripts / "python", "-m", "drgs", "--help", cwd=tmp_path)
    assert script.startswith("usage: drgs [-h]")
    assert script.replace("drgs", "python -m drgs", 1).splitlines()[0] == module.splitlines()[0]


def test_the_script_renders_gaussians_and_a_mitsuba_scene(scripts, model, tmp_path):
    """With both plugins."""
    (tmp_path / "scene.xml").write_text(SCENE)
    camera = ("--origin", "0", "-4", "1", "--size", "32", "24")
    run(scripts / "drgs", "render", model, *camera, "--out", "a", cwd=tmp_path)
    run(scripts / "drgs", "render", "scene.xml", "--out", "b", cwd=tmp_path)
    for picture in ("a/camera.png", "b/scene.png"):
        pixels = np.array(Image.open(tmp_path / picture))
        assert pixels.shape[:2] == (24, 32) and pixels.std() > 1


def test_mitsuba_finds_the_plugins_by_the_entry_point(scripts, model, tmp_path):
    """As Mitsuba 3.10 does: nothing else imports drgs."""
    program = (
        "import importlib, importlib.metadata, sys\n"
        "import mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "(point,) = importlib.metadata.entry_points(group='mitsuba', name='drgs')\n"
        "assert 'drgs' not in sys.modules\n"
        "importlib.import_module(point.value)\n"
        "scene = mi.load_file('scene.xml')\n"
        "print(mi.render(scene).shape, sys.modules['drgs'].__file__)"
    )
    (tmp_path / "scene.xml").write_text(SCENE)
    shown = run(scripts / "python", "-c", program, cwd=tmp_path)
    assert shown.startswith("(24, 32, ") and str(scripts.parent) in shown
