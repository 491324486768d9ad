"""The benchmark suites, one module or folder each."""
