"""The import graph: kernels import no host code, the core imports no technique, and nothing imports in a circle."""

import ast
from functools import cache
from pathlib import Path

import pytest

from warp_gi import techniques

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"warp_gi": "warp_gi", "kernels": "warp_gi.kernels", "bench": "warp_gi.bench"}
OUTER = ("warp_gi.techniques", "warp_gi.cli", "warp_gi.bench")
"""What may import techniques: they themselves, the command line and the benchmarks."""
DESCRIPTIONS = {f"warp_gi.techniques.{folder}.technique" for folder in techniques.TECHNIQUES}


@cache
def modules():
    """Return the file of every module, by name. The links in warp_gi/ show the same files a second time."""
    found = {}
    for folder, package in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            if package != "warp_gi" or f"warp_gi.{parts[0]}" not in (
                "warp_gi.kernels",
                "warp_gi.bench",
                "warp_gi.assets",
            ):
                found[".".join([package, *parts]).removesuffix(".__init__")] = path
    return found


def imports_of(text, known):
    """Return the modules among ``known`` that a module's text imports, in functions and for types, too."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in known else node.module)
    return found & set(known)


@cache
def graph():
    known = modules()
    return {name: imports_of(path.read_text(), known) - {name} for name, path in known.items()}


def circle(edges):
    """Return modules that import one another in a circle, in order, or nothing."""
    done, path = set(), []

    def visit(name):
        if name in path:
            return path[path.index(name) :]
        if name in done:
            return []
        path.append(name)
        for other in sorted(edges[name]):
            if found := visit(other):
                return found
        path.pop()
        done.add(name)
        return []

    for name in sorted(edges):
        if found := visit(name):
            return found
    return []


def test_circles_are_found():
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == ["b", "c"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    text = "def f():\n    from warp_gi.scene import camera\nif TYPE_CHECKING:\n    import warp_gi.frame\n"
    assert imports_of(text, ["warp_gi.scene.camera", "warp_gi.frame"]) == {"warp_gi.scene.camera", "warp_gi.frame"}


def test_nothing_imports_in_a_circle():
    """Imports for types count, and those inside of functions."""
    assert len(graph()) > 150
    assert circle(graph()) == []


@pytest.mark.parametrize("name", [n for n in modules() if not n.startswith((*OUTER, "warp_gi.kernels"))])
def test_the_core_imports_no_technique(name):
    """The registry finds them by name; it reads the list of their folders."""
    inner = {other for other in graph()[name] if other.startswith(OUTER)}
    assert inner <= {"warp_gi.techniques"}, f"{name} imports {inner}"
    assert not inner or name == "warp_gi.registry"


@pytest.mark.parametrize("name", sorted(DESCRIPTIONS))
def test_descriptions_of_techniques_import_the_registry_alone(name):
    assert graph()[name] == {"warp_gi.registry"}


@pytest.mark.parametrize("name", [n for n in modules() if n.startswith("warp_gi.kernels.")])
def test_kernels_import_kernels_alone(name):
    assert all(other.startswith("warp_gi.kernels") for other in graph()[name])
