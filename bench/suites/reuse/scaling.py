"""What sample reuse adds to the suite ``scaling``: the light cache over lights, and its preset over pixels."""

from __future__ import annotations

import warp_gi as gi

EMITTERS = {"VisibilityLightCache": gi.VisibilityLightCache()}
PIPELINES = ("reuse",)
