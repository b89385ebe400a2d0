"""The weighted bilinear sampling of deformable attention in one pass over memory, forward and backward.

Where the plain path writes every sampled value to memory, a fused one keeps a head's sum in vector registers.  numba
compiles it at the first call for the machine it runs on; `sample_plain` is its oracle.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray
from torch import Tensor

Floats = NDArray[np.float32]
_FAST = {"contract", "nsz", "arcp", "reassoc"}  # not nnan: an undefined location must stay outside
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)


def _pointer(context: Any, builder: ir.IRBuilder, kind: Any, value: Any) -> Any:
    return cgutils.create_struct_proxy(kind)(context, builder, value).data


def _broadcast(builder: ir.IRBuilder, scalar: Any, vector: ir.VectorType) -> Any:
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(ir.IntType(32), 0))
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), vector.count), [0] * vector.count)
    return builder.shuffle_vector(first, undefined, lanes)


@intrinsic
def sum_rows(typing_context, out, at, value, index, weight, count, width):  # type: ignore[no-untyped-def]
    """out[at : at + D] = sum_i weight[i] value[index[i] : index[i] + D] with D = len(width), i < 4 count."""
    vector = ir.VectorType(ir.FloatType(), len(width))
    signature = types.void(out, types.intp, value, index, weight, types.intp, width)

    def generate(context: Any, builder: ir.IRBuilder, sig: Any, args: Any) -> Any:
        out_p, value_p, index_p, weight_p = (_pointer(context, builder, sig.args[i], args[i]) for i in (0, 2, 3, 4))
        sums = [cgutils.alloca_once_value(builder, ir.Constant(vector, None)) for _ in range(4)]
        word = ir.IntType(64)
        with cgutils.for_range(builder, args[5]) as loop:
            for corner in range(4):  # four sums: a single one would wait for itself
                position = builder.add(builder.mul(loop.index, word(4)), word(corner))
                row = builder.sext(builder.load(builder.gep(index_p, [position])), word)
                share = _broadcast(builder, builder.load(builder.gep(weight_p, [position])), vector)
                values = builder.load(builder.bitcast(builder.gep(value_p, [row]), vector.as_pointer()), align=4)
                product = builder.fmul(share, values, flags=("contract",))
                total = builder.fadd(builder.load(sums[corner]), product, flags=("contract",))
                builder.store(total, sums[corner])
        a, b, c, d = (builder.load(total) for total in sums)
        total = builder.fadd(builder.fadd(a, b), builder.fadd(c, d))
        builder.store(total, builder.bitcast(builder.gep(out_p, [args[1]]), vector.as_pointer()), align=4)
        return context.get_dummy_value()

    return signature, generate


@numba.njit(fastmath=_FAST, error_model="numpy", inline="always")
def corner_rows(x, y, share, width, height, start, stride, offset, index, weight, at):  # type: ignore[no-untyped-def]
    """Write the four rows and weights of one bilinear sample at cell x, y of a level; zeros outside."""
    left, top = np.floor(x), np.floor(y)
    fx, fy = x - left, y - top
    right, bottom = left + _ONE, top + _ONE
    last_x, last_y = width - _ONE, height - _ONE
    x0 = left if left > _ZERO else _ZERO  # each comparison is false for an undefined location
    x0 = x0 if x0 < last_x else last_x
    x1 = right if right > _ZERO else _ZERO
    x1 = x1 if x1 < last_x else last_x
    y0 = top if top > _ZERO else _ZERO
    y0 = y0 if y0 < last_y else last_y
    y1 = bottom if bottom > _ZERO else _ZERO
    y1 = y1 if y1 < last_y else last_y
    wx0 = _ONE - fx if left == x0 else _ZERO
    wx1 = fx if right == x1 else _ZERO
    wy0 = (_ONE - fy) * share if top == y0 else _ZERO
    wy1 = fy * share if bottom == y1 else _ZERO
    above, below = start + y0 * width, start + y1 * width
    weight[at] = wx0 * wy0
    weight[at + 1] = wx1 * wy0
    weight[at + 2] = wx0 * wy1
    weight[at + 3] = wx1 * wy1
    index[at] = np.int32(above + x0) * stride + offset
    index[at + 1] = np.int32(above + x1) * stride + offset
    index[at + 2] = np.int32(below + x0) * stride + offset
    index[at + 3] = np.int32(below + x1) * stride + offset


@numba.njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def _forward(value, levels, locations, weights, out, width, first, last):  # type: ignore[no-untyped-def]
    """value (S M D,), levels (3, K) w, h, start; locations (Q, M, K, 2), weights (Q, M, K) -> out (Q M D,)."""
    _, heads, samples = weights.shape
    depth = len(width)
    stride = np.int32(heads * depth)
    index = np.empty(4 * samples, np.int32)
    weight = np.empty(4 * samples, np.float32)
    for query in range(first, last):
        for head in range(heads):
            offset = np.int32(head * depth)
            for i in range(samples):
                x = locations[query, head, i, 0] * levels[0, i] - _HALF
                y = locations[query, head, i, 1] * levels[1, i] - _HALF
                share = weights[query, head, i]
                corner_rows(x, y, share, levels[0, i], levels[1, i], levels[2, i], stride, offset, index, weight, 4 * i)
            sum_rows(out, query * heads * depth + offset, value, index, weight, samples, width)  # type: ignore[call-arg]


@numba.njit(fastmath=_FAST, error_model="numpy", nogil=True, cache=True)
def _backward(
    value, levels, locations, weights, grad_out, grad_value, grad_locations, grad_weights, width, first, last
):  # type: ignore[no-untyped-def]
    """Gradients for the heads first..last; each head owns its columns of grad_value, so threads do not meet."""
    queries, heads, samples = weights.shape
    depth = len(width)
    stride = np.int32(heads * depth)
    index = np.empty(4, np.int32)
    weight = np.empty(4, np.float32)
    dot = np.empty(4, np.float32)
    for head in range(first, last):
        offset = np.int32(head * depth)
        for query in range(queries):
            at = query * stride + offset
            for i in range(samples):
                w, h = levels[0, i], levels[1, i]
                x = locations[query, head, i, 0] * w - _HALF
                y = locations[query, head, i, 1] * h - _HALF
                share = weights[query, head, i]
                corner_rows(x, y, _ONE, w, h, levels[2, i], stride, offset, index, weight, 0)
                for corner in range(4):
                    row = index[corner]
                    scale = weight[corner] * share
                    total = _ZERO
                    for d in range(depth):
                        g = grad_out[at + d]
                        total += g * value[row + d]
                        grad_value[row + d] += scale * g
                    dot[corner] = total
                fx, fy = x - np.floor(x), y - np.floor(y)
                left, top = np.floor(x), np.floor(y)
                inside_left = _ONE if (left >= _ZERO) & (left < w) else _ZERO
                inside_right = _ONE if (left >= -_ONE) & (left < w - _ONE) else _ZERO
                inside_top = _ONE if (top >= _ZERO) & (top < h) else _ZERO
                inside_bottom = _ONE if (top >= -_ONE) & (top < h - _ONE) else _ZERO
                d00 = dot[0] * inside_left * inside_top
                d01 = dot[1] * inside_right * inside_top
                d10 = dot[2] * inside_left * inside_bottom
                d11 = dot[3] * inside_right * inside_bottom
                grad_weights[query, head, i] = (
                    weight[0] * dot[0] + weight[1] * dot[1] + weight[2] * dot[2] + weight[3] * dot[3]
                )
                grad_locations[query, head, i, 0] = share * w * ((_ONE - fy) * (d01 - d00) + fy * (d11 - d10))
                grad_locations[query, head, i, 1] = share * h * ((_ONE - fx) * (d10 - d00) + fx * (d11 - d01))


@lru_cache(maxsize=64)
def level_table(shapes: tuple[tuple[int, int], ...], points: int) -> Floats:
    """Return (3, L P): width, height and first token of the level of each sample."""
    sizes = [h * w for h, w in shapes]
    starts = [sum(sizes[:level]) for level in range(len(sizes))]
    rows = [[w, h, start] for (h, w), start in zip(shapes, starts)]
    return np.repeat(np.array(rows, np.float32).T, points, axis=1).copy()


@lru_cache(maxsize=4)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="sampler")


def run_in_threads(kernel: Callable[[int, int], None], count: int, smallest: int) -> None:
    """Split 0..count among torch's number of threads; `kernel` gives up the interpreter lock while it runs."""
    threads = min(torch.get_num_threads(), -(-count // smallest))
    if threads <= 1:
        kernel(0, count)
        return
    bounds = np.linspace(0, count, threads + 1).astype(int).tolist()
    pool = _pool(threads, os.getpid())
    for done in [pool.submit(kernel, *span) for span in pairwise(bounds)]:
        done.result()


def _flat(tensor: Tensor) -> Floats:
    return tensor.detach().reshape(-1).numpy()


class FusedSample(torch.autograd.Function):
    """`sample_plain` for contiguous float32 tensors on the CPU, with its gradient."""

    @staticmethod
    def forward(  # noqa: D102
        ctx: Any, value: Tensor, shapes: tuple[tuple[int, int], ...], locations: Tensor, weights: Tensor
    ) -> Tensor:  # type: ignore[override]
        value, locations, weights = value.contiguous(), locations.contiguous(), weights.contiguous()
        ctx.save_for_backward(value, locations, weights)
        ctx.shapes = shapes
        batch, queries, heads, _, points = weights.shape
        out = value.new_empty(batch, queries, heads * value.shape[-1])
        levels, width = level_table(shapes, points), (0,) * value.shape[-1]
        for b in range(batch):
            arrays = _flat(value[b]), levels, *_samples(locations[b], weights[b]), _flat(out[b]), width
            run_in_threads(partial(_forward, *arrays), queries, 64)
        return out

    @staticmethod
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor, None, Tensor, Tensor]:  # type: ignore[override]  # noqa: D102
        value, locations, weights = ctx.saved_tensors
        batch, _, heads, _, points = weights.shape
        grad_out = grad_out.contiguous()
        grads = torch.zeros_like(value), torch.empty_like(locations), torch.empty_like(weights)
        levels, width = level_table(ctx.shapes, points), (0,) * value.shape[-1]
        for b in range(batch):
            given = _flat(value[b]), levels, *_samples(locations[b], weights[b]), _flat(grad_out[b])
            wanted = _flat(grads[0][b]), *_samples(grads[1][b], grads[2][b])
            run_in_threads(partial(_backward, *given, *wanted, width), heads, 1)
        return grads[0], None, grads[1], grads[2]


def _samples(locations: Tensor, weights: Tensor) -> tuple[Floats, Floats]:
    queries, heads = weights.shape[:2]
    return (
        locations.detach().reshape(queries, heads, -1, 2).numpy(),
        weights.detach().reshape(queries, heads, -1).numpy(),
    )
