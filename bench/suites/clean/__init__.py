"""The suite ``clean``: whole sequences by the preset ``clean``."""
