"""How much this library and Warp say in a program that uses them."""

from __future__ import annotations

import logging
from typing import Literal

import warp as wp

from warp_gi.errors import unknown_name

LEVELS = {"error": logging.ERROR, "warning": logging.WARNING, "info": logging.INFO, "debug": logging.DEBUG}
Verbosity = Literal["error", "warning", "info", "debug"]
_handler: logging.Handler | None = None


def set_verbosity(level: Verbosity) -> None:
    """Choose what is said: on stderr by this library, and by Warp, whose lines go where it writes them.

    "error" is nothing but errors, "warning", which it is at first, warnings too; "info" also says what is waited for:
    kernels that compile, bakes that are loaded and kept; "debug" adds Warp's greeting and a line a kernel module, on
    stdout. Raises OptionError for another word.
    """
    global _handler
    if level not in LEVELS:
        raise unknown_name("verbosity", level, LEVELS)
    log = logging.getLogger("warp_gi")
    log.setLevel(LEVELS[level])
    if _handler is None:
        _handler = logging.StreamHandler()
        _handler.setFormatter(logging.Formatter("warp_gi: %(message)s"))
        log.addHandler(_handler)
    wp.config.log_level = wp.LOG_DEBUG if level == "debug" else max(LEVELS[level], wp.LOG_WARNING)


def quieten_warp() -> None:
    """Keep Warp's greeting and its lines of modules off a program's stdout, unless the program has set a level."""
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
