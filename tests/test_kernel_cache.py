"""The cache of compiled kernels: damage is told and mended, what cannot be written names its folder and variable."""

from __future__ import annotations

import contextlib
import errno
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
import warp as wp

import warp_gi as gi
from warp_gi import kernel_cache, launch
from warp_gi.cli import main as cli

CPU = wp.get_device("cpu")


class Module:
    """A module whose folder holds one file of machine code, and that loads if the file is as it was compiled."""

    def __init__(self, cache):
        self.folder, self.failed_builds, self.compiled = cache / "one", {}, 0

    def get_module_identifier(self, block):
        return self.folder.name

    def load(self, device, block):
        code = self.folder / "code.o"
        if not code.exists():
            made = self.folder.with_name(f"one_p{os.getpid()}")
            made.mkdir()
            (made / code.name).write_bytes(b"machine code")
            time.sleep(0.02)
            self.compiled += 1
            try:
                os.rename(made, self.folder)  # as Warp does
            except OSError:  # another process got there first
                shutil.rmtree(made)
        if not code.read_bytes().startswith(b"machine"):
            raise Exception("Failed to load CPU module 'one'")  # as Warp does


@pytest.fixture
def module(tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    made = Module(tmp_path)
    kernel_cache.load(made, CPU, 1)
    assert made.compiled == 1 and json.loads((made.folder / kernel_cache.SUMS).read_text())
    return made


@pytest.mark.parametrize("knows", [True, False], ids=["with sums", "without"])
@pytest.mark.parametrize("content", [b"", b"noise", b"machine c0de"])
def test_damaged_code_is_told_and_compiled_again(module, caplog, content, knows):
    (module.folder / "code.o").write_bytes(content)
    if not knows:
        (module.folder / kernel_cache.SUMS).unlink()
    kernel_cache.load(module, CPU, 1)
    is_seen = knows or not content.startswith(b"machine")
    assert module.compiled == 1 + is_seen
    assert caplog.messages == [m for m in caplog.messages if f"are damaged in {module.folder} (" in m]
    assert len(caplog.messages) == is_seen
    if is_seen:
        kernel_cache.load(module, CPU, 1)
        assert module.compiled == 2 and len(caplog.messages) == 1


def test_damaged_sums_are_made_again(module):
    for content in (b"{", b"[1]", b"\xff"):
        (module.folder / kernel_cache.SUMS).write_bytes(content)
        before = module.compiled
        kernel_cache.load(module, CPU, 1)
        assert module.compiled == before + 1 and "code.o" in json.loads((module.folder / kernel_cache.SUMS).read_text())


def test_what_another_process_mends_meanwhile_is_left_alone(module, monkeypatch, caplog):
    """Both find the damage; the later one takes what the first one made, and removes nothing."""
    (module.folder / "code.o").write_bytes(b"noise")
    alone = kernel_cache._alone

    @contextlib.contextmanager
    def after_another(folder):
        with alone(folder):
            (folder / "code.o").write_bytes(b"machine code")
            (folder / "its own").write_text("")
            yield

    monkeypatch.setattr(kernel_cache, "_alone", after_another)
    kernel_cache.load(module, CPU, 1)
    assert module.compiled == 1 and (module.folder / "its own").exists() and not caplog.messages


def mend(module, gate, found):
    gate.wait()
    try:
        kernel_cache.load(module, CPU, 1)
        found.put((module.compiled, ""))
    except Exception as error:
        found.put((module.compiled, repr(error)))


def test_many_processes_mend_one_folder_at_once(module):
    """Compiling and loading take a while, in which the folder of others must not go."""
    context = multiprocessing.get_context("fork")
    for content in (b"noise", b""):
        (module.folder / "code.o").write_bytes(content)
        gate, found = context.Barrier(6), context.Queue()
        others = [context.Process(target=mend, args=(module, gate, found)) for _ in range(6)]
        for one in others:
            one.start()
        got = [found.get(timeout=60) for _ in others]
        for one in others:
            one.join()
        assert [problem for _, problem in got if problem] == []
        assert sum(compiled - module.compiled for compiled, _ in got) >= 1
        assert (module.folder / "code.o").read_bytes() == b"machine code"
        assert not list(module.folder.parent.glob("*.damaged"))


def test_a_kernel_that_does_not_compile_is_an_error_at_once(module):
    failing = SimpleNamespace(get_module_identifier=lambda block: "other", load=lambda device, block: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        kernel_cache.load(failing, CPU, 1)


@pytest.mark.parametrize("kind", [errno.ENOSPC, errno.EACCES, errno.EROFS])
def test_what_cannot_be_written_names_folder_and_variable(module, monkeypatch, capfd, tmp_path, kind):
    def fails(device, block):
        raise OSError(kind, os.strerror(kind), str(module.folder / "x"))

    monkeypatch.setattr(module, "load", fails)
    (module.folder / "code.o").write_bytes(b"")
    with pytest.raises(OSError, match="name another by WARP_CACHE_PATH") as caught:
        kernel_cache.load(module, CPU, 1)
    assert caught.value.errno == kind and caught.value.filename == str(tmp_path)
    monkeypatch.setattr(kernel_cache, "load", lambda *arguments: (_ for _ in ()).throw(caught.value))
    monkeypatch.setattr(launch, "_loaded", set())
    options = ["--resolution", "8x8", "--spp", "1", "--frames", "0", "--pipeline", "path", "--threads", "1", "--quiet"]
    code = 1 if kind == errno.ENOSPC else 2
    assert cli.main(["render", "cornell_box", *options, "-o", str(tmp_path / "o" / "a.exr")]) == code
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and str(tmp_path) in error and os.strerror(kind) in error


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a place where nothing can be made")
@pytest.mark.parametrize("by", ["HOME", "WARP_CACHE_PATH"])
def test_a_home_that_cannot_be_written_is_one_line(tmp_path, by):
    places = {name: value for name, value in os.environ.items() if name not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")}
    command = [sys.executable, "-m", "warp_gi.cli", "info", "cornell_box"]
    done = subprocess.run(command, env=places | {by: "/proc/1/none"}, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "/proc/1/none" in done.stderr and "name another by WARP_CACHE_PATH" in done.stderr


def test_a_folder_of_bakes_that_cannot_be_written_names_its_variable(tmp_path, monkeypatch, caplog):
    from warp_gi import kept

    (tmp_path / "file").write_text("")
    monkeypatch.setattr(kept, "LEAST_SECONDS", 0.0)
    scene = gi.builtin_scene("cornell_box")
    with caplog.at_level("INFO", "warp_gi"):
        gi.bake(scene, gi.VisibilityField(cell_size=1.0, samples=8, rays=8), cache=tmp_path / "file" / "below")
    said = [message for message in caplog.messages if "cannot be kept" in message]
    assert len(said) == 1 and "WARP_GI_BAKES" in said[0] and str(tmp_path / "file") in said[0]


COMMAND = [sys.executable, "-m", "warp_gi.cli", "render", "cornell_box", "--resolution", "8x8", "--spp", "1"]
COMMAND += ["--pipeline", "path", "--frames", "0", "-o"]


@pytest.fixture(scope="module")
def real_cache(tmp_path_factory):
    """A folder with Warp's files of a render, and its picture."""
    folder = tmp_path_factory.mktemp("cache")
    environment = os.environ | {"WARP_CACHE_PATH": str(folder)}
    subprocess.run([*COMMAND, str(folder / "a.exr")], env=environment, check=True, capture_output=True, timeout=600)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("harm", ["cut", "empty", "noise", "flips", "meta", "no meta", "cut without sums"])
def test_real_caches(tmp_path, real_cache, harm):
    """Warp's own files of one module, each way damaged."""
    shutil.copytree(real_cache, tmp_path / "cache")
    (code,) = (tmp_path / "cache").glob("*/*compose*/*.o")
    data = bytearray(code.read_bytes())
    if harm == "flips":
        data[100:4000:50] = bytes(255 - byte for byte in data[100:4000:50])
    if harm == "cut without sums":
        (code.parent / kernel_cache.SUMS).unlink()
    if "meta" in harm:
        (meta,) = code.parent.glob("*.meta")
        meta.write_text("{oops")
        if harm == "no meta":
            meta.unlink()
    else:
        broken = {"cut": data[: len(data) // 2], "empty": b"", "noise": os.urandom(5000)}
        code.write_bytes(broken.get(harm.split(" without")[0], data))
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    command = [*COMMAND, str(tmp_path / "a.exr")]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True, timeout=600)
    first, again = (gi.read_frame(folder / "a.exr").numpy("beauty") for folder in (real_cache, tmp_path))
    assert (first == again).all()
    if harm != "no meta":  # Warp itself compiles again where a file is missing
        assert f"are damaged in {code.parent}" in done.stderr + done.stdout
