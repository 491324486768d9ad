"""Repairs in a forked process: free locks, an EXR writer without threads, and a note that CUDA is lost."""

from __future__ import annotations

import os
import sys
import threading
import weakref
from typing import Any

_guards: weakref.WeakSet[Guard] = weakref.WeakSet()
has_lost_cuda = False
"""Whether this process was forked after CUDA had started; CUDA calls fail here then."""


class Guard:
    """A re-entrant lock that belongs to one object in one process: after a pickle or a fork it is a free one.

    Write ``with guard.lock:``. No interrupt leaves that lock taken, as it can where a class's own methods take it.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        _guards.add(self)

    def __reduce__(self) -> tuple[Any, ...]:
        return Guard, ()


def _after_fork() -> None:
    global has_lost_cuda
    context: Any = sys.modules.get("warp._src.context")
    if getattr(context, "runtime", None) is not None:  # asked without a call, which would start Warp
        has_lost_cuda = context.is_cuda_available()
    for guard in list(_guards):
        guard.lock = threading.RLock()
    if "OpenImageIO" in sys.modules:  # writing EXR waits for ever for threads that only the parent has
        sys.modules["OpenImageIO"].attribute("exr_threads", -1)  # no threads but the calling one


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
