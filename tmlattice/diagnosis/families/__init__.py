"""Families of errors that a dense fit may have: each is one object, and `steps` says when it is
tried."""
