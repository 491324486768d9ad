"""Emitters selected by a hierarchy over them."""
