"""What may be wrong with a machine."""

from tmlattice.effects.cause import Cause

__all__ = ["Cause"]
