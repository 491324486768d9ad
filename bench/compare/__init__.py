"""``warp-gi bench compare``: pipelines beside each other on a scene of the user's."""
