"""What a recording shows beyond what the baseline explains: where, which physics, and what it would take to know."""
