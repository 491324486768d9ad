"""Benchmarks of warp_gi; run them with ``warp-gi bench SUITE``."""
