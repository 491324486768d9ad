"""What visibility fields add to the suite ``sequence``."""

from warp_gi.bench.harness.sequences import Sequence

CASES = {"dvf": Sequence(("--pipeline", "dvf", "--environment.cell-size", "1"), is_quick=False)}
