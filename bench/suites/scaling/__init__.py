"""The suite ``scaling``: how time and memory grow."""
