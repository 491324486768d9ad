"""What has to be equal on two machines for their frames to be equal bit for bit."""

from __future__ import annotations

import hashlib
import socket
from dataclasses import dataclass, fields

import numpy as np
import warp as wp

import warp_gi
from warp_gi.kept import code_hash


@dataclass(frozen=True)
class Identity:
    """Versions and processor of a process."""

    warp_gi: str
    """Version of this package."""
    code: str
    """Hash of the package's code, which tells versions apart that have one number."""
    warp: str
    """Version of Warp."""
    numpy: str
    """Version of NumPy."""
    processor: str
    """Warp's name for the instructions of the processor that kernels are compiled for."""

    @classmethod
    def mine(cls) -> Identity:
        """Return that of this process."""
        return cls(warp_gi.__version__, code_hash()[:12], wp.__version__, np.__version__, wp.get_cpu_kernel_cache_key())

    @property
    def resource(self) -> str:
        """Name of the resource of Dask that workers of this identity have one of."""
        return f"warp_gi-{hashlib.sha256(repr(self).encode()).hexdigest()[:12]}"

    def differences(self, other: Identity) -> str:
        """Return in words in what ``other`` differs, "" if in nothing."""
        names = {"code": "code of warp_gi"}
        pairs = [(one.name, getattr(self, one.name), getattr(other, one.name)) for one in fields(self)]
        return ", ".join(f"{names.get(n, n)} {theirs} instead of {mine}" for n, mine, theirs in pairs if mine != theirs)


def host() -> str:
    """Return the name of this machine."""
    return socket.gethostname()
