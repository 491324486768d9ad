"""What the documents say is so: tables from the code, links, commands, examples in Python."""

import functools
import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import warp_gi as gi
from warp_gi import registry

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))])
FENCE = re.compile(r"^```(?P<language>\w*)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\[[^\]\n]*\]\((?P<target>[^)#\s]*)(?P<anchor>#[^)\s]*)?\)")
COMMANDS = {"render": "warp_gi.cli.render", "bake": "warp_gi.cli.bake", "bench compare": "warp_gi.cli.bench_compare"}


def name_of(path):
    return path.relative_to(ROOT).as_posix()


def blocks(path, language):
    found = FENCE.finditer(path.read_text(encoding="utf-8"))
    return [match["text"] for match in found if match["language"] == language]


@functools.cache
def anchors(path):
    """Return the anchors of a page, as code hosts make them from its headings."""
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    headings = [re.sub(r"[^\w\- ]", "", line).strip() for line in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    return {heading.lower().replace(" ", "-") for heading in headings} | set(re.findall(r'<a id="([\w-]+)"', text))


def generate():
    sys.path.insert(0, str(DOCS))
    try:
        return importlib.import_module("generate")
    finally:
        sys.path.remove(str(DOCS))


def test_tables_from_the_code_are_up_to_date():
    result = subprocess.run([sys.executable, DOCS / "generate.py", "--check"], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


def test_a_changed_docstring_makes_a_page_stale():
    text = (DOCS / "techniques/path_tracing.md").read_text(encoding="utf-8")
    assert generate().filled(text) == text
    assert generate().filled(text.replace("| `max_depth` |", "| `most_depth` |")) == text


DRAFTS = {
    name
    for one in registry.techniques().values()
    for name in (*one.estimators, *one.services, *one.caches, *one.functions)
    if not one.page
}
"""Public names of techniques that name no page yet."""


@pytest.mark.parametrize("name", [name for name in gi.__all__ if name not in DRAFTS])
def test_every_public_name_is_in_the_reference(name):
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (DOCS / "reference/api").glob("*.md"))
    names = re.findall(r"<!-- names: (.*?) -->", pages)
    assert sum(name in found.split() for found in names) == 1, f"{name} must stand in one region of docs/reference/api"


def test_every_estimator_has_a_table_of_its_settings():
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (DOCS / "techniques").glob("*.md"))
    for name in gi.__all__:
        value = getattr(gi, name)
        if (
            name not in DRAFTS
            and isinstance(value, type)
            and issubclass(value, (gi.Estimator, gi.Denoiser))
            and generate().attribute_docs(value)
        ):
            has_settings = [key for key in generate().attribute_docs(value) if key != "term"]
            assert not has_settings or f"<!-- settings: {name} -->" in pages or name in ("Estimator", "Denoiser"), name


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_links_lead_somewhere(path):
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    for match in LINK.finditer(text):
        target, anchor = match["target"], match["anchor"]
        if "://" in target:
            continue
        file = (path.parent / target).resolve() if target else path
        assert file.exists() and ROOT in file.parents, f"{name_of(path)}: {match[0]}: no such file"
        if anchor:
            assert anchor[1:] in anchors(file), f"{name_of(path)}: {match[0]}: no such heading"


def commands():
    for path in PAGES:
        for text in blocks(path, "sh"):
            for line in text.replace("\\\n", " ").splitlines():
                found = re.match(r"warp-gi (render|bake|bench compare)\b(.*?)(\s#.*)?$", line)
                if found:
                    yield pytest.param(found[1], shlex.split(found[2]), id=f"{name_of(path)}: {line}"[:100])


@pytest.mark.parametrize(("command", "arguments"), list(commands()))
def test_commands_are_understood(command, arguments):
    importlib.import_module(COMMANDS[command]).parse(arguments)


def test_the_example_of_the_readme_names_what_there_is():
    """It renders the atrium, which takes a minute; here two rooms, small."""
    (text,) = blocks(ROOT / "README.md", "python")
    assert len(text.splitlines()) <= 8
    for long, short in (('"atrium"', '"two_rooms"'), ("range(8)", "range(1)")):
        assert long in text
        text = text.replace(long, short)
    assert '_path("two_rooms")' in text
    run(text.replace('_path("two_rooms")', '_path("two_rooms").at_resolution(32, 18)'))


def test_the_readme_is_short():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) < 150
    assert next(i for i, line in enumerate(lines) if line.startswith("|")) >= 40


@pytest.mark.parametrize("number", range(3))
def test_examples_of_the_first_sequence_run(number, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = blocks(DOCS / "guide/first_sequence.md", "python")[number]
    run(text.replace("(320, 180)", "(64, 36)").replace("range(4)", "range(2)").replace("samples=20000", "samples=500"))
    assert [path.name for path in sorted(tmp_path.rglob("*.*")) if path.is_file()] == [
        ["shot.0000.exr", "shot.0001.exr"],
        ["path.json"],
        ["two_rooms.dvf.safetensors"],
    ][number]


@pytest.mark.parametrize(("number", "size"), [(0, "(320, 180)"), (1, "at_resolution(32, 32)")])
def test_examples_of_edits_run(number, size, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = blocks(DOCS / "guide/edits.md", "python")[number]
    assert size in text
    found = run(text.replace("(320, 180)", "(64, 36)"))
    if number == 0:
        frames = [gi.read_frame(path).numpy("object_id") for path in sorted(tmp_path.rglob("*.exr"))]
        assert len(frames) == 4 and all((frames[0] != frame).any() for frame in frames[1:])
    else:
        assert "(0.63, 0.065, 0.05)" in capsys.readouterr().out
        assert found["wall"].base_color == pytest.approx(found["wanted"], rel=1e-3)


@pytest.mark.parametrize("number", range(7))
def test_examples_of_ray_queries_run(number, tmp_path, monkeypatch, capsys):
    text = blocks(DOCS / "guide/ray_queries.md", "python")[number]
    monkeypatch.setattr(trimesh.ray.ray_triangle, "RayMeshIntersector", trimesh.ray.ray_triangle.RayMeshIntersector)
    if trimesh.ray.has_embree:
        embree = trimesh.ray.ray_pyembree
        monkeypatch.setattr(embree, "RayMeshIntersector", embree.RayMeshIntersector)
    (tmp_path / "example.py").write_text(text, encoding="utf-8")  # Warp reads kernels from files
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "example", raising=False)
    found = vars(importlib.import_module("example"))
    said = re.findall(r"^print.*  # ([\[(<].*)$", text, re.MULTILINE)
    assert capsys.readouterr().out.splitlines()[: len(said)] == said
    if number == 0:
        np.testing.assert_allclose(found["at"], [[0.75, 0.25, 0.0], [0.25, 0.75, 0.0]])
    elif number == 1:
        assert found["face"].tolist() == [0, -1]
    elif number == 2:
        np.testing.assert_allclose(found["seen"].depth[:, 24, 32], np.linspace(2, 4, 100), rtol=1e-6)
    elif number == 3:
        assert found["t"] == found["again"] == 1.5


def run(text):
    names = {}
    exec(compile(text, "example", "exec"), names)
    return names


def test_the_example_of_a_kernel_test_passes(tmp_path):
    text = next(text for text in blocks(DOCS / "guide/test_one_kernel.md", "python") if "def test_" in text)
    (tmp_path / "test_example.py").write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", tmp_path / "test_example.py"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0 and "1 passed" in result.stdout, result.stdout + result.stderr
