"""What light field probes add to the suite ``sequence``."""

from warp_gi.bench.harness.sequences import Sequence

CASES = {
    "probes": Sequence(
        ("--pipeline", "probes"),
        smaller=("--indirect.counts", "4", "4", "4", "--indirect.resolution", "64"),
        smaller_title="4x4x4 of 64x64",
    )
}
