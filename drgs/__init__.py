"""3D Gaussian splatting inside Mitsuba 3: a rasterizer in Dr.Jit with a hand-written adjoint."""

from drgs import _registration
from drgs.core import llvm

__version__ = "0.1.0"

# Dr.Jit loads its libLLVM while it is being imported: this comes before anything that does.
llvm.select_newest_llvm()
llvm.check_llvm_variants()
_registration.map_sibling_plugins()
_registration.register_plugins()
