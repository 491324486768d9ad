"""Other renderers, measured beside this one."""
