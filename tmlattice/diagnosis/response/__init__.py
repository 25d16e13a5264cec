"""Diagnosis of an orbit response, whose ring has small errors everywhere.

In the order in which it happens: the data are checked (`strangers`, `exchanged`, `outliers`), few
causes are sought alone (`few`), all families of errors are fitted at once (`hierarchical`; `state`
and `weights` have the noise model, `rounds` the damped Gauss-Newton), validated on held-out
readings (`judges`), single faults are sought among small errors (`singled_out`), and the result is
reported: how well things are known (`stated`), which few numbers are behind many (`reasons`), and
what is missing (`missing`). `procedure` is all of it; `before_after` is that of two measurements.
"""
