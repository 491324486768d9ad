"""Discrete visibility fields (dvf.txt)."""
