"""Eq. 5 and terms of one's own, in torch and by kernels, and the minimisers."""
