"""Precomputed radiance transfer textures: how light of any sky arrives at each texel of the scene's surfaces."""
