"""Parameters from measurements: fits, their errors, and what the data cannot tell."""
