import os
from pathlib import Path

import pytest
from conftest import REPOSITORY
from pydantic import BaseModel, ValidationError

from drgs.config.approximations import Approximations
from drgs.config.load import PATH_KEYS, dump_config, known_keys, load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError

SCENES = sorted((REPOSITORY / "scenes").glob("*.yml"))

MINIMAL = "data: {path: somewhere}\n"


@pytest.fixture
def load(tmp_path, monkeypatch):
    """load(text, *overrides): the configuration in scenes/x.yml below the current folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes").mkdir()

    def load_text(text, *overrides):
        Path("scenes/x.yml").write_text(text)
        return load_config("scenes/x.yml", overrides)

    return load_text


def fields_of(model, prefix=""):
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from fields_of(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, field


def test_lego_paper_is_the_reference_recipe():
    config = load_config(REPOSITORY / "scenes" / "lego_paper.yml")
    optimizer, densify, init = config.optimizer, config.densify, config.init
    assert (optimizer.means_lr, optimizer.means_lr_final) == (1.6e-4, 1.6e-6)
    assert (optimizer.sh0_lr, optimizer.shN_lr, optimizer.opacities_lr) == (2.5e-3, 1.25e-4, 0.05)
    assert (optimizer.scales_lr, optimizer.quats_lr, optimizer.epsilon) == (5e-3, 1e-3, 1e-15)
    assert (optimizer.beta_1, optimizer.beta_2) == (0.9, 0.999)
    assert (optimizer.decay, optimizer.views) == (1, 1)  # of all but the means, constant rates
    assert (config.loss.dssim_weight, config.loss.window, config.loss.sigma) == (0.2, 11, 1.5)
    assert (config.model.sh_degree, config.model.sh_increase_every) == (3, 1000)
    assert config.model.approximations == Approximations() and not config.model.smoothing
    assert (densify.start, densify.stop, densify.every) == (500, 15_000, 100)
    assert densify.strategy == "adc" and densify.prune.to is None
    adc = densify.adc
    assert (adc.grad_threshold, adc.clone_scale) == (2e-4, 0.01)
    assert (adc.split_count, adc.split_shrink) == (2, 1.6)
    assert (adc.prune_opacity, adc.prune_scale) == (0.005, 0.1)
    assert (adc.reset_every, adc.reset_opacity) == (3000, 0.01)
    assert adc.white_background_reset == 500
    assert (init.num_points, init.opacity, init.scale, init.start) == (100_000, 0.1, 1, "random")
    assert config.iterations == 30_000 and config.coarse == []


def test_rates_decay_except_with_adc(load):
    assert load(MINIMAL).optimizer.decay == 0.1
    assert load(MINIMAL + "densify: {strategy: adc}").optimizer.decay == 1
    given = load(MINIMAL + "densify: {strategy: adc}\noptimizer: {decay: 0.5}")
    assert given.optimizer.decay == 0.5


@pytest.mark.parametrize(
    ("iterations", "start", "stop", "degree"),
    [(60_000, 500, 15_000, 1000), (30_000, 500, 15_000, 750), (7000, 350, 3500, 175),
     (700, 35, 350, 18), (3, 1, 2, 1), (1, 0, 1, 1)],
)  # fmt: skip
def test_the_schedule_follows_from_the_iterations(load, iterations, start, stop, degree):
    config = load(MINIMAL + f"iterations: {iterations}")
    assert (config.densify.start, config.densify.stop) == (start, stop)
    assert config.model.sh_increase_every == degree


@pytest.mark.parametrize(
    ("iterations", "start", "stop"),
    [(30_000, 500, 15_000), (7000, 500, 5000), (700, 250, 500), (3, 1, 2), (1, 0, 1)],
)
def test_adc_has_a_longer_density_schedule(load, iterations, start, stop):
    config = load(MINIMAL + f"iterations: {iterations}\ndensify: {{strategy: adc}}")
    assert (config.densify.start, config.densify.stop) == (start, stop)


def test_explicit_schedule_values_are_kept(load):
    given = "densify: {start: 400}\nmodel: {sh_increase_every: 900}\niterations: 500"
    config = load(MINIMAL + given)
    assert (config.densify.start, config.densify.stop) == (400, 401)
    assert config.model.sh_increase_every == 900
    config = load(MINIMAL + given, "densify.start=null", "densify.stop=90")
    assert (config.densify.start, config.densify.stop) == (25, 90)


def test_every_value_is_described():
    for name, field in fields_of(FitConfig):
        assert field.description, name


def test_a_configuration_is_frozen(load):
    with pytest.raises(ValidationError, match="frozen"):
        load(MINIMAL).iterations = 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("densify: {every: 0}", "densify.every must be >= 1, got 0"),
        ("densify: {evry: 3}", "unknown key densify.evry; did you mean densify.every?"),
        (
            "grad_threshold: 3",
            "unknown key grad_threshold; did you mean densify.adc.grad_threshold?",
        ),
        ("zzz: 3", "unknown key zzz"),
        ("5: 3", "unknown key 5"),
        ("iterations: 1.5", "iterations must be an integer, got 1.5"),
        ("iterations: true", "iterations must be an integer, got true"),
        ("iterations: '7'", "iterations must be an integer, got '7'"),
        ("seed: 3000000000", "seed must be <= 2147483647, got 3000000000"),
        (
            "output: {dir: ~not-a-user/x}",
            "output.dir must be a path in UTF-8, got '~not-a-user/x' (Could not determine home "
            "directory.)",
        ),
        (
            'output: {dir: "a\\0b"}',
            "output.dir must be a path in UTF-8, got 'a\\x00b' (embedded null byte)",
        ),
        ("seed: -1", "seed must be >= 0, got -1"),
        ("loss: {sigma: 0}", "loss.sigma must be >= 0.1, got 0"),
        ("loss: {sigma: big}", "loss.sigma must be a number, got 'big'"),
        ("loss: {sigma: .inf}", "loss.sigma must be a finite number, got .inf"),
        ("loss: {sigma: .nan}", "loss.sigma must be a finite number, got .nan"),
        ("loss: {dssim_weight: 2}", "loss.dssim_weight must be <= 1, got 2"),
        ("loss: {window: 4}", "loss.window must be odd, got 4"),
        ("init: {opacity: 1}", "init.opacity must be <= 0.999999, got 1"),
        ("model: {sh_degree: 4}", "model.sh_degree must be <= 3, got 4"),
        ("model: {antialiased: some}", "model.antialiased must be true or false, got 'some'"),
        ("model: 5", "model must be a section of keys, got 5"),
        ("model:", "model must be a section of keys, got null"),
        ("output: {dir: [1]}", "output.dir must be a path, got [1]"),
        ("coarse: 4", "coarse must be a list, got 4"),
        ("coarse: [{until: 9, factor: 1}]", "coarse.0.factor must be >= 2, got 1"),
        (
            "coarse: [{until: 9}]",
            "coarse.0.factor is missing: Width and height are divided by this.",
        ),
        (
            "coarse: [{until: 9, factor: 2, facto: 2}]",
            "unknown key coarse.0.facto; did you mean coarse.factor?",
        ),
        (
            "coarse: [{until: 9, factor: 2}, {until: 20, factor: 4}]",
            "coarse must be stages with growing until and falling factor, got {until: 9, "
            "factor: 2} before {until: 20, factor: 4}",
        ),
        (
            "optimizer: {means_lr_aims: [{after: 0, end: 9}, {after: 9, end: 9}]}",
            "optimizer.means_lr_aims must have growing after < end, got "
            "{after: 0, end: 9}, {after: 9, end: 9}",
        ),
        (
            "densify: {start: 900, stop: 800}",
            "densify.start must be < densify.stop (800), got 900",
        ),
        (
            "optimizer: {means_lr: 1e-5, means_lr_final: 1e-4}",
            "optimizer.means_lr_final must be <= optimizer.means_lr (1e-05), got 0.0001",
        ),
        (
            "densify: {adc: {prune_opacity: 0.01}}",
            "densify.adc.prune_opacity must be < densify.adc.reset_opacity (0.01), or a reset "
            "removes everything, got 0.01",
        ),
        (
            "densify: {max_gaussians: 500}\ninit: {num_points: 501}",
            "init.num_points must be <= densify.max_gaussians (500), got 501",
        ),
        (
            "cameras: {optimise: true}\nmodel: {sh_direction: pixel}",
            "model.sh_direction must be mean where cameras.optimise is true (colours along rays "
            "are not differentiated in the camera), got pixel",
        ),
    ],
)
def test_a_wrong_value_is_refused_with_file_key_expected_and_got(load, text, message):
    with pytest.raises(UserError) as error:
        load(MINIMAL + text)
    assert str(error.value) == f"scenes/x.yml: {message}"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "data: {path: x, background: grey}",
            "data.background must be white, black or three numbers in 0..1, got 'grey'",
        ),
        (
            "data: {path: x, background: [0, 0, 2]}",
            "data.background must be white, black or three numbers in 0..1, got [0, 0, 2]",
        ),
        (
            "data: {path: x, type: llff}",
            "data.type must be one of 'auto', 'nerf_synthetic', 'nerfstudio', 'colmap' (others "
            'come with installed packages that have an entry point of the group "drgs"), got '
            "'llff'",
        ),
        ("data: {}", "data.path is missing: Dataset folder; relative to the configuration file."),
        (
            "seed: 1",
            "data is missing: Photographs, cameras, and how to read them.",
        ),
        ("", "must hold sections such as 'data:', got null"),
        ("- 1", "must hold sections such as 'data:', got [1]"),
        ("seed: 1\nseed: 2", "line 2: not valid YAML: key seed is given twice"),
        ("a: " + "[" * 50_000, "not valid YAML: maximum recursion depth exceeded"),
        ("seed: 2001-02-31", "not valid YAML: day is out of range for month"),
        ("seed: !!int ''", "not valid YAML: string index out of range"),
        (
            "seed: \0",
            "not valid YAML: unacceptable character #x0000: special characters are not "
            'allowed in "<unicode string>", position 6',
        ),
        ("#" * 2**20 + "#", "cannot read the configuration: more than 1,048,576 bytes"),
        ("a:\n  - [1\nb: 2", "line 3: not valid YAML: expected ',' or ']', but got ':'"),
    ],
)
def test_a_wrong_file_is_refused(load, text, message):
    with pytest.raises(UserError) as error:
        load(text)
    assert str(error.value) == f"scenes/x.yml: {message}"


def test_several_wrong_values_are_reported_in_one_line(load):
    with pytest.raises(UserError) as error:
        load(MINIMAL + "densify: {every: 0, adc: {split_count: 1}}")
    assert str(error.value) == (
        "scenes/x.yml: densify.every must be >= 1, got 0; densify.adc.split_count must be >= 2, "
        "got 1"
    )


@pytest.mark.slow
def test_a_long_list_of_wrong_values_is_cut(load):
    with pytest.raises(UserError) as error:
        load(MINIMAL + "".join(f"k{i}: 1\n" for i in range(50_000)))
    assert str(error.value) == (
        "scenes/x.yml: unknown key k0; unknown key k1; unknown key k2 and 49,997 more"
    )


def test_wrong_value_with_newlines_is_shown_on_one_line(load):
    with pytest.raises(UserError) as error:
        load(MINIMAL + 'seed: ["a\\nb", 0x' + "f" * 9000 + ']\n"k\\ny": 2')
    assert str(error.value) == (
        "scenes/x.yml: seed must be an integer, got a number of thousands of digits; "
        "unknown key k y"
    )


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"none.yml: cannot read the configuration: No such file"):
        load_config(tmp_path / "none.yml")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["densify.every=0"], "--set densify.every: densify.every must be >= 1, got 0"),
        (
            ["densify.evry=9"],
            "--set densify.evry: unknown key densify.evry; did you mean densify.every?",
        ),
        (["seed"], "--set seed: must be KEY=VALUE, as in densify.every=200"),
        (["seed=["], "--set seed: not a YAML value: ["),
        (
            ["densify.stop=9", "densify.start=500"],
            "scenes/x.yml with --set densify.start densify.stop: densify.start must be < "
            "densify.stop (9), got 500",
        ),
    ],
)
def test_a_wrong_override_is_refused(load, overrides, message):
    with pytest.raises(UserError) as error:
        load(MINIMAL, *overrides)
    assert str(error.value) == message


def test_overrides_win_over_the_file_and_the_last_one_wins(load):
    config = load(
        MINIMAL + "seed: 1", "seed=2", "seed=3", "loss.sigma=2e0", "data.background=[0, 0.5, 1]"
    )
    assert config.seed == 3
    assert config.loss.sigma == 2.0
    assert config.data.background == config.data.background_rgb == (0.0, 0.5, 1.0)


def test_numbers_may_be_written_without_a_decimal_point(load):
    assert load(MINIMAL + "optimizer: {epsilon: 1e-8}").optimizer.epsilon == 1e-8


def test_paths_are_relative_to_the_file_and_in_overrides_to_the_current_folder(load, tmp_path):
    config = load("data: {path: ../here}\ninit: {point_cloud: ~/p.ply}", "output.dir=there")
    assert config.data.path == tmp_path.resolve() / "here"
    assert config.init.point_cloud == Path(os.path.expanduser("~/p.ply")).resolve()
    assert config.output.dir == tmp_path.resolve() / "there"


def test_overriding_path_need_not_be_valid_yaml(load):
    assert load(MINIMAL, "data.path=a: [b").data.path.name == "a: [b"
    assert load(MINIMAL, "data.path=2024").data.path.name == "2024"


def test_path_keys_list_every_path_field():
    paths = {name for name, field in fields_of(FitConfig) if "Path" in str(field.annotation)}
    assert paths == set(PATH_KEYS)
    assert set(PATH_KEYS) <= set(known_keys())


@pytest.mark.parametrize(
    "text",
    [
        MINIMAL,
        "data: {path: ../x, background: [0.1, 0.2, 0.3], image_size: 7}\n"
        "optimizer: {epsilon: 1e-15}\ninit: {half_extent: 0.1}\noutput: {dir: y}\n"
        "coarse: [{until: 5, factor: 4}, {until: 9, factor: 2}]",
    ],
)
def test_a_dumped_configuration_reloads_equal(load, tmp_path, text):
    config = load(text)
    dump_config(config, tmp_path / "out" / "config.yml")
    assert load_config(tmp_path / "out" / "config.yml") == config


@pytest.mark.parametrize("scene", SCENES, ids=lambda path: path.stem)
def test_shipped_configurations_load(scene):
    """Each names a shipped scene, or leaves the data to the user."""
    config = load_config(scene)
    shipped = config.data.path == REPOSITORY / "scenes" / "lego"
    assert shipped or config.data.path.is_relative_to(REPOSITORY / "data")
    assert shipped or config.data.source


@pytest.mark.parametrize("name", ["lego", "lego_mini", "fox", "photos"])
@pytest.mark.parametrize("overrides", [[], ["iterations=3000"], ["iterations=4300"]])
def test_last_opacity_reset_of_a_short_run_is_long_before_its_end(name, overrides):
    config = load_config(REPOSITORY / "scenes" / f"{name}.yml", overrides)
    densify = config.densify
    resets = [*range(densify.adc.reset_every, densify.stop, densify.adc.reset_every)]
    resets.append(densify.adc.white_background_reset)
    assert config.iterations - max(resets) >= 1200
