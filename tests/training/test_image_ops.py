"""Operations on pixels against numpy, their derivatives against formulas and each other."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
import pytest
from support.helpers import FLOAT32, FLOAT64, assert_arrays_agree, both_precisions, single
from support.kernels import float_reductions
from support.small_fits import kernel_hashes

from drgs.training.effects import colors, depth

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

    apply: Callable
    numpy: Callable
    inputs: dict[str, np.ndarray]

    def outputs(self, inputs):
        result = self.apply(**inputs)
        return result if isinstance(result, tuple) else (result,)

    def expected(self, inputs):
        result = self.numpy(**inputs)
        return result if isinstance(result, tuple) else (result,)

    def device(self, precision, attached=()):
        """Return the inputs; those named in ``attached`` have derivatives."""
        found = {name: tensor(value, precision) for name, value in self.inputs.items()}
        for name in attached:
            dr.enable_grad(found[name])
        return found


def split_operation(channels, count):
    return Operation(
        lambda image: depth.split(image, count),
        lambda image: (image[..., :count], image[..., count:]),
        {"image": random(HEIGHT, WIDTH, channels)},
    )


def transform_operation():
    return Operation(
        colors.transform_colors,
        lambda image, matrix: np.einsum("ij,hwj->hwi", matrix[:, :3], image) + matrix[:, 3],
        {"image": random(HEIGHT, WIDTH, 3), "matrix": random(3, 4)},
    )


def depth_operation():
    depths, target, weights = depth_inputs()

    def apply(depths):
        of_type = FLOAT32 if dr.array_t(depths) is FLOAT32.Float else FLOAT64
        return depth.depth_error(depths, of_type.array(target), of_type.array(weights))

    def numpy(depths):
        depth, alpha = depths[..., 0].ravel(), depths[..., 1].ravel()
        return np.array([np.sum(weights * np.abs(depth - alpha * target))])

    return Operation(apply, numpy, {"depths": depths})


OPERATIONS = {
    "split": split_operation(5, 3),
    "split off one": split_operation(4, 3),
    "transform_colors": transform_operation(),
    "depth_error": depth_operation(),
}

all_operations = pytest.mark.parametrize("name", OPERATIONS)


def cotangents_of(operation):
    """One for each output; exact in single precision."""
    outputs = operation.expected(operation.inputs)
    return [random(*output.shape, seed=10 + k) for k, output in enumerate(outputs)]


def gradients(operation, precision, cotangents, attached=None) -> dict[str, np.ndarray]:
    """Return gradients of sum(cotangents * outputs); attached: of these inputs alone."""
    attached = attached or operation.inputs
    inputs = operation.device(precision, attached)
    outputs = operation.outputs(inputs)
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
    outputs = operation.outputs(inputs)
    dr.forward_to(outputs)
    return [to_numpy(dr.grad(output)) for output in outputs]


def random_directions(operation):
    return {k: random(*v.shape, seed=20) for k, v in operation.inputs.items()}


def assert_outputs_agree(actual, expected, tolerance):
    assert_arrays_agree(dict(enumerate(actual)), dict(enumerate(expected)), tolerance)


@both_precisions
@all_operations
def test_values_match_numpy(name, precision):
    operation = OPERATIONS[name]
    actual = operation.outputs(operation.device(precision))
    expected = operation.expected(operation.inputs)
    assert_outputs_agree(map(to_numpy, actual), expected, TOLERANCE[precision])


@all_operations
def test_backward_derivatives_equal_central_differences(name):
    """Differences of the value by numpy, at some of the numbers. At a kink of |x| both slopes
    average to 0."""
    operation = OPERATIONS[name]
    cotangents = cotangents_of(operation)
    actual = gradients(operation, FLOAT64, cotangents)
    rng = np.random.default_rng(5)

    def loss(inputs):
        outputs = operation.expected(inputs)
        return sum(np.sum(c * o) for c, o in zip(cotangents, outputs, strict=True))

    for key, values in operation.inputs.items():
        scale = np.abs(actual[key]).max()
        for flat in rng.choice(values.size, min(values.size, 30), replace=False):
            moved = []
            for sign in (1, -1):
                other = values.copy()
                other.flat[flat] += sign * STEP
                moved.append(loss(operation.inputs | {key: other}))
            difference = (moved[0] - moved[1]) / (2 * STEP)
            error = abs(actual[key].flat[flat] - difference)
            assert error <= DIFFERENCES * scale, (key, flat, actual[key].flat[flat], difference)


@both_precisions
@all_operations
def test_forward_derivatives_equal_central_differences(name, precision):
    operation = OPERATIONS[name]
    directions = random_directions(operation)
    actual = tangents(operation, precision, directions)
    # |x| has kinks; no difference of depths is as close to one as this step reaches, but those
    # that are zero, where the derivative is taken as 0: as the mean of both sides is.
    step = 1e-6

    def at(sign):
        moved = {k: v + sign * step * directions[k] for k, v in operation.inputs.items()}
        return operation.expected(moved)

    expected = [(a - b) / (2 * step) for a, b in zip(at(1), at(-1), strict=True)]
    # A step of 1e-6 amplifies roundings of float64 to 1e-10 of values up to 100.
    tolerance = max(TOLERANCE[precision], 1e-8)
    assert_outputs_agree(actual, expected, tolerance)


@both_precisions
@all_operations
def test_forward_and_backward_derivatives_are_transposed(name, precision):
    """<J v, w> = <v, J^T w>."""
    operation = OPERATIONS[name]
    directions, cotangents = random_directions(operation), cotangents_of(operation)
    forward = tangents(operation, precision, directions)
    backward = gradients(operation, precision, cotangents)
    left = [np.sum(c * f) for c, f in zip(cotangents, forward, strict=True)]
    right = [np.sum(directions[k] * g) for k, g in backward.items()]
    size = sum(np.abs(c * f).sum() for c, f in zip(cotangents, forward, strict=True))
    assert abs(sum(left) - sum(right)) <= TOLERANCE[precision] * size
    assert abs(sum(left)) > 1e-3 * size  # not two zeros


def test_comparisons_detect_one_percent_errors(monkeypatch):
    """Adjoints and tangents are scaled."""
    for method in ("set_grad_in", "set_grad_out"):
        original = getattr(dr.CustomOp, method)

        def scaled(self, *arguments, original=original):
            *key, value = arguments
            both = isinstance(value, tuple)
            original(self, *key, tuple(1.01 * v for v in value) if both else 1.01 * value)

        # Private: the only operations with derivatives of their own here.
        for kind in (depth._Split, colors._TransformColors, depth._DepthError):
            monkeypatch.setattr(kind, method, scaled)
    for name in OPERATIONS:
        with pytest.raises(AssertionError):
            test_backward_derivatives_equal_central_differences(name)
        with pytest.raises(AssertionError):
            test_forward_derivatives_equal_central_differences(name, FLOAT32)


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
    cotangents, direction = cotangents_of(operation), random_directions(operation)[attached]
    actual = gradients(operation, FLOAT32, cotangents, [attached])[attached]
    expected = gradients(operation, FLOAT32, cotangents)[attached]
    np.testing.assert_array_equal(actual, expected)
    zero = {name: np.zeros_like(value) for name, value in operation.inputs.items()}
    actual = tangents(operation, FLOAT32, {attached: direction})
    expected = tangents(operation, FLOAT32, {**zero, attached: direction})
    np.testing.assert_array_equal(actual, expected)


def test_equal_depths_have_no_slope():
    """In the three pixels where depth is exactly alpha times the target's."""
    operation = OPERATIONS["depth_error"]
    gradient = gradients(operation, FLOAT32, [np.ones(1)])["depths"]
    weights = depth_inputs()[2].reshape(HEIGHT, WIDTH)
    assert (gradient[0, :3] == 0).all()
    assert ((gradient[..., 0] != 0) == (weights > 0))[1:].all()


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


def test_matrix_is_no_kernel_literal():
    """Each step of its optimizer would compile its own."""
    operation, cotangents = OPERATIONS["transform_colors"], [random(HEIGHT, WIDTH, 3)]

    def hashes(factor):
        inputs = {**operation.inputs, "matrix": factor * random(3, 4)}
        changed = replace(operation, inputs=inputs)
        return kernel_hashes(lambda: gradients(changed, FLOAT32, cotangents))

    assert hashes(1.0) == hashes(0.5)
