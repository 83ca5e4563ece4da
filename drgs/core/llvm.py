"""Choice of the libLLVM that Dr.Jit compiles with, and refusal of versions that crash.

LLVM 14 to 16 end the process on a kernel with ``dr.minimum``, ``dr.maximum`` or ``dr.clip``
("Cannot select: fminimum"), so the version is checked before any kernel exists.

Dr.Jit 1.5, when imported, takes the first of: a libLLVM that the process has loaded; the file that
``DRJIT_LIBLLVM_PATH`` names; ``libLLVM.so`` on the loader's path; on Linux, the last of
``/usr/lib/{x86_64-linux-gnu,aarch64-linux-gnu,wsl/lib}/libLLVM*.so.*`` in numeric order, links only
if there is nothing else. A newer library that is a link (LLVM's own packages), or in another folder
(Fedora), therefore loses against an old one.
"""

from __future__ import annotations

import os
import platform
import re
import sys
from contextlib import suppress
from glob import glob
from pathlib import Path

MINIMUM_VERSION = 17  # first major version that compiles every kernel

HOW_TO_INSTALL = (
    "Install one with pip install 'drgs[llvm]' (x86-64 Linux), apt-get install libllvm19 or brew "
    "install llvm"
)

ENVIRONMENT_FOLDER = os.path.join(sys.prefix, "lib")  # of libraries that pip and conda install

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"

Version = tuple[int, ...]


class LLVMVersionError(ImportError, RuntimeError):
    """There is no libLLVM that drgs can run with.

    An ImportError, so that ``mi.set_variant("llvm_ad_rgb", "scalar_rgb")`` tries its next choice.
    """


def select_newest_llvm() -> None:
    """Set ``DRJIT_LIBLLVM_PATH`` to the newest libLLVM, for this process and its children.

    Without effect if the variable is set, Dr.Jit is imported, or no usable library is found.
    """
    if os.environ.get(PATH_VARIABLE) or "drjit" in sys.modules:
        return
    for version, path in installed_libraries():
        if version[0] >= MINIMUM_VERSION:
            os.environ[PATH_VARIABLE] = path
            return


def ensure_usable_llvm() -> None:
    """Raise :class:`LLVMVersionError` unless Dr.Jit's libLLVM is recent enough."""
    version = loaded_version()
    if version is None or version[0] < MINIMUM_VERSION:
        raise LLVMVersionError(_refusal(version))


def check_llvm_variants() -> None:
    """Install an import hook that runs :func:`ensure_usable_llvm` for ``mitsuba.llvm_*``.

    Callbacks of ``mi.set_variant`` come too late: it fails before, with a misleading message.
    """
    if not any(isinstance(finder, _VariantCheck) for finder in sys.meta_path):
        sys.meta_path.insert(0, _VariantCheck())


def loaded_version() -> Version | None:
    """Return the version of the libLLVM in use, such as (19, 1, 7); None if Dr.Jit has none."""
    from drgs.core.private import llvm_version

    version = llvm_version()
    return version if version[0] >= 0 else None


def installed_libraries() -> list[tuple[Version, str]]:
    """Return (version, path) of every libLLVM in the usual places, the newest first.

    Versions come from file names: loading is slow, and two libLLVM in one process conflict.
    """
    names = {n for folder in _library_folders() for n in glob(os.path.join(folder, "libLLVM*"))}
    files = filter(os.path.isfile, names)
    libraries = [(version, name) for name in files if (version := version_from_name(name))]
    return sorted(libraries, key=lambda item: (item[0], len(item[1])), reverse=True)


def library_file() -> str | None:
    """Return the file of the libLLVM in use; None if it is unknown."""
    import psutil

    with suppress(AttributeError, psutil.Error):  # macOS has no list of mapped files
        for mapped in psutil.Process().memory_maps():
            if version_from_name(mapped.path) is not None:
                return mapped.path
    return os.environ.get(PATH_VARIABLE)


def version_from_name(path: str | Path) -> Version | None:
    """Return the version of a libLLVM from its file name, or from its folder if the name has none.

    ``libLLVM-14.so.1`` is (14,), ``libLLVM.so.19.1`` (19, 1), ``llvm/22.1.8/lib/libLLVM.dylib``
    (22, 1, 8). None for any other file (``libLLVMSPIRVLib.so.19``, ``libLLVM-14.a``).
    """
    path = str(path)
    name = os.path.basename(path)
    if not re.fullmatch(r"libLLVM(-[\d.]+)?\.(so(\.[\d.]+)?|dylib)", name):
        return None
    for pattern, text in (
        (r"libLLVM-([\d.]+)\.(so|dylib)", name),
        (r"libLLVM\.so\.(\d[\d.]*)", os.path.basename(os.path.realpath(path))),
        (r"libLLVM\.so\.(\d[\d.]*)", name),
        (r"/llvm[-@/](\d[\d.]*)", path),
    ):
        if match := re.search(pattern, text):
            return tuple(int(part) for part in match.group(1).strip(".").split("."))
    return None


class _VariantCheck:
    """An import hook that finds nothing and checks before ``mitsuba.llvm_*`` is loaded."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name.startswith("mitsuba.llvm_"):
            ensure_usable_llvm()


def _library_folders() -> list[str]:
    return [
        *filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)),
        ENVIRONMENT_FOLDER,
        f"/usr/lib/{platform.machine()}-linux-gnu",
        "/usr/lib64",
        "/usr/local/lib",
        *glob("/usr/lib/llvm-*/lib"),
        *glob("/usr/lib64/llvm*/lib*"),
        *glob("/opt/homebrew/Cellar/llvm*/*/lib"),
        *glob("/usr/local/Cellar/llvm*/*/lib"),
    ]


def _refusal(version: Version | None) -> str:
    loaded = "none that Dr.Jit can load" if version is None else format_version(version)
    if version is None and (named := os.environ.get(PATH_VARIABLE)):
        loaded += f" ({PATH_VARIABLE}={named})"
    message = (
        f"drgs: libLLVM {MINIMUM_VERSION} or newer is needed, found {loaded}. {HOW_TO_INSTALL}, or "
        f"name its file in the environment variable {PATH_VARIABLE}"
    )
    usable = [path for version, path in installed_libraries() if version[0] >= MINIMUM_VERSION]
    if usable:
        message += f"; here {PATH_VARIABLE}={usable[0]} would do"
        message += ", or 'import drgs' before drjit and mitsuba"
    return message + "."


def format_version(version: Version) -> str:
    """Return a version as text, such as ``19.1.7``."""
    return ".".join(str(part) for part in version)
