"""Recipes for other schedulers, as the page has them: run by a stand-in for sbatch, and by GNU parallel."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import warp_gi as gi

PAGE = Path(__file__).parents[2] / "docs/guide/many_machines.md"
SCENE = "cornell_box --resolution 16x9 --spp 1 --seed 3"
SBATCH = r"""#!/bin/bash
# A stand-in for sbatch: reads #SBATCH lines of a script, runs each task of the array, and ends as the worst one.
range=$(sed -n 's/^#SBATCH --array=//p' "$1") worst=0
for SLURM_ARRAY_TASK_ID in $(seq "${range%-*}" "${range#*-}"); do
  export SLURM_ARRAY_TASK_ID SLURM_ARRAY_TASK_COUNT=$((${range#*-} - ${range%-*} + 1))
  export SLURM_CPUS_PER_TASK=$(sed -n 's/^#SBATCH --cpus-per-task=//p' "$1")
  bash "$1" || worst=$?
done
exit $worst
"""


def recipe(beginning):
    """Return the block of the page that begins so, made small."""
    blocks = [block.partition("\n")[2] for block in PAGE.read_text(encoding="utf-8").split("```")[1::2]]
    (found,) = [block for block in blocks if block.startswith(beginning)]
    for long, short in (
        ("hall.glb --camera path.json", SCENE),
        ("0-959", "0-4"),
        ("1-16", "1-3"),
        ("/16", "/3"),
        ("seq 16", "seq 3"),
        ("--cpus-per-task=8", "--cpus-per-task=1"),
        ("--threads 4", "--threads 1"),
    ):
        found = found.replace(long, short)
    return found


def run(script, folder):
    path = f"{Path(sys.executable).parent}{os.pathsep}{folder}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        script, shell=True, cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, text=True
    )


def check(folder):
    scene, path = gi.builtin_scene("cornell_box"), gi.builtin_camera_path("cornell_box").at_resolution(16, 9)
    pipeline = gi.Pipeline.preset("path", spp=1)
    output = folder / "shared" / "hall.####.exr"
    assert sorted(file.name for file in output.parent.iterdir()) == [f"hall.{index:04d}.exr" for index in range(5)]
    assert gi.plan_sequence(scene, path, pipeline, range(5), seed=3, output=output).frames == ()


@pytest.mark.slow
def test_the_slurm_array(tmp_path):
    (tmp_path / "job.sh").write_text(recipe("#!/bin/bash"))
    (tmp_path / "sbatch").write_text(SBATCH)
    (tmp_path / "sbatch").chmod(0o755)
    for _ in range(2):  # a job that is sent again finds its frames
        done = run("sbatch job.sh", tmp_path)
        assert done.returncode == 0, done
        check(tmp_path)
    assert "2 of 2 frames are there already" in done.stdout
    (tmp_path / "job.sh").write_text((tmp_path / "job.sh").read_text().replace("--spp 1", "--spp none"))
    assert run("sbatch job.sh", tmp_path).returncode == 2


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("parallel") is None, reason="needs GNU parallel")
def test_gnu_parallel(tmp_path):
    done = run(recipe("parallel"), tmp_path)
    assert done.returncode == 0, done
    check(tmp_path)
