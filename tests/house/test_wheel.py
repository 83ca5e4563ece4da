"""An installed wheel, used far from the checkout.

Nothing is fetched: the build tools and the dependencies are those of this environment.
"""

import json
import os
import shutil
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from conftest import REPOSITORY, copy_checkout, run_program
from PIL import Image
from support.small_capture import blobs, make_dataset, write_dataset

from drgs.gaussians.parameters import Gaussians
from drgs.io.images import write_png
from drgs.results.folder import own_gaussians

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
    """Return the standard output of a process that succeeds, far from the checkout."""
    variables = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return run_program(*command, cwd=cwd, env=variables, timeout=300)


PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input")
OFFLINE = ("--quiet", "--no-deps", "--no-index")


def build_wheel(source, folder):
    """Return the wheel of a package, in a folder without others."""
    run(*PIP, "wheel", *OFFLINE, "--no-build-isolation", "-w", folder, source, cwd=folder)
    (wheel,) = folder.glob("*.whl")
    return wheel


def install_for(wheel, python):
    """Install a wheel for another interpreter."""
    run(*PIP, "--python", python, "install", *OFFLINE, wheel, cwd=wheel.parent)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    return build_wheel(copy_checkout(folder / "source"), folder)


def make_environment(wheel, folder):
    """Return the folders of scripts and packages of a new virtual environment with the wheel."""
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
    scripts = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / f"python{sysconfig.get_config_var('EXE') or ''}"
    install_for(wheel, python)
    # The dependencies are this environment's, and come last. Its own .pth files, such as that of
    # an editable drgs, are not read there.
    where = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder)
    paths = [path for path in sys.path if path.endswith("site-packages")]
    Path(where.strip(), "dependencies.pth").write_text("\n".join(paths) + "\n")
    return scripts, Path(where.strip())


@pytest.fixture(scope="module")
def scripts(wheel, tmp_path_factory):
    """Folder of the scripts of a new virtual environment with the wheel in it."""
    return make_environment(wheel, tmp_path_factory.mktemp("environment"))[0]


@pytest.fixture
def model(tmp_path):
    blobs().save(tmp_path / "model.ply")
    return tmp_path / "model.ply"


def test_the_console_script_and_the_module_are_the_same_program(scripts, tmp_path):
    script = run(scripts / "drgs", "--help", cwd=tmp_path)
    module = run(scripts / "python", "-m", "drgs", "--help", cwd=tmp_path)
    assert script.startswith("usage: drgs [-h]")
    assert script.replace("drgs", "python -m drgs", 1).splitlines()[0] == module.splitlines()[0]


def test_a_wheel_without_some_commands_has_the_others(wheel, tmp_path):
    """Entry points of missing packages are left out."""
    scripts, packages = make_environment(wheel, tmp_path)
    for command in ("export", "poses", "capture", "bench", "examine"):
        shutil.rmtree(packages / "drgs" / command)
    commands = run(scripts / "drgs", "--help", cwd=tmp_path).partition("commands:")[2]
    listed = [line.split()[0] for line in commands.partition("examples:")[0].splitlines() if line]
    assert [name for name in listed if name != "COMMAND"] == ["fit", "render", "view"]
    write_dataset(tmp_path / "photographs", make_dataset(train=3, test=1))
    short = ("iterations=4", "init.num_points=60", "output.report=false")
    short = [word for value in short for word in ("--set", value)]
    shown = run(scripts / "drgs", "fit", "photographs", *short, "--out", "out", cwd=tmp_path)
    assert "not examined: no examiner is installed" in shown and "written: " in shown
    run(scripts / "drgs", "render", "out", "--orbit", 2, "--out", "images", cwd=tmp_path)
    assert len(list((tmp_path / "images").glob("**/*.png"))) == 2
    assert "usage: drgs view" in run(scripts / "drgs", "view", "--help", cwd=tmp_path)
    shutil.copy(tmp_path / "out" / "point_cloud.ply", tmp_path / "model.ply")
    (tmp_path / "scene.xml").write_text(SCENE)
    program = "import drgs, mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
    program += "print(mi.render(mi.load_file('scene.xml')).shape)"
    assert run(scripts / "python", "-c", program, cwd=tmp_path).startswith("(24, 32, ")


def test_the_script_renders_gaussians_and_a_mitsuba_scene(scripts, model, tmp_path):
    """With both plugins."""
    (tmp_path / "scene.xml").write_text(SCENE)
    camera = ("--origin", "0", "-4", "1", "--size", "32", "24")
    run(scripts / "drgs", "render", model, *camera, "--out", "a", cwd=tmp_path)
    run(scripts / "drgs", "render", "scene.xml", "--out", "b", cwd=tmp_path)
    for rendered in ("a/camera.png", "b/scene.png"):
        pixels = np.array(Image.open(tmp_path / rendered))
        assert pixels.shape[:2] == (24, 32) and pixels.std() > 1


def test_mitsuba_finds_the_plugins_by_the_entry_point(scripts, model, tmp_path):
    """Mitsuba 3.10 loads it so; nothing else imports drgs."""
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


