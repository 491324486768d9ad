"""The suite ``cache``: surface radiance caches."""
