"""Compiled kernels that came with the package: used where Warp's hashes say that they fit, and nowhere else."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import warp as wp

import warp_gi as gi
from warp_gi import foretold, loading, shipped
from warp_gi.bench import ship

NAME = "warp_gi.kernels.one"
FLAGS = shipped.flags(loading.FLAG)
NATIVE = f"{wp.config.cpu_compiler_flags} {loading.FLAG}"


class Module:
    """A module whose hash is of its source and flags."""

    def __init__(self, name=NAME, source="1"):
        self.name, self.source, self.options = name, source, {"cpu_compiler_flags": None}

    def mark_modified(self):
        pass

    def get_module_identifier(self, block):
        return f"wp_{self.name}_{self.source}{len(self.options['cpu_compiler_flags']):x}"


@pytest.fixture
def objects(tmp_path, monkeypatch):
    """The folder of compiled kernels for this Warp, with those of one module."""
    cache, root = tmp_path / "cache", tmp_path / "objects"
    folder = root / wp.get_cpu_kernel_cache_key(cpu_compiler_flags=FLAGS)
    one = folder / f"wp_{NAME}_1{len(FLAGS):x}"
    one.mkdir(parents=True)
    cache.mkdir()
    (one / "code.o").write_bytes(b"machine code")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(cache))
    monkeypatch.setenv(shipped.VARIABLE, str(root))
    monkeypatch.setattr(shipped, "knows_level", lambda: True)
    return SimpleNamespace(cache=cache, root=root, folder=folder, one=one)


def prepared(module):
    loading.prepare(module)
    return module.options["cpu_compiler_flags"]


def test_machine_code_that_fits_is_copied_into_the_cache(objects):
    for _ in range(2):  # the second time it is there
        assert prepared(Module()) == FLAGS
        assert [one.name for one in objects.cache.iterdir()] == [objects.one.name]
        assert (objects.cache / objects.one.name / "code.o").read_bytes() == b"machine code"


def test_what_another_process_has_put_there_stays(objects):
    (objects.cache / objects.one.name).mkdir()
    assert prepared(Module()) == FLAGS and not list((objects.cache / objects.one.name).iterdir())


@pytest.mark.parametrize(("name", "source"), [(NAME, "2"), (NAME[:-1], "1"), (f"{NAME}_1", "1")])
def test_another_source_or_module_is_compiled_as_ever(objects, name, source):
    assert prepared(Module(name, source)) == NATIVE and not list(objects.cache.iterdir())


def another_key(objects, monkeypatch):
    objects.folder.rename(objects.root / "1.0.0-Linux-x86_64-00000000")


def old_processor(objects, monkeypatch):
    monkeypatch.setattr(shipped, "knows_level", lambda: False)


def asked_for_none(objects, monkeypatch):
    monkeypatch.setenv(shipped.VARIABLE, "")


def flags_of_the_user(objects, monkeypatch):
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", "-O1")


def full_disk(objects, monkeypatch):
    def copy(*arguments, **more):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shipped.shutil, "copyfile", copy)


@pytest.mark.parametrize("spoil", [another_key, old_processor, asked_for_none, flags_of_the_user, full_disk])
def test_kernels_are_compiled_as_ever_where_none_fit(objects, monkeypatch, spoil):
    spoil(objects, monkeypatch)
    flags = prepared(Module())
    assert flags == f"{wp.config.cpu_compiler_flags} {loading.FLAG}" and shipped.LEVEL not in flags
    assert not list(objects.cache.iterdir())


def test_the_level_of_this_processor_is_what_linux_says(monkeypatch):
    lines = "processor : 0\nflags\t\t: fpu {}\nprocessor : 1\nflags\t\t: fpu\n"
    for lacks in (None, "avx2", "fma"):
        known = " ".join(shipped.NEEDED - {lacks})
        monkeypatch.setattr(shipped.Path, "read_text", lambda path, known=known: lines.format(known))
        monkeypatch.setattr(shipped.sys, "platform", "linux")
        monkeypatch.setattr(shipped.platform, "machine", lambda: "x86_64")
        assert shipped.knows_level.__wrapped__() is (lacks is None)


def test_a_check_names_what_is_missing_or_old(objects, capsys):
    assert ship.main(["warp_gi.kernels.nothing", "--folder", str(objects.root), "--check"]) == 1
    assert "warp_gi.kernels.nothing: no machine code of its present source" in capsys.readouterr().out


@pytest.mark.slow
def test_what_is_shipped_is_loaded_without_a_compiler(tmp_path):
    objects, name = tmp_path / "objects", "warp_gi.kernels.compose"
    run = [sys.executable, "-m", "warp_gi.bench.ship", name, "--folder", str(objects)]
    assert subprocess.run(run, check=True, capture_output=True, text=True).stdout.startswith(name)
    assert subprocess.run([*run, "--check"]).returncode == 0
    code = (
        "from warp_gi import launch; from warp_gi.kernels.compose import compose_frame as kernel;"
        "launch.load(kernel, launch.get_device('cpu')); print(kernel.module.options['cpu_compiler_flags'])"
    )
    environment = os.environ | {shipped.VARIABLE: str(objects), "WARP_CACHE_PATH": str(tmp_path / "cache")}
    told = subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True)
    assert FLAGS in told.stdout
    files = {one.suffix for one in (tmp_path / "cache").rglob("wp_*/*")}
    assert files == {".o", ".meta", ".sha256"}  # no .cpp: nothing was compiled


def test_every_kernel_that_a_preset_foretells_is_shipped():
    scene, known = gi.builtin_scene("cornell_box"), set(ship.shipped_modules())
    for name in gi.Pipeline.presets():
        modules = {kernel.module.name for kernel in foretold.kernels_of(gi.Pipeline.preset(name), scene)}
        assert modules <= known, name
