"""The suite ``sequence``: whole sequences from the command to written files."""
