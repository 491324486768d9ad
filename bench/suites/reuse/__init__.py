"""The suite ``reuse``: sample reuse."""
