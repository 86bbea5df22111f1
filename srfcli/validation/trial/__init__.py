"""A blind trial of the diagnosis: a sealed bank is diagnosed, then unsealed, and the answers are marked."""
