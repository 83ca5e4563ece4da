"""Alternatives and effects that a scene does not use cost nothing in its kernels."""

import json
from pathlib import Path

import pytest
from conftest import REPOSITORY

UNUSED = [
    f"drgs.{folder}.{path.stem}"
    for folder in ("accuracy", "effects", "light")
    for path in sorted((REPOSITORY / "drgs" / folder).glob("*.py"))
    if path.stem not in ("__init__", "pipeline", "compose", "base")
]
"""Modules of alternatives and effects; the others compose them."""

PROGRAM = """
import json, sys
sys.path.insert(0, {tests!r})
sys.modules.update(dict.fromkeys({blocked!r}))  # importing one raises ImportError
from support.kernels import kernels_of_a_frame
from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
print(json.dumps(kernels_of_a_frame(pipeline_of(Approximations(**{approximations!r}), 2))))
"""


def kernels_without(run_python, blocked, **approximations):
    tests = str(Path(__file__).parents[1])
    program = PROGRAM.format(tests=tests, blocked=blocked, approximations=approximations)
    return run_python(program)


@pytest.mark.slow
def test_kernels_are_the_same_where_what_they_do_not_use_cannot_be_imported(run_python):
    """Hashes and operation counts of the image, the adjoint and the tangent."""
    assert len(UNUSED) >= 15
    results = [kernels_without(run_python, blocked) for blocked in ([], UNUSED)]
    assert [r.returncode for r in results] == [0, 0], results[1].stderr
    whole, reduced = (json.loads(r.stdout) for r in results)
    assert whole == reduced and all(len(kernels) >= 3 for kernels in whole.values())


@pytest.mark.slow
def test_an_approximation_that_is_chosen_needs_its_module(run_python):
    result = kernels_without(run_python, UNUSED, projection="exact")
    assert result.returncode != 0 and "projection must be one of ewa (" in result.stderr
