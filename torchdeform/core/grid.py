"""Geometry of a regular grid: shape, spacing, and the positions of its nodes."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from operator import index

import torch
from torch import Tensor

from torchdeform.errors import InputError

# Nodes computed at once: few enough that a CPU's cache and allocator hold what belongs to them, many enough for a GPU.
_SLAB_NODES = {"cpu": 2**17, "cuda": 2**22}


@dataclass(frozen=True)
class Grid:
    """Nodes x_i = i · spacing of the box Ω = Π [0, (n_k − 1) h_k] spanned by the outermost voxel centres.

    Args:
        shape: number of nodes along each array axis, 2 or 3 axes, each at least 2.
        spacing: distance between neighbouring nodes along each array axis, in mm (or pixels); 1 by default.

    Raises:
        InputError: the shape or the spacing is not usable.
    """

    shape: tuple[int, ...]
    spacing: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        try:
            shape = tuple(index(n) for n in self.shape)
            spacing = tuple(float(h) for h in self.spacing) or (1.0,) * len(shape)
        except (TypeError, ValueError) as error:
            message = f"Grid: shape must be whole numbers and spacing must be numbers, got {self.shape}, {self.spacing}"
            raise InputError(message) from error
        if len(shape) not in (2, 3) or min(shape) < 2:
            raise InputError(f"Grid: shape must have 2 or 3 axes of at least 2 nodes, got {shape}")
        if len(spacing) != len(shape) or not all(math.isfinite(h) and h > 0 for h in spacing):
            raise InputError(f"Grid: spacing must have {len(shape)} positive finite entries, got {spacing}")
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "spacing", spacing)

    @property
    def dim(self) -> int:
        """Number of axes D, 2 or 3."""
        return len(self.shape)

    @property
    def axes(self) -> tuple[int, ...]:
        """Positions of the spatial axes in a ``(B, C, *S)`` tensor: ``(2, 3)`` or ``(2, 3, 4)``."""
        return tuple(range(2, 2 + self.dim))

    @property
    def size_text(self) -> str:
        """Number of nodes in x, y, z order as in ITK, such as ``256×256×160``."""
        return "×".join(map(str, self.shape[::-1]))

    @property
    def extent(self) -> tuple[float, ...]:
        """Side lengths (n_k − 1) h_k of Ω in units of spacing."""
        return tuple((n - 1) * h for n, h in zip(self.shape, self.spacing, strict=True))

    @property
    def volume(self) -> float:
        """Volume |Ω| (area in 2D) in units of spacing to the power D."""
        return math.prod(self.extent)

    @property
    def cell_volume(self) -> float:
        """Volume Π h_k of one element."""
        return math.prod(self.spacing)

    def along(self, values: Sequence[float], like: Tensor) -> Tensor:
        """Return D numbers as a ``(1, D, 1, ..)`` tensor that broadcasts over vectors ``(B, D, *T)`` like ``like``.

        Where that has fewer axes, it gives type and device only, and T is the shape of the grid.
        """
        ones = [1] * (like.dim() - 2 if like.dim() > 2 else self.dim)
        return torch.as_tensor(values, dtype=like.dtype, device=like.device).view(1, -1, *ones)

    @property
    def strides(self) -> tuple[int, ...]:
        """By how much the number of a node grows from one to the next along each axis, the last running fastest."""
        return tuple(math.prod(self.shape[k + 1 :]) for k in range(self.dim))

    def with_shape(self, shape: Iterable[int]) -> "Grid":
        """Return the grid of the same box with so many nodes along each axis."""
        shape = tuple(shape)
        if shape == self.shape:
            return self
        return Grid(shape, tuple(side / (n - 1) for side, n in zip(self.extent, shape, strict=True)))

    def points(
        self,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        rows: slice = slice(None),
    ) -> Tensor:
        """Return the node positions x as a ``(1, D, *S)`` tensor in units of spacing, node 0 at the origin.

        Args:
            dtype: floating type wanted.
            device: device wanted.
            rows: of the first axis; all of them by default.
        """
        steps = [torch.arange(n, dtype=dtype, device=device) * h for n, h in zip(self.shape, self.spacing, strict=True)]
        return torch.stack(torch.meshgrid(steps[0][rows], *steps[1:], indexing="ij")).unsqueeze(0)

    def quadrature(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """Return the trapezoidal weights ``(1, 1, *S)`` with Σ w f = ∫ f for every Q1 function f; their sum is |Ω|."""
        weights = torch.full((1, 1, *self.shape), self.cell_volume, dtype=dtype, device=device)
        for axis, end in product(self.axes, (0, -1)):
            weights.select(axis, end).mul_(0.5)
        return weights

    def check(self, field: Tensor, name: str, *, components: int | None = None) -> None:
        """Raise `InputError` unless ``field`` is a float32 or float64 ``(B, components, *S)`` tensor on this grid.

        Args:
            field: the tensor to look at.
            name: what it is called where the caller sees it, for instance ``"warp: u"``.
            components: number of channels wanted; any when None.
        """
        require_float(field, name)
        channels = field.shape[1] if components is None and field.dim() > 1 else components
        shaped = field.dim() == self.dim + 2 and field.shape[1] == channels and tuple(field.shape[2:]) == self.shape
        if not shaped:
            want = ", ".join(["B", "C" if components is None else str(components), *map(str, self.shape)])
            raise InputError(f"{name} must have shape ({want}), got {tuple(field.shape)}")
        if field.numel() == 0:
            raise InputError(f"{name} is empty, its shape is {tuple(field.shape)}; give at least one item and channel")

    def check_vector(self, field: Tensor, name: str) -> None:
        """Raise `InputError` unless ``field`` is a ``(B, D, *S)`` vector field on this grid."""
        self.check(field, name, components=self.dim)

    def check_scalar(self, field: Tensor, name: str) -> None:
        """Raise `InputError` unless ``field`` is a ``(B, 1, *S)`` scalar field on this grid."""
        self.check(field, name, components=1)


def require_float(values: Tensor, name: str) -> None:
    """Raise `InputError`, which names ``name``, unless values are float32 or float64.

    The one place that says which types are computed with. With the 8 or 11 digits of bfloat16 and float16 points are a
    tenth of a voxel off, and sums over an image overflow; layers of `torchdeform.nn` widen what they are given.
    """
    if not isinstance(values, Tensor) or values.dtype not in (torch.float32, torch.float64):
        kind = f"{values.dtype}; convert it with .float()" if isinstance(values, Tensor) else type(values).__name__
        raise InputError(f"{name} must be a floating-point tensor of 32 or 64 bits, got {kind}")


def parts_of(count: int, size: int) -> list[slice]:
    """Return slices of so many entries of ``size`` each, the last one of what is left."""
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]


def slabs(shape: Sequence[int], device: torch.device, *, least: int = 1) -> Iterator[slice]:
    """Yield the rows of the first axis, a slab of at least so many at a time, for what needs much memory a node."""
    rows = max(least, _SLAB_NODES.get(device.type, 2**22) // math.prod(shape[1:]))
    yield from parts_of(shape[0], rows)


def over_slabs(
    values: Callable[[slice], Tensor], shape: Sequence[int], device: torch.device, *, least: int = 1
) -> Tensor:
    """Return what a function of rows of the first axis has to say, ``(B, C, *T)`` each, for all of them together.

    Args:
        values: of the rows of a slab.
        shape: of all nodes.
        device: where the values are made.
        least: rows of a slab at least.

    Notes:
        Slabs are copied into place as they come. Where a gradient is wanted they are joined at the end: it would be
        copied as a whole for every slab otherwise.
    """
    rows, *others = slabs(shape, device, least=least)
    first = values(rows)
    if first.requires_grad:
        return torch.cat([first, *map(values, others)], dim=2)
    if not others:
        return first
    whole = first.new_empty(*first.shape[:2], shape[0], *first.shape[3:])
    whole[:, :, rows] = first

    def fill(rows: slice) -> None:
        whole[:, :, rows] = values(rows)

    on_threads(fill, others, device)
    return whole


def on_threads(work: Callable[[slice], None], parts: Sequence[slice], device: torch.device) -> None:
    """Do work on all parts, without gradients; on the CPU every one on a thread.

    Threads that take the next part when they are done never wait for each other, as torch's do after every call.
    """
    threads = torch.get_num_threads()
    if min(threads, len(parts)) < 2 or device.type != "cpu":
        for part in parts:
            work(part)
        return
    inference = torch.is_inference_mode_enabled()

    def alone(part: slice) -> None:
        with torch.inference_mode(inference), torch.no_grad():  # a thread does not inherit them
            work(part)

    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            deque(pool.map(alone, parts), maxlen=0)
    finally:
        torch.set_num_threads(threads)  # what threads to come begin with


# Fewer nodes than this are not worth more than one thread: with two, a pair of 216×291 gains a tenth on a quiet machine
# and takes three times as long beside another busy program.
_NODES_PER_THREAD = 2**16


@contextmanager
def limit_threads(fields: int, grid: Grid) -> Iterator[None]:
    """Use no more of torch's threads than so many fields are worth: on a shared machine they wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, min(before, fields * math.prod(grid.shape) // _NODES_PER_THREAD)))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def common_batch(where: str, *tensors: Tensor) -> int:
    """Return the batch size of tensors; raise `InputError`, which names ``where``, unless they agree or are 1."""
    sizes = {tensor.shape[0] for tensor in tensors if tensor.dim() > 0} - {1} or {1}
    if len(sizes) > 1:
        raise InputError(f"{where}: batch sizes must agree or be 1, got {sorted(sizes)}")
    return sizes.pop()


def over_items(function: Callable[[Tensor], Tensor], field: Tensor, dim: int) -> Tensor:
    """Return function of ``(B, ..)`` for each entry along an axis of ``field``, which comes first in the result."""
    many = field.movedim(dim, 0)
    return function(many.flatten(0, 1)).unflatten(0, many.shape[:2])


def largest(field: Tensor) -> Tensor:
    """Return the largest absolute value of each item, ``(B,)``."""
    return field.detach().abs().flatten(1).amax(1)


def magnitude(field: Tensor) -> Tensor:
    """Return a power of two near the largest absolute value of each item, ``(B, 1, ..)``; 1 if that is 0 or infinite.

    A field divided by it has squares that neither overflow nor vanish, and has lost nothing: the division is exact.
    """
    most = largest(field)
    usable = torch.isfinite(most) & (most > 0)
    power = torch.ldexp(torch.ones_like(most), torch.frexp(torch.where(usable, most, 1.0)).exponent - 1)
    return per_item(power, field)


def per_item(per_item: Tensor, like: Tensor) -> Tensor:
    """Return ``(B,)`` as ``(B, 1, 1, ..)``, to go with ``like``."""
    return per_item.view(-1, *([1] * (like.dim() - 1)))
