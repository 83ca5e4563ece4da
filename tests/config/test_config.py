import os
from pathlib import Path

import pytest
from conftest import REPOSITORY
from pydantic import BaseModel, ValidationError
from support.small_fits import make_trainer, plain_dataset

from drgs.config.approximations import Approximations
from drgs.config.changes import with_iterations
from drgs.config.load import PATH_KEYS, known_keys, load_config
from drgs.config.schema import FitConfig
from drgs.config.section import ExtensibleSection
from drgs.core.errors import UserError
from drgs.training.density.adc import AdcConfig

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
    for extension in model.extensions() if issubclass(model, ExtensibleSection) else ():
        yield from fields_of(extension.section, f"{prefix}{extension.name}.")


def test_lego_paper_is_the_reference_recipe():
    config = load_config(REPOSITORY / "scenes" / "lego_paper.yml")
    optimizer, densify, adc = config.optimizer, config.densify, config.densify.adc
    assert (optimizer.means_lr, optimizer.means_lr_final) == (1.6e-4, 1.6e-6)
    assert (optimizer.sh0_lr, optimizer.shN_lr, optimizer.opacities_lr) == (2.5e-3, 1.25e-4, 0.05)
    assert (optimizer.scales_lr, optimizer.quats_lr) == (5e-3, 1e-3)
    assert optimizer.decay == 1  # of all but the means, constant rates
    assert (densify.start, densify.stop, densify.every) == (500, 15_000, 100)
    assert (densify.strategy, densify.prune.to) == ("adc", None)
    assert (adc.grad_threshold, adc.prune_opacity, adc.reset_every) == (2e-4, 0.005, 3000)
    assert config.model.approximations == Approximations() and not config.model.smoothing
    assert config.iterations == 30_000 and config.coarse == []


@pytest.mark.parametrize(
    ("text", "start", "stop", "degree"),
    [
        ("iterations: 60000", 500, 45_000, 1000),
        ("iterations: 7000", 350, 5250, 1000),
        ("iterations: 3", 1, 2, 1),
        ("iterations: 1", 0, 1, 1),
        ("iterations: 60000\ndensify: {strategy: adc}", 500, 15_000, 1000),
        ("iterations: 7000\ndensify: {strategy: mcmc}", 350, 5000, 1000),
        ("iterations: 7000\ndensify: {strategy: adc}", 500, 5000, 1000),
        ("iterations: 700\ndensify: {strategy: adc}", 250, 500, 105),
        ("densify: {start: 400}\nmodel: {sh_increase_every: 900}\niterations: 500", 400, 401, 900),
        ("densify: {stop: 90}\niterations: 500", 25, 90, 75),
    ],
)
def test_schedule_and_decay_follow_from_iterations_and_strategy(load, text, start, stop, degree):
    config = load(MINIMAL + text)
    assert (config.densify.start, config.densify.stop) == (start, stop)
    assert config.model.sh_increase_every == degree
    expected = {"adc": 1, "mcmc": 0.1, "budget": 0.03}
    assert config.optimizer.decay == expected[config.densify.strategy]


def test_shorter_schedule_is_scaled_in_proportion():
    """A fit of fewer iterations has the same schedule; what is off stays off."""
    config = FitConfig(
        data={"path": "."},
        iterations=30_000,
        coarse=[{"until": 3000, "factor": 2}],
        cameras={"start": 1000},
        densify={"adc": {}},
        seed=7,
    )
    short = with_iterations(config, 6000)
    assert short.iterations == 6000 and short.seed == 7
    assert (short.densify.start, short.densify.stop, short.densify.every) == (100, 4500, 100)
    assert short.sections["cameras"].start == 200
    assert (short.densify.adc.reset_every, short.densify.adc.white_background_reset) == (600, 100)
    assert short.densify.adc.grad_threshold == config.densify.adc.grad_threshold
    assert short.model.sh_increase_every == 200 and short.coarse[0].until == 600
    assert with_iterations(short, 30_000) == config
    config = FitConfig(data={"path": "."}, densify={"adc": {"white_background_reset": None}})
    short = with_iterations(config, 30)
    assert short.densify.adc.white_background_reset is None
    assert (short.densify.start, short.densify.stop, short.model.sh_increase_every) == (1, 22, 1)


