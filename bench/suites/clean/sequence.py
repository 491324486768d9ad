"""Pipelines of the preset ``clean`` that the suite ``sequence`` renders too: its memory over many frames."""

from warp_gi.bench.harness.sequences import Sequence

CASES = {"clean": Sequence(("--pipeline", "clean"), is_quick=False)}
