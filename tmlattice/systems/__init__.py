"""The paper's other systems: the methods for rings, on systems that fit on a page.

Each module holds its equation, its map, what is learned from one solution, and `comparisons` of the
paper's figures with ours. `tmlattice dev reproduce` runs them all.
"""
