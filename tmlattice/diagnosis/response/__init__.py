"""Diagnosis of an orbit response, whose ring has small errors everywhere.

In the order in which it happens: the data are looked at (`strangers`, `exchanged`, `odd_readings`),
a fit begins (`first_guess`, `state`), families come in one after another in damped rounds (`dense`,
`rounds`, `weights`, `jitter`), steps that went wrong are left out (`odd_steps`, `torn_steps`,
`other_kicks`), each family is judged by evidence and by readings that it was not fitted to
(`judges`, `rf_by_others`), few causes are sought alone (`few`) or among small errors
(`singled_out`), and it is told how well things are known (`stated`), which few numbers are behind
many (`reasons`), and what is missing (`missing`). `procedure` is all of it; `before_after` is that
of two measurements.
"""
