"""``warp-gi video``: frames of a sequence as a film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from warp_gi.cli.options import flag, parse_options
from warp_gi.cli.report import Reporter
from warp_gi.sequence.frames import parse_frames
from warp_gi.sequence.video import Video

DESCRIPTION = """Make a film of the frames of a sequence, tone-mapped as previews are.

The file appears whole or not at all. A row or column is left out where a size is odd, at the bottom or on the right.

  warp-gi video out/shot.####.exr -o out/shot.mp4
  warp-gi video out/shot.####.exr -o out/shot.mp4 --frames 0-47 --fps 30 --exposure 1"""


@dataclass
class VideoOptions:
    """What to make a film of, and how."""

    frames_of: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="pattern", metavar="FRAMES")]
    """Files of the frames, as out/shot.####.exr; #### stands for their numbers."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None
    """File of the film, .mp4, .mov or .mkv (default: the frames' name without number, .mp4)."""
    frames: Annotated[str, flag("LIST", "every file that is there")] = ""
    """Numbers of the frames: 0-47, 0-47:2 or 1,4,9-12."""
    fps: Annotated[float | None, flag("X", "as the frames' times say; 24 without")] = None
    """Frames a second."""
    exposure: float = 0.0
    """Exposure in stops."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print nothing but errors."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse(arguments)
    report = Reporter(options.quiet)
    numbers = parse_frames(options.frames) if options.frames else None
    video = Video(options.frames_of, options.output, numbers, options.fps, options.exposure)
    with report.shares("video") as tell:
        codec = video.write(tell)
    width, height = video.size
    report.line(f"{len(video.paths)} frames of {width}x{height}, {video.fps:g} a second, {codec}: {video.output}")
    return 0


def parse(arguments: Sequence[str]) -> VideoOptions:
    """Return the options; raises OptionError for those that are unknown, missing or cannot be read."""
    return parse_options(VideoOptions, "video", arguments, DESCRIPTION)
