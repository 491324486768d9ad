"""What a technique that can be baked tells ``warp-gi bake``: its settings, checks, files, pictures and tables."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Generic, NamedTuple, TypeVar

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.stateful import Stateful

Value = str | int | float
Rows = list[tuple[str, Value]]
"""Rows of a table of two columns: what a value is, with its unit, and the value."""

Settings = TypeVar("Settings", bound=Stateful)


class Table(NamedTuple):
    """A table to print."""

    title: str
    """Heading of the table."""
    columns: tuple[str, ...]
    """Names of the columns."""
    rows: Sequence[tuple[Value, ...]]
    """Rows, each with a value for every column."""


@dataclass(frozen=True)
class ExportSettings:
    """Settings of an export beside those of the bake: flags of ``warp-gi bake``. These are none."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""


@dataclass(frozen=True)
class ExportRequest(Generic[Settings]):
    """How an export is made."""

    settings: Settings
    """Settings of the bake."""
    own: ExportSettings = field(default_factory=ExportSettings)
    """Settings of the export, of the class that ``BakeTool.export_settings`` names."""
    components: int = 0
    """Number of principal components to compress to; 0 compresses nothing."""
    device: str = "cpu"
    """Device to compute on."""
    seed: int = 1
    """Seed that every random number follows from."""
    progress: Callable[[float], None] = field(default=lambda share: None)
    """Called with the share that is done."""


class BakeTool(ABC, Generic[Settings]):
    """How one technique is baked from the command line.

    A technique's module ``bake_tool`` has an instance of its own subclass as ``TOOL``; the registry names that module.
    """

    settings: type[Settings]
    """Class of the estimator or radiance cache that is baked; its fields are the flags."""
    summary: ClassVar[Sequence[str]]
    """Lines of the command's help that say what is baked."""
    shows: ClassVar[Sequence[str]]
    """Lines of the command's help that say what ``write_pictures`` shows."""
    exports: ClassVar[Sequence[str]]
    """Lines of the command's help that say which files ``export`` writes for which name."""
    examples: ClassVar[Sequence[str]]
    """Arguments of the command's examples, as "hall.glb --cell-size 0.5"; without ``--technique``."""
    exported: ClassVar[str]
    """Word for the files of an export, as "textures"."""
    export_settings: ClassVar[type[ExportSettings]] = ExportSettings
    """Class of the settings that an export has beside those of the bake; its fields are flags."""
    compresses: ClassVar[bool] = False
    """Whether an export can hold principal components of something, so that ``components`` may be above 0."""
    views: ClassVar[Sequence[str]] = ()
    """Lines of the command's help that say what the page of ``view`` shows; none where there is no page."""
    needs_sky: ClassVar[bool] = False
    """Whether its pictures show nothing without a sky, so that a white sky stands in for one."""
    finds_places: ClassVar[bool] = False
    """Whether the bake chooses what to bake in a scene that has no camera."""

    @abstractmethod
    def check(self, settings: Settings, everywhere: bool) -> None:
        """Raise OptionError for settings that cannot be baked, or if ``everywhere`` means nothing for them."""

    @abstractmethod
    def check_scene(self, settings: Settings, scene: Scene) -> None:
        """Raise OptionError for a bake of the scene that would be too large."""

    @abstractmethod
    def check_export(self, settings: Settings, path: Path, components: int) -> None:
        """Raise OptionError for a file that an export cannot be, and for settings whose bake cannot be exported."""

    def check_export_settings(self, own: ExportSettings, path: Path | None) -> None:
        """Raise OptionError for settings of an export that are out of range, or mean nothing for this file or none."""

    def exported_files(self, path: Path) -> list[Path]:
        """Return the files that ``export`` writes, but for those whose number the bake decides."""
        return [path, path.with_suffix(".json")]

    @abstractmethod
    def export(self, bake: Bake, path: Path, scene: Scene, request: ExportRequest[Settings]) -> list[Path]:
        """Write the files of an export of the scene's bake and return them, the description last."""

    def check_view(self, settings: Settings, path: Path) -> None:
        """Raise OptionError for a page that ``view`` cannot write; here for every one."""
        raise OptionError(f"--view is not known to bakes for {self.settings.__name__}; leave it out")

    def view(self, bake: Bake, scene: Scene, camera: Camera, path: Path) -> Path:
        """Write a page that shows the bake in a browser, at first as the camera sees it, and return its path."""
        raise NotImplementedError

    @abstractmethod
    def write_pictures(
        self, scene: Scene, camera: Camera, bake: Bake, settings: Settings, folder: Path, device: str, seed: int
    ) -> list[Path]:
        """Write pictures of the bake to a folder and return their paths."""

    @abstractmethod
    def rows(self, bake: Bake, seconds: float) -> Rows:
        """Return rows of the closing table about a bake that took so many seconds."""

    def tables(self, bake: Bake) -> list[Table]:
        """Return tables to print after the closing one."""
        return []

    def advice(self, bake: Bake, settings: Settings) -> str:
        """Return one line on what to do for a better bake; "" if there is nothing to say."""
        return ""


def times(values: Iterable[object]) -> str:
    """Return numbers as "4 x 4 x 4"."""
    return " x ".join(map(str, values))
