"""Scaling: how time and memory grow with triangles, lights, pixels, bake samples, probes and threads.

``python -m warp_gi.bench.scaling [--quick] [--parts NAME ...]``. Tables ": growth" have the exponents of power laws
through all sizes, and what ten times the size costs at worst. Seconds of rays are of one thread; where other programs
run, "cost" is CPU seconds. The meshes, lamps and rays are generated, the same each time.
"""

from __future__ import annotations

import argparse

from warp_gi.bench import runner
from warp_gi.bench.measure import Row
from warp_gi.bench.scaling_bakes import probe_rows, sample_rows
from warp_gi.bench.scaling_frames import light_rows, pixel_rows, thread_rows
from warp_gi.bench.scaling_triangles import triangle_rows

PARTS = {
    "triangles": triangle_rows,
    "lights": light_rows,
    "pixels": pixel_rows,
    "samples": sample_rows,
    "probes": probe_rows,
    "threads": thread_rows,
}


def run(quick: bool = False, device: str = "cpu", parts: list[str] | None = None) -> list[Row]:
    """Return rows of all tables; ``quick`` takes smaller sizes and fewer turns."""
    return [row for part in parts or PARTS for row in PARTS[part](quick, device)]


def main() -> None:
    """Print the rows, as tables and as lines of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smaller sizes, fewer turns")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="of the suite; all by default")
    options = parser.parse_args()
    rows = run(options.quick, options.device, options.parts)
    runner.print_rows("scaling", rows)
    print(runner.json_lines("scaling", rows, options.quick, options.device), end="")


if __name__ == "__main__":
    main()
