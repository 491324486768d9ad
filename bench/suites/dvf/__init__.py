"""The suite ``dvf``: visibility fields."""
