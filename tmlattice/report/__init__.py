"""Reports of a diagnosis: text and one self-contained page.

Nothing is imported here: the text needs no template, and the page loads figures only to draw
them.
"""
