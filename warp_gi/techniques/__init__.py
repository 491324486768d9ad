"""Estimators, one file a technique."""
