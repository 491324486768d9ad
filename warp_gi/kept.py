"""Bakes kept in a folder: what takes seconds is made once for a scene and its settings, and read the next time.

A file is named by a hash of all that decides the bake's bits: class, settings, seed, what the part says of scene and
camera (``Stateful.bake_identity``), this package's own code, Warp, NumPy, and the kind of processor. It is a bake file
(``warp_gi.baking``): it appears whole or not at all, and a damaged one is found on reading. So several processes may
use one folder. Files not used for longest are removed first. The folder may be removed at any time.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import sys
import time
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

import warp_gi.kernels
from warp_gi.baking import Bake, load_bake
from warp_gi.errors import BakeError, one_line
from warp_gi.estimator import Estimator
from warp_gi.files import cache_folder, prune, remove_stale_parts, user_path
from warp_gi.radiance_cache import RadianceCache

if TYPE_CHECKING:
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.camera import Camera, CameraPath
    from warp_gi.scene.scene import Scene
    from warp_gi.stateful import Stateful

MOST_BYTES = 2 << 30
"""Bytes of all files, above which those not used for longest are removed."""
LEAST_SECONDS = 0.3
"""Seconds that making a bake has to take for it to be kept."""
VARIABLE = "WARP_GI_BAKES"
"""Environment variable that names another folder than ``warp_gi/bakes`` in the user's cache."""
DIGITS = 32
"""Digits of the hash in a file's name."""
_SUFFIX = ".safetensors"
_LOG = logging.getLogger("warp_gi")


class BakeFolder:
    """A folder of bakes.

    Args:
        folder: None is the one that WARP_GI_BAKES names, or ``warp_gi/bakes`` in XDG_CACHE_HOME or ~/.cache.
        most_bytes: Bytes of all files; None is ``MOST_BYTES``.
    """

    def __init__(self, folder: str | Path | None = None, most_bytes: int | None = None) -> None:
        named = folder or os.environ.get(VARIABLE)
        self.folder = user_path(named) if named else cache_folder("bakes")
        self.most_bytes = MOST_BYTES if most_bytes is None else most_bytes

    def bake(
        self,
        part: Stateful,
        scene: Scene | BakedScene,
        camera: Camera | CameraPath | None,
        device: wp.Device,
        seed: int,
        make: Callable[[], Bake | None],
    ) -> Bake | None:
        """Return the bake of a part that was kept, or the one that ``make`` returns, and keep it if it took long.

        A damaged file is made anew, and a folder that cannot be written to is left alone: one line says so (logger
        "warp_gi", level INFO).
        """
        path = self.path(part, scene, camera, device, seed)
        found = self._read(path)
        if found is not None:
            return found
        started = time.perf_counter()
        made = make()
        if made is not None and time.perf_counter() - started >= LEAST_SECONDS:
            self._keep(path, made)
        return made

    def path(
        self,
        part: Stateful,
        scene: Scene | BakedScene,
        camera: Camera | CameraPath | None,
        device: wp.Device,
        seed: int,
    ) -> Path:
        """Return the file of a part's bake."""
        name = type(part).__name__
        decides = (
            f"{type(part).__module__}.{name}",
            sorted(part.bake_settings(scene).items()),
            part.bake_identity(scene, camera),
            seed,
            device.name if device.is_cuda else wp.get_cpu_kernel_cache_key(),
            (code_hash(), _own_code(part), wp.__version__, np.__version__),
        )
        return self.folder / f"{name}-{hashlib.sha256(repr(decides).encode()).hexdigest()[:DIGITS]}{_SUFFIX}"

    def _read(self, path: Path) -> Bake | None:
        try:
            if not path.exists():
                return None
            found = load_bake(path)
        except (BakeError, OSError) as error:
            _LOG.info("a bake that was kept is made anew: %s", one_line(str(error)))
            return None
        with contextlib.suppress(OSError):  # a folder that others own
            os.utime(path)
        return found

    def _keep(self, path: Path, bake: Bake) -> None:
        try:
            remove_stale_parts(path)
            if bake.nbytes <= self.most_bytes:
                bake.save(path)
                prune(self.folder, f"?*-{'[0-9a-f]' * DIGITS}{_SUFFIX}", self.most_bytes, path)
        except (OSError, BakeError, TypeError) as error:  # TypeError: a value that a file does not hold
            _LOG.info(
                "the bake cannot be kept for the next time: %s; %s names another folder", one_line(str(error)), VARIABLE
            )


def cached_bake(
    kept: BakeFolder | str | Path | None,
    part: Stateful,
    scene: Scene | BakedScene,
    camera: Camera | CameraPath | None,
    device: wp.Device,
    seed: int,
    make: Callable[[], Bake | None],
) -> Bake | None:
    """Return a part's bake by ``BakeFolder.bake``; ``kept`` may name the folder, and None keeps nothing."""
    if kept is None:
        return make()
    folder = kept if isinstance(kept, BakeFolder) else BakeFolder(kept)
    return folder.bake(part, scene, camera, device, seed, make)


def _own_code(part: Stateful) -> tuple[str, ...]:
    """Return what decides the bake of a class from elsewhere, which may tell nothing of its settings."""
    module = sys.modules.get(type(part).__module__)
    if type(part).__module__.partition(".")[0] == __name__.partition(".")[0]:
        return ()
    source = Path(getattr(module, "__file__", None) or "")
    code = hashlib.sha256(source.read_bytes()).hexdigest() if source.is_file() else ""
    return code, repr(part)


@cache
def code_hash() -> str:
    """Return a SHA-256 of the package's code, but for the command line's: a bake of other code may have other bits."""
    digest = hashlib.sha256()
    package = Path(warp_gi.__file__).parent
    roots = [package, *map(Path, warp_gi.kernels.__path__)]
    for path in sorted({file.resolve() for root in roots for file in root.rglob("*.py")}):
        if package / "cli" not in path.parents:
            digest.update(f"{path.name} {path.stat().st_size}".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def bakes_by_class(bakes: Iterable[Bake], parts: dict[str, Stateful]) -> dict[str, list[Bake]]:
    """Return the bakes by the class that they are for; raises BakeError for one that nothing uses."""
    users = [part for part in parts.values() if isinstance(part, Estimator | RadianceCache)]
    found: dict[str, list[Bake]] = {type(part).__name__: [] for part in users}
    for one in bakes:
        one.check_whole()
        if one.technique not in found:
            names = ", ".join(sorted(found)) or "none"
            raise BakeError(
                f"a bake of {one.technique} was given, but the pipeline's estimators are: {names}; leave it out, "
                "or name another pipeline"
            )
        found[one.technique].append(one)
    return found
