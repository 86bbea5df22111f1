"""Independent tasks spread over processes or a cluster: the same function, the same tasks, the same results."""
