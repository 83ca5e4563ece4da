"""Fixtures for more than one test file."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)

pytest.register_assert_rewrite("support")

REPOSITORY = Path(__file__).resolve().parent.parent
TESTS = str(REPOSITORY / "tests")
"""Where programs of the tests find ``support``."""

SHARED_DATA = REPOSITORY.parent / "shared" / "data"


def pytest_configure(config):
    """Dr.Jit computes on one thread in each worker: they share the cores, and idle threads spin."""
    if hasattr(config, "workerinput"):
        import drjit as dr

        dr.set_thread_count(1)


def _shared(*parts):
    folder = SHARED_DATA.joinpath(*parts)
    if not folder.is_dir():
        pytest.skip(f"the shared data folder {'/'.join(parts)} is not here")
    return folder


@pytest.fixture
def lego_folder():
    return _shared("nerf_synthetic", "lego")


@pytest.fixture
def fox_folder():
    return _shared("fox")


@pytest.fixture
def run_python():
    """Runs a program in a fresh interpreter: run(code, cwd=checkout, **environment variables)."""

    def run(code, cwd=REPOSITORY, **variables):
        clean = {
            k: v for k, v in os.environ.items() if k not in ("DRJIT_LIBLLVM_PATH", "PYTHONPATH")
        }
        return subprocess.run(
            [sys.executable, "-c", code],
            cwd=cwd,
            env={**clean, **variables},
            capture_output=True,
            text=True,
            timeout=120,
        )

    return run