def test_values_cannot_be_changed(load):
    with pytest.raises(ValidationError, match="frozen"):
        load(MINIMAL).iterations = 3


MORE = ' (others come with installed packages that have an entry point of the group "drgs"), got '
WRONG_VALUES = [
    ("densify: {every: 0}", "densify.every must be >= 1, got 0"),
    ("densify: {evry: 3}", "unknown key densify.evry; did you mean densify.every?"),
    ("grad_threshold: 3", "unknown key grad_threshold; did you mean densify.adc.grad_threshold?"),
    (
        "densify: {splt_count: 3}",
        "unknown key densify.splt_count; did you mean densify.adc.split_count?",
    ),
    ("zzz: 3", "unknown key zzz"),
    (
        "densify: {strategy: abc}",
        f"densify.strategy must be one of 'adc', 'budget', 'mcmc'{MORE}'abc'",
    ),
    ("iterations: 1.5", "iterations must be an integer, got 1.5"),
    ("iterations: '7'", "iterations must be an integer, got '7'"),
    ("seed: 3000000000", "seed must be <= 2147483647, got 3000000000"),
    (
        "output: {dir: ~not-a-user/x}",
        "output.dir must be a path, got '~not-a-user/x' (Could not determine home directory.)",
    ),
    (
        'output: {dir: "\\0"}',
        "output.dir must be a path in UTF-8 without zero bytes, got '\\x00'",
    ),
    ("loss: {dssim_weight: big}", "loss.dssim_weight must be a number, got 'big'"),
    ("loss: {dssim_weight: .inf}", "loss.dssim_weight must be a finite number, got .inf"),
    (
        "loss: {window: 7, sigma: 1.5}",
        "loss.window must be 11, its only value since 0.1.0 (CHANGELOG.md), got 7",
    ),
    ("init: {opacity: 1}", "init.opacity must be <= 0.999999, got 1"),
    ("model: {antialiased: some}", "model.antialiased must be true or false, got 'some'"),
    ("model:", "model must be a section of keys, got null"),
    ("output: {dir: [1]}", "output.dir must be a path, got [1]"),
    ("coarse: 4", "coarse must be a list, got 4"),
    ("coarse: [{until: 9, factor: 1}]", "coarse.0.factor must be >= 2, got 1"),
    ("coarse: [{until: 9}]", "coarse.0.factor is missing: Width and height are divided by this."),
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
        "optimizer: {means_lr_aims: [9]}",
        "optimizer.means_lr_aims must be [], its only value since 0.1.0 (CHANGELOG.md), got [9]",
    ),
    ("densify: {start: 900, stop: 800}", "densify.start must be < densify.stop (800), got 900"),
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
    (
        "densify: {every: 0, adc: {split_count: 1}}",
        "densify.every must be >= 1, got 0; densify.adc.split_count must be >= 2, got 1",
    ),
    (
        'seed: ["a\\nb", 0x' + "f" * 9000 + ']\n"k\\ny": 2',
        "seed must be an integer, got a number of thousands of digits; unknown key k y",
    ),
    (
        "".join(f"k{i}: 1\n" for i in range(5000)),
        "unknown key k0; unknown key k1; unknown key k2 and 4,997 more",
    ),
]


@pytest.mark.parametrize(("text", "message"), WRONG_VALUES, ids=[m[:40] for _, m in WRONG_VALUES])
def test_a_wrong_value_is_refused_with_file_key_expected_and_got(load, text, message):
    with pytest.raises(UserError) as error:
        load(MINIMAL + text)
    assert str(error.value) == f"scenes/x.yml: {message}"


BACKGROUND = "data.background must be white, black or three numbers in 0..1, got "
WRONG_FILES = [
    ("data: {path: x, background: grey}", f"{BACKGROUND}'grey'"),
    ("data: {path: x, background: [0, 0, 2]}", f"{BACKGROUND}[0, 0, 2]"),
    (
        "data: {path: x, type: blender}",
        "data.type must be one of 'auto', '3dgs', 'colmap', 'llff', 'metashape', 'nerf_synthetic', "
        f"'nerfstudio', 'opensfm'{MORE}'blender'",
    ),
    ("data: {}", "data.path is missing: Dataset folder; relative to the configuration file."),
    ("seed: 1", "data is missing: Photographs, cameras, and how to read them."),
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
]


