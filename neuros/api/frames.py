"""Rows as pandas frames."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any

from neuros.errors import EnvironmentFault


def frame_of(rows: Iterable[Mapping[str, Any]], index: str | None = None) -> Any:
    """A ``pandas.DataFrame``, one row each; ``index``: the column that names them.

    Raises:
        EnvironmentFault: if pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise EnvironmentFault(
            f"pandas is not installed for {sys.executable}: pip install pandas"
        ) from error
    frame = pd.DataFrame(list(rows))
    return frame if index is None or frame.empty else frame.set_index(index)
