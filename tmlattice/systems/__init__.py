"""The paper's other systems: the methods for rings, on systems that fit on a page.

Each module holds its equation, its map, what is learned from one solution, and `comparisons`, the
paper's figures beside ours. `tmlattice dev reproduce` runs them all.
"""
