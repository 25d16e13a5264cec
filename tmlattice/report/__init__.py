"""Reports for people: one HTML page that holds everything and opens offline."""

from tmlattice.report.page import draw, page

__all__ = ["draw", "page"]
