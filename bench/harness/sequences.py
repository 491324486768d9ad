"""What a suite's folder may add to the suite ``sequence``: ``CASES`` in its ``sequence.py``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sequence:
    """A pipeline that renders the suite's sequence."""

    arguments: tuple[str, ...]
    """Arguments of ``warp-gi render``; the suite adds scene, frames, size and samples."""
    is_quick: bool = True
    """Whether the quick form renders it too."""
    smaller: tuple[str, ...] = ()
    """Arguments that the quick form adds, as its frames are too few to pay for a bake."""
    smaller_title: str = ""
    """How the pipeline's name in rows of the quick form tells of ``smaller``."""
