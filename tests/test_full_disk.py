"""A full disk: the error says so and names the file that was asked for, and nothing half-written stays."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from warp_gi.files import replacing
from warp_gi.sequence import lock
from warp_gi.sequence.lock import Claim
from warp_gi.sequence.preview import write_png
from warp_gi.techniques.shared.exr_parts import Part, write_exr_parts

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_writer_that_finds_no_room_names_the_file(tmp_path, monkeypatch):
    from PIL import Image

    def fails(self, *arguments, **more):
        raise FULL

    monkeypatch.setattr(Image.Image, "save", fails)
    with pytest.raises(OSError) as caught:
        write_png(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(tmp_path / "a.png"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("named", [None, "part"])
def test_names_of_temporary_files_are_not_told(tmp_path, named):
    with pytest.raises(OSError) as caught, replacing(tmp_path / "a.bin") as part:
        raise OSError(errno.ENOSPC, "No space left on device", str(part) if named else None)
    assert caught.value.filename == str(tmp_path / "a.bin") and not list(tmp_path.iterdir())
    with pytest.raises(OSError, match="words of its own"), replacing(tmp_path / "a.bin"):
        raise OSError("words of its own")
    with pytest.raises(OSError) as caught, replacing(tmp_path / "a.bin"):
        raise OSError(errno.ENOENT, "gone", "/another")
    assert caught.value.filename == "/another"


@pytest.mark.skipif(lock.fcntl is None, reason="this system has no such locks")
@pytest.mark.parametrize("written", [0, 10, None])
def test_a_claim_that_finds_no_room_leaves_nothing(tmp_path, monkeypatch, written):
    def write(file, data):
        if written is None:
            raise FULL
        return written

    monkeypatch.setattr(os, "write", write)
    claim = Claim(Path(tmp_path / "a.####.exr"), range(3), False)
    with pytest.raises(OSError, match="nothing can be written here") as caught:
        claim.take()
    assert caught.value.filename == str(tmp_path) and not list(tmp_path.iterdir())
    claim.release()


@pytest.mark.skipif(lock.fcntl is None, reason="this system has no limits of files")
@pytest.mark.parametrize("count", [1, 2])
def test_the_last_bytes_of_parts_that_find_no_room_are_told(tmp_path, count):
    """OpenImageIO says that all is well when a file cannot grow by what it writes when it closes it."""
    import resource

    noise = np.random.default_rng(1).random((40, 64, 3), np.float32)
    file = tmp_path / "a.exr"
    parts = [Part(name, ("R", "G", "B"), (64, 40), lambda: noise) for name in "ab"[:count]]
    write_exr_parts(file, file, parts)
    size, limits = file.stat().st_size, resource.getrlimit(resource.RLIMIT_FSIZE)
    for missing in (1, 10, 100, 1000):
        file.unlink()
        resource.setrlimit(resource.RLIMIT_FSIZE, (size - missing, limits[1]))
        try:
            with pytest.raises(OSError, match="cannot write"):
                write_exr_parts(file, file, parts)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
