"""What a person reads of a diagnosis: words, text, one page that holds everything.

Nothing is imported here: the text needs no template, and the page no figures before they are drawn.
"""
