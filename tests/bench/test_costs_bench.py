"""What kernels cost: their machine code, the bytes that they move, and their blocks.

The kernels here are so small that what they load and store is known by construction.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from drjit.llvm.ad import Array4f, Float, UInt32

from drgs.bench import amdahl, blocks, costs, machine_code, pairs, profile, scenes, speed, traffic
from drgs.bench.limits import vector_width
from drgs.splatting import reduction

LANES = 1000


def launches_of(computation):
    """The compiled kernels of a computation that leaves nothing to evaluate."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.sync_thread()
        dr.kernel_history_clear()
        computation()
        dr.sync_thread()
        return [launch for launch in profile._launches(dr.kernel_history()) if launch.ir]


def evaluated(*arrays):
    dr.eval(arrays)
    return arrays


def loop_over_state(count, table):
    """A loop that adds one gathered number to ``count`` state variables."""
    first = dr.arange(UInt32, LANES)
    number = dr.opaque(UInt32, 5)

    def body(step, values):
        found = dr.gather(Float, table, (first + step) % LANES)
        return step + 1, [dr.fma(v, v, found) for v in values]

    _, values = dr.while_loop(
        state=(dr.zeros(UInt32, LANES), [Float(first) + k for k in range(count)]),
        cond=lambda step, values: step < number + (first & 1),
        body=body,
    )
    dr.eval(values)


@pytest.fixture
def table():
    return evaluated(dr.arange(Float, LANES) + 0.5)[0]


@pytest.fixture
def code():
    """Skips where there is none."""
    try:
        machine_code._library()
    except machine_code.MachineCodeError as error:
        pytest.skip(str(error))
    return machine_code


# ----------------------------------------------------------------------------------------------
# Machine code
# ----------------------------------------------------------------------------------------------

LOOP = """
kernel:
\tmovq\t%rsp, %rbp
\tvmovups\t(%rdi), %zmm0
.LBB0_1:                                # outer
\tvmovups\t64(%rsp), %zmm1                # 64-byte Reload
.LBB0_2:
\tvaddps\t(%rax,%rcx,4), %zmm1, %zmm1
\tvfmadd213ps\t.LCPI0_0(%rip){1to16}, %zmm2, %zmm1
\ttestb\t$1, (%rdx)
\tjne\t.LBB0_4
\tvmovaps\t%zmm1, -128(%rbp)
\tincq\t8(%rsp)
\tjmp\t.LBB0_5
.LBB0_4:
\tvscatterdps\t%zmm1, (%rax,%zmm3,4) {%k1}
\tleaq\t4(%rax), %rax
.LBB0_5:
\tcmpq\t%rcx, (%rsi)
\tjb\t.LBB0_2
\tdecq\t%r8
\tjne\t.LBB0_1
\tretq
"""


def test_operations_of_the_innermost_loop_are_counted():
    body = machine_code.innermost_loop(LOOP)
    assert [line.split()[0] for line in body][:2] == ["vaddps", "vfmadd213ps"]
    assert machine_code.count_operations(body, LOOP) == machine_code.Operations(
        instructions=11,
        vectors=4,  # of which one spills and one scatters
        loads=3,  # vaddps, testb, cmpq
        stores=1,  # vscatterdps
        stack_loads=1,  # incq
        stack_stores=2,  # vmovaps, incq
        constants=1,
    )


def test_code_without_a_loop_is_refused():
    with pytest.raises(machine_code.MachineCodeError, match="no loop"):
        machine_code.innermost_loop("kernel:\n\tvzeroupper\n\tretq\n")


def test_state_that_has_no_register_is_on_the_stack(code, table):
    """Each iteration loads and stores what does not fit, and nothing if all fits."""
    found = {}
    for count in (4, 80):
        kernel = launches_of(lambda count=count: loop_over_state(count, table))[-1]
        text = code.assembly(kernel.ir)
        found[count] = code.count_operations(code.innermost_loop(text), text)
    assert found[4].stack_stores == 0 and found[4].stores == 0
    registers = 32 if vector_width() == 16 else 16
    assert 80 - registers <= found[80].stack_stores <= 80
    assert 80 - registers <= found[80].stack_loads <= 2 * 80  # a value that is squared, and more
    assert found[80].stores == 0
    assert found[80].loads == found[4].loads > 0  # the gather
    multiply_adds = found[80].vectors - found[4].vectors
    assert multiply_adds >= 80 - 4


