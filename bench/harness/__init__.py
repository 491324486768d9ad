"""How suites run, measure and record."""
