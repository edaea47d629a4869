"""Base class of dataclasses of arrays with the same length: selects, overwrites and concatenates
rows.
"""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, Self, cast

import numpy as np


class Rows:
    """Base of dataclasses of arrays with the same length, or of other `Rows`; any other field
    applies to all rows.
    """

    def _columns(self) -> dict[str, Any]:
        columns = ((each.name, getattr(self, each.name)) for each in fields(cast(Any, self)))
        return {name: value for name, value in columns if isinstance(value, np.ndarray | Rows)}

    def __len__(self) -> int:
        return len(next(iter(self._columns().values())))

    def rows(self, index: Any) -> Self:
        """The rows `index`: row numbers (R,), a mask (N,) or a slice."""
        chosen = {
            name: value.rows(index) if isinstance(value, Rows) else value[index]
            for name, value in self._columns().items()
        }
        return replace(cast(Any, self), **chosen)

    def put(self, index: Any, other: Self) -> None:
        """Overwrite the rows `index` (R,) by the rows of `other`."""
        for name, values in self._columns().items():
            if isinstance(values, Rows):
                values.put(index, getattr(other, name))
            else:
                values[index] = getattr(other, name)

    @classmethod
    def concatenate(cls, parts: Sequence[Self], **others: Any) -> Self:
        """The rows of one or more parts, one after the other; fields that apply to all rows are
        `others`, or those of the first part.
        """
        joined = {
            name: type(value).concatenate([getattr(part, name) for part in parts])
            if isinstance(value, Rows)
            else np.concatenate([getattr(part, name) for part in parts])
            for name, value in parts[0]._columns().items()
        }
        return replace(cast(Any, parts[0]), **joined, **others)
