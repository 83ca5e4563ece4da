"""``mpiexec -n K python -m drgs.render``: the same files."""

import pytest
from support import parallel_processes

MODEL = parallel_processes.REPOSITORY / "scenes" / "shapes" / "knot.ply"


def rendered(size, out, *words):
    command = ["-m", "drgs.render", MODEL, "--orbit", 5, "--size", 30, 20, "--out", out, *words]
    return parallel_processes.run(size, command)


def files_of(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".json"}


@pytest.mark.slow
def test_processes_share_the_frames_of_an_orbit(tmp_path):
    outputs = []
    for size in (1, 3):
        status, output, errors = rendered(size, tmp_path / str(size))
        assert status == 0, errors
        outputs.append(output.replace(str(tmp_path / str(size)), "OUT"))
    assert outputs[0] == outputs[1]
    one, three = (files_of(tmp_path / str(size)) for size in (1, 3))
    assert one == three and len(one) == 7  # frames, and two animations


@pytest.mark.slow
def test_errors_are_reported_by_one_process(tmp_path):
    (tmp_path / "orbit_002.png").write_text("mine")
    status, _, errors = rendered(2, tmp_path)
    assert status == 2 and errors.count("error: ") == 1
    assert (tmp_path / "orbit_002.png").read_text() == "mine"
    status, _, errors = rendered(2, tmp_path, "--target", 0, 0, 0)
    assert status == 2 and errors.count("error: ") == 1
