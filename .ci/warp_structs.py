"""A plugin for mypy: lets it read classes decorated with ``@wp.struct`` as host code uses them.

Mypy takes such a class for the class that its text says, which is what instances behave like. Two things are missing:
a field of type ``wp.float32`` or ``wp.int32`` holds a Python number on the host, and the struct itself has ``vars``
and ``numpy_dtype()``. Fields declared as ``wp.array(dtype=...)`` stay unchecked.
"""

from collections.abc import Callable

from mypy.nodes import MDEF, SymbolTableNode, Var
from mypy.plugin import ClassDefContext, Plugin
from mypy.types import AnyType, Instance, TypeOfAny

NUMBERS = {
    **{f"warp._src.types.{sign}int{bits}": "builtins.int" for sign in ("", "u") for bits in (8, 16, 32, 64)},
    **{f"warp._src.types.float{bits}": "builtins.float" for bits in (16, 32, 64)},
}


def read_struct(context: ClassDefContext) -> bool:
    """Give a struct's fields the types that they have on the host, add its other names, return True: all is known."""
    info = context.cls.info
    for field in info.names.values():
        if isinstance(field.node, Var) and isinstance(field.node.type, Instance):
            number = NUMBERS.get(field.node.type.type.fullname)
            if number:
                field.node.type = context.api.named_type(number, [])
    for name in ("vars", "numpy_dtype"):
        added = Var(name, AnyType(TypeOfAny.explicit))
        added.info = info
        added.is_classvar = True
        info.names[name] = SymbolTableNode(MDEF, added)
    return True


class WarpStructs(Plugin):
    """The plugin as mypy loads it."""

    def get_class_decorator_hook_2(self, fullname: str) -> Callable[[ClassDefContext], bool] | None:
        return read_struct if fullname in ("warp.struct", "warp._src.context.struct") else None


def plugin(version: str) -> type[Plugin]:
    """Return the plugin for a version of mypy."""
    return WarpStructs
