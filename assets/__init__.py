"""Data files that warp_gi ships."""
