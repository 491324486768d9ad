"""Where packages lie: kernels/, bench/ and assets/ are installed as warp_gi.kernels, warp_gi.bench, warp_gi.assets.

All else is in pyproject.toml. The links of the same names in warp_gi/ are for editors and type checkers alone.
"""

from setuptools import find_packages, setup

APART = ("kernels", "bench", "assets")
links = [f"warp_gi.{name}{end}" for name in APART for end in ("", ".*")]
inside = find_packages(include=["warp_gi", "warp_gi.*"], exclude=links)
apart = [f"warp_gi.{name}" for folder in APART for name in find_packages(include=[folder, f"{folder}.*"])]
setup(packages=[*inside, *apart], package_dir={"warp_gi": "warp_gi", **{f"warp_gi.{name}": name for name in APART}})
