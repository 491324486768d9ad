"""Documents made from results: ``python -m warp_gi.bench.publish``."""
