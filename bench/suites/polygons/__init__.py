"""The suite ``polygons``: bakes, evaluators and frames of visibility polygons."""
