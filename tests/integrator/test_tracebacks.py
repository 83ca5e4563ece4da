"""An error's traceback contains its cause, whatever Mitsuba and Dr.Jit put around it.

Programs run one after the other in a process of their own, which shows each error as Python does.
"""

import re
import subprocess
import sys
from functools import cache

import pytest
from conftest import REPOSITORY

SCENES = """
import sys, tempfile
import numpy as np, drgs, drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")

def tensor(values):
    return mi.TensorXf(np.float32(values))

splats = dict(type="splats", means=tensor([[0, 0, 0]]), quats=tensor([[1, 0, 0, 0]]),
              log_scales=tensor([[-1, -1, -1]]), logit_opacities=tensor([1]),
              sh0=tensor([[[1, 1, 1]]]))
film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
to_world = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
camera = {"type": "perspective", "to_world": to_world, "film": film}
ball = {"type": "sphere", "radius": 0.3, "bsdf": {"type": "conductor"}}

def load(integrator=splats, sensor=camera, **others):
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **others})

def attached(key, *arguments, **others):
    scene = load(*arguments, **others)
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    return scene, params, mi.render(scene, params)

def run(program):
    try:
        exec(program, dict(globals()))
    except Exception:
        sys.excepthook(*sys.exc_info())
"""

HAS_SURFACES = "sensor.to_world is not differentiated in a scene with surfaces"

PROGRAMS = {
    "load_dict": ("load({**splats, 'nea': 1})", "splats: there is no parameter nea"),
    "load_string": (
        'mi.load_string(\'<scene version="3.0.0"><integrator type="splats">'
        '<float name="nea" value="1"/></integrator></scene>\')',
        "splats: there is no parameter nea",
    ),
    "load_file": (
        "path = tempfile.mkdtemp() + '/scene.xml'\n"
        'open(path, \'w\').write(\'<scene version="3.0.0"><integrator type="splatpath">'
        '<float name="rr_dept" value="1"/></integrator></scene>\')\n'
        "mi.load_file(path)",
        "splatpath: there is no parameter rr_dept; did you mean rr_depth?",
    ),
    "splatpath": (
        "mi.load_dict({'type': 'splatpath', 'max_depth': -5})",
        "splatpath: max_depth must be an integer from -1 to 2147483647, got -5",
    ),
    "calibrated": ("mi.load_dict({'type': 'calibrated', 'fx': -3.0})", "calibrated: fx must be"),
    "inside aov": (
        "mi.load_dict({'type': 'aov', 'aovs': 'd:depth', 'img': {**splats, 'nea': 1}})",
        "splats: there is no parameter nea",
    ),
    "render": ("mi.render(load(), spp=100000)", "splats: a pixel can have at most 4,096 samples"),
    "render with parameters": (
        "scene = load(); mi.render(scene, mi.traverse(scene), spp=100000)",
        "splats: a pixel can have at most 4,096 samples",
    ),
    "integrator.render": (
        "scene = load(); scene.integrator().render(scene, spp=100000)",
        "splats: a pixel can have at most 4,096 samples",
    ),
    "moment": (
        "mi.render(load({'type': 'moment', 'img': splats}))",
        "splats: this integrator renders whole images",
    ),
    "a film": (
        "mi.render(load({**splats, 'srgb_primitives': False}, "
        "{**camera, 'film': {**film, 'pixel_format': 'luminance'}}, ball=ball))",
        "splats: in a scene with surfaces and with srgb_primitives false",
    ),
    "update": (
        "params = mi.traverse(load()); params['integrator.means'] = tensor(np.zeros((2, 3)))\n"
        "params.update()",
        "splats: quats must have the shape",
    ),
    "backward": ("dr.backward(attached('sensor.to_world', ball=ball)[2])", HAS_SURFACES),
    "forward": ("dr.forward_to(attached('sensor.to_world', ball=ball)[2])", HAS_SURFACES),
    "render_backward": (
        "scene, params, image = attached('sensor.to_world', ball=ball)\n"
        "scene.integrator().render_backward(scene, params, dr.detach(image))",
        HAS_SURFACES,
    ),
    "render_forward": (
        "scene, params, image = attached('sensor.to_world', ball=ball)\n"
        "scene.integrator().render_forward(scene, params)",
        HAS_SURFACES,
    ),
    "splatpath alone": (
        "dr.backward(attached('sensor.x_fov', {'type': 'splatpath'}, ball=ball)[2])",
        "splatpath: nothing that a path meets changes with the parameters",
    ),
}


@cache
def shown() -> dict[str, str]:
    """Return each program's output on stderr."""
    programs = [program for program, _ in PROGRAMS.values()]
    between = "\nEND OF PROGRAM\n"
    script = f"{SCENES}\nfor program in {programs!r}:\n    run(program)\n"
    script += f"    sys.stderr.write({between!r})\n"
    command = [sys.executable, "-c", script]
    result = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=120)
    parts = result.stderr.split(between)
    assert len(parts) == len(PROGRAMS) + 1, parts[-1]
    return dict(zip(PROGRAMS, parts, strict=False))


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_the_traceback_names_the_cause(name):
    _, expected = PROGRAMS[name]
    errors = r"(?:drgs\.core\.errors\.)?(?:PluginError|PluginTypeError|UnsupportedError): (.*)"
    messages = re.findall(errors, shown()[name])
    assert any(
        message.startswith(("splats:", "splatpath:", "calibrated:")) and expected in message
        for message in messages
    )
