"""How results are shown and kept; this package reads results and computes nothing."""
