"""COLMAP's models: what files say, what COLMAP's own reader says of them, and what is refused."""

import re
import struct

import numpy as np
import pytest
from conftest import SHARED_DATA
from support.colmap_models import PARAMETERS, WRITERS, Model, some_model, write_binary, write_text

from drgs.core.errors import UserError
from drgs.io.colmap import MODELS, ColmapCamera, model_files, read_model, read_points3d

MUTATIONS = 500  # of each format

REAL_MODEL = SHARED_DATA / "colmap_robothead" / "sparse" / "0"

each_format = pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)


@pytest.fixture
def model():
    return some_model(np.random.default_rng(3))


@each_format
def test_written_models_are_read_back(tmp_path, model, write):
    read = read_model(write(tmp_path, model))
    for number, name, width, height, values in model.cameras:
        parameters = dict(zip(MODELS[name][1], values, strict=True))
        assert read.cameras[number] == ColmapCamera(number, name, width, height, parameters)
    assert [(image.name, image.camera) for image in read.images] == [i[:2] for i in model.images]
    for image, (_, _, pose) in zip(read.images, model.images, strict=True):
        # Numbers up to 4, written as a quaternion: a few roundings.
        np.testing.assert_allclose(image.camera_to_world, pose, atol=1e-14)
    columns = zip(*model.points, strict=True)
    points = read_points3d(read.points_file)
    for got, expected in zip(vars(points).values(), columns, strict=True):
        assert got.tolist() == np.array(expected).tolist()


@each_format
def test_model_without_points_has_no_points(tmp_path, model, write):
    read = read_model(write(tmp_path, model, with_points=False))
    assert read.points_file is None and not read.has_points


def test_binary_files_are_preferred_to_text(tmp_path, model):
    write_text(tmp_path, model)
    assert model_files(tmp_path)["images"].suffix == ".txt"
    write_binary(tmp_path, model)
    assert {path.suffix for path in model_files(tmp_path).values()} == {".bin"}
    assert model_files(tmp_path / "nothing") is None


def test_camera_parameters_are_named(tmp_path):
    cameras = [(k, name, 640, 480, values) for k, (name, values) in enumerate(PARAMETERS.items())]
    for name, write in WRITERS.items():
        read = read_model(write(tmp_path / name, Model(cameras))).cameras
        assert [tuple(camera.values) for camera in read.values()] == [
            MODELS[camera[1]][1] for camera in cameras
        ]
    assert read[4].values == {
        "fx": 600, "fy": 620, "cx": 320.5, "cy": 239, "k1": 0.01, "k2": 0.02, "p1": 0.03, "p2": 0.04
    }  # fmt: skip


# ----------------------------------------------------------------------------------------------
# COLMAP's own reader
# ----------------------------------------------------------------------------------------------


def assert_as_colmap_reads(pycolmap, folder):
    """Poses, intrinsics and points, to 1e-12 relative."""
    read, expected = read_model(folder), pycolmap.Reconstruction(str(folder))
    assert set(read.cameras) == set(expected.cameras)
    for number, camera in expected.cameras.items():
        ours = read.cameras[number]
        assert (ours.model, ours.width, ours.height) == (
            camera.model.name, camera.width, camera.height
        )  # fmt: skip
        np.testing.assert_allclose(list(ours.values.values()), camera.params, rtol=1e-12)
    poses = {image.name: image for image in expected.images.values()}
    assert sorted(poses) == sorted(image.name for image in read.images)
    for image in read.images:
        theirs = np.eye(4)
        theirs[:3] = poses[image.name].cam_from_world().inverse().matrix()
        size = np.abs(theirs).max()
        np.testing.assert_allclose(image.camera_to_world, theirs, rtol=0, atol=1e-12 * size)
        assert image.camera == poses[image.name].camera_id
    points = list(expected.points3D.values())
    theirs = np.array([[*p.xyz, *p.color, p.error, p.track.length()] for p in points])
    ours = np.column_stack(list(vars(read_points3d(read.points_file)).values()))
    theirs, ours = (table[np.lexsort(table.T)] for table in (theirs.reshape(-1, 8), ours))
    np.testing.assert_allclose(ours, theirs, rtol=1e-12)


