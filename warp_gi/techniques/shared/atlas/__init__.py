"""Texels of a scene's surfaces: charts, their places on a page, what lies at each texel, and the surfaces as glTF."""
