"""Services: parts that are built once a frame, whichever estimators ask for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from warp_gi.stateful import Stateful


@dataclass(frozen=True)
class Service(Stateful):
    """Base of every service: several estimators share it, and it is built once a frame before they preprocess.

    An estimator names the services that it needs (``Estimator.services``). ``preprocess`` and ``after`` run before
    those of estimators, and hand over what they made by ``Frame.offer``; estimators take it by ``Frame.offered``.
    """

    name: ClassVar[str]
    """Key of the service's state. A field of ``Pipeline`` with this name holds its settings."""
