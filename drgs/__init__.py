"""3D Gaussian splatting inside Mitsuba 3: a rasterizer in Dr.Jit with a hand-written adjoint."""

from drgs import llvm
from drgs._plugin_path import map_sibling_plugins

__version__ = "0.1.0"

# Dr.Jit loads its libLLVM while it is being imported: this comes before anything that does.
llvm.select_newest_llvm()
llvm.check_llvm_variants()
map_sibling_plugins()

from drgs import registration  # noqa: E402  (the plugins' folder is mapped above)

registration.register_plugins()
