"""Sequences on many machines by Dask distributed: what travels, what workers do, and who hands frames out."""
