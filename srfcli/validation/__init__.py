"""The diagnosis put to the proof: an independent generator of recordings, and sealed trials on them."""