PROGRAM = """
import drgs, drjit as dr
from drjit.llvm.ad import Float
dr.set_flag(dr.JitFlag.KernelHistory, True)
x = dr.arange(Float, 1000) + dr.opaque(Float, 3)
dr.set_log_level(dr.LogLevel.Trace)
dr.eval(dr.sin(x * 1.25) * dr.exp(x) + dr.gather(Float, dr.arange(Float, 1000), dr.arange(
    dr.llvm.ad.UInt32, 1000) // 2))
dr.set_log_level(dr.LogLevel.Disable)
from drgs.bench import machine_code, profile
ir = [launch for launch in profile._launches(dr.kernel_history()) if launch.ir][-1].ir
print("ASSEMBLY")
print(machine_code.assembly(ir), flush=True)
"""


def test_the_machine_code_is_what_dr_jit_runs(code, tmp_path):
    """By Dr.Jit's own disassembly, in a process whose cache has no kernels.

    The names of vector instructions agree in their order; of others, AT&T's syntax has suffixes.
    """
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "HOME": str(tmp_path)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    log = result.stdout + result.stderr
    run = re.findall(r"jit_llvm_disasm\(\): 0x\w+\s+(\w+)", log)
    run = run[: run.index("ret") + 1] if run.count("ret") == 1 else run
    text = result.stdout.partition("ASSEMBLY")[2].partition("jit_llvm_disasm")[0]
    ours = [line.split()[0] for line in code.instructions(text)]
    without_padding = [name for name in run if not name.startswith("nop")]
    assert len(ours) == len(without_padding) > 40
    vectors = [name for name in ours if name.startswith("v")]
    assert vectors == [name for name in run if name.startswith("v")] and len(vectors) > 30


# ----------------------------------------------------------------------------------------------
# Bytes
# ----------------------------------------------------------------------------------------------


def test_bytes_are_those_of_arrays_read_and_written(table):
    """4 B a number: two arrays read in order, one gathered in packets of 4, one written."""
    a, b = evaluated(dr.arange(Float, LANES), dr.arange(Float, LANES) * 3)
    rows = evaluated(dr.arange(Float, 4 * LANES))[0]
    index = evaluated(dr.arange(UInt32, LANES))[0]

    def compute():
        packet = dr.gather(Array4f, rows, index)
        dr.eval(a * b + sum(packet))

    (kernel,) = launches_of(compute)
    read, written = 4 * LANES * (2 + 1 + 4), 4 * LANES
    assert traffic.bytes_of(kernel) == read + written


def test_bytes_of_a_loop_count_for_each_trip(table):
    (kernel,) = launches_of(lambda: loop_over_state(3, table))
    with traffic.counted_trips() as counted:
        loop_over_state(3, table)
    (trips,) = counted.take()
    np.testing.assert_array_equal(trips, 5 + np.arange(LANES) % 2)
    assert traffic.bytes_of(kernel, [trips]) == 4 * int(trips.sum()) + 3 * 4 * LANES
    assert counted.take() == []


# ----------------------------------------------------------------------------------------------
# Blocks
# ----------------------------------------------------------------------------------------------

SIZES = (5, 40, 3000, 40_000, 100_000, 262_144, 1_200_000)

SUBMITTED = """
import sys, drgs, drjit as dr
from drjit.llvm.ad import UInt32
dr.set_thread_count(8)
for size in %r:
    values = dr.arange(UInt32, size)
    print("JIT", size, flush=True)
    dr.eval(values)
    print("BlockReduce", size, flush=True)
    dr.sum(values)
    keys = values & 255
    dr.eval(keys)
    dr.sync_thread()
    print("MkPerm", size, flush=True)
    dr.detail.block_mkperm(keys, size, 256)
    dr.sync_thread()
    print("end", size, flush=True)
"""

DEBUGGER = """
set pagination off
set breakpoint pending on
set print thread-events off
break task_submit_dep
commands
silent
printf "SUBMIT %d\\n", $ecx
continue
end
run
"""


