"""From rows to an explanation: it knows rows, not rings."""
