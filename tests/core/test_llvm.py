import os
import sys
import warnings
from glob import glob

import pytest

from drgs.core import llvm
from drgs.core.llvm import (
    LLVMVersionError,
    ensure_usable_llvm,
    installed_libraries,
    loaded_version,
    select_newest_llvm,
    version_from_name,
)


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """machine(*names): a Linux machine with these libraries, where Dr.Jit is not loaded yet."""
    # Set before it is deleted, so that what a test makes of it is undone even if it is not set.
    monkeypatch.setenv(llvm.PATH_VARIABLE, "")
    monkeypatch.delenv(llvm.PATH_VARIABLE)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(llvm, "_library_folders", lambda: [str(tmp_path)])

    def install(*names):
        for name in names:
            (tmp_path / name).touch()
        return tmp_path

    return install


def set_loaded_version(monkeypatch, *version):
    monkeypatch.setattr(llvm, "loaded_version", lambda: version or None)


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.so.1", (14,)),
        ("libLLVM-15.so", (15,)),
        ("libLLVM-14.0.6.so", (14, 0, 6)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM-18.so.18.1", (18,)),
        ("/opt/homebrew/Cellar/llvm/22.1.8/lib/libLLVM.dylib", (22, 1, 8)),
        ("/usr/lib/llvm-20/lib/libLLVM.so", (20,)),
        ("libLLVM.so", None),
        ("libLLVMSPIRVLib.so.19.1", None),
        ("libLLVM-C.so", None),
        ("libLLVM-14.a", None),
    ],
)
def test_the_version_is_read_from_the_file_name(path, version):
    assert version_from_name(path) == version


def test_unversioned_link_has_the_version_of_its_target(tmp_path):
    (tmp_path / "libLLVM.so.21.1").touch()
    (tmp_path / "libLLVM.so").symlink_to("libLLVM.so.21.1")
    assert version_from_name(tmp_path / "libLLVM.so") == (21, 1)


def test_libraries_are_listed_newest_first_without_dangling_links(machine):
    folder = machine("libLLVM-9.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM.so.100.1")
    (folder / "libLLVM.so.200.1").symlink_to("nowhere")
    assert [version for version, _ in installed_libraries()] == [(100, 1), (19, 1), (15,), (9,)]


def test_the_newest_library_is_selected_even_if_it_is_a_link(machine):
    folder = machine("libLLVM-15.so.1", "libLLVM.so.17.0", "target")
    (folder / "libLLVM.so.22.1").symlink_to("target")
    select_newest_llvm()
    assert os.environ[llvm.PATH_VARIABLE] == str(folder / "libLLVM.so.22.1")


def test_library_chosen_by_the_user_is_kept(machine, monkeypatch):
    machine("libLLVM.so.22.1")
    monkeypatch.setenv(llvm.PATH_VARIABLE, "/mine.so")
    select_newest_llvm()
    assert os.environ[llvm.PATH_VARIABLE] == "/mine.so"


def test_nothing_is_selected_without_a_usable_library(machine):
    machine("libLLVM-15.so.1", "libLLVM-16.so.1")
    select_newest_llvm()
    assert llvm.PATH_VARIABLE not in os.environ


def test_nothing_is_selected_once_drjit_has_loaded_one(machine, monkeypatch):
    machine("libLLVM.so.22.1")
    monkeypatch.setitem(sys.modules, "drjit", object())
    select_newest_llvm()
    assert llvm.PATH_VARIABLE not in os.environ


@pytest.mark.parametrize("version", [(19, 1, 7), (22, 1, 8)])
def test_tested_versions_pass_silently(machine, monkeypatch, version):
    set_loaded_version(monkeypatch, *version)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ensure_usable_llvm()


@pytest.mark.parametrize("major", [17, 18])
def test_17_and_18_warn_as_untested(machine, monkeypatch, major):
    set_loaded_version(monkeypatch, major, 0, 6)
    with pytest.warns(UserWarning) as record:
        ensure_usable_llvm()
    assert str(record[0].message) == (
        f"drgs: libLLVM {major}.0.6 is untested; 19 or newer is recommended: "
        "apt-get install libllvm19"
    )


