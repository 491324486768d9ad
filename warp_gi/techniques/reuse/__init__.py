"""Sample reuse over frames: the visibility light cache and guided paths (temporal_reuse.txt)."""
