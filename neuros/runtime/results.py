"""What a plugin has found out in a run: ``results.json`` in the folder of its node."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

FILE_NAME = "results.json"


class Results:
    """Results by name, on the disk as soon as they are known: a killed node keeps them."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / FILE_NAME
        self._values: dict[str, Any] = {}

    def set(self, name: str, value: Any) -> None:
        """Keep a value. Raises ``TypeError`` or ``ValueError`` for what JSON does not know."""
        value = _plain(value) if hasattr(value, "tolist") else value
        is_finite = not isinstance(value, float) or math.isfinite(value)
        values = {**self._values, str(name): value if is_finite else None}
        text = json.dumps(values, indent=2, default=_plain, allow_nan=False)
        new = self._file.with_suffix(".new")
        new.write_text(text + "\n", "utf-8")
        os.replace(new, self._file)  # whoever reads it never finds half of it
        self._values = values


def _plain(value: Any) -> Any:
    """A number or an array of NumPy as Python's own."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is nothing that JSON knows")
