"""Equations of the pages as MathML, which browsers draw themselves: no script and no network.

`$...$` and `$$...$$` of a page come from `pymdownx.arithmatex` (generic) marked by brackets.
"""

import re
from html import unescape
from typing import Any

from latex2mathml.converter import convert

MARKED = re.compile(r"\\\((.+?)\\\)|\\\[(.+?)\\\]", re.DOTALL)
PLACE = re.compile(r'(<(?:span|div) class="arithmatex">)(.*?)(</(?:span|div)>)', re.DOTALL)


def on_page_content(html: str, **_: Any) -> str:
    """Draw the equations of a page; click's word for "no default" goes from the command page."""
    html = PLACE.sub(lambda place: place[1] + _drawn(place[2]) + place[3], html)
    return html.replace("<code>Sentinel.UNSET</code>", "")


def _drawn(marked: str) -> str:
    (found,) = MARKED.finditer(marked)
    inline, block = found[1], found[2]
    return str(convert(unescape(inline or block), display="inline" if inline else "block"))
