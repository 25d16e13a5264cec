"""Diagnosis of an orbit response of a ring with distributed errors.

The order of the procedure: a sparse fit is tried (`sparse`). A fit of all errors begins
(`first_guess`, `state`), families are added and fitted by damped steps (`hierarchical`, `rounds`,
`weights`, `jitter`), outliers and wrong labels are rejected (`outlier_readings`, `labels`), each
family is tested by its evidence (`rounds`), the fit is validated on held-out readings
(`validation`), and single faults are sought given distributed errors (`detected_faults`). The
result has its errors (`stated`), common factors of many numbers (`common_factors`), and missing
effects (`missing_effects`). `procedure` diagnoses one measurement, `before_after` the change
between two.
"""
