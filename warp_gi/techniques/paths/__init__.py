"""The baselines: path tracing, and emitters picked by a fixed distribution."""
