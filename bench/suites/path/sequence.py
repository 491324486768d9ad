"""What the path tracer adds to the suite ``sequence``."""

from warp_gi.bench.harness.sequences import Sequence

CASES = {
    "path": Sequence(("--pipeline", "path")),
    "path, denoised": Sequence(("--pipeline", "path", "--denoise", "spatiotemporal"), is_quick=False),
}