@pytest.fixture
def pycolmap():
    return pytest.importorskip("pycolmap")


def test_every_model_is_read_like_colmap(tmp_path, pycolmap):
    rng = np.random.default_rng(4)
    for name, (number, _) in MODELS.items():
        if name not in PARAMETERS:
            continue
        assert int(getattr(pycolmap.CameraModelId, name)) == number
        model = some_model(rng, models=[name])
        model.points = [(p, c, e, 0) for p, c, e, _ in model.points]
        model.images = [(f"{name}.jpg", *rest) for (_, *rest) in model.images[:1]]
        for kind, write in WRITERS.items():
            assert_as_colmap_reads(pycolmap, write(tmp_path / name / kind, model))


@pytest.mark.slow
@pytest.mark.skipif(not REAL_MODEL.is_dir(), reason="the shared data folder is not here")
def test_real_model_is_read_like_colmap(tmp_path, pycolmap):
    assert_as_colmap_reads(pycolmap, REAL_MODEL)
    reconstruction = pycolmap.Reconstruction(str(REAL_MODEL))
    for write in (reconstruction.write_text, reconstruction.write_binary):
        write(str(tmp_path))
        assert_as_colmap_reads(pycolmap, tmp_path)
        for path in tmp_path.iterdir():
            path.unlink()


# ----------------------------------------------------------------------------------------------
# Damage
# ----------------------------------------------------------------------------------------------


def refusal(folder):
    with pytest.raises(UserError) as error:
        read_points3d(read_model(folder).points_file)
    return str(error.value)


def with_bytes(path, at, data):
    content = bytearray(path.read_bytes())
    content[at : at + len(data)] = data
    path.write_bytes(content)


CAMERAS = 8  # byte: the first camera
IMAGES = 8  # byte: the first image


@pytest.mark.parametrize(
    ("file", "at", "data", "message"),
    [
        ("cameras", 0, struct.pack("<Q", 9), "byte 152: 24 bytes were expected, and 0 are"),
        ("cameras", CAMERAS + 4, struct.pack("<i", 18), "byte 8: a camera model of COLMAP was"),
        ("cameras", CAMERAS + 8, struct.pack("<Q", 0), "byte 8: width and height must be"),
        ("cameras", CAMERAS + 16, struct.pack("<Q", 2**40), "byte 8: width and height must be"),
        ("cameras", CAMERAS + 24, struct.pack("<d", np.nan), "byte 8: fx must be a number"),
        ("cameras", CAMERAS + 112, struct.pack("<d", 2e12), "byte 64: k1 must be a number of at"),
        ("cameras", CAMERAS + 56, struct.pack("<I", 7), "byte 64: each camera must be there once"),
        ("images", 0, struct.pack("<Q", 2**62), "byte 320: 64 bytes were expected, and 0"),
        ("images", IMAGES + 4, bytes(32), "byte 8: the length of a rotation's quaternion"),
        ("images", IMAGES + 36, struct.pack("<d", np.inf), "byte 8: TX must be a number of at"),
        ("images", IMAGES + 60, struct.pack("<I", 5), "byte 8: the number of a camera was"),
        ("images", IMAGES + 64, b"\xff", "byte 72: a name in UTF-8 of less than"),
        ("points3D", 16, struct.pack("<d", np.nan), "byte 8: X must be a number of at most"),
        ("points3D", 51, struct.pack("<Q", 2**50), "byte 59: 9,007,199,254,740,992 bytes were"),
    ],
)  # fmt: skip
def test_a_wrong_number_in_a_binary_file_is_refused(tmp_path, model, file, at, data, message):
    path = write_binary(tmp_path, model) / f"{file}.bin"
    with_bytes(path, at, data)
    assert refusal(tmp_path).startswith(f"{path}: {message}")


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras", "PINHOLE", "PINHOLES", "line 3: a camera model of COLMAP was expected, got"),
        ("cameras", " 640 ", " -640 ", "line 3: width and height must be between 1"),
        ("cameras", " 320.5 ", " 320.5 1 ", "line 3: a camera of the model PINHOLE"),
        ("cameras", "600.0", "nan", "line 3: fx must be a number of at most 1e+12"),
        ("cameras", " 0.01 ", " 1e300 ", "line 4: k1 must be a number of at most 1e+12"),
        ("images", " a.jpg", "", "line 2: an image (IMAGE_ID QW QX QY"),
        ("images", "b c.jpg", "a.jpg", "line 4: each image must have a name of its own"),
        ("images", "\n\n", "\n1 2\n", "line 3: observations (X Y POINT3D_ID of each point) were"),
        ("images", " a.jpg", " ../a.jpg", "line 2: each image must have a name of its own, "),
        ("images", " a.jpg", " /a.jpg", "line 2: each image must have a name of its own, "),
        ("images", " 7 a.jpg", " 5 a.jpg", "line 2: the number of a camera was expected, got 5"),
        ("images", " 7 a.jpg", " x a.jpg", "line 2: an image (IMAGE_ID QW"),
        ("points3D", "1 0 \n", "1 \n", "line 3: a point (POINT3D_ID X Y Z R G B ERROR, pairs"),
    ],
)  # fmt: skip
def test_a_wrong_word_in_a_text_file_is_refused(tmp_path, model, file, old, new, message):
    path = write_text(tmp_path, model) / f"{file}.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert refusal(tmp_path).startswith(f"{path}: {message}")


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
    read = read_model(tmp_path).images
    for got, wanted in zip(read, expected, strict=True):
        assert (got.name, got.camera) == (wanted.name, wanted.camera)
        assert (got.camera_to_world == wanted.camera_to_world).all()


