"""Writes the parts of the pages that come from the code: tables of settings, of flags and of public names.

``python docs/generate.py [--check]``. A region stands between ``<!-- KIND: NAMES -->`` and ``<!-- end -->``:

- ``settings: VisibilityField`` is a table of a dataclass's fields, with the docstrings below them;
- ``flags: warp_gi.cli.render.Render`` is the same as flags of a command;
- ``names: Scene Mesh`` is a table of names with the first line of their docstrings;
- ``features: warp_gi.scene.files.support.FEATURES`` is a table of what scene files can hold;
- ``models: warp_gi.scene.files.feature_models.MODELS`` says what is rendered of models that use them.

``--check`` writes nothing, and leaves with exit code 1 if a page is not what it would write.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import warp_gi
from warp_gi.scene.files.support import BY_NAME

DOCS = Path(__file__).parent
REGION = re.compile(
    r"(<!-- (?P<kind>settings|flags|names|features|models): (?P<what>[\w. ]+) -->\n).*?(?P<end><!-- end -->)", re.DOTALL
)


def named(name: str) -> Any:
    """Return a public name of ``warp_gi``, or what a dotted path leads to, e.g. "warp_gi.cli.render.Render"."""
    if "." not in name:
        return getattr(warp_gi, name)
    module, _, last = name.rpartition(".")
    return getattr(importlib.import_module(module), last)


def attribute_docs(kind: type) -> dict[str, tuple[str, str]]:
    """Return (annotation, docstring) of each documented setting of a class and its bases, by name."""
    found: dict[str, tuple[str, str]] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body
        for node, after in zip(body, [*body[1:], None], strict=True):
            if (
                isinstance(node, ast.AnnAssign)
                and not ast.unparse(node.annotation).startswith("ClassVar")
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
            ):
                found[ast.unparse(node.target)] = ast.unparse(node.annotation), " ".join(str(after.value.value).split())
    return found


def settings_table(name: str) -> str:
    """Return the fields of a dataclass as a Markdown table."""
    kind = named(name)
    docs, rows = attribute_docs(kind), []
    for field in dataclasses.fields(kind):
        annotation, text = docs[field.name]
        rows.append((f"`{field.name}`", _type(annotation), f"`{_default(field)}`", text))
    return _table(("setting", "type", "default", "what it does"), rows)


def flags_table(name: str) -> str:
    """Return the options of a command, a dataclass that tyro reads, as a Markdown table."""
    kind = named(name)
    docs, hints, rows = attribute_docs(kind), get_type_hints(kind, include_extras=True), []
    for field in dataclasses.fields(kind):
        if field.name not in docs:  # nested settings, which have tables of their own
            continue
        told = [one for one in get_args(hints[field.name])[1:] if hasattr(one, "metavar")]
        metavar = next((one.metavar for one in told if one.metavar), None)
        hint = next((one.help_behavior_hint for one in told if one.help_behavior_hint is not None), None)
        flag = f"--{field.name.replace('_', '-')}"
        flag = ", ".join([*(alias for one in told for alias in one.aliases or ()), flag])
        bare = get_args(hints[field.name])[0] if get_origin(hints[field.name]) is Annotated else hints[field.name]
        if "[" in str(metavar) or (metavar and metavar.isupper() and field.default is dataclasses.MISSING):
            flag = metavar  # positional
        elif metavar:
            flag += f" {metavar}"
        elif bare is not bool:
            flag += f" {_metavar(bare)}"
        default = _default(field) if hint is None else re.sub(r"^\(default: (.*)\)$", r"\1", str(hint))
        code = hint is None and default != ""
        rows.append((f"`{flag}`", f"`{default}`" if code else default, docs[field.name][1]))
    return _table(("flag", "default", "what it does"), rows)


def names_table(names: str) -> str:
    """Return public names with the first line of their docstrings as a Markdown table."""
    rows = []
    for name in names.split():
        first = (inspect.getdoc(named(name)) or "").partition("\n\n")[0]
        rows.append((f"`{name}`", " ".join(first.split())))
    return _table(("name", "what it is"), rows)


def features_table(name: str) -> str:
    """Return what scene files can hold, and what becomes of it, as a Markdown table."""
    rows = [(one.name, one.formats, one.status, one.how) for one in named(name)]
    return _table(("feature", "formats", "status", "what becomes of it"), rows)


def models_table(name: str) -> str:
    """Return what is rendered of models, which are given with the features that they use, as a Markdown table."""
    rows = []
    for model, features in named(name).items():
        used = [BY_NAME[feature] for feature in features]
        lacking = "; ".join(f"{one.name} ({one.status}): {one.how}" for one in used if one.status != "supported")
        rows.append((model, ", ".join(features), lacking or "whole"))
    return _table(("model", "features", "what is rendered"), rows)


KINDS: dict[str, Callable[[str], str]] = {
    "settings": settings_table,
    "flags": flags_table,
    "names": names_table,
    "features": features_table,
    "models": models_table,
}


def filled(text: str) -> str:
    """Return the text of a page with its regions made anew."""
    return REGION.sub(lambda match: f"{match[1]}\n{KINDS[match['kind']](match['what'])}\n\n{match['end']}", text)


def stale(check: bool) -> list[Path]:
    """Write the pages that are not what they should be, or with ``check`` only find them; return their paths."""
    found = []
    for path in sorted(DOCS.rglob("*.md")):
        text = path.read_text(encoding="utf-8")
        if filled(text) != text:
            found.append(path)
            if not check:
                path.write_text(filled(text), encoding="utf-8")
    return found


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if a page differs")
    options = parser.parse_args()
    found = stale(options.check)
    for path in found:
        name = path.relative_to(DOCS.parent)
        print(f"{name}: differs; run `python docs/generate.py`" if options.check else f"wrote {name}")
    return int(options.check and bool(found))


def _type(annotation: str) -> str:
    """Return an annotation as Markdown: the values of a Literal, and what a union allows, joined by "or"."""
    plain = re.sub(r"Literal\[(.*?)\]", lambda match: match[1].replace(", ", " | "), annotation).replace("'", '"')
    return " or ".join(f"`{part}`" for part in plain.split(" | "))


def _metavar(kind: Any) -> str:
    if get_args(kind) and not isinstance(kind, type):
        return f"{{{','.join(map(str, get_args(kind)))}}}"
    return {int: "N", float: "X", str: "NAME", Path: "FILE"}.get(kind, "VALUE")


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING:
        return ""
    value = field.default
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not isinstance(value, bool):
        return f"{value:.4g}"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _table(headers: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [headers, tuple("---" for _ in headers), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", r"\|").replace("<", "&lt;") for cell in row) + " |" for row in lines
    )


if __name__ == "__main__":
    sys.exit(main())
