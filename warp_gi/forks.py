"""What else a forked process needs: free locks, an EXR writer without threads, and to know that CUDA is lost."""

from __future__ import annotations

import os
import sys
import threading
import weakref
from typing import Any

_guards: weakref.WeakSet[Guard] = weakref.WeakSet()
has_lost_cuda = False
"""Whether this process was forked after CUDA had started, from when on CUDA fails here."""


class Guard:
    """Holds a re-entrant lock for what is one process's and one object's own: pickled or forked, it is a free one.

    Write ``with guard.lock:``, of which no interrupt leaves the lock taken, as it can where a class of its own
    takes it.
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
