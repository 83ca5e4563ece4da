"""``drgs.render`` shows a file's Gaussians as its header says, unless ``--set`` says otherwise."""

from dataclasses import replace

import pytest
import yaml
from support.render_command import run
from support.small_capture import blobs, make_dataset, write_dataset

HEADER_VALUES = {"antialiased": True, "low_pass": 0.02}
CAMERA = ["--origin", 0, -4, 1, "--size", 24, 16]
LINES = [
    "  antialiasing: opacities compensated for the low-pass filter (set by the file)",
    "  approximations: low_pass = 0.02 (set by the file)",
]


@pytest.fixture
def files(tmp_path):
    """A run whose file and configuration have HEADER_VALUES, and a file without a header."""
    run_folder = tmp_path / "run"
    run_folder.mkdir()
    replace(blobs(), rendered_with=HEADER_VALUES).save(run_folder / "point_cloud.ply")
    blobs().save(tmp_path / "plain.ply")
    write_dataset(tmp_path / "data", make_dataset(1, 1))
    config = {"data": {"path": str(tmp_path / "data")}}
    (tmp_path / "plain.yml").write_text(yaml.safe_dump(config))
    (run_folder / "config.yml").write_text(yaml.safe_dump({**config, "model": HEADER_VALUES}))
    return tmp_path


def shown(files, out, *arguments):
    run(*arguments, "--out", files / out)
    (rendered,) = (files / out).glob("*.png")
    return rendered.read_bytes()


def test_single_file_is_rendered_with_its_header(files, capsys):
    said = shown(files, "a", files / "run" / "point_cloud.ply", *CAMERA)
    lines = capsys.readouterr().out.splitlines()
    assert set(LINES) <= set(lines)
    assert said != shown(files, "b", files / "plain.ply", *CAMERA)
    assert "set by the file" not in capsys.readouterr().out


@pytest.mark.slow
def test_header_overrides_configuration_and_set_overrides_header(files, capsys):
    ply, config = files / "run" / "point_cloud.ply", files / "plain.yml"
    own = shown(files, "a", files / "run")
    assert shown(files, "b", ply, "--scene", config) == own
    capsys.readouterr()
    values = [f"model.{name}={str(value).lower()}" for name, value in HEADER_VALUES.items()]
    assert shown(files, "c", files / "plain.ply", "--scene", config, "--set", *values[:1]) != own
    given = [word for value in values for word in ("--set", value)]
    assert shown(files, "d", files / "plain.ply", "--scene", config, *given) == own
    usual = ["--set", "model.low_pass=0.3", "--set", "model.antialiased=false"]
    plain = shown(files, "e", files / "plain.ply", "--scene", config)
    capsys.readouterr()
    assert shown(files, "f", ply, "--scene", config, *usual) == plain
    assert "set by the file" not in capsys.readouterr().out


def test_file_for_viewers_is_rendered_like_viewers(files):
    """Under the configuration of its run, which says otherwise."""
    usual = {"antialiased": False, "low_pass": 0.3}
    replace(blobs(), rendered_with=usual).save(files / "run" / "viewers.ply")
    found = shown(
        files, "a", files / "run" / "viewers.ply", "--scene", files / "run" / "config.yml"
    )
    assert found == shown(files, "b", files / "plain.ply", "--scene", files / "plain.yml")


def test_a_wrong_header_is_refused_in_one_line(files, capsys):
    replace(blobs(), rendered_with={"low_pass": -1.0}).save(files / "a.ply")
    with pytest.raises(SystemExit) as end:
        run(files / "a.ply", *CAMERA, "--out", files / "out")
    assert end.value.code == 2 and not (files / "out").exists()
    assert (
        capsys.readouterr()
        .err.strip()
        .splitlines()[-1]
        .endswith(
            f"{files / 'a.ply'}: the header's low_pass must be finite and not negative, got -1.0; "
            "correct the line, or remove it"
        )
    )
