"""Products with matrices along the axes of fields."""

from torch import Tensor

# Up to this many nodes an axis the product with the dense matrix is the fastest; longer axes take the few entries of
# its rows one by one.
DENSE_LIMIT = 512


def dense_product(field: Tensor, matrix: Tensor, axis: int) -> Tensor:
    """Return Σ_j matrix[i, j] field[.., j, ..] along one axis of ``(B, C, *S)``."""
    if axis == field.dim() - 1:
        return field @ matrix.T
    shape = (*field.shape[:axis], matrix.shape[0], *field.shape[axis + 1 :])
    return (matrix @ field.flatten(axis + 1)).view(shape)


def sparse_product(field: Tensor, values: Tensor, columns: Tensor, axis: int) -> Tensor:
    """Return Σ_k values[i, k] field[.., columns[i, k], ..] along one axis of ``(B, C, *S)``.

    Args:
        field: ``(B, C, *S)``.
        values: entries of each row of a matrix ``(rows, width)``; those of one column add up.
        columns: where they stand, the same shape.
        axis: the axis, from 2.
    """
    if field.shape[axis] <= DENSE_LIMIT:
        matrix = values.new_zeros(len(values), field.shape[axis]).scatter_add_(1, columns, values)
        return dense_product(field, matrix, axis)
    rest = [1] * (field.dim() - 1 - axis)
    entries = zip(values.unbind(1), columns.unbind(1), strict=True)
    parts = (field.index_select(axis, column).mul_(value.view(-1, *rest)) for value, column in entries)
    total = next(parts)
    for part in parts:
        total += part
    return total
