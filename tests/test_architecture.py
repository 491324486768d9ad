"""What the code's own text promises: who imports what, who launches, what is public, what compiles for CUDA."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

import warp_gi

ROOT = Path(__file__).resolve().parents[1]
KERNELS = sorted((ROOT / "kernels").rglob("*.py"))
LINKED = ("kernels", "bench", "assets")  # in warp_gi/, for editors
HOST = sorted(
    [p for f in ("warp_gi", "bench") for p in (ROOT / f).rglob("*.py") if p.parts[len(ROOT.parts) + 1] not in LINKED]
)


def _imported(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def _relative(path):
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", KERNELS, ids=_relative)
def test_kernels_reach_nothing_of_the_host_code(path):
    for name in _imported(ast.parse(path.read_text())):
        assert not name.startswith("."), f"{path.name} imports {name}; write it in full"
        is_own = name in ("warp_gi", "warp_gi.kernels") or name.startswith("warp_gi.kernels.")
        assert not name.startswith("warp_gi") or is_own, f"{path.name} imports {name}"
        assert name != "warp_gi", f"{path.name} imports the host package"
        assert name.partition(".")[0] in {"warp", "warp_gi", "math", "typing", "functools", "collections", "__future__"}


def _launches(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr in ("launch", "launch_tiled"):
            if isinstance(node.value, ast.Name) and node.value.id in ("wp", "warp"):
                yield node.lineno
        elif isinstance(node, ast.ImportFrom) and node.module == "warp":
            yield from (node.lineno for alias in node.names if alias.name.startswith("launch"))


def test_only_one_place_launches():
    found = {_relative(path): list(_launches(ast.parse(path.read_text()))) for path in [*KERNELS, *HOST]}
    assert {path for path, lines in found.items() if lines} == {"warp_gi/launch.py"}, found


@pytest.mark.parametrize("path", [p for p in KERNELS if "@wp.kernel" in p.read_text()], ids=_relative)
def test_kernels_keep_their_form(path):
    """Every kernel takes ``first`` first, has at most 8 arguments, at most 60 lines and a comment above it."""
    text = path.read_text()
    lines = text.splitlines()
    assert 'set_module_options({"enable_backward": False' in text
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.FunctionDef):
            continue
        decorators = {ast.unparse(d).partition("(")[0] for d in node.decorator_list}
        if decorators & {"wp.kernel", "wp.func", "wp.func_native"}:
            assert ast.get_docstring(node) is None, f"{node.name}: a docstring inside rebuilds the module when edited"
        if "wp.kernel" in decorators:
            arguments = node.args.args
            assert arguments[0].arg == "first" and len(arguments) <= 8, node.name
            assert node.end_lineno - node.lineno < 60, f"{node.name} is too long"
            above = node.decorator_list[0].lineno - 2
            assert lines[above].strip().startswith("#"), f"{node.name}: say what a thread is, above the decorator"


@pytest.mark.parametrize("path", KERNELS, ids=_relative)
def test_locals_of_device_code_are_not_named_as_constants_of_warp(path):
    """Warp takes `e.pdf` for Euler's number until `e` was compiled: a hash then depends on what was compiled before."""
    for function in ast.walk(ast.parse(path.read_text())):
        if not isinstance(function, ast.FunctionDef):
            continue
        stored = {n.id for n in ast.walk(function) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        read = {
            n.value.id for n in ast.walk(function) if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)
        }
        own = (stored | {argument.arg for argument in function.args.args}) & read
        taken = {name for name in own if isinstance(getattr(wp, name, None), (int, float))}
        assert not taken, f"{function.name}: rename {taken}"


@pytest.mark.parametrize("name", warp_gi.__all__)
def test_public_names_are_there_and_documented(name):
    value = getattr(warp_gi, name)
    assert (value.__doc__ or "").strip(), f"{name} has no docstring"
    assert not value.__doc__.startswith(f"{name}("), f"{name} has only the docstring that dataclass made"


def test_unknown_public_name():
    with pytest.raises(AttributeError, match="no attribute 'lod_scene'"):
        warp_gi.lod_scene  # noqa: B018
    assert set(warp_gi.__all__) <= set(dir(warp_gi))


def test_import_is_light_and_compiles_nothing():
    script = """
import sys, warp
before = set(sys.modules)
import warp_gi
heavy = {"trimesh", "OpenImageIO", "OpenEXR", "rich", "tyro", "PIL", "pygltflib", "scipy"}
print(sorted({name.partition(".")[0] for name in set(sys.modules) - before} & heavy))
print(sorted(name for name in sys.modules if name.startswith("warp_gi.")))
print(warp._src.context.runtime is None)
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines() == ["[]", "[]", "True"], result.stdout


@pytest.mark.parametrize(
    "module", ["warp_gi", "warp_gi.cli.main", "warp_gi.launch", "warp_gi.metrics", "warp_gi.pipeline"]
)
def test_imports_start_nothing(module):
    """Importing loads no kernel module and does not even start Warp."""
    script = f"import {module}, warp; print(warp._src.context.runtime is None)"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "True"


def test_kernel_modules_are_found_and_compile_for_cuda(tmp_path):
    from warp_gi.bench import compile_cuda

    names = compile_cuda.kernel_modules()
    assert {Path(p).stem for p in KERNELS if "@wp.kernel" in p.read_text()} == {n.split(".")[2] for n in names}
    paths = compile_cuda.compile_module("warp_gi.kernels.compose", (80, 90), tmp_path)
    assert len(paths) == 2


@pytest.mark.slow
def test_every_kernel_compiles_for_cuda(tmp_path):
    from warp_gi.bench import compile_cuda

    for name in compile_cuda.kernel_modules():
        compile_cuda.compile_module(name, compile_cuda.ARCHITECTURES, tmp_path / name)


def test_kernels_have_one_name():
    """Imported as top-level ``kernels`` they would be a second set of Warp modules and structs."""
    script = f"import sys; sys.path.insert(0, {str(ROOT)!r}); import kernels"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode != 0 and "warp_gi.kernels" in result.stderr
    assert importlib.import_module("warp_gi.kernels").__file__
