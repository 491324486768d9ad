"""A radiance cache on surfaces: paths end in cells of a hash grid that were filled before the first frame."""
