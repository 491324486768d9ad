"""The suite ``probes``: light field probes."""
