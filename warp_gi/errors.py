"""Errors that a user can mend: one clear line, exit code 2 from the command line."""

from __future__ import annotations

import difflib
import errno
import re
from collections.abc import Iterable
from numbers import Integral
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

FARTHEST = 1e15
"""Metres from the origin beyond which squares of distances leave float32."""
FARTHEST_VERTEX = 1e12
"""Metres beyond which products of three lengths leave float32, by which rays are tested against triangles."""
OF_MACHINE = {"ENOSPC", "EDQUOT", "EFBIG", "EIO", "ENOMEM", "ESTALE", "EMFILE", "ENFILE", "EPIPE", "ETIMEDOUT"}
"""Errors of the system that no argument is to blame for."""
_BREAKS = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")
MOST_NAMES = 64
"""Known names that an error lists."""


class GiError(ValueError):
    """Base of every error that says what was expected, what came and what to do.

    It is one line: ends of lines in names that it quotes, and other characters that move the cursor, become spaces.
    """

    def __init__(self, *message: object) -> None:
        super().__init__(*(_BREAKS.sub(" ", one) if isinstance(one, str) else one for one in message))


class SceneError(GiError):
    """A scene, image, environment or camera file cannot be used."""


class OptionError(GiError):
    """A setting or option is unknown or out of range."""


class BakeError(GiError):
    """A bake file is damaged, foreign, or of another scene or other settings."""


class UnsupportedWarning(UserWarning):
    """A file uses what this library does not read, or reads only nearly; one for each feature, which says where."""


def one_line(message: object, otherwise: str = "") -> str:
    """Return a message with each run of spaces and line ends as one space; ``otherwise`` if nothing is left."""
    return " ".join(str(message).split()) or otherwise


def unknown_name(kind: str, name: object, known: Iterable[str]) -> OptionError:
    """Return an error for an unknown ``name`` that lists the known ones and the nearest match.

    Of more than MOST_NAMES, as a scene's nodes may be, it lists those that are nearest.
    """
    known = sorted(known)
    near = difflib.get_close_matches(str(name), known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    shown = known
    if len(known) > MOST_NAMES:
        shown = difflib.get_close_matches(str(name), known, n=MOST_NAMES // 8, cutoff=0.3) or known[: MOST_NAMES // 8]
    more = f" and {len(known) - len(shown):,} others" if len(shown) < len(known) else ""
    return OptionError(f"unknown {kind} {name!r}{hint} (known: {', '.join(shown)}{more})")


def check_whole(name: str, value: object, least: int, most: int) -> None:
    """Raise OptionError unless a setting is a whole number in a range."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not least <= int(value) <= most:
        raise OptionError(f"{name} must be a whole number from {least} to {most}, got {value!r}")


def whole_number(name: str, value: object) -> int:
    """Return a whole number as Python's own, of NumPy's kinds too; raises OptionError for what is none."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise OptionError(f"{name} must be a whole number, got {value!r:.80}")
    return int(value)


def check_number(name: str, value: object) -> None:
    """Raise OptionError unless a setting is a number."""
    if isinstance(value, str | bytes) or not hasattr(value, "__float__"):
        raise OptionError(f"{name} must be a number, got {value!r:.80}")


def check_near(points: np.ndarray) -> None:
    """Raise SceneError for positions beyond ``FARTHEST_VERTEX``, float32 [vertex, 3]."""
    if len(points) and max(points.max(), -points.min()) > FARTHEST_VERTEX:
        bad = int(abs(points).max(axis=1).argmax())
        raise SceneError(
            f"vertices must be within {FARTHEST_VERTEX:g} m, but vertex {bad} is at {points[bad].tolist()}; scale down"
        )


def is_of_machine(error: BaseException) -> bool:
    """Return whether another try may do better: memory or disk ran out, or a library could not write a file."""
    if isinstance(error, OSError):
        return error.errno is None or errno.errorcode.get(error.errno) in OF_MACHINE
    return isinstance(error, MemoryError)


def is_mistake(error: BaseException) -> bool:
    """Return whether what was asked for cannot be, so that another try would fail, too."""
    return isinstance(error, GiError | OSError) and not is_of_machine(error)
