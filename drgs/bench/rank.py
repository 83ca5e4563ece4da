"""A process whose steps ``python -m drgs.bench processes`` times, alone or as one of several.

    python -m drgs.bench.rank FIT_DIR VIEWS STEPS THREADS
    mpiexec -n K python -m drgs.bench.rank FIT_DIR VIEWS STEPS THREADS

The first process prints what it has found as JSON.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.changes import changed
from drgs.core.denormals import denormals_flushed
from drgs.core.processes import ending_together, process_number
from drgs.datasets import load_dataset
from drgs.gaussians.parameters import Gaussians
from drgs.results.files import GAUSSIANS
from drgs.results.folder import load_run_config
from drgs.training.trainer import Trainer


@ending_together()
def main() -> None:
    """Time steps of a fit that has ended; its population stays, and all harmonics are in use."""
    folder, views, steps, threads = Path(sys.argv[1]), *map(int, sys.argv[2:5])
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(threads)
    config = load_run_config(folder)
    never = 1_000_000
    config = changed(
        config,
        {
            "iterations": never,
            "coarse": [],
            "densify.start": never,
            "densify.stop": never + 1,
            "densify.prune.to": None,
            "model.sh_increase_every": 1,
            "optimizer.views_per_step": views,
        },
    )
    dataset, gaussians = load_dataset(config.data), Gaussians.load(folder / GAUSSIANS)
    ranks = None
    with denormals_flushed():
        if process_number() is None:
            trainer = Trainer(config, dataset, gaussians)
        else:
            from drgs.training.parallel.ranks import Ranks, Times
            from drgs.training.parallel.trainer import DistributedTrainer

            ranks = Ranks.world()
            trainer = DistributedTrainer(config, dataset, gaussians, ranks)
        for _ in range(len(dataset.train) // views + 2):  # makes the targets of all views
            report = trainer.step()
        _ = report.loss
        if ranks is not None:
            ranks.told(np.zeros(1))
            ranks.times = Times()
        start = time.perf_counter()
        for _ in range(steps):
            report = trainer.step()
        _ = report.loss
        dr.sync_thread()
        seconds = time.perf_counter() - start
    found = {"ms": 1e3 * seconds / steps, "waiting": 0.0, "exchanging": 0.0, "sent_bytes": 0.0}
    if ranks is not None:
        for name in ("waiting", "exchanging"):
            found[name] = 1e3 * getattr(ranks.times, name) / steps
        found["sent_bytes"] = ranks.times.sent_bytes / steps
    if ranks is None or ranks.is_first:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
