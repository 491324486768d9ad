"""Reports of results: one HTML file."""
