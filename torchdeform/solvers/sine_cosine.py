"""Sine and cosine transforms of type I along the axes of a tensor, which diagonalise Q1 elements on a box."""

import math
from typing import Literal

import torch
from torch import Tensor
from torch.autograd import Function

from torchdeform.core.grid import over_items
from torchdeform.core.tables import kept
from torchdeform.errors import require_choice

Kind = Literal["cosine", "sine"]

# The kind of each channel along each axis.
Kinds = tuple[tuple[Kind, ...], ...]

KINDS: tuple[Kind, ...] = ("cosine", "sine")

# Up to this length one product with the dense n×n matrix beats the FFT of length 2(n − 1): a 3×128³ float32 field takes
# 11 ms an axis against 110 ms on one core; at 512 nodes the two are level where the FFT has a length it likes.
DENSE_LIMIT = 512


def transform(x: Tensor, dim: int, kind: Kind) -> Tensor:
    """Return y_j = Σ_i x_i cos(π i j / (n − 1)) (or sin), the sum over all n nodes of one axis.

    Args:
        x: real floating tensor; axis ``dim`` has n ≥ 2 entries.
        dim: the axis.
        kind: ``cosine`` or ``sine``.

    Returns:
        The shape of ``x``, entries j = 0 to n − 1. Sine sums are zero at both ends, and blind to the ends of ``x``.

    Raises:
        InputError: an unknown kind.

    Notes:
        Symmetric in i and j, so a transform is its own adjoint, and `inverse_transform` is a scaling of it. Sine sums
        are half the usual DST-I of the inner nodes, cosine sums half the usual DCT-I of ``x`` with its ends doubled.
        Takes an n×n product up to `DENSE_LIMIT` nodes, else a real FFT of length 2(n − 1). Linear, differentiable.
    """
    require_choice(kind, KINDS, "transform: kind")
    return _sum(x.contiguous(), dim % x.dim(), kind, None)


def inverse_transform(y: Tensor, dim: int, kind: Kind) -> Tensor:
    """Return x with ``transform(x, dim, kind) = y``; for ``sine`` the ends of x are zero.

    Args:
        y: real floating tensor, modes along axis ``dim``.
        dim: the axis.
        kind: ``cosine`` or ``sine``.

    Raises:
        InputError: an unknown kind.

    Notes:
        With E = diag(½, 1, .., 1, ½) the cosine sums C satisfy C E C E = (n − 1)/2, so C⁻¹ = 2/(n − 1) · E C E. The
        same holds for sine sums, whose end entries are zero on both sides.
    """
    size = y.shape[dim]
    ends = torch.ones(size, dtype=y.dtype, device=y.device)
    ends[[0, -1]] = 0.5
    ends = ends.view(-1, *([1] * (y.dim() - 1 - dim % y.dim())))
    return transform(y * ends, dim, kind) * ends * (2 / (size - 1))


def separable_transform(x: Tensor, kinds: Kinds, *, out: Tensor | None = None) -> Tensor:
    """Return the transform of every channel along all its axes, kind ``kinds[channel][axis]``.

    Args:
        x: ``(B, C, *S)``.
        kinds: one tuple per channel, one kind per spatial axis.
        out: memory to write the result to, contiguous and not ``x``; only where no gradient is wanted.

    Returns:
        ``(B, C, *S)``.

    Notes:
        Self-adjoint, so its derivative is itself, to every degree. One product per item, channel and axis: nothing is
        copied. A batch gives the results of its items to rounding: a product may round by where its memory begins.
    """
    return _SeparableTransform.apply(x, kinds) if out is None else _separable(x, kinds, out)


class _SeparableTransform(Function):
    @staticmethod
    def forward(x: Tensor, kinds: Kinds) -> Tensor:
        return _separable(x, kinds, torch.empty_like(x, memory_format=torch.contiguous_format))

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.kinds = inputs[1]

    @staticmethod
    def backward(ctx, grad: Tensor):
        return _SeparableTransform.apply(grad, ctx.kinds), None

    @staticmethod
    def jvp(ctx, tangent: Tensor, _: None) -> Tensor:
        return _SeparableTransform.apply(tangent, ctx.kinds)

    @staticmethod
    def vmap(info, in_dims, x: Tensor, kinds: Kinds):
        return over_items(lambda items: _SeparableTransform.apply(items, kinds), x, in_dims[0]), 0


def _separable(x: Tensor, kinds: Kinds, out: Tensor) -> Tensor:
    x, dim = x.contiguous(), len(kinds[0])
    scratch = torch.empty_like(x[0, 0])
    for item in range(x.shape[0]):
        for channel, along in enumerate(kinds):
            source = x[item, channel]
            for axis in range(dim):
                target = out[item, channel] if (dim - axis) % 2 else scratch  # the last axis writes to out
                source = _sum(source, axis, along[axis], target)
    return out


def _sum(x: Tensor, dim: int, kind: Kind, out: Tensor | None) -> Tensor:
    size = x.shape[dim]
    if size > DENSE_LIMIT:
        return _fft_sum(x, dim, kind, out)
    matrix = dense_matrix(size, kind, x.dtype, x.device)
    if dim == x.dim() - 1:
        flat = None if out is None else out.view(-1, size)
        return torch.mm(x.view(-1, size), matrix, out=flat).view(x.shape)
    shape = (math.prod(x.shape[:dim]), size, math.prod(x.shape[dim + 1 :]))
    flat = None if out is None else out.view(shape)
    return torch.bmm(matrix.expand(shape[0], size, size), x.view(shape), out=flat).view(x.shape)


def _fft_sum(x: Tensor, dim: int, kind: Kind, out: Tensor | None) -> Tensor:
    """Take both sums from Σ_k x_k exp(−iπ k j/(n − 1)), the FFT of x padded with zeros to length 2(n − 1)."""
    modes = torch.fft.rfft(x, n=2 * (x.shape[dim] - 1), dim=dim)
    sums = modes.real if kind == "cosine" else -modes.imag
    return sums if out is None else out.copy_(sums)


@kept(64)
def dense_matrix(size: int, kind: Kind, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the symmetric matrix of entries cos(π i j/(n − 1)) or sin(π i j/(n − 1)); shared, not to be written to."""
    node = torch.arange(size, device="cpu")
    # The phase is reduced in integers: exact zeros at the ends of the sines, full accuracy for long axes.
    phase = torch.remainder(torch.outer(node, node), 2 * (size - 1)).double() * (math.pi / (size - 1))
    matrix = phase.cos() if kind == "cosine" else phase.sin()
    if kind == "sine":
        matrix[[0, -1]], matrix[:, [0, -1]] = 0.0, 0.0
    return matrix.to(dtype=dtype, device=device)
