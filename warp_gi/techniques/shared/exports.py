"""Files that exports write beside each other."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from warp_gi.errors import OptionError


def check_own(files: Iterable[Path], says_so: Callable[[Path], bool]) -> None:
    """Raise OptionError for a file that exists and does not say that it is of an earlier export.

    ``says_so`` reads a file. What it raises over a file that is another's counts as a no.
    """
    for file in files:
        if file.is_dir():
            raise OptionError(f"{file}: is a folder; give another name")
        if not file.exists():
            continue
        try:
            is_own = says_so(file)
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            is_own = False
        if not is_own:
            raise OptionError(
                f"{file} exists and is not of an earlier export, which would overwrite it: give another name"
            )
