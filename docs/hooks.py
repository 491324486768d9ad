"""What the site has beyond the pages as a code host shows them: docstrings in full, pictures of ``assets/``.

mkdocs calls these functions (``hooks`` in mkdocs.yml). Links that leave ``docs/`` work on a code host; the site shows
their text alone, as it holds no source.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.structure.files import File

import warp_gi
from warp_gi import Denoiser, Estimator

ROOT = Path(__file__).parents[1]
NAMES = re.compile(r"<!-- names: (?P<names>[\w. ]+) -->\n.*?<!-- end -->", re.DOTALL)
LINK = re.compile(r"(?P<picture>!?)\[(?P<text>[^\]\n]*)\]\((?P<target>[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")
FENCE = re.compile(r"(^```.*?^```$)", re.DOTALL | re.MULTILINE)


def on_files(files: Any, config: Any) -> Any:
    """Add the pictures of ``assets/`` to the site."""
    for path in sorted((ROOT / "assets").glob("*.jpg")):
        files.append(File.generated(config, f"assets/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Return a page with the docstrings of the names in its tables, and with links that work on the site."""
    markdown = NAMES.sub(
        lambda match: match[0] + "\n\n" + "\n\n".join(map(_directive, match["names"].split())), markdown
    )
    folder = PurePosixPath("docs", page.file.src_uri).parent
    parts = FENCE.split(markdown)
    parts[::2] = [LINK.sub(lambda match: _on_site(match, folder), part) for part in parts[::2]]
    return "".join(parts)


def _directive(name: str) -> str:
    """Return what mkdocstrings replaces by the documentation of a public name; of an estimator, its settings alone."""
    module, value = warp_gi._PUBLIC.get(name), getattr(warp_gi, name)
    path = f"warp_gi.{name}" if module is None else f"{module}.{name}"
    lines = [f"::: {path}", "    options:", f"      heading: warp_gi.{name}", f"      toc_label: {name}"]
    if isinstance(value, type) and issubclass(value, (Estimator, Denoiser)) and value not in (Estimator, Denoiser):
        settings = [field.name for field in dataclasses.fields(value)]
        lines += (
            ["      inherited_members: true", f"      members: {settings}"] if settings else ["      members: false"]
        )
    return "\n".join(lines)


def _on_site(match: re.Match[str], folder: PurePosixPath) -> str:
    """Return a link as the site has it; ``folder`` is that of the page, from the project's root."""
    target = match["target"]
    if "://" in target or target.startswith("mailto:"):
        return match[0]
    parts: list[str] = []
    for part in (folder / target).parts:
        parts = parts[:-1] if part == ".." else [*parts, part]
    if parts[:1] == ["docs"]:
        return match[0]
    if parts[:1] == ["assets"]:
        up = "../" * (len(folder.parts) - 1)
        return f"{match['picture']}[{match['text']}]({up}{'/'.join(parts)})"
    return match["text"]
