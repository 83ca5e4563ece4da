"""Available memory, from the kernel's files; requests that exceed it are refused."""

import errno
from types import SimpleNamespace

import drjit as dr
import psutil
import pytest

from drgs.core import memory
from drgs.core.errors import UserError

GB = 10**9


def write(folder, **files):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)


def limit_process(monkeypatch, limit):
    """Give this process, of one GB, a limit of its size."""
    size = SimpleNamespace(vms=GB)
    process = SimpleNamespace(rlimit=lambda _: (limit, limit), memory_info=lambda: size)
    monkeypatch.setattr(memory.psutil, "Process", lambda: process)


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """A folder with the kernel's files: of a machine with 8 GB to give, and no other limit."""
    monkeypatch.setattr(memory, "_PROC", tmp_path / "proc")
    monkeypatch.setattr(memory, "_CGROUPS", tmp_path / "cgroup")
    machine = SimpleNamespace(available=8_000_000 * 1024)
    monkeypatch.setattr(memory.psutil, "virtual_memory", lambda: machine)
    limit_process(monkeypatch, psutil.RLIM_INFINITY)
    write(tmp_path / "proc" / "self", cgroup="")
    return tmp_path


@pytest.mark.parametrize("path", ["/a/b", "/"])
def test_a_control_group_limits_it(kernel, path):
    """Its parents' limits hold as well; what is kept of files makes room."""
    write(kernel / "proc" / "self", cgroup=f"0::{path}\n")
    group = kernel / "cgroup" / path.strip("/")
    write(group, memory__max="max\n", memory__current=f"{GB}\n", memory__stat="anon 7\n")
    assert memory.available_memory() == 8_000_000 * 1024
    parent = kernel / "cgroup"
    stat = f"anon 7\ninactive_file {GB // 2}\n"
    write(parent, memory__max=f"{4 * GB}\n", memory__current=f"{GB}\n", memory__stat=stat)
    assert memory.available_memory() == 3.5 * GB
    write(group, memory__max=f"{GB}\n", memory__current=f"{2 * GB}\n", memory__stat="anon 7\n")
    assert memory.available_memory() == 0


@pytest.mark.parametrize(
    ("error", "is_exhausted"),
    [
        (MemoryError(), True),
        (RuntimeError("jit_malloc(): out of memory! Could not allocate 9 bytes"), True),
        (ImportError("libtiff.so: failed to map segment from shared object"), True),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), True),
        (OSError(errno.ENOENT, "No such file"), False),
        (RuntimeError("no memory of it"), False),
    ],
)
def test_out_of_memory_is_distinguished_from_other_errors(kernel, error, is_exhausted):
    reason = memory.out_of_memory_reason(error)
    assert (reason is not None) == is_exhausted
    assert not is_exhausted or "8.19 GB are available; close other programs" in reason


def test_memory_request_beyond_available_memory_is_refused(kernel):
    memory.require_memory("a.ply", 8_000_000 * 1024, "a scene")
    message = (
        r"^a\.ply: a scene takes about 8\.19 GB of memory, of which 8\.19 GB are available; cl"
    )
    with pytest.raises(UserError, match=message):
        memory.require_memory("a.ply", 8_000_000 * 1024 + 1, "a scene")


@pytest.mark.skipif(not hasattr(psutil, "RLIMIT_AS"), reason="psutil knows it on Linux only")
def test_process_memory_limit_counts(kernel, monkeypatch):
    limit_process(monkeypatch, 3 * GB)
    assert memory.available_memory() == 2 * GB


def test_byte_counts_are_written_with_three_digits():
    counts = (24.06e9, 999.9e6, 5e12, 123_456)
    texts = [memory.format_bytes(count) for count in counts]
    assert texts == ["24.1 GB", "1 GB", "5,000 GB", "123 kB"]


def test_images_are_limited_by_memory_and_by_drjits_arrays(monkeypatch):
    """``test_image_limits.py`` checks the messages."""
    monkeypatch.setattr(memory, "available_memory", lambda: 8 * GB)
    assert memory.too_large_reason(4000, 5000) is None
    assert "need about" in memory.too_large_reason(20_000, 20_000)
    assert "with 1,000 samples each need about" in memory.too_large_reason(400, 400, samples=1000)
    monkeypatch.setattr(memory, "available_memory", lambda: 10**15)
    assert memory.too_large_reason(2**15, 2**15 - 1) is None
    for size in ((2**15, 2**15), (400, 400, 3, 10**9), (2000, 2000, 2000)):
        assert "too many for Dr.Jit" in memory.too_large_reason(*size)


def test_drjit_malloc_cache_counts_as_available(monkeypatch):
    rooms = [10**9]
    monkeypatch.setattr(memory, "available_memory", lambda: rooms[-1])
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: rooms.append(8 * GB))
    for _ in range(2):
        assert memory.too_large_reason(3000, 3000) is None
        assert len(rooms) == 2