@pytest.mark.slow
@pytest.mark.parametrize(("text", "message"), WRONG_FILES, ids=[m[:40] for _, m in WRONG_FILES])
def test_a_wrong_file_is_refused(load, text, message):
    with pytest.raises(UserError) as error:
        load(text)
    assert str(error.value) == f"scenes/x.yml: {message}"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["densify.every=0"], "--set densify.every: densify.every must be >= 1, got 0"),
        (["seeds=9"], "--set seeds: unknown key seeds; did you mean seed?"),
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
    """Paths need not be valid YAML; numbers may lack a decimal point."""
    given = (
        "optimizer.decay=0.5",
        "densify.strategy=adc",
        "seed=2",
        "seed=3",
        "loss.dssim_weight=1e0",
        "data.background=[0, 0.5, 1]",
    )
    config = load(MINIMAL + "seed: 1\noptimizer: {means_lr_final: 1e-8}", *given, "data.path=a: [b")
    assert (config.seed, config.loss.dssim_weight) == (3, 1.0)
    assert config.optimizer.means_lr_final == 1e-8
    assert config.data.background == config.data.background_rgb == (0.0, 0.5, 1.0)
    assert config.data.path.name == "a: [b" and config.optimizer.decay == 0.5
    assert load(MINIMAL, "data.path=2024").data.path.name == "2024"


def test_paths_are_relative_to_the_file_and_in_overrides_to_the_current_folder(load, tmp_path):
    config = load("data: {path: ../here}\ninit: {point_cloud: ~/p.ply}", "output.dir=there")
    assert config.data.path == tmp_path.resolve() / "here"
    assert config.init.point_cloud == Path(os.path.expanduser("~/p.ply")).resolve()
    assert config.output.dir == tmp_path.resolve() / "there"


def test_every_value_is_described_and_every_path_listed():
    assert all(field.description for _, field in fields_of(FitConfig))
    paths = {name for name, field in fields_of(FitConfig) if "Path" in str(field.annotation)}
    assert paths == set(PATH_KEYS) and paths <= set(known_keys())


@pytest.mark.parametrize("scene", SCENES, ids=lambda path: path.stem)
def test_shipped_configurations_load(scene):
    """Each names a shipped scene, or leaves the data to the user."""
    config = load_config(scene)
    shipped = config.data.path == REPOSITORY / "scenes" / "lego"
    assert shipped or config.data.path.is_relative_to(REPOSITORY / "data")
    assert shipped or config.data.source


@pytest.mark.parametrize("name", ["lego", "lego_mini", "fox", "photos"])
def test_last_opacity_reset_of_a_short_run_is_long_before_its_end(name):
    for overrides in ([], ["iterations=3000"], ["iterations=4300"]):
        config = load_config(REPOSITORY / "scenes" / f"{name}.yml", overrides)
        adc = AdcConfig()
        resets = range(adc.reset_every, config.densify.stop, adc.reset_every)
        assert config.iterations - max([*resets, adc.white_background_reset]) >= 1200


UNLIMITED = {"model.low_pass", "densify.adc.grad_threshold", "densify.adc.clone_scale",
             "densify.adc.prune_scale", "densify.adc.split_shrink"}  # fmt: skip
"""Compared with, or finite in float32, however large they are."""

UNFITTED = ("data.", "output.", "coarse")


def test_every_number_of_a_fit_has_two_limits():
    for key, field in fields_of(FitConfig):
        if field.annotation not in (float, float | None) or key.startswith(UNFITTED):
            continue
        low, high = (
            any(hasattr(limit, name) for limit in field.metadata for name in names)
            for names in (("ge", "gt"), ("le", "lt"))
        )
        assert low and (high or key in UNLIMITED), key


def test_diverging_focal_lengths_are_an_error_naming_their_rate():
    trainer = make_trainer(plain_dataset(), cameras__optimise=True, cameras__focal_lr=1.0)
    (effect,) = (e for e in trainer.effects if e.name == "cameras")
    assert effect.lens_change.focal == (1, 1)
    state = effect.state()
    state["log_focals.value"][:] = 88
    effect.restore(state)
    with pytest.raises(
        UserError, match=r"cameras.focal_lr: .* up to 1000, got e to the power of 88"
    ):
        effect.correct_views(())