CONFIGURATION = """
data: {path: photographs, type: numpy_poses, test_every: 4}
iterations: 12
init: {num_points: 60, half_extent: 0.5}
model: {falloff: compact}
densify: {strategy: halving, halving: {after: 8}}
loss: {type: charbonnier}
output: {report: false}
numpy_poses: {unit: 1.0}
vignetting: {lr: 0.02}
binary_opacity: {weight: 0.1}
"""

PROGRAM = """
import drgs
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from charbonnier import Charbonnier, CharbonnierSection
from halving import Halving, HalvingSection
from vignetting import Vignetting, VignettingSection

# The rates' decay follows from the strategy's name: here it is that of ``halving``.
settings = ["densify.strategy=budget", "loss.type=photometric", "optimizer.decay=0.1"]
config = load_config("fit.yml", settings)
config = FitConfig.model_validate(config.model_dump(exclude={"vignetting"}))
result = drgs.train(
    config,
    strategy=Halving(HalvingSection(after=8)),
    effects=[Vignetting(VignettingSection(lr=0.02))],
    loss=Charbonnier(CharbonnierSection()),
)
result.gaussians.save("python.npz")
"""


@pytest.fixture
def photographs(tmp_path):
    """Photographs in the layout of the example's reader, and the same through its lens."""
    views = make_dataset(train=5, test=0).train
    (tmp_path / "photographs" / "images").mkdir(parents=True)
    for index, view in enumerate(views):
        write_png(tmp_path / "photographs" / "images" / f"{index}.png", np.asarray(view.image))
    np.save(tmp_path / "photographs" / "poses.npy", [view.camera_to_world for view in views])
    camera = {name: getattr(views[0], name) for name in ("fx", "fy", "cx", "cy")}
    (tmp_path / "photographs" / "intrinsics.json").write_text(json.dumps(camera))
    shutil.copytree(tmp_path / "photographs" / "images", tmp_path / "bent" / "images")
    frames = [
        {
            "file_path": f"images/{index}.png",
            "transform_matrix": (view.camera_to_world @ np.diag([1, -1, -1, 1])).tolist(),
        }
        for index, view in enumerate(views)
    ]
    lens = {"camera_model": "unified", "xi": 0.25}
    numbers = {"fl_x": 1.25 * camera["fx"], "fl_y": 1.25 * camera["fy"]}
    numbers |= {"cx": camera["cx"], "cy": camera["cy"]}
    content = json.dumps({**lens, **numbers, "frames": frames})
    (tmp_path / "bent" / "transforms.json").write_text(content)
    return tmp_path


def test_template_of_a_package_is_installed_and_passes_its_own_tests(scripts, tmp_path):
    source = shutil.copytree(REPOSITORY / "examples" / "extension", tmp_path / "source")
    install_for(build_wheel(source, tmp_path), scripts / "python")
    tests = shutil.move(source / "tests", tmp_path / "tests")
    shutil.rmtree(source)
    line = (scripts / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", tests)
    assert " passed" in run(*line, cwd=tmp_path)
    assert "lens equisolid" in run(scripts / "drgs", "fit", "--help", cwd=tmp_path)


def test_external_package_can_use_every_extension_point(scripts, photographs):
    """A strategy, effect, loss, term, lens, falloff, file format and reader; no file of drgs."""
    folder = photographs
    source = shutil.copytree(REPOSITORY / "examples", folder / "source")
    install_for(build_wheel(source, folder), scripts / "python")
    shutil.rmtree(source)
    (folder / "fit.yml").write_text(CONFIGURATION)
    shown = run(scripts / "drgs", "fit", "fit.yml", "--out", "out", cwd=folder)
    for line in ("halving: density strategy", "vignetting: effect", "charbonnier: loss"):
        assert line in shown
    assert "binary_opacity: loss term" in shown and "(numpy_poses layout)" in shown
    assert "compact" in shown
    run(scripts / "drgs", "export", "out", "--format", "npz", "--out", "yaml.npz", cwd=folder)
    run(scripts / "python", "-c", PROGRAM, cwd=folder)
    with np.load(folder / "yaml.npz") as named, np.load(folder / "python.npz") as given:
        assert len(named["means"]) == 30
        fitted = Gaussians.load(own_gaussians(folder / "out"))
        np.testing.assert_array_equal(fitted.means, given["means"])
    short = ("--set", "iterations=4", "--set", "init.num_points=60", "--set", "output.report=false")
    shown = run(scripts / "drgs", "fit", "bent", *short, "--out", "bent_out", cwd=folder)
    assert "unified" in shown and "unified" in (folder / "bent_out" / "views.json").read_text()
    listed = " ".join(run(scripts / "drgs", "--help", cwd=folder).split())
    assert "count print the number of Gaussians" in listed
    assert run(scripts / "drgs", "count", "yaml.npz", cwd=folder) == "30\n"
    help_text = " ".join(run(scripts / "drgs", "fit", "--help", cwd=folder).split())
    for name in (
        "dataset reader numpy_poses",
        "file format npz",
        "lens unified",
        "falloff compact",
    ):
        assert name in help_text
