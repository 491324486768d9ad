"""What sample reuse adds to the suite ``sequence``."""

from warp_gi.bench.harness.sequences import Sequence

CASES = {"reuse": Sequence(("--pipeline", "reuse"))}
