"""The comparison of recipes: its cases change what they say, its fits become tables and plots."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import yaml
from PIL import Image
from support.small_capture import make_dataset, write_dataset

from drgs import fit
from drgs.bench import __main__ as bench
from drgs.bench import ingredients, recipes
from drgs.bench.ingredients import CASES, EXTRAS, INGREDIENTS, PAPER, SCENES, config_of, shortened
from drgs.cli.commands import CommandParser
from drgs.config.load import dump_config, known_keys, load_config
from drgs.core.errors import UserError

PAPER_FILE = ingredients.SCENES_FOLDER / "lego_paper.yml"

scene_and_case = pytest.mark.parametrize(
    ("scene", "case"),
    [
        pytest.param(scene, case, id=f"{scene.name}-{case.name}")
        for scene in SCENES
        for case in CASES
        if case.concerns(scene)
    ],
)


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def value(config, key):
    for name in key.split("."):
        config = getattr(config, name)
    return config


def flat(values, prefix=""):
    """Of nested sections, by dotted names."""
    found = {}
    for name, each in values.items():
        if isinstance(each, dict):
            found |= flat(each, f"{prefix}{name}.")
        else:
            found[prefix + name] = each
    return found


def differences(first, second):
    """Names of the values that two configurations do not share."""
    one, other = flat(first.model_dump()), flat(second.model_dump())
    return {key for key in one if one[key] != other[key]}


# ----------------------------------------------------------------------------------------------
# Cases
# ----------------------------------------------------------------------------------------------


def test_each_ingredient_is_added_and_taken_away_and_what_else_was_tried_is_added():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
    assert names[:2] == ["the paper's", "the whole"]
    parts = [ingredient.name for ingredient in INGREDIENTS]
    assert names[2:] == [
        *(f"the paper's + {name}" for name in parts),
        *(f"the whole without {name}" for name in parts),
        *(f"the whole + {extra.name}" for extra in EXTRAS),
    ]


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_both_ends_are_written_out(scene):
    """What a default is makes no difference."""
    written = ingredients.paper_of(scene)
    changes = [ingredient.changes(scene) for ingredient in INGREDIENTS]
    for each in (*changes, *(extra.changes(scene) for extra in EXTRAS)):
        assert set(each) <= set(written)
    keys = [key for each in changes for key in each]
    assert len(set(keys)) == len(keys)
    assert set(written) <= set(known_keys())


def test_the_paper_s_recipe_is_that_of_its_file():
    config = load_config(PAPER_FILE)
    assert {key: value(config, key) for key in PAPER} == dict(PAPER)


@scene_and_case
def test_a_case_changes_what_it_names_and_nothing_else(scene, case, tmp_path):
    config = config_of(case, scene)
    dump_config(config, tmp_path / "case.yml")
    assert load_config(tmp_path / "case.yml") == config
    if case.reference is not None:
        reference = next(each for each in CASES if each.name == case.reference)
        varied = INGREDIENTS if case.varied is None else (case.varied,)
        keys = {key for ingredient in varied for key in ingredient.changes(scene)}
        assert differences(config, config_of(reference, scene)) == keys


@scene_and_case
def test_a_case_can_be_shortened(scene, case):
    config = config_of(case, scene)
    short = shortened(config, 300)
    assert short.iterations == 300 and shortened(config, 10**6) == config
    assert short.densify.stop == round(300 * config.densify.stop / config.iterations)


def test_the_whole_on_the_shipped_scene():
    config = config_of(CASES[1], ingredients.LEGO)
    assert config.iterations == 4000 and config.data.image_size == 200
    assert (config.model.antialiased, config.model.low_pass) == (True, 0.1)
    assert (config.init.start, config.init.num_points) == ("masks", 20_000)
    assert (config.densify.strategy, config.densify.budget.gaussians) == ("budget", 50_000)
    assert (config.densify.start, config.densify.stop) == (200, 2000)
    rates = config.optimizer
    assert (rates.means_lr, rates.means_lr_final, rates.sh0_lr) == (3.2e-4, 3.2e-6, 5e-3)
    assert (rates.scales_lr, rates.quats_lr, rates.shN_lr) == (1e-2, 2e-3, 1e-3)
    assert (rates.decay, rates.decay_from) == (0.1, 0.5)
    assert config.model.sh_increase_every == 100


# ----------------------------------------------------------------------------------------------
# Tables and plots
# ----------------------------------------------------------------------------------------------


def point(case, seed=0, psnr=30.0, wall_s=100.0, scene="lego", viewers_psnr=None):
    return recipes.Point(scene, case, seed, psnr, 0.95, 1000, 4000, wall_s, viewers_psnr)


def cells(text, name):
    """Of the row of a recipe."""
    line = next(line for line in text.splitlines() if line.startswith(f"| {name} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_row_says_what_a_recipe_is_worth_and_what_it_takes():
    points = [point("the paper's", viewers_psnr=30.0), point("the whole", psnr=34.0, wall_s=80.0)]
    text = recipes.table([*points, point("the whole + steps of 4 views", psnr=33.75, wall_s=90.0)])
    assert cells(text, "the paper's") == [
        *("the paper's", "30.00 dB", "", "0.9500", "1,000", "100 s", "1.00", "30.00 dB"),
    ]
    assert cells(text, "the whole")[1:] == [
        *("34.00 dB", "+4.00", "0.9500", "1,000", "80 s", "0.80", ""),
    ]
    assert cells(text, "the whole + steps of 4 views")[1:3] == ["33.75 dB", "-0.25"]
    assert len(text.splitlines()) == 5


def test_of_several_seeds_the_mean_and_each_are_shown_and_compared_where_both_have_them():
    points = [
        *(point("the paper's", 0, 30.0, 100.0), point("the paper's", 1, 31.0, 120.0)),
        point("the whole", 1, 33.0, 55.0),
    ]
    text = recipes.table(points)
    assert cells(text, "the paper's")[1] == "30.50 dB (30.00, 31.00)"
    assert cells(text, "the whole")[1:3] == ["33.00 dB", "+2.00"]
    assert cells(text, "the whole")[6] == "0.50"


def test_without_the_paper_s_recipe_there_is_nothing_to_compare_with():
    assert cells(recipes.table([point("the whole")]), "the whole")[2] == ""
    assert recipes.times_the_papers([point("the whole")], [point("the whole")]) is None


def test_a_plot_has_a_panel_for_each_scene_and_a_mark_for_each_recipe():
    names = [case.name for case in CASES]
    points = [point(name, psnr=30 + k, scene="lego") for k, name in enumerate(names)]
    points += [point(names[0], k, psnr=20 + k, wall_s=50.0, scene="fox") for k in range(3)]
    figure = recipes.plot(points, "wall_s", "s")
    lego, fox = figure.axes
    assert [line.get_label() for line in lego.lines] == names
    (mark,) = fox.lines
    assert np.allclose(mark.get_xydata(), [[50, 21]])
    looks = {(line.get_color(), line.get_marker()) for line in lego.lines}
    assert len(looks) == len(names)


@pytest.mark.skipif(not recipes.KEPT.exists(), reason="nothing was measured yet")
def test_the_page_of_results_shows_what_is_kept():
    rows = read(recipes.KEPT / "recipes.csv")
    kinds = {"scene": str, "case": str, "seed": int, "gaussians": int, "iterations": int}
    names = recipes.Point.__dataclass_fields__
    points = [
        recipes.Point(**{k: kinds.get(k, float)(row[k]) if row[k] else None for k in names})
        for row in rows
    ]
    page = (ingredients.SCENES_FOLDER.parent / "docs" / "results.md").read_text()
    for table in recipes.tables(points).split("\n\n")[1::2]:
        assert table in page


# ----------------------------------------------------------------------------------------------
# The command
# ----------------------------------------------------------------------------------------------


class Here:
    """In the place of a process of its own."""

    def __init__(self, *args, **settings):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def submit(self, function, *args):
        function(*args)
        return self

    def result(self):
        pass


def pretended(arguments):
    """In the place of ``drgs.fit``: what it leaves behind of what is read."""
    parser = CommandParser()
    fit.add_arguments(parser)
    args = parser.parse_args(arguments)
    config = load_config(args.config)
    metrics = {
        "test": {"psnr": 20 + config.model.antialiased, "ssim": 0.9},
        "num_gaussians": config.init.num_points,
        "iterations": config.iterations,
        "wall_s": 4.0 - config.model.antialiased,
        "seed": config.seed,
        "config": config.model_dump(mode="json"),
    }
    if config.model.antialiased:
        metrics["viewers"] = {"psnr": 20.25}
    folder = Path(args.out)
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    dump_config(config, folder / "config.yml")


@pytest.fixture
def small(tmp_path, monkeypatch):
    """A scene of a few noisy pictures in the place of the shipped one; the fox is not there."""
    write_dataset(tmp_path / "data", make_dataset(train=3, test=1))
    file = tmp_path / "small.yml"
    file.write_text(yaml.safe_dump({"data": {"path": "data"}}))
    values = {**ingredients.LEGO.paper, "data.image_size": None, "init.num_points": 60}
    lego = replace(ingredients.LEGO, config=file, gaussians=60, carved=40, paper=values)
    missing = tmp_path / "fox.yml"
    missing.write_text(yaml.safe_dump({"data": {"path": "nowhere"}}))
    fox = replace(ingredients.FOX, config=missing)
    monkeypatch.setattr(recipes, "SCENES", (lego, fox))
    monkeypatch.setattr(recipes, "QUICK_ITERATIONS", 20)
    return lego


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_fits_become_a_table_and_plots(small, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(recipes, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(fit, "main", pretended)
    command = ["recipes", "--quick", "--only", "1", "3", "--seeds", "2", "--threads", "1"]
    bench.main([*command, "--out", str(tmp_path / "out"), "--keep", str(tmp_path / "kept")])
    printed = capfd.readouterr().out
    assert "fox is left out: no folder" in printed
    names = CASES[0].name, CASES[2].name
    assert f"| {names[1]} | 21.00 dB (21.00, 21.00) | +1.00 |" in printed
    folder = tmp_path / "out" / "recipes"
    rows = read(folder / "recipes.csv")
    assert [(row["scene"], row["case"], row["seed"]) for row in rows] == [
        ("lego", name, seed) for name in names for seed in "01"
    ]
    assert [row["iterations"] for row in rows] == ["20"] * 4
    assert [float(row["times_the_papers"]) for row in rows] == [1, 1, 0.75, 0.75]
    assert [float(row["viewers_psnr"]) for row in rows] == [20, 20, 20.25, 20.25]
    for name in recipes.NAMES:
        assert (tmp_path / "kept" / name).read_bytes() == (folder / name).read_bytes()
    for name in recipes.NAMES[1:]:
        assert Image.open(folder / name).size[0] > 500
    fitted = load_config(recipes.folder_of(CASES[2], small, 20, folder) / "1" / "config.yml")
    assert fitted == shortened(config_of(CASES[2], small), 20).model_copy(update={"seed": 1})


def test_what_was_kept_by_others_stays(small, tmp_path, capfd):
    (tmp_path / "recipes.csv").write_text("mine")
    with pytest.raises(SystemExit):
        bench.main(["recipes", "--out", str(tmp_path / "out"), "--keep", str(tmp_path)])
    assert "holds recipes.csv" in capfd.readouterr().err
    assert not (tmp_path / "out" / "recipes").exists()


def test_a_folder_of_photographs_that_is_not_there_is_refused(small, tmp_path):
    with pytest.raises(UserError, match="--data: must be the folder of the photographs"):
        recipes.usable(recipes.SCENES, ["lego", "fox"], tmp_path / "no")
    assert recipes.usable(recipes.SCENES, ["lego", "fox"], None) == [small]


@pytest.mark.slow
def test_fits_run_each_in_a_process_of_its_own_and_are_not_repeated(tmp_path, capfd, monkeypatch):
    """The two ends, and what else was tried, on the shipped scene at the size of a stamp."""
    values = {**ingredients.LEGO.paper, "data.image_size": 32, "init.num_points": 200}
    scene = replace(ingredients.LEGO, gaussians=150, carved=100, paper=values)
    monkeypatch.setattr(recipes, "SCENES", (scene,))
    monkeypatch.setattr(recipes, "QUICK_ITERATIONS", 20)
    numbers = [str(k) for k, case in enumerate(CASES, 1) if k <= 2 or case.varied in EXTRAS]
    command = ["recipes", "--quick", "--out", str(tmp_path), "--scenes", "lego", "--threads", "1"]
    command += ["--only", *numbers]
    bench.main(command)
    rows = read(tmp_path / "recipes" / "recipes.csv")
    assert [row["case"] for row in rows] == [CASES[int(k) - 1].name for k in numbers]
    assert all(0 < float(row["viewers_psnr"]) < 60 for row in rows)
    written = (tmp_path / "recipes" / "recipes.csv").read_text()
    capfd.readouterr()
    bench.main(command)
    assert capfd.readouterr().out.count("this fit is finished") == len(numbers)
    assert (tmp_path / "recipes" / "recipes.csv").read_text() == written
