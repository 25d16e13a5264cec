"""OCELOT, imported without its greeting.

OCELOT prints while it is imported and takes seconds; everything in this package that needs it
imports it from here, and only when it is needed.
"""

import contextlib
import io
import logging

with contextlib.redirect_stdout(io.StringIO()):
    from ocelot.cpbd import elements
    from ocelot.cpbd.elements.optic_element import OpticElement
    from ocelot.cpbd.transformations.second_order import SecondTM
    from ocelot.cpbd.transformations.transformation import TMTypes

logging.getLogger("ocelot").setLevel(logging.ERROR)

__all__ = ["OpticElement", "SecondTM", "TMTypes", "elements"]
