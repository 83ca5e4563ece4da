"""``drgs poses``: what it says."""

import pytest

from drgs.poses import __main__ as poses
from drgs.poses.structure_from_motion import SfmResult, SfmSettings

PLACED = SfmResult(("a.jpg", "b.jpg"), (), ("OPENCV 64 x 48 px (f: 50)",), 1234, 0.456, 1)


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs the command with a search that finds ``found``: what it was asked for, and its lines."""

    def command(found, *options):
        asked = []

        def reconstruct(folder, search, replace, watch):
            for done in (0, 1, 2, 1, 2):  # of two models
                watch("camera", done, 2)
            asked.append((folder, search, replace))
            return found

        monkeypatch.setattr(poses, "reconstruct", reconstruct)
        monkeypatch.setattr(poses, "find_reader", lambda config: ("colmap", None))
        poses.main([str(tmp_path), *options])
        return asked[0], capsys.readouterr().out.splitlines()

    return command


def test_result_is_printed(run, tmp_path):
    _, (progress, found, camera, written, following) = run(PLACED)
    assert progress == "camera 2/2  left 0:00"
    assert found == "2 of 2 photographs placed, mean reprojection error 0.46 px, 1,234 points"
    assert camera == "camera: OPENCV 64 x 48 px (f: 50)"
    assert written.startswith(f"written: {tmp_path}/sparse/0 in ")
    assert following == f"continue with: drgs fit {tmp_path}"
    missing = tuple(f"{k}.jpg" for k in range(7))
    _, lines = run(SfmResult(("a.jpg",), missing, ("x", "y"), 9, 1.0, 3))
    for part in (
        "1 of 8 photographs placed",
        "camera: x\ncamera: y",
        "without a camera: 0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg and 2 more",
        "smaller models that do not hang together with this one: 2",
        "so may --share one or --camera-model SIMPLE_RADIAL",
    ):
        assert part in "\n".join(lines)


def test_options_set_the_search(run, tmp_path):
    options = ["--camera-model", "RADIAL", "--share", "one", "--compare", "neighbours"]
    asked, _ = run(PLACED, *options, "--mapper", "global", "--overwrite")
    assert asked == (tmp_path, SfmSettings("RADIAL", "neighbours", "one", "global"), True)
