"""Texel sets: how densely texels lie on each mesh."""

from __future__ import annotations

import math

import numpy as np

from warp_gi.errors import OptionError, unknown_name
from warp_gi.scene.scene import Scene

TEXELS_A_TRIANGLE = 4.0
"""Texels that the mean triangle of a mesh is to have, where densities are chosen."""
COVERED = 0.5
"""About the share of a page that surfaces cover."""
MOST_FACTOR = 32.0
"""Largest factor by which a density is raised above that of the others."""
LEAST_GIVEN, MOST_GIVEN = 1e-3, 1e3
"""Smallest and largest factor that may be given: beyond, meshes would be left without texels."""
LARGEST_SHARE = 0.25
"""Share of all texels that meshes of raised density may take, about."""


def parse_texel_sets(text: str) -> dict[str, float] | None:
    """Return the factors of "NAME=FACTOR,..." by name; {} for "one", None for "auto".

    Raises OptionError for anything else.
    """
    if text in ("auto", "one"):
        return None if text == "auto" else {}
    factors: dict[str, float] = {}
    if not isinstance(text, str):
        raise OptionError(f'texel_sets must be text, "auto", "one", or "NAME=FACTOR,...", got {text!r:.80}')
    for item in text.split(","):
        name, equals, number = (piece.strip() for piece in item.rpartition("="))
        try:
            factor = float(number)
        except ValueError:
            factor = math.nan
        if not (name and equals and LEAST_GIVEN <= factor <= MOST_GIVEN):
            raise OptionError(
                'texel_sets must be "auto", "one", or "NAME=FACTOR,..." with the name of a node or mesh and a factor'
                f" of its texels a metre, from {LEAST_GIVEN:g} to {MOST_GIVEN:g}, got {text!r}"
            )
        if name in factors:
            raise OptionError(f"texel_sets names {name!r} twice, in {text!r}")
        factors[name] = factor
    return factors


def density_factors(scene: Scene, texel_sets: str, areas: np.ndarray, counts: np.ndarray, texels: int) -> np.ndarray:
    """Return by how much texels lie denser along a line on each part than without sets, float64 [part].

    Parts are the meshes of all nodes, one after another; ``areas`` float64 [part] in square metres and ``counts`` are
    those of their triangles, of which 0 is none. ``texels`` is the number of all. A name is that of a node or of a
    mesh; where both have a factor, their product counts. Raises OptionError for an unknown name.
    """
    factors = parse_texel_sets(texel_sets)
    if factors is None:
        return automatic_factors(areas, counts, texels)
    check_texel_sets(scene, texel_sets)
    pairs = [(node.name, mesh.name) for node in scene.nodes for mesh in node.meshes]
    return np.array(
        [factors.get(node, 1.0) * (factors.get(mesh, 1.0) if mesh != node else 1.0) for node, mesh in pairs]
    )


def check_texel_sets(scene: Scene, texel_sets: str) -> None:
    """Raise OptionError for a name that no node with a mesh and no mesh has."""
    names = {name for node in scene.nodes for mesh in node.meshes for name in (node.name, mesh.name)}
    for name in parse_texel_sets(texel_sets) or ():
        if name not in names:
            raise unknown_name("node or mesh in texel_sets", name, names)


def automatic_factors(areas: np.ndarray, counts: np.ndarray, texels: int) -> np.ndarray:
    """Return factors that give the mean triangle of each part TEXELS_A_TRIANGLE, or fewer where there are many.

    A factor is from 1 to MOST_FACTOR. Parts whose factor is above 1 take about LARGEST_SHARE of the texels at most.
    """
    density = COVERED * texels / max(float(areas.sum()), 1e-300)
    mean = np.divide(areas * density, counts, out=np.full(len(areas), np.inf), where=(counts > 0) & (areas > 0.0))
    starved = mean < TEXELS_A_TRIANGLE
    wanted = min(TEXELS_A_TRIANGLE, LARGEST_SHARE * COVERED * texels / max(int(counts[starved].sum()), 1))
    return np.sqrt(np.clip(wanted / mean, 1.0, MOST_FACTOR**2))
