"""Frozen dataclasses of arrays with a common leading axis."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


class Batch:
    """Base of dataclasses whose array fields all have the same leading length.

    Fields that are no arrays are what the rows have in common.
    """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The array fields by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    def __len__(self) -> int:
        return len(next(iter(self.arrays().values())))

    def __getitem__(self, index: NDArray[Any] | slice) -> Self:
        return self.with_arrays({name: value[index] for name, value in self.arrays().items()})

    def with_arrays(self, arrays: dict[str, NDArray[Any]]) -> Self:
        """The same with other arrays."""
        return replace(self, **arrays)  # type: ignore[type-var]

    def with_rows(self, index: NDArray[Any], rows: Self) -> Self:
        """A copy in which the rows at `index` are those of another batch."""
        arrays = {name: value.copy() for name, value in self.arrays().items()}
        for name, value in rows.arrays().items():
            arrays[name][index] = value
        return self.with_arrays(arrays)
