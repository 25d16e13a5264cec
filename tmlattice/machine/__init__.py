"""The virtual machine: a ring with known causes, tracked by an engine and read by its monitors."""
