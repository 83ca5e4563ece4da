"""Row surgery on Adam: what stays must not notice, what is new must start from nothing."""

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float, TensorXf, UInt32
from drjit.opt import Adam
from support.populations import rows_of

from drgs.core import adam
from drgs.core.adam import make_optimizer
from drgs.gaussians.parameters import PARAMETER_NAMES

RATES = {name: 0.01 * (k + 1) for k, name in enumerate(PARAMETER_NAMES)}


ROW_SHAPES = dict(zip(PARAMETER_NAMES, ((3,), (4,), (3,), (), (1, 3), (15, 3)), strict=True))


def parameters(num, seed=0):
    random, result = np.random.default_rng(seed), {}
    for name, shape in ROW_SHAPES.items():
        values = random.standard_normal((num, *shape)).astype(np.float32)
        result[name] = TensorXf(values) if shape else Float(values)
    return result


def step(optimizer, seed, rows):
    """One Adam step; row i gets a gradient that depends on seed and ``rows[i]`` alone."""
    for name, value in optimizer.items():
        random = np.random.default_rng([seed, len(name)])
        gradients = random.standard_normal((100, *ROW_SHAPES[name])).astype(np.float32)
        dr.set_grad(value, type(value)(gradients[rows]))
    optimizer.step()


def snapshot(optimizer):
    """Bytes of the value and both moments of every row, by parameter."""
    result = {}
    for key, (value, _, _, (_, m, v, _)) in optimizer.state.items():
        arrays = dr.detach(value).array, m, v
        result[key] = [np.array(array).reshape(value.shape[0], -1) for array in arrays]
    return result


def stepped(num=4, count=1):
    """An optimizer after some steps."""
    optimizer = make_optimizer(parameters(num), RATES)
    for seed in range(count):
        step(optimizer, seed, np.arange(num))
    return optimizer


def test_make_optimizer_sets_rates_and_leaves_out_empty_parameters():
    optimizer = make_optimizer(parameters(5) | {"shN": dr.zeros(TensorXf, (5, 0, 3))}, RATES)
    # Gradients of a mean over pixels are far below Adam's usual epsilon of 1e-8.
    assert isinstance(optimizer, Adam) and optimizer.epsilon == 1e-15
    assert list(optimizer.keys()) == list(PARAMETER_NAMES[:-1])
    for name in PARAMETER_NAMES[:-1]:
        assert optimizer.learning_rate(name) == RATES[name]
    with pytest.raises(ValueError, match="no learning rate for parameter quats"):
        make_optimizer(parameters(2), {"means": 1.0})


def test_steps_are_along_nesterov_s_momentum():
    """After Dozat 2016, in float64; the bias is that of the moment one step ahead."""
    optimizer, rows = make_optimizer(parameters(4), RATES), np.arange(4)
    value, first, second = parameters(4)["log_scales"].numpy().astype(np.float64), 0.0, 0.0
    for seed in range(5):
        step(optimizer, seed, rows)
        gradient = np.random.default_rng([seed, len("log_scales")]).standard_normal((100, 3))[:4]
        first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 0.001 * gradient**2
        ahead = (0.9 * first + 0.1 * gradient) / (1 - 0.9 ** (seed + 2))
        value -= RATES["log_scales"] * ahead / np.sqrt(second / (1 - 0.999 ** (seed + 1)))
        found, moment, _ = snapshot(optimizer)["log_scales"]
        # float32: values of about 1, and moments of about 0.3, after five steps.
        np.testing.assert_allclose(found, value, atol=2e-6)
        np.testing.assert_allclose(moment, first, atol=1e-6)


@pytest.mark.slow
def test_lean_steps_are_those_of_adam_and_use_large_gradients_up(monkeypatch):
    values = parameters(25_000)
    monkeypatch.setattr(adam, "LARGE_WIDTH", dr.width(values["shN"]))
    plain, ours = Adam(lr=0.0, epsilon=1e-15), adam.LeanAdam(lr=0.0, epsilon=1e-15)
    for name, value in values.items():
        for optimizer in (plain, ours):
            optimizer[name] = value
            optimizer.set_learning_rate({name: RATES[name]})
    for seed in range(2):
        former = dict(ours.items())
        for optimizer in (plain, ours):
            step(optimizer, seed, np.arange(25_000) % 100)
    for key, state in snapshot(ours).items():
        np.testing.assert_array_equal(np.stack(state), np.stack(snapshot(plain)[key]))
    left = {key for key, value in former.items() if np.any(np.array(dr.grad(value)))}
    assert left == set(ours) - {"shN"}


