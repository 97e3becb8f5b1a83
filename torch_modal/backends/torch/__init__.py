"""The reference, in torch: it serves everything."""
