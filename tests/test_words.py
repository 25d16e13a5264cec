"""Texts have the field's words (`WORDS`), not those of a dialect.

To extend it: a pair in `WORDS` (a word that is looked for, whatever its case, and what to write in
its place), or a glob in `TEXTS` with how its prose is taken from the file.
"""

import ast
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

WORDS = (
    (r"told|tells?|telling", "reported, stated, determined"),
    (r"says?|said|saying", "report, state, message"),
    (r"mend(s|ed|ing)?", "correct, fix"),
    (r"put right|righted", "corrected"),
    (r"doctor|consulted", "data checks"),
    (r"strangers?|resembl\w+ nothing", "rejected channels"),
    (r"torn|odd (steps?|readings?)", "inconsistent steps, outliers"),
    (r"(gross|wild) readings?|spikes?|left-out readings?", "outliers"),
    (r"other kicks", "spurious kicks"),
    (r"exchanged (columns|correctors|monitors|BPMs|planes|labels)|are exchanged", "swapped"),
    (r"few causes|few reasons", "sparse fit, common factors"),
    (r"dense fit|families' fit", "hierarchical fit"),
    (r"singled out|stands? out", "detected fault"),
    (r"small errors everywhere", "distributed errors"),
    (r"pulled apart|pulls? apart", "inconsistency (Hausman test)"),
    (r"lacks? of the model|what is lacking", "model discrepancy"),
    (r"independent share", "effective sample size"),
    (r"judges?|judged|judging", "validation set, held-out readings, scored"),
    (r"likeliest", "most probable"),
    (r"rivals?", "alternatives"),
    (r"beside", "together with, next to, given"),
    (r"as found", "estimated"),
    (r"remed(y|ies)", "correction, recommended action"),
    (r"even in (its|their|the) logarithm", "log-uniform"),
    (r"(goes|go|went|going) astray|astray|without an end", "diverges, does not converge"),
    (r"nobody|not known", "unknown"),
    (r"speaks?|spoken", "states"),
    (r"culprits?", "faulty element"),
    (r"part(s|ed)? (them|the data|the two)|parts nothing", "separate"),
    (r"as it comes|as they come", "as it is"),
    (r"(\d\d? )?(January|February|March|April|May|June|July|August|September|October|November"
     r"|December) (\d\d?, )?20\d\d", "no date"),
)  # fmt: skip
"""Words (without the letters about them, in any case), and what to say instead."""


def page(path):
    """The prose of a Markdown page."""
    return prose(path.read_text(encoding="utf-8"))


def notebook(path):
    """The prose of the Markdown cells of a notebook."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    own = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"]
    return prose("\n\n".join(own))


def prose(text):
    """Markdown without code, links' addresses, and what is generated."""
    text = re.sub(r"^(```|~~~).*?^\1\s*$", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!--.*?-->|\$\$.*?\$\$", "", text, flags=re.DOTALL)
    text = re.sub(r"`[^`\n]*`", "`code`", text)
    text = re.sub(r"^:::.*(\n +:.*)*", "", text, flags=re.MULTILINE)
    return re.sub(r"\]\([^)]*\)", "]", text)


def module(path):
    """Docstrings and messages of a module: its texts of several words."""
    texts = [
        node.value for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value
    ]  # fmt: skip
    return re.sub(r"`[^`]*`", "`code`", "\n\n".join(texts))


TEXTS = {
    "tmlattice/**/*.py": module, "benchmarks/*.py": module,
    "README.md": page, "CHANGELOG.md": page, "CONTRIBUTING.md": page, "docs/**/*.md": page,
    "notebooks/*.ipynb": notebook,
}  # fmt: skip
"""Files by glob, and how their prose is taken from them."""
FILES = {path: taken for glob, taken in TEXTS.items() for path in sorted(ROOT.glob(glob))}


MONITOR = re.compile(r"(?<!position )\bmonitors?\b", re.IGNORECASE)


@pytest.mark.parametrize("path", [p for p, taken in FILES.items() if taken is not module],
                         ids=lambda path: str(path.relative_to(ROOT)))  # fmt: skip
def test_a_beam_position_monitor_is_a_bpm(path):
    text = FILES[path](path)
    assert not [text[m.start() - 40 : m.end() + 20] for m in MONITOR.finditer(text)]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_words_are_the_fields(path):
    text = FILES[path](path)
    wrong = [
        f"'{found[0]}' in '{text[max(found.start() - 40, 0) : found.end() + 20]}' -> {instead}"
        for words, instead in WORDS
        for found in re.finditer(rf"\b(?:{words})\b", text, re.IGNORECASE)
    ]
    assert not wrong, "\n".join(wrong)
