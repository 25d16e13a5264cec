"""Inference from rows to an explanation, independent of rings."""
