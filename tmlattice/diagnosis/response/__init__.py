"""Diagnosis of an orbit response of a ring with distributed errors.

The order of the procedure: the data are checked (`unlike_model`, `swaps`), a sparse fit is tried
(`sparse`), a fit of all errors begins (`first_guess`, `state`), families are added one by one in
damped rounds (`stepwise`, `rounds`, `weights`, `jitter`), outliers are rejected
(`outlier_readings`, `outlier_steps`, `inconsistent_steps`, `spurious_kicks`), each family is
validated by evidence and held-out readings (`validation`, `rf_by_others`), and single faults are
sought given distributed errors (`detected_faults`). The result has its errors (`stated`), common
factors of many numbers (`common_factors`), and missing effects (`missing_effects`). `procedure`
diagnoses one measurement, `before_after` the change between two.
"""
