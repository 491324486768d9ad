"""Sequences of frames: files, metadata, states between frames, and what a resumed run may skip."""
