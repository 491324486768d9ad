"""The command ``warp-gi``."""
