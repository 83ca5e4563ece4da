import os
import platform
import sys
from glob import glob

import pytest

from drgs.core import llvm


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """machine(*names): a Linux machine with these libraries, where Dr.Jit is not loaded yet."""
    # Set before it is deleted, so that what a test makes of it is undone even if it is not set.
    monkeypatch.setenv(llvm.PATH_VARIABLE, "")
    monkeypatch.delenv(llvm.PATH_VARIABLE)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(llvm, "ENVIRONMENT_FOLDER", str(tmp_path / "environment"))
    folders = [str(tmp_path), llvm.ENVIRONMENT_FOLDER]
    monkeypatch.setattr(llvm, "_library_folders", lambda: folders)

    def install(*names):
        for name in names:
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).touch()
        return tmp_path

    return install


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.so.1", (14,)),
        ("libLLVM-14.0.6.so", (14, 0, 6)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM-18.so.18.1", (18,)),
        ("/opt/homebrew/Cellar/llvm/22.1.8/lib/libLLVM.dylib", (22, 1, 8)),
        ("/usr/lib/llvm-20/lib/libLLVM.so", (20,)),
        ("libLLVM.so", None),
        ("libLLVMSPIRVLib.so.19.1", None),
    ],
)
def test_the_version_is_read_from_the_file_name(path, version):
    assert llvm.version_from_name(path) == version


def test_unversioned_link_has_the_version_of_its_target(tmp_path):
    (tmp_path / "libLLVM.so.21.1").touch()
    (tmp_path / "libLLVM.so").symlink_to("libLLVM.so.21.1")
    assert llvm.version_from_name(tmp_path / "libLLVM.so") == (21, 1)


def test_the_newest_library_is_selected_even_if_it_is_a_link(machine):
    folder = machine("libLLVM-9.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1", "target")
    for name, target in (("libLLVM.so.100.1", "target"), ("libLLVM.so.200.1", "nowhere")):
        (folder / name).symlink_to(target)
    assert [version for version, _ in llvm.installed_libraries()] == [
        (100, 1),
        (19, 1),
        (15,),
        (9,),
    ]
    llvm.select_newest_llvm()
    assert os.environ[llvm.PATH_VARIABLE] == str(folder / "libLLVM.so.100.1")


def test_nothing_is_selected_where_the_choice_is_made(machine, monkeypatch):
    """No library is usable; the user has chosen one; Dr.Jit has loaded one."""
    machine("libLLVM-15.so.1", "libLLVM-16.so.1")
    llvm.select_newest_llvm()
    assert llvm.PATH_VARIABLE not in os.environ
    machine("libLLVM.so.22.1")
    with monkeypatch.context() as chosen:
        chosen.setenv(llvm.PATH_VARIABLE, "/mine.so")
        llvm.select_newest_llvm()
        assert os.environ[llvm.PATH_VARIABLE] == "/mine.so"
    monkeypatch.setitem(sys.modules, "drjit", object())
    llvm.select_newest_llvm()
    assert llvm.PATH_VARIABLE not in os.environ


@pytest.mark.parametrize("version", [(17, 0, 6), (22, 1, 8)])
def test_usable_versions_pass(machine, monkeypatch, version):
    monkeypatch.setattr(llvm, "loaded_version", lambda: version)
    llvm.ensure_usable_llvm()


NONE = "found none that Dr.Jit can load"
REFUSALS = [
    ((16, 0, 6), [], "", "found 16.0.6. Install one with pip install 'drgs[llvm]'"),
    ((16, 0, 6), [], "", "install llvm, or name its file in the environment variable DRJIT_"),
    ((15, 0, 6), ["libLLVM.so.19.1"], "", "; here DRJIT_LIBLLVM_PATH={}/libLLVM.so.19.1 would do,"),
    ((15, 0, 6), ["libLLVM.so.19.1"], "", " or 'import drgs' before drjit and mitsuba."),
    (None, [], "", f"{NONE}. Install one"),
    (None, ["libLLVM-14.so.1"], "", f"{NONE}. Install one"),
    (None, [], "/none.so", f"{NONE} (DRJIT_LIBLLVM_PATH=/none.so). Install one"),
]


@pytest.mark.parametrize(("version", "names", "variable", "message"), REFUSALS)
def test_unusable_libraries_are_refused(machine, monkeypatch, version, names, variable, message):
    folder = machine(*names)
    monkeypatch.setenv(llvm.PATH_VARIABLE, variable)
    monkeypatch.setattr(llvm, "loaded_version", lambda: version)
    with pytest.raises(llvm.LLVMVersionError) as error:
        llvm.ensure_usable_llvm()
    assert str(error.value).startswith("drgs: libLLVM 17 or newer is needed, found ")
    assert message.format(folder) in str(error.value)


def test_the_file_in_use_is_known():
    assert llvm.version_from_name(llvm.library_file())[0] == llvm.loaded_version()[0]


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
@pytest.mark.parametrize("major", [14, 15, 16, None])
def test_an_old_library_is_refused_when_an_llvm_variant_is_chosen(run_python, major):
    """14 is turned down by Dr.Jit itself, the others by drgs; neither ends the process."""
    found = glob(f"/usr/lib/*-linux-gnu/libLLVM-{major}.so*") if major else ["/nonexistent"]
    if not found:
        pytest.skip(f"libLLVM {major} is not installed")
    result = run_python(SET_VARIANT, DRJIT_LIBLLVM_PATH=found[0])
    assert result.returncode == 0, result.stderr
    refusal, variant, fallback = result.stdout.splitlines()
    assert refusal.startswith("drgs: libLLVM 17 or newer is needed, found ")
    assert f"found {major}" in refusal or found[0] in refusal
    assert (variant, fallback) == ("None", "scalar_rgb")
