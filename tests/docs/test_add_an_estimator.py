"""The guide "Add an estimator" works: its files, written to a folder, render what its test expects."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs/guide/add_an_estimator.md"
ROOT = PAGE.parents[2]
LINE = re.compile(
    r"^Then one line in the list of `(?P<path>[\w/.]+)`:\n\n```python\n    \"(?P<folder>\w+)\",\n```$", re.MULTILINE
)
BLOCK = re.compile(r"^`(?P<path>[\w/]+\.py)`\n\n```python\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
CONFTEST = """
from pathlib import Path

import warp_gi.kernels
import warp_gi.techniques

warp_gi.techniques.TECHNIQUES += ("{folder}",)
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
        file = folder / "files" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    line = LINE.search(PAGE.read_text(encoding="utf-8"))
    assert line["path"] == "warp_gi/techniques/__init__.py"
    (folder / "conftest.py").write_text(CONFTEST.replace("{folder}", line["folder"]), encoding="utf-8")


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
    assert all("ambient_occlusion" in path and not (ROOT / path).exists() for path in blocks)  # no file that is there
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


def test_the_technique_is_where_all_others_are(tmp_path, blocks):
    """By the line alone: public name, preset, flags of the command, metadata, and the truth table's scenes."""
    write(tmp_path, blocks)
    (tmp_path / "files" / TEST).write_text(EVERYWHERE, encoding="utf-8")
    result = run(tmp_path)
    assert result.returncode == 0 and "4 passed" in result.stdout, result.stdout + result.stderr


EVERYWHERE = """
import sys

import pytest

import warp_gi as gi
from warp_gi import registry
from warp_gi.cli.main import main
from warp_gi.sequence.frames import read_frame

sys.path.insert(0, "{tests}")
sys.path.insert(0, "{tests}/truth")


def test_names():
    assert "AmbientOcclusion" in gi.__all__ and "ao" in gi.Pipeline.presets()
    assert registry.technique_named("ambient-occlusion") is registry.technique_named("ao")


def test_command(tmp_path):
    command = ["render", "cornell_box", "--environment=1", "--pipeline=ao", "--environment.radius=0.5", "--frames=0"]
    assert main([*command, "--spp=2", "--resolution=24x16", "--quiet", "-o", str(tmp_path / "a.####.exr")]) == 0
    frame = read_frame(tmp_path / "a.0000.exr")
    assert frame.metadata["pipeline.environment.radius"] == 0.5 and frame.numpy("environment").max() > 0


def test_dependence():
    assert gi.Pipeline.preset("ao").dependence(gi.builtin_scene("cornell_box")).kind == "independent"


def test_claims():
    import test_truth_table

    test_truth_table.test_pictures_are_as_true_as_claimed("AmbientOcclusion")
""".replace("{tests}", str(ROOT / "tests"))
