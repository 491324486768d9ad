"""The guide "Add an estimator" works: its files, written to a folder, render what its test expects."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs/guide/add_an_estimator.md"
BLOCK = re.compile(r"^`(?P<path>[\w/]+\.py)`\n\n```python\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
CONFTEST = """
from pathlib import Path

import warp_gi.kernels
import warp_gi.techniques

FILES = Path(__file__).parent / "files"  # a folder of their own: one named warp_gi beside this would hide the package
warp_gi.kernels.__path__.append(str(FILES / "kernels"))
warp_gi.techniques.__path__.append(str(FILES / "warp_gi/techniques"))
"""
TEST = "tests/ambient_occlusion/test_ambient_occlusion.py"


@pytest.fixture(scope="module")
def blocks():
    """The files that the guide shows, text by path."""
    return {match["path"]: match["text"] for match in BLOCK.finditer(PAGE.read_text(encoding="utf-8"))}


def write(folder, blocks):
    """Write the technique and its test to a folder, whose conftest.py makes it a part of the installed package."""
    for path, text in blocks.items():
        if path != "warp_gi/registry.py":
            file = folder / "files" / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
    (folder / "conftest.py").write_text(CONFTEST, encoding="utf-8")


def run(folder):
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        folder,
        folder / "files" / TEST,
    ]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder)


def test_the_files_of_the_guide_render_the_known_answer(tmp_path, blocks):
    assert next(iter(blocks)) == "kernels/ambient_occlusion.py" and list(blocks)[-1] == TEST and len(blocks) == 5
    write(tmp_path, blocks)
    result = run(tmp_path)
    assert result.returncode == 0 and "4 passed" in result.stdout, result.stdout + result.stderr


def test_a_broken_kernel_turns_the_test_of_the_guide_red(tmp_path, blocks):
    """Without the radius every ray meets the ceiling: the guide says to try that."""
    kernel = "kernels/ambient_occlusion.py"
    broken = blocks[kernel].replace("direction, radius)", "direction, float(wp.inf))")
    assert broken != blocks[kernel]
    write(tmp_path, blocks | {kernel: broken})
    result = run(tmp_path)
    assert result.returncode == 1 and "3 failed, 1 passed" in result.stdout, result.stdout + result.stderr
