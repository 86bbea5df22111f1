"""From formulas to NumPy and C, and the model that is made of them."""
