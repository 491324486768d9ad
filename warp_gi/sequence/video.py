"""Films of sequences by PyAV (FFmpeg): H.264 where its build has an encoder, else MPEG-4 part 2.

Pictures are those of previews (``tone_map``), with sRGB's coding and the primaries of BT.709 in 4:2:0 of limited range.
Both codecs take even sizes only: of an odd one the last row or column is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.errors import OptionError, SceneError, check_number
from warp_gi.files import check_target, frame_path, frames_there, remove_stale_parts, replacing, user_path
from warp_gi.sequence.exr import stored_values
from warp_gi.sequence.frames import read_frame
from warp_gi.sequence.preview import check_exposure, tone_map

SUFFIXES = (".mp4", ".mov", ".mkv")
CODECS = {"libx264": {"crf": "17", "preset": "medium"}, "libopenh264": {}, "mpeg4": {"qscale": "2"}}
"""Encoders in the order in which they are tried, and their settings: no loss that the eye sees."""
FPS = 24.0
"""Frames a second of files that do not tell their times."""
MOST_FPS = 1000.0


class Video:
    """A film of the EXR or PNG files of a sequence.

    Args:
        pattern: The frames' files, as "out/shot.####.exr".
        output: The film's file, .mp4, .mov or .mkv; None is the frames' name without the number.
        frames: Numbers of the frames, in order; None is every file that is there.
        fps: Frames a second; None is what the times of the first two frames say, or 24.
        exposure: Exposure in stops; PNG files are pictures already and take none.

    Raises OptionError for files that cannot be, or if PyAV is not installed, SceneError for a frame that is missing.
    """

    def __init__(
        self,
        pattern: str | Path,
        output: str | Path | None = None,
        frames: Sequence[int] | None = None,
        fps: float | None = None,
        exposure: float = 0.0,
    ) -> None:
        self.pattern, self.exposure = user_path(pattern), exposure
        stem = self.pattern.stem.replace("#", "").strip("._-") or "film"
        self.output = user_path(output) if output else self.pattern.with_name(f"{stem}.mp4")
        check_exposure(exposure)
        if self.output.suffix.lower() not in SUFFIXES:
            raise OptionError(f"cannot write {self.output.name}: films are {', '.join(SUFFIXES)} files")
        if "#" not in self.pattern.name or self.pattern.suffix.lower() not in (".exr", ".png"):
            raise OptionError(f"a film is made of .exr or .png files with #### in their name, got {self.pattern}")
        if self.pattern.suffix.lower() == ".png" and exposure:
            raise OptionError("exposure goes with .exr files: .png files are tone-mapped already")
        numbers = frames_there(self.pattern) if frames is None else list(frames)
        self.paths = [frame_path(self.pattern, index) for index in numbers]
        missing = [path for path in self.paths if not path.is_file()]
        if missing or not self.paths:
            which = missing[0] if missing else self.pattern
            more = f", as are {len(missing) - 1} others" if len(missing) > 1 else ""
            raise SceneError(f"{which}: no such file{more}; render first (--resume), or name other --frames")
        if fps is not None:
            check_number("fps", fps)
            if not 0 < fps <= MOST_FPS:
                raise OptionError(f"fps must be above 0 and at most {MOST_FPS:g}, got {fps:g}")
        check_target(self.output)
        _av()
        first = self._picture(0)
        self.size = first.shape[1] // 2 * 2, first.shape[0] // 2 * 2
        """Width and height of the film in pixels: those of the frames, less an odd column or row."""
        if min(self.size) < 2:
            raise OptionError(
                f"a film needs at least 2x2 pixels, {self.paths[0]} has {first.shape[1]}x{first.shape[0]}"
            )
        self.fps = fps or self._fps()

    def write(self, progress: Callable[[float], None] | None = None) -> str:
        """Write the film, whole or not at all, and return the name of its codec.

        Raises SceneError for a frame that is torn or of another size, OSError for a file that cannot be written.
        """
        av = _av()
        codec = next(name for name in CODECS if name in av.codecs_available)
        remove_stale_parts(self.output)
        kind = {".mkv": "matroska"}.get(self.output.suffix.lower(), self.output.suffix.lower()[1:])
        with replacing(self.output) as part, av.open(str(part), "w", format=kind) as film:
            stream = film.add_stream(codec, rate=Fraction(self.fps).limit_denominator(1001), options=CODECS[codec])
            stream.width, stream.height = self.size
            stream.pix_fmt = "yuv420p"
            for name, value in (("color_primaries", 1), ("color_trc", 13), ("colorspace", 1), ("color_range", 1)):
                setattr(stream.codec_context, name, value)  # BT.709 with sRGB's coding, limited range
            for place, path in enumerate(self.paths):
                pixels = self._picture(place)
                if (pixels.shape[1] // 2 * 2, pixels.shape[0] // 2 * 2) != self.size:
                    size = f"{pixels.shape[1]}x{pixels.shape[0]}"
                    raise SceneError(f"{path}: is {size}, expected the first frame's {self.size[0]}x{self.size[1]}")
                cropped = np.ascontiguousarray(pixels[: self.size[1], : self.size[0]])
                picture = av.VideoFrame.from_ndarray(cropped, format="rgb24")
                film.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace=1)))
                if progress is not None:
                    progress((place + 1) / len(self.paths))
            film.mux(stream.encode(None))
        return {"mpeg4": "MPEG-4"}.get(codec, "H.264")

    def _picture(self, place: int) -> np.ndarray:
        """Return a frame's tone-mapped picture, uint8 [height, width, 3]."""
        path = self.paths[place]
        if path.suffix.lower() == ".png":
            from PIL import Image

            try:
                with Image.open(path) as image:
                    return np.asarray(image.convert("RGB"))
            except (OSError, SyntaxError, ValueError) as error:
                raise SceneError(f"{path}: is no whole PNG file; render it again") from error
        frame = read_frame(path)
        if "beauty" not in frame.buffers:
            raise SceneError(f"{path}: has no picture (R, G, B); it has {', '.join(frame.names)}")
        return tone_map(stored_values("beauty", frame.numpy("beauty")), self.exposure)

    def _fps(self) -> float:
        """Return the frames a second that the first two files tell, by their times."""
        if len(self.paths) < 2 or self.pattern.suffix.lower() == ".png":
            return FPS
        first, second = (read_frame(path).time for path in self.paths[:2])
        return min(round(1.0 / (second - first), 3), MOST_FPS) if second > first else FPS


def check_video(pattern: Path) -> None:
    """Raise OptionError before frames are rendered, if no film can be made of them, or PyAV is not installed."""
    _av()
    if "#" not in pattern.name:
        raise OptionError(f"a film is made of files with #### in their name, got {pattern}")


def _av() -> Any:
    try:
        import av
    except ImportError:
        raise OptionError("films need PyAV: pip install 'warp-gi[video]'") from None
    return av
