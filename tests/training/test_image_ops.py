"""Operations on pixels against numpy, their derivatives against formulas and each other."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    assert_arrays_agree,
    both_precisions,
    central_difference,
    single,
)
from support.kernels import float_reductions

from drgs.effects import colors, depth

HEIGHT, WIDTH = 13, 21

# Relative to the largest value of an array: sums of at most 273 products, with a rounding each.
TOLERANCE = {FLOAT64: 1e-14, FLOAT32: 2e-6}

# Central differences of functions that are linear or bilinear: exact but for the rounding of a
# difference of values of order 1 to 100 over a step of 1e-4.
STEP, DIFFERENCES = 1e-4, 1e-9


def random(*shape, seed=0) -> np.ndarray:
    """Normal numbers, the same in both precisions."""
    return single(np.random.default_rng([seed, *shape]).normal(size=shape))


def tensor(values, precision):
    return precision.TensorXf(precision.array(values), values.shape)


def to_numpy(value) -> np.ndarray:
    return np.array(value).astype(np.float64)


def depth_inputs():
    """Depths behind, before and, in three pixels, exactly at the target; some without weight."""
    rng = np.random.default_rng(3)
    alpha = single(rng.uniform(0.1, 1, (HEIGHT, WIDTH)))
    target = rng.integers(1, 5, (HEIGHT, WIDTH)).astype(np.float64)
    depth = single(alpha * target + rng.normal(0, 0.3, alpha.shape))
    alpha[0, :3], depth[0, :3] = 0.5, 0.5 * target[0, :3]
    weights = single(rng.uniform(0.5, 1, alpha.shape)) * (rng.uniform(size=alpha.shape) < 0.8)
    return np.stack([depth, alpha], axis=-1), target.ravel(), weights.ravel()


@dataclass
class Operation:
    """A function of pixels, by drgs and by numpy, and its inputs by name."""

    outputs: Callable  # a tuple
    expected: Callable  # the same, of numpy
    inputs: dict[str, np.ndarray]

    def device(self, precision, attached=()):
        """Return the inputs; those named in ``attached`` have derivatives."""
        found = {name: tensor(value, precision) for name, value in self.inputs.items()}
        for name in attached:
            dr.enable_grad(found[name])
        return found

    def directions(self):
        return {k: random(*v.shape, seed=20) for k, v in self.inputs.items()}


def split_operation(channels, count):
    return Operation(
        lambda image: depth.split(image, count),
        lambda image: (image[..., :count], image[..., count:]),
        {"image": random(HEIGHT, WIDTH, channels)},
    )


def depth_error(depths):
    of_type = FLOAT32 if dr.array_t(depths) is FLOAT32.Float else FLOAT64
    return (depth.depth_error(depths, of_type.array(TARGET), of_type.array(WEIGHTS)),)


def depth_error_in_numpy(depths):
    error = np.abs(depths[..., 0].ravel() - depths[..., 1].ravel() * TARGET)
    return (np.array([np.sum(WEIGHTS * error)]),)


DEPTHS, TARGET, WEIGHTS = depth_inputs()

OPERATIONS = {
    "split": split_operation(5, 3),
    "split off one": split_operation(4, 3),
    "transform_colors": Operation(
        lambda image, matrix: (colors.transform_colors(image, matrix),),
        lambda image, matrix: (np.einsum("ij,hwj->hwi", matrix[:, :3], image) + matrix[:, 3],),
        {"image": random(HEIGHT, WIDTH, 3), "matrix": random(3, 4)},
    ),
    "depth_error": Operation(depth_error, depth_error_in_numpy, {"depths": DEPTHS}),
}

all_operations = pytest.mark.parametrize("name", OPERATIONS)


def cotangents_of(operation):
    """One for each output; exact in single precision."""
    outputs = operation.expected(**operation.inputs)
    return [random(*output.shape, seed=10 + k) for k, output in enumerate(outputs)]


def gradients(operation, precision, cotangents, attached=None) -> dict[str, np.ndarray]:
    """Return gradients of sum(cotangents * outputs); attached: of these inputs alone."""
    attached = attached or operation.inputs
    inputs = operation.device(precision, attached)
    outputs = operation.outputs(**inputs)
    for output, cotangent in zip(outputs, cotangents, strict=True):
        is_tensor = dr.is_tensor_v(output)
        to_device = tensor(cotangent, precision) if is_tensor else precision.array(cotangent)
        dr.set_grad(output, to_device)
    dr.enqueue(dr.ADMode.Backward, outputs)
    dr.traverse(dr.ADMode.Backward)
    return {name: to_numpy(dr.grad(inputs[name])) for name in attached}


def tangents(operation, precision, directions) -> list[np.ndarray]:
    """Return tangents of the outputs, along directions of some of the inputs."""
    inputs = operation.device(precision, directions)
    for name, direction in directions.items():
        dr.set_grad(inputs[name], tensor(direction, precision))
    outputs = operation.outputs(**inputs)
    dr.forward_to(outputs)
    return [to_numpy(dr.grad(output)) for output in outputs]


@both_precisions
@all_operations
def test_values_match_numpy(name, precision):
    operation = OPERATIONS[name]
    actual = map(to_numpy, operation.outputs(**operation.device(precision)))
    expected = operation.expected(**operation.inputs)
    assert_arrays_agree(dict(enumerate(actual)), dict(enumerate(expected)), TOLERANCE[precision])


@all_operations
def test_backward_derivatives_equal_central_differences(name):
    """Differences of the value by numpy, at some of the numbers.

    The first six are those of depths exactly at the target: at a kink of |x| both slopes average
    to 0.
    """
    operation = OPERATIONS[name]
    cotangents = cotangents_of(operation)
    actual = gradients(operation, FLOAT64, cotangents)
    rng = np.random.default_rng(5)

    def loss(values, key):
        outputs = operation.expected(**operation.inputs | {key: values})
        return sum(np.sum(c * o) for c, o in zip(cotangents, outputs, strict=True))

    for key, values in operation.inputs.items():
        scale = np.abs(actual[key]).max()
        others = rng.choice(values.size, min(values.size, 30), replace=False)
        for flat in {*range(6), *others}:
            index = np.unravel_index(flat, values.shape)
            difference = central_difference(partial(loss, key=key), values, index, STEP)
            error = abs(actual[key][index] - difference)
            assert error <= DIFFERENCES * scale, (key, index, actual[key][index], difference)


@both_precisions
@all_operations
def test_forward_and_backward_derivatives_are_transposed(precision, name):
    """<J v, w> = <v, J^T w>."""
    operation = OPERATIONS[name]
    directions, cotangents = operation.directions(), cotangents_of(operation)
    forward = tangents(operation, precision, directions)
    backward = gradients(operation, precision, cotangents)
    left = [np.sum(c * f) for c, f in zip(cotangents, forward, strict=True)]
    right = [np.sum(directions[k] * g) for k, g in backward.items()]
    size = sum(np.abs(c * f).sum() for c, f in zip(cotangents, forward, strict=True))
    assert abs(sum(left) - sum(right)) <= TOLERANCE[precision] * size
    assert abs(sum(left)) > 1e-3 * size  # not two zeros


@pytest.mark.parametrize(
    ("method", "check"),
    [
        ("set_grad_in", test_backward_derivatives_equal_central_differences),
        ("set_grad_out", partial(test_forward_and_backward_derivatives_are_transposed, FLOAT32)),
    ],
    ids=["adjoint", "tangent"],
)
def test_comparison_detects_a_one_percent_error(monkeypatch, method, check):
    original = getattr(dr.CustomOp, method)

    def scaled(self, *arguments):
        *key, value = arguments
        both = isinstance(value, tuple)
        original(self, *key, tuple(1.01 * v for v in value) if both else 1.01 * value)

    # Private: the only operations with derivatives of their own here.
    for kind in (depth._Split, colors._TransformColors, depth._DepthError):
        monkeypatch.setattr(kind, method, scaled)
    for name in OPERATIONS:
        with pytest.raises(AssertionError):
            check(name)


@pytest.mark.parametrize("used", [0, 1])
def test_unused_half_of_a_split_has_no_derivative(used):
    image = OPERATIONS["split"].device(FLOAT32, ["image"])["image"]
    halves = depth.split(image, 3)
    weights = random(*halves[used].shape)
    dr.backward(dr.sum(halves[used] * tensor(weights, FLOAT32), axis=None))
    expected = np.zeros((HEIGHT, WIDTH, 5))
    expected[..., [slice(0, 3), slice(3, 5)][used]] = weights
    np.testing.assert_array_equal(to_numpy(dr.grad(image)), expected)


@pytest.mark.parametrize("attached", ["image", "matrix"])
def test_color_transform_supports_derivatives_of_one_input(attached):
    operation = OPERATIONS["transform_colors"]
    cotangents, direction = cotangents_of(operation), operation.directions()[attached]
    actual = gradients(operation, FLOAT32, cotangents, [attached])[attached]
    expected = gradients(operation, FLOAT32, cotangents)[attached]
    np.testing.assert_array_equal(actual, expected)
    zero = {name: np.zeros_like(value) for name, value in operation.inputs.items()}
    actual = tangents(operation, FLOAT32, {attached: direction})
    expected = tangents(operation, FLOAT32, {**zero, attached: direction})
    np.testing.assert_array_equal(actual, expected)


@both_precisions
@all_operations
def test_derivatives_use_no_float_atomics(name, precision):
    """Dr.Jit's derivative of a gather would be."""
    operation = OPERATIONS[name]
    results = {}
    found, count = float_reductions(
        lambda: results.update(gradients(operation, precision, cotangents_of(operation)))
    )
    assert results and not found and count >= 1
