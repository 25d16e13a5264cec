"""The paper's other systems: the methods for rings, on systems that fit on a page.

Each module has its equation, its map, a map learned from one solution, and `comparisons` of the
paper's figures with ours. `tmlattice reproduce` runs them all.
"""
