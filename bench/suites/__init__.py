"""The benchmark suites, one folder each; what a folder may hold is in ``warp_gi.bench.harness.catalogue``."""
