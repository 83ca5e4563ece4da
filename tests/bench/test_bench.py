"""The measurements run, write what they say and nothing else, and measure what they say."""

import argparse
import importlib

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from drgs.bench import speed
from drgs.bench.__main__ import COMMANDS
from drgs.bench.output import add_out
from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.cli.commands import CommandParser
from drgs.core.errors import UserError


def test_renderers_do_not_reuse_a_frame():
    mi.set_variant("llvm_ad_rgb")
    problem = speed.Problem("small", bench_gaussians(500), bench_camera(48), np.ones((48, 48, 3)))
    renderer = speed.drgs_renderer(problem)
    renderer.forward()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        renderer.forward()
        first = len(dr.kernel_history())
        renderer.forward()
        assert len(dr.kernel_history()) == first >= 10


def test_a_measurement_is_replaced_by_the_next_unless_it_was_edited(tmp_path):
    path, text = tmp_path / "it.csv", ""
    parser = argparse.ArgumentParser()
    add_out(parser, lambda args: path.write_text(text), "it.csv")
    args = parser.parse_args(["--out", str(tmp_path)])
    for text in ("first", "second"):  # noqa: B007  (the measurement writes it)
        args.run(args)
    assert path.read_text() == "second"
    path.write_text("edited")
    with pytest.raises(UserError, match=r"holds it\.csv"):
        args.run(args)
    assert path.read_text() == "edited"


@pytest.mark.parametrize("name", COMMANDS)
def test_existing_output_is_refused_before_measuring(name, tmp_path):
    module = importlib.import_module(f"drgs.bench.{name}")
    parser = CommandParser()
    module.add_arguments(parser)
    (tmp_path / f"{name}.csv").write_text("mine")
    args = parser.parse_args(["--out", str(tmp_path)])
    with pytest.raises(UserError, match=rf"holds .*{name}\.csv"):
        args.run(args)
    assert [p.name for p in tmp_path.iterdir()] == [f"{name}.csv"]
