"""COLMAP's models: what files say, what COLMAP's own reader says of them, and what is refused."""

import re
import struct

import numpy as np
import pytest
from conftest import SHARED_DATA
from support.attacks.mutations import mutate_bytes
from support.colmap_models import PARAMETERS, WRITERS, some_model, write_binary, write_text
from support.formats import refusal

from drgs.core.errors import UserError
from drgs.io.colmap import MODELS, ColmapCamera, read_model, read_points3d

MUTATIONS = 500  # of each format

REAL_MODEL = SHARED_DATA / "colmap_robothead" / "sparse" / "0"

each_format = pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)


@pytest.fixture
def model():
    return some_model(np.random.default_rng(3))


def read(folder):
    return read_points3d(read_model(folder).points_file)


@each_format
def test_written_models_are_read_back(tmp_path, model, write):
    found = read_model(write(tmp_path, model))
    for number, name, width, height, values in model.cameras:
        parameters = dict(zip(MODELS[name][1], values, strict=True))
        assert found.cameras[number] == ColmapCamera(number, name, width, height, parameters)
    for image, (name, camera, pose) in zip(found.images, model.images, strict=True):
        assert (image.name, image.camera) == (name, camera)
        # Numbers up to 4, written as a quaternion: a few roundings.
        np.testing.assert_allclose(image.camera_to_world, pose, atol=1e-14)
    columns = zip(*model.points, strict=True)
    points = read(tmp_path)
    for name, expected in zip(points.dtype.names, columns, strict=True):
        assert points[name].tolist() == np.array(expected).tolist()


@each_format
def test_model_without_points_has_no_points(tmp_path, model, write):
    found = read_model(write(tmp_path, model, with_points=False))
    assert found.points_file is None and not found.has_points


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
@pytest.mark.parametrize("name", ["a.jpg", "my photo 1.jpg"])  # the latter line has 12 words
def test_images_with_one_line_each_are_read(tmp_path, model, ending, name):
    """Exporters leave out the lines of what images observe."""
    model.images = [(name, *model.images[0][1:]), *model.images[1:]]
    file = write_text(tmp_path, model) / "images.txt"
    expected = read_model(tmp_path).images
    lines = file.read_text().splitlines()
    assert len(lines) == 7 and expected[0].name == name
    file.write_bytes(("\ufeff" + ending.join(lines[:1] + lines[1::2]) + ending).encode())
    for got, wanted in zip(read_model(tmp_path).images, expected, strict=True):
        assert (got.name, got.camera) == (wanted.name, wanted.camera)
        assert (got.camera_to_world == wanted.camera_to_world).all()


def assert_as_colmap_reads(pycolmap, folder):
    """Poses, intrinsics and points, to 1e-12 relative."""
    found, expected = read_model(folder), pycolmap.Reconstruction(str(folder))
    assert set(found.cameras) == set(expected.cameras)
    for number, camera in expected.cameras.items():
        ours = found.cameras[number]
        sizes = camera.model.name, camera.width, camera.height
        assert (ours.model, ours.width, ours.height) == sizes
        np.testing.assert_allclose(list(ours.values.values()), camera.params, rtol=1e-12)
    poses = {image.name: image for image in expected.images.values()}
    assert sorted(poses) == sorted(image.name for image in found.images)
    for image in found.images:
        theirs = np.eye(4)
        theirs[:3] = poses[image.name].cam_from_world().inverse().matrix()
        size = np.abs(theirs).max()
        np.testing.assert_allclose(image.camera_to_world, theirs, rtol=0, atol=1e-12 * size)
        assert image.camera == poses[image.name].camera_id
    points = list(expected.points3D.values())
    theirs = np.array([[*p.xyz, *p.color, p.error, p.track.length()] for p in points])
    found = read(folder)
    ours = np.column_stack([found[name] for name in found.dtype.names])
    theirs, ours = (table[np.lexsort(table.T)] for table in (theirs.reshape(-1, 8), ours))
    np.testing.assert_allclose(ours, theirs, rtol=1e-12)


def test_every_model_is_read_like_colmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(4)
    for name in PARAMETERS:
        assert int(getattr(pycolmap.CameraModelId, name)) == MODELS[name][0]
        model = some_model(rng, models=[name])
        model.points = [(p, c, e, 0) for p, c, e, _ in model.points]
        model.images = [(f"{name}.jpg", *rest) for (_, *rest) in model.images[:1]]
        for kind, write in WRITERS.items():
            assert_as_colmap_reads(pycolmap, write(tmp_path / name / kind, model))


@pytest.mark.slow
@pytest.mark.skipif(not REAL_MODEL.is_dir(), reason="the shared data folder is not here")
def test_real_model_is_read_like_colmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    assert_as_colmap_reads(pycolmap, REAL_MODEL)
    reconstruction = pycolmap.Reconstruction(str(REAL_MODEL))
    reconstruction.write_text(str(tmp_path))
    assert_as_colmap_reads(pycolmap, tmp_path)


FIRST = 8  # byte: the first record


