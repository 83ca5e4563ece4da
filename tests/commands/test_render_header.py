"""``drgs.render`` shows a file's Gaussians as its header says, unless ``--set`` says otherwise."""

from dataclasses import replace

import pytest
import yaml
from support.render_command import run
from support.small_capture import blobs, make_dataset, write_dataset

HEADER = {"antialiased": True, "low_pass": 0.02}
VIEWERS = {"antialiased": False, "low_pass": 0.3}
CAMERA = ["--origin", 0, -4, 1, "--size", 24, 16]
LINES = {
    "  antialiasing: opacities compensated for the low-pass filter (set by the file)",
    "  approximations: low_pass = 0.02 (set by the file)",
}


@pytest.fixture
def shown(tmp_path, capsys):
    """Images of words, in a folder with files and configurations; and what was printed."""
    for name, header in (("plain", None), ("native", HEADER), ("viewers", VIEWERS)):
        replace(blobs(), rendered_with=header).save(tmp_path / f"{name}.ply")
    write_dataset(tmp_path / "data", make_dataset(1, 1))
    config = {"data": {"path": str(tmp_path / "data")}}
    (tmp_path / "plain.yml").write_text(yaml.safe_dump(config))
    (tmp_path / "native.yml").write_text(yaml.safe_dump({**config, "model": HEADER}))

    def render(name, *words, config=None):
        words = [*words, *(["--scene", tmp_path / f"{config}.yml"] if config else CAMERA)]
        run(tmp_path / f"{name}.ply", *words, "--out", tmp_path / "out")
        (image,) = (tmp_path / "out").glob("*.png")
        content = image.read_bytes()
        image.unlink()
        return content, capsys.readouterr().out

    return render


def test_single_file_is_rendered_with_its_header(shown):
    own, said = shown("native")
    plain, plainly_said = shown("plain")
    assert set(said.splitlines()) >= LINES
    assert own != plain and "set by the file" not in plainly_said


@pytest.mark.slow
def test_header_overrides_configuration_and_set_overrides_header(shown):
    own, _ = shown("native", config="native")
    plain, _ = shown("plain", config="plain")
    assert own != plain
    assert shown("native", config="plain")[0] == own
    assert shown("viewers", config="native")[0] == plain
    sets = [
        [word for name, value in values.items() for word in ("--set", f"model.{name}={value}")]
        for values in (HEADER, VIEWERS)
    ]
    assert shown("plain", *sets[0][:2], config="plain")[0] != own
    assert shown("plain", *sets[0], config="plain")[0] == own
    image, said = shown("native", *sets[1], config="plain")
    assert image == plain and "set by the file" not in said
