"""The suite ``compile``: kernel modules, compiled and loaded."""
