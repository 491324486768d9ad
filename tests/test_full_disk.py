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
