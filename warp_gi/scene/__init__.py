"""Scenes: what is in them, how they are loaded, and what the kernels see of them."""
