"""Checks of the method drgs of nerfbaselines; prints a page of what they gave.

    python examples/nerfbaselines/check.py --data DIR [--environment DIR]

In an environment with nerfbaselines and drgs, or a new one in ``--environment``, it runs
nerfbaselines' test of a method and a short fit on each scene in DIR: ``nerf_synthetic/lego``,
``fox`` and ``colmap_robothead``. It then measures the fitted Gaussians by drgs, whose readers and
scores share no code with those of nerfbaselines. ``RECORD.md`` has figures, and explains them.

LPIPS is left out unless ``--lpips`` is given: it takes PyTorch, and weights from the internet.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parents[1]
METHOD = HERE / "drgs_method.py"
NERFBASELINES = "nerfbaselines==1.2.0"
BORDER_PX = 5  # half of the window of SSIM
COLOR_CODES = re.compile(r"\x1b\[[0-9;]*m")


def main() -> None:
    """Run the checks of the command line."""
    if sys.argv[1:2] == ["nerfbaselines"]:
        run_nerfbaselines(sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the scenes")
    parser.add_argument("--environment", type=Path, help="make a virtual environment here")
    parser.add_argument("--iterations", type=int, default=600, help="of a fit")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--lpips", action="store_true", help="measure it, too")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    options = parser.parse_args()
    options.environment = options.environment and options.environment.absolute()
    if options.environment not in (None, Path(sys.prefix)):
        start_in_environment(options.environment)
    os.environ["CHECK_THREADS"] = str(options.threads)
    os.environ["CHECK_LPIPS"] = "1" if options.lpips else ""
    set_threads()
    print(make_header(options))
    with tempfile.TemporaryDirectory() as folder:
        for name in options.scenes:
            data = Path(folder) / name
            data.mkdir()
            SCENES[name](options.data.resolve(), data)
            print(check_scene(name, data, options.iterations), flush=True)


def start_in_environment(folder: Path) -> None:
    """Make a virtual environment with both programs, and start this script there."""
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
        # In one command: nerfbaselines needs a NumPy below 2, which drgs supports.
        subprocess.run(
            [python, "-m", "pip", "install", NERFBASELINES, "-e", f"{REPOSITORY}[llvm]"], check=True
        )
    os.execv(python, [str(python), *sys.argv])


def set_threads() -> None:
    """Let Dr.Jit compute on as many threads as the command line says."""
    import drgs  # noqa: F401  (selects the LLVM that Dr.Jit will load)

    # isort: split
    import drjit

    drjit.set_thread_count(int(os.environ["CHECK_THREADS"]))


def run_nerfbaselines(arguments: Sequence[str]) -> None:
    """Run nerfbaselines' command line, without LPIPS where that is left out."""
    set_threads()
    if not os.environ["CHECK_LPIPS"]:
        import numpy as np
        from nerfbaselines import evaluation, metrics

        def not_measured(first: np.ndarray, second: np.ndarray) -> np.ndarray:
            return np.full(first.shape[:-3], np.nan, np.float32)

        metrics.lpips = metrics.lpips_vgg = not_measured
        evaluation.run_inside_eval_container = lambda *_: nullcontext()  # it would install PyTorch
    from nerfbaselines.cli import main as command

    command(list(arguments))


def nerfbaselines(*arguments: object) -> str:
    """Return the standard output of a command of nerfbaselines."""
    command = [sys.executable, __file__, "nerfbaselines", *map(str, arguments)]
    environment = {**os.environ, "NERFBASELINES_REGISTER": str(METHOD)}
    result = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True)
    return COLOR_CODES.sub("", result.stdout) + f"exit status {result.returncode}\n"


# Scenes: folders that nerfbaselines' loaders and drgs' readers both read


def write_info(folder: Path, **values: object) -> None:
    """Write ``nb-info.json``; without an id, published checkpoints and presets are not used."""
    values = {"id": None, "scene": folder.name, **values}
    (folder / "nb-info.json").write_text(json.dumps(values))


