"""Repairs in a forked process: free locks, an EXR writer without threads, and a note that CUDA is lost."""

from __future__ import annotations

import functools
import os
import sys
import threading
import weakref
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeVar

_Owner = TypeVar("_Owner", bound=Any)
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

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


def holds_scene(
    method: Callable[Concatenate[_Owner, _Arguments], _Result],
) -> Callable[Concatenate[_Owner, _Arguments], _Result]:
    """Return a method during which no other thread moves, edits or renders the object's scene."""

    @functools.wraps(method)
    def holding(self: _Owner, /, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with self.scene.lock:
            return method(self, *args, **kwargs)

    return holding


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
