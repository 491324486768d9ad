"""Settings in Python's own numbers, whatever kind they were given in."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Return a number of NumPy's kinds as Python's own, also in tuples and lists; anything else as it is."""
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0):
        return value.item()
    if isinstance(value, tuple | list) and any(isinstance(one, np.generic) for one in value):
        return type(value)(plain(one) for one in value)
    return value


def take_plain(settings: Any) -> None:
    """Let the fields of a frozen dataclass hold Python's own numbers; arrays become tuples where those are usual."""
    for one in fields(settings):
        value = getattr(settings, one.name)
        known = plain(value)
        if isinstance(value, np.ndarray) and value.ndim == 1 and isinstance(one.default, tuple):
            known = tuple(value.tolist())
        if known is not value:
            object.__setattr__(settings, one.name, known)
