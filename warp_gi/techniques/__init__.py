"""Techniques, a folder each."""