def test_moments_that_are_overwritten_are_those_that_are_not(monkeypatch):
    """Also after they were assigned, and while another array refers to them."""
    num, key = 25_000, "shN"
    results = []
    for large in (1 << 20, 1 << 40):
        monkeypatch.setattr(adam, "LARGE_WIDTH", large)
        optimizer = make_optimizer(parameters(num), RATES)
        step(optimizer, 0, np.arange(num) % 100)
        rows_of(optimizer).edit(dr.arange(UInt32, num) ^ 1, parameters(7))
        step(optimizer, 1, np.arange(num + 7) % 100)
        held = Float(optimizer.state[key][3][1])
        at_the_time = np.array(held)
        step(optimizer, 2, np.arange(num + 7) % 100)
        np.testing.assert_array_equal(np.array(held), at_the_time)
        rows_of(optimizer).replace("shN", optimizer[key] + 1)
        step(optimizer, 3, np.arange(num + 7) % 100)
        results.append(snapshot(optimizer))
    for key, arrays in results[0].items():
        np.testing.assert_array_equal(np.stack(arrays), np.stack(results[1][key]))


def test_edit_appends_rows_with_zero_moments_and_keeps_counts_rates_and_order():
    optimizer = stepped(count=2)
    optimizer.set_learning_rate({"means": 0.125})
    before, new, rates = snapshot(optimizer), parameters(3, seed=5), RATES | {"means": 0.125}
    rows_of(optimizer).edit(UInt32(3, 1), new)
    assert list(optimizer.keys()) == list(PARAMETER_NAMES)
    for name in PARAMETER_NAMES:
        value, *moments = snapshot(optimizer)[name]
        np.testing.assert_array_equal(value[:2], before[name][0][[3, 1]])
        np.testing.assert_array_equal(value[2:], new[name].numpy().reshape(3, -1))
        for moment, former in zip(moments, before[name][1:], strict=True):
            np.testing.assert_array_equal(moment[:2], former[[3, 1]])
            assert (moment[:2] != 0).all() and (moment[2:] == 0).all()
        assert optimizer[name].shape == (5, *ROW_SHAPES[name])
        assert optimizer.learning_rate(name) == rates[name]
        assert optimizer.state[name][3][0][0] == 2 and dr.grad_enabled(optimizer[name])


def test_edit_without_appending_and_without_keeping():
    optimizer = stepped()
    expected = snapshot(optimizer)["shN"][0][[2, 0]]
    rows_of(optimizer).edit(UInt32(2, 0))
    np.testing.assert_array_equal(snapshot(optimizer)["shN"][0], expected)
    new = parameters(3, seed=1)
    rows_of(optimizer).edit(UInt32(), new)
    np.testing.assert_array_equal(optimizer["means"].numpy(), new["means"].numpy())
    step(optimizer, 0, np.arange(3))


WITHOUT_QUATS = {name: value for name, value in parameters(2).items() if name != "quats"}

REFUSED_EDITS = [
    ([0, 4], None, "row numbers below 4"),
    ([], None, "at least one row must remain"),
    ([0], WITHOUT_QUATS, r"rows of quats must have the shape \(2, 4\), got none"),
    ([0], parameters(2) | {"sh0": parameters(3)["sh0"]}, r"means must have the shape \(3, 3\)"),
]


@pytest.mark.parametrize(("keep", "append", "message"), REFUSED_EDITS)
def test_misaligned_rows_are_refused(keep, append, message):
    with pytest.raises(ValueError, match=message):
        rows_of(stepped()).edit(UInt32(keep), append)


@pytest.mark.parametrize("keeps_moments", [False, True], ids=["replace", "set_values"])
def test_new_values_keep_step_count_and_rate(keeps_moments):
    """``set_values`` keeps the moments as well."""
    optimizer = stepped()
    before, rows = snapshot(optimizer), rows_of(optimizer)
    act = rows.set_values if keeps_moments else rows.replace
    act("logit_opacities", Float(1, 2, 3, 4))
    value, _, rate, (t, _, _, _) = optimizer.state["logit_opacities"]
    np.testing.assert_array_equal(value.numpy(), [1, 2, 3, 4])
    assert rate == RATES["logit_opacities"] and t[0] == 1 and dr.grad_enabled(value)
    after = snapshot(optimizer)
    for k in (1, 2):
        expected = before["logit_opacities"][k] * keeps_moments
        np.testing.assert_array_equal(after["logit_opacities"][k], expected)
        np.testing.assert_array_equal(after["means"][k], before["means"][k])
    with pytest.raises(ValueError, match=r"has shape \(4,\), the new values \(3,\)"):
        act("logit_opacities", Float(1, 2, 3))
