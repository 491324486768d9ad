"""Films of sequences: what a player shows is what previews show."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError, SceneError
from warp_gi.sequence import video as films
from warp_gi.sequence.exr import write_exr
from warp_gi.sequence.preview import tone_map
from warp_gi.sequence.video import Video

av = pytest.importorskip("av")
COUNT, FPS = 6, 12.0


def light(index, height=35, width=65):
    """A smooth picture: red to the right, green downwards, blue by the frame; no codec loses much of it."""
    picture = np.zeros((height, width, 3), np.float32)
    picture[:, :, 0] = np.linspace(0.0, 1.5, width)
    picture[:, :, 1] = np.linspace(0.0, 0.8, height)[:, None]
    picture[:, :, 2] = 0.2 * index
    return picture


@pytest.fixture
def shots(tmp_path):
    for index in range(COUNT):
        write_exr(tmp_path / f"s.{index:04d}.exr", {"beauty": light(index)}, {"frame": index, "time": index / FPS})
    return tmp_path / "s.####.exr"


def read(path):
    with av.open(str(path)) as film:
        stream = film.streams.video[0]
        pictures = [
            frame.reformat(format="rgb24", src_colorspace=1).to_ndarray().astype(float) for frame in film.decode(stream)
        ]
        return pictures, float(stream.average_rate), stream.codec_context.name


@pytest.mark.parametrize("codec", [None, "mpeg4"])
def test_a_film_shows_the_frames(codec, shots, tmp_path, monkeypatch):
    """Every frame once and in order, in the previews' colours, at the pace of the frames' times; odd sizes are cut."""
    if codec is not None:
        monkeypatch.setattr(films, "CODECS", {codec: films.CODECS[codec]})
    assert Video(shots, exposure=1.0).write() == ("MPEG-4" if codec else "H.264")
    pictures, fps, name = read(tmp_path / "s.mp4")
    assert len(pictures) == COUNT and fps == FPS and name == (codec or "h264")
    for index, picture in enumerate(pictures):
        assert picture.shape == (34, 64, 3)
        wanted = tone_map(light(index)[:34, :64], 1.0)
        assert np.abs(picture - wanted).mean() < 6.0, index
    assert not list(tmp_path.glob(".*"))


def test_frames_that_are_named_and_their_pace(shots, tmp_path):
    film = Video(shots, tmp_path / "f.mkv", [0, 2, 4])
    assert film.fps == FPS / 2 and film.size == (64, 34)  # in real time
    film.write()
    assert len(read(tmp_path / "f.mkv")[0]) == 3
    assert Video(shots, fps=50).fps == 50


@pytest.mark.parametrize("codec", films.CODECS)
def test_colours_are_kept(codec, tmp_path, monkeypatch):
    """Within the steps of limited range; with the matrix of BT.601 green would be 15 off."""
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV has no {codec}")
    monkeypatch.setattr(films, "CODECS", {codec: films.CODECS[codec]})
    colours = [(200, 40, 30), (30, 180, 60), (20, 10, 126), (128, 128, 128), (255, 255, 255), (0, 0, 0)]
    for index, colour in enumerate(colours):
        Image.new("RGB", (32, 32), colour).save(tmp_path / f"c.{index}.png")
    Video(tmp_path / "c.#.png").write()
    for picture, colour in zip(read(tmp_path / "c.mp4")[0], colours, strict=True):
        assert np.abs(picture[4:-4, 4:-4] - colour).max() <= 4, colour


def test_pictures_of_png_files(tmp_path):
    for index in range(2):
        Image.fromarray(tone_map(light(index))).save(tmp_path / f"p.{index}.png")
    Video(tmp_path / "p.#.png").write()
    pictures, fps, _ = read(tmp_path / "p.mp4")
    assert fps == 24 and np.abs(pictures[1] - tone_map(light(1)[:34, :64])).mean() < 6.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"output": "f.avi"}, "cannot write f.avi: films are .mp4, .mov, .mkv files"),
        ({"frames": [0, 7, 9]}, "s.0007.exr: no such file, as are 1 others; render first"),
        ({"fps": 0}, "fps must be above 0 and at most 1000, got 0"),
        ({"exposure": 1e6}, "exposure must be from -100 to 100 stops"),
        ({"pattern": "s.exr"}, "a film is made of .exr or .png files with #### in their name"),
        ({"pattern": "t.####.exr"}, "t.####.exr: no such file"),
    ],
)
def test_mistakes_are_one_line(change, words, shots, tmp_path):
    with pytest.raises((OptionError, SceneError)) as error:
        Video(**{"pattern": shots, **change})
    assert words in str(error.value) and "\n" not in str(error.value) and not (tmp_path / "s.mp4").exists()


def test_a_frame_that_is_torn_leaves_the_film_as_it_was(shots, tmp_path):
    (tmp_path / "s.mp4").write_bytes(b"a film")
    torn = tmp_path / "s.0003.exr"
    torn.write_bytes(torn.read_bytes()[:-9])
    with pytest.raises(SceneError, match=r"s\.0003\.exr: not a whole EXR file"):
        Video(shots).write()
    write_exr(torn, {"beauty": light(3, 20)}, {})
    with pytest.raises(SceneError, match="is 65x20, expected the first frame's 64x34"):
        Video(shots).write()
    assert (tmp_path / "s.mp4").read_bytes() == b"a film" and not list(tmp_path.glob(".*"))


def test_the_commands(shots, tmp_path, capsys):
    assert cli.main(["video", str(shots), "-o", str(tmp_path / "g.mp4"), "--frames", "1-3"]) == 0
    assert "3 frames of 64x34, 12 a second, H.264" in capsys.readouterr().out and len(read(tmp_path / "g.mp4")[0]) == 3
    assert cli.main(["video", str(shots), "--fps", "-1"]) == 2
    command = ["render", "cornell_box", "--resolution=8x8", "--spp=1", "--pipeline=path", "--frames=0-1", "--video"]
    assert cli.main([*command, "-o", str(tmp_path / "r.####.exr")]) == 0
    shown = tone_map(gi.read_frame(tmp_path / "r.0001.exr").numpy("beauty"))
    assert np.abs(read(tmp_path / "r.mp4")[0][1] - shown).mean() < 12.0  # 8x8 pixels with noise
    assert cli.main([*command, "-o", str(tmp_path / "r.exr"), "--frames=0"]) == 2
    assert cli.main([*command, "--chunk=1/2", "-o", str(tmp_path / "r.####.exr")]) == 2
    told = capsys.readouterr().err.splitlines()
    assert "with #### in their name" in told[-2] and "--video needs all frames" in told[-1]
