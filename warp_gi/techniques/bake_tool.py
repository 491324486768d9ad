"""What a technique that can be baked tells ``warp-gi bake``: its settings, checks, files, pictures and tables."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from warp_gi.baking import Bake
from warp_gi.estimator import Estimator
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene

Rows = list[tuple[str, Any]]


class Table(NamedTuple):
    """A table to print: its title, names of columns, and rows."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]


class BakeTool(ABC):
    """How one technique is baked from the command line.

    A technique's module ``bake_tool`` has an instance of its own subclass as ``TOOL``; the registry names that module.
    """

    settings: ClassVar[type[Estimator]]
    """The estimator whose bake it is; its fields are the flags."""
    summary: ClassVar[Sequence[str]]
    """Lines of the command's help that say what is baked."""
    shows: ClassVar[Sequence[str]]
    """Lines of the command's help that say what ``write_pictures`` shows."""
    exports: ClassVar[Sequence[str]]
    """Lines of the command's help that say which files ``export`` writes for which name."""
    examples: ClassVar[Sequence[str]]
    """Arguments of the command's examples, as "hall.glb --cell-size 0.5"; without ``--technique``."""
    exported: ClassVar[str]
    """What the files of an export are called, as "textures"."""
    needs_sky: ClassVar[bool] = False
    """Whether its pictures show nothing without a sky, so that a white one stands for it."""
    finds_places: ClassVar[bool] = False
    """Whether it finds out by itself what to bake of a scene that has no camera."""

    @abstractmethod
    def check(self, settings: Any, everywhere: bool) -> None:
        """Raise OptionError for settings that cannot be baked, or if all of a scene was asked for in vain."""

    @abstractmethod
    def check_scene(self, settings: Any, scene: Scene) -> None:
        """Raise OptionError for a bake of the scene that would be too large."""

    @abstractmethod
    def check_export_name(self, path: Path) -> None:
        """Raise OptionError for a file that an export cannot be."""

    @abstractmethod
    def export(self, bake: Bake, path: Path) -> list[Path]:
        """Write the files of an export and return them, the description last."""

    @abstractmethod
    def write_pictures(
        self, scene: Scene, camera: Camera, bake: Bake, settings: Any, folder: Path, device: str, seed: int
    ) -> list[Path]:
        """Write pictures of the bake to a folder and return their paths."""

    @abstractmethod
    def rows(self, bake: Bake, seconds: float) -> Rows:
        """Return rows of the closing table, of a bake and the seconds that it took."""

    def tables(self, bake: Bake) -> list[Table]:
        """Return what else there is to tell, after the closing table."""
        return []

    def advice(self, bake: Bake, settings: Any) -> str:
        """Return one line on what to do for a better bake; "" if there is nothing to say."""
        return ""


def times(values: Any) -> str:
    """Return numbers as "4 x 4 x 4"."""
    return " x ".join(map(str, values))