@pytest.mark.parametrize("version", [(15, 0, 6), (16, 0, 6)])
def test_older_versions_are_refused_with_version_command_and_variable(
    machine, monkeypatch, version
):
    set_loaded_version(monkeypatch, *version)
    with pytest.raises(LLVMVersionError) as error:
        ensure_usable_llvm()
    assert str(error.value) == (
        f"drgs: libLLVM 17 or newer is needed (19 is tested), found {version[0]}.0.6. Install one "
        "with 'apt-get install libllvm19', or name its file in the environment variable "
        "DRJIT_LIBLLVM_PATH."
    )


def test_on_macos_the_command_is_brews(machine, monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    set_loaded_version(monkeypatch, 16, 0, 6)
    with pytest.raises(LLVMVersionError, match="Install one with 'brew install llvm', or name"):
        ensure_usable_llvm()


def test_the_refusal_names_a_usable_library_that_is_installed(machine, monkeypatch):
    folder = machine("libLLVM.so.19.1")
    set_loaded_version(monkeypatch, 15, 0, 6)
    with pytest.raises(LLVMVersionError) as error:
        ensure_usable_llvm()
    assert str(error.value).endswith(
        f"; here DRJIT_LIBLLVM_PATH={folder}/libLLVM.so.19.1 would do."
    )


@pytest.mark.parametrize(
    ("names", "variable", "found"),
    [
        ([], None, "none that Dr.Jit can load"),
        (["libLLVM-14.so.1"], None, "none that Dr.Jit can load"),
        ([], "/none.so", "none that Dr.Jit can load (DRJIT_LIBLLVM_PATH=/none.so)"),
    ],
)
def test_refusal_without_a_library_lists_the_installed_ones(
    machine, monkeypatch, names, variable, found
):
    folder = machine(*names)
    if variable:
        monkeypatch.setenv(llvm.PATH_VARIABLE, variable.format(folder=folder))
    set_loaded_version(monkeypatch)
    with pytest.raises(LLVMVersionError) as error:
        ensure_usable_llvm()
    assert f", found {found.format(folder=folder)}. Install one" in str(error.value)


def test_the_version_in_use_is_known():
    version = loaded_version()
    assert version is not None, "the test suite needs libLLVM: apt-get install libllvm19"
    assert version[0] >= llvm.MINIMUM_VERSION


def old_library(major):
    found = glob(f"/usr/lib/*-linux-gnu/libLLVM-{major}.so*")
    if not found:
        pytest.skip(f"libLLVM {major} is not installed")
    return found[0]


SET_VARIANT = """
import drgs, mitsuba as mi
try:
    mi.set_variant("llvm_ad_rgb")
except drgs.core.llvm.LLVMVersionError as error:
    print(error, mi.variant(), sep="\\n")
mi.set_variant("llvm_ad_rgb", "scalar_rgb")
print(mi.variant())
"""


@pytest.mark.slow
@pytest.mark.parametrize("major", [14, 15, 16])
def test_an_old_library_is_refused_when_an_llvm_variant_is_chosen(run_python, major):
    """14 is turned down by Dr.Jit itself, the others by drgs; neither ends the process."""
    result = run_python(SET_VARIANT, DRJIT_LIBLLVM_PATH=old_library(major))
    assert result.returncode == 0, result.stderr
    refusal, variant, fallback = result.stdout.splitlines()
    assert refusal.startswith("drgs: libLLVM 17 or newer is needed (19 is tested), found ")
    assert f"found {major}" in refusal or f"libLLVM-{major}" in refusal
    assert "apt-get install libllvm19" in refusal
    assert "DRJIT_LIBLLVM_PATH" in refusal
    assert (variant, fallback) == ("None", "scalar_rgb")


@pytest.mark.slow
def test_a_missing_library_is_refused_when_an_llvm_variant_is_chosen(run_python):
    result = run_python(SET_VARIANT, DRJIT_LIBLLVM_PATH="/nonexistent")
    assert result.returncode == 0, result.stderr
    assert "found none that Dr.Jit can load (DRJIT_LIBLLVM_PATH=/nonexistent)" in result.stdout


@pytest.mark.slow
def test_a_usable_library_passes(run_python):
    result = run_python('import drgs, mitsuba as mi; mi.set_variant("llvm_ad_rgb"); print("ok")')
    assert (result.returncode, result.stdout) == (0, "ok\n"), result.stderr
