"""The one command for whoever has a GPU: what it runs, when it stops, and what it writes."""

import json
import sys
import time

import pytest

from warp_gi.bench import on_gpu

TESTS = """
import pytest

@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_good(device):
    assert device == "cpu"

@pytest.mark.parametrize("device", ["cpu"])
def test_bad(device):
    assert False
"""


@pytest.fixture
def session(tmp_path, monkeypatch):
    monkeypatch.setattr(on_gpu, "ROOT", tmp_path)
    monkeypatch.setattr(on_gpu, "PYTHON", sys.executable)
    now = time.monotonic()
    return on_gpu.Session("cpu", tmp_path / "results.jsonl", now + 60, now + 50, {"cpu": "Some CPU"})


def test_device_tests_are_those_that_run_on_every_device():
    names = [path.relative_to(on_gpu.ROOT).as_posix() for path in on_gpu.device_tests()]
    assert names[0].startswith("tests/kernels/") and names[-1].startswith("tests/truth/")
    assert "tests/reuse/test_quadtree.py" in names and "tests/scene/test_camera.py" not in names


def test_a_row_counts_the_tests_of_the_device_alone(session, tmp_path):
    file = tmp_path / "test_two.py"
    file.write_text(TESTS, encoding="utf-8")
    on_gpu.run_tests(session, file)
    (row,) = [json.loads(line) for line in session.output.read_text(encoding="utf-8").splitlines()]
    assert (row["file"], row["passed"], row["failures"], row["skipped"]) == ("test_two.py", 1, 1, 0)
    assert row["cpu"] == "Some CPU" and "failed" not in row and session.failed == ["test_two.py"]


def test_what_takes_too_long_is_stopped_and_nothing_new_is_started(session, tmp_path):
    session.end, session.last_start = time.monotonic() + 1, time.monotonic() + 0.5
    code, seconds = session.run("slow", [sys.executable, "-c", "import time; time.sleep(30)"])
    assert code is None and seconds < 10
    on_gpu.run_suite(session, "rays")
    on_gpu.run_tests(session, tmp_path / "test_none.py")
    assert session.left_out == ["suite rays", "test_none.py"] and session.failed == ["slow"]


def test_a_suite_that_breaks_is_a_row_that_says_why(session):
    on_gpu.run_suite(session, "nothing")
    (row,) = [json.loads(line) for line in session.output.read_text(encoding="utf-8").splitlines()]
    assert row["suite"] == "nothing" and "exit code 2" in row["failed"] and "unknown benchmark suite" in row["failed"]
