"""The plugins are found by Mitsuba 3.10's discovery, by ``import drgs``, and by both.

The discovery is simulated as that version does it: it imports the modules that entry points of the
group ``mitsuba`` name when the first variant becomes active, and reloads them after each change.
"""

import importlib.metadata

import pytest
from conftest import CHOSEN_LLVM, REPOSITORY

tomllib = pytest.importorskip("tomllib")  # from Python 3.11 on

DISCOVERY = """
import importlib, sys
import mitsuba as mi

modules = None

def set_variant(name):
    global modules
    mi.set_variant(name)
    if modules is None:
        modules = [importlib.import_module({module!r})]
    else:
        modules = [importlib.reload(module) for module in modules]
"""

ROUND_TRIP = """
set_variant("llvm_ad_rgb")
first = type(mi.load_dict({"type": "splats"})), type(mi.load_dict({"type": "calibrated"}))
assert issubclass(first[0], mi.Integrator) and issubclass(first[1], mi.Sensor)
set_variant("scalar_rgb")
assert issubclass(sys.modules["drgs.plugins.scalar_rgb.splats"].SplatsIntegrator, mi.Integrator)
set_variant("llvm_ad_rgb")
again = type(mi.load_dict({"type": "splats"})), type(mi.load_dict({"type": "calibrated"}))
assert again == first and issubclass(again[0], mi.Integrator)
llvm = {name for name in sys.modules if name.startswith("drgs.plugins.llvm_ad_rgb")}
names = ("splats", "splatpath", "calibrated", "minimal")
assert llvm == {f"drgs.plugins.llvm_ad_rgb.{name}" for name in names}
assert sys.modules["drgs.plugins.llvm_ad_rgb.splats"].SplatsIntegrator is first[0]
print("fine")
"""

PLAIN = "\ndef set_variant(name):\n    mi.set_variant(name)\n"


def entry_points():
    with (REPOSITORY / "pyproject.toml").open("rb") as file:
        return tomllib.load(file)["project"]["entry-points"]["mitsuba"]


def test_one_entry_point_names_the_plugins():
    assert entry_points() == {"drgs": "drgs.plugins"}


def test_installed_metadata_has_the_same_entry_point():
    found = importlib.metadata.entry_points(group="mitsuba", name="drgs")
    if not found:
        pytest.skip("drgs is not installed here, or was before it had an entry point")
    assert {point.value for point in found} == {"drgs.plugins"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "program",
    [
        "{discovery}{trip}",
        "import drgs\n{discovery}{trip}",
        "{discovery}set_variant('scalar_rgb')\nimport drgs\n{trip}",
        "{discovery}mi.set_variant('llvm_ad_rgb')\nimport drgs\n{trip}",
        "{discovery}set_variant('llvm_ad_rgb')\nmi.detail.clear_variant_callbacks()\n{trip}",
        "import sys, mitsuba as mi\nmi.set_variant('scalar_rgb')\nimport drgs\n{plain}{trip}",
        "import sys, importlib, drgs\nimport mitsuba as mi\n{plain}"
        "set_variant('llvm_ad_rgb')\nimportlib.reload(drgs)\n{trip}",
    ],
    ids=[
        "entry point alone",
        "import first",
        "import after the first variant",
        "import between the variant and the discovery",
        "entry point without callbacks",
        "import alone, after a variant",
        "import reloaded",
    ],
)
def test_each_way_to_register_gives_one_class_for_each_variant(run_python, program):
    text = program.format(
        discovery=DISCOVERY.format(module=entry_points()["drgs"]), trip=ROUND_TRIP, plain=PLAIN
    )
    result = run_python(text, **CHOSEN_LLVM)
    assert result.stdout == "fine\n", result.stderr