def make_lego(source: Path, folder: Path) -> None:
    """Link NeRF-synthetic's Lego, with its split ``val`` as ``test``."""
    lego = source / "nerf_synthetic" / "lego"
    for split, given in (("train", "train"), ("test", "val")):
        (folder / f"transforms_{split}.json").symlink_to(lego / f"transforms_{given}.json")
        (folder / given).symlink_to(lego / given)
    loader = "nerfbaselines.datasets.blender:load_blender_dataset"
    write_info(folder, loader=loader, evaluation_protocol="nerf", type="object-centric")


def make_robot_head(source: Path, folder: Path) -> None:
    """Link a model of COLMAP and its photographs at a quarter of their size."""
    for name in ("sparse", "images_4"):
        (folder / name).symlink_to(source / "colmap_robothead" / name)
    options = {"images_path": "images_4"}
    write_info(folder, loader="colmap", loader_kwargs=options, evaluation_protocol="default")


def make_fox(source: Path, folder: Path) -> None:
    """Write the cameras of instant-ngp's fox as a model of COLMAP, without points.

    Version 1.2.0's loader of transforms.json swaps width and height, p1 and p2, and turns the first
    three cameras only to OpenCV's axes: what it returns is another scene.
    """
    import numpy as np
    from scipy.spatial.transform import Rotation

    given = json.loads((source / "fox" / "transforms.json").read_text())
    (folder / "images").symlink_to(source / "fox" / "images")
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    (model / "cameras.txt").write_text(f"1 OPENCV {' '.join(repr(given[n]) for n in names)}\n")
    lines = []
    for number, frame in enumerate(given["frames"], 1):
        pose = np.array(frame["transform_matrix"])
        pose[:3, 1:3] *= -1  # OpenGL's axes to OpenCV's
        rotation = pose[:3, :3].T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        numbers = [w, x, y, z, *(-rotation @ pose[:3, 3])]
        values = " ".join(repr(float(value)) for value in numbers)
        lines += [f"{number} {values} 1 {Path(frame['file_path']).name}", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("")
    write_info(folder, loader="colmap", evaluation_protocol="default")


SCENES: dict[str, Callable[[Path, Path], None]] = {
    "lego": make_lego,
    "fox": make_fox,
    "robot_head": make_robot_head,
}


# Checks

Row = tuple[str, float, float]  # of a table: what was measured, PSNR (dB), SSIM


def check_scene(name: str, data: Path, iterations: int) -> str:
    """Return the section of the record on a scene."""
    tested = nerfbaselines("test-method", "--method", "drgs", "--data", data)
    output, start = data.parent / f"{name}_output", time.perf_counter()
    options = ("--method", "drgs", "--data", data, "--output", output)
    trained = nerfbaselines("train", *options, "--set", f"iterations={iterations}")
    seconds = time.perf_counter() - start
    if not trained.endswith("exit status 0\n"):
        raise SystemExit(trained)
    scores = json.loads((output / f"results-{iterations}.json").read_text())["metrics"]
    rows = [
        ("nerfbaselines' own scores", scores["psnr"], scores["ssim"]),
        *scores_by_drgs(data, output / f"checkpoint-{iterations}"),
        score_of_own_fit(data, iterations),
    ]
    table = "".join(f"| {what} | {psnr:.3f} | {ssim:.5f} |\n" for what, psnr, ssim in rows)
    return (
        f"## {name}\n\n"
        f"`nerfbaselines test-method --method drgs --data {name}`:\n\n```\n{tested}```\n\n"
        f"`nerfbaselines train --method drgs --data {name} --set iterations={iterations}`: "
        f"{seconds:.0f} s in all. Scores of the same Gaussians, and of others in the last row:\n\n"
        f"| scores | PSNR | SSIM |\n| --- | --- | --- |\n{table}\n"
        f"LPIPS: {format_lpips(scores)}.\n"
    )


def format_lpips(scores: Mapping[str, float]) -> str:
    """Return what was measured, or the reason why nothing was."""
    if os.environ["CHECK_LPIPS"]:
        return ", ".join(f"{key} {value:.4f}" for key, value in scores.items() if "lpips" in key)
    return "not measured, as its weights come from the internet"


def scores_by_drgs(data: Path, checkpoint: Path) -> list[Row]:
    """Return scores of the Gaussians of a checkpoint: cameras, images and renderings by drgs.

    Each row changes one thing on the way from nerfbaselines' scores to those of drgs.
    """
    import drgs

    # isort: split
    import mitsuba as mi
    import numpy as np
    from nerfbaselines import metrics

    from drgs.config.schema import FitConfig
    from drgs.integrator.scene import make_scene, render_views
    from drgs.results.metrics import psnr, ssim

    mi.set_variant("llvm_ad_rgb")
    model = FitConfig.model_validate_json((checkpoint / "config.json").read_text()).model
    dataset = drgs.load_dataset(data)
    scene = make_scene(
        drgs.Gaussians.load(checkpoint / "point_cloud_drgs.ply"), model, dataset.background
    )
    images = [image.astype(np.float32) for image in render_views(scene, dataset.test)]
    targets = [np.asarray(view.image, np.float32) for view in dataset.test]

    def score(what: str, change: Callable, psnr_of: Callable, ssim_of: Callable) -> Row:
        pairs = [(change(i), change(t)) for i, t in zip(images, targets, strict=True)]
        means = (np.mean([scorer(*pair) for pair in pairs]) for scorer in (psnr_of, ssim_of))
        return what, *map(float, means)

    def truncate(image: np.ndarray) -> np.ndarray:
        """Return the image in 8 bits, rounded down, as nerfbaselines converts it."""
        return np.floor(image * np.float32(255)) / np.float32(255)

    def round_to_nearest(image: np.ndarray) -> np.ndarray:
        return np.round(image * np.float32(255)) / np.float32(255)

    def padded_ssim(image: np.ndarray, target: np.ndarray) -> float:
        """Return nerfbaselines' SSIM with windows that reach beyond the images, as drgs has it."""
        border = ((BORDER_PX, BORDER_PX), (BORDER_PX, BORDER_PX), (0, 0))
        return metrics.ssim(np.pad(image, border), np.pad(target, border))

    return [
        score("its formulas, images of drgs", truncate, metrics.psnr, metrics.ssim),
        score("a black border around both in SSIM", truncate, metrics.psnr, padded_ssim),
        score("formulas of drgs", truncate, psnr, ssim),
        score("images rounded to the nearest of 8 bits", round_to_nearest, psnr, ssim),
        score("images not rounded: drgs' own scores", lambda image: image, psnr, ssim),
    ]


def score_of_own_fit(data: Path, iterations: int) -> Row:
    """Return drgs' scores of a fit by ``drgs.train``, from the folder itself."""
    import drgs
    from drgs.results.metrics import mean_quality

    dataset = drgs.load_dataset(data)
    config = {"data": {"path": data}, "iterations": iterations}
    trainer = drgs.train(config, dataset).trainer
    trainer.sync_scene()
    targets = (view.image for view in dataset.test)
    quality = mean_quality(zip(trainer.images(dataset.test), targets, strict=True))
    return "another fit, by `drgs.train`: drgs' own scores", quality.psnr, quality.ssim


def make_header(options: argparse.Namespace) -> str:
    """Return the beginning of the page: versions, machine, and how to read the tables."""
    packages = ("nerfbaselines", "drgs", "mitsuba", "drjit", "numpy")
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return (
        f"{time.strftime('%Y-%m-%d')}, {versions}, Python {platform.python_version()}, "
        f"{processor()}, {options.threads} thread(s) of Dr.Jit. Scores are means over test views; "
        "each row of a table differs from the one above it in what it names.\n"
    )


def processor() -> str:
    """Return the processor's name."""
    names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    return names[0] if names else platform.machine()


if __name__ == "__main__":
    main()
