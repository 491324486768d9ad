"""Light field probes: rays beside the tree's, leaks, indirect light beside the path tracer, bakes, and denoisers.

``python -m warp_gi.bench.probes [--quick]``. Seconds of a mode are of the indirect stage alone, primary rays apart.
What the paper measured stands in tables of its own.
"""

from __future__ import annotations

import argparse

from warp_gi.bench import runner
from warp_gi.bench.gallery import CLOSED, Gallery, call
from warp_gi.bench.measure import Row
from warp_gi.bench.probes_denoise import denoise_rows
from warp_gi.bench.probes_light import bake_rows, leak_rows, light_rows
from warp_gi.bench.probes_rays import ray_rows

PARTS = {"rays": ray_rows, "leaks": leak_rows, "light": light_rows, "bakes": bake_rows, "denoise": denoise_rows}


def run(
    quick: bool = False, device: str = "cpu", parts: list[str] | None = None, gallery: Gallery = CLOSED
) -> list[Row]:
    """Return rows of all tables; ``quick`` takes fewer rays, pixels and grids."""
    return [row for part in parts or PARTS for row in call(PARTS[part], quick, device, gallery)]


def main() -> None:
    """Print the rows, as tables and as lines of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer rays, pixels and grids")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="of the suite; all by default")
    options = parser.parse_args()
    rows = run(options.quick, options.device, options.parts)
    runner.print_rows("probes", rows)
    print(runner.json_lines("probes", rows, options.quick, options.device), end="")


if __name__ == "__main__":
    main()
