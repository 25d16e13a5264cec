"""Families of errors of a hierarchical fit: each is one object, and `steps` lists them."""
