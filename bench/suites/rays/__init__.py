"""The suite ``rays``: ray queries and tree builds beside Embree."""
