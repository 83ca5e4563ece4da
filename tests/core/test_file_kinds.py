"""Files of other kinds are named, with the way to use them, wherever a path is taken."""

import gzip
import zipfile

import pytest

from drgs.config.load import load_config
from drgs.core.errors import UserError
from drgs.core.file_kinds import describe_file
from drgs.gaussians.parameters import Gaussians
from drgs.poses.structure_from_motion import photographs_in

VIDEO = b"\0\0\0\x18ftypmp42" + bytes(64)

FILES = {
    "clip.mp4": (b"", "is a video: take photographs from it, as by ffmpeg -i "),
    "CLIP.MOV": (b"", "is a video"),
    "clip.ply": (VIDEO, "is a video"),
    "a.ply.gz": (gzip.compress(b"ply"), "is compressed: unpack it first, as by gunzip -k "),
    "renamed.ply": (gzip.compress(b"ply"), "is compressed"),
    "a.zip": (b"", "is an archive: unpack it first"),
    "a.gltf": (b"{}", "is glTF as text"),
    "a.lcc": (b"{}", "is LCC of XGRIDS"),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("use", [Gaussians.load, load_config, photographs_in])
def test_files_of_other_kinds_are_named(tmp_path, name, use):
    content, message = FILES[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError) as error:
        use(tmp_path / name)
    assert str(error.value).startswith(f"{tmp_path / name}: {message}")


def test_archives_by_content_and_other_files(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.ply", "w") as archive:
        archive.writestr("b", "c")
    assert describe_file(tmp_path / "a.ply").startswith("is an archive")
    (tmp_path / "b.ply").write_bytes(b"ply\n")
    for name in ("b.ply", "missing.yml", ""):
        assert describe_file(tmp_path / name) == ""


def test_a_dataset_in_place_of_a_configuration_is_named(tmp_path):
    (tmp_path / "transforms.json").write_text('{"fl_x": 60.0, "frames": [{"file_path": "a"}]}')
    with pytest.raises(UserError, match=f"describes a dataset, no fit; give its folder {tmp_path}"):
        load_config(tmp_path / "transforms.json")
