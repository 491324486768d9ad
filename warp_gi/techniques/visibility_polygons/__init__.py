"""Visibility polygons: noise-free light of any sky, one integral along a polygon's edges a pixel."""