def test_colors_are_bytes(tmp_path, model):
    write_text(tmp_path, model)
    path = tmp_path / "points3D.txt"
    path.write_text("# x\n1 0.0 0.0 0.0 0 256 0 0.5 1 0\n")
    with pytest.raises(UserError, match=r"line 2: colours must be 0 to 255, got \(0, 256, 0\)"):
        read_points3d(path)


def test_an_image_without_a_name_is_refused(tmp_path, model):
    model.images[0] = ("", *model.images[0][1:])
    assert "byte 8: each image must have a name of its own" in refusal(
        write_binary(tmp_path, model)
    )


def test_a_folder_without_a_model_is_refused(tmp_path):
    assert "is no model of COLMAP: there are neither cameras.bin" in refusal(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_truncated_binary_file_is_refused_at_any_length(tmp_path, model, name):
    path = write_binary(tmp_path, model) / f"{name}.bin"
    whole = path.read_bytes()
    for end in range(len(whole)):
        path.write_bytes(whole[:end])
        assert re.match(rf"{re.escape(str(path))}: byte [\d,]+: .*cut off$", refusal(tmp_path)), end
    path.write_bytes(whole + b"\0")
    assert "the end of the file was expected" in refusal(tmp_path)


@pytest.mark.slow
@each_format
def test_damaged_files_are_read_or_refused_with_file_and_place(tmp_path, model, write):
    """Bytes are changed, left out or put in: nothing comes but a UserError with the place."""
    rng = np.random.default_rng(5)
    write(tmp_path, model)
    paths = sorted(tmp_path.iterdir())
    contents = [path.read_bytes() for path in paths]
    refused = 0
    for _ in range(MUTATIONS):
        chosen = int(rng.integers(len(paths)))
        content = bytearray(contents[chosen])
        for _ in range(int(rng.integers(1, 4))):
            at, kind = int(rng.integers(len(content))), int(rng.integers(3))
            if kind == 0:
                content[at] = int(rng.integers(256))
            elif kind == 1:
                del content[at : at + int(rng.integers(1, 9))]
            else:
                content[at:at] = rng.bytes(int(rng.integers(1, 9)))
        paths[chosen].write_bytes(content)
        try:
            read_points3d(read_model(tmp_path).points_file)
        except UserError as error:
            refused += 1
            file = rf"({'|'.join(re.escape(str(path)) for path in paths)})"
            assert re.match(rf"{file}: ((byte|line) [\d,]+: |cannot read the file: )", str(error))
        paths[chosen].write_bytes(contents[chosen])
    assert refused > MUTATIONS // 5  # the others change a digit, or what is skipped
