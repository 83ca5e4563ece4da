"""Who has which rows, who renders which views, and who is who."""

import numpy as np
import pytest

from drgs.core.processes import LAUNCHERS, process_count, process_number
from drgs.training.parallel import population
from drgs.training.steps import view_of


@pytest.mark.parametrize(("total", "size"), [(10, 3), (7, 7), (100_000, 4), (5, 1)])
def test_every_row_has_one_owner_and_shards_are_of_equal_size(total, size):
    shards = [population.Shard(total, rank, size) for rank in range(size)]
    rows = np.arange(total)
    owned = np.concatenate([rows[shard.local] for shard in shards])
    np.testing.assert_array_equal(owned, rows)
    lengths = [len(rows[shard.local]) for shard in shards]
    assert max(lengths) - min(lengths) <= 1
    for shard in shards:
        assert (shard.owners(rows)[shard.local] == shard.rank).all()


@pytest.mark.parametrize(("count", "views_per_step", "size"), [(10, 4, 3), (3, 4, 2), (25, 6, 6)])
def test_process_reads_only_the_photographs_it_uses(count, views_per_step, size):
    seen = [set() for _ in range(size)]
    for iteration in range(1, 40 * views_per_step + 1):
        place = (iteration - 1) % views_per_step
        rank = place * size // views_per_step
        seen[rank].add(view_of(iteration, count, 5, views_per_step))
    expected = [population.own_views(count, views_per_step, rank, size) for rank in range(size)]
    assert seen == expected


def test_rank_is_read_from_launcher_variables(monkeypatch):
    for name in (name for names in LAUNCHERS for name in names):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "4")  # of a batch script, which is no process of MPI
    assert (process_number(), process_count()) == (None, None)
    monkeypatch.setenv("PMIX_RANK", "2")
    assert (process_number(), process_count()) == (2, 4)
    monkeypatch.setenv("OMPI_COMM_WORLD_RANK", "3")
    assert (process_number(), process_count()) == (3, None)
    monkeypatch.setenv("OMPI_COMM_WORLD_RANK", "none")
    assert process_number() == 2


@pytest.mark.slow
def test_single_process_does_not_import_the_parallel_package(run_python, tmp_path):
    code = (
        "import sys; sys.modules['mpi4py'] = None\n"
        "from drgs.fit import __main__ as fit\n"
        "from drgs.training.trainer import Trainer\n"
        "print([m for m in sys.modules if m.startswith(('mpi4py.', 'drgs.training.parallel.ex'))])"
    )
    assert run_python(code).stdout.strip() == "[]"


@pytest.mark.slow
def test_launcher_of_another_mpi_is_refused(run_python):
    """Each of its processes would fit alone, into the same folder."""
    pytest.importorskip("mpi4py", reason="the extra mpi is not installed")
    code = "from drgs.fit.__main__ import main; main(['scenes/lego_mini.yml'])"
    launcher = {"OMPI_COMM_WORLD_RANK": "0", "OMPI_COMM_WORLD_SIZE": "2"}
    result = run_python(code, **launcher)
    assert result.returncode == 2
    assert "has started 2 processes, but MPI knows of 1; use the mpiexec of" in result.stderr
