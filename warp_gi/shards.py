"""Bakes in shards: parts of a bake that separate processes make, and the merge that is equal to one bake of all.

A shard is a bake file of its own whose technique says which part of how many it is, so that nothing takes it for a
whole bake. Beside the settings it holds what has to be equal in all shards for the merge to be exact.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from warp_gi import launch, registry
from warp_gi.baking import Bake, load_bake, shard_of
from warp_gi.cluster.identity import Identity
from warp_gi.errors import BakeError, OptionError
from warp_gi.stateful import Stateful

if TYPE_CHECKING:
    from warp_gi.scene.camera import Camera, CameraPath
    from warp_gi.scene.scene import Scene
    from warp_gi.sequence.chunks import Chunk

PREFIX = "shard."
"""Beginning of the names in a shard's settings that say what has to be equal in all shards."""
_WORDS = {"of": "scene, sky or views of the camera", "code": "code of warp_gi"}
MOST_NAMED = 8
"""Missing shards that a message names."""


def check_shardable(part: Stateful) -> None:
    """Raise OptionError for an estimator or a radiance cache that cannot be baked in shards."""
    if type(part).bake_shard is not Stateful.bake_shard:
        return
    tools = [registry.bake_tool(name) for name in registry.bakeable()]
    able = [tool.settings.__name__ for tool in tools if tool.settings.bake_shard is not Stateful.bake_shard]
    raise OptionError(
        f"{type(part).__name__} cannot be baked in shards yet, but {' and '.join(able)} can: leave the chunk out"
    )


def bake_shard(
    scene: Scene,
    part: Stateful,
    chunk: Chunk,
    device: str,
    seed: int,
    camera: Camera | CameraPath | None,
    progress: Callable[[float], None] | None = None,
) -> Bake | None:
    """Return one shard of a part's bake; None if it has nothing to bake. Raises OptionError where it has no shards."""
    check_shardable(part)
    made = part.bake_shard(scene, device, seed, (chunk.number, chunk.count), progress, camera)
    if made is None:
        return None
    target = launch.get_device(device)
    identity = part.bake_identity(scene, camera)
    equal = {
        "seed": seed,
        "of": hashlib.sha256(identity.encode()).hexdigest(),
        "device": target.name if target.is_cuda else "cpu",
        **asdict(Identity.mine()),
    }
    settings = made.settings | {f"{PREFIX}{name}": value for name, value in equal.items()}
    technique = f"{made.technique}, shard {chunk.number} of {chunk.count}"
    return replace(made, technique=technique, settings=settings)


def merge_bakes(shards: Sequence[Bake | str | Path]) -> Bake:
    """Return the whole bake of its shards, with the arrays, settings and counts of one bake of all, bit for bit.

    Only seconds differ: they are those of all shards together.

    Args:
        shards: All shards of a bake, in any order: bakes, or their files.

    Raises BakeError for files that are no shards, for shards that are missing or there twice, and for those of another
    technique, scene, view, seed, device, version or processor, or of other settings.
    """
    names = [f"shard {place + 1} given" if isinstance(one, Bake) else str(one) for place, one in enumerate(shards)]
    bakes = [one if isinstance(one, Bake) else load_bake(one) for one in shards]
    if not bakes:
        raise BakeError("there is no shard to merge; give all shards of one bake")
    for one, name in zip(bakes, names, strict=True):
        _check_equal(bakes[0], names[0], one, name)
    numbers, count = _numbers(bakes, names), _shard(bakes[0], names[0])[2]
    if len(numbers) < count:
        absent = (f"{number}/{count}" for number in range(1, count + 1) if number not in numbers)
        told = ", ".join(itertools.islice(absent, MOST_NAMED))
        more = ", ..." if count - len(numbers) > MOST_NAMED else ""
        raise BakeError(
            f"{count - len(numbers)} of {count} shards are missing ({told}{more}): bake each by --chunk, and give all"
        )
    technique = _shard(bakes[0], names[0])[0]
    if technique not in registry.public():
        raise BakeError(f"{names[0]}: is of {technique!r}, which this warp_gi does not know; update it")
    kind: Any = registry.find(technique)
    plain = [
        replace(bakes[numbers[number]], technique=technique, settings=_own_settings(bakes[numbers[number]]))
        for number in sorted(numbers)
    ]
    whole: Bake = kind.merge_shards(plain)
    return whole


def _shard(bake: Bake, name: str) -> tuple[str, int, int]:
    found = shard_of(bake.technique)
    if found is None:
        raise BakeError(f"{name}: is a whole bake by {bake.technique!r}, not a shard; leave it out")
    return found


def _numbers(bakes: Sequence[Bake], names: Sequence[str]) -> dict[int, int]:
    """Return the place of each shard in what was given, by its number; raises BakeError for one that is there twice."""
    found: dict[int, int] = {}
    for place, (bake, name) in enumerate(zip(bakes, names, strict=True)):
        _, number, count = _shard(bake, name)
        if number in found:
            raise BakeError(
                f"shard {number} of {count} is there twice: {names[found[number]]} and {name}; leave one of them out"
            )
        found[number] = place
    return found


def _own_settings(bake: Bake) -> dict[str, Any]:
    return {name: value for name, value in bake.settings.items() if not name.startswith(PREFIX)}


def _check_equal(first: Bake, first_name: str, other: Bake, name: str) -> None:
    """Raise BakeError unless two shards are of one bake."""
    (technique, _, count), (other_technique, _, other_count) = _shard(first, first_name), _shard(other, name)
    pairs: list[tuple[str, object, object]] = [
        ("technique", technique, other_technique),
        ("number of shards", count, other_count),
        ("hash of the scene", first.scene_key[:12], other.scene_key[:12]),
        ("scene", first.scene_name, other.scene_name),
    ]
    for key in sorted({*first.settings, *other.settings}):
        short = key.removeprefix(PREFIX)
        word = _WORDS.get(short, short) if key.startswith(PREFIX) else f"setting {key}"
        pairs.append((word, first.settings.get(key, "none"), other.settings.get(key, "none")))
    differing = [f"{word} {theirs!s:.40} instead of {mine!s:.40}" for word, mine, theirs in pairs if mine != theirs]
    if differing:
        raise BakeError(f"{name}: is no shard of the same bake as {first_name}: it has {', '.join(differing)}")
