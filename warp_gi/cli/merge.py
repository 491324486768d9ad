"""``warp-gi merge``: shards of a bake, that several processes made, as one bake."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from warp_gi.cli.inputs import BAKE_SUFFIX
from warp_gi.cli.options import parse_options
from warp_gi.cli.report import Reporter
from warp_gi.errors import OptionError
from warp_gi.files import check_target, check_writable, remove_stale_parts
from warp_gi.shards import merge_bakes

DESCRIPTION = """Make one bake of its shards, equal bit for bit to a bake by one process.

All shards of one bake are given, in any order. They have to be of one technique, scene, view, seed, version and kind of
processor, and of the same settings. The file appears whole or not at all.

  warp-gi bake hall.glb --everywhere --chunk 1/2 -o out/hall.1.safetensors
  warp-gi bake hall.glb --everywhere --chunk 2/2 -o out/hall.2.safetensors
  warp-gi merge out/hall.1.safetensors out/hall.2.safetensors -o out/hall.dvf.safetensors"""


@dataclass
class MergeOptions:
    """Which shards to merge, and where to."""

    shards: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SHARD...")]
    """Files that `warp-gi bake --chunk` wrote: all shards of one bake."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File of the whole bake."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print nothing but errors."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse(arguments)
    report = Reporter(options.quiet)
    output = options.output
    if output.suffix.lower() != BAKE_SUFFIX:
        raise OptionError(f"cannot write {output.name}: bakes are {BAKE_SUFFIX} files")
    check_target(output)
    for shard in options.shards:
        if output.exists() and shard.exists() and output.samefile(shard):
            raise OptionError(f"{output} would be written over a shard: give another name")
    with report.phase("merge"):
        whole = merge_bakes(options.shards)
        check_writable(output.parent)
        remove_stale_parts(output)
        whole.save(output)
    report.line(
        f"{len(options.shards)} shards of {whole.technique} of {whole.scene_name!r}, {whole.nbytes / 1e6:.3g} MB"
    )
    report.line(f"bake: {output}")
    return 0


def parse(arguments: Sequence[str]) -> MergeOptions:
    """Return the options; raises OptionError for those that are unknown, missing or cannot be read."""
    return parse_options(MergeOptions, "merge", arguments, DESCRIPTION)
