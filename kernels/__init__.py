"""Warp device code: arrays and structs only, no files, no scenes.

Installed as ``warp_gi.kernels``. Imported under another name the structs and
modules would exist twice, so that is refused.
"""

if __name__ != "warp_gi.kernels":
    raise ImportError(f"import warp_gi.kernels, not {__name__}: a second copy would make second struct classes")
