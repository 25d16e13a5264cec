"""Diagnosis of an orbit response of a ring with distributed errors.

In order: the data are checked (`unlike_model`, `swaps`, `outliers`), a sparse solution is tried
(`sparse`), and all families of errors are fitted (`hierarchical`; noise model in `state` and
`weights`, damped Gauss-Newton in `rounds`). The fit is validated (`validation`), and single faults
are detected among distributed errors (`detected_faults`). Then errors are stated (`stated`), common
factors (`common_factors`) and missing effects (`missing_effects`) are sought. `procedure` is the
whole; `before_after` compares two measurements.
"""