@pytest.mark.parametrize(
    ("file", "at", "data", "message"),
    [
        ("cameras", 0, struct.pack("<Q", 9), "byte 152: 24 bytes were expected, and 0 are"),
        ("cameras", FIRST + 4, struct.pack("<i", 18), "byte 8: a camera model of COLMAP was"),
        ("cameras", FIRST + 8, struct.pack("<Q", 0), "byte 8: width and height must be"),
        ("cameras", FIRST + 16, struct.pack("<Q", 2**40), "byte 8: width and height must be"),
        ("cameras", FIRST + 24, struct.pack("<d", np.nan), "byte 8: fx must be a number"),
        ("cameras", FIRST + 112, struct.pack("<d", 2e12), "byte 64: k1 must be a number of at"),
        ("cameras", FIRST + 56, struct.pack("<I", 7), "byte 64: each camera must be there once"),
        ("images", 0, struct.pack("<Q", 2**62), "byte 320: 64 bytes were expected, and 0"),
        ("images", FIRST + 4, bytes(32), "byte 8: the length of a rotation's quaternion"),
        ("images", FIRST + 36, struct.pack("<d", np.inf), "byte 8: TX must be a number of at"),
        ("images", FIRST + 60, struct.pack("<I", 5), "byte 8: the number of a camera was"),
        ("images", FIRST + 64, b"\xff", "byte 72: a name in UTF-8 of less than"),
        ("images", FIRST + 64, b"/", "byte 8: each image must have a name of its own"),
        ("points3D", 16, struct.pack("<d", np.nan), "byte 8: X must be a number of at most"),
        ("points3D", 51, struct.pack("<Q", 2**50), "byte 59: 9,007,199,254,740,992 bytes were"),
    ],
)  # fmt: skip
def test_a_wrong_number_in_a_binary_file_is_refused(tmp_path, model, file, at, data, message):
    path = write_binary(tmp_path, model) / f"{file}.bin"
    content = path.read_bytes()
    path.write_bytes(content[:at] + data + content[at + len(data) :])
    assert refusal(tmp_path, read).startswith(f"{path}: {message}")


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras", "PINHOLE", "PINHOLES", "line 3: a camera model of COLMAP was expected, got"),
        ("cameras", " 640 ", " -640 ", "line 3: width and height must be between 1"),
        ("cameras", " 320.5 ", " 320.5 1 ", "line 3: a camera of the model PINHOLE"),
        ("cameras", "600.0", "nan", "line 3: fx must be a number of at most 1e+12"),
        ("images", " a.jpg", "", "line 2: an image (IMAGE_ID QW QX QY"),
        ("images", "b c.jpg", "a.jpg", "line 4: each image must have a name of its own"),
        ("images", "\n\n", "\n1 2\n", "line 3: an image (IMAGE_ID QW QX QY"),
        ("images", " a.jpg", " ../a.jpg", "line 2: each image must have a name of its own, "),
        ("images", " a.jpg", " /a.jpg", "line 2: each image must have a name of its own, "),
        ("images", " 7 a.jpg", " 5 a.jpg", "line 2: the number of a camera was expected, got 5"),
        ("images", " 7 a.jpg", " x a.jpg", "line 2: an image (IMAGE_ID QW"),
        ("points3D", "1 0 \n", "1 \n", "line 3: a point (POINT3D_ID X Y Z R G B ERROR, pairs"),
        ("points3D", "# 3D", "1 0 0 0 0 256 0 0.5\n#", "line 1: colours must be 0 to 255, got"),
    ],
)  # fmt: skip
def test_a_wrong_word_in_a_text_file_is_refused(tmp_path, model, file, old, new, message):
    path = write_text(tmp_path, model) / f"{file}.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert refusal(tmp_path, read).startswith(f"{path}: {message}")


def test_a_folder_without_a_model_is_refused(tmp_path):
    assert "is no model of COLMAP: there are neither cameras.bin" in refusal(tmp_path, read)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_truncated_binary_file_is_refused_at_any_length(tmp_path, model, name):
    path = write_binary(tmp_path, model) / f"{name}.bin"
    whole = path.read_bytes()
    for end in range(len(whole)):
        path.write_bytes(whole[:end])
        assert re.match(
            rf"{re.escape(str(path))}: byte [\d,]+: .*cut off$", refusal(tmp_path, read)
        ), end
    path.write_bytes(whole + b"\0")
    assert "the end of the file was expected" in refusal(tmp_path, read)


@pytest.mark.slow
@each_format
def test_damaged_files_are_read_or_refused_with_file_and_place(tmp_path, model, write):
    """Bytes are changed, left out or put in: nothing comes but a UserError with the place."""
    write(tmp_path, model)
    paths = sorted(tmp_path.iterdir())
    file = rf"({'|'.join(re.escape(str(path)) for path in paths)})"
    refused = 0
    for path in paths:
        content = path.read_bytes()
        for seed in range(MUTATIONS // len(paths)):
            path.write_bytes(mutate_bytes(np.random.default_rng(seed), content))
            try:
                read(tmp_path)
            except UserError as error:
                refused += 1
                place = rf"{file}: ((byte|line) [\d,]+: |cannot read the file: )"
                assert re.match(place, str(error))
        path.write_bytes(content)
    assert refused > MUTATIONS // 5  # the others change a digit, or what is skipped
