"""Row surgery on Adam: what stays must not notice, what is new must start from nothing."""

import math

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float, TensorXf, TensorXf64, UInt32
from drjit.opt import Adam
from support.populations import rows_of
from support.small_fits import kernel_hashes

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.training import optimizer as optimizer_module
from drgs.training.optimizer import (
    LARGE_WIDTH,
    make_optimizer,
)

RATES = {name: 0.01 * (k + 1) for k, name in enumerate(PARAMETER_NAMES)}


def row_shapes(sh_rows=15):
    return {
        "means": (3,),
        "quats": (4,),
        "log_scales": (3,),
        "logit_opacities": (),
        "sh0": (1, 3),
        "shN": (sh_rows, 3),
    }


def parameters(num, sh_rows=15, seed=0, tensor_type=TensorXf):
    random = np.random.default_rng(seed)
    flat_type = dr.array_t(tensor_type)
    result = {}
    for name, shape in row_shapes(sh_rows).items():
        flat = flat_type(random.standard_normal(num * math.prod(shape)))
        result[name] = tensor_type(flat, (num, *shape)) if shape else flat
    return result


def step(optimizer, seed, rows):
    """One Adam step; row i gets a gradient that depends on seed and ``rows[i]`` alone."""
    for name, shape in row_shapes().items():
        if name not in optimizer:
            continue
        value = optimizer[name]
        table = np.random.default_rng([seed, len(name)]).standard_normal((100, *shape))
        gradient = type(value)(table[rows].astype(np.float32))
        dr.set_grad(value, gradient)
    optimizer.step()


def snapshot(optimizer):
    """Bytes of the value and both moments of every row, by parameter."""
    result = {}
    for key, (value, _, _, (_, m, v, _)) in optimizer.state.items():
        num = value.shape[0]
        flat = dr.detach(value).array
        result[key] = [np.array(array).reshape(num, -1) for array in (flat, m, v)]
    return result


def stepped(num=4, count=1):
    """An optimizer after some steps."""
    optimizer = make_optimizer(parameters(num), RATES)
    for seed in range(count):
        step(optimizer, seed, np.arange(num))
    return optimizer


def test_make_optimizer_sets_rates_and_leaves_out_empty_parameters():
    optimizer = make_optimizer(parameters(5, sh_rows=0), RATES)
    # Gradients of a mean over pixels are far below Adam's usual epsilon of 1e-8.
    assert isinstance(optimizer, Adam) and optimizer.epsilon == 1e-15
    assert list(optimizer.keys()) == list(PARAMETER_NAMES[:-1])
    for name in PARAMETER_NAMES[:-1]:
        assert optimizer.learning_rate(name) == RATES[name]
    with pytest.raises(ValueError, match="no learning rate for parameter quats"):
        make_optimizer(parameters(2), {"means": 1.0})


@pytest.mark.slow
def test_steps_are_those_of_adam_and_use_large_gradients_up():
    values = parameters(25_000)
    assert dr.width(values["shN"]) > LARGE_WIDTH > dr.width(values["quats"])
    plain, ours = Adam(lr=0.0, epsilon=1e-15), make_optimizer(values, RATES)
    for name, value in values.items():
        plain[name] = value
        plain.set_learning_rate({name: RATES[name]})
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
    for large in (LARGE_WIDTH, 1 << 40):
        monkeypatch.setattr(optimizer_module, "LARGE_WIDTH", large)
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


@pytest.mark.parametrize("tensor_type", [TensorXf, TensorXf64])
def test_surviving_rows_continue_bitwise(tensor_type):
    def run(edit):
        optimizer = make_optimizer(parameters(20, tensor_type=tensor_type), RATES)
        rows = np.arange(20)
        for seed in range(3):
            step(optimizer, seed, rows)
        if edit:
            keep = [0, 3, 4, 7, 19]
            new = parameters(6, seed=9, tensor_type=tensor_type)
            rows_of(optimizer).edit(UInt32(keep), new)
            rows = np.array([*keep, 50, 51, 52, 53, 54, 55])
        for seed in range(3, 7):
            step(optimizer, seed, rows)
        return snapshot(optimizer)

    edited, untouched = run(edit=True), run(edit=False)
    for key, arrays in edited.items():
        for array, original in zip(arrays, untouched[key], strict=True):
            assert array.shape[0] == 11
            assert array[:5].tobytes() == original[[0, 3, 4, 7, 19]].tobytes(), key


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
        assert optimizer[name].shape == (5, *row_shapes()[name])
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
    (
        *([0], parameters(2) | {"sh0": parameters(3)["sh0"]}),
        r"rows of means must have the shape \(3, 3\)",
    ),
]


@pytest.mark.parametrize(("keep", "append", "message"), REFUSED_EDITS)
def test_misaligned_rows_are_refused(keep, append, message):
    with pytest.raises(ValueError, match=message):
        rows_of(stepped()).edit(UInt32(keep), append)


def test_later_edits_of_other_sizes_compile_no_kernel():
    def kernels(num, keep, added):
        optimizer = make_optimizer(parameters(num), RATES)
        # Memory of Dr.Jit's own: kernels that read numpy's also depend on its alignment.
        new = {name: value + 1 for name, value in parameters(added).items()}
        dr.eval(new)
        return kernel_hashes(lambda: rows_of(optimizer).edit(dr.arange(UInt32, keep), new))

    first = kernels(40, 30, 9)
    assert first and kernels(70, 41, 22) == first


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
