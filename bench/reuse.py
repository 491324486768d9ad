"""Sample reuse: light cache and guided paths by scene, over frames, after changes of the light, and their cost.

``python -m warp_gi.bench.reuse [--quick]``. One sample a pixel; errors are mean squared, without the reference's
noise. Where other programs run, "equal time" and "cost" count CPU seconds. What the paper measured stands in tables
of its own.
"""

from __future__ import annotations

import argparse

from warp_gi.bench import runner
from warp_gi.bench.gallery import CLOSED, Gallery, call
from warp_gi.bench.measure import Row
from warp_gi.bench.reuse_cost import cost_rows
from warp_gi.bench.reuse_quality import quality_rows
from warp_gi.bench.reuse_time import adaptation_rows, strobe_rows, turning_rows

PARTS = {
    "quality": quality_rows,
    "adaptation": adaptation_rows,
    "turning": turning_rows,
    "cost": cost_rows,
    "strobe": strobe_rows,
}


def run(
    quick: bool = False, device: str = "cpu", parts: list[str] | None = None, gallery: Gallery = CLOSED
) -> list[Row]:
    """Return rows of all tables; ``quick`` takes fewer pixels, frames and scenes."""
    return [row for part in parts or PARTS for row in call(PARTS[part], quick, device, gallery)]


def main() -> None:
    """Print the rows, as tables and as lines of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer pixels, frames and scenes")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="of the suite; all by default")
    options = parser.parse_args()
    rows = run(options.quick, options.device, options.parts)
    runner.print_rows("reuse", rows)
    print(runner.json_lines("reuse", rows, options.quick, options.device), end="")


if __name__ == "__main__":
    main()
