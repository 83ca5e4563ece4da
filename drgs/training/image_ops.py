"""What stands between a rendered image and a photograph: operations on pixels, with their adjoints.

Dr.Jit differentiates a gather by adding atomically, in an order that no two runs share. These
operations are written so that no derivative is scattered.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from drgs.core.arrays import image_of, planes_of, types_of


def split(image: Any, count: int) -> tuple[Any, Any]:
    """The first ``count`` channels of an image (H, W, C), and the others."""
    return dr.custom(_Split, image=image, count=count)


class _Split(dr.CustomOp):
    def eval(self, image: Any, count: int) -> tuple[Any, Any]:
        self.count = count
        planes = planes_of(image)
        return image_of(planes[:count], image), image_of(planes[count:], image)

    def forward(self) -> None:
        tangent = planes_of(self.grad_in("image"))
        like = self.grad_in("image")
        self.set_grad_out(
            (image_of(tangent[: self.count], like), image_of(tangent[self.count :], like))
        )

    def backward(self) -> None:
        first, rest = self.grad_out()
        self.set_grad_in("image", image_of(planes_of(first) + planes_of(rest), first))


def transform_colors(image: Any, matrix: Any) -> Any:
    """A y with y = (red, green, blue, 1) of each pixel.

    image: (H, W, 3); matrix: A, a tensor (3, 4). Differentiable in both.
    """
    return dr.custom(_TransformColors, image=image, matrix=matrix)


class _TransformColors(dr.CustomOp):
    def eval(self, image: Any, matrix: Any) -> Any:
        self.image, self.matrix = dr.detach(image), dr.detach(matrix)
        return self._transformed(planes_of(image), self._rows(self.matrix))

    def forward(self) -> None:
        d_image, d_matrix = self.grad_in("image"), self.grad_in("matrix")
        rows = [[*row[:3], 0] for row in self._rows(self.matrix)]
        moved = self._transformed(planes_of(d_image), rows)
        turned = self._transformed(planes_of(self.image), self._rows(d_matrix))
        self.set_grad_out(moved + turned)

    def backward(self) -> None:
        g = planes_of(self.grad_out())
        rows, inputs = self._rows(self.matrix), planes_of(self.image)
        d_planes = [sum(rows[i][j] * g[i] for i in range(3)) for j in range(3)]
        self.set_grad_in("image", image_of(d_planes, self.image))
        products = [d * x for d in g for x in (*inputs, 1)]
        dr.eval(products)
        d_matrix = dr.concat([dr.sum(product) for product in products])
        self.set_grad_in("matrix", type(self.matrix)(d_matrix, (3, 4)))

    def _transformed(self, planes: list[Any], rows: list[list[Any]]) -> Any:
        moved = [sum(a * x for a, x in zip(row, (*planes, 1), strict=True)) for row in rows]
        return image_of(moved, self.image)

    @staticmethod
    def _rows(matrix: Any) -> list[list[Any]]:
        """The numbers as arrays of one entry, that are not compiled into the kernel."""
        flat = matrix.array
        UInt32 = types_of(type(flat)).UInt32
        return [
            [dr.gather(type(flat), flat, UInt32(4 * i + j)) for j in range(4)] for i in range(3)
        ]


def depth_error(depths: Any, target: Any, weights: Any) -> Any:
    """sum_i w_i |D_i - A_i d_i| over pixels, a Float of one value.

    depths: (H, W, 2), the composited depth D and alpha A; target: d, Float (H * W,), in the units
    of D; weights: w, Float (H * W,). Not normalised by alpha, the difference stays finite where
    nothing is. The derivative of |x| at 0 is taken as 0. Not differentiated: target and weights.
    """
    return dr.custom(_DepthError, depths=depths, target=target, weights=weights)


class _DepthError(dr.CustomOp):
    def eval(self, depths: Any, target: Any, weights: Any) -> Any:
        self.like, self.target, self.weights = dr.detach(depths), target, weights
        depth, alpha = planes_of(depths)
        difference = dr.fma(-alpha, target, depth)
        self.slope = weights * dr.select(difference == 0, 0, dr.sign(difference))
        return dr.sum(weights * dr.abs(difference))

    def forward(self) -> None:
        d_depth, d_alpha = planes_of(self.grad_in("depths"))
        self.set_grad_out(dr.sum(self.slope * dr.fma(-d_alpha, self.target, d_depth)))

    def backward(self) -> None:
        g = self.slope * self.grad_out()
        self.set_grad_in("depths", image_of([g, -g * self.target], self.like))
