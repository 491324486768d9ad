"""What a suite's folder may add to the suite ``sequence``: ``CASES`` in its ``sequence.py``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sequence:
    """A pipeline that renders the suite's sequence."""

    arguments: tuple[str, ...]
    """Of ``warp-gi render``, scene, frames, size and samples apart."""
    is_quick: bool = True
    """Whether the quick form renders it too."""
    smaller: tuple[str, ...] = ()
    """Arguments that the quick form adds, as its frames are too few to pay for a bake."""
    smaller_title: str = ""
    """What the quick form's rows say of them."""