def test_blocks_are_those_that_dr_jit_submits(tmp_path):
    """A debugger prints the number of blocks of each task, the fourth argument of its function."""
    if shutil.which("gdb") is None or platform.machine() != "x86_64":
        pytest.skip("there is no gdb, or its register has another name")
    (tmp_path / "commands").write_text(DEBUGGER)
    command = ["gdb", "-q", "-batch", "-x", str(tmp_path / "commands"), "--args"]
    program = [sys.executable, "-c", SUBMITTED % (SIZES,)]
    result = subprocess.run([*command, *program], capture_output=True, text=True, timeout=300)
    if "SUBMIT" not in result.stdout:
        pytest.skip(f"gdb cannot run a program here: {result.stderr[-200:]}")
    found, current = {}, []
    for kind, number in re.findall(
        r"^(SUBMIT|JIT|BlockReduce|MkPerm|end) (\d+)$", result.stdout, re.M
    ):
        if kind == "SUBMIT":
            current.append(int(number))
        else:
            current = found.setdefault((kind, int(number)), [])
    pool = blocks.Pool(8, vector_width())
    for size in SIZES:
        assert found["JIT", size][0] == blocks.blocks_of_lanes(size, pool)[0], size
        assert found["BlockReduce", size][0] == blocks.blocks_of_sum(size, pool), size
        sort = blocks.blocks_of_sort(size, pool)
        assert found["MkPerm", size] == [sort, 1, sort], size


@pytest.mark.parametrize("threads", [1, 2, 8, 64])
def test_blocks_cover_all_lanes(threads):
    pool = blocks.Pool(threads, 16, 16_384)
    for size in SIZES:
        count, lanes = blocks.blocks_of_lanes(size, pool)
        assert count * lanes >= size and lanes % 16 == 0
        assert lanes <= pool.block or threads == 1
        launch = profile.Launch("JIT", size, 1.0, "")
        # Blocks beyond the last lane have no cost.
        costs = blocks.costs_of_blocks(launch, pool)
        assert len(costs) == -(-size // lanes) and costs.sum() == -(-size // 16)


def test_vectors_wait_for_their_longest_lane():
    trips = np.array([1, 2, 3, 4, 5, 6, 7, 8, 9, 10])
    assert blocks.vector_trips(trips, 4) == 4 + 8 + 10
    pool = blocks.Pool(2, 4, 4)
    launch = profile.Launch("JIT", 10, 1.0, "")
    np.testing.assert_array_equal(blocks.costs_of_blocks(launch, pool, [trips]), [5, 9, 11])


def test_the_busiest_core_has_the_block_that_it_takes_last():
    assert blocks.busiest_share(np.ones(6), 4) == 2 / 6
    assert blocks.busiest_share(np.array([4.0, 1, 1, 1, 1]), 2) == 4 / 8
    assert blocks.busiest_share(np.ones(1), 64) == 1


def test_the_bound_is_amdahls():
    """Half of the time in a kernel of many blocks: S(P) = 1 / (1/2 + 1/2P)."""
    kernel = amdahl.KernelBlocks("binning", "JIT", 1, 10.0, {}, {c: 1 / c for c in amdahl.CORES})
    found = amdahl.Speedups([kernel], host_ms=10.0)
    for cores in amdahl.CORES:
        assert found.bound(None, cores) == pytest.approx(1 / (0.5 + 0.5 / cores))
        assert found.bound("binning", cores) == pytest.approx(cores)


# ----------------------------------------------------------------------------------------------
# A training iteration
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("band_slots", [1 << 20, 1000])
def test_every_stage_has_kernels_and_bytes_and_its_loops_have_pairs(code, band_slots, monkeypatch):
    """Also where the adjoint and its sums go from band to band."""
    mi.set_variant("llvm_ad_rgb")
    monkeypatch.setattr(reduction, "BAND_SLOTS", band_slots)
    scene = scenes.Scene("small", scenes.bench_gaussians(500), scenes.bench_camera(48))
    launches = profile.counted_launches(
        lambda: partial(speed.clocked_step, speed.warm_trainer(scene))
    )
    found = costs.stage_costs(launches)
    assert set(found) == set(profile.STAGES)
    parameters = 4 * 59 * 500  # all are read by projection, and written by the optimizer
    assert all(cost.kernels > 0 and cost.bytes > 0 for cost in found.values())
    assert found["projection and SH"].bytes > parameters
    assert found["optimizer and statistics"].bytes > 6 * parameters  # read and write, and moments
    work = pairs.count_work(scenes.frame_of(scene))
    for stage in speed.INSTRUCTIONS:
        loop = costs.loop_cost(launches[stage], vector_width())
        assert loop.vectors > speed.INSTRUCTIONS[stage]
        # Trained a little, the scene has not quite the pairs that it began with.
        assert 16 * loop.steps * vector_width() > 0.9 * work.evaluated
